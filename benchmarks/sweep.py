"""Double pendulums from a square grid of initial angles, 10 s at rtol 1e-6: the time of the whole sweep."""

import os

import numpy as np

from . import timing


LANES, QUICK_LANES = 10_000, 100


def run(peers, repeats, quick):
    """One row for each peer that takes part; the C program and heyoka with one thread and with all."""
    side = int((QUICK_LANES if quick else LANES) ** 0.5)
    grid = np.linspace(-3, 3, side)
    angles = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    rows = []
    for peer in peers:
        if not hasattr(peer, "sweep"):
            continue
        threaded = "threads" in peer.sweep.__code__.co_varnames
        for threads in (1, os.cpu_count()) if threaded else (None,):
            row = {"peer": peer.name, "threads": threads, "lanes": len(angles), "failure": None}
            try:
                options = {"threads": threads} if threaded else {}
                (_, solve), row["first"] = timing.first_call(peer.sweep, angles, 1e-6, **options)
                row["time"] = timing.measure(solve, min(repeats, 3), 0.0)
            except Exception as error:  # a peer that fails is a row, not the end of the table
                row["failure"] = f"{type(error).__name__}: {error}".splitlines()[0][:80]
            rows.append(row)
            print(_line(row), flush=True)
    return rows


def _line(row):
    head = f"{row['peer']:<22} {row['lanes']} lanes, threads {row['threads'] or 'as it likes'}"
    return f"{head}: failed: {row['failure']}" if row["failure"] else f"{head}: {row['time'].median:.3f} s"


def figures(rows):
    """None."""
    return ()


def targets(rows):
    """See `work_precision.targets`."""
    best = {}
    for row in rows:
        if not row["failure"]:
            best[row["peer"]] = min(best.get(row["peer"], np.inf), row["time"].median)
    ours = best.get("dae_jax")
    for name, text, limit, upper in (
        ("diffrax, hand-reduced", "throughput of jit(vmap(diffeqsolve)) ≥ 30", 30, False),
        ("heyoka", "throughput of heyoka's batch mode ≥ 1", 1, False),
        ("C DOP853", "time of the SIMD C program ≤ 2", 2, True),
    ):
        other = best.get(name)
        ratio = None if not (ours and other) else ours / other if upper else other / ours
        yield text, ratio, limit
