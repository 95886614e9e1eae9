"""The force of multipliers on the coordinates, Aᵀ(λ, μ), without A."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.mechanical import REVERSE_FROM, MechanicalODE
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.scenes import chain


def lengths(t, q, args):
    return q[1:] * q[:-1] - t


def lengths_in_a_loop(t, q, args):
    """Whose turns are found on the way, so that there are forward derivatives only."""
    turn = lambda c: (c[0] + 1, c[1].at[c[0]].set(q[c[0] + 1] * q[c[0]] - t))
    return jax.lax.while_loop(lambda c: c[0] < len(q) - 1, turn, (0, 0 * q[1:]))[1]


def rolling(t, q, v, args):
    return jnp.stack([q[2] * v[0] - jnp.sin(q[0]) * v[1]])


@pytest.mark.parametrize("count", [3, REVERSE_FROM + 2], ids=["few", "many"])
@pytest.mark.parametrize("constraint", [lengths, lengths_in_a_loop])
@pytest.mark.parametrize("nonholonomic", [rolling, None])
def test_is_what_the_jacobian_says(count, constraint, nonholonomic):
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: -q, constraint, nonholonomic=nonholonomic)
    q, v, rest = np.random.default_rng(0).normal(size=(3, count))
    ode = MechanicalODE.of(system, 0.3, (jnp.asarray(q), jnp.asarray(v)), None)
    multipliers = jnp.asarray(rest[: ode.holonomic + ode.nonholonomic])
    a = ode.constraint_jacobian(0.3, jnp.asarray(q), jnp.asarray(v))
    np.testing.assert_allclose(ode.reaction(0.3, q, v)(multipliers), a.T @ multipliers, rtol=1e-13, atol=1e-15)
    of_position = multipliers[: ode.holonomic]
    expected = a[: ode.holonomic].T @ of_position
    np.testing.assert_allclose(ode.reaction(0.3, q, v)(of_position), expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("count", [2, REVERSE_FROM], ids=["few", "many"])
def test_without_holonomic_constraints_theirs_is_zero(count):
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: -q, nonholonomic=lambda t, q, v, args: v[1:] * q[:-1])
    at = jnp.arange(1.0, count + 2), jnp.zeros(count + 1)
    pull = MechanicalODE.of(system, 0.0, at, None).reaction(0.0, *at)
    np.testing.assert_array_equal(pull(jnp.ones(count)), [0, *range(1, count + 1)])
    np.testing.assert_array_equal(pull(jnp.zeros(0)), np.zeros(count + 1))


def test_a_branch_that_is_not_taken_is_not_differentiated_in_reverse():
    """√0, of an angle that is 0 there: forward derivatives leave it out, reverse ones make it NaN."""
    guarded = lambda t, q, args: jnp.stack([jnp.where(q[0] > 0, jnp.sqrt(q[0]), q[0]) + q[1]])
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: -q, guarded)
    at = jnp.array([0.0, 0.0]), jnp.array([1.0, -1.0])
    ode = MechanicalODE.of(system, 0.0, at, None)
    np.testing.assert_array_equal(ode.reaction(0.0, *at)(jnp.ones(1)), [1.0, 1.0])


@pytest.mark.parametrize("form", ["index-3", "GGL"])
def test_the_equations_of_a_chain_cost_in_proportion_to_its_links(form):
    def operations(links):
        scene = chain(links)
        residual = ResidualForm.of(scene.system, 0.0, scene.y0, scene.args, form)
        y = jax.ShapeDtypeStruct((residual.size,), jnp.float64)
        time = jax.ShapeDtypeStruct((), jnp.float64)
        found = jax.jit(residual.residual).lower(time, y, y).compile().cost_analysis()
        assert found is not None
        return found["flops"]

    assert operations(128) < 2.5 * operations(64)
