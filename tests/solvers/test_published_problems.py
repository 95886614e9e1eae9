"""Problems of the IVP test set on which solvers stop: kinks in time and in charges at nanoseconds, an elastic rod, water in tubes."""

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


# Of the water tubes: from which node to which each leads, and the nodes in the order of their pressures, two buffers first.
TUBES = (
    (1, 2, 2, 3, 3, 4, 5, 6, 7, 7, 8, 8, 9, 11, 11, 12, 12, 13),
    (2, 3, 6, 4, 5, 5, 10, 5, 4, 8, 5, 10, 8, 9, 12, 7, 8, 11),
)
NODES = [5, 8, 1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13]
AREA = np.pi / 4


def water(t, y, yd, args):
    """Flows, frictions and pressures, y = (φ, λ, p): a tube is turbulent beyond a Reynolds number of 2300."""
    flow, friction, pressure = y[:18], y[18:36], y[36:]
    first, last = (np.array([NODES.index(node) for node in ends]) for ends in TUBES)
    hours = t / 3600
    supply, demand = 1 - jnp.cos(jnp.exp(-hours) - 1), hours**2 * (3 * hours**2 - 92 * hours + 720) / 1e6
    outside = [(1, supply / 200), (13, supply / 80), (10, -demand)]
    net = sum(jnp.zeros(13).at[NODES.index(node)].set(value) for node, value in outside)
    net = net.at[last].add(flow).at[first].add(-flow)
    reynolds, root = jnp.abs(flow) / (1.31e-6 * AREA), jnp.sqrt(friction)
    colebrook = 1 / root - 1.74 + 2 * jnp.log10(4e-4 + 18.7 / (jnp.maximum(reynolds, 2300.0) * root))
    loss = jnp.where(reynolds > 2300, friction * 1e6 * flow**2 / AREA**2, 32 * 1.31 * flow / AREA)
    driven = 1e6 / AREA * yd[:18] - pressure[first] + pressure[last] + loss
    return jnp.concatenate([driven, colebrook, jnp.where(np.arange(13) < 2, 200 / 9800, 0.0) * yd[36:] - net])


def test_water_in_tubes_ends_as_published():
    """Problem "Water tube system" of index 2, solved by PSIDE there; friction jumps where a tube becomes turbulent, unannounced."""
    laminar = 0.47519404529185289807e-1
    control = diffrax.PIDController(rtol=1e-8, atol=np.repeat([1e-12, 1e-10, 1e-4], [18, 18, 13]))
    y = dae_jax.daesolve(
        dae_jax.ImplicitDAE(water), dae_jax.RadauIIA5(), 0.0, 61200.0, None,
        np.repeat([0.0, laminar, 109800.0], [18, 18, 13]), stepsize_controller=control, max_steps=20_000,
    ).ys[-1]  # fmt: skip
    flows = [0.2298488296477430e-2, 0.1188984650746585e-2, 0.1109503645730845e-2, 0.1589620100314825e-3]
    flows += [0.1030022640715102e-2, 0.8710606306836165e-3, 0.3243571480903489e-2, 0.1109503645730845e-2]
    flows += [0.7120986206521341e-3, 0.6414613963833099e-3, 0.9416978549524347e-3, 0.3403428519096511e-2]
    flows += [0.2397639310739395e-2, 0.2397639310739395e-2, 0.3348581430454180e-2, 0.1353560017035444e-2]
    flows += [0.1995021413418736e-2, 0.5746220741193575e-2]
    frictions = np.full(18, 0.4751940452918529e-1)
    frictions[[6, 11, 12, 13, 14, 17]] = [
        0.4311196778792902e-1,
        0.4249217433601160e-1,
        0.4732336439609648e-1,
        0.4732336439609648e-1,
        0.4270002118868241e-1,
        0.3651427026675656e-1,
    ]
    pressures = [0.1111268591478108e6, 0.1111270045592387e6, 0.1111271078730254e6, 0.1111269851929858e6]
    pressures += [0.1111269255355337e6, 0.1111269322658045e6, 0.1111269221703983e6, 0.1111270121140691e6]
    pressures += [0.1111274419515807e6, 0.1111255158881087e6, 0.1111278793439227e6, 0.1111270995171642e6]
    pressures += [0.1111298338971779e6]
    np.testing.assert_allclose(y, [*flows, *frictions, *pressures], rtol=1e-6)
