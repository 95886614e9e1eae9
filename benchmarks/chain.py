"""A chain of n pendulums, 1 s at rtol 1e-6: run time over n, with the exponent of its growth."""

import numpy as np

from . import timing


SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
QUICK_SIZES = (4, 16)
COMPACTION_THRESHOLD = 20.0  # a peer whose first call took longer than this, in s, is not asked for a longer chain


def run(peers, repeats, quick):
    """One row for each peer and length. Errors are distances to the C program at rtol 1e-10."""
    rows, tired = [], set()
    for n in QUICK_SIZES if quick else SIZES:
        solves, found = {}, {}
        reference = None
        for peer in peers:
            if not hasattr(peer, "chain") or peer.name in tired:
                continue
            row = found[peer.name] = {"peer": peer.name, "n": n, "failure": None}
            try:
                (end, solves[peer.name]), row["first"] = timing.first_call(peer.chain, n, 1e-6)
                row["end"] = end
                if peer.name == "C DOP853":
                    reference = peer.chain(n, 1e-10)[0]
            except Exception as error:  # a peer that fails is a row, not the end of the table
                row["failure"] = f"{type(error).__name__}: {error}".splitlines()[0][:80]
                tired.add(peer.name)
            if row.get("first", 0) > COMPACTION_THRESHOLD:
                tired.add(peer.name)
        for name, measured in timing.measure_together(solves, repeats).items():
            found[name]["time"] = measured
        for row in found.values():
            end = row.pop("end", None)
            if not row["failure"]:
                row["error"] = None if reference is None else float(np.abs(end - reference).max())
            rows.append(row)
            print(_line(row), flush=True)
    return rows


def _line(row):
    if row["failure"]:
        return f"{row['peer']:<22} n = {row['n']:<4} failed: {row['failure']}"
    error = "" if row["error"] is None else f"{row['error']:8.1e}"
    return (
        f"{row['peer']:<22} n = {row['n']:<4} {1e3 * row['time'].median:9.4f} ms {error} (first {row['first']:.1f} s)"
    )


def growth(rows, peer):
    """The exponent of the run time in n, fitted over n ≥ 16."""
    points = [(r["n"], r["time"].median) for r in rows if r["peer"] == peer and not r["failure"] and r["n"] >= 16]
    return float(np.polyfit(*np.log(np.array(points).T), 1)[0]) if len(points) > 1 else None


def figures(rows):
    """(name, figure): run time over n."""
    from dae_jax import plotting

    curves = {}
    for row in rows:
        if not row["failure"]:
            ns, times = curves.setdefault(row["peer"], ([], []))
            ns.append(row["n"])
            times.append(row["time"].median)
    if curves:
        yield (
            "chain",
            plotting.scaling(curves, "pendulums n", "run time in s", "Chain of n pendulums, 1 s at rtol 1e-6"),
        )


def targets(rows):
    """See `work_precision.targets`."""
    yield "growth exponent, n = 16 to 256 ≤ 1.2", growth(rows, "dae_jax"), 1.2
    at = {r["peer"]: r["time"].median for r in rows if r["n"] == 128 and not r["failure"]}
    ours = at.pop("dae_jax", None)
    limit = at.pop("C DOP853", None)
    at.pop("diffrax, hand-reduced", None)
    best = min(at.values(), default=None)
    yield "faster than the best peer at n = 128 ≥ 4", None if not (ours and best) else best / ours, 4
    yield "time of the C program at n = 128 ≤ 3", None if not (ours and limit) else ours / limit, 3
