"""Loads at places where their formulas have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import mechanisms as m


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_spring_between_points_that_coincide_has_its_stiffness_there(dimension):
    """Q = −k d of a spring whose rest is 0, V = k |d|²/2: linear and quadratic, at d = 0 as everywhere."""
    place = np.arange(1.0, 1 + dimension)
    body = m.Body("body", 1.0, 0.1 if dimension == 2 else (0.1, 0.2, 0.2), at=place)
    stiffness = 4.0
    balance = m.spring(m.between(m.ground, body, (place, place)), stiffness)
    mechanism = m.Mechanism([body], [], [balance])
    q, v = mechanism.reference
    moved = lambda x: q.put("body", q["body"].at[:dimension].add(x))
    force = lambda x: mechanism.force(0.0, moved(x), v, None)["body"][:dimension]
    energy = lambda x: mechanism.potential(moved(x), None)
    still = jnp.zeros(dimension)
    np.testing.assert_allclose(force(still), 0, atol=1e-30)
    np.testing.assert_allclose(jax.jacfwd(force)(still), -stiffness * np.eye(dimension), rtol=1e-14)
    np.testing.assert_allclose(jax.jacrev(force)(still), -stiffness * np.eye(dimension), rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(energy)(still), stiffness * np.eye(dimension), rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(force)(still), 0, atol=1e-30)


@pytest.mark.parametrize(("rest", "at", "force", "slope"), [(1e-6, 2e-6, -4e-6, -4), (0.0, 0.0, 0.0, -4)])
def test_a_short_spring_in_float32(rest, at, force, slope):
    """Of micrometres, along its line; and one without a length where its points coincide."""
    with jax.enable_x64(False):
        body = m.Body("body", 1.0, 0.1)
        spring = m.spring(m.between(m.ground, body, (np.zeros(2), np.zeros(2))), 4.0, rest)
        mechanism = m.Mechanism([body], [], [spring])
        q, v = mechanism.reference
        along = lambda x: mechanism.force(0.0, q.put("body", q["body"].at[0].add(x)), v, None)["body"][0]
        found, changes = jax.value_and_grad(along)(jnp.array(at))
        np.testing.assert_allclose((found, changes), (force, slope), rtol=1e-6)
