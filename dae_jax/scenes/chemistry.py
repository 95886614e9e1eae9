"""Stiff reactions with conservation laws: Robertson's, many of them, and the Akzo Nobel problem; all of index 1."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE, SemiExplicitDAE
from ..types import Args, Time
from .scene import Scene, minimal, published


def robertson() -> Scene[SemiExplicitDAE]:
    """H. H. Robertson's autocatalytic reaction with the conservation of mass as an equation; x = (y₁, y₂), z = y₃.

        ẏ₁ = −0.04 y₁ + 10⁴ y₂ y₃,   ẏ₂ = 0.04 y₁ − 10⁴ y₂ y₃ − 3·10⁷ y₂²,   0 = y₁ + y₂ + y₃ − 1.

    Source of the end values: F. Mazzia, C. Magherini, *Test Set for IVP Solvers* 2.4 (Bari, 2008).
    """

    def f(t: Time, x: Array, z: Array, args: Args):
        forth, back, twice = 0.04 * x[0], 1e4 * x[1] * z[0], 3e7 * x[1] ** 2
        return jnp.stack([back - forth, forth - back - twice])

    system = SemiExplicitDAE(f, lambda t, x, z, args: jnp.stack([x[0] + x[1] + z[0] - 1]))
    end = (np.array([0.2083340149701255e-7, 0.8333360770334713e-13]), np.array([0.9999999791665050]))
    start = (np.array([1.0, 0.0]), np.array([0.0]))
    return Scene("robertson", system, start, 1e11, published(1e11, end), index=1, scale=1e-6, stiff=True, first=1e-6)


def robertson_copies(n: int = 4, spread: float = 0.0) -> Scene[SemiExplicitDAE]:
    """n copies of Robertson's reaction side by side, 3 n unknowns; x = (y₁, y₂) of shape (2, n), z = y₃ of shape (n,).

    `args` are the three rates of each, (3, n), spread by factors e^(spread · N(0, 1)). The reference eliminates y₃; where
    rates differ it is known of the first copies only, all else is NaN.

    Source: as of `robertson`, which goes on to t = 10¹¹; the end 4 · 10¹⁰ is that of SUNDIALS' idaRoberts.
    """
    random = np.random.default_rng(0).standard_normal((3, n))
    rates = np.array([0.04, 1e4, 3e7])[:, None] * np.exp(spread * random)

    def f(t: Time, x: Array, z: Array, args: Args):
        forth, back, twice = args[0] * x[0], args[1] * x[1] * z, args[2] * x[1] ** 2
        return jnp.stack([back - forth, forth - back - twice])

    known = min(n, 4) if spread else 1
    of_copy = [_one_robertson(tuple(k)) for k in rates.T[:known].tolist()]

    def reference(times: np.ndarray):
        found = np.stack([copy(times) for copy in of_copy], -1)
        if spread:
            found = np.pad(found, ((0, 0), (0, 0), (0, n - known)), constant_values=np.nan)
        y = np.broadcast_to(found, (*found.shape[:2], n))
        return y[:, :2], y[:, 2]

    system = SemiExplicitDAE(f, lambda t, x, z, args: x[0] + x[1] + z - 1)
    start = np.array([np.ones(n), np.zeros(n)]), np.zeros(n)
    return Scene(
        f"robertson-{n}", system, start, 4e10, reference, args=rates, index=1, scale=1e-4, stiff=True, first=1e-6
    )


@functools.cache
def _one_robertson(rates: tuple[float, float, float]):
    k1, k2, k3 = rates

    def field(t: float, y: np.ndarray) -> np.ndarray:
        flow = k1 * y[0] - k2 * y[1] * (1 - y[0] - y[1])
        return np.array([-flow, flow - k3 * y[1] ** 2])

    return minimal(field, [1.0, 0.0], lambda t, y: np.array([*y, 1 - y[0] - y[1]]), "LSODA", max_step=np.inf)


def akzo_nobel() -> Scene[ImplicitDAE]:
    """The chemical Akzo Nobel problem: six species, one of them in equilibrium, carbon dioxide dissolved from the gas.

    Source: as of `robertson`; the equations and end values of its problem "Chemical Akzo Nobel".
    """
    k1, k2, k3, k4, equilibrium, inflow, dissolution, pressure, henry = (
        18.7,
        0.58,
        0.09,
        0.42,
        34.4,
        3.3,
        115.83,
        0.9,
        737.0,
    )

    def residual(t: Time, y: Array, yd: Array, args: Args):
        a, oxygen, b, c, d, e = y
        root = jnp.sqrt(oxygen)
        r1, r2, r3 = k1 * a**4 * root, k2 * b * c, k2 / equilibrium * a * d
        r4, r5 = k3 * a * c**2, k4 * e**2 * root
        return jnp.stack(
            [
                yd[0] + 2 * r1 - r2 + r3 + r4,
                yd[1] + r1 / 2 + r4 + r5 / 2 - inflow * (pressure / henry - oxygen),
                yd[2] - r1 + r2 - r3,
                yd[3] + r2 - r3 + 2 * r4,
                yd[4] - r2 + r3 - r5,
                dissolution * a * c - e,
            ]
        )

    start = np.array([0.444, 0.00123, 0.0, 0.007, 0.0, dissolution * 0.444 * 0.007])
    end = np.array(
        [
            0.1150794920661702,
            0.1203831471567715e-2,
            0.1611562887407974,
            0.3656156421249283e-3,
            0.1708010885264404e-1,
            0.4873531310307455e-2,
        ]
    )
    return Scene(
        "akzo-nobel", ImplicitDAE(residual), start, 180.0, published(180.0, end), index=1, scale=1e-3, stiff=True
    )
