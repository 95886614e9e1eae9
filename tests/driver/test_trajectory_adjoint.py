"""The reverse derivative from the trajectory is that of diffrax's checkpoints."""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import equations
from dae_jax.driver.trajectory_adjoint import LARGEST_OF_LARGE, has_trajectory_adjoint
from dae_jax.scenes import chain, pendulum


SCENE = pendulum()
SAVEATS = {
    "t1": lambda x: diffrax.SaveAt(t1=True),
    "t0, ts, t1": lambda x: diffrax.SaveAt(t0=True, t1=True, ts=jnp.linspace(0.0, 0.9, 7) * x),
    "ts, fn": lambda x: diffrax.SaveAt(ts=jnp.array([0.3, 0.31, 0.8]) * x, fn=lambda t, y, args: {"e": y[0] * args}),
}


def loss(x, saveat, solver, dt0, t0=0.1, t1=1.0, form=None, **options):
    """Of the angle of the start, gravity, both times, and factors on the times saved at and on the size of fixed steps."""
    angle, gravity, start, end, factor, size = x
    dt0 = None if dt0 is None else size * dt0
    system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), SCENE.system.constraint)
    y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.stack([jnp.cos(angle), -jnp.sin(angle)]))
    sol = dae_jax.daesolve(
        system, solver, start * t0, end * t1, dt0, y0, gravity, saveat=SAVEATS[saveat](factor), max_steps=1000, throw=False,
        formulation=form, **options,
    )  # fmt: skip
    leaves = [jnp.sum(jnp.sin(3 * leaf)) for leaf in jax.tree.leaves((sol.ys, sol.ts, sol.t1))]
    return sum(leaves)


STEPS = {"adaptive": None, "fixed": 0.05, "backwards": -0.05}
SOLVERS = {
    "Tsit5": diffrax.Tsit5(),
    "projection": dae_jax.OrthogonalProjection(dae_jax.DOP853()),
    "tangent": dae_jax.TangentSpace(diffrax.Tsit5()),
    "radau": dae_jax.RadauIIA5(),
    "bdf": dae_jax.BDF(),
    "selected states": diffrax.Tsit5(),
}
# Each solver, each kind of step and each kind of output.
CASES = [("Tsit5", "t1", "backwards"), ("projection", "t0, ts, t1", "adaptive"), ("tangent", "ts, fn", "fixed")]
CASES += [("radau", "t0, ts, t1", "adaptive"), ("bdf", "t1", "backwards"), ("selected states", "t1", "fixed")]


# Its checkpoints take XLA as long to compile as all else here together; its forward derivatives are the same.
BACKWARDS_BY_DIFFRAX = ("Tsit5", "radau")


@pytest.mark.parametrize(("name", "saveat", "steps"), CASES)
def test_equals_diffrax_with_respect_to_everything(name, saveat, steps):
    dt0 = STEPS[steps]
    times = (1.0, 0.1) if steps == "backwards" else (0.0, 1.0)
    x = jnp.array([1.2, 9.81, 1.0, 1.0, 1.0, 1.0])
    form = dae_jax.DummyDerivatives() if name == "selected states" else None
    solver = SOLVERS[name]
    # The trajectory's steps are those of a derivative: equal up to the tolerance.
    tight = {"stepsize_controller": diffrax.PIDController(1e-11, 1e-11)} if steps == "adaptive" else {}
    of = lambda x, **options: loss(x, saveat, solver, dt0, *times, form, **tight, **options)
    inputs = jax.grad(of)(x)
    if name in BACKWARDS_BY_DIFFRAX:
        with dae_jax.configure(one_kernel=False):
            expected = jax.grad(of)(x)
    else:
        expected = jax.jacfwd(lambda x: of(x, adjoint=diffrax.ForwardMode()))(x)
    assert np.abs(expected).max() > 0.1
    assert (expected[-1] != 0) == (dt0 is not None)
    # For steps of sizes of their own, diffrax lets the start of the interval move all of them; so does ours.
    np.testing.assert_allclose(inputs, expected, rtol=1e-8, atol=1e-9)


def test_is_used_where_it_should_be():
    solve = dae_jax.driver.program.Solve(
        dae_jax.Differentiation(), dae_jax.DOP853(), diffrax.SaveAt(t1=True), diffrax.PIDController(1e-6, 1e-6),
        diffrax.RecursiveCheckpointAdjoint(), None, diffrax.NoProgressMeter(), 1000,
    )  # fmt: skip
    assert has_trajectory_adjoint(solve, 4)
    assert not has_trajectory_adjoint(solve, LARGEST_OF_LARGE // 1000)
    for name, value in {
        "saveat": diffrax.SaveAt(dense=True),
        "solver": diffrax.Kvaerno5(),
        "max_steps": None,
    }.items():
        assert not has_trajectory_adjoint(dataclasses.replace(solve, **{name: value}), 4)
    ended = dataclasses.replace(solve, event=diffrax.Event(lambda t, y, args, **kwargs: y[0]))
    assert has_trajectory_adjoint(ended, 4)
    assert not has_trajectory_adjoint(dataclasses.replace(ended, controller=diffrax.ConstantStepSize()), 4)


def test_gradient_of_a_long_chain_is_right():
    scene = chain(12)

    def end(gravity):
        system = dae_jax.ConstrainedSystem(
            lambda t, q, v, g: jnp.tile(jnp.stack([0 * g, g]), 12), scene.system.constraint
        )
        sol = dae_jax.daesolve(system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 0.2, 0.02, scene.y0, gravity)
        return jnp.sum(sol.ys[0] ** 2)

    h = 1e-4
    central = (end(9.81 + h) - end(9.81 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(end)(9.81), central, rtol=1e-7)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF(), dae_jax.OrthogonalProjection(dae_jax.DOP853())])
@pytest.mark.parametrize("direction", [1, -1])
def test_what_was_saved_before_a_solve_failed_has_its_derivative(solver, direction):
    """ẋ = −a x, and from |t| = ½ on no number."""
    rate = lambda t, x, z, a: jnp.where(jnp.abs(t) > 0.5, jnp.nan, -a * x)
    system = dae_jax.SemiExplicitDAE(rate, lambda t, x, z, a: z - x)
    times = direction * jnp.array([0.2, 0.4, 0.8])

    def reached(a):
        saveat = diffrax.SaveAt(ts=times)
        y0 = jnp.ones(1), jnp.ones(1)
        sol = dae_jax.daesolve(system, solver, 0.0, direction * 1.0, None, y0, a, saveat=saveat, throw=False)
        return jnp.sum(jnp.where(jnp.isfinite(sol.ys[0]), sol.ys[0], 0)), sol.result._value

    slope, code = jax.grad(reached, has_aux=True)(2.0)
    assert code != dae_jax.RESULTS.successful._value
    at = np.array(times[:2])
    np.testing.assert_allclose(slope, -(at * np.exp(-2 * at)).sum(), rtol=1e-5)


@pytest.mark.parametrize("dt0", [None, 0.1], ids=["adaptive", "fixed"])
@pytest.mark.parametrize(
    ("name", "saved"),
    [("Tsit5", dict(t1=True)), ("projection", dict()), ("projection", dict(t0=True, t1=True)), ("bdf", dict(t0=True))],
    ids=str,
)
@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_of_an_interval_without_length(name, saved, dt0, jacobian):
    """Where no step is taken, all that is saved is the start; it moves with each time as in any other interval."""
    rate = np.cos(0.3) - np.sin(0.3)

    def values_and_times(angle, t0, t1, ts):
        y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.stack([jnp.cos(angle), -jnp.sin(angle)]))
        saveat = diffrax.SaveAt(ts=ts, **saved)
        sol = dae_jax.daesolve(SCENE.system, SOLVERS[name], t0, t1, dt0, y0, saveat=saveat)
        return jnp.stack([jnp.sum(sol.ys[0], 1), sol.ts], 1)

    by = jacobian(values_and_times, argnums=(0, 1, 2, 3))(0.3, 1.0, 1.0, jnp.ones(2))
    of_angle, of_t0, of_t1, of_ts = (np.asarray(x) for x in by)
    rows = 2 + len(saved)
    first, last = int("t0" in saved), int("t1" in saved)
    is_t0, is_t1 = np.arange(rows) < first, np.arange(rows) >= rows - last
    is_ts = np.eye(rows)[:, first : first + 2]
    close = functools.partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    close(of_angle, np.stack([np.full(rows, rate), np.zeros(rows)], 1))
    close(of_t0, np.stack([rate * is_t0 - rate, is_t0], 1))
    close(of_t1, np.stack([rate * is_t1, is_t1], 1))
    close(of_ts, np.stack([rate * is_ts, is_ts], 1))


def test_of_intervals_with_and_without_length():
    """In a batch, and of second order."""
    end = lambda t1: dae_jax.daesolve(
        SCENE.system, SOLVERS["projection"], 0.0, t1, None, (jnp.array([0.6, 0.8]), jnp.array([0.8, -0.6]))
    ).final[0][0]
    t1 = jnp.array([0.0, 1e-6, 0.0])
    np.testing.assert_allclose(jax.vmap(jax.grad(end))(t1), 0.8, rtol=1e-5)
    second = jax.vmap(jax.hessian(end))(t1)
    np.testing.assert_allclose(second[::2], second[1], rtol=1e-5)


def test_what_stays_has_no_cotangent():
    """Of all numbers of a solve only those that move: the velocity at the start, or the end of the interval."""

    def length(gravity, t1=1.0):
        sol = dae_jax.daesolve(
            SCENE.system,
            SOLVERS["projection"],
            0.0,
            t1,
            None,
            (jnp.array([1.0, 0.0]), jnp.zeros(2) + gravity),
            args=jnp.arange(9.0),
        )
        return sol.ys[0][-1, 1]

    def cotangents_of(fn):
        maps = [eqn for eqn in equations(jax.make_jaxpr(jax.grad(fn))(0.3)) if eqn.primitive.name == "linear_map"]
        return [[v.aval.shape for v in eqn.outvars] for eqn in maps]

    assert cotangents_of(length) == [[(2,)]]
    assert cotangents_of(lambda t1: length(0.1, t1)) == [[()]]
