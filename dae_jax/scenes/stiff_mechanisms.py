"""Two mechanisms on which most solvers fail: the car axis and Andrews' squeezing mechanism."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ConstrainedSystem
from ..types import Args, Time
from .scene import Drawing, Scene, published


def car_axis() -> Scene[ConstrainedSystem]:
    """An axis whose left end stands on a flat road and whose right end on a bumpy one, each on a stiff spring; index 3.

    q = (x_l, y_l, x_r, y_r); the mass is small (κ = m ε²/2, ε = 0.01) and the constraints depend on time.

    Source: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008), problem "Car axis".
    """
    length, rest, height, omega = 1.0, 0.5, 0.1, 10.0
    kappa = 10 * 1e-2**2 / 2

    def road(t: Time):
        y = height * jnp.sin(omega * t)
        return jnp.stack([jnp.sqrt(length**2 - y**2), y])

    def spring(d: Array):
        size = jnp.sqrt(jnp.sum(d**2))
        return (rest - size) / size * d

    def force(t: Time, q: Array, v: Array, args: Args):
        weight = kappa * jnp.array([0.0, 1.0, 0.0, 1.0], q.dtype)
        return jnp.concatenate([spring(q[:2]), spring(q[2:] - road(t))]) - weight

    def constraint(t: Time, q: Array, args: Args):
        return jnp.stack([jnp.sum(q[:2] * road(t)), jnp.sum((q[:2] - q[2:]) ** 2) - length**2])

    system = ConstrainedSystem(force, constraint, mass=np.full(4, kappa))
    start = (np.array([0.0, 0.5, 1.0, 0.5]), np.array([-0.5, 0.0, -0.5, 0.0]))
    q = [0.493455784275402809e-1, 0.496989460230171153861, 0.104174252488542151681e1, 0.373911027265361256927]
    v = [-0.770583684040972357970e-1, 0.744686658723778553466e-2, 0.175568157537232222276e-1, 0.770341043779251976443]
    points = lambda t, q: jnp.stack([jnp.zeros(2), q[:2], q[2:], road(t)])
    ends = {"left end": 1, "right end": 2, "right wheel": 3}
    drawing = Drawing(points, ends, links=((1, 2),), springs=((0, 1), (2, 3)))
    reference = published(3.0, (np.array(q), np.array(v)))
    return Scene("car-axis", system, start, 3.0, reference, index=3, drawing=drawing)


def andrews() -> Scene[ConstrainedSystem]:
    """Andrews' squeezing mechanism: seven plane bodies in three loops, a motor and a spring; index 3, M depends on q.

    q = (β, Θ, γ, Φ, δ, Ω, ε), angles.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, section VII.7; end values from the test
    set named in `car_axis`. These are good to about 9 digits; none are published for v.
    """
    m1, m2, m3, m4, m5, m6, m7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
    i1, i2, i3, i4, i5, i6, i7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
    xa, ya, xb, yb, xc, yc, c0, l0 = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072, 4530.0, 0.07785
    d, da, e, ea, rr, ra, mom = 28e-3, 115e-4, 2e-2, 1421e-5, 7e-3, 92e-5, 33e-3
    ss, sa, sb, sc, sd, ta, tb = 35e-3, 1874e-5, 1043e-5, 18e-3, 2e-2, 2308e-5, 916e-5
    u, ua, ub, zf, zt, fa = 4e-2, 1228e-5, 449e-5, 2e-2, 4e-2, 1421e-5
    sin, cos = jnp.sin, jnp.cos

    def mass(q: Array, args: Args):
        _, theta, _, phi, _, omega, _ = q
        one = jnp.ones_like(theta)
        blocks = {
            (0, 0): m1 * ra**2 + m2 * (rr**2 - 2 * da * rr * cos(theta) + da**2) + i1 + i2,
            (0, 1): m2 * (da**2 - da * rr * cos(theta)) + i2,
            (1, 1): (m2 * da**2 + i2) * one,
            (2, 2): (m3 * (sa**2 + sb**2) + i3) * one,
            (3, 3): (m4 * (e - ea) ** 2 + i4) * one,
            (3, 4): m4 * ((e - ea) ** 2 + zt * (e - ea) * sin(phi)) + i4,
            (4, 4): m4 * (zt**2 + 2 * zt * (e - ea) * sin(phi) + (e - ea) ** 2) + m5 * (ta**2 + tb**2) + i4 + i5,
            (5, 5): (m6 * (zf - fa) ** 2 + i6) * one,
            (5, 6): m6 * ((zf - fa) ** 2 - u * (zf - fa) * sin(omega)) + i6,
            (6, 6): m6 * ((zf - fa) ** 2 - 2 * u * (zf - fa) * sin(omega) + u**2) + m7 * (ua**2 + ub**2) + i6 + i7,
        }
        entry = lambda i, j: blocks.get((min(i, j), max(i, j)), 0 * one)
        return jnp.stack([jnp.stack([entry(i, j) for j in range(7)]) for i in range(7)])

    def force(t: Time, q: Array, v: Array, args: Args):
        _, theta, gamma, phi, _, omega, _ = q
        beta_, theta_, _, phi_, delta_, omega_, epsilon_ = v
        x, y = sd * cos(gamma) + sc * sin(gamma) + xb - xc, sd * sin(gamma) - sc * cos(gamma) + yb - yc
        x_, y_ = sc * cos(gamma) - sd * sin(gamma), sd * cos(gamma) + sc * sin(gamma)
        spring = -c0 * (1 - l0 / jnp.sqrt(x**2 + y**2)) * (x * x_ + y * y_)
        return jnp.stack(
            [
                mom - m2 * da * rr * theta_ * (theta_ + 2 * beta_) * sin(theta),
                m2 * da * rr * beta_**2 * sin(theta),
                spring,
                m4 * zt * (e - ea) * delta_**2 * cos(phi),
                -m4 * zt * (e - ea) * phi_ * (phi_ + 2 * delta_) * cos(phi),
                -m6 * u * (zf - fa) * epsilon_**2 * cos(omega),
                m6 * u * (zf - fa) * omega_ * (omega_ + 2 * epsilon_) * cos(omega),
            ]
        )

    def constraint(t: Time, q: Array, args: Args):
        beta, theta, gamma, phi, delta, omega, epsilon = q
        x, y = rr * cos(beta) - d * cos(beta + theta), rr * sin(beta) - d * sin(beta + theta)
        return jnp.stack(
            [
                x - ss * sin(gamma) - xb,
                y + ss * cos(gamma) - yb,
                x - e * sin(phi + delta) - zt * cos(delta) - xa,
                y + e * cos(phi + delta) - zt * sin(delta) - ya,
                x - zf * cos(omega + epsilon) - u * sin(epsilon) - xa,
                y - zf * sin(omega + epsilon) + u * cos(epsilon) - ya,
            ]
        )

    system = ConstrainedSystem(force, constraint, mass=mass)
    q0 = [-0.0617138900142764496, 0, 0.455279819163070380, 0.222668390165885885]
    q0 += [0.487364979543842550, -0.222668390165885885, 1.23054744454982120]
    end = [15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948]
    end += [0.5244099658805304, 0.5347301163226948, 1.048080741042263]
    reference = published(0.03, (np.array(end), np.full(7, np.nan)))

    def points(t: Time, q: Array):
        beta, theta, gamma, _, delta, _, epsilon = q
        along = lambda angle: jnp.stack([cos(angle), sin(angle)])
        across = lambda angle: jnp.stack([sin(angle), -cos(angle)])
        a, b, c = jnp.array([[xa, ya], [xb, yb], [xc, yc]])
        f = rr * along(beta)
        e = f - d * along(beta + theta)
        spring = b + sc * across(gamma) + sd * along(gamma)
        return jnp.stack([0 * f, f, e, a, b, c, spring, a + zt * along(delta), a + u * across(epsilon)])

    bodies = ((0, 1), (1, 2), (2, 4), (4, 6), (2, 6), (2, 7), (3, 7), (2, 8), (3, 8))
    shown = {"crank": 1, "common joint": 2, "upper joint": 7, "lower joint": 8}
    drawing = Drawing(points, shown, links=bodies, springs=((5, 6),))
    return Scene("andrews", system, (np.array(q0), np.zeros(7)), 0.03, reference, index=3, drawing=drawing)
