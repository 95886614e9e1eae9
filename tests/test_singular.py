"""Mechanisms whose constraints are redundant, degenerate or singular, whose masses are none: right, or refused in words."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import RESULTS, ConstrainedSystem


GRAVITY = jnp.array([0.0, -9.81])
LEVEL = (jnp.array([1.0, 0.0]), jnp.zeros(2))
PROJECTED = dae_jax.OrthogonalProjection(diffrax.Tsit5())


def circle(q):
    return (q @ q - 1) / 2


def pendulum(constraint=lambda t, q, args: circle(q), **more):
    return ConstrainedSystem(lambda t, q, v, args: jnp.zeros_like(q).at[1].set(-9.81), constraint, **more)


def solve(system, solver=PROJECTED, y0=LEVEL, args=None, dt0=None, t1=1.0, **options):
    return dae_jax.daesolve(system, solver, 0.0, t1, dt0, y0, args, **options)


def traced(system, solver=PROJECTED, y0=LEVEL, batched=False, **options):
    """The result code of a solve whose start is traced."""
    run = lambda y0: solve(system, solver, y0, throw=False, **options).result._value
    if batched:
        return int(jax.vmap(run)(jax.tree.map(lambda x: jnp.stack([x, x]), y0))[1])
    return int(jax.jit(run)(y0))


def code(result):
    return int(result._value)


SQUARED = pendulum(lambda t, q, args: (q @ q - 1) ** 2)
STILL = (jnp.zeros(2), jnp.zeros(2))
VANISHING = ConstrainedSystem(lambda t, q, v, args: GRAVITY, nonholonomic=lambda t, q, v, args: q[0] * v[1])
SPACE = (jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3))
TWO = lambda t, q, args: jnp.stack([circle(q), q[2]])


class TestDegenerateStart:
    @pytest.mark.parametrize(
        ("system", "y0", "words"),
        [
            (SQUARED, LEVEL, r"rank 0 of 1 at the start: the gradient of constraint\[0\]"),
            (VANISHING, STILL, r"rank 0 of 1 at the start: the gradient of nonholonomic\[0\]"),
            (pendulum(TWO, rank=1), SPACE, "1 of the 2 constraints are independent, but .* rank 2 of 2"),
            (pendulum(rank=0), LEVEL, "0 of the 1 constraints are independent, but .* rank 1 of 1"),
            (
                pendulum(lambda t, q, args: jnp.stack([circle(q), (q[0] - 1) ** 2 + q[1] ** 2 - 4]) / 1.0),
                (jnp.array([-1.0, 0.0]), jnp.zeros(2)),
                "rank 1 of 2 at the start, and more beside it: a singular configuration",
            ),
        ],
        ids=["squared", "vanishing", "rank-too-small", "rank-0", "stretched"],
    )
    def test_is_refused(self, system, y0, words):
        with pytest.raises(ValueError, match=words):
            solve(system, y0=y0)
        assert traced(system, y0=y0) == code(RESULTS.dependent_constraints)

    def test_in_lanes(self):
        assert traced(SQUARED, batched=True) == code(RESULTS.dependent_constraints)


REDUNDANT = {
    "doubled": pendulum(lambda t, q, args: jnp.stack([circle(q), 2 * circle(q)])),
    "scaled": pendulum(lambda t, q, args: jnp.stack([circle(q), 1e-9 * circle(q)])),
    "trivial": pendulum(lambda t, q, args: jnp.stack([circle(q), 0 * q[0]])),
    "rolling": pendulum(nonholonomic=lambda t, q, v, args: q @ v),
}


class TestRedundantConstraints:
    """What is redundant is found, and changes nothing."""

    @pytest.mark.parametrize("name", REDUNDANT)
    def test_as_without(self, name):
        plain, sol = solve(pendulum()), solve(REDUNDANT[name])
        assert sol.rank == 1
        np.testing.assert_allclose(sol.ys[0], plain.ys[0], atol=1e-7)
        assert dae_jax.drift(REDUNDANT[name], sol).position[0] < 1e-13
