"""A block-diagonal mass matrix is the same matrix as the one written out, by every path through the equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.constraint_jacobian import DenseConstraintJacobian, dense_mass
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.equations.sparse_constraint_jacobian import SparseConstraintJacobian


BODIES = 8


def blocks(q, args):
    """Three numbers a body, masses that depend on them."""
    q = q.reshape(BODIES, 3)
    lower = jnp.tril(0.3 * jnp.sin(q[:, :, None] + q[:, None, :])) + jnp.eye(3)
    return jnp.einsum("bij,bkj->bik", lower, lower)


def chain(mass, links: int) -> dae_jax.ConstrainedSystem:
    """Each body at a given distance from the one before; the first is free."""

    def constraint(t, q, args):
        q = q.reshape(BODIES, 3)
        apart = q[1 : links + 1] - q[:links]
        return jnp.sum(apart**2, 1) - 1

    return dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.cos(q) - v, constraint, mass=mass)


@pytest.mark.parametrize(("links", "linear"), [(2, DenseConstraintJacobian), (7, SparseConstraintJacobian)])
def test_the_field_and_the_way_to_the_manifold_are_those_of_the_dense_matrix(links, linear):
    rng = np.random.default_rng(0)
    q, v = jnp.asarray(rng.normal(size=(2, 3 * BODIES)))
    found = []
    for mass in (blocks, lambda q, args: dense_mass(blocks(q, args))):
        ode = MechanicalODE.of(chain(mass, links), 0.0, (q, v), None)
        if mass is blocks:
            assert isinstance(ode.linear, linear)
        found.append(
            jax.jit(lambda y, ode=ode: (ode.field(0.0, y), ode.distances(0.0, y), ode.project(0.0, y)[0]))((q, v))
        )
    for ours, dense in zip(*map(jax.tree.leaves, found), strict=True):
        assert np.allclose(ours, dense, rtol=1e-10, atol=1e-10)


def test_a_block_that_is_not_definite_is_refused():
    q = jnp.arange(24.0) / 2
    bad = lambda q, args: blocks(q, args).at[3].multiply(-1.0)
    system = chain(bad, 2)
    y0 = (q, jnp.zeros_like(q))
    with pytest.raises(ValueError, match="positive definite"):
        dae_jax.daesolve(system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.0, None, y0)
