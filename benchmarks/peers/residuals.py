"""The pendulums as residuals F(t, y, y') = 0 in plain Python floats, for the solvers that call back into Python.

Index 1: y = (q, v, λ), the constraints differentiated twice. GGL (stabilised index 2): y' also carries (λ, μ), as
derivatives of extra unknowns, so that the constraints and their first derivatives are both equations and the whole is
of index 1. Each function returns (residual, jacobian, start, start slope); jacobian(t, y, dy) is ∂F/∂y, or None.
"""

import numpy as np

from .problems import GRAVITY, chain_start


def pendulum():
    def residual(t, y, dy):
        x, z, u, v, f = y.tolist()
        a, b, c, d, _ = dy.tolist()
        return np.array(
            (a - u, b - v, c + f * x, d + f * z - GRAVITY, f * (x * x + z * z) - u * u - v * v - GRAVITY * z)
        )

    def jacobian(t, y, dy):
        x, z, u, v, f = y.tolist()
        return np.array(
            (
                (0, 0, -1, 0, 0),
                (0, 0, 0, -1, 0),
                (f, 0, 0, 0, x),
                (0, f, 0, 0, z),
                (2 * f * x, 2 * f * z - GRAVITY, -2 * u, -2 * v, x * x + z * z),
            )
        )

    return residual, jacobian, *_start(1, 1)


def double_pendulum():
    def residual(t, y, dy):
        x1, y1, x2, y2, u1, v1, u2, v2, f1, f2 = y.tolist()
        a1, b1, a2, b2, c1, d1, c2, d2, _, _ = dy.tolist()
        dx, dz, wx, wz = x2 - x1, y2 - y1, u2 - u1, v2 - v1
        along = x1 * dx + y1 * dz
        return np.array(
            (
                a1 - u1,
                b1 - v1,
                a2 - u2,
                b2 - v2,
                c1 + f1 * x1 - f2 * dx,
                d1 + f1 * y1 - f2 * dz - GRAVITY,
                c2 + f2 * dx,
                d2 + f2 * dz - GRAVITY,
                f1 * (x1 * x1 + y1 * y1) - f2 * along - u1 * u1 - v1 * v1 - GRAVITY * y1,
                2 * f2 * (dx * dx + dz * dz) - f1 * along - wx * wx - wz * wz,
            )
        )

    def jacobian(t, y, dy):
        x1, y1, x2, y2, u1, v1, u2, v2, f1, f2 = y.tolist()
        dx, dz, wx, wz = x2 - x1, y2 - y1, u2 - u1, v2 - v1
        along, px, pz = x1 * dx + y1 * dz, dx - x1, dz - y1
        return np.array(
            (
                (0, 0, 0, 0, -1, 0, 0, 0, 0, 0),
                (0, 0, 0, 0, 0, -1, 0, 0, 0, 0),
                (0, 0, 0, 0, 0, 0, -1, 0, 0, 0),
                (0, 0, 0, 0, 0, 0, 0, -1, 0, 0),
                (f1 + f2, 0, -f2, 0, 0, 0, 0, 0, x1, -dx),
                (0, f1 + f2, 0, -f2, 0, 0, 0, 0, y1, -dz),
                (-f2, 0, f2, 0, 0, 0, 0, 0, 0, dx),
                (0, -f2, 0, f2, 0, 0, 0, 0, 0, dz),
                (
                    2 * f1 * x1 - f2 * px,
                    2 * f1 * y1 - f2 * pz - GRAVITY,
                    *(-f2 * x1, -f2 * y1, -2 * u1, -2 * v1, 0, 0, x1 * x1 + y1 * y1, -along),
                ),
                (
                    *(-4 * f2 * dx - f1 * px, -4 * f2 * dz - f1 * pz, 4 * f2 * dx - f1 * x1, 4 * f2 * dz - f1 * y1),
                    *(2 * wx, 2 * wz, -2 * wx, -2 * wz, -along, 2 * (dx * dx + dz * dz)),
                ),
            )
        )

    return residual, jacobian, *_start(2, 2)


def pendulum_ggl():
    def residual(t, y, dy):
        x, z, u, v, _, _ = y.tolist()
        a, b, c, d, f, m = dy.tolist()
        tangent, length = x * u + z * v, (x * x + z * z - 1) / 2
        return np.array((a - u + m * x, b - v + m * z, c + f * x, d + f * z - GRAVITY, length, tangent))

    return residual, None, *_start(1, 2)


def double_pendulum_ggl():
    def residual(t, y, dy):
        x1, y1, x2, y2, u1, v1, u2, v2 = y.tolist()[:8]
        a1, b1, a2, b2, c1, d1, c2, d2, f1, f2, m1, m2 = dy.tolist()
        dx, dz, wx, wz = x2 - x1, y2 - y1, u2 - u1, v2 - v1
        return np.array(
            (
                a1 - u1 + m1 * x1 - m2 * dx,
                b1 - v1 + m1 * y1 - m2 * dz,
                a2 - u2 + m2 * dx,
                b2 - v2 + m2 * dz,
                c1 + f1 * x1 - f2 * dx,
                d1 + f1 * y1 - f2 * dz - GRAVITY,
                c2 + f2 * dx,
                d2 + f2 * dz - GRAVITY,
                (x1 * x1 + y1 * y1 - 1) / 2,
                (dx * dx + dz * dz - 1) / 2,
                x1 * u1 + y1 * v1,
                dx * wx + dz * wz,
            )
        )

    return residual, None, *_start(2, 4)


def _start(n, extra):
    """The chain stretched out horizontally at rest, where all multipliers are zero."""
    slope = np.zeros(4 * n + extra)
    slope[2 * n + 1 : 4 * n : 2] = GRAVITY
    return np.concatenate([chain_start(n), np.zeros(extra)]), slope
