"""Random trees and loops of point masses and rods, with springs, drag and driven joints, as arrays: a batch is one program."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import dae_jax


T1 = 0.5
# Of the Gram matrix of the constraints in the metric of M, its diagonal 1: below, a mechanism is near a dead centre.
NEAR_SINGULAR = 1e-2
SPRINGS = 2


@dataclasses.dataclass(frozen=True)
class Family:
    """`masses` in `dimensions` dimensions, hung up as a tree of `rods` rods and for the rest springs; where there are more rods
    than masses, the others close loops.
    """

    name: str
    masses: int
    dimensions: int
    rods: int
    driven: bool = False
    heavy_rods: bool = False


FAMILIES = {
    family.name: family
    for family in (
        Family("plane tree", 3, 2, 2),
        Family("loop of heavy rods", 3, 2, 4, heavy_rods=True),
        Family("driven loop in space", 2, 3, 3, driven=True),
    )
}


def mechanism(family: Family, seed: int) -> dict[str, Any]:
    """Incidence matrices, parameters and a consistent start (q, v), all numpy arrays whose shapes are the family's."""
    rng = np.random.default_rng([list(FAMILIES).index(family.name), seed])
    while True:
        drawn = _drawn(family, rng)
        jacobian, inverse = constraint_jacobian(drawn, 0.0, drawn["q"]), np.linalg.inv(mass_matrix(drawn))
        if np.all(np.linalg.norm(jacobian, axis=1) > 0.3) and conditioning(jacobian, inverse) > 10 * NEAR_SINGULAR:
            break
    wanted = rng.normal(size=drawn["q"].size)
    off = jacobian @ wanted + time_derivative(drawn, 0.0, drawn["q"])
    towards = inverse @ jacobian.T
    drawn["v"] = (wanted - towards @ np.linalg.solve(jacobian @ towards, off)).reshape(drawn["q"].shape)
    return drawn


def _drawn(family: Family, rng: np.random.Generator) -> dict[str, Any]:
    n, d, m = family.masses, family.dimensions, family.rods
    parents = [-1] + [int(rng.integers(-1, i)) for i in range(1, n)]
    base, q = rng.normal(size=(n, d)), np.zeros((n, d))
    for i, parent in enumerate(parents):
        direction = rng.normal(size=d)
        q[i] = (base[i] if parent < 0 else q[parent]) + rng.uniform(0.5, 1.5) * direction / np.linalg.norm(direction)
    tree = list(enumerate(parents))
    chords = [(i, j) for i in range(n) for j in range(-1, i) if (i, j) not in tree]
    hung = [tree[0]] + [tree[k] for k in 1 + rng.permutation(n - 1)]
    rods = (hung + [chords[k] for k in rng.permutation(len(chords))])[:m]
    springs = (hung[m:] + [(i, int(rng.integers(-1, i))) for i in rng.integers(0, n, SPRINGS)])[:SPRINGS]

    def incidence(edges: Any) -> tuple[np.ndarray, np.ndarray]:
        matrix, anchor = np.zeros((len(edges), n)), np.zeros((len(edges), d))
        for row, (i, j) in enumerate(edges):
            matrix[row, i] = 1
            if j >= 0:
                matrix[row, j] = -1
            else:
                anchor[row] = base[i]
        return matrix, anchor

    on_rods, anchors = incidence(rods)
    on_springs, hooks = incidence(springs)
    at_ground = np.array([j < 0 for _, j in rods])[:, None]
    return {
        "mass": 10 ** rng.uniform(-0.5, 0.5, n),
        "rod mass": rng.uniform(0.1, 1, m) * family.heavy_rods,
        "rods": on_rods, "anchors": anchors,
        "length": np.linalg.norm(on_rods @ q - anchors, axis=1),
        "drive": 0.2 * rng.normal(size=(m, d)) * at_ground * family.driven,
        "breath": 0.1 * rng.uniform(-1, 1, m) * family.driven,
        "frequency": np.array(rng.uniform(2, 8)),
        "springs": on_springs, "hooks": hooks,
        "stiffness": 10 ** rng.uniform(0, 2, SPRINGS),
        # A spring much shorter than the rods is too stiff, stretched, for the quadrature of powers.
        "rest": np.maximum(np.linalg.norm(on_springs @ q - hooks, axis=1), 0.5) * rng.uniform(0.8, 1.2, SPRINGS),
        "drag": rng.uniform(0, 1, n) * (rng.random() < 0.7),
        "cubic drag": 0.1 * rng.uniform(0, 1, n) * (rng.random() < 0.5),
        "gravity": rng.normal(size=d) * 5,
        "q": q,
    }  # fmt: skip


def system(family: Family, p: Any) -> dae_jax.ConstrainedSystem:
    """M v̇ = f − Gᵀλ, 0 = (|s|² − ℓ(t)²)/2 for each rod, s = B q − a(t); the potential of a spring is k (|s|² − ℓ²)²/(8 ℓ²)."""

    def force(t: Any, q: Any, v: Any, p: Any) -> Any:
        weights = p["mass"] + jnp.abs(p["rods"]).T @ p["rod mass"] / 2
        s = p["springs"] @ q - p["hooks"]
        pull = p["stiffness"] * (jnp.sum(s**2, 1) / p["rest"] ** 2 - 1) / 2
        drag = p["drag"] + p["cubic drag"] * jnp.sum(v**2, 1)
        return weights[:, None] * p["gravity"] - p["springs"].T @ (pull[:, None] * s) - drag[:, None] * v

    def constraint(t: Any, q: Any, p: Any) -> Any:
        s, length = p["rods"] @ q - p["anchors"], p["length"]
        if family.driven:
            wave = jnp.sin(p["frequency"] * t)
            s, length = s - p["drive"] * wave, length * (1 + p["breath"] * wave)
        return (jnp.sum(s**2, 1) - length**2) / 2

    shape = family.masses, family.dimensions
    if family.heavy_rods:
        ends = jnp.abs(p["rods"])
        rods = (ends.T * p["rod mass"]) @ ends
        mass = jnp.kron(jnp.diag(p["mass"] + ends.T @ p["rod mass"] / 6) + rods / 6, jnp.eye(shape[1]))
    else:
        mass = jnp.broadcast_to(p["mass"][:, None], shape)
    return dae_jax.ConstrainedSystem(force, constraint, mass)


# The same in numpy, each on its own, for the checks.


def mass_matrix(p: Any) -> np.ndarray:
    """From the kinetic energy μ (|a|² + a·b + |b|²)/6 of a rod whose ends have the velocities a and b."""
    matrix = np.diag(p["mass"])
    for row, mass in zip(p["rods"], p["rod mass"], strict=True):
        ends = np.flatnonzero(row)
        matrix[ends, ends] += mass / 3
        if len(ends) == 2:
            matrix[ends, ends[::-1]] += mass / 6
    return np.kron(matrix, np.eye(len(p["gravity"])))


def spans(p: Any, t: float, q: np.ndarray) -> np.ndarray:
    return p["rods"] @ q - p["anchors"] - p["drive"] * np.sin(p["frequency"] * t)


def constraint_jacobian(p: Any, t: float, q: np.ndarray) -> np.ndarray:
    """∂g/∂q, a row a rod."""
    return np.einsum("mn,md->mnd", p["rods"], spans(p, t, q)).reshape(len(p["rods"]), -1)


def time_derivative(p: Any, t: float, q: np.ndarray) -> np.ndarray:
    """∂g/∂t."""
    wave, rate = np.sin(p["frequency"] * t), p["frequency"] * np.cos(p["frequency"] * t)
    lengths = p["length"] ** 2 * (1 + p["breath"] * wave) * p["breath"]
    return -rate * (np.sum(spans(p, t, q) * p["drive"], 1) + lengths)


def off_constraints(p: Any, t: float, q: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """The largest of g and ġ over the length of the gradient."""
    jacobian = constraint_jacobian(p, t, q)
    lengths = np.linalg.norm(jacobian, axis=1)
    now = p["length"] * (1 + p["breath"] * np.sin(p["frequency"] * t))
    g = (np.sum(spans(p, t, q) ** 2, 1) - now**2) / 2
    rate = jacobian @ v.ravel() + time_derivative(p, t, q)
    return float(np.max(np.abs(g) / lengths)), float(np.max(np.abs(rate) / lengths))


def energy(p: Any, q: np.ndarray, v: np.ndarray) -> float:
    weights = p["mass"] + np.abs(p["rods"]).T @ p["rod mass"] / 2
    s = np.sum((p["springs"] @ q - p["hooks"]) ** 2, 1)
    springs = np.sum(p["stiffness"] * (s - p["rest"] ** 2) ** 2 / p["rest"] ** 2) / 8
    return float(v.ravel() @ mass_matrix(p) @ v.ravel() / 2 - weights @ (q @ p["gravity"]) + springs)


def power(p: Any, t: float, q: np.ndarray, v: np.ndarray, multipliers: np.ndarray) -> float:
    """Of drag, and of what drives the joints: −v·Gᵀλ = λ·∂g/∂t."""
    speeds = np.sum(v**2, 1)
    return float(-np.sum((p["drag"] + p["cubic drag"] * speeds) * speeds) + multipliers @ time_derivative(p, t, q))


def conditioning(jacobian: np.ndarray, inverse_mass: np.ndarray) -> float:
    gram = jacobian @ inverse_mass @ jacobian.T
    scale = 1 / np.sqrt(np.diag(gram))
    return float(np.linalg.eigvalsh(gram * scale * scale[:, None])[0])


# How each parameter scales with (mass, length, time).
_DIMENSIONS = {
    "mass": (1, 0, 0), "rod mass": (1, 0, 0), "anchors": (0, 1, 0), "length": (0, 1, 0), "drive": (0, 1, 0),
    "frequency": (0, 0, -1), "hooks": (0, 1, 0), "stiffness": (1, 0, -2), "rest": (0, 1, 0), "drag": (1, 0, -1),
    "cubic drag": (1, -2, 1), "gravity": (0, 1, -2), "q": (0, 1, 0), "v": (0, 1, -1),
}  # fmt: skip


def scaled(p: Any, mass: Any, length: Any, time: Any) -> dict[str, Any]:
    """The same mechanisms (a batch) in other units."""
    factor = lambda name, x: np.prod(
        [u**e for u, e in zip((mass, length, time), _DIMENSIONS[name], strict=True)], 0
    ).reshape(-1, *[1] * (np.ndim(x) - 1))
    return {name: x * factor(name, x) if name in _DIMENSIONS else x for name, x in p.items()}


def in_another_frame(p: Any, seed: int) -> tuple[dict[str, Any], Callable[[np.ndarray], np.ndarray]]:
    """The same mechanism, its masses, rods and springs in another order, in a frame that is turned, mirrored and shifted; and
    the way of velocities into that frame (of positions, less the shift, which is 1 along each axis).
    """
    rng = np.random.default_rng([9, seed])
    masses, rods, springs = (rng.permutation(len(p[name])) for name in ("mass", "rods", "springs"))
    turn, _ = np.linalg.qr(rng.normal(size=(p["q"].shape[1],) * 2))
    turned = lambda x: x[..., masses, :] @ turn
    moved = {
        "mass": p["mass"][masses], "drag": p["drag"][masses], "cubic drag": p["cubic drag"][masses],
        "rods": p["rods"][rods][:, masses], "springs": p["springs"][springs][:, masses],
        "anchors": p["anchors"][rods] @ turn + p["rods"][rods].sum(1)[:, None],
        "hooks": p["hooks"][springs] @ turn + p["springs"][springs].sum(1)[:, None],
        "rod mass": p["rod mass"][rods], "length": p["length"][rods], "breath": p["breath"][rods],
        "drive": p["drive"][rods] @ turn, "stiffness": p["stiffness"][springs], "rest": p["rest"][springs],
        "gravity": p["gravity"] @ turn, "q": turned(p["q"]) + 1, "v": turned(p["v"]),
    }  # fmt: skip
    return p | moved, turned
