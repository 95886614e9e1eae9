"""Every available peer on the double pendulum, 10 s: error of the end state and warm run time at each tolerance.

python -m benchmarks.peers [--peers NAME ...] [--rtols 1e-6 ...] [--repeats 5] [--save]
"""

import argparse
import os
import sys

import numpy as np

from .. import timing
from . import NAMES, PACKAGES, load, problems


REACHED = 1e-4  # what every peer must come within at its tightest tolerance


def main():
    """Print the table; the exit status says whether all peers reach the reference."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__.splitlines()[0])
    parser.add_argument("--peers", nargs="+", default=NAMES, choices=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--rtols", nargs="+", type=float, default=[1e-6, 1e-8, 1e-10, 1e-12])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--save", action="store_true", help="write benchmarks/results/peers.json")
    arguments = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")

    peers = available(arguments.peers)
    rows = []
    print(f"{'peer':<22} {'method':<16} {'rtol':>6} {'error':>8} {'median ms':>10} {'first ms':>9}")
    for rtol in arguments.rtols:
        for row in measure(peers, rtol, arguments.repeats):
            rows.append(row)
            print_row(row)
    if arguments.save:
        print("written to", timing.save("peers", rows, PACKAGES))
    missed = [
        row for row in rows if row["rtol"] == min(arguments.rtols) and (row["failure"] or not row["error"] <= REACHED)
    ]
    for row in missed:
        print(f"{row['peer']} ({row['method']}) misses the reference: {row['failure'] or row['error']}")
    return 1 if missed else 0


def available(names):
    """The peers that can run here; the others are named, with the reason."""
    peers = []
    for name in names:
        peer = load(name)
        reason = peer.available()
        if reason:
            print(f"skipped {peer.name}: {reason}")
        else:
            peers.append(peer)
    return peers


def measure(peers, rtol, repeats):
    """One row for each peer and method, timed in turn."""
    rows, solves, firsts = {}, {}, {}
    for peer in peers:
        for method in peer.methods:
            key = peer.name, method
            rows[key] = {
                "peer": peer.name,
                "method": method,
                "rtol": rtol,
                "error": None,
                "time": None,
                "failure": None,
            }
            try:
                (end, solves[key]), firsts[key] = timing.first_call(peer.double_pendulum, rtol, method=method)
            except Exception as error:  # a peer that fails is a row, not the end of the table
                rows[key]["failure"] = f"{type(error).__name__}: {error}"
            else:
                rows[key]["error"] = float(np.abs(end - problems.DOUBLE_PENDULUM_10).max())
    for key, time in timing.measure_together(solves, repeats, firsts=firsts).items():
        rows[key]["time"] = time
    return rows.values()


def print_row(row):
    """One line of the table."""
    head = f"{row['peer']:<22} {row['method']:<16} {row['rtol']:>6.0e}"
    if row["failure"]:
        print(f"{head} failed: {row['failure'][:60]}")
    else:
        time = row["time"]
        print(f"{head} {row['error']:>8.1e} {1e3 * time.median:>10.4f} {1e3 * time.first:>9.0f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
