"""RadauIIA9, RadauIIA13 and Radau, which chooses: what more stages change. What they share with RadauIIA5 is tested there."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import SCENES


NINE, THIRTEEN, ANY = dae_jax.RadauIIA9(), dae_jax.RadauIIA13(), dae_jax.Radau()
BOTH = pytest.mark.parametrize("solver", [NINE, THIRTEEN], ids=["9", "13"])


def fixed(system, solver, t1, steps, y0):
    return dae_jax.daesolve(
        system, solver, 0.0, t1, t1 / steps, y0, stepsize_controller=diffrax.ConstantStepSize(), max_steps=1000
    ).ys  # fmt: skip


def adaptive(system, solver, t1, y0, rtol=1e-8, atol=None, args=None, **options):
    control = diffrax.PIDController(rtol=rtol, atol=rtol if atol is None else atol)
    return dae_jax.daesolve(system, solver, 0.0, t1, None, y0, args, stepsize_controller=control, **options)


@BOTH
def test_steps_grow_where_equations_are_nonlinear_in_the_rates(solver):
    """Beyond the reach of the last step's polynomial Newton's method starts from what rates were, not from rates of 0."""
    right = lambda t: jnp.cos(t) ** 3 + jnp.cos(t) + 3 * jnp.sin(t)
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd**3 + yd + 3 * y - right(t))
    sol = adaptive(system, solver, 2.0, jnp.zeros(1))
    np.testing.assert_allclose(sol.ys[0], np.sin([2.0]), rtol=1e-7)
    assert sol.stats["num_rejected_steps"] <= 2
    assert sol.stats["num_steps"] < 40


OSCILLATORS = {
    "ODE": lambda t, y, yd, args: jnp.stack([yd[0] - y[1], yd[1] + y[0]]),
    "index 1": lambda t, y, yd, args: jnp.stack([yd[0] - y[2], yd[1] + y[0], y[2] - y[1]]),
}


@pytest.mark.parametrize(("solver", "kind"), [(NINE, "index 1"), (THIRTEEN, "ODE"), (THIRTEEN, "index 1")])
def test_order_on_an_ode_and_on_index_one(solver, kind):
    system, end = dae_jax.ImplicitDAE(OSCILLATORS[kind]), 24.0
    exact = np.array([np.sin(end), np.cos(end), np.cos(end)])
    start = jnp.array([0.0, 1.0, 1.0])

    def error(steps):
        y0 = start[: 2 if kind == "ODE" else 3]
        return np.abs(np.asarray(fixed(system, solver, end, steps, y0))[-1] - exact[: len(y0)]).max()

    coarse, fine = {5: (20, 30), 7: (9, 13)}[solver.stages]
    slope = np.log(error(coarse) / error(fine)) / np.log(fine / coarse)
    order = solver.order(None)
    assert order - 0.5 < slope < order + 1


@BOTH
def test_algebraic_variables_of_index_two_have_the_order_of_the_stages(solver):
    scene = SCENES["hessenberg-2"]()
    exact = [x[0] for x in scene.reference(np.array([scene.t1]))]

    def error(steps):
        x, z = fixed(scene.system, solver, scene.t1, steps, scene.y0)
        return [np.abs(np.asarray(found)[-1] - known).max() for found, known in zip((x, z), exact, strict=True)]

    coarse, fine = {5: (4, 8), 7: (3, 4)}[solver.stages]
    far, near = error(coarse), error(fine)
    assert np.log(far[1] / near[1]) / np.log(fine / coarse) > solver.stages - 0.35
    # The differential ones superconverge.
    assert near[0] < 1e-13 + 1e-3 * near[1]


@pytest.mark.parametrize("solver", [THIRTEEN, ANY], ids=["13", "variable"])
def test_fewer_steps_at_tight_tolerances(solver):
    """RadauIIA5 takes 3875, RadauIIA9 513."""
    scene = SCENES["robertson"]()
    sol = adaptive(scene.system, solver, scene.t1, scene.y0, 1e-10, 1e-10 * scene.scale)
    assert sol.stats["num_steps"] < 280
    assert scene.error(np.array([scene.t1]), sol.ys) < 1e-11


@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
@pytest.mark.parametrize("solver", [NINE, THIRTEEN, ANY], ids=["9", "13", "variable"])
def test_newton_contracts_in_its_own_norm_at_index_two(solver, rtol):
    """Judged by the algebraic variable, whose corrections are those of the others divided by h, it was given up for ever."""
    scene = SCENES["hessenberg-2"]()
    sol = adaptive(scene.system, solver, scene.t1, scene.y0, rtol)
    assert sol.stats["num_steps"] < 100
    assert scene.error(np.array([scene.t1]), sol.ys) < 10 * rtol


def test_failures_of_newton_are_not_every_other_step():
    """By 13th order it needs small steps: 749 steps, a third of them in vain, where the step grew back at once."""
    scene = SCENES["pendulum"]()
    stats = adaptive(scene.system, THIRTEEN, scene.t1, scene.y0, 1e-8).stats
    assert stats["num_rejected_steps"] < stats["num_steps"] / 4


class TestTheOrderIsChosen:
    """By the contraction of Newton's method."""

    def test_low_where_it_is_hard_and_high_where_it_is_smooth(self):
        scene = SCENES["pendulum"]()
        steps = lambda rtol, solver: adaptive(scene.system, solver, scene.t1, scene.y0, rtol).stats["num_steps"]
        assert steps(1e-4, ANY) < 1.1 * steps(1e-4, dae_jax.RadauIIA5())
        assert steps(1e-9, ANY) < steps(1e-9, dae_jax.RadauIIA5()) / 3

    def test_errors_follow_the_tolerance(self):
        scene = SCENES["akzo-nobel"]()
        for rtol in (1e-4, 1e-7, 1e-10):
            sol = adaptive(scene.system, ANY, scene.t1, scene.y0, rtol, rtol * scene.scale)
            assert scene.error(np.array([scene.t1]), sol.ys) < 30 * rtol

    def test_it_falls_where_a_source_jumps(self):
        """ẏ = −1000 (y − s) with a jump of s: steps over it are of the implicit Euler method."""
        residual = lambda t, y, yd, a: yd + 1000 * (y - jnp.where(t < 0.5, 1.0, 2.0))
        sol = adaptive(dae_jax.ImplicitDAE(residual), ANY, 1.0, jnp.ones(1), 1e-6)
        np.testing.assert_allclose(sol.ys[-1], 2.0, rtol=1e-5)


def test_the_stabilised_form_keeps_both_levels():
    scene = SCENES["pendulum"]()
    sol = adaptive(scene.system, THIRTEEN, 20.0, scene.y0, 1e-10, saveat=diffrax.SaveAt(steps=True))
    off, taken = dae_jax.drift(scene.system, sol), np.isfinite(sol.ts)
    assert max(off.position[taken].max(), off.velocity[taken].max()) < 1e-11


@pytest.mark.parametrize(
    ("solver", "residual"),
    [
        (NINE, lambda t, y, yd, args: [yd[0] + y[0], y[1] - 20 * jnp.cos(20 * t)]),
        (THIRTEEN, lambda t, y, yd, args: [yd[0] - y[1] + 20 * jnp.cos(20 * t), y[0] - jnp.exp(-t)]),
        (ANY, lambda t, y, yd, args: [yd[0] - y[1] + 20 * jnp.cos(20 * t), y[0] - jnp.exp(-t)]),
    ],
    ids=["9, index 1", "13, index 2", "variable, index 2"],
)
def test_between_steps_errors_follow_the_tolerance(solver, residual):
    times = np.linspace(0, 2, 301)
    z = 20 * np.cos(20 * times) - (np.exp(-times) if solver is not NINE else 0)
    start = jnp.array([1.0, z[0]])
    sol = adaptive(dae_jax.ImplicitDAE(residual), solver, 2.0, start, saveat=diffrax.SaveAt(ts=times))
    np.testing.assert_allclose(sol.ys[:, 0], np.exp(-times), atol=3e-7)
    np.testing.assert_allclose(sol.ys[:, 1], z, atol=20 * 3e-7)
    assert sol.stats["num_steps"] < 150


def reaction(k):
    """Robertson's, with its conservation of mass."""
    f = lambda t, x, z, k: jnp.stack(
        [-k[0] * x[0] + k[1] * x[1] * z[0], k[0] * x[0] - k[1] * x[1] * z[0] - k[2] * x[1] ** 2]
    )
    system = dae_jax.SemiExplicitDAE(f, lambda t, x, z, k: jnp.stack([x[0] + x[1] + z[0] - 1]))
    return system, (jnp.array([1.0, 0.0]), jnp.zeros(1)), jnp.array([0.04, 1e4, 3e7]) * k


@pytest.mark.parametrize("solver", [NINE, ANY], ids=["9", "variable"])
def test_gradients_and_a_batch(solver):
    def end(k, adjoint):
        system, y0, rates = reaction(k)
        return adaptive(system, solver, 40.0, y0, 1e-9, 1e-13, rates, adjoint=adjoint, max_steps=1000).ys[1][-1, 0]

    reverse, forward = diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode()
    k, along, h = jnp.array([1.0, 1.1, 0.9]), jnp.array([0.3, -0.5, 1.0]), 1e-4
    batch = jax.vmap(lambda k: end(k, reverse))(jnp.stack([k, k + h * along, k - h * along]))
    value, change = jax.jvp(lambda k: end(k, forward), (k,), (along,))
    np.testing.assert_allclose(batch[0], value, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(lambda k: end(k, reverse))(k) @ along, change, rtol=1e-8)
    np.testing.assert_allclose(change, (batch[1] - batch[2]) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize("solver", [THIRTEEN, ANY], ids=["13", "variable"])
def test_float32_and_backwards(solver):
    """ẏ = z, 0 = z + y: y = e^(1 − t)."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z + x)
    start = (jnp.ones(1, jnp.float32), -jnp.ones(1, jnp.float32))
    sol = dae_jax.daesolve(
        system, solver, 1.0, 0.0, None, start, saveat=diffrax.SaveAt(ts=jnp.array([0.6, 0.0])),
        stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-4),
    )  # fmt: skip
    assert sol.ys[0].dtype == jnp.float32
    np.testing.assert_allclose(sol.ys[0][:, 0], np.exp([0.4, 1.0]), rtol=3e-4)


def test_a_solution_that_blows_up_is_named():
    sol = adaptive(dae_jax.ImplicitDAE(lambda t, y, yd, a: yd - y**2), THIRTEEN, 2.0, jnp.ones(1), throw=False)
    assert sol.result == dae_jax.RESULTS.error_too_large
