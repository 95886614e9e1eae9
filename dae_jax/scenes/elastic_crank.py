"""A slider-crank with an elastic rod, stiff and undamped."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE
from ..types import Args, Time
from .scene import Scene, published


def elastic_crank() -> Scene[ImplicitDAE]:
    """A crank that turns at 150 rad/s, an elastic connecting rod, a sliding block; y = (p, v, w, λ) in 24 unknowns, index 2:

        ṗ = v,   v̇ = w,   M(p) w = f(p, v) − K q − G(p)ᵀ λ,   0 = G(p) v − (0, 0, Ω),

    p = (φ₁, φ₂, x₃, q): angles of crank and rod, place of the block, and the rod's shape by two lateral modes and two
    longitudinal nodes. Frequencies of the rod reach 10⁵ rad/s.

    Source: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008), problem "Slider crank", after B. Simeon,
    Math. Modelling of Systems 2 (1996), 1–18.
    """
    m2, m3, l1, l2, j1, j2 = 0.151104, 0.075552, 0.15, 0.3, 0.002727, 0.0045339259
    young, width, density, omega, pi = 2e11, 0.008, 7870.0, 150.0, 3.1415927
    volume, stiffness = width**2 * l2, young * width**2 / l2
    mass = density * volume * np.array([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 8, 1], [0, 0, 1, 2]])
    bend = pi**4 * (width / l2) ** 2
    k = stiffness * np.array(
        [[bend / 24, 0, 0, 0], [0, bend * 2 / 3, 0, 0], [0, 0, 16 / 3, -8 / 3], [0, 0, -8 / 3, 7 / 3]]
    )
    upper = np.array([[-16 / pi**3, 8 / pi**3 - 1 / pi], [0, 0.5 / pi]])
    b = volume * np.block([[np.zeros((2, 2)), upper], [-upper.T, np.zeros((2, 2))]])
    c1, c2 = volume * np.array([0, 0, 2 / 3, 1 / 6]), volume * np.array([2 / pi, 0, 0, 0])
    c12, c21 = volume * l2 * np.array([0, 0, 1 / 3, 1 / 6]), volume * l2 * np.array([1 / pi, -0.5 / pi, 0, 0])

    def residual(t: Time, y: Array, yd: Array, args: Args):
        p, v, w, multipliers = y[:7], y[7:14], y[14:21], y[21:]
        q, qd = p[3:], v[3:]
        sin1, cos1, sin2, cos2 = jnp.sin(p[0]), jnp.cos(p[0]), jnp.sin(p[1]), jnp.cos(p[1])
        sin, cos = jnp.sin(p[0] - p[1]), jnp.cos(p[0] - p[1])
        inertia, turning = jnp.dot(mass, q), jnp.dot(b, qd)
        coupling = l1 * l2 * m2 / 2 * cos + density * l1 * (sin * (c2 @ q) + cos * (c1 @ q))
        on_crank = density * l1 * (cos * c2 - sin * c1)
        on_rod = density * (c21 + q @ b)
        rod = j2 + q @ inertia + 2 * density * (c12 @ q)
        along = c1 @ q, c2 @ q, c1 @ qd, c2 @ qd
        momentum = jnp.concatenate(
            [
                jnp.stack(
                    [
                        (j1 + m2 * l1**2) * w[0] + coupling * w[1] + on_crank @ w[3:],
                        coupling * w[0] + rod * w[1] + on_rod @ w[3:],
                        m3 * w[2],
                    ]
                ),
                on_crank * w[0] + on_rod * w[1] + mass @ w[3:],
            ]
        )
        force = jnp.concatenate(
            [
                jnp.stack(
                    [
                        -l1 * l2 * m2 / 2 * v[1] ** 2 * sin
                        + density * l1 * v[1] ** 2 * (cos * along[1] - sin * along[0])
                        - 2 * density * l1 * v[1] * (cos * along[2] + sin * along[3]),
                        l1 * l2 * m2 / 2 * v[0] ** 2 * sin
                        + density * l1 * v[0] ** 2 * (sin * along[0] - cos * along[1])
                        - 2 * v[1] * (density * (c12 @ qd) + qd @ inertia)
                        - density * (qd @ turning),
                        0 * sin,
                    ]
                ),
                v[1] ** 2 * (inertia + density * c12)
                + density * (l1 * v[0] ** 2 * (cos * c1 + sin * c2) + 2 * v[1] * turning)
                - k @ q,
            ]
        )
        reach, zero = l2 + q[3], jnp.zeros_like(sin)
        jacobian = jnp.stack(
            [
                jnp.stack([l1 * cos1, reach * cos2, zero, zero, zero, zero, sin2]),
                jnp.stack([l1 * sin1, reach * sin2, zero + 1, zero, zero, zero, -cos2]),
                jnp.asarray([1.0, 0, 0, 0, 0, 0, 0], y.dtype),
            ]
        )
        velocity = jacobian @ v - jnp.asarray([0, 0, omega], y.dtype)
        return jnp.concatenate([yd[:7] - v, yd[7:14] - w, momentum - force + multipliers @ jacobian, velocity])

    start = [0, 0, 0.450016933, 0, 0, 0.103339863e-4, 0.169327969e-4]
    start += [150, -74.9957670, -0.268938672e-5, 0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5]
    start += [0, -1.344541576008661e-3, -5062.194923138079, -6.833142732779555e-5, 1.449382650173157e-8]
    start += [-4.268463211410861, 2.098334687947376e-1]
    start += [-6.397251492537153e-8, 382.4589508329281, -4.376060460948886e-9]
    end = [15, -0.3311734987910881, 0.1697373326718410, 1.893192460247178e-4, 2.375751865617931e-5]
    end += [-5.323907988763734e-6, -8.363283141616840e-6, 150, 60.25346682645789, -8.753116989887888]
    end += [-3.005536801092212e-2, -5.500488291932075e-3, 4.978243404809343e-4, 1.104933470696396e-3, 0]
    end += [6488.722210234531, 2167.924253080623, 33.91435115267547, 0.1699107480197843, -1.415799354959001]
    end += [0.9903251655235532, -62.32893262533717, -163.7910131687472, 25.29853213732781]
    reference = published(0.1, np.array(end))
    return Scene("elastic-crank", ImplicitDAE(residual), np.array(start), 0.1, reference, index=2, stiff=True)
