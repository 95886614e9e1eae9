"""Of a solve that fails, or that an event ends, there is no number at the times that it did not reach, and no derivative."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


DECAY = dae_jax.ImplicitDAE(lambda t, y, yd, k: jnp.stack([yd[0] + k * y[0], y[1] - y[0] ** 2]))
TIMES = jnp.array([0.0, 1e-6, 2.0, 3.0])
SAVEATS = {
    "t1": diffrax.SaveAt(t1=True),
    "ts": diffrax.SaveAt(ts=TIMES),
    "ts and t1": diffrax.SaveAt(ts=TIMES, t1=True),
    "of a function": diffrax.SaveAt(ts=TIMES, fn=lambda t, y, args: y + t),
    # Not with a `Reset`.
    "parts": diffrax.SaveAt(subs={"a": diffrax.SubSaveAt(t1=True), "b": diffrax.SubSaveAt(t0=True, ts=TIMES)}),
}
SOLVERS = {"tsit5": diffrax.Tsit5(), "bdf": dae_jax.BDF()}
# How a solve ends before t = 2.
ENDS = {
    "steps": {"max_steps": 8},
    "event": {"event": diffrax.Event(lambda t, y, args, **kwargs: y[0] - 0.9)},
    "too many resets": {
        "event": dae_jax.Reset(lambda t, y, args, **kwargs: y[0] - 0.9, lambda t, y, args: (y.at[0].set(1.0), args), False, max_resets=2)
    },
}  # fmt: skip
REACHED = {
    "t1": [0],
    "ts": [1, 1, 0, 0],
    "ts and t1": [1, 1, 0, 0, 0],
    "of a function": [1, 1, 0, 0],
    "parts": [0, 1, 1, 1, 0, 0],
}


def saved(solver, saveat, end):
    """All rows that are saved, as a function of k."""

    def rows(k):
        sol = dae_jax.daesolve(
            DECAY, solver, 0.0, 3.0, None, jnp.array([1.0, 1.0]), k, saveat=SAVEATS[saveat], throw=False, **ENDS[end]
        )
        return jnp.concatenate(jax.tree.leaves(sol.ys)), jnp.concatenate(jax.tree.leaves(sol.ts))

    return rows


@pytest.mark.parametrize(
    ("saveat", "end"), [(s, e) for s in SAVEATS for e in ENDS if (s, e) != ("parts", "too many resets")]
)
@pytest.mark.parametrize("by", SOLVERS)
def test_where_there_is_no_number_there_is_no_derivative(by, saveat, end):
    rows = saved(SOLVERS[by], saveat, end)
    reached = np.array(REACHED[saveat], bool)
    if end == "event":
        # Its last row is that of the event, and stands after the times that were reached.
        reached = {"t1": [1], "ts and t1": [1, 1, 1, 0, 0], "parts": [1, 1, 1, 1, 0, 0]}.get(saveat, reached)
        reached = np.array(reached, bool)
    (ys, ts), (forward, _) = jax.jvp(rows, (0.5,), (1.0,))
    np.testing.assert_array_equal(np.isfinite(ts), reached)
    np.testing.assert_array_equal(np.isfinite(ys), np.stack([reached] * 2, 1))
    np.testing.assert_array_equal(np.isfinite(forward), np.isfinite(ys))
    known = jnp.where(np.isfinite(ys), 1.0, 0.0)
    (_, pull_back) = jax.vjp(lambda k: rows(k)[0], 0.5)
    (of_known,), (of_all,) = pull_back(known), pull_back(jnp.ones_like(known))
    np.testing.assert_allclose(of_known, jnp.sum(jnp.where(known > 0, forward, 0)), rtol=1e-6, atol=1e-9)
    assert np.isfinite(of_all) == reached.all()


def test_a_lane_that_fails_leaves_the_derivatives_of_others_alone():
    def end(k):
        sol = dae_jax.daesolve(
            DECAY, dae_jax.RadauIIA5(), 0.0, 3.0, None, jnp.array([1.0, 1.0]), k, throw=False, max_steps=20
        )
        return sol.ys[0, 0]

    loss = lambda k: jnp.sum(jnp.where(jnp.isfinite(ends := jax.vmap(end)(k)), ends, 0))
    rates = jnp.array([1e-3, 1e4, 1e-2])
    ends = jax.vmap(end)(rates)
    np.testing.assert_array_equal(np.isfinite(ends), [True, False, True])
    np.testing.assert_allclose(jax.grad(loss)(rates), [-3 * np.exp(-3e-3), 0, -3 * np.exp(-3e-2)], rtol=1e-6)


def test_the_end_of_a_solve_that_fails_is_in_the_solution_still():
    sol = dae_jax.daesolve(DECAY, dae_jax.BDF(), 0.0, 3.0, None, jnp.array([1.0, 1.0]), 0.5, throw=False, max_steps=12)
    t, y = sol.end
    assert 0 < t < 2
    np.testing.assert_allclose(y, [np.exp(-0.5 * t), np.exp(-t)], rtol=1e-5)
    steps = dae_jax.daesolve(
        DECAY, dae_jax.BDF(), 0.0, 3.0, None, jnp.array([1.0, 1.0]), 0.5, throw=False, max_steps=12,
        saveat=diffrax.SaveAt(steps=True),
    )  # fmt: skip
    assert steps.ts[np.isfinite(steps.ts)][-1] == t
