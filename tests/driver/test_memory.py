"""What a process keeps of the problems that it has solved is bounded."""

import subprocess
import sys


PROGRAM = """
import gc
import diffrax, jax, jax.numpy as jnp, dae_jax
from dae_jax import solve
from dae_jax.driver import program

jax.config.update("jax_enable_x64", True)
program.KEPT = solve.KEPT = 2

def solved(k, constraint):
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, 9.81 + k]), constraint)
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)
    jax.block_until_ready(dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, y0).ys)

for k in range(7):
    solved(k, lambda t, q, args: (q @ q - 1) / 2)
    gc.collect()
    print(sum(type(x).__name__ == "JaxprEqn" for x in gc.get_objects()), end=" ")
print()
for k in range(4):
    solved(k, lambda t, q, args: jnp.stack([q @ q - 1, 1 - q @ q]))
    print(len(solve._of_known_rank), end=" ")
"""


def test_problems_are_let_go():
    """With room for two, seven problems leave no more equations of jaxprs behind than four, and the rank of the
    constraints of two; in a process of their own.
    """
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    left, ranks = (list(map(int, line.split())) for line in done.stdout.splitlines())
    assert len(left) == 7
    assert left[1] > left[0] + 100
    assert max(left[4:]) <= 1.1 * max(left[:4])
    assert ranks == [1, 2, 2, 2]
