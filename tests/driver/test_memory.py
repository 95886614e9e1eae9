"""What a process keeps of the problems that it has solved is bounded."""

import subprocess
import sys

from dae_jax import solve


PROGRAM = """
import gc
import diffrax, jax, jax.numpy as jnp, dae_jax
from dae_jax.driver import program

jax.config.update("jax_enable_x64", True)
program.KEPT = 2
for k in range(7):
    force = lambda t, q, v, args, k=k: jnp.array([0.0, 9.81 + k])
    system = dae_jax.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2)
    sol = dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
    jax.block_until_ready(sol.ys)
    gc.collect()
    print(sum(type(x).__name__ == "JaxprEqn" for x in gc.get_objects()))
"""


def test_problems_are_let_go():
    """With room for two, seven problems leave no more equations of jaxprs behind than four; in a process of their own."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    left = list(map(int, done.stdout.split()))
    assert len(left) == 7
    assert left[1] > left[0] + 100
    assert max(left[4:]) <= 1.1 * max(left[:4])


def test_the_ranks_of_problems_are_forgotten(monkeypatch):
    monkeypatch.setattr(solve, "_of_known_rank", {})
    monkeypatch.setattr(solve, "KEPT", 3)
    for k in range(9):
        solve._remember(k, None)
    assert list(solve._of_known_rank) == [6, 7, 8]
