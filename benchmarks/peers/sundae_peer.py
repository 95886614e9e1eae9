"""SUNDIALS IDA through scikit-sundae: index-1 DAE (q, v, λ), residual and Jacobian as Python callbacks, BDF.

For the chain, unknowns ordered link by link so that the banded solver serves, with its finite-difference Jacobian.
"""

import numpy as np

from . import apart, missing, problems, residuals, stiff_problems


name = "IDA (scikit-sundae)"
methods = ("index 1",)


def available():
    return missing("sksundae")


def double_pendulum(rtol, t1=10.0, method="index 1"):
    return _small(*residuals.double_pendulum(), 8, rtol, t1)


def pendulum(rtol, t1=10.0, method="index 1"):
    return _small(*residuals.pendulum(), 4, rtol, t1)


def chain(n, rtol, t1=1.0, method="index 1"):
    gravity = np.array([0.0, problems.GRAVITY])
    first = np.arange(n) == 0

    def residual(t, y, dy, out):
        rows, rates, result = y.reshape(n, 5), dy.reshape(n, 5), out.reshape(n, 5)
        r, v, f = rows[:, :2], rows[:, 2:4], rows[:, 4]
        d, w = np.diff(r, axis=0, prepend=0.0), np.diff(v, axis=0, prepend=0.0)
        pull = f[:, None] * d
        coupling = (d[1:] * d[:-1]).sum(1)
        result[:, :2] = rates[:, :2] - v
        result[:, 2:4] = rates[:, 2:4] - gravity + pull
        result[:-1, 2:4] -= pull[1:]
        result[:, 4] = f * (2 - first) * (d * d).sum(1) - (w * w).sum(1) - first * (d @ gravity)
        result[1:, 4] -= coupling * f[:-1]
        result[:-1, 4] -= coupling * f[1:]

    start, slope = np.zeros((n, 5)), np.zeros((n, 5))
    start[:, :4] = problems.chain_start(n).reshape(2, n, 2).swapaxes(0, 1).reshape(n, 4)
    slope[:, 3] = problems.GRAVITY
    # the multiplier equation of link i reaches back to the position of link i - 2, its velocity equation to the next λ
    band = {"linsolver": "band", "lband": 14, "uband": 7} if n > 3 else {}
    end, solve = _prepare(residual, start.ravel(), slope.ravel(), np.arange(4, 5 * n, 5), rtol, t1, **band)
    return end.reshape(n, 5)[:, :4].reshape(n, 2, 2).swapaxes(0, 1).ravel(), solve


def _small(residual, jacobian, start, slope, size, rtol, t1):
    def fill_residual(t, y, dy, out):
        out[:] = residual(t, y, dy)

    differential = np.arange(size)

    def fill_jacobian(t, y, dy, out, cj, matrix):
        matrix[:] = jacobian(t, y, dy)
        matrix[differential, differential] += cj

    algebraic = np.arange(size, len(start))
    end, solve = _prepare(fill_residual, start, slope, algebraic, rtol, t1, jacfn=fill_jacobian)
    return end[:size], solve


def _prepare(residual, start, slope, algebraic, rtol, t1, **options):
    from sksundae.ida import IDA

    integrator = IDA(residual, rtol=rtol, atol=rtol, algebraic_idx=algebraic, max_num_steps=1_000_000, **options)

    def solve():
        solution = integrator.solve([0.0, t1], start, slope)
        if not solution.success:
            raise RuntimeError(f"IDA: {solution.message}")
        return solution.y[-1]

    return solve(), solve


stiff_methods = ("BDF",)


def stiff(problem, rtol, method):
    """In a process of its own, since the car axis does not end."""
    return apart.stiff("sundae_peer", problem, rtol, method)


def stiff_here(problem, rtol, method):
    import math

    from sksundae.ida import IDA

    def residual(t, y, dy, out):
        out[:] = problem.residual(t, y.tolist(), dy.tolist(), math)

    jacobians = stiff_problems.jacobians(problem)

    def jacobian(t, y, dy, out, cj, matrix):
        by_y, by_slope = jacobians(t, y, dy)
        matrix[:] = by_y + cj * by_slope

    options = {"algebraic_idx": list(problem.algebraic)} if problem.algebraic else {}
    integrator = IDA(residual, rtol=rtol, atol=problem.scale * rtol, max_num_steps=20_000, jacfn=jacobian, **options)

    def solve():
        solution = integrator.solve([0.0, problem.t1], problem.y0, problem.dy0)
        if not solution.success:
            raise RuntimeError(f"IDA: {solution.message}")
        return solution.y[-1][: problem.size]

    return solve(), solve
