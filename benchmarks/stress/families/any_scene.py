"""A mechanism of the library under stressors that fit all: its constraints scaled, tolerances, a force that breaks, a start that
is off, float32.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from dae_jax.scenes import SCENES

from ..cases import Case


def cases(name, quick):
    """The truth is the scene's own, which does not come from the library either."""
    scene = SCENES[name]()
    system, (q, v) = scene.system, scene.y0
    t1 = scene.t1 / 10 if scene.horizon > scene.t1 / 10 else scene.horizon
    if np.isnan(scene.reference(np.array([t1]))[0]).any():
        t1 = scene.t1
    inner_force, inner_constraint, inner_rolling = system.force, system.constraint, system.nonholonomic

    def force(t, q, v, args):
        own, stress = args
        return inner_force(t, q, v, own) + jnp.where(t > stress["nan after"], jnp.nan, 0.0)

    def constraint(t, q, args):
        return args[1]["factor"] * inner_constraint(t, q, args[0])

    def rolling(t, q, v, args):
        return args[1]["factor"] * inner_rolling(t, q, v, args[0])

    mass = system.mass
    stressed = dataclasses.replace(
        system, force=force, constraint=inner_constraint and constraint, nonholonomic=inner_rolling and rolling, potential=None,
        mass=(lambda q, args: mass(q, args[0])) if callable(mass) else mass,
    )  # fmt: skip
    scaled = scene.scale if np.ndim(scene.scale) == 0 else 1.0
    known = [np.nan_to_num(x) for x in scene.reference(np.linspace(0, t1, 21))]
    size = tuple(max(float(np.abs(x).max()), scaled) for x in known)
    chart = None if scene.chart is None else scene.chart

    def case(name, y0=(q, v), factor=1.0, nan=np.inf, **rest):
        args = (scene.args, {"factor": np.asarray(factor), "nan after": np.asarray(nan)})
        return Case(name, stressed, y0, t1, scene.reference, args, size, rate=10 / t1, steps=4000, chart=chart, **rest)

    found = [
        case("as it is"),
        case("constraints × 1e8", factor=1e8),
        case("constraints × 1e-8", factor=1e-8),
        case("force NaN from half-time", nan=t1 / 2, due="failure", ends=t1 / 2),
        case("start off by 1e-2", y0=(q * 1.01, v), due="refusal", off=1e-2),
    ]
    if quick:
        return found[:2]
    return [*found, *(case(f"tolerance {rtol:g}", rtol=rtol) for rtol in (1e-2, 1e-4, 1e-6, 1e-10, 1e-12))]
