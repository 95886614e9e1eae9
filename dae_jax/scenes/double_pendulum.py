"""The chaotic double pendulum, and chains of n pendulums: unit masses and lengths, y pointing down."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ConstrainedSystem
from ..types import Args, Time
from .scene import Drawing, Scene, State, minimal


def double_pendulum(
    angle1: float = np.pi / 2, angle2: float = np.pi / 2, gravity: float = 9.81
) -> Scene[ConstrainedSystem]:
    """The double pendulum of Pöll, Hafner and Heinzl in q = (x₁, y₁, x₂, y₂), 0 = (|r₁|² − 1)/2 = (|r₂ − r₁|² − 1)/2.

    Angles from the downward vertical in rad; released at rest, by default with both arms horizontal. Errors of the
    initial state grow about 1e4-fold to 10 s; the reference, in angles, is good to about 1e-8 there.
    """
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, gravity, 0.0, gravity], q.dtype),
        constraint=lambda t, q, args: jnp.stack([q[:2] @ q[:2] - 1, (q[2:] - q[:2]) @ (q[2:] - q[:2]) - 1]) / 2,
        potential=lambda q, args: -gravity * (q[1] + q[3]),
    )
    start = [angle1, angle2, 0.0, 0.0]
    chart = lambda z: jnp.stack(
        [jnp.sin(z[0]), jnp.cos(z[0]), jnp.sin(z[0]) + jnp.sin(z[1]), jnp.cos(z[0]) + jnp.cos(z[1])]
    )
    y0 = _embed(0.0, np.array(start))
    return Scene(
        "double-pendulum", system, y0, 10.0, minimal(_chain_field(gravity), start, _embed), 12.0, chart,
        drawing=_drawing(2, 2.0), paper=("fig7_baumgarte", "fig8_state_space"),
    )  # fmt: skip


def chain(n: int = 8, gravity: float = 9.81) -> Scene[ConstrainedSystem]:
    """A chain of n point masses on massless rods, hung at the origin, released horizontally; q = (x₁, y₁, …, xₙ, yₙ)."""
    force = np.tile([0.0, gravity], n)

    def constraint(t: Time, q: Array, args: Args):
        points = q.reshape(n, 2)
        rods = points - jnp.concatenate([jnp.zeros((1, 2), q.dtype), points[:-1]])
        return (jnp.sum(rods * rods, 1) - 1) / 2

    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.asarray(force, q.dtype),
        constraint=constraint,
        potential=lambda q, args: -gravity * jnp.sum(q.reshape(n, 2)[:, 1]),
    )
    start = [np.pi / 2] * n + [0.0] * n
    y0 = _embed(0.0, np.array(start))
    reference = minimal(_chain_field(gravity), start, _embed)
    return Scene(f"chain-{n}", system, y0, 1.0, reference, 2.0, drawing=_drawing(n, 1.0))


def _drawing(n: int, t1: float) -> Drawing:
    points = lambda t, q: jnp.concatenate([jnp.zeros((1, 2)), q.reshape(n, 2)])
    shown = {f"mass {i}": i for i in ((1, 2) if n == 2 else (1, n // 2, n))}
    return Drawing(points, shown, links=tuple((i, i + 1) for i in range(n)), down=True, t1=t1)


def _chain_field(gravity: float):
    """Lagrange's equations of n unit pendulums in angles: Σⱼ mᵢⱼ (cos(θᵢ−θⱼ) θ̈ⱼ + sin(θᵢ−θⱼ) θ̇ⱼ²) = −mᵢᵢ g sin θᵢ, with
    mᵢⱼ the mass below both joints, n − max(i, j).
    """

    def field(t: float, z: np.ndarray) -> np.ndarray:
        angle, rate = np.split(z, 2)
        n = len(angle)
        below = n - np.maximum.outer(np.arange(n), np.arange(n))
        difference = angle[:, None] - angle[None, :]
        right = -np.diagonal(below) * gravity * np.sin(angle) - (below * np.sin(difference)) @ rate**2
        return np.concatenate([rate, np.linalg.solve(below * np.cos(difference), right)])

    return field


def _embed(t: float, z: np.ndarray) -> State:
    angle, rate = np.split(z, 2)
    q = np.cumsum(np.stack([np.sin(angle), np.cos(angle)], 1), 0)
    v = np.cumsum(rate[:, None] * np.stack([np.cos(angle), -np.sin(angle)], 1), 0)
    return q.ravel(), v.ravel()
