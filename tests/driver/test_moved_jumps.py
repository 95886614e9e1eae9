"""Derivatives by the times of jumps that are announced."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax


# ẋ = z x, where z jumps from 1 to −2 at a, and to 1/2 at b, in the direction in which the solve goes.
TIMES = jnp.array([0.4, 1.1])
SAVED = jnp.array([0.3, 0.9, 1.7])
METHODS = {
    "explicit": (dae_jax.DOP853(), None),
    "projected": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
    "tangent": (dae_jax.TangentSpace(diffrax.Dopri8()), None),
    "dummy": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    "radau": (dae_jax.RadauIIA5(), None),
    "bdf": (dae_jax.BDF(), None),
}


def level(t, times):
    return jnp.where(t < times[0], 1.0, jnp.where(t < times[1], -2.0, 0.5))


def exact(times, t):
    a, b = times
    return 2 * jnp.exp(jnp.minimum(t, a) - 2 * jnp.clip(t - a, 0, b - a) + 0.5 * jnp.maximum(t - b, 0))


def solved(times, method, way=1, tolerance=1e-8, **options):
    solver, formulation = METHODS[method]
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, p: way * z * x, lambda t, x, z, p: z - level(way * t, p))
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    return dae_jax.daesolve(
        system, solver, 0.0, 2.0 * way, None, (jnp.array([2.0]), jnp.ones(1)), times, formulation=formulation,
        stepsize_controller=diffrax.ClipStepSizeController(control, jump_ts=way * times), **options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("method", "way"),
    [("explicit", 1), ("projected", -1), ("tangent", 1), ("dummy", -1), ("radau", 1), ("radau", -1), ("bdf", -1)],
)
def test_the_solution_moves_with_the_times_of_jumps(method, way):
    found = lambda times: solved(times, method, way, saveat=diffrax.SaveAt(ts=way * SAVED)).ys[0][:, 0]
    np.testing.assert_allclose(jax.jacfwd(found)(TIMES), jax.jacfwd(exact)(TIMES, SAVED), atol=1e-6)


@pytest.mark.parametrize("method", ["explicit", "radau"])
def test_in_reverse_and_in_batches(method):
    found = lambda times: solved(times, method).ys[0][0, 0]
    batch = TIMES + jnp.array([[0.0], [0.2], [-0.1]])
    for of, given in ((jax.grad, TIMES), (lambda f: jax.vmap(jax.grad(f)), batch)):
        np.testing.assert_allclose(of(found)(given), of(lambda times: exact(times, 2.0))(given), atol=1e-6)


@pytest.mark.parametrize("adjoint", [diffrax.ForwardMode(), diffrax.DirectAdjoint()], ids=lambda a: type(a).__name__)
def test_with_another_adjoint(adjoint):
    found = lambda times: solved(times, "explicit", adjoint=adjoint).ys[0][0, 0]
    np.testing.assert_allclose(jax.jacfwd(found)(TIMES), jax.grad(exact)(TIMES, 2.0), atol=1e-6)


def test_second_derivatives():
    found = lambda times: solved(times, "explicit", tolerance=1e-10).ys[0][0, 0]
    np.testing.assert_allclose(jax.hessian(found)(TIMES), jax.hessian(exact)(TIMES, 2.0), atol=1e-7)


def test_of_the_time_of_an_event_after_them():
    """x = 1 at b + 2 (log(1/2) − 3 a + 2 b), in the last part."""
    event = diffrax.Event(lambda t, y, p, **_: y[0][0] - 1, optimistix.Newton(1e-10, 1e-10), direction=True)
    found = lambda times: solved(times, "explicit", event=event).ts[-1]
    of = lambda times: times[1] + 2 * (jnp.log(0.5) - 3 * times[0] + 2 * times[1])
    np.testing.assert_allclose(found(TIMES), of(TIMES), atol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(found)(TIMES), jax.jacfwd(of)(TIMES), atol=1e-6)


def test_by_the_time_of_a_jump_of_many_unknowns_in_steps_that_are_saved():
    """Beyond 256 unknowns steps move with the times of their ends, those that are taken again, too."""
    many = jnp.arange(1.0, 131.0)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z - many * jnp.where(t < a, 1.0, 3.0))

    def found(a):
        control = diffrax.ClipStepSizeController(diffrax.PIDController(rtol=1e-6, atol=1e-6), jump_ts=a[None])
        sol = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 2.0, None, (jnp.zeros(130), many), a,
            stepsize_controller=control, saveat=diffrax.SaveAt(dense=True), max_steps=64,
        )  # fmt: skip
        return sol.evaluate(1.7)[0]

    np.testing.assert_allclose(jax.jacfwd(found)(jnp.asarray(1.1)), -2 * many, rtol=1e-6)
