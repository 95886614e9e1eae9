"""Every measurement: `python -m benchmarks` or `dae-jax bench`."""

import argparse
import os
import sys
from pathlib import Path

from dae_jax.app.options import writable

from . import chain, cost, first, gpu, jit, large, loops, stiff, sweep, timing, work_precision
from .peers import NAMES, PACKAGES, load


PARTS = {
    "work-precision": work_precision,
    "chain": chain,
    "cost": cost,
    "first": first,
    "sweep": sweep,
    "stiff": stiff,
    "jit": jit,
    "large": large,
    "loops": loops,
    "gpu": gpu,
}
# The others are asked for: one needs a GPU, one takes an hour of new processes.
BY_DEFAULT = [part for part in PARTS if part not in ("gpu", "first")]
QUICK = ("dae_jax_peer", "c_limit", "plain_diffrax")


def main(argv=None):
    """Print the tables, write data and figures, and set the measurements against what they must reach."""
    parser = argparse.ArgumentParser(prog="dae-jax bench", description=__doc__)
    parser.add_argument("--parts", nargs="+", default=BY_DEFAULT, choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--peers", nargs="+", choices=NAMES, metavar="PEER", help=f"by default all: {', '.join(NAMES)}")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="a smoke test: few points; this library, C and diffrax")
    parser.add_argument("--out", type=Path, default=timing.RESULTS, help="folder for data and figures")
    parser.add_argument(
        "--synchronous", action="store_true", help="JAX computes in the calling thread, which saves waking another"
    )
    arguments = parser.parse_args(argv)
    if arguments.repeats < 1:
        parser.error(f"--repeats must be at least 1, but is {arguments.repeats}")
    if arguments.quick and arguments.peers:
        parser.error(f"--quick takes no --peers: it is for {', '.join(QUICK)}")
    writable(parser, arguments.out)
    if "gpu" not in arguments.parts:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if arguments.synchronous:
        import jax

        jax.config.update("jax_cpu_enable_async_dispatch", False)
    peers = available(QUICK if arguments.quick else arguments.peers or NAMES)
    verdicts = []
    for part in arguments.parts:
        print(f"\n== {part}: {PARTS[part].__doc__}")
        rows = PARTS[part].run(peers, arguments.repeats, arguments.quick)
        print("written:", timing.save(part, rows, arguments.out, PACKAGES))
        for name, figure in PARTS[part].figures(rows):
            figure.savefig(arguments.out / f"{name}.png")
            print("written:", arguments.out / f"{name}.png")
        verdicts += PARTS[part].targets(rows)
    print("\n== what must be reached")
    for text, measured, limit in verdicts:
        print(verdict(text, measured, limit))
    return 0


def verdict(text, measured, limit):
    """One line: what, measured, reached or not."""
    if measured is None:
        return f"{text:<56} not measured: one of the two is missing or does not get there"
    reached = measured >= limit if "≥" in text else measured <= limit
    return f"{text:<56} {measured:10.3g}   {'reached' if reached else 'MISSED'}"


def available(names):
    """The peers that can run here, each with its formulation; the others are named, with the reason."""
    peers = []
    for name in names:
        peer = load(name)
        reason = peer.available()
        print(f"skipped {peer.name}: {reason}" if reason else f"{peer.name}: {' '.join(peer.__doc__.split())}")
        if not reason:
            peers.append(peer)
    return peers


if __name__ == "__main__":
    sys.exit(main())
