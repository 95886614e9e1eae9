"""What a process keeps of the problems that it has solved is bounded."""

import gc

import diffrax
import jax
import jax.numpy as jnp

import dae_jax
from dae_jax import program, solve


def traced():
    """How many equations of jaxprs there are in the process."""
    gc.collect()
    return sum(type(x).__name__ == "JaxprEqn" for x in gc.get_objects())


def test_problems_are_let_go(monkeypatch):
    """With room for two, six problems leave no more behind than three."""
    monkeypatch.setattr(program, "KEPT", 2)
    monkeypatch.setattr(program, "_traced", [])
    jax.clear_caches()
    before, left = traced(), []
    for k in range(6):
        force = lambda t, q, v, args, k=k: jnp.array([0.0, 9.81 + k])
        system = dae_jax.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2)
        sol = dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
        jax.block_until_ready(sol.ys)
        left.append(traced() - before)
    assert left[0] > 100
    assert max(left[3:]) <= 1.1 * max(left[:3])


def test_the_ranks_of_problems_are_forgotten(monkeypatch):
    monkeypatch.setattr(solve, "_ranks", {})
    monkeypatch.setattr(solve, "KEPT", 3)
    for k in range(9):
        solve._remember(k, None)
    assert list(solve._ranks) == [6, 7, 8]
