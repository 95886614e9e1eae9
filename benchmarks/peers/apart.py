"""Solves in a process of their own: for peers that may not end, or that need an environment of their own.

`python -m benchmarks.peers.apart PEER PROBLEM RTOL METHOD` calls `stiff_here` of the peer, and solves once more for each
line that it is sent; each time it prints the end state.
"""

import json
import os
import select
import subprocess
import sys

from . import load, stiff_problems


# Seconds for a first solve, from the start of the process.
LIMIT = 40.0


def stiff(peer, problem, rtol, method, python=sys.executable):
    """(end state, solve) of `peer.stiff_here(problem, rtol, method)`; an error where that fails or does not end."""
    command = [python, "-W", "ignore", "-m", __name__, peer, problem.name, repr(rtol), method]
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    environment = {**os.environ, "PYTHONPATH": root, "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )

    def answer():
        ready, _, _ = select.select([process.stdout], [], [], LIMIT)
        if not ready:
            process.kill()
            raise TimeoutError(f"it does not end within {LIMIT:.0f} s")
        found = json.loads(process.stdout.readline() or '{"error": "the process ended"}')
        if "error" in found:
            raise RuntimeError(found["error"])
        return found["end"]

    def solve():
        process.stdin.write("\n")
        process.stdin.flush()
        return answer()

    return answer(), solve


def main(peer, name, rtol, method):
    """The process."""
    channel, sys.stdout = sys.stdout, sys.stderr  # what a peer prints is no answer
    say = lambda found: print(json.dumps(found), file=channel, flush=True)
    try:
        end, solve = load(peer).stiff_here(stiff_problems.PROBLEMS[name](), float(rtol), method)
    except Exception as error:  # a peer that fails is a row of the table
        say({"error": f"{type(error).__name__}: {error}"})
        return
    say({"end": list(map(float, end))})
    for _ in sys.stdin:
        say({"end": list(map(float, solve()))})


if __name__ == "__main__":
    main(*sys.argv[1:])
