"""Problems of the IVP test set on which solvers stop: kinks in time and in charges at nanoseconds, an elastic rod."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import charge_pump, elastic_crank, wheelset


PUMP = charge_pump()


@pytest.mark.parametrize(
    ("solver", "factor"),
    [(dae_jax.RadauIIA5(), 100), (dae_jax.BDF(), 20_000)],
    ids=["radau", "bdf-of-dummy-derivatives"],
)
def test_a_charge_pump_passes_its_kinks(solver, factor):
    """Those in the charges, where a capacitance and with it the current jumps, are not announced; also where `atol` is far
    above the charges.
    """
    times = np.array([25e-9, 55e-9, 58e-9, 85e-9, 112e-9, 118e-9, 1150e-9, 1200e-9])

    @jax.jit
    def solve(tolerance):
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        control = diffrax.ClipStepSizeController(control, jump_ts=np.array(PUMP.kinks))
        return dae_jax.daesolve(
            PUMP.system, solver, 0.0, PUMP.t1, None, PUMP.y0, stepsize_controller=control, max_steps=20_000,
            saveat=diffrax.SaveAt(ts=times),
        )  # fmt: skip

    exact = PUMP.reference(times)
    for tolerance in (1e-6, 1e-8, 1e-10):
        y = np.array(solve(tolerance).ys)
        # Charges of 1e-12 are far below `atol`: what is left of their sum after ten periods is a voltage.
        np.testing.assert_allclose(y[:, 5:8], exact[:, 5:8], atol=factor * tolerance)
        # Where the source has a kink, its derivative is that of one side or the other.
        known = np.isfinite(exact[:, 8]) & (times < PUMP.t1)
        np.testing.assert_allclose(y[known, 8], exact[known, 8], atol=1e-12)


def test_the_reference_of_the_charge_pump_is_the_published_one():
    end = PUMP.reference(np.array([PUMP.t1]))[0]
    np.testing.assert_allclose(end, [0.1262800429876759e-12, *7 * [0], 0.1522565920949845e-3], atol=1e-20)


def test_the_reference_of_the_charge_pump_knows_no_current_where_it_jumps():
    kinks = np.array(PUMP.kinks)
    assert np.isnan(PUMP.reference(kinks)[:, 8]).all()
    beside = PUMP.reference(np.array([0.0, 1e-9, 49e-9, 61e-9, 109e-9, 121e-9]))
    np.testing.assert_array_equal(beside[:, 8], 0)


def test_the_elastic_crank_starts_as_published():
    """The published accelerations and multipliers satisfy the equations of motion to their digits."""
    scene = elastic_crank()
    y = jnp.asarray(scene.y0)
    rates = jnp.concatenate([y[7:21], jnp.zeros(10)])
    np.testing.assert_allclose(scene.system.residual(0.0, y, rates, None), 0, atol=1e-6)


def test_the_wheelset_starts_as_published():
    """The published accelerations satisfy the equations to round-off."""
    scene = wheelset()
    rates = np.zeros(17)
    rates[5:8] = -1.975258894011285, -1.0898297102811276e-3, 7.8855083626142589e-2
    rates[8:11] = -5.533362821731549, -0.3487021489546511, -2.132968724380927
    np.testing.assert_allclose(scene.system.residual(0.0, jnp.asarray(scene.y0), rates, None), 0, atol=1e-13)
