"""A railway wheelset on its track: contact geometry and creep forces in long expressions."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE
from ..types import Args, Time
from .scene import Scene, published


MASS, INERTIA, INERTIA_ACROSS, GRAVITY, SPEED = 16.08, 0.0605, 0.366, 9.81, 30.0
SPRING, HALF_BASE, FRICTION = 6400.0, 0.19, 0.12
RADIUS, CONE, HALF_GAUGE, RAIL = 0.1, 0.0262, 0.1506, 0.06
# Hertz's and Kalker's coefficients of the contact ellipse.
SHEAR, POISSON, ELLIPSE, RATIO = 7.92e10, 0.28, 1.3537956, 0.7115218
ALONG, ACROSS, SPIN, PI = 4.72772197, 4.27526987, 1.97203505, 3.1415926


def wheelset() -> Scene[ImplicitDAE]:
    """A wheelset at 30 m/s on a straight track; y = (x, y, z, θ, φ, their rates, β, ψ_r, ξ_r, ψ_l, ξ_l, λ), 17 unknowns, index 2:

        ṗ = v,   M(p) (v̇, β̇) = f(p, v, β, q, λ) + Q(p, q)ᵀ λ,   0 = Q(p, q) v,   0 = g(p, q),

    with the place q = (ψ, ξ) of the contact on each side, where the normals of wheel and rail are parallel, and creep forces by the
    formulas of Kalker and Jaschinski, which depend on the normal forces and so on λ (in 10⁴ N).

    Source: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008), problem "Wheelset", after B. Simeon, C. Führer,
    P. Rentrop, Surv. Math. Ind. 1 (1991), 1–37. The end values are of a run at 1e-9 and good to about 5 digits; those of λ are
    less.
    """

    def residual(t: Time, y: Array, yd: Array, args: Args):
        p, v, beta = y[:5], y[5:10], y[10]
        x, _, z, theta, phi = p
        sin_p, cos_p = jnp.sin(phi), jnp.cos(phi)
        turn = SPEED / RADIUS + beta
        # The left side's contact follows the right one's.
        sides = [_Contact(p, y[13], y[14]), _Contact(p, y[11], y[12])]
        normals = 1e4 * y[15], 1e4 * y[16]
        across, up = (sum(n * s.gradient[i] for n, s in zip(normals, sides, strict=True)) for i in (0, 1))
        left, right = sides
        angles = left.angle(-1), right.angle(1)
        common = -jnp.sin(angles[0] + angles[1])
        loads = (
            (jnp.cos(angles[1]) * across - jnp.sin(angles[1]) * up) / common,
            (-jnp.cos(angles[0]) * across - jnp.sin(angles[0]) * up) / common,
        )
        creeps = [
            s.creep(p, v, turn, load, angle, sign)
            for s, load, angle, sign in zip(sides, loads, angles, (1, -1), strict=True)
        ]
        pushes = [sum(n * s.gradient[i] for n, s in zip(normals, sides, strict=True)) for i in range(5)]
        forces = [sum(c[i] for c in creeps) for i in range(3)]
        moments = [sum(s.moments(p, c)[i] for s, c in zip(sides, creeps, strict=True)) for i in range(3)]
        yaw_spring = -2 * HALF_BASE**2 * SPRING * theta
        theta_, phi_ = v[3], v[4]
        gyro = INERTIA * turn + (INERTIA - INERTIA_ACROSS) * theta_ * sin_p
        dynamics = [
            MASS * yd[5] - (forces[0] + pushes[0] - 2 * SPRING * x),
            MASS * yd[6] - (forces[1] + pushes[1] - MASS * GRAVITY),
            MASS * yd[7] - (forces[2] + pushes[2] - 2 * SPRING * z),
            INERTIA_ACROSS * cos_p * yd[8]
            - (INERTIA_ACROSS * theta_ * phi_ * sin_p - gyro * phi_ + moments[0] + cos_p * yaw_spring + pushes[3]),
            INERTIA_ACROSS * yd[9] - (gyro * theta_ * cos_p + moments[1] + pushes[4]),
            INERTIA * (sin_p * yd[8] + yd[10]) - (moments[2] + sin_p * yaw_spring - INERTIA * theta_ * phi_ * cos_p),
        ]
        rolling = [sum(g * u for g, u in zip(s.gradient, v, strict=True)) for s in sides]
        contacts = [c for s in (left, right) for c in s.parallel(p)]
        return jnp.concatenate([yd[:5] - v, jnp.stack([*dynamics, *rolling, *contacts])])

    start = [0.14941e-2, 0.40089e-6, 0.11241e-5, -0.28573e-3, 0.26459e-3] + 6 * [0.0]
    start += [-7.4122380357667139e-6, -0.1521364296121248, 7.5634406395172940e-6, 0.1490635714733819]
    start += [-0.83593e-2, -0.74144e-2]
    end = [0.86355386965811e-2, 0.13038281022727e-4, -0.93635784016818e-4, -0.13642299804033e-1, 0.15292895005422e-2]
    end += [-0.76985374142666e-1, -0.25151106429207e-3, 0.20541188079539e-2, -0.23904837703692, -0.13633468454173e-1]
    end += [-0.24421377661131, -0.33666751972196e-3, -0.15949425684022, 0.37839614386969e-3, 0.14173214964613]
    end += [-0.10124044903201e-1, -0.56285630573753e-2]
    reference = published(10.0, np.array(end))
    return Scene("wheelset", ImplicitDAE(residual), np.array(start), 10.0, reference, index=2, scale=1e-2, stiff=True)


class _Contact:
    """One wheel on its rail: `gradient` is the row of Q."""

    def __init__(self, p: Array, psi: Array, xi: Array):
        x, _, _, theta, phi = p
        self.xi = xi
        self.sin, self.cos = jnp.sin(psi), jnp.cos(psi)
        sin_t, cos_t, sin_p, cos_p = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
        side = jnp.sign(xi)
        # The wheel is a cone of radius r at ξ, the rail a circle.
        self.r, self.slope = RADIUS + np.tan(CONE) * (HALF_GAUGE - jnp.abs(xi)), -np.tan(CONE) * side
        on_rail = x + xi * cos_t * cos_p + self.r * (cos_t * sin_p * self.cos - sin_t * self.sin)
        off = jnp.abs(on_rail) - HALF_GAUGE - np.sin(CONE) * RAIL
        height = jnp.sqrt(RAIL**2 - off**2)
        self.rail_slope, self.rail_bend = -jnp.sign(on_rail) * off / height, -(RAIL**2) / height**3
        dg, r = self.rail_slope, self.r
        self.gradient = (
            dg,
            -jnp.ones_like(dg),
            jnp.zeros_like(dg),
            dg * (r * (-cos_t * self.sin - self.cos * sin_p * sin_t) - cos_p * sin_t * xi),
            -self.cos * r * sin_p - cos_p * xi + dg * (cos_p * self.cos * cos_t * r - cos_t * sin_p * xi),
        )
        self.normal = (self.slope * cos_p - sin_p * self.cos) * cos_t + self.sin * sin_t
        self.upward = self.slope * sin_p + self.cos * cos_p

    def angle(self, sign: float):
        """Of the plane of contact."""
        return jnp.arctan(sign * self.normal / self.upward)

    def parallel(self, p: Array):
        """0 where the normals of wheel and rail are parallel."""
        _, _, _, theta, phi = p
        sin_t, cos_t, sin_p, cos_p = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
        along = self.slope * sin_t * cos_p - sin_t * sin_p * self.cos - cos_t * self.sin
        return self.rail_slope * self.upward + self.normal, along

    def creep(self, p: Array, v: Array, turn: Array, load: Array, angle: Array, sign: float):
        """The force on the wheel at its contact."""
        xi, r = self.xi, self.r
        sin_p, cos_p = jnp.sin(p[4]), jnp.cos(p[4])
        sin_d, cos_d = jnp.sin(angle), jnp.cos(angle)
        sin_t, cos_t = jnp.sin(p[3] / cos_d), jnp.cos(p[3] / cos_d)
        curvature = -self.rail_bend / (1 + self.rail_slope**2) ** 1.5
        both = 0.5 / (r * jnp.sqrt(1 + self.slope**2)) + 0.5 * curvature
        size = jnp.cbrt(3 * jnp.abs(load) * (1 - POISSON) * ELLIPSE / (2 * PI * both * SHEAR * np.sqrt(RATIO)))
        arm, lift = xi * sin_p - r * cos_p * self.cos, sin_t * sin_p * self.cos + cos_t * self.sin
        depth = cos_t * sin_p * self.cos - sin_t * self.sin
        slip = (
            v[0]
            - turn * r * (sin_t * self.cos + cos_t * sin_p * self.sin)
            - v[3] * (r * lift + xi * sin_t * cos_p)
            - v[4] * cos_t * arm,
            v[1] + turn * r * cos_p * self.sin + v[4] * (xi * cos_p + r * sin_p * self.cos),
            v[2]
            + SPEED
            - turn * r * (cos_t * self.cos - sin_t * sin_p * self.sin)
            - v[3] * (xi * cos_t * cos_p + r * depth)
            + v[4] * sin_t * arm,
        )
        rolling = [s - 2 * u for s, u in zip(slip, (v[0], v[1], v[2] + SPEED), strict=True)]
        speed = 0.5 * jnp.sqrt(sum(u**2 for u in rolling))
        along = (sin_t * slip[0] + cos_t * slip[2]) / speed
        across = (cos_t * cos_d * slip[0] + sign * sin_d * slip[1] - sin_t * cos_d * slip[2]) / speed
        spin = (-sign * sin_d * turn + cos_d * v[3]) / speed
        most, stiffness = FRICTION * load, SHEAR * size**2
        first = -most * jnp.tanh(stiffness * ALONG * along / most)
        second = -most * jnp.tanh(stiffness * (ACROSS * across + SPIN * size * spin) / most)
        total = first**2 + second**2
        part = jnp.where(total > most**2, jnp.abs(most) / jnp.sqrt(jnp.where(total > 0, total, 1)), 1)
        first, second = first * part, second * part
        return (
            sin_t * first + cos_t * cos_d * second,
            sign * sin_d * second,
            cos_t * first - sin_t * cos_d * second,
        )

    def moments(self, p: Array, force: tuple[Array, Array, Array]):
        """What a force at the contact does to yaw, roll and spin."""
        sin_t, cos_t, sin_p, cos_p = jnp.sin(p[3]), jnp.cos(p[3]), jnp.sin(p[4]), jnp.cos(p[4])
        xi, down, ahead = self.xi, self.r * self.cos, self.r * self.sin
        a, b, c = force
        yaw = -(xi * sin_t + ahead * cos_t * cos_p) * a - ahead * sin_p * b + (ahead * sin_t * cos_p - xi * cos_t) * c
        roll = -(xi * sin_p - down * cos_p) * cos_t * a + (xi * cos_p + down * sin_p) * b
        roll = roll + (xi * sin_p - down * cos_p) * sin_t * c
        spin = (
            -(down * sin_t + ahead * cos_t * sin_p) * a + ahead * cos_p * b - (down * cos_t - ahead * sin_t * sin_p) * c
        )
        return yaw, roll, spin
