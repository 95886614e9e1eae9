"""heyoka: Taylor series of adaptive order and step, compiled by LLVM for the scene, on the index-1 ODE with λ inlined.

The pendulums in Cartesian coordinates, λ by 2×2 elimination; the chain by elimination written out, so only while n
is small enough to compile. Built once, state reset for each solve. The sweep is the batch integrator, one copy a
thread; its ensemble form copies the integrator for every batch and takes six times as long.
"""

import copy
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from . import missing, problems


name = "heyoka"
methods = ("taylor",)
LARGEST_CHAIN = 32


def available():
    return missing("heyoka")


def double_pendulum(rtol, t1=10.0, method="taylor"):
    return chain(2, rtol, t1)


def pendulum(rtol, t1=10.0, method="taylor"):
    return chain(1, rtol, t1)


def chain(n, rtol, t1=1.0, method="taylor"):
    import heyoka

    if n > LARGEST_CHAIN:
        raise ValueError(f"heyoka writes every equation out: n ≤ {LARGEST_CHAIN} here, to compile within a minute")
    start = problems.chain_start(n)
    integrator = heyoka.taylor_adaptive(_system(n), start, tol=rtol, fast_math=True)

    def solve():
        integrator.time = 0.0
        integrator.state[:] = start
        integrator.propagate_until(t1)
        return integrator.state

    return solve().copy(), solve


def sweep(angles, rtol, t1=10.0, method="taylor", threads=None):
    import heyoka

    starts = problems.double_pendulum_starts(angles)
    lanes, threads = heyoka.recommended_simd_size(), threads or os.cpu_count()
    batches = -(-len(starts) // lanes)
    padded = np.resize(starts, (batches * lanes, 8)).reshape(batches, lanes, 8).swapaxes(1, 2)
    ends = np.empty_like(padded)
    integrator = heyoka.taylor_adaptive_batch(_system(2), padded[0].copy(), tol=rtol, fast_math=True)
    copies = [copy.deepcopy(integrator) for _ in range(threads)]

    def work(first):
        integrator = copies[first]
        for index in range(first, batches, threads):
            integrator.set_time(0.0)
            integrator.state[:] = padded[index]
            integrator.propagate_until(t1)
            ends[index] = integrator.state

    def solve():
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, range(threads)))
        return ends.swapaxes(1, 2).reshape(-1, 8)[: len(starts)]

    return solve(), solve


def _system(n):
    """The chain's equations; the tridiagonal system for the multipliers is eliminated from the far end.

    The lengths of the links are not replaced by 1: that is a little faster, but unstable off the constraints (some
    double pendulums of the sweep blow up before 10 s).
    """
    import heyoka

    def variables(letter):
        return heyoka.make_vars(*(f"{letter}{i}" for i in range(n))) if n > 1 else [heyoka.make_vars(f"{letter}0")]

    x, y, u, v = map(variables, "xyuv")

    def links(a):
        return [a[0], *(a[i] - a[i - 1] for i in range(1, n))]

    dx, dy, du, dv = links(x), links(y), links(u), links(v)
    diagonal = [(1.0 if i == 0 else 2.0) * (dx[i] ** 2.0 + dy[i] ** 2.0) for i in range(n)]
    right = [du[i] ** 2.0 + dv[i] ** 2.0 for i in range(n)]
    right[0] += problems.GRAVITY * y[0]
    coupling = [dx[i] * dx[i + 1] + dy[i] * dy[i + 1] for i in range(n - 1)]
    for i in range(n - 2, -1, -1):
        ratio = coupling[i] / diagonal[i + 1]
        diagonal[i] -= ratio * coupling[i]
        right[i] += ratio * right[i + 1]
    pull = [right[0] / diagonal[0]]
    for i in range(1, n):
        pull.append((right[i] + coupling[i - 1] * pull[i - 1]) / diagonal[i])
    fx = [pull[i] * dx[i] for i in range(n)] + [0.0]
    fy = [pull[i] * dy[i] for i in range(n)] + [0.0]
    positions = [equation for i in range(n) for equation in ((x[i], u[i]), (y[i], v[i]))]
    velocities = [
        equation
        for i in range(n)
        for equation in ((u[i], fx[i + 1] - fx[i]), (v[i], fy[i + 1] - fy[i] + problems.GRAVITY))
    ]
    return positions + velocities
