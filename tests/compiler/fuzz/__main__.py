"""python -m tests.compiler.fuzz FIRST LAST: the programs of these seeds, and the smallest part of each that differs.

A seed is one program for each primitive on each type of numbers and 100 compositions, about 950 in all.
"""

import os
import sys


os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax


def main(first: int, last: int) -> int:
    from . import campaign

    jax.config.update("jax_enable_x64", True)
    count = failed = 0
    for seed in range(first, last):
        for programs in campaign.bundles(campaign.of_seed(seed)):
            report = campaign.report(programs)
            count, failed = count + len(programs), failed + len(report)
            print(*report, sep="\n\n", end="\n\n" if report else "")
            print(f"seed {seed}: {count} programs, {failed} differ", flush=True)
            jax.clear_caches()
    return failed


if __name__ == "__main__":
    sys.exit(bool(main(*map(int, sys.argv[1:3]))))
