"""Resets after which the index of the equations is higher than their structure has it: derivatives, and what is consistent."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.consistent import consistent_after
from dae_jax.driver.known_derivatives import refused_if_unknown


# L i̇ = cos t − R i − v beside an ideal diode: v = 0 while it conducts, of index 1, and i = 0 while it does not, of index 2.
DIODE = dae_jax.ImplicitDAE(
    lambda t, y, yd, a: jnp.stack(
        [a["L"] * yd[0] - (jnp.cos(t) - a["R"] * y[0] - y[1]), jnp.where(a["conducts"] > 0, y[1], y[0])]
    )
)
SWITCH = dae_jax.Reset(
    lambda t, y, a, **_: jnp.where(a["conducts"] > 0, y[0], -y[1]),
    lambda t, y, a: (y, {**a, "conducts": -a["conducts"]}),
    direction=False,
    max_resets=4,
)


def current(coil, t1, solver, adjoint):
    sol = dae_jax.daesolve(
        DIODE, solver, 0.0, t1, None, jnp.array([0.5, 0.0]), {"L": coil[0], "R": coil[1], "conducts": 1.0},
        event=SWITCH, adjoint=adjoint,
    )  # fmt: skip
    return sol.final, sol.stats["jumps"]


def exact(coil, t1):
    """The current from 3π/2 on, when the voltage has the sign again in which the diode conducts."""
    inductance, resistance = coil
    forced = lambda t: (resistance * jnp.cos(t) + inductance * jnp.sin(t)) / (resistance**2 + inductance**2)
    begin = 3 * jnp.pi / 2
    return forced(t1) - forced(begin) * jnp.exp(-resistance / inductance * (t1 - begin))


@pytest.mark.parametrize(
    ("mode", "solver"), [("forward", dae_jax.RadauIIA5()), ("reverse", dae_jax.RadauIIA5())], ids=["forward", "reverse"]
)
def test_derivatives_after_an_ideal_diode_beside_a_coil(mode, solver):
    of, adjoint = {
        "forward": (jax.jacfwd, diffrax.ForwardMode()),
        "reverse": (jax.jacrev, diffrax.RecursiveCheckpointAdjoint()),
    }[mode]
    coil = jnp.array([3.0, 0.5])
    found = jax.jit(lambda coil, t1: of(lambda *x: current(*x, solver, adjoint), (0, 1), has_aux=True)(coil, t1))
    (by_coil, by_time), resets = found(coil, 4.2)
    assert resets == 1
    # i = 0 and v = cos t there, whatever the coil is.
    np.testing.assert_allclose(by_coil, 0, atol=1e-6)
    np.testing.assert_allclose(by_time, [0, -np.sin(4.2)], atol=1e-6)
    (by_coil, by_time), resets = found(coil, 6.0)
    assert resets == 2
    np.testing.assert_allclose(by_coil[0], jax.grad(exact)(coil, 6.0), atol=1e-6)
    np.testing.assert_allclose(by_time[0], jax.grad(exact, 1)(coil, 6.0), atol=1e-6)
    np.testing.assert_allclose(by_coil[1], 0, atol=1e-9)


@pytest.mark.parametrize("inductance", [0.3, 1.0, 3.0])
def test_the_voltage_after_the_diode_has_opened_is_that_of_the_source(inductance):
    """Not what it was before, with a rate of the current that the hidden equation di/dt = 0 forbids."""
    after = jax.jit(
        lambda coil: consistent_after(
            DIODE, 2.7, jnp.zeros(2), {"L": coil, "R": 0.5, "conducts": jnp.sign(-coil)}, None, raised=True
        )
    )
    np.testing.assert_allclose(after(inductance), [0, np.cos(2.7)], atol=1e-9)


def test_a_derivative_that_is_no_number_is_an_error_in_both_modes():
    """Of a finite value; elsewhere, and with batches and second derivatives, nothing changes."""
    squares = lambda x: jnp.sum(refused_if_unknown([2 * x, jnp.arange(3)], given=True)[0] ** 2)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(squares)))(jnp.ones((3, 2))), 8)
    np.testing.assert_array_equal(jax.hessian(squares)(jnp.ones(2)), 8 * np.eye(2))
    lost = lambda x: 0 * jnp.sum(jnp.sqrt(refused_if_unknown(x, given=True) - 1))
    for ask in (
        lambda: jax.grad(lost)(jnp.ones(2)),
        lambda: jax.jit(jax.grad(lost))(jnp.ones(2)),
        lambda: jax.jvp(lambda x: refused_if_unknown(0 * jnp.sqrt(x), given=False), (jnp.zeros(2),), (jnp.ones(2),)),
    ):
        with pytest.raises(Exception, match=r"not known \(NaN\): a reset has led to equations whose index"):
            jax.block_until_ready(ask())
