"""The limit: hand-written C (benchmarks/c), gcc -O3 -march=native, DOP853 on the index-1 equations.

λ by elimination for the double pendulum and by a two-ended tridiagonal solve for the chain; the pendulums with
orthogonal projection after each step or without. Compiled on first use; ctypes adds about one microsecond to a call.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np

from . import problems


name = "C DOP853"
methods = ("projected", "plain")
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")
SOURCES = Path(__file__).parent.parent / "c"


def available():
    return None if shutil.which("gcc") else "gcc is not on the path"


def double_pendulum(rtol, t1=10.0, method="projected"):
    return _prepare(_library().double_pendulum, problems.chain_start(2), t1, rtol, method)


def pendulum(rtol, t1=10.0, method="projected"):
    return _prepare(_library().pendulum, problems.chain_start(1), t1, rtol, method)


def chain(n, rtol, t1=1.0, method="plain"):
    start = problems.chain_start(n).reshape(2, n, 2).swapaxes(1, 2).ravel()  # the program wants all x, all y, ...
    state = np.empty_like(start)
    solve = _caller(_library().chain, state, start, n, _pointer(state), ctypes.c_double(t1), ctypes.c_double(rtol))
    return solve().reshape(2, 2, n).swapaxes(1, 2).ravel(), solve


def sweep(angles, rtol, t1=10.0, method="plain", threads=None):
    starts = problems.double_pendulum_starts(angles)
    states = np.empty_like(starts)
    arguments = _pointer(states), ctypes.c_double(t1), ctypes.c_double(rtol), threads or os.cpu_count()
    solve = _caller(_library().sweep, states, starts, ctypes.c_long(len(starts)), *arguments)
    return solve().copy(), solve


def _prepare(function, start, t1, tol, method):
    state = np.empty_like(start)
    projected = int(method == "projected")
    solve = _caller(function, state, start, _pointer(state), ctypes.c_double(t1), ctypes.c_double(tol), projected)
    return solve().copy(), solve


def _caller(function, state, start, *arguments):
    def solve():
        state[...] = start
        if function(*arguments) < 0:
            raise RuntimeError("the C program gave up: step too small, or NaN")
        return state

    return solve


def _pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def _library():
    """The shared library, compiled into benchmarks/c/build unless it is there already."""
    sources = b"".join(path.read_bytes() for path in sorted(SOURCES.glob("*.[ci]*")))
    build = SOURCES / "build"
    target = build / f"pendulums-{hashlib.sha256(sources + ' '.join(FLAGS).encode()).hexdigest()[:12]}.so"
    if not target.exists():
        build.mkdir(exist_ok=True)
        (build / ".gitignore").write_text("*\n")
        subprocess.run(["gcc", *FLAGS, "-o", target, SOURCES / "pendulums.c", "-lm", "-lpthread"], check=True)
    library = ctypes.CDLL(str(target))
    library.sweep.restype = ctypes.c_long
    return library
