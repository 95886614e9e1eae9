"""Closed loops: a slider-crank and a parallelogram four-bar linkage."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ConstrainedSystem
from ..types import Args, Time
from .scene import Drawing, Scene, State, minimal


def slider_crank(crank: float = 1.0, rod: float = 2.5, gravity: float = 9.81) -> Scene[ConstrainedSystem]:
    """A crank (unit mass at its pin), a massless rod and a slider of unit mass on the x axis; q = (θ, s), M = [[1, ¼], [¼, 1]].

    The rod closes the loop, 0 = ((s − r sin θ)² + (r cos θ)² − ℓ²)/2, θ from the downward vertical. The off-diagonal
    mass is an inertial coupling (a gyrostat); with s = S(θ) the kinetic energy is m(θ) θ̇²/2, m = 1 + S′/2 + S′².
    """
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.stack([-gravity * jnp.sin(q[0]), 0 * q[1]]),
        constraint=lambda t, q, args: ((q[1] - crank * jnp.sin(q[0])) ** 2 + (crank * jnp.cos(q[0])) ** 2 - rod**2) / 2,
        mass=np.array([[1.0, 0.25], [0.25, 1.0]]),
        potential=lambda q, args: -gravity * jnp.cos(q[0]),
    )

    def slider(x: float) -> tuple[float, float, float]:
        """S, S′ and S″ of S = r sin θ + √(ℓ² − r² cos² θ)."""
        s, c = np.sin(x), np.cos(x)
        root = np.sqrt(rod**2 - crank**2 * c**2)
        first = crank**2 * s * c / root
        second = crank**2 * (c**2 - s**2) / root - first**2 / root
        return crank * s + root, crank * c + first, -crank * s + second

    def field(t: float, z: np.ndarray) -> np.ndarray:
        _, first, second = slider(z[0])
        inertia, slope = 1 + first / 2 + first**2, second / 2 + 2 * first * second
        return np.array([z[1], (-gravity * np.sin(z[0]) - slope * z[1] ** 2 / 2) / inertia])

    def embed(t: float, z: np.ndarray) -> State:
        position, first, _ = slider(z[0])
        return np.array([z[0], position]), np.array([z[1], first * z[1]])

    chart = lambda z: jnp.stack([z[0], crank * jnp.sin(z[0]) + jnp.sqrt(rod**2 - crank**2 * jnp.cos(z[0]) ** 2)])
    start = [2.0, 0.5]

    def points(t: Time, q: Array):
        pin = crank * jnp.stack([jnp.sin(q[0]), jnp.cos(q[0])])
        return jnp.stack([jnp.zeros(2), pin, jnp.stack([q[1], 0 * q[1]])])

    drawing = Drawing(points, {"crank pin": 1, "slider": 2}, links=((0, 1), (1, 2)), down=True, t1=2.0)
    y0, reference = embed(0.0, np.array(start)), minimal(field, start, embed)
    return Scene("slider-crank", system, y0, 10.0, reference, chart=chart, drawing=drawing)


def four_bar(redundant: bool = False, base: float = 2.0, gravity: float = 9.81) -> Scene[ConstrainedSystem]:
    """A parallelogram: cranks of length 1 at (0, 0) and (b, 0), joined by a coupler of length b; unit masses at the pins.

    Both pins move on circles in parallel, so that the motion is that of one pendulum. With `redundant`, a third, parallel
    rod from the coupler's middle to (b/2, 0) adds a constraint that depends on the others.
    """
    pivot = np.array([base, 0.0])

    def constraint(t: Time, q: Array, args: Args):
        left, right = q[:2], q[2:]
        middle = (left + right - pivot) / 2
        rods = [left @ left - 1, (right - pivot) @ (right - pivot) - 1, (right - left) @ (right - left) - base**2]
        return jnp.stack([*rods, middle @ middle - 1] if redundant else rods) / 2

    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, gravity, 0.0, gravity], q.dtype),
        constraint=constraint,
        potential=lambda q, args: -gravity * (q[1] + q[3]),
    )

    def embed(t: float, z: np.ndarray) -> State:
        arm = np.array([np.sin(z[0]), np.cos(z[0])])
        velocity = z[1] * np.array([np.cos(z[0]), -np.sin(z[0])])
        return np.concatenate([arm, arm + pivot]), np.concatenate([velocity, velocity])

    start = [1.0, 0.0]
    field = lambda t, z: np.array([z[1], -gravity * np.sin(z[0])])
    name = "four-bar-redundant" if redundant else "four-bar"
    chart = lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0]), base + jnp.sin(z[0]), jnp.cos(z[0])])

    def points(t: Time, q: Array):
        left, right, base_left, base_right = q[:2], q[2:], jnp.zeros(2), jnp.asarray(pivot)
        return jnp.stack([base_left, left, right, base_right, base_right / 2, (left + right) / 2])

    rods = ((0, 1), (1, 2), (2, 3), (4, 5)) if redundant else ((0, 1), (1, 2), (2, 3))
    drawing = Drawing(points, {"left pin": 1, "right pin": 2}, links=rods, down=True, t1=1.0)
    y0, reference = embed(0.0, np.array(start)), minimal(field, start, embed)
    return Scene(name, system, y0, 10.0, reference, chart=chart, drawing=drawing)
