"""A bead on a torus, for which no global chart exists, and a knife edge, whose constraint is not holonomic."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ConstrainedSystem
from ..types import Time
from .scene import Drawing, Scene, State, minimal


def bead_on_torus(major: float = 2.0, minor: float = 1.0, gravity: float = 9.81) -> Scene[ConstrainedSystem]:
    """A bead of unit mass that slides without friction on a torus: 0 = ((√(x² + y²) − R)² + z² − r²)/2, z upwards.

    No single regular chart covers the torus. The reference uses the two angles, which are periodic: ρ = R + r cos θ,
    r θ̈ = −ρ φ̇² sin θ − g cos θ, ρ φ̈ = 2 r sin θ θ̇ φ̇.
    """
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, 0.0, -gravity], q.dtype),
        constraint=lambda t, q, args: ((jnp.sqrt(q[0] ** 2 + q[1] ** 2) - major) ** 2 + q[2] ** 2 - minor**2) / 2,
        potential=lambda q, args: gravity * q[2],
    )
    start = [0.3, 0.0, 0.5, 1.0]

    def field(t: float, z: np.ndarray) -> np.ndarray:
        theta, _, rate, turn = z
        rho = major + minor * np.cos(theta)
        return np.array(
            [
                rate,
                turn,
                (-rho * turn**2 * np.sin(theta) - gravity * np.cos(theta)) / minor,
                2 * minor * np.sin(theta) * rate * turn / rho,
            ]
        )

    def embed(t: float, z: np.ndarray) -> State:
        theta, phi, rate, turn = z
        rho, drho = major + minor * np.cos(theta), -minor * np.sin(theta) * rate
        s, c = np.sin(phi), np.cos(phi)
        q = np.array([rho * c, rho * s, minor * np.sin(theta)])
        return q, np.array([drho * c - rho * turn * s, drho * s + rho * turn * c, minor * np.cos(theta) * rate])

    y0, reference = embed(0.0, np.array(start)), minimal(field, start, embed)
    drawing = Drawing(lambda t, q: q[None, :2], {"bead": 0}, axes=("x in m, seen from above", "y in m"))
    return Scene("bead-on-torus", system, y0, 5.0, reference, 10.0, drawing=drawing)


def knife_edge(slope: float = 0.3, turn: float = 1.0, gravity: float = 9.81) -> Scene[ConstrainedSystem]:
    """A blade on an inclined plane, q = (x, y, φ), unit mass and inertia: it moves along its edge only,

        0 = ẋ sin φ − ẏ cos φ,   with the force g sin(slope) along x.

    Released at rest while turning at the rate ω = φ̇, it does not slide down but traces a cycloid: with
    a = g sin(slope), x = (a/2ω²) sin² ωt, y = (a/2ω²)(ωt − sin(2ωt)/2).
    """
    a = gravity * np.sin(slope)
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([a, 0.0, 0.0], q.dtype),
        nonholonomic=lambda t, q, v, args: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]),
        potential=lambda q, args: -a * q[0],
    )

    def reference(times: np.ndarray) -> State:
        t = np.asarray(times, float)
        s, c = np.sin(turn * t), np.cos(turn * t)
        scale = a / (2 * turn**2)
        q = np.stack([scale * s**2, scale * (turn * t - s * c), turn * t], -1)
        speed = a / turn * s
        return q, np.stack([speed * c, speed * s, np.full_like(t, turn)], -1)

    def points(t: Time, q: Array):
        half = 0.25 * jnp.stack([jnp.sin(q[2]), jnp.cos(q[2])])
        middle = q[1::-1]
        return jnp.stack([middle - half, middle, middle + half])

    axes = ("y in m, across the slope", "x in m, downhill")
    drawing = Drawing(points, {"middle of the blade": 1}, links=((0, 2),), down=True, t1=6.0, axes=axes)
    q0, v0 = (x[0] for x in reference(np.zeros(1)))
    return Scene("knife-edge", system, (q0, v0), 10.0, reference, index=2, drawing=drawing)
