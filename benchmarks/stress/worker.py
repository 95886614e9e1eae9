"""One family of stressors in a process of its own: a line of JSON for each cell on stdout, when it begins and when it ends."""

import argparse
import dataclasses
import json
import os
import resource
import signal
import sys

import numpy as np


# What a cell says that needs more memory than there is.
FULL = "out of memory"


def main():
    """Cells named by case and method, in the order given on stdin."""
    parser = argparse.ArgumentParser()
    parser.add_argument("family")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument(
        "--limit", type=float, required=True, help="seconds of processor time for a cell; then the process ends"
    )
    parser.add_argument("--memory", type=float, required=True, help="GiB; whoever asks for more gets an error")
    arguments = parser.parse_args()
    most = int(arguments.memory * 2**30)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    # No dump of that size.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
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
