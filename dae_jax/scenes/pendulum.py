"""The pendulum and its relatives: unit mass and length, y pointing down."""

import jax.numpy as jnp
import numpy as np

from ..systems import ConstrainedSystem
from .scene import Drawing, Scene, State, minimal


def pendulum(
    angle: float = np.pi / 2, angular_velocity: float = 0.0, gravity: float = 9.81
) -> Scene[ConstrainedSystem]:
    """The pendulum of Pöll, Hafner and Heinzl: v̇ = (0, g) − λ q, 0 = (|q|² − 1)/2, one degree of freedom.

    `angle` from the downward vertical in rad; the default is released horizontally. The reference is exact, by Jacobi
    elliptic functions, also for a pendulum that swings over the top.
    """
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, gravity], q.dtype),
        constraint=lambda t, q, args: (q @ q - 1) / 2,
        potential=lambda q, args: -gravity * q[1],
    )
    q0 = np.array([np.sin(angle), np.cos(angle)])
    v0 = angular_velocity * np.array([np.cos(angle), -np.sin(angle)])

    def reference(times: np.ndarray) -> State:
        sine, cosine, rate = _exact(np.asarray(times, float), angle, angular_velocity, gravity)
        return np.stack([sine, cosine], -1), rate[:, None] * np.stack([cosine, -sine], -1)

    chart = lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])])
    drawing = Drawing(lambda t, q: jnp.stack([jnp.zeros(2), q]), {"mass": 1}, links=((0, 1),), down=True, t1=1.0)
    paper = ("fig4_drift_off", "fig5_euler_speed", "fig6_phase_portrait")
    return Scene("pendulum", system, (q0, v0), 10.0, reference, chart=chart, drawing=drawing, paper=paper)


def _exact(t: np.ndarray, angle: float, rate: float, gravity: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sin θ, cos θ and θ̇ of θ̈ = −g sin θ.

    Libration, with k² = (θ̇₀²/2 + g(1 − cos θ₀)) / 2g < 1 and ω = √g: sin(θ/2) = k sn(ωt + u₀ | k²),
    θ̇ = 2ωk cn. Rotation, k > 1: sin(θ/2) = ± sn(ωk t + u₀ | 1/k²), θ̇ = ± 2ωk dn.
    """
    from scipy.special import ellipj, ellipkinc

    omega = np.sqrt(gravity)
    m = (rate**2 / 2 + gravity * (1 - np.cos(angle))) / (2 * gravity)
    k = np.sqrt(m)
    if k == 0:
        return 0 * t, 1 + 0 * t, 0 * t
    if m < 1:
        phase = np.arctan2(np.sin(angle / 2) / k, rate / (2 * omega * k))
        sn, cn, dn, _ = ellipj(omega * t + ellipkinc(phase, m), m)
        half, whole, rates = k * sn, dn, 2 * omega * k * cn
    else:
        direction = np.sign(rate)
        start = ellipkinc(direction * angle / 2, 1 / m)
        sn, cn, dn, _ = ellipj(omega * k * t + start, 1 / m)
        half, whole, rates = direction * sn, cn, direction * 2 * omega * k * dn
    return 2 * half * whole, 1 - 2 * half**2, rates


def moving_pivot_pendulum(
    amplitude: float = 0.3, frequency: float = 3.0, gravity: float = 9.81
) -> Scene[ConstrainedSystem]:
    """A pendulum whose pivot moves as (a sin ωt, 0): 0 = (|q − p(t)|² − 1)/2, a constraint that depends on time.

    In the angle: θ̈ = −g sin θ − p̈ₓ cos θ.
    """
    a, w = amplitude, frequency
    pivot = lambda t: jnp.stack([a * jnp.sin(w * t), jnp.zeros_like(jnp.asarray(t))])
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, gravity], q.dtype),
        constraint=lambda t, q, args: (jnp.sum((q - pivot(t)) ** 2) - 1) / 2,
    )

    def embed(t: float, z: np.ndarray) -> State:
        s, c = np.sin(z[0]), np.cos(z[0])
        return np.array([a * np.sin(w * t) + s, c]), np.array([a * w * np.cos(w * t) + z[1] * c, -z[1] * s])

    def field(t: float, z: np.ndarray) -> np.ndarray:
        return np.array([z[1], -gravity * np.sin(z[0]) + a * w**2 * np.sin(w * t) * np.cos(z[0])])

    start = [1.0, 0.0]
    chart = lambda t, z, args: pivot(t) + jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])])
    y0, reference = embed(0.0, np.array(start)), minimal(field, start, embed)
    points = lambda t, q: jnp.stack([pivot(t), q])
    drawing = Drawing(points, {"pivot": 0, "mass": 1}, links=((0, 1),), down=True, t1=2.0)
    return Scene("moving-pivot-pendulum", system, y0, 10.0, reference, chart=chart, drawing=drawing)


def spherical_pendulum(
    polar: float = 1.0, azimuthal_rate: float = 2.0, gravity: float = 9.81
) -> Scene[ConstrainedSystem]:
    """A pendulum in space, z pointing down: conserves the energy and the angular momentum x ẏ − y ẋ.

    In the polar angle from the downward vertical and the azimuth: θ̈ = φ̇² sin θ cos θ − g sin θ, φ̇ = L / sin² θ.
    """
    system = ConstrainedSystem(
        force=lambda t, q, v, args: jnp.array([0.0, 0.0, gravity], q.dtype),
        constraint=lambda t, q, args: (q @ q - 1) / 2,
        potential=lambda q, args: -gravity * q[2],
    )
    momentum = azimuthal_rate * np.sin(polar) ** 2

    def field(t: float, z: np.ndarray) -> np.ndarray:
        theta, rate, _ = z
        turn = momentum / np.sin(theta) ** 2
        return np.array([rate, turn**2 * np.sin(theta) * np.cos(theta) - gravity * np.sin(theta), turn])

    def embed(t: float, z: np.ndarray) -> State:
        theta, rate, phi = z
        turn = momentum / np.sin(theta) ** 2
        s, c, sp, cp = np.sin(theta), np.cos(theta), np.sin(phi), np.cos(phi)
        q = np.array([s * cp, s * sp, c])
        return q, np.array([rate * c * cp - turn * s * sp, rate * c * sp + turn * s * cp, -rate * s])

    start = [polar, 0.0, 0.0]
    y0, reference = embed(0.0, np.array(start)), minimal(field, start, embed)
    drawing = Drawing(lambda t, q: jnp.stack([jnp.zeros(3), q]), {"mass": 1}, links=((0, 1),), down=True, t1=2.5)
    return Scene("spherical-pendulum", system, y0, 10.0, reference, drawing=drawing)
