"""Solves of large systems, each in a process of its own: its memory is that of one solve, and it may not end.

`python -m benchmarks.peers.large_apart PEER WHAT PROBLEM N RTOL METHOD REPEATS` calls `large`, `large_gradient` or
`large_analyse` of the peer, which give (states, steps, solve), and writes two lines: one after this first call, one after
further ones of `solve()`.
"""

import json
import os
import resource
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from .. import timing
from . import large_problems, load


# Seconds for a first call and those after it, from the start of the process; GiB that it may take.
LIMIT, MEMORY = 300.0, 12
# Seconds for all warm calls, as long as there is one.
PATIENCE = 20.0


def run(peer, what, name, n, rtol, method, repeats, limit=LIMIT):
    """What the process found: `first` and `time` in s, `memory` in MB, `states`, `steps`, and `failure`, None where it did not."""
    module = peer.__name__.rsplit(".", 1)[-1]
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-m",
        __name__,
        module,
        what,
        name,
        str(n),
        repr(rtol),
        method,
        str(repeats),
    ]
    root = Path(__file__).parents[2]
    # Threads of a BLAS wait for each other far longer than they compute where cores are busy; JAX's are not among them.
    environment = {
        **os.environ,
        "PYTHONPATH": str(root),
        "JAX_PLATFORMS": "cpu",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, cwd=root, timeout=limit, check=False
        )
        said, status = done.stdout, f"the process ended with status {done.returncode}: {_last_line(done.stderr)}"
    except subprocess.TimeoutExpired as late:
        said, status = (late.stdout or b"").decode(), f"it does not end within {limit:.0f} s"
    found = {"failure": None}
    for line in said.splitlines():
        found |= json.loads(line)
    if "time" in found:
        found["time"] = timing.Timing(**found["time"])
    elif not found["failure"]:
        found["failure"] = status
    return found


def _last_line(text):
    return (text.strip().splitlines() or [""])[-1]


def main(peer, what, name, n, rtol, method, repeats):
    """The process."""
    # What a peer prints, from C too, is no answer.
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    say = lambda found: print(json.dumps(found), file=channel, flush=True)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY * 2**30, MEMORY * 2**30))
    try:
        peer, problem = load(peer), large_problems.problem(name, int(n))
        # The libraries that make the problem are no part of what a solve takes.
        held = _resident()
        (states, steps, solve), first = timing.first_call(getattr(peer, what), problem, float(rtol), method)
        say({"first": first, "states": np.asarray(states).tolist(), "steps": steps, "memory": _peak() - held})
        _, warm = timing.first_call(solve)
        count = max(1, min(int(repeats), int(PATIENCE / warm)))
        found = (
            timing.measure(solve, count, first=first)
            if warm < PATIENCE / 3
            else timing.Timing(warm, warm, warm, 1, first)
        )
        say({"time": asdict(found), "memory": _peak() - held})
    except Exception as error:  # a peer that fails is a row of the table
        say({"failure": f"{type(error).__name__}: {error}".splitlines()[0][:80]})


def _resident():
    """Megabytes of the process; its peak is counted from here."""
    if sys.platform != "linux":
        return 0.0
    Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak():
    if sys.platform != "linux":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return _status("VmHWM")


def _status(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


if __name__ == "__main__":
    main(*sys.argv[1:])
