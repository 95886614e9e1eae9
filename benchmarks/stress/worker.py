"""One family of stressors in a process of its own: a line of JSON for each cell on stdout, when it begins and when it ends."""

import argparse
import dataclasses
import json
import os
import signal
import sys

import numpy as np


def main():
    """Cells named by case and method, in the order given on stdin."""
    parser = argparse.ArgumentParser()
    parser.add_argument("family")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument(
        "--limit", type=float, required=True, help="seconds of processor time for a cell; then the process ends"
    )
    arguments = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    # What a library prints must not end up between the lines.
    out, sys.stdout = sys.stdout, sys.stderr
    import jax

    jax.config.update("jax_enable_x64", True)

    from .families import cases_of
    from .judge import judged
    from .solve import solved

    cases = cases_of(arguments.family, arguments.quick)
    for line in sys.stdin:
        stressor, method = json.loads(line)
        signal.setitimer(signal.ITIMER_PROF, arguments.limit)
        case = next(case for case in cases if case.name == stressor and case.applies(method))
        outcome = solved(case, method)
        signal.setitimer(signal.ITIMER_PROF, 0)
        cell = dataclasses.asdict(judged(arguments.family, case, method, outcome))
        cell["series"] = {name: np.asarray(x).tolist() for name, x in outcome.series.items()}
        print(json.dumps(cell), file=out, flush=True)


if __name__ == "__main__":
    main()
