"""What a solution gives back at times that are no ordinary ones, and outside of the process that made it."""

import copy
import pickle

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import pendulum


SCENE = pendulum()
PROJECTED = dae_jax.OrthogonalProjection(diffrax.Tsit5())


def solve(solver=PROJECTED, t1=1.0, dt0=0.01, **options):
    return dae_jax.daesolve(SCENE.system, solver, 0.0, t1, dt0, SCENE.y0, **options)


@pytest.mark.parametrize(
    ("solver", "dt0"),
    [(PROJECTED, 0.01), (dae_jax.RadauIIA5(), None), (dae_jax.BDF(), None)],
    ids=["fixed", "radau", "bdf"],
)
def test_an_interval_of_no_length_gives_the_start(solver, dt0):
    sol = solve(solver, 0.0, dt0)
    assert sol.result == dae_jax.RESULTS.successful
    for found, start in zip(sol.ys, SCENE.y0, strict=True):
        np.testing.assert_array_equal(found, [start])


def test_a_time_that_is_asked_for_twice_is_saved_twice():
    sol = solve(saveat=diffrax.SaveAt(t0=True, ts=np.array([0.0, 0.5, 0.5, 1.0]), t1=True))
    np.testing.assert_array_equal(sol.ts, [0.0, 0.0, 0.5, 0.5, 1.0, 1.0])
    for x in sol.ys:
        np.testing.assert_allclose(x[::2], x[1::2], atol=1e-15)
    exact = SCENE.reference(np.asarray(sol.ts))
    np.testing.assert_allclose(sol.ys[0], exact[0], atol=1e-7)


def test_dense_output_anywhere_in_any_way():
    """Increments, batches, the steps themselves; nothing outside."""
    sol = solve(saveat=diffrax.SaveAt(dense=True, steps=True))
    taken = jnp.isfinite(sol.ts)
    q, v = jax.vmap(sol.evaluate)(sol.ts[taken])
    np.testing.assert_allclose(q, sol.ys[0][taken], atol=1e-13)
    np.testing.assert_allclose(v, sol.ys[1][taken], atol=1e-12)
    increment, both = sol.evaluate(0.2, 0.4), (sol.evaluate(0.2), sol.evaluate(0.4))
    for change, before, after in zip(increment, *both, strict=True):
        np.testing.assert_allclose(change, after - before, atol=1e-14)
    assert jnp.isnan(sol.evaluate(1.5)[0]).all()


def test_dense_output_and_no_saved_states():
    sol = solve(saveat=diffrax.SaveAt(dense=True))
    assert sol.ys is None
    np.testing.assert_allclose(sol.evaluate(0.5)[0], SCENE.reference(np.array([0.5]))[0][0], atol=1e-7)


@pytest.mark.parametrize("way", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy], ids=["pickle", "deepcopy"])
def test_a_solution_can_be_copied(way):
    sol = solve(saveat=diffrax.SaveAt(ts=np.linspace(0, 1, 5)))
    again = way(sol)
    for a, b in zip((again.ts, *again.ys), (sol.ts, *sol.ys), strict=True):
        np.testing.assert_array_equal(a, b)
    assert again.result == dae_jax.RESULTS.successful
    np.testing.assert_array_equal(
        dae_jax.drift(SCENE.system, again).position, dae_jax.drift(SCENE.system, sol).position
    )


TO_RETURN = {
    "projection": (PROJECTED, None),
    "tangent space": (dae_jax.TangentSpace(diffrax.Tsit5()), None),
    "dummy derivatives": (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
    "BDF": (dae_jax.BDF(), None),
}


@pytest.mark.parametrize("name", TO_RETURN)
def test_dense_output_may_be_returned_to_jit_and_vmap_and_handed_to_them(name):
    """With functions in it: those of the system, and one in `args`."""
    solver, formulation = TO_RETURN[name]
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: args[0](args[1]), SCENE.system.constraint)
    force = lambda g: jnp.stack([0 * g, g])

    def solve(g):
        return dae_jax.daesolve(
            system, solver, 0.0, 1.0, None, SCENE.y0, (force, g), formulation=formulation,
            saveat=diffrax.SaveAt(dense=True),
        )  # fmt: skip

    expected = solve(9.81).evaluate(0.5)[0]
    one, both = jax.jit(solve)(9.81), jax.vmap(solve)(jnp.array([9.81, 3.0]))
    np.testing.assert_array_equal(one.args[0](2.0), force(2.0))
    at = jax.jit(lambda sol, t: sol.evaluate(t)[0])
    np.testing.assert_allclose(at(one, 0.5), expected, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(lambda sol: sol.evaluate(0.5)[0])(both)[0], expected, atol=1e-7)
