"""Error of the end state against warm run time, on the pendulum and the double pendulum, 10 s."""

import functools

import numpy as np

from . import timing
from .peers import problems


PROBLEMS = {
    "pendulum": lambda: problems.pendulum_exact(10.0),
    "double pendulum": lambda: problems.DOUBLE_PENDULUM_10,
}
RTOLS = tuple(10.0**-k for k in range(4, 14))
QUICK_RTOLS = (1e-6, 1e-10)


def run(peers, repeats, quick):
    """One row for each problem, peer, method and tolerance; within a problem and tolerance all are timed in turn."""
    rows = []
    for problem, reference in PROBLEMS.items():
        exact = reference()
        for rtol in QUICK_RTOLS if quick else RTOLS:
            rows += _at(problem, exact, peers, rtol, repeats)
    return rows


def _at(problem, exact, peers, rtol, repeats):
    calls = {
        (peer.name, method): functools.partial(getattr(peer, problem.replace(" ", "_")), rtol, method=method)
        for peer in peers
        for method in peer.methods
    }
    return timed(problem, rtol, calls, lambda end: float(np.abs(end - exact).max()), repeats)


def timed(problem, rtol, calls, error_of, repeats):
    """One row for each of {(peer, method): call}; a call gives (end state, solve), as the peers do."""
    rows, solves = {}, {}
    for (peer, method), call in calls.items():
        row = {"problem": problem, "peer": peer, "method": method, "rtol": rtol, "failure": None}
        try:
            (end, solve), first = timing.first_call(call)
        except Exception as error:  # a peer that fails is a row, not the end of the table
            row["failure"] = f"{type(error).__name__}: {error}".splitlines()[0][:80]
        else:
            row |= {"error": error_of(end), "first": first}
            solves[peer, method] = solve
        rows[peer, method] = row
    for key, measured in timing.measure_together(solves, repeats).items():
        rows[key]["time"] = measured
    for row in rows.values():
        print(_line(row), flush=True)
    return list(rows.values())


def _line(row):
    head = f"{row['problem']:<16} {row['peer']:<22} {row['method']:<30} {row['rtol']:>6.0e}"
    if row["failure"]:
        return f"{head} failed: {row['failure']}"
    return f"{head} {row['error']:>8.1e} {1e3 * row['time'].median:>10.4f} ms (first {row['first']:.2f} s)"


def curves(rows, problem):
    """{(peer, method): (run times in s, errors)} for one problem."""
    found = {}
    for row in rows:
        if row["problem"] == problem and not row["failure"] and row["error"] > 0:
            times, errors = found.setdefault((row["peer"], row["method"]), ([], []))
            times.append(row["time"].median)
            errors.append(row["error"])
    return found


def time_at(curve, error):
    """The run time at which a method reaches `error`, between two tolerances by interpolation of the logarithms; its
    fastest run that is better where all are; `None` where it does not get there.
    """
    times, errors = (np.array(x) for x in curve)
    good = errors <= error
    if not good.any():
        return None
    best = float(times[good].min())
    if good.all():
        return best
    order = np.argsort(-errors)
    logs = np.log(errors[order]), np.log(times[order])
    after = int(np.argmax(logs[0] <= np.log(error)))
    if after == 0:
        return best
    weight = (logs[0][after - 1] - np.log(error)) / (logs[0][after - 1] - logs[0][after])
    return float(np.exp(logs[1][after - 1] + weight * (logs[1][after] - logs[1][after - 1])))


def fastest(found, name, error, only=""):
    """The least `time_at` of a peer's methods, of those with `only` in their names, of `curves`."""
    times = (time_at(curve, error) for (peer, method), curve in found.items() if peer == name and only in method)
    return min(filter(None, times), default=None)


def ratio(a, b):
    """a/b of run times, where both are known."""
    return None if a is None or b is None else a / b


def figures(rows):
    """(name, figure) for each problem."""
    from dae_jax import plotting

    for problem in PROBLEMS:
        points = {f"{peer}, {method}": curve for (peer, method), curve in curves(rows, problem).items()}
        if points:
            yield f"work_precision_{problem.replace(' ', '_')}", plotting.work_precision(points, f"{problem}, 10 s")


def targets(rows):
    """(what, measured ratio, limit) with "≥" or "≤" in what: this library against each peer at equal error."""
    found = curves(rows, "double pendulum")
    best = functools.partial(fastest, found)
    for name, limit, errors in (
        ("diffrax, hand-reduced", 20, (1e-6, 1e-9)),
        ("CasADi", 20, (1e-6,)),
        ("solve_dae", 200, (1e-6,)),
        ("IDA (scikit-sundae)", 200, (1e-6,)),
    ):
        for error in errors:
            yield f"faster than {name} at {error:g} ≥ {limit}", ratio(best(name, error), best("dae_jax", error)), limit
    for error in (1e-6, 1e-9):
        ours = best("dae_jax", error, "OrthogonalProjection")
        yield f"time of the C program at {error:g} ≤ 1.5", ratio(ours, best("C DOP853", error, "projected")), 1.5
        yield f"time of heyoka at {error:g} ≤ 1.5", ratio(best("dae_jax", error), best("heyoka", error)), 1.5
        projected, unprojected = (
            time_at(found[key], error) if (key := ("dae_jax", method)) in found else None
            for method in ("OrthogonalProjection(DOP853)", "DOP853")
        )
        yield f"projected against unprojected at {error:g} ≤ 1.0", ratio(projected, unprojected), 1.0
