"""Stiff problems of index 1 to 3 with published end values: error against warm run time, and 1,000 variations of one."""

import functools

import numpy as np

from . import timing
from .peers import stiff_problems
from .work_precision import curves, fastest, ratio, timed


RTOLS = tuple(10.0**-k for k in range(4, 11))
QUICK_RTOLS = (1e-5, 1e-7)
VARIATIONS, VARIED_RTOL = 1000, 1e-6


def run(peers, repeats, quick):
    """One row for each problem, peer, method and tolerance, then one for each peer that takes the variations."""
    rows = []
    for name, make in stiff_problems.PROBLEMS.items():
        for rtol in QUICK_RTOLS if quick else RTOLS:
            rows += _at(name, make(), peers, rtol, repeats)
    rates = np.array([0.04, 1e4, 3e7]) * np.exp(np.random.default_rng(0).uniform(-1, 1, (VARIATIONS, 3)))
    for peer in peers:
        if hasattr(peer, "robertson_variations"):
            (ends, solve), first = timing.first_call(peer.robertson_variations, rates, VARIED_RTOL)
            measured = timing.measure(solve, min(repeats, 3), first=first)
            rows.append({"problem": "variations", "peer": peer.name, "time": measured, "ends": ends.tolist()})
            print(f"{VARIATIONS} variations of Robertson, {peer.name}: {measured.median:.3f} s", flush=True)
    return rows


def _at(name, problem, peers, rtol, repeats):
    calls = {
        (peer.name, method): functools.partial(peer.stiff, problem, rtol, method)
        for peer in peers
        for method in getattr(peer, "stiff_methods", ())
    }
    return timed(name, rtol, calls, lambda end: stiff_problems.error(name, np.asarray(end)), repeats)


def figures(rows):
    """(name, figure) for each problem."""
    from dae_jax import plotting

    for problem in stiff_problems.PROBLEMS:
        points = {f"{peer}, {method}": curve for (peer, method), curve in curves(rows, problem).items()}
        if points:
            yield f"work_precision_{problem}", plotting.work_precision(points, problem)


def targets(rows):
    """(what, measured ratio, limit): this library against each peer at an error of 1e-6."""
    for problem in stiff_problems.PROBLEMS:
        best = functools.partial(fastest, curves(rows, problem), error=1e-6)
        slower = lambda name, best=best: ratio(best(name), best("dae_jax"))
        yield f"{problem}: faster than IDA with Python ≥ 20", slower("IDA (scikit-sundae)"), 20
        yield f"{problem}: faster than solve_dae ≥ 20", slower("solve_dae"), 20
        if stiff_problems.PROBLEMS[problem]().semi_explicit:
            yield f"{problem}: faster than CasADi IDAS ≥ 1", slower("CasADi"), 1
    seconds = {row["peer"]: row["time"].median for row in rows if row["problem"] == "variations"}
    ours, theirs = seconds.get("dae_jax"), seconds.get("CasADi")
    yield "variations: throughput of a loop over IDAS ≥ 10", ratio(theirs, ours), 10
