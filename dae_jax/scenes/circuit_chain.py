"""Amplifiers of one transistor each, one after the other; index 1."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE
from ..types import Args, Time
from .scene import Scene, minimal


SUPPLY, THERMAL, ALPHA, BETA, R0, R = 6.0, 0.026, 0.99, 1e-6, 1000.0, 9000.0
# More stages are too much for the dense Jacobians of the reference.
KNOWN = 30


def circuit_chain(n: int = 3) -> Scene[ImplicitDAE]:
    """n stages of `amplifier` in a row amplify U(t) = 0.1 sin(200 π t) volts: two of them are that scene; index 1, 3 n + 2 unknowns.

    y are the voltages at the input, at base, emitter and collector of each transistor, and at the output. n + 1 capacitors
    couple the input with a base, a collector with the next base, the last with the output; n are beside the emitters.

    The reference has as its unknowns the voltages of the capacitors; those of the nodes follow one after the other, by Wright's ω.

    Source: as of `amplifier`, of which a row of stages is the obvious extension.
    """
    # Capacities as in the amplifier of two; all further ones are as its last.
    coupling = 1e-6 * np.minimum(2 * np.arange(n + 1) + 1.0, 5)
    beside = 1e-6 * np.minimum(2 * np.arange(n) + 2.0, 4)

    def residual(t: Time, y: Array, yd: Array, args: Args):
        left, right, emitter = y[0::3], y[1::3], y[2::3]
        emitted = BETA * (jnp.exp((right[:-1] - emitter) / THERMAL) - 1)
        into_left, into_right = currents(jnp, t, left, right, emitted)
        through = coupling * (yd[1::3] - yd[0::3])
        return through + into_left, into_right - through, emitted - emitter / R - beside * yd[2::3]

    # What is in parallel to the base of each transistor, and to the output.
    ohmic = np.array([1 / R0 + 2 / R, *[3 / R] * (n - 1), 2 / R])

    def field(t: float, z: np.ndarray) -> np.ndarray:
        right, emitted = nodes(t, z)
        into_left, _ = currents(np, t, right - z[: n + 1], right, emitted)
        return np.concatenate([-into_left / coupling, (emitted - z[n + 1 :] / R) / beside])

    def nodes(t: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Right of the capacitors, and through the emitters: what flows into both sides of a capacitor is nothing."""
        from scipy.special import wrightomega

        short, _ = currents(np, t, -z[: n + 1], np.zeros(n + 1), np.zeros(n))
        short += np.array([*[SUPPLY / R] * n, 0.0])
        right, emitted, before = np.empty(n + 1), np.empty(n), 0.0
        for k in range(n + 1):
            # 0 = short − ohmic u − α before − (1 − α) β (e^((u − e)/U_F) − 1)
            u = (short[k] - ALPHA * before) / ohmic[k]
            if k < n:
                small = (1 - ALPHA) * BETA / ohmic[k]
                u += small
                u -= THERMAL * wrightomega(np.log(small / THERMAL) + (u - z[n + 1 + k]) / THERMAL)
                emitted[k] = before = BETA * np.expm1((u - z[n + 1 + k]) / THERMAL)
            right[k] = u
        return right, emitted

    def embed(t: float, z: np.ndarray) -> np.ndarray:
        right, _ = nodes(t, z)
        stages = np.stack([right[:-1], z[n + 1 :], (right - z[: n + 1])[1:]], 1)
        return np.concatenate([right[:1] - z[:1], stages.ravel(), right[-1:]])

    start = np.array([0.0, *[SUPPLY / 2, SUPPLY / 2, SUPPLY] * n, 0.0])
    z0 = np.concatenate([start[1::3] - start[0::3], start[2::3]])
    unknown = lambda times: np.full((len(times), 3 * n + 2), np.nan)
    reference = minimal(field, z0, embed, "LSODA", max_step=np.inf) if n <= KNOWN else unknown
    return Scene(f"circuit-chain-{n}", ImplicitDAE(residual), start, 0.2, reference, index=1)


def currents(xp, t: Time, left, right, emitted):
    """Into the nodes left of the coupling capacitors and those right of them, but for the capacitors' own; `emitted` by
    the transistors, of which the part 1 − α comes from the base.
    """
    source = 0.1 * xp.sin(200 * xp.pi * t)
    into_input = (source - left[:1]) / R0
    into_collectors = (SUPPLY - left[1:]) / R - ALPHA * emitted
    into_bases = (SUPPLY - 2 * right[:-1]) / R - (1 - ALPHA) * emitted
    return xp.concatenate([into_input, into_collectors]), xp.concatenate([into_bases, -right[-1:] / R])
