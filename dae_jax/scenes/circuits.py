"""Electrical circuits by their nodes: an amplifier of two transistors, and a loop of capacitors."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE
from ..types import Args, Time
from .scene import Scene, published


def amplifier() -> Scene[ImplicitDAE]:
    """Two transistors amplify U(t) = 0.1 sin(200 π t) volts; eight node voltages, five capacitors; index 1, C singular.

    A transistor lets β(e^(u/U_F) − 1) through its emitter, the part α of it through its collector.

    Source: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008), problem "Transistor amplifier".
    """
    supply, thermal, alpha, beta, r0, r = 6.0, 0.026, 0.99, 1e-6, 1000.0, 9000.0
    c1, c2, c3, c4, c5 = (1e-6 * k for k in range(1, 6))

    def residual(t: Time, y: Array, yd: Array, args: Args):
        u = 0.1 * jnp.sin(200 * jnp.pi * t)
        first, second = (beta * (jnp.exp((y[b] - y[e]) / thermal) - 1) for b, e in ((1, 2), (4, 5)))
        return jnp.stack(
            [
                c1 * (yd[1] - yd[0]) - (y[0] - u) / r0,
                c1 * (yd[0] - yd[1]) + (supply - 2 * y[1]) / r + (alpha - 1) * first,
                -c2 * yd[2] - y[2] / r + first,
                c3 * (yd[4] - yd[3]) + (supply - y[3]) / r - alpha * first,
                c3 * (yd[3] - yd[4]) + (supply - 2 * y[4]) / r + (alpha - 1) * second,
                -c4 * yd[5] - y[5] / r + second,
                c5 * (yd[7] - yd[6]) + (supply - y[6]) / r - alpha * second,
                c5 * (yd[6] - yd[7]) - y[7] / r,
            ]
        )

    start = np.array([0, supply / 2, supply / 2, supply, supply / 2, supply / 2, supply, 0])
    end = np.array(
        [
            -0.5562145012262709e-2,
            3.006522471903042,
            2.849958788608128,
            2.926422536206241,
            2.704617865010554,
            2.761837778393145,
            4.770927631616772,
            1.236995868091548,
        ]
    )
    return Scene("amplifier", ImplicitDAE(residual), start, 0.2, published(0.2, end), index=1)


def capacitor_loop(c1: float = 2.0, c2: float = 1.0, resistance: float = 0.5) -> Scene[ImplicitDAE]:
    """A source sin t in a loop with two capacitors, a resistor beside the second; y = (v₁, v₂, i), index 2:

        0 = C₁ (v̇₁ − v̇₂) + i,   0 = C₁ (v̇₂ − v̇₁) + C₂ v̇₂ + v₂/R,   0 = v₁ − sin t.

    With τ = R (C₁ + C₂) and k = R C₁: v₂ = k (cos t + τ sin t − e^(−t/τ))/(1 + τ²), i = −C₁ (v̇₁ − v̇₂).
    """
    tau, k = resistance * (c1 + c2), resistance * c1

    def residual(t: Time, y: Array, yd: Array, args: Args):
        loop = c1 * (yd[0] - yd[1])
        return jnp.stack([loop + y[2], c2 * yd[1] - loop + y[1] / resistance, y[0] - jnp.sin(t)])

    def reference(times: np.ndarray):
        t = np.asarray(times, float)
        decay = np.exp(-t / tau)
        v2 = k * (np.cos(t) + tau * np.sin(t) - decay) / (1 + tau**2)
        v2_dot = k * (tau * np.cos(t) - np.sin(t) + decay / tau) / (1 + tau**2)
        return np.stack([np.sin(t), v2, -c1 * (np.cos(t) - v2_dot)], 1)

    start = reference(np.zeros(1))[0]
    return Scene("capacitor-loop", ImplicitDAE(residual), start, 10.0, reference, index=2)
