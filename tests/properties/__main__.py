"""python -m tests.properties FIRST LAST [--everything]: the mechanisms of these seeds, of each family, DAEs
whose solution was chosen, and what does not hold.

By default what the tests ask of each family; `--everything`: every method and derivatives of every family, which takes minutes to
compile.
"""

import os
import sys


os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax


TOGETHER = 170


def main(first: int, last: int, everything: bool) -> int:
    from . import manufactured
    from .campaign import EVERYTHING, FAMILY_CHECKS, broken
    from .checks import Batch

    jax.config.update("jax_enable_x64", True)
    count = near = failed = 0
    for name, checks in FAMILY_CHECKS.items():
        # Batches of one size, so that nothing is compiled again.
        for start in range(first, last, TOGETHER):
            batch = Batch(name, range(start, start + TOGETHER))
            lines = broken(batch, EVERYTHING if everything else checks)
            count, near, failed = count + TOGETHER, near + int(batch.near.sum()), failed + len(lines)
            print(*lines, sep="\n", end="\n" if lines else "")
            print(f"{name}: {count} mechanisms, {near} of them near a dead centre, {failed} lines", flush=True)
        jax.clear_caches()
    for index in (1, 2, 3):
        for method in manufactured.METHODS if everything else ("projection",):
            lines = manufactured.broken(index, range(first, last), method, derivatives=everything and index < 3)
            failed += len(lines)
            print(*lines, f"index {index} by {method}: {last - first} DAEs, {len(lines)} lines", sep="\n", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(bool(main(int(sys.argv[1]), int(sys.argv[2]), "--everything" in sys.argv)))
