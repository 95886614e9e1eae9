"""Systems of up to 30,000 unknowns: time, memory and error over size; each solve in a process of its own."""

import functools

import numpy as np

from .peers import large_apart, large_problems
from .work_precision import curves, time_at


# {problem: (its sizes n, relative tolerances)}; `analyse` is asked for the structure of the largest of Robertson's.
FULL = {
    "robertson": ((1, 100, 1000, 10_000), (1e-4, 1e-8)),
    "heat": ((100,), (1e-4, 1e-6)),
    "food web": ((60,), (1e-4, 1e-6)),
    "stokes": ((16, 32, 64), (1e-6,)),
    "power grid": ((2000,), (1e-6,)),
}
QUICK = {
    "robertson": ((1, 10), (1e-4,)),
    "heat": ((5,), (1e-4,)),
    "food web": ((4,), (1e-4,)),
    "stokes": ((2,), (1e-4,)),
    "power grid": ((6,), (1e-4,)),
}
# Where no reference is known, a tight solve by another code stands in for it.
TIGHT, OTHERS = 1e-10, ("casadi_peer", "sundae_peer")
# Growth is that over at least so many unknowns.
MANY = 300


def run(peers, repeats, quick):
    """One row for each problem, size, tolerance, peer and method. A method that does not end is not asked for more."""
    rows, tired = [], set()
    by_name = {peer.__name__.rsplit(".", 1)[-1]: peer for peer in peers}
    others = [by_name[name] for name in OTHERS if name in by_name]
    for problem, (sizes, rtols) in (QUICK if quick else FULL).items():
        for n in sizes:
            for peer, method in _taking_part(peers, problem, n):
                for rtol in rtols:
                    rows.append(_row(peer, "large", problem, n, rtol, method, repeats, others, tired))
        for peer, method in _taking_part(peers, problem, sizes[-1]):
            if problem == "power grid" and hasattr(peer, "large_gradient"):
                rows.append(_row(peer, "large_gradient", problem, sizes[-1], rtols[-1], method, repeats, others, tired))
        if problem == "robertson" and "dae_jax_peer" in by_name:
            rows.append(
                _row(by_name["dae_jax_peer"], "large_analyse", problem, sizes[-1], 1.0, "analyse", 1, [], tired)
            )
    return rows


def _taking_part(peers, problem, n):
    for peer in peers:
        if n <= getattr(peer, "large_limits", {}).get(problem, n):
            yield from ((peer, method) for method in getattr(peer, "large_methods", ()))


def _row(peer, what, problem, n, rtol, method, repeats, others, tired):
    of = large_problems.problem(problem, n)
    row = {
        "problem": problem,
        "what": what.removeprefix("large_").replace("large", "solve"),
        "n": n,
        "unknowns": of.unknowns,
        "rtol": rtol,
        "peer": peer.name,
        "method": method,
    }
    if (peer, what, problem, method) in tired:
        row["failure"] = "not asked: a smaller one failed"
    else:
        row |= large_apart.run(peer, what, problem, n, rtol, method, repeats)
        if row["failure"]:
            tired.add((peer, what, problem, method))
    states = row.pop("states", None)
    row["error"] = None if states is None else _error(of, row, np.array(states), others)
    print(_line(row), flush=True)
    return row


def _error(of, row, states, others):
    """Of a solve, or of how a gradient says that the deviation changes with all inertias."""
    others = [peer for peer in others if peer.name != row["peer"]] or others
    if row["what"] == "gradient":
        slopes = [_tight(peer, "large_slope", of.name, of.n) for peer in others if hasattr(peer, "large_slope")]
        return abs(states @ of.p / slopes[0][0] - 1) if slopes and slopes[0] else None
    if row["what"] != "solve":
        return None
    known = of.known()
    if np.isnan(known).all():
        known = next((found for peer in others if (found := _tight(peer, "large", of.name, of.n))), known)
    return of.error(states, known)


@functools.cache
def _tight(peer, what, problem, n):
    return large_apart.run(peer, what, problem, n, TIGHT, peer.large_methods[0], 1).get("states")


def _line(row):
    task = "" if row["what"] == "solve" else f" {row['what']}"
    head = f"{row['problem'] + task:<20} {row['unknowns']:>6} {row['rtol']:>6.0e} {row['peer']:<22} {row['method']:<10}"
    memory, error = (
        f"{row[x]:>8.{1}{'e' if x == 'error' else 'f'}}" if row.get(x) is not None else "       –"
        for x in ("memory", "error")
    )
    first = f"first {row['first']:7.2f} s" if "first" in row else " " * 15
    if row["failure"]:
        return f"{head} {first} {error} {memory} MB  {row['failure']}"
    steps = "     –" if row["steps"] is None else f"{row['steps']:>6}"
    return f"{head} {first} {error} {memory} MB {steps} steps {1e3 * row['time'].median:11.3f} ms"


def figures(rows):
    """(name, figure): time and memory over the number of unknowns, with the exponents of their growth."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    from dae_jax.app.plotting.common import look

    solves = [r for r in rows if r["what"] == "solve" and r["problem"] == "robertson" and not r["failure"]]
    if not solves:
        return
    rtols = sorted({r["rtol"] for r in solves}, reverse=True)
    names = sorted({(r["peer"], r["method"]) for r in solves}, key=[(r["peer"], r["method"]) for r in solves].index)
    panels = [(f"warm run time in s, rtol {rtol:.0e}", rtol, lambda r: r["time"].median) for rtol in rtols]
    panels.append((f"memory of a solve in MB, rtol {rtols[-1]:.0e}", rtols[-1], lambda r: r["memory"]))
    figure = Figure(figsize=(4.4 * len(panels), 4.2), layout="constrained", dpi=200)
    for axes, (quantity, rtol, of) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for i, (peer, method) in enumerate(names):
            points = [
                (r["unknowns"], of(r)) for r in solves if (r["peer"], r["method"], r["rtol"]) == (peer, method, rtol)
            ]
            if points:
                slope = growth(points)
                label = f"{peer}, {method}" + (f": {slope:.2f}" if slope else "")
                axes.loglog(*zip(*points, strict=True), label=label, **look(f"{peer} {method}", i))
        axes.set(xlabel="unknowns", title=quantity)
        axes.title.set_fontsize("medium")
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(
            frameon=False, fontsize="x-small", loc="upper left", title="exponent of growth", title_fontsize="x-small"
        )
        # Room for the legend.
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.45)
    figure.suptitle("Copies of Robertson's reaction side by side, to t = 4·10¹⁰")
    yield "large", figure


def growth(points):
    """The exponent in the number of unknowns, of MANY and more; None of fewer than two points."""
    points = [(size, value) for size, value in points if size >= MANY]
    return float(np.polyfit(*np.log(np.array(points)).T, 1)[0]) if len(points) > 1 else None


def targets(rows):
    """(what, measured ratio, limit): this library's best method against the peers, and absolute limits."""
    done = [r for r in rows if not r["failure"]]
    ratio = lambda a, b: None if a is None or b is None else a / b
    solved = [r for r in done if r["what"] == "solve"]

    def least(peer, of, **which):
        found = [of(r) for r in solved if r["peer"] == peer and all(r[k] == v for k, v in which.items())]
        return min(found, default=None)

    seconds, megabytes, first = lambda r: r["time"].median, lambda r: r["memory"], lambda r: r["first"]
    copies = sorted({(r["unknowns"], r["rtol"]) for r in rows if r["what"] == "solve" and r["problem"] == "robertson"})
    for size, rtol in copies:
        ours, theirs = (least(p, seconds, problem="robertson", unknowns=size, rtol=rtol) for p in ("dae_jax", "CasADi"))
        yield f"{size} unknowns at {rtol:g}: time of CasADi ≤ 1", ratio(ours, theirs), 1
    for rtol in sorted({rtol for _, rtol in copies}):
        times = [
            (s, least("dae_jax", seconds, problem="robertson", unknowns=s, rtol=rtol)) for s, r in copies if r == rtol
        ]
        yield f"growth exponent at {rtol:g} ≤ 1.1", growth([p for p in times if p[1]]), 1.1
    for problem in ("heat", "food web"):
        yield f"{problem}: time of IDA at equal error ≤ 1", ratio(*_at_equal_error(solved, problem)), 1
    size, rtol = copies[-1]
    memories = (least(p, megabytes, problem="robertson", unknowns=size, rtol=rtol) for p in ("dae_jax", "CasADi"))
    yield f"{size} unknowns: memory of CasADi ≤ 2", ratio(*memories), 2
    for n, limit in zip(FULL["stokes"][0], (5, 8, 15), strict=True):
        yield f"first call of stokes {n} × {n}, in s ≤ {limit}", least("dae_jax", first, problem="stokes", n=n), limit
    analysed = next((r for r in done if r["what"] == "analyse"), None)
    yield "analyse, in s ≤ 20", analysed and analysed["first"], 20
    yield "analyse, in MB ≤ 2000", analysed and analysed["memory"], 2000


def _at_equal_error(solved, problem):
    """Seconds of this library and of IDA by its best interface, at the least error that both reach."""
    found = curves([r for r in solved if r["error"]], problem)
    ours, theirs = ([c for (peer, _), c in found.items() if (peer == "dae_jax") == own] for own in (True, False))
    if not ours or not theirs:
        return None, None
    error = max(min(min(c[1]) for c in side) for side in (ours, theirs))
    return tuple(min((t for c in side if (t := time_at(c, error))), default=None) for side in (ours, theirs))
