"""A transistor between two capacitors on a pulsed voltage: nanoseconds and picocoulombs, kinks in time and in the charges."""

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE
from ..types import Args, Time
from .scene import Scene


# Threshold in V, body effect in √V, surface potential in V; the capacitances of the gate, at source and at drain, in F.
THRESHOLD, GAMMA, PHI = 0.2, 0.035, 1.01
GATE, SOURCE, DRAIN = 4e-12, 1.6e-12, 0.4e-12
FLAT = THRESHOLD - GAMMA * PHI**0.5 - PHI
# The voltage rises to HIGH between RISES and STAYS of each PERIOD, and falls after FALLS.
HIGH, RISES, STAYS, FALLS, PERIOD, END = 20.0, 50e-9, 60e-9, 110e-9, 120e-9, 1200e-9

# Of one transistor, or at all times.
Voltage = Array | np.ndarray | float


def charge_pump() -> Scene[ImplicitDAE]:
    """A MOS transistor whose charges q_g, q_s, q_d follow its voltages at once, between two capacitors; index 2,
    y = (q_g, p_s, q_s, p_d, q_d, u_g, u_s, u_d, i):

        q̇_g = −i,   ṗ_s + q̇_s = 0,   ṗ_d + q̇_d = 0,   u_g = V(t),   p_s = C_s u_s,   p_d = C_d u_d.

    V is a trapezoid of 20 V and 120 ns. The reference needs one equation in one unknown for each time: p + q does not change
    at source and drain.

    Source: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008), problem "Charge pump", after M. Günther,
    G. Denk, U. Feldmann, *How models for MOS transistors reflect charge distribution effects* (1995).
    """

    def residual(t: Time, y: Array, yd: Array, args: Args):
        gate, source, drain = y[5], y[6], y[7]
        on_gate, in_channel = _charges(jnp, gate, gate - source, gate - drain)
        conserved = [yd[0] + y[8], yd[1] + yd[2], yd[3] + yd[4]]
        capacitors = [y[1] - SOURCE * source, y[3] - DRAIN * drain]
        transistor = [y[0] - on_gate, y[2] - in_channel, y[4] - in_channel]
        return jnp.stack([*conserved, gate - _pulse(jnp, t), *capacitors, *transistor])

    start = _state(0.0, 0.0)
    kinks = [k * PERIOD + x for k in range(10) for x in (RISES, STAYS, FALLS, PERIOD)]
    return Scene(
        "charge-pump", ImplicitDAE(residual), start, END, _reference, index=2, scale=1e-3, kinks=tuple(kinks[:-1])
    )


def _pulse(xp: ModuleType, t: Time):
    within, slope = t % PERIOD, HIGH / (STAYS - RISES)
    return xp.clip(xp.minimum((within - RISES) * slope, (PERIOD - within) * slope), 0.0, HIGH)


def _charges(xp: ModuleType, to_bulk: Voltage, to_source: Voltage, to_drain: Voltage):
    """The charge on the gate, and that at source and at drain each, from the gate's voltage to bulk, source and drain."""
    larger, smaller = xp.maximum(to_source, to_drain), xp.minimum(to_source, to_drain)
    depth = xp.sqrt(PHI - (larger - to_bulk))
    threshold = THRESHOLD + GAMMA * (depth - PHI**0.5)
    a, b = xp.maximum(larger - threshold, 0), xp.maximum(smaller - threshold, 0)
    channel = a + b - a * b / xp.where(a + b > 0, a + b, 1)
    depleted = GAMMA * (xp.sqrt((GAMMA / 2) ** 2 + xp.maximum(to_bulk - FLAT, 0)) - GAMMA / 2)
    charge = xp.where(larger > threshold, 2 / 3 * channel + GAMMA * depth, depleted)
    return GATE * xp.where(to_bulk > FLAT, charge, to_bulk - FLAT), -GATE / 3 * channel


def _state(voltage: float, current: float) -> np.ndarray:
    """y for u_g = `voltage`: what the channel holds has left the capacitors."""
    from scipy.optimize import brentq

    def charges(moved: float):
        return _charges(np, voltage, voltage - moved / SOURCE, voltage - moved / DRAIN)

    moved: Any = brentq(lambda x: x + charges(x)[1], 0.0, GATE * HIGH, xtol=1e-28, rtol=np.float64(1e-14))
    gate, channel = charges(moved)
    return np.array([gate, moved, channel, moved, channel, voltage, moved / SOURCE, moved / DRAIN, current])


def _reference(times: np.ndarray):
    # The current is known where the voltage does not change, and at the end, where it is published; at a kink it jumps.
    current = lambda t: 0.1522565920949845e-3 if t == END else np.nan if _changes(t) else 0.0
    return np.stack([_state(float(_pulse(np, t)), current(t)) for t in np.asarray(times, float)])


def _changes(t: Time):
    within, near = t % PERIOD, 1e-9 * PERIOD
    return RISES - near < within < STAYS + near or within > FALLS - near or (within < near and t > near)
