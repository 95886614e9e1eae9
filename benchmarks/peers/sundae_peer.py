"""SUNDIALS IDA through scikit-sundae: index-1 DAE (q, v, λ), residual and Jacobian as Python callbacks, BDF.

For the chain, unknowns ordered link by link so that the banded solver serves, with its finite-difference Jacobian.
"""

import numpy as np

from . import apart, large_problems, missing, problems, residuals, stiff_problems


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


large_methods = ("BDF",)
# Fewer unknowns are faster dense.
DENSE = 50


def large(problem, rtol, method):
    """The residual by numpy, the exact Jacobian by CasADi, factored by SuperLU."""
    from sksundae.ida import IDA

    k, size = problem.x0.size, problem.unknowns

    def residual(t, y, dy, out):
        out[:k] = dy[:k] - problem.ode(t, y[:k], y[k:], problem.p, large_problems.Numpy)
        out[k:] = -problem.algebraic(t, y[:k], y[k:], problem.p, large_problems.Numpy)

    atol = np.full(size, problem.scene.scale * rtol)
    if problem.name == "stokes":
        atol[k:] = 1e10  # of index 2: no error test
    jacobian, sparsity = _large_jacobian(problem)
    integrator = IDA(
        residual, rtol=rtol, atol=atol, algebraic_idx=np.arange(k, size), max_num_steps=1_000_000, jacfn=jacobian,
        linsolver="dense" if size < DENSE else "sparse", sparsity=sparsity,
    )  # fmt: skip
    start, slope = np.concatenate([problem.x0, problem.z0]), np.concatenate([problem.dx0, np.zeros(size - k)])
    times = np.append(problem.t0, problem.times)

    def solve():
        solution = integrator.solve(times, start, slope)
        if not solution.success:
            raise RuntimeError(f"IDA: {solution.message}")
        return problem.in_order(solution.y[1:, :k], solution.y[1:, k:])

    return solve(), None, solve


def _large_jacobian(problem):
    """∂F/∂y + c ∂F/∂ẏ of F = (ẋ − f, −g): its nonzeros column by column, or all of it, and where they are."""
    import casadi
    from scipy import sparse

    k, size = problem.x0.size, problem.unknowns
    y, c = casadi.MX.sym("y", size), casadi.MX.sym("c")
    right = (f(problem.t0, y[:k], y[k:], problem.p, large_problems.CasADi) for f in (problem.ode, problem.algebraic))
    differential = casadi.DM(sparse.diags_array(np.repeat([1.0, 0.0], [k, size - k]), format="csc"))
    jacobian = casadi.Function("jacobian", [y, c], [c * differential - casadi.jacobian(casadi.vertcat(*right), y)])
    columns, rows = (np.array(x, np.int32) for x in jacobian.sparsity_out(0).get_ccs())
    pattern = sparse.csc_array((np.ones(rows.size), rows, columns), (size, size))
    buffer, evaluate = jacobian.buffer()
    state, scale, values = np.empty(size), np.empty(1), np.empty(rows.size)
    for i, argument in enumerate((state, scale)):
        buffer.set_arg(i, memoryview(argument))
    buffer.set_res(0, memoryview(values))
    column = np.repeat(np.arange(size), np.diff(columns))

    def fill(t, y, dy, out, cj, matrix):
        state[:], scale[0] = y, cj
        evaluate()
        matrix[(rows, column) if size < DENSE else ...] = values

    fill.buffer = buffer  # which `evaluate` alone does not keep
    return fill, pattern
