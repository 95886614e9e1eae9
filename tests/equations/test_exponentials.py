"""Consistent states where Newton's method comes down an exponential, or is thrown far up one: diodes, i = Iₛ (exp(v/0.025) − 1)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dae_jax
from dae_jax.consistent import consistent_after


SATURATION, THERMAL, OHM = 1e-12, 0.025, 100.0


def circuit(t, x, z, args):
    voltage, current = z
    return jnp.stack([(x - voltage) / OHM - current, current - SATURATION * jnp.expm1(voltage / THERMAL)])


CIRCUIT = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -x, circuit)


def exact(source):
    return brentq(lambda v: (source - v) / OHM - SATURATION * np.expm1(v / THERMAL), min(source, 0) - 1, 1, xtol=1e-15)


@jax.jit
def after(start):
    """Of a reset."""
    return consistent_after(CIRCUIT, 0.0, start, None, None)


@pytest.mark.parametrize("source", [-5.0, 5.0, 20.0])
@pytest.mark.parametrize("guess", [0.0, 3.0, 17.6, 20.0, 100.0])
def test_a_diode_from_any_voltage(guess, source):
    """From 17.7 V on the exponential overflows; below Newton's method takes 0.025 V off at a time."""
    start = jnp.array([source]), jnp.array([[guess], [0.0]])
    for found in (dae_jax.consistent_state(CIRCUIT, 0.0, start, fixed=(True, False)), after(start)):
        np.testing.assert_allclose(found[0], source)
        np.testing.assert_allclose(found[1][0], exact(source), rtol=1e-12)


@pytest.mark.parametrize("guess", [0.0, 0.6, 10.0, 40.0])
def test_many_diodes_from_any_voltage(guess):
    """300 unknowns, with sparse factors: from 0 V whole corrections lead to the 20 V of the source."""
    sources = jnp.linspace(1.0, 20.0, 100)
    start = sources, jnp.stack([jnp.full(100, guess), jnp.zeros(100)])
    found = dae_jax.consistent_state(CIRCUIT, 0.0, start, fixed=(True, False))
    np.testing.assert_allclose(found[1][0], list(map(exact, np.asarray(sources))), rtol=1e-12)


def test_a_start_without_a_number_is_refused_still():
    root = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -x, lambda t, x, z, args: jnp.log(z) - x)
    with pytest.raises(ValueError, match=r"No consistent state was found near `y0`; left over are(.|\n)* off by nan"):
        dae_jax.consistent_state(root, 0.0, (jnp.ones(1), -jnp.ones(1)), fixed=(True, False))
