"""Masses, lengths, constraints, time spans and units over many decades: the answer may not depend on them beyond rounding.
A double pendulum, which also starts folded, with its tip at its pivot, where its constraints are not singular. Each unknown has a
tolerance of its own, a part of its size; or all have one number, that of the smallest.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

import dae_jax as dj

from ..cases import METHODS, Case
from .truth import by_angles


G = 9.81


def force(t, q, v, a):
    """Weights of two masses; y points down. Coordinates are in units of their own: x = u q."""
    return a["mass"] * a["unit"] * a["gravity"] * jnp.array([0.0, 1.0, 0.0, 1.0])


def constraint(t, q, a):
    """Two rods; each with a factor."""
    x = (q * a["unit"]).reshape(2, 2)
    rods = jnp.stack([x[0] @ x[0], (x[1] - x[0]) @ (x[1] - x[0])])
    return a["factor"] * (rods - a["length"] ** 2) / 2


def two_rods(
    name,
    masses=(1.0, 1.0),
    lengths=(1.0, 1.0),
    gravity=G,
    factors=(1.0, 1.0),
    units=(1.0,) * 4,
    t1=2.0,
    fastest=1.0,
    angles=(1.0, 0.5),
):
    """A double pendulum released from rest at two angles from the vertical; `t1` is in units of √(ℓ₁/g)."""
    (m1, m2), (l1, l2) = masses, lengths
    unit, time = np.array(units), np.sqrt(l1 / gravity)
    ratio, short = m2 / (m1 + m2), l2 / l1

    def field(t, z):
        # Lagrange's equations, divided by (m₁ + m₂) ℓ₁² and m₂ ℓ₁ ℓ₂, in units of ℓ₁ and √(ℓ₁/g): nothing is large or small.
        (a, b), (da, db) = z[:2], z[2:]
        c, s = np.cos(a - b), np.sin(a - b)
        matrix = np.array([[1.0, ratio * short * c], [c, short]])
        right = [-ratio * short * s * db**2 - np.sin(a), s * da**2 - np.sin(b)]
        return np.concatenate([z[2:], np.linalg.solve(matrix, right)])

    def embed(t, z):
        (a, b), (da, db) = z[:2], z[2:] / time
        first, second = l1 * np.array([np.sin(a), np.cos(a)]), l2 * np.array([np.sin(b), np.cos(b)])
        turned = lambda x, rate: rate * np.array([x[1], -x[0]])
        v1, v2 = turned(first, da), turned(second, db)
        return np.concatenate([first, first + second]) / unit, np.concatenate([v1, v1 + v2]) / unit

    z0 = np.array([*angles, 0.0, 0.0])
    scaled = by_angles(field, z0, embed)
    mass = np.array([m1, m1, m2, m2]) * unit**2
    args = {"mass": mass / unit**2, "unit": unit, "gravity": np.asarray(gravity), "factor": np.array(factors),
            "length": np.array(lengths)}  # fmt: skip
    size = (l1 / unit, np.sqrt(l1 * gravity) / unit)
    system = dj.ConstrainedSystem(force, constraint, mass)
    return Case(
        name, system, embed(0, z0), t1 * time, lambda times: scaled(np.asarray(times) / time), args, size, rate=fastest / time,
        steps=2000, chart=chart, tolerance_each=True,
    )  # fmt: skip


def chart(t, z, a):
    """The angles."""
    bars = a["length"][:, None] * jnp.stack([jnp.sin(z), jnp.cos(z)], 1)
    return jnp.ravel(jnp.cumsum(bars, 0)) / a["unit"]


def with_tolerance():
    """The methods that choose their steps."""
    return tuple(name for name, method in METHODS.items() if method.order is None)


def cases(quick):
    """All start alike, so that they share one program a method."""
    small = {"as it is": {}, "masses 1e8": {"masses": (1e8, 1e8)}, "masses 1e-8": {"masses": (1e-8, 1e-8)}}
    if quick:
        return [two_rods(name, **what) for name, what in small.items()]
    found = [two_rods(name, **what) for name, what in {**small, **MORE}.items()]
    tiny = next(case for case in found if case.name == "lengths 1e-6")
    mixed = [
        dataclasses.replace(case, name=f"{case.name}, one tolerance", tolerance_each=False)
        for case in found
        if case.name in MIXED
    ]
    off = {"y0": (tiny.y0[0] * 1.01, tiny.y0[1]), "off": 1e-2, "due": "refusal"}
    return [*found, *mixed, dataclasses.replace(tiny, name="lengths 1e-6, off by 1 %", **off)]


MORE = {
    "folded rods": {"angles": (1.0, 1.0 + np.pi), "fastest": 2.0},
    # The other way round the light mass snaps between two rods that become taut, at frequencies of 1e8: no truth is known.
    "masses 1e-8 below 1e8": {"masses": (1e8, 1e-8)},
    "lengths 1e6": {"lengths": (1e6, 1e6)},
    "lengths 1e-6": {"lengths": (1e-6, 1e-6)},
    "lengths 1 and 1e-3": {"lengths": (1.0, 1e-3), "fastest": 32.0},
    "constraints × 1e8": {"factors": (1e8, 1e8)},
    "constraints × 1e-8": {"factors": (1e-8, 1e-8)},
    "constraints × 1e8, 1e-8": {"factors": (1e8, 1e-8)},
    "time span 1e-9 s": {"gravity": 4e18},
    "time span 1e9 s": {"gravity": 4e-18},
    "units mixed by 1e12": {"units": (1e-6, 1e6, 1e-6, 1e6)},
}
# Also with one number for all tolerances, that of the smallest unknown.
MIXED = ("time span 1e9 s", "units mixed by 1e12")
