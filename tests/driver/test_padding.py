"""Saved times that are padding, of steps, of solves that ended early, change no diagnostic."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import plotting, reductions
from dae_jax.scenes import pendulum


SCENE = pendulum()
PROJECTED = dae_jax.OrthogonalProjection(diffrax.Tsit5())
TIMES = np.linspace(0.0, 1.0, 11)
# Half a metre above the lowest point: before the end.
LOW = diffrax.Event(lambda t, y, args, **_: y[0][1] - 0.5)


def solve(solver=diffrax.Tsit5(), **options):  # noqa: B008
    return dae_jax.daesolve(SCENE.system, solver, 0.0, 1.0, None, SCENE.y0, SCENE.args, **options)


CASES = {
    "steps": {"saveat": diffrax.SaveAt(t0=True, steps=True)},
    "event": {"saveat": diffrax.SaveAt(ts=TIMES), "event": LOW},
    "failed": {"saveat": diffrax.SaveAt(ts=TIMES), "max_steps": 12, "throw": False},
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("batched", [False, True], ids=["alone", "vmap"])
def test_padding_is_the_last_value(name, batched):
    if batched:
        # Times and states of a batch of one: under `vmap` of the solve, and of a batch of solutions.
        run = jax.vmap(lambda a: solve_at(a, **CASES[name]))
        many = run(jnp.zeros(1))
        one = lambda x: jax.tree.map(lambda x: x[0], x)
    else:
        many, one = solve(**CASES[name]), lambda x: x
    sol = one(many)
    saved = int(np.isfinite(sol.ts).sum())
    assert 0 < saved < len(sol.ts)
    for diagnostic in (dae_jax.drift, dae_jax.energy, dae_jax.multipliers):
        found = one(diagnostic(SCENE.system, many))
        exact = at_each(diagnostic, sol, saved)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
            np.testing.assert_allclose(a[:saved], b, rtol=1e-12, atol=1e-14)
            np.testing.assert_array_equal(a[saved:], np.broadcast_to(a[saved - 1], a[saved:].shape))
    for a, b in zip(jax.tree.leaves(one(many.final)), jax.tree.leaves(sol.ys), strict=True):
        np.testing.assert_array_equal(a, b[saved - 1])
    largest = np.inf if name == "failed" else max(x.max() for x in dae_jax.drift(SCENE.system, sol))
    assert reductions.largest_drift(SCENE.system, sol) == largest
    assert np.isfinite(reductions.energy_error(SCENE.system, sol)) == (name != "failed")


def solve_at(shift, **options):
    y0 = (jnp.asarray(SCENE.y0[0]) + 0 * shift, jnp.asarray(SCENE.y0[1]))
    return dae_jax.daesolve(SCENE.system, diffrax.Tsit5(), 0.0, 1.0, None, y0, SCENE.args, **options)


def at_each(diagnostic, sol, saved):
    """The diagnostic of a solution that has the saved times only."""
    import dataclasses

    cut = dataclasses.replace(sol, ts=sol.ts[:saved], ys=jax.tree.map(lambda y: y[:saved], sol.ys))
    return diagnostic(SCENE.system, cut)


def test_a_batch_of_solutions_is_each_of_them():
    def run(k):
        system = dae_jax.ConstrainedSystem(lambda t, q, v, k: jnp.stack([0 * k, k]), SCENE.system.constraint)
        return system, dae_jax.daesolve(
            system, diffrax.Tsit5(), 0.0, 1.0, None, SCENE.y0, k, saveat=CASES["steps"]["saveat"]
        )

    forces = jnp.array([1.0, 9.81])
    together = jax.vmap(lambda k: run(k)[1])(forces)
    found = dae_jax.multipliers(run(1.0)[0], together)
    for i, k in enumerate(forces):
        system, alone = run(k)
        lane = jax.tree.map(lambda x: x[i], together)  # noqa: B023
        np.testing.assert_allclose(found[i], dae_jax.multipliers(system, lane), rtol=1e-12)
        # Round-off of an error makes steps longer or shorter.
        np.testing.assert_allclose(lane.final[0], alone.final[0], rtol=1e-8)


def test_largest_error_is_over_the_saved_times_and_infinite_for_a_failure():
    ended = solve(**CASES["event"])
    reference = SCENE.reference(TIMES)
    assert reductions.largest_error(ended, reference) < 1e-6
    assert np.isinf(reductions.largest_error(solve(**CASES["failed"]), reference))


def test_padding_has_no_derivative():
    def loss(g):
        system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), SCENE.system.constraint)
        sol = dae_jax.daesolve(
            system, PROJECTED, 0.0, 1.0, None, SCENE.y0, g, saveat=diffrax.SaveAt(steps=True), adjoint=diffrax.ForwardMode()
        )  # fmt: skip
        return dae_jax.multipliers(system, sol)[-1, 0]

    tangent = jax.jvp(loss, (9.81,), (1.0,))[1]
    h = 1e-5
    np.testing.assert_allclose(tangent, (loss(9.81 + h) - loss(9.81 - h)) / (2 * h), rtol=1e-4)


def test_pictures_leave_padding_out():
    sol = solve(saveat=diffrax.SaveAt(t0=True, steps=True))
    saved = np.isfinite(sol.ts)
    times, path = np.asarray(sol.ts), np.asarray(sol.ys[0])
    drift = np.asarray(dae_jax.drift(SCENE.system, sol).position)
    for figure in (
        plotting.trajectory(times, path, 0.5),
        plotting.drift_growth({"Tsit5": (times, drift)}),
        plotting.drift({"Tsit5": (times, drift)}),
        plotting.energy({"Tsit5": (times, np.asarray(dae_jax.energy(SCENE.system, sol)))}),
    ):
        figure.canvas.draw()
        for line in figure.axes[0].lines:
            assert np.isfinite(line.get_xdata()).all()
            assert len(line.get_xdata()) <= saved.sum()
        assert not any("inf" in text.get_text() for legend in figure.legends for text in legend.get_texts())


@pytest.mark.parametrize("beyond", ["end", "start"])
def test_a_time_beyond_the_ends_is_no_padding(beyond):
    """By one unit in the last place, where it is traced: nothing was saved there."""
    t1 = 1.2e-6
    last = 1200 * 1e-9 if beyond == "end" else -1e-22
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -z, lambda t, x, z, args: z - x)

    def solve(ts):
        sol = dae_jax.daesolve(
            system,
            diffrax.Tsit5(),
            0.0,
            t1,
            None,
            (jnp.ones(1), jnp.ones(1)),
            saveat=diffrax.SaveAt(ts=ts),
            throw=False,
        )
        return sol.result == dae_jax.RESULTS.times_outside, sol.result == dae_jax.RESULTS.successful

    assert t1 < 1200 * 1e-9
    ts = jnp.sort(jnp.array([6e-7, last]))
    assert jax.jit(solve)(ts) == (True, False)
    assert jax.jit(solve)(jnp.array([0.0, t1])) == (False, True)


def test_a_time_that_is_out_of_order_or_before_the_start_has_no_state():
    """With `throw=False`, and traced: else what is extrapolated passes for a state."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -z, lambda t, x, z, args: z - x)

    def solve(ts):
        return dae_jax.daesolve(
            system, diffrax.Tsit5(), 0.0, 1.0, None, (jnp.ones(1), jnp.ones(1)), saveat=diffrax.SaveAt(ts=ts), throw=False
        )  # fmt: skip

    for ts in ([0.0, 0.5, 0.49, 1.0], [0.0, 0.3, -0.01, 1.0]):
        sol = jax.jit(solve)(jnp.array(ts))
        assert sol.result == dae_jax.RESULTS.times_outside
        assert jnp.isnan(sol.ys[0][:, 0]).tolist() == [False, False, True, False]
    known = jnp.array([0.0, 0.5, 0.49, 1.0])
    with pytest.raises(ValueError, match="in the order"):
        jax.jit(lambda x: solve(known).ys[0] * x)(1.0)
