"""A plane tree in angles, and positions of what hangs on springs: an ODE in numpy, without constraints, for a whole batch."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def motion_in_minimal_coordinates(p: Any, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(q, v) at `times`.

    Spans s = B q − a, of rods s = ℓ (cos θ, sin θ), of other masses s = q, are functions of the coordinates u; with
    J = B⁻¹ ∂s/∂u and s̈ = (∂s/∂u) ü + σ the motion is JᵀM J ü = Jᵀ(f − M B⁻¹σ).
    """
    lanes, rods, n = p["rods"].shape
    hung = (
        p["rods"].clip(0).sum(1)
    )  # 1 where a rod holds the mass, which is the one that the rod's row names with a plus
    loose = np.stack([np.eye(n)[row == 0] for row in hung])
    spread = np.linalg.inv(np.concatenate([p["rods"], loose], 1))
    anchors = np.concatenate([p["anchors"], np.zeros((lanes, n - rods, 2))], 1)
    lengths = p["length"][..., None]

    def spans(u: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, ...]:
        """s, ṡ, σ, and ∂s/∂θ."""
        angle, turning = u[:, :rods, None], rate[:, :rods, None]
        along = lengths * np.concatenate([np.cos(angle), np.sin(angle)], 2)
        across = np.stack([-along[..., 1], along[..., 0]], 2)
        free, speed = (x[:, rods:].reshape(lanes, -1, 2) for x in (u, rate))
        join = lambda a, b: np.concatenate([a, b], 1)
        return join(along, free), join(across * turning, speed), join(-along * turning**2, 0 * free), across

    def motion(state: np.ndarray) -> tuple[np.ndarray, ...]:
        u, rate = state.reshape(2, lanes, -1)
        s, speeds, bent, across = spans(u, rate)
        return spread @ (s + anchors), spread @ speeds, spread @ bent, across, rate

    def force(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        s = p["springs"] @ q - p["hooks"]
        pull = p["stiffness"] * (np.sum(s**2, 2) / p["rest"] ** 2 - 1) / 2
        drag = p["drag"] + p["cubic drag"] * np.sum(v**2, 2)
        springs = np.swapaxes(p["springs"], 1, 2) @ (pull[..., None] * s)
        return p["mass"][..., None] * p["gravity"][:, None] - springs - drag[..., None] * v

    def field(t: float, state: np.ndarray) -> np.ndarray:
        q, v, bent, across, rate = motion(state)
        directions = np.zeros((lanes, n, 2, rate.shape[1]))
        for k in range(rods):
            directions[:, k, :, k] = across[:, k]
        for k in range(2 * (n - rods)):
            directions[:, rods + k // 2, k % 2, rods + k] = 1
        jacobian = np.einsum("bij,bjdu->bidu", spread, directions)
        heavy = p["mass"][:, :, None, None] * jacobian
        unbalanced = force(q, v) - p["mass"][..., None] * bent
        turned = np.einsum("bidu,bid->bu", jacobian, unbalanced)
        gram = np.einsum("bidu,bidw->buw", jacobian, heavy)
        return np.concatenate([rate.ravel(), np.linalg.solve(gram, turned[..., None]).ravel()])

    s0 = p["rods"] @ p["q"] - p["anchors"]
    angles = np.arctan2(s0[..., 1], s0[..., 0])
    towards = p["rods"] @ p["v"]
    turning = (s0[..., 0] * towards[..., 1] - s0[..., 1] * towards[..., 0]) / p["length"] ** 2
    start = [np.concatenate([a, (loose @ x).reshape(lanes, -1)], 1) for a, x in ((angles, p["q"]), (turning, p["v"]))]
    # The norm of the error is a mean over the batch, of which one mechanism may have most.
    found = solve_ivp(
        field, (0.0, times[-1]), np.concatenate([x.ravel() for x in start]), "DOP853", times, rtol=1e-12, atol=1e-12
    )  # fmt: skip
    moved = [motion(state) for state in found.y.T]
    return np.stack([x[0] for x in moved], 1), np.stack([x[1] for x in moved], 1)
