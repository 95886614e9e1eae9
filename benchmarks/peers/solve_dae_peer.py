"""solve_dae (the successor of scipy_dae), residual in Python: Radau IIA of 7 or 3 stages, and BDF.

Radau on the index-1 DAE with its analytic Jacobian; BDF on the stabilised index-2 form (GGL), where it loses fewer
digits. 7 stages are the fastest of 3, 5, 7, 9 at errors of 1e-5 and below.
"""

import numpy as np

from . import missing, residuals, stiff_problems


name = "solve_dae"
methods = ("Radau, 7 stages", "Radau, 3 stages", "BDF")
OPTIONS = {
    "Radau, 7 stages": {"method": "Radau", "stages": 7},
    "Radau, 3 stages": {"method": "Radau", "stages": 3},
    "BDF": {"method": "BDF"},
}


def available():
    return missing("solve_dae.integrate")


def double_pendulum(rtol, t1=10.0, method=methods[0]):
    problem = residuals.double_pendulum_ggl() if method == "BDF" else residuals.double_pendulum()
    return _prepare(*problem, 8, rtol, t1, method)


def pendulum(rtol, t1=10.0, method=methods[0]):
    problem = residuals.pendulum_ggl() if method == "BDF" else residuals.pendulum()
    return _prepare(*problem, 4, rtol, t1, method)


def _prepare(residual, jacobian, start, slope, size, rtol, t1, method):
    from solve_dae.integrate import solve_dae

    options = {"rtol": rtol, "atol": rtol, **OPTIONS[method]}
    if jacobian is not None:
        mass = np.diag(np.where(np.arange(len(start)) < size, 1.0, 0.0))
        options["jac"] = lambda t, y, dy: (jacobian(t, y, dy), mass)

    def solve():
        with np.errstate(over="ignore"):  # its difference quotients, for the unknowns that do not occur in the GGL form
            solution = solve_dae(residual, (0.0, t1), start, slope, **options)
        if not solution.success:
            raise RuntimeError(f"solve_dae: {solution.message}")
        return solution.y[:size, -1]

    return solve(), solve


stiff_methods = ("Radau, 3 stages", "BDF")


def stiff(problem, rtol, method):
    import math

    from solve_dae.integrate import solve_dae

    residual = lambda t, y, dy: np.array(problem.residual(t, y.tolist(), dy.tolist(), math))
    options = {"rtol": rtol, "atol": problem.scale * rtol, "jac": stiff_problems.jacobians(problem), **OPTIONS[method]}

    def solve():
        with np.errstate(over="ignore", invalid="ignore"):
            solution = solve_dae(residual, (0.0, problem.t1), problem.y0, problem.dy0, **options)
        if not solution.success:
            raise RuntimeError(f"solve_dae: {solution.message}")
        return solution.y[: problem.size, -1]

    return solve(), solve
