"""CasADi with SUNDIALS: CVODES on the ODE with λ eliminated symbolically, IDAS on the index-1 DAE with λ as unknown.

SX expressions. CVODES as for a non-stiff problem: Adams, functional iteration; Newton, a higher order
and compiled expressions change little. IDAS: BDF, Newton with exact Jacobians, CasADi's default.
"""

import numpy as np

from . import large_problems, missing, problems


name = "CasADi"
methods = ("CVODES", "IDAS")
OPTIONS = {
    "CVODES": {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"},
    "IDAS": {},
}


def available():
    return missing("casadi")


def double_pendulum(rtol, t1=10.0, method="CVODES"):
    return chain(2, rtol, t1, method)


def pendulum(rtol, t1=10.0, method="CVODES"):
    return chain(1, rtol, t1, method)


def chain(n, rtol, t1=1.0, method="CVODES"):
    import casadi

    options = {"reltol": rtol, "abstol": rtol, "max_num_steps": 1_000_000, **OPTIONS[method]}
    integrator = casadi.integrator("chain", method.lower(), _equations(n, method == "IDAS"), 0.0, t1, options)
    start = casadi.DM(problems.chain_start(n))
    multipliers = casadi.DM.zeros(n if method == "IDAS" else 0)  # at rest on a horizontal line, all are zero

    def solve():
        return integrator(x0=start, z0=multipliers)["xf"]

    return np.asarray(solve()).ravel(), solve


def _equations(n, keep_multipliers):
    """The chain: `alg` is the tridiagonal system for the multipliers, or it is eliminated from the far end."""
    import casadi

    state = casadi.SX.sym("state", 4 * n)
    r, v = casadi.reshape(state[: 2 * n], 2, n), casadi.reshape(state[2 * n :], 2, n)
    gravity = casadi.DM([0.0, problems.GRAVITY])
    d = casadi.horzcat(r[:, 0], casadi.diff(r, 1, 1))
    w = casadi.horzcat(v[:, 0], casadi.diff(v, 1, 1))
    diagonal = [(1 if i == 0 else 2) * casadi.sumsqr(d[:, i]) for i in range(n)]
    right = [casadi.sumsqr(w[:, i]) + (casadi.dot(gravity, r[:, 0]) if i == 0 else 0) for i in range(n)]
    coupling = [casadi.dot(d[:, i], d[:, i + 1]) for i in range(n - 1)]
    equations = {"x": state}
    if keep_multipliers:
        tension = casadi.SX.sym("tension", n)
        equations["z"] = tension
        equations["alg"] = casadi.vertcat(
            *(
                diagonal[i] * tension[i]
                - (coupling[i - 1] * tension[i - 1] if i > 0 else 0)
                - (coupling[i] * tension[i + 1] if i < n - 1 else 0)
                - right[i]
                for i in range(n)
            )
        )
    else:
        for i in range(n - 2, -1, -1):
            diagonal[i] -= coupling[i] ** 2 / diagonal[i + 1]
            right[i] += coupling[i] / diagonal[i + 1] * right[i + 1]
        tension = [right[0] / diagonal[0]]
        for i in range(1, n):
            tension.append((right[i] + coupling[i - 1] * tension[i - 1]) / diagonal[i])
    pull = [tension[i] * d[:, i] for i in range(n)] + [0]
    equations["ode"] = casadi.vertcat(casadi.vec(v), *(gravity - pull[i] + pull[i + 1] for i in range(n)))
    return equations


stiff_methods = ("IDAS",)


def stiff(problem, rtol, method):
    import casadi

    if problem.semi_explicit is None:
        raise ValueError("not in semi-explicit form of index 1, which CasADi takes")
    split = len(problem.y0) - len(problem.algebraic)
    x, z, t = casadi.SX.sym("x", split), casadi.SX.sym("z", len(problem.algebraic)), casadi.SX.sym("t")
    ode, alg = problem.semi_explicit(t, x, z, casadi)
    equations = {"x": x, "z": z, "t": t, "ode": casadi.vertcat(*ode), "alg": casadi.vertcat(*alg)}
    options = _stiff_options(problem, rtol, split)
    integrator = casadi.integrator("stiff", "idas", equations, 0.0, problem.t1, options)
    start = {"x0": casadi.DM(problem.y0[:split]), "z0": casadi.DM(problem.y0[split:])}

    def solve():
        found = integrator(**start)
        return found["xf"], found["zf"]

    return np.concatenate([np.asarray(part).ravel() for part in solve()]), solve


def _stiff_options(problem, rtol, split):
    """With the derivatives of the start, without which IDAS does not get off it."""
    start = {"calc_ic": False, "init_xdot": problem.dy0[:split].tolist()}
    return {"reltol": rtol, "abstol": problem.scale * rtol, "max_num_steps": 1_000_000, **start}


def robertson_variations(rates, rtol):
    """One integrator, called for each row of rates: (end values of y₃, solve)."""
    import casadi

    from . import stiff_problems

    problem = stiff_problems.robertson()
    x, z, p = casadi.SX.sym("x", 2), casadi.SX.sym("z", 1), casadi.SX.sym("p", 3)
    ode, alg = problem.semi_explicit(0.0, x, z, casadi, [p[i] for i in range(3)])
    equations = {"x": x, "z": z, "p": p, "ode": casadi.vertcat(*ode), "alg": casadi.vertcat(*alg)}
    options = _stiff_options(problem, rtol, 2)
    integrator = casadi.integrator("robertson", "idas", equations, 0.0, problem.t1, options)
    start = {"x0": casadi.DM([1, 0]), "z0": casadi.DM([0])}

    def solve():
        return np.array([float(integrator(**start, p=rate)["zf"]) for rate in rates])

    return solve(), solve


large_methods = ("IDAS",)


def large(problem, rtol, method):
    integrator = _large_integrator(problem, rtol, problem.times.tolist())
    start = {"x0": problem.x0, "z0": problem.z0} | ({} if problem.p is None else {"p": problem.p})

    def solve():
        found = integrator(**start)
        return problem.in_order(np.asarray(found["xf"]).T, np.asarray(found["zf"]).T)

    return solve(), integrator.stats()["nsteps"], solve


def large_gradient(problem, rtol, method):
    """As that of `dae_jax_peer`, but of the mean over all times, by the adjoint equations: where these jump, at each of many
    times, IDAS does not get on.
    """
    import casadi

    integrator = _large_integrator(problem, rtol, [problem.scene.t1], calc_icB=True)
    p = casadi.MX.sym("p", problem.p.size)
    mean = integrator(x0=problem.x0, z0=problem.z0, p=p)["qf"] / (problem.scene.t1 - problem.t0)
    gradient = casadi.Function("gradient", [p], [casadi.gradient(mean, p)])
    solve = lambda: np.asarray(gradient(problem.p)).ravel()
    return solve(), None, solve


def large_slope(problem, rtol, method):
    """The gradient of `dae_jax_peer` times p: by a central difference."""
    integrator = _large_integrator(problem, rtol, large_problems.samples(problem).tolist())

    def deviation(scale):
        speeds = np.asarray(integrator(x0=problem.x0, z0=problem.z0, p=scale * problem.p)["xf"])[problem.x0.size // 2 :]
        return np.mean(speeds**2)

    solve = lambda: [(deviation(1.001) - deviation(0.999)) / 0.002]
    return solve(), None, solve


def _large_integrator(problem, rtol, times, **options):
    """MX expressions, whose Jacobian is sparse and exact. Where it falls apart into small blocks "csparse" factors it fastest,
    else "qr".
    """
    import casadi

    x, z = casadi.MX.sym("x", problem.x0.size), casadi.MX.sym("z", problem.z0.size)
    p = None if problem.p is None else casadi.MX.sym("p", problem.p.size)
    ode, alg = (f(problem.t0, x, z, p, large_problems.CasADi) for f in (problem.ode, problem.algebraic))
    equations = {"x": x, "z": z, "ode": ode, "alg": alg}
    if p is not None:
        speeds = x[problem.x0.size // 2 :]
        equations |= {"p": p, "quad": casadi.sumsqr(speeds) / speeds.numel()}
    options |= {
        "reltol": rtol,
        "abstol": problem.scene.scale * rtol,
        "max_num_steps": 1_000_000,
        "calc_ic": False,
        "init_xdot": problem.dx0.tolist(),
        "linear_solver": "csparse" if problem.name == "robertson" else "qr",
        # Of index 2 are only the pressures.
        "suppress_algebraic": problem.name == "stokes",
    }
    return casadi.integrator("large", "idas", equations, problem.t0, times, options)
