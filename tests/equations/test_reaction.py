"""The force of multipliers on the coordinates, Aᵀ(λ, μ), without A."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.scenes import chain


def lengths(t, q, args):
    return jnp.stack([q @ q - 1 - t, q[0] * q[1] * q[2]]) / 2


def lengths_in_a_loop(t, q, args):
    """Whose turns are found on the way, so that there are forward derivatives only."""
    _, square = jax.lax.while_loop(lambda c: c[0] < len(q), lambda c: (c[0] + 1, c[1] + q[c[0]] ** 2), (0, 0.0 * t))
    return jnp.stack([square - 1 - t, q[0] * q[1] * q[2]]) / 2


def rolling(t, q, v, args):
    return jnp.stack([q[2] * v[0] - jnp.sin(q[0]) * v[1]])


@pytest.mark.parametrize("constraint", [lengths, lengths_in_a_loop])
@pytest.mark.parametrize("nonholonomic", [rolling, None])
def test_is_what_the_jacobian_says(constraint, nonholonomic):
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: -q, constraint, nonholonomic=nonholonomic)
    q, v, *rest = np.random.default_rng(0).normal(size=(4, 3))
    ode = MechanicalODE.of(system, 0.3, (jnp.asarray(q), jnp.asarray(v)), None)
    multipliers = jnp.asarray(rest[0][: ode.holonomic + ode.nonholonomic])
    a = ode.constraint_jacobian(0.3, jnp.asarray(q), jnp.asarray(v))
    np.testing.assert_allclose(ode.reaction(0.3, q, v, multipliers), a.T @ multipliers, rtol=1e-13)
    of_position = multipliers[: ode.holonomic]
    np.testing.assert_allclose(ode.reaction(0.3, q, v, of_position), a[: ode.holonomic].T @ of_position, rtol=1e-13)


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


def test_a_constraint_with_forward_derivatives_only_is_solved():
    force = lambda t, q, v, args: jnp.array([0.0, 0.0, -9.81])

    def sphere(t, q, args):
        return jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] + q[c[0]] ** 2), (0, -1.0 + 0 * t))[1]

    ends = [
        dae_jax.daesolve(
            dae_jax.ConstrainedSystem(force, constraint), dae_jax.RadauIIA5(), 0.0, 0.5, None,
            (jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 1.0, 0.0])),
        ).final[0]
        for constraint in (sphere, lambda t, q, args: q @ q - 1)
    ]  # fmt: skip
    np.testing.assert_allclose(*ends, atol=1e-7)
