"""Mechanisms with closed loops, from bodies and joints: error of all bodies' places at the end against warm run time.

A five-bar with a motor (one loop, in the plane) and a Stewart platform (six loops, in space), of `dae_jax.mechanisms.EXAMPLES`; the
truth is their motion in minimal coordinates.
"""

import functools

import numpy as np

from . import timing
from .work_precision import curves, fastest, ratio, timed


PROBLEMS = ("five-bar", "stewart")
RTOLS = tuple(10.0**-k for k in range(3, 11))
QUICK_RTOLS = (1e-4, 1e-8)
# What takes longer, in s, is not asked for less error.
LONG = 1.0
# Six loops, simulated seconds in one, at gaps of at most so many m.
GAP = 1e-10


def run(peers, repeats, quick):
    """One row for each problem, peer, method and tolerance; then gap and pace of six loops in 100 s by this library."""
    rows = []
    for problem in PROBLEMS:
        tired = set()
        scene = example(problem)
        exact = places(scene.reference(np.array([scene.t1]))[0].values[0])
        for rtol in QUICK_RTOLS if quick else RTOLS:
            calls = {
                (peer.name, method): functools.partial(peer.loops, problem, rtol, method=method)
                for peer in peers
                for method in getattr(peer, "loop_methods", ())
                if (peer.name, method) not in tired
            }
            # Of what moves in a plane, peers may give a third coordinate.
            off = lambda places, exact=exact: float(np.abs(places[:, : exact.shape[1]] - exact).max())
            found = timed(problem, rtol, calls, off, repeats)
            tired |= {(row["peer"], row["method"]) for row in found if "time" in row and row["time"].median > LONG}
            rows += found
    return rows + [long(peer, repeats) for peer in peers if hasattr(peer, "long_loops") and not quick]


def example(problem):
    """The scene, in float64."""
    import jax

    from dae_jax.mechanisms import EXAMPLES

    jax.config.update("jax_enable_x64", True)
    return EXAMPLES[problem]()


def places(values):
    """Where the centres of mass are, of the coordinates of all bodies."""
    return np.asarray(values)[..., : 2 if np.shape(values)[-1] == 3 else 3]


def long(peer, repeats, t1=100.0, rtol=1e-6):
    """How long a Stewart platform takes for 100 s, and how far its joints come apart at most."""
    gap, solve = peer.long_loops("stewart", rtol, t1)
    measured = timing.measure(solve, min(repeats, 3))
    print(f"stewart, {t1:g} s at rtol {rtol:g}, {peer.name}: {measured.median:.2f} s, gap {gap:.1e} m", flush=True)
    return {"problem": "long", "peer": peer.name, "t1": t1, "rtol": rtol, "gap": gap, "time": measured}


def figures(rows):
    """(name, figure) for each problem."""
    from dae_jax import plotting

    for problem in PROBLEMS:
        points = {f"{peer}, {method}": curve for (peer, method), curve in curves(rows, problem).items()}
        if points:
            title = f"{problem}, {example(problem).t1:g} s: largest error of a place in m"
            yield f"work_precision_{problem}", plotting.work_precision(points, title)


def targets(rows):
    """See `work_precision.targets`."""
    for problem in PROBLEMS:
        best = functools.partial(fastest, curves(rows, problem))
        for name in ("MuJoCo", "Exudyn"):
            for error in (1e-5, 1e-7):
                times = ratio(best(name, error), best("dae_jax", error))
                yield f"{problem}: faster than {name} at {error:g} m ≥ 20", times, 20
    for row in rows:
        if row["problem"] == "long":
            yield f"six loops: gap in m after {row['t1']:g} s ≤ {GAP:g}", row["gap"], GAP
            yield "six loops: simulated seconds a second ≥ 54", row["t1"] / row["time"].median, 54
