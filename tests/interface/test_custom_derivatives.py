"""Derivatives that a user's function has of its own, or has not, are those of a solution too."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


@jax.custom_jvp
def five_times(x):
    return x


five_times.defjvp(lambda primals, tangents: (primals[0], 5 * tangents[0]))


@jax.custom_vjp
def three_times(x):
    return x


three_times.defvjp(lambda x: (x, None), lambda _, cotangent: (3 * cotangent,))

FACTORS = {"stop_gradient": (jax.lax.stop_gradient, 0), "custom_jvp": (five_times, 5), "custom_vjp": (three_times, 3)}
METHODS = {
    "orthogonal projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), {}),
    "tangent space": (dae_jax.TangentSpace(diffrax.Tsit5()), {}),
    "symmetric projection": (dae_jax.SymmetricProjection(dae_jax.Gauss4()), {"dt0": 0.02}),
    "Radau": (dae_jax.RadauIIA5(), {}),
    "BDF": (dae_jax.BDF(), {}),
    "Baumgarte": (diffrax.Tsit5(), {"formulation": dae_jax.Baumgarte(5.0, 5.0)}),
    "dummy derivatives": (dae_jax.DOP853(), {"formulation": dae_jax.DummyDerivatives()}),
    "RATTLE": (dae_jax.RATTLE(), {"dt0": 0.02}),
}


def height(method, of_gravity, gravity, **rest):
    """Of a pendulum after 0.3 s; `of_gravity` is what the force makes of gravity."""
    solver, options = METHODS[method]
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, g: jnp.stack([0 * t, -of_gravity(g)]), lambda t, q, g: (q @ q - 1) / 2
    )
    y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)
    options = {"dt0": None, **options, **rest}
    return dae_jax.daesolve(system, solver, 0.0, 0.3, options.pop("dt0"), y0, gravity, **options).ys[0][-1, 1]


def by_parts(rules):
    """Gravity as a sum, the first part as it is and each other by its rule; what the slopes are then, beside the first."""
    of_gravity = lambda parts: parts[0] + sum(rule(x) for (rule, _), x in zip(rules, parts[1:], strict=True))
    return of_gravity, jnp.full(1 + len(rules), 9.81 / (1 + len(rules))), np.array([1, *(f for _, f in rules)])


@pytest.mark.parametrize("method", METHODS)
def test_a_rule_in_the_force_is_kept(method):
    of_gravity, parts, factors = by_parts([*FACTORS.values()])
    slopes = np.asarray(jax.grad(lambda g: height(method, of_gravity, g))(parts))
    assert abs(slopes[0]) > 1e-2
    np.testing.assert_allclose(slopes, factors * slopes[0], rtol=1e-9)


@pytest.mark.parametrize("method", ["orthogonal projection", "Radau", "dummy derivatives"])
def test_forward_too(method):
    of_gravity, parts, factors = by_parts([FACTORS["stop_gradient"], FACTORS["custom_jvp"]])
    forward = diffrax.ForwardMode()
    slopes = np.asarray(jax.jacfwd(lambda g: height(method, of_gravity, g, adjoint=forward))(parts))
    assert abs(slopes[0]) > 1e-2
    np.testing.assert_allclose(slopes, factors * slopes[0], rtol=1e-9)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.OrthogonalProjection(dae_jax.DOP853())])
def test_in_a_residual(solver):
    """0 = ẏ₀ + a y₁, y₁ = y₀, with rules for a."""
    for rule, factor in (FACTORS["stop_gradient"], FACTORS["custom_jvp"]):
        system = dae_jax.ImplicitDAE(lambda t, y, yd, a, rule=rule: jnp.stack([yd[0] + rule(a) * y[1], y[1] - y[0]]))
        at = functools.partial(dae_jax.daesolve, system, solver, 0.0, 1.0, None, jnp.ones(2))
        np.testing.assert_allclose(jax.grad(lambda a, at=at: at(a).ys[-1, 0])(2.0), -factor * np.exp(-2), rtol=1e-6)


def test_the_time_derivative_of_a_constraint_is_that_of_the_rule():
    """The path of a driven point is known at whole times only; its rule says how it moves."""

    @jax.custom_jvp
    def path(t):
        return jnp.sin(jnp.round(t * 2**30) / 2**30)

    path.defjvp(lambda primals, tangents: (path(*primals), cosine(primals[0]) * tangents[0]))

    @jax.custom_jvp
    def cosine(t):
        return jnp.cos(jnp.round(t * 2**30) / 2**30)

    cosine.defjvp(lambda primals, tangents: (cosine(*primals), -path(primals[0]) * tangents[0]))
    system = dae_jax.ConstrainedSystem(lambda t, q, v, a: jnp.zeros(2), lambda t, q, a: q[0] - path(t))
    y0 = jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0])
    for formulation in (None, dae_jax.DummyDerivatives()):
        sol = dae_jax.daesolve(system, dae_jax.DOP853(), 0.0, 1.0, None, y0, formulation=formulation)
        np.testing.assert_allclose(sol.ys[1][-1, 0], np.cos(1), atol=1e-7)


def test_straight_through():
    """x + stop_gradient(round(x) − x) has the values of round and the slope 1."""
    rounded = lambda x: x + jax.lax.stop_gradient(jnp.round(x) - x)
    plain = jax.grad(lambda g: height("orthogonal projection", lambda x: x, g))(10.0)
    np.testing.assert_allclose(jax.grad(lambda g: height("orthogonal projection", rounded, g))(10.0), plain, rtol=1e-9)
