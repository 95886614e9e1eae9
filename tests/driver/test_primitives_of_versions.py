"""Functions of users may use what is a primitive made of others in some versions of JAX, as `einsum` and `searchsorted` from 0.12 on."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import DOP853, ConstrainedSystem, DummyDerivatives, OrthogonalProjection, daesolve


PLACES = jnp.linspace(-3, 3, 50)
TABLE = jnp.sin(PLACES)
TURN = np.array([[0.0, 1.0], [-0.5, 0.3]])
Y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)


def by_primitives(t, q, v, args):
    fraction, power = jnp.frexp(q[0])
    pull = jnp.ldexp(fraction, power) * q[jnp.nonzero(q > -9, size=2)[0]]
    return jnp.array([0.0, -9.81]) + args * jnp.einsum("ij,j->i", TURN, v) + jnp.interp(q[0], PLACES, TABLE) * pull


def by_hand(t, q, v, args):
    k = jnp.sum(q[0] > PLACES) - 1
    part = (q[0] - PLACES[k]) / (PLACES[1] - PLACES[0])
    height = (1 - part) * TABLE[k] + part * TABLE[k + 1]
    return jnp.array([0.0, -9.81]) + args * (TURN @ v) + height * q[0] * q


SYSTEM = ConstrainedSystem(by_primitives, lambda t, q, args: (jnp.einsum("i,i->", q, q) - 1) / 2)
SAME = ConstrainedSystem(by_hand, lambda t, q, args: (q @ q - 1) / 2)


@pytest.mark.parametrize(
    ("solver", "formulation"),
    [(OrthogonalProjection(DOP853()), None), (DOP853(), DummyDerivatives())],
    ids=["projection", "dummy derivatives"],
)
def test_a_solve_and_its_derivatives(solver, formulation):
    solve = functools.partial(
        daesolve, solver=solver, t0=0.0, t1=1.0, dt0=None, y0=Y0, formulation=formulation,
        stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-7),
    )  # fmt: skip
    end = lambda system: lambda damping: solve(system, args=damping).ys[0][-1, 1]
    both = lambda of, *args: np.testing.assert_allclose(of(end(SYSTEM))(*args), of(end(SAME))(*args), rtol=1e-5)
    both(lambda fn: fn, 0.2)
    both(jax.grad, 0.2)
    both(jax.vmap, jnp.array([0.1, 0.3]))
