"""Stiff problems of index 1 to 3 for the peers: residuals of scalars, written once for Python floats and for CasADi.

`residual(t, y, dy, m)` gives F(t, y, y') as a list; `m` has sin, exp and sqrt. The car axis is in the GGL form, as IDA
and solve_dae need it. `semi_explicit(t, x, z, m)` → (ode, alg) where the natural form is one, for CasADi. The equations,
starts and published end values are those of `dae_jax.scenes`.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dae_jax.scenes import SCENES


@dataclass(frozen=True)
class Problem:
    """`y0`, `dy0`: a consistent start; `algebraic`: the unknowns without derivative; `size`: how many unknowns the
    published end values have; `atol` of `rtol`.
    """

    residual: Any
    y0: np.ndarray
    dy0: np.ndarray
    algebraic: tuple[int, ...]
    size: int
    scale: float
    t1: float
    semi_explicit: Any = None
    name: str = ""

    def scene(self):
        return SCENES[self.name]()


def robertson():
    def semi_explicit(t, x, z, m, rates=(0.04, 1e4, 3e7)):
        k1, k2, k3 = rates
        forth, back, twice = k1 * x[0], k2 * x[1] * z[0], k3 * x[1] * x[1]
        return [back - forth, forth - back - twice], [x[0] + x[1] + z[0] - 1]

    def residual(t, y, dy, m):
        ode, alg = semi_explicit(t, y[:2], y[2:], m)
        return [dy[0] - ode[0], dy[1] - ode[1], *alg]

    slope = np.array([-0.04, 0.04, 0.0])
    return Problem(residual, np.array([1.0, 0, 0]), slope, (2,), 3, 1e-6, 1e11, semi_explicit, name="robertson")


def akzo_nobel():
    k1, k2, k3, k4, equilibrium, inflow, dissolution, pressure, henry = (
        18.7,
        0.58,
        0.09,
        0.42,
        34.4,
        3.3,
        115.83,
        0.9,
        737.0,
    )

    def semi_explicit(t, x, z, m):
        a, oxygen, b, c, d = (x[i] for i in range(5))
        e = z[0]
        root = m.sqrt(oxygen)
        r1, r2, r3 = k1 * a * a * a * a * root, k2 * b * c, k2 / equilibrium * a * d
        r4, r5 = k3 * a * c * c, k4 * e * e * root
        ode = [
            -2 * r1 + r2 - r3 - r4,
            -r1 / 2 - r4 - r5 / 2 + inflow * (pressure / henry - oxygen),
            r1 - r2 + r3,
            -r2 + r3 - 2 * r4,
            r2 - r3 + r5,
        ]
        return ode, [dissolution * a * c - e]

    def residual(t, y, dy, m):
        ode, alg = semi_explicit(t, y[:5], y[5:], m)
        return [*(dy[i] - ode[i] for i in range(5)), *alg]

    y0 = np.asarray(SCENES["akzo-nobel"]().y0)
    slope = np.append(semi_explicit(0.0, y0[:5], y0[5:], math)[0], 0.0)
    return Problem(residual, y0, slope, (5,), 6, 1e-3, 180.0, semi_explicit, name="akzo-nobel")


def amplifier():
    supply, thermal, alpha, beta, r0, r = 6.0, 0.026, 0.99, 1e-6, 1000.0, 9000.0
    c1, c2, c3, c4, c5 = (1e-6 * k for k in range(1, 6))

    def residual(t, y, dy, m):
        u = 0.1 * m.sin(200 * math.pi * t)
        first, second = (beta * (m.exp((y[b] - y[e]) / thermal) - 1) for b, e in ((1, 2), (4, 5)))
        return [
            c1 * (dy[1] - dy[0]) - (y[0] - u) / r0,
            c1 * (dy[0] - dy[1]) + (supply - 2 * y[1]) / r + (alpha - 1) * first,
            -c2 * dy[2] - y[2] / r + first,
            c3 * (dy[4] - dy[3]) + (supply - y[3]) / r - alpha * first,
            c3 * (dy[3] - dy[4]) + (supply - 2 * y[4]) / r + (alpha - 1) * second,
            -c4 * dy[5] - y[5] / r + second,
            c5 * (dy[7] - dy[6]) + (supply - y[6]) / r - alpha * second,
            c5 * (dy[6] - dy[7]) - y[7] / r,
        ]

    y0 = np.asarray(SCENES["amplifier"]().y0)
    # As the test set gives them.
    u1, u3, u5, u6, u8 = 51.338775, -supply / (2 * c2 * r), -24.9757667, -supply / (2 * c4 * r), -10.00564453
    slope = np.array([u1, u1, u3, u5, u5, u6, u8, u8])
    return Problem(residual, y0, slope, (), 8, 1.0, 0.2, name="amplifier")


def car_axis():
    length, rest, height, omega, kappa = 1.0, 0.5, 0.1, 10.0, 10 * 1e-2**2 / 2

    def residual(t, y, dy, m):
        xl, yl, xr, yr, ul, vl, ur, vr, f1, f2, n1, n2 = (y[i] for i in range(12))
        yb = height * m.sin(omega * t)
        xb = m.sqrt(length**2 - yb * yb)
        dyb = height * omega * m.cos(omega * t)
        dxb = -yb * dyb / xb
        left, right = m.sqrt(xl * xl + yl * yl), m.sqrt((xr - xb) * (xr - xb) + (yr - yb) * (yr - yb))
        pull, push = (rest - left) / left, (rest - right) / right
        ex, ey = xl - xr, yl - yr
        return [
            dy[0] - ul + xb * n1 + 2 * ex * n2,
            dy[1] - vl + yb * n1 + 2 * ey * n2,
            dy[2] - ur - 2 * ex * n2,
            dy[3] - vr - 2 * ey * n2,
            kappa * dy[4] - pull * xl + f1 * xb + 2 * f2 * ex,
            kappa * dy[5] - pull * yl + f1 * yb + 2 * f2 * ey + kappa,
            kappa * dy[6] - push * (xr - xb) - 2 * f2 * ex,
            kappa * dy[7] - push * (yr - yb) - 2 * f2 * ey + kappa,
            xl * xb + yl * yb,
            ex * ex + ey * ey - length**2,
            ul * xb + vl * yb + xl * dxb + yl * dyb,
            ex * (ul - ur) + ey * (vl - vr),
        ]

    q, v = SCENES["car-axis"]().y0
    y0 = np.concatenate([q, v, np.zeros(4)])
    slope = np.concatenate([v, residual(0.0, y0, np.zeros(12), math)[4:8], np.zeros(4)])
    slope[4:8] /= -kappa
    return Problem(residual, y0, slope, (8, 9, 10, 11), 8, 1.0, 3.0, name="car-axis")


PROBLEMS = {"robertson": robertson, "akzo-nobel": akzo_nobel, "amplifier": amplifier, "car-axis": car_axis}


def jacobians(problem):
    """(t, y, y') → (∂F/∂y, ∂F/∂y'), exact: without them solve_dae fails on two of the problems."""
    import casadi

    n = len(problem.y0)
    t, y, dy = casadi.SX.sym("t"), casadi.SX.sym("y", n), casadi.SX.sym("dy", n)
    f = casadi.vertcat(*problem.residual(t, casadi.vertsplit(y), casadi.vertsplit(dy), casadi))
    both = casadi.Function("jacobians", [t, y, dy], [casadi.densify(casadi.jacobian(f, x)) for x in (y, dy)])
    return lambda t, y, dy: tuple(np.asarray(x) for x in both(t, y, dy))


def error(name, end):
    """The largest error of an end state, relative where the published value is larger than the scene's scale."""
    exact = np.concatenate([np.ravel(x) for x in _leaves(SCENES[name]())])
    return float(np.max(np.abs(end - exact) / np.maximum(np.abs(exact), PROBLEMS[name]().scale)))


def _leaves(scene):
    found = scene.reference(np.array([scene.t1]))
    return found if isinstance(found, tuple) else (found,)
