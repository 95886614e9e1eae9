"""Derivatives of solves of bodies in space, whose inertia is a matrix that stays symmetric."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from dae_jax import OrthogonalProjection, daesolve
from dae_jax.driver.changes import _by_no_pattern
from dae_jax.mechanisms import Body, Mechanism, gravity, ground, revolute, spring


def test_by_a_spring():
    """Its steps, those for any change of parameters, did not lead to the end: the derivative was refused."""

    def end(stiffness):
        body = Body("a", 2.0, jnp.array([0.2, 0.3, 0.25]), at=(0.3, 0.0, 0.0))
        hinge = revolute(ground, body, at=(0.0, 0.0, 0.0), axis=(1.0, 2.0, 0.3), name="hinge")
        mechanism = Mechanism([body], [hinge], [gravity((0.0, 0.0, -9.81)), spring(hinge, stiffness, 0.2)])
        sol = daesolve(
            mechanism.system(), OrthogonalProjection(diffrax.Tsit5()), 0.0, 0.8, None,
            mechanism.assemble(at={"hinge": 0.2}, rates={"hinge": 1.0}),
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        )  # fmt: skip
        return sol.ys[0]["a"][-1]

    slope = jax.jvp(end, (jnp.asarray(3.0),), (jnp.ones(()),))[1]
    np.testing.assert_allclose(slope, (end(3.0001) - end(2.9999)) / 2e-4, atol=1e-6)


def test_symmetric_matrices_change_as_such():
    a = jnp.array([[1.0, 2.0], [2.0, 5.0]])
    given = {"inertia": a, "many": jnp.stack([a, 2 * a]), "other": a.at[0, 1].set(3.0)}
    found = _by_no_pattern(given, jnp.ones_like)
    np.testing.assert_array_equal(found["inertia"], found["inertia"].T)
    np.testing.assert_array_equal(found["many"], found["many"].swapaxes(1, 2))
    assert found["other"][0, 1] != found["other"][1, 0]
    assert np.unique(found["many"]).size == 6
