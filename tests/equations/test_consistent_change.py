"""What of a change of a consistent state keeps it consistent: the derivative of the search for the nearest consistent state, without
the search.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import dae_jax as D
from dae_jax.equations.consistent_change import consistent_change
from dae_jax.studies.reductions import lyapunov


def gravity(t: Any, q: Any, v: Any, a: Any) -> Any:
    return jnp.zeros_like(q).at[-1].set(-9.81)


def robertson(t: Any, y: Any, yd: Any, a: Any) -> Any:
    return [
        yd[0] + 0.04 * y[0] - 1e4 * y[1] * y[2],
        yd[1] - 0.04 * y[0] + 1e4 * y[1] * y[2] + 3e7 * y[1] ** 2,
        y.sum() - 1,
    ]


def pendulum(t: Any, y: Any, yd: Any, a: Any) -> Any:
    x, w, u, v, force = y
    return [yd[0] - u, yd[1] - v, yd[2] + force * x, yd[3] + force * w + 9.81, x**2 + w**2 - 1]


UNIT = D.ConstrainedSystem(gravity, lambda t, q, a: (q @ q - 1) / 2)
SYSTEMS = {
    "pendulum": (UNIT, (jnp.array([0.6, -0.8]), jnp.array([0.4, 0.3]))),
    "masses": (
        D.ConstrainedSystem(gravity, lambda t, q, a: (q @ q - 1) / 2, mass=jnp.array([1.0, 5.0])),
        (jnp.array([0.6, -0.8]), jnp.array([0.4, 0.3])),
    ),
    "moved": (
        D.ConstrainedSystem(gravity, lambda t, q, a: (q @ q - (1 + 0.5 * t) ** 2) / 2),
        (jnp.array([0.6, -0.8]), jnp.array([0.7, -0.1])),
    ),
    "redundant": (
        D.ConstrainedSystem(gravity, lambda t, q, a: jnp.stack([(q @ q - 1) / 2, q @ q - 1]), rank=1),
        (jnp.array([0.6, -0.8]), jnp.array([0.4, 0.3])),
    ),
    "knife edge": (
        D.ConstrainedSystem(gravity, nonholonomic=lambda t, q, v, a: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2])),
        (jnp.array([0.0, 0.0, 0.5]), jnp.array([2 * np.cos(0.5), 2 * np.sin(0.5), 3.0])),
    ),
    "index 1": (D.ImplicitDAE(robertson), jnp.array([0.9, 1e-5, 0.1 - 1e-5])),
    "index 3": (D.ImplicitDAE(pendulum), jnp.array([0.6, -0.8, 0.4, 0.3, 0.25 + 9.81 * 0.8])),
    "a resistor between": (
        D.SemiExplicitDAE(lambda t, x, z, a: -z, lambda t, x, z, a: z**3 + z - x),
        (jnp.array([2.0]), jnp.array([1.0])),
    ),
}


def wanted(y: Any) -> Any:
    numbers, tree = ravel_pytree(y)
    return tree(jnp.cos(1.0 + jnp.arange(numbers.size) ** 2))


@pytest.mark.parametrize("name", SYSTEMS)
def test_is_the_derivative_of_the_nearest_consistent_state(name: str) -> None:
    system, y = SYSTEMS[name]
    _, expected = jax.jvp(lambda y: D.consistent_state(system, 0.0, y), (y,), (wanted(y),))
    found = consistent_change(system, 0.0, y, wanted(y), None)
    assert jnp.max(jnp.abs(ravel_pytree(expected)[0])) > 0.1
    np.testing.assert_allclose(ravel_pytree(found)[0], ravel_pytree(expected)[0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", SYSTEMS)
def test_stays_as_it_is(name: str) -> None:
    system, y = SYSTEMS[name]
    once = consistent_change(system, 0.0, y, wanted(y), None)
    again = consistent_change(system, 0.0, y, once, None)
    np.testing.assert_allclose(ravel_pytree(again)[0], ravel_pytree(once)[0], rtol=1e-9, atol=1e-9)


def test_directions_of_whole_numbers_and_of_another_structure() -> None:
    end = 0.0, 1.0, (np.array([1, 0]), np.array([0, 0]))
    solver = D.OrthogonalProjection(D.DOP853())
    of_floats = lyapunov(UNIT, solver, 0.0, 1.0, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
    assert lyapunov(UNIT, solver, *end) == of_floats
    with pytest.raises(ValueError, match="`direction` must hold numbers in the structure of the state"):
        lyapunov(UNIT, solver, *end, direction=jnp.ones(4))


def of_args(name: str) -> Any:
    """A system whose `args` are two lengths, and a state of it that is consistent for (1, 1)."""
    if name == "mechanism":
        constraint = lambda t, q, a: (q @ q - (a[0] + t * a[1]) ** 2) / 2
        return D.ConstrainedSystem(gravity, constraint, mass=jnp.array([1.0, 5.0])), (
            jnp.array([0.6, -0.8]),
            jnp.array([0.6, -0.8]),
        )
    if name == "knife edge":
        across = lambda t, q, v, a: a[0] * v[0] * jnp.sin(q[2]) - a[1] * v[1] * jnp.cos(q[2])
        return D.ConstrainedSystem(gravity, nonholonomic=across), SYSTEMS[name][1]
    if name == "index 1":
        return D.ImplicitDAE(lambda t, y, yd, a: [*robertson(t, y, yd, a)[:2], a[0] * y.sum() - a[1]]), SYSTEMS[name][1]
    long = lambda y, a: y[0] ** 2 + y[1] ** 2 - a[0] * a[1]
    return D.ImplicitDAE(lambda t, y, yd, a: [*pendulum(t, y, yd, a)[:4], long(y, a)]), SYSTEMS[name][1]


@pytest.mark.parametrize("name", ["mechanism", "knife edge", "index 1", "index 3"])
def test_of_parameters_too(name: str) -> None:
    """As of the search, where the start follows: of one that is not wanted to move."""
    system, y = of_args(name)
    at, change = jnp.ones(2), jnp.array([0.7, -0.4])
    _, expected = jax.jvp(lambda a: D.consistent_state(system, 0.0, y, a), (at,), (change,))
    still = jax.tree.map(jnp.zeros_like, y)
    numbers = jax.tree.map(jnp.zeros_like, eqx.filter(system, eqx.is_inexact_array))
    found = consistent_change(system, 0.0, y, still, at, (numbers, change))
    assert jnp.max(jnp.abs(ravel_pytree(expected)[0])) > 0.1
    np.testing.assert_allclose(ravel_pytree(found)[0], ravel_pytree(expected)[0], rtol=1e-6, atol=1e-6)
