"""Dummy derivatives as the algebraic variables of a system of index 1, for RadauIIA5 and BDF."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk, ellipkinc

import dae_jax
from dae_jax.scenes import SCENES


PENDULUM = SCENES["pendulum"]()
DUMMY = dae_jax.DummyDerivatives()


def solved(system, solver, t1, y0, tolerance, **options):
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    return dae_jax.daesolve(
        system, solver, 0.0, t1, None, y0, formulation=DUMMY, stepsize_controller=controller, max_steps=5000, **options
    )


def test_through_many_switches():
    times = np.linspace(0, 5, 51)
    sol = solved(PENDULUM.system, dae_jax.BDF(), 5.0, PENDULUM.y0, 1e-9, saveat=diffrax.SaveAt(ts=times))
    assert int(sol.stats["switches"]) > 6
    assert PENDULUM.error(times, sol.ys) < 1e-6
    drift = dae_jax.drift(PENDULUM.system, sol)
    assert max(drift.position.max(), drift.velocity.max()) < 1e-11


@pytest.mark.parametrize("solver", [dae_jax.BDF(), dae_jax.RadauIIA5()])
def test_on_the_constraints_at_a_low_tolerance(solver):
    """At a step's end, and between."""
    save = diffrax.SaveAt(ts=np.linspace(0.5, 2, 31), t1=True)
    sol = solved(PENDULUM.system, solver, 2.0, PENDULUM.y0, 1e-3, saveat=save)
    drift = dae_jax.drift(PENDULUM.system, sol)
    assert max(drift.position.max(), drift.velocity.max()) < 1e-13
    assert 1e-6 < PENDULUM.error(sol.ts, sol.ys) < 0.1


def test_order_five():
    def error(step):
        sol = dae_jax.daesolve(PENDULUM.system, dae_jax.RadauIIA5(), 0.0, 0.8, step, PENDULUM.y0, formulation=DUMMY)
        assert int(sol.stats["switches"]) >= 1
        return PENDULUM.error(np.array([0.8]), sol.ys)

    assert np.log2(error(0.04) / error(0.02)) > 4.6


def test_fixed_steps_of_any_size_get_to_round_off():
    """What is left of an equation there has no slope: one in ten sizes ended without convergence."""
    for steps in range(20, 320, 3):
        sol = dae_jax.daesolve(
            PENDULUM.system, dae_jax.RadauIIA5(), 0.0, 0.8, 0.8 / steps, PENDULUM.y0, formulation=DUMMY, throw=False
        )
        assert sol.result == dae_jax.RESULTS.successful, steps


def test_index_five_which_is_beyond_methods_for_the_equations_as_written():
    scene = SCENES["integrators-5"]()
    with pytest.raises(ValueError, match="index up to 2"):
        dae_jax.daesolve(scene.system, dae_jax.BDF(), 0.0, scene.t1, None, scene.y0, formulation=dae_jax.Residual())
    sol = solved(scene.system, dae_jax.BDF(), scene.t1, scene.y0, 1e-9)
    assert scene.error(np.array([scene.t1]), sol.ys) < 1e-8


@pytest.mark.parametrize("solver", [dae_jax.BDF(), dae_jax.RadauIIA5()])
def test_a_jump_off_a_surface_that_a_dummy_derivative_leaves(solver):
    """Released where x is level, thrown back where y = 0.9: there y is found from the constraint."""
    height, m = 0.9, 0.5
    amplitude = np.arcsin(np.sin(np.arccos(height) / 2) / np.sqrt(m))
    fall = (ellipk(m) - ellipkinc(amplitude, m)) / np.sqrt(9.81)
    bounce = dae_jax.Reset(lambda t, y, args, **_: y[0][1] - height, lambda t, y, args: ((y[0], -y[1]), args))
    y0 = (np.array([1.0, 0.0]), np.zeros(2))
    sol = solved(PENDULUM.system, solver, 6 * fall, y0, 1e-8, event=bounce)
    assert sol.stats["jumps"] == 3
    np.testing.assert_allclose(sol.stats["jump_times"][:3], fall * np.array([1, 3, 5]), atol=1e-6)


RATE = 1e6


def stiff(t, y, yd, args):
    """The pendulum (x, y, u, v, λ) and a sensor that follows x at a rate of 10⁶/s."""
    position, velocity, multiplier, sensor = y[:2], y[2:4], y[4], y[5]
    force = jnp.array([0.0, 9.81]) - multiplier * position
    length = (jnp.sum(position**2, keepdims=True) - 1) / 2
    follows = yd[5] + RATE * (sensor - position[0])
    return jnp.concatenate([yd[:2] - velocity, yd[2:4] - force, length, follows[None]])


def test_a_stiff_system_of_index_three():
    """An explicit method would need a million steps."""
    sol = solved(dae_jax.ImplicitDAE(stiff), dae_jax.RadauIIA5(), 2.0, np.array([1.0, 0, 0, 0, 0, 1.0]), 1e-8)
    q, v = PENDULUM.reference(np.array([2.0]))
    assert int(sol.stats["num_steps"]) < 3000
    np.testing.assert_allclose(sol.ys[-1, :4], np.concatenate([q[0], v[0]]), atol=2e-5)
    # Behind by ẋ/rate.
    np.testing.assert_allclose(sol.ys[-1, 5], sol.ys[-1, 0] - sol.ys[-1, 2] / RATE, atol=1e-9)


def test_derivatives_through_a_switch():
    def end(angle, adjoint):
        y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.zeros(2))
        sol = solved(PENDULUM.system, dae_jax.BDF(), 0.8, y0, 1e-9, adjoint=adjoint)
        return sol.ys[0][-1, 0], sol.stats["switches"]

    h = 1e-3
    (low, switches), (high, _) = (end(1.2 + x, diffrax.RecursiveCheckpointAdjoint()) for x in (-h, h))
    assert switches >= 1
    along = lambda a: jax.jvp(lambda a: end(a, diffrax.ForwardMode())[0], (a,), (1.0,))[1]
    forward = jax.jit(along)(1.2)
    np.testing.assert_allclose(forward, (high - low) / (2 * h), rtol=1e-4)
    reverse = jax.grad(lambda a: end(a, diffrax.RecursiveCheckpointAdjoint())[0])(1.2)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


def test_on_the_constraints_whatever_the_unit_of_time():
    """Of index 4: u is given, the next follow by ẏ + sin(y)/4. In a nearest point they are as far off as derivatives are large."""
    unit, chain = 1e-6, [lambda t: jnp.sin(2e6 * t) + jnp.cos(1e6 * t) / 2]
    next_of = lambda y: lambda t: jax.jvp(y, (t,), (jnp.asarray(unit),))[1] + jnp.sin(y(t)) / 4
    for _ in range(3):
        chain.append(next_of(chain[-1]))
    exact = lambda t: jnp.stack([y(t) for y in chain])

    def equations(t, y, yd, args):
        u = chain[0](t)
        return jnp.concatenate([unit * yd[:3] + jnp.sin(y[:3]) / 4 - y[1:], y[:1] + y[:1] ** 3 / 5 - u - u**3 / 5])

    system, start, ts = dae_jax.ImplicitDAE(equations), exact(jnp.asarray(0.0)), unit * jnp.linspace(0, 2, 23)
    sol = solved(system, dae_jax.RadauIIA5(), 2 * unit, start, 1e-6, saveat=diffrax.SaveAt(ts=ts))
    np.testing.assert_allclose(sol.ys[:, :3], jax.vmap(exact)(ts)[:, :3], atol=1e-13)
