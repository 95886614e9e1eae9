"""Resets from which no solve goes on say so, and when."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


ROOT = dae_jax.SemiExplicitDAE(lambda t, x, z, a: jnp.ones(1), lambda t, x, z, a: z**2 - a)
ROD = dae_jax.ConstrainedSystem(lambda t, q, v, a: jnp.array([0.0, -9.81]), lambda t, q, a: q @ q - a)
# z² = −1, and a rod whose length squared is −1.
NONE = dae_jax.Reset(lambda t, y, a, **_: t - 0.25, lambda t, y, a: (y, -a))
CASES = [
    (ROOT, dae_jax.RadauIIA5(), (jnp.zeros(1), jnp.ones(1))),
    (ROD, dae_jax.OrthogonalProjection(diffrax.Tsit5()), (jnp.array([1.0, 0.0]), jnp.zeros(2))),
]


@pytest.mark.parametrize(("system", "solver", "start"), CASES, ids=["equations", "mechanism"])
def test_a_state_that_cannot_be_made_consistent_is_not_said_to_be_the_initial_one(system, solver, start):
    solve = lambda start, **options: dae_jax.daesolve(
        system,
        solver,
        0.0,
        1.0,
        None,
        start,
        1.0,
        event=NONE,
        saveat=diffrax.SaveAt(ts=np.linspace(0, 1, 5)),
        **options,
    )
    with pytest.raises(RuntimeError, match=r"^The state after a reset cannot .* ended at t = 0\.25 after") as refusal:
        solve(start)
    assert "initial state" not in str(refusal.value)
    with pytest.raises(Exception, match=r"The state after a reset cannot be made consistent"):
        jax.jit(lambda start: solve(start).ys)(start)
    sol = solve(start, throw=False)
    assert sol.result == dae_jax.RESULTS.inconsistent_reset
    # The solve ends with the state before the reset.
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(sol.end))
    np.testing.assert_array_equal(np.isfinite(sol.ts), np.arange(5) < 2)
