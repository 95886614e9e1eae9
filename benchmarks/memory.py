"""Memory of a process that solves many different systems: `python -m benchmarks.memory [COUNT]`.

Each system has functions of its own, so that it is traced and compiled by itself. Printed are how many were solved, the memory
of the process, and how much of it is code of our own compiler.
"""

import ctypes
import gc
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp

import dae_jax
from dae_jax.compiler.emit import programs


def resident() -> float:
    """Megabytes of the process, after what is free was given back."""
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def solve(k: int) -> None:
    """A pendulum of its own length, by a method that is compiled quickly."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, 9.81]), lambda t, q, args: (q @ q - (1 + 0.01 * k) ** 2) / 2
    )
    y0 = jnp.array([1 + 0.01 * k, 0.0]), jnp.zeros(2)
    sol = dae_jax.daesolve(system, dae_jax.OrthogonalProjection(diffrax.Euler()), 0.0, 0.1, 0.01, y0)
    jax.block_until_ready(sol.ys)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    print("systems  memory (MB)  programs loaded  their code (MB)")
    for k in range(count + 1):
        if k % 10 == 0:
            loaded = [p for p in programs._programs.values() if p.engine is not None]
            code = sum(p.size + programs.ENGINE for p in loaded) / 1e6
            print(f"{k:7d} {resident():12.0f} {len(loaded):16d} {code:16.1f}", flush=True)
        solve(k)


if __name__ == "__main__":
    main()
