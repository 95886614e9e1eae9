"""Tolerances from 1e-2 to 1e-14, and float32 throughout: a double pendulum for 2 s and a fast pendulum."""

import dataclasses

import numpy as np

from . import scales


TOLERANCES = tuple(10.0**-k for k in range(2, 15, 2))


def cases(quick):
    """Fixed steps know no tolerance: they are in float32 only."""
    system = scales.two_rods("", t1=6.0)
    adaptive = scales.with_tolerance()
    found = [dataclasses.replace(system, name=f"tolerance {rtol:g}", rtol=rtol, only=adaptive) for rtol in TOLERANCES]
    single = lambda tree: {name: np.asarray(x, np.float32) for name, x in tree.items()}
    y0 = tuple(x.astype(np.float32) for x in system.y0)
    mass = system.system.mass.astype(np.float32)
    small = dataclasses.replace(
        system, name="float32", rtol=1e-5, y0=y0, args=single(system.args), steps=2000,
        system=dataclasses.replace(system.system, mass=mass),
    )  # fmt: skip
    return [*found, small]


def figures(folder, quick, cells):
    """Error against tolerance, each method a curve."""
    from matplotlib.figure import Figure

    from dae_jax.app.plotting.common import look

    curves = {}
    for cell in cells:
        if cell.stressor.startswith("tolerance") and cell.ended == "answer":
            curves.setdefault(cell.method, []).append((float(cell.stressor.split()[1]), cell.error))
    if not curves:
        return {}
    shown = Figure(figsize=(7.2, 4.8), layout="constrained", dpi=160)
    axes = shown.subplots()
    ends = np.array([TOLERANCES[-1], TOLERANCES[0]])
    axes.fill_between(ends, ends, 1e3 * ends, color="#3E8E7E", alpha=0.12, linewidth=0, label="1 to 1,000 tolerances")
    for i, (method, points) in enumerate(curves.items()):
        axes.plot(*zip(*points, strict=True), label=method, **(look(f"{method}:", i) | {"markersize": 4}))
    axes.set(xscale="log", yscale="log", xlabel="rtol = atol", ylabel="largest error, relative", ylim=(1e-15, 2))
    axes.invert_xaxis()
    axes.grid(alpha=0.3, linewidth=0.5)
    shown.legend(loc="outside right upper", frameon=False, fontsize="small")
    shown.savefig(folder / "stress-tolerances.png")
    steepest = {
        m: np.polyfit(*np.log10(list(zip(*points, strict=True))), 1)[0]
        for m, points in curves.items()
        if len(points) > 2
    }
    low, high = (f"{steepest[m]:.2f} ({m})" for m in (min(steepest, key=steepest.get), max(steepest, key=steepest.get)))
    said = f"Error against tolerance on a double pendulum: the errors fall with powers of the tolerance from {low} to {high}."
    return {"stress-tolerances.png": said}
