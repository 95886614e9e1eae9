"""The maps and the tuning that the command line draws: α and β of a mechanism, initial angles of one that has two."""

import functools
from pathlib import Path
from typing import Any, NamedTuple, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..scenes import Scene
from ..solution import RESULTS
from ..solve import daesolve
from ..solvers import DOP853, OrthogonalProjection
from ..studies.baumgarte_loss import FAILED, BaumgarteLoss, Verification, baumgarte_loss
from ..studies.grid import grid
from ..studies.reductions import first_flip, lyapunov
from ..studies.sweep import sweep
from ..studies.tune import descent
from ..systems import ConstrainedSystem
from . import plotting


# Where a descent starts: values that are common, and too stiff for most steps.
START = {"alpha": 20.0, "beta": 20.0}
# Explicit steps of dt0 are stable up to about dt0 |s| = 3; the map goes a little beyond, and three decades down.
BEYOND, DECADES = 4.0, 3


class Point(NamedTuple):
    """A point of a descent, and the solves that verify it."""

    alpha: float
    beta: float
    loss: float
    verification: Verification


def loss_of(scene: Scene[ConstrainedSystem], t1: float, dt0: float) -> BaumgarteLoss:
    """The loss of Baumgarte's parameters for a mechanism, against the scene's own reference where that is known at every time."""
    known = all(np.isfinite(x).all() for x in jax.tree.leaves(scene.reference(np.linspace(0, t1, 3))))
    reference = scene.reference if known else None
    return baumgarte_loss(scene.system, scene.y0, t1, dt0=dt0, args=scene.args, reference=reference)


def baumgarte_map(loss: BaumgarteLoss, points: int, store: Path | None, progress: bool = True) -> dict[str, np.ndarray]:
    """The loss, the drift and the error over α and β, from harmless to unstable."""
    axis = BEYOND / loss.dt0 * np.logspace(-DECADES, 0, points)

    def of_pair(p: dict[str, Any]) -> Any:
        drift, error, _, result = loss.parts(p)
        return loss(p), drift, error, result

    values, drift, error, result = sweep(of_pair, grid(alpha=axis, beta=axis), store=store, progress=progress)
    failed = np.asarray(result != RESULTS.successful) | (np.asarray(values) >= FAILED)
    return {"alpha": axis, "beta": axis, "loss": values, "drift": drift, "error": error, "failed": failed}


def angle_map(
    scene: Scene[ConstrainedSystem], points: int, t1: float, rtol: float, store: Path | None, progress: bool = True
) -> dict[str, np.ndarray]:
    """A scene with a chart in two angles, released at rest: the time of the first flip of any of its links, and the
    finite-time Lyapunov exponent.
    """
    system, chart, drawing = scene.system, scene.chart, scene.drawing
    assert chart is not None
    assert drawing is not None
    solver = OrthogonalProjection(DOP853())
    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    times = np.linspace(0, t1, max(int(t1 / 0.04), 2) + 1)

    def of_angles(p: dict[str, Any]) -> Any:
        q0 = chart(jnp.stack([p["first"], p["second"]]))
        y0 = (q0, jnp.zeros_like(q0))
        sol = daesolve(
            system,
            solver,
            0.0,
            t1,
            None,
            y0,
            saveat=diffrax.SaveAt(ts=cast(Array, times)),
            stepsize_controller=controller,
            throw=False,
        )
        shown = jax.vmap(drawing.points)(sol.ts, sol.ys[0])
        flips = [first_flip(sol.ts, shown[:, end] - shown[:, start]) for start, end in drawing.links]
        exponent = lyapunov(system, solver, 0.0, t1, y0, stepsize_controller=controller, throw=False)
        return functools.reduce(jnp.minimum, flips), exponent, sol.result

    # Half a cell off the middle, where both arms hang straight down and nothing moves.
    axis = (np.arange(points) + 0.5) / points * 2 * np.pi - np.pi
    flip, exponent, result = sweep(of_angles, grid(first=axis, second=axis), store=store, progress=progress)
    failed = np.asarray(result != RESULTS.successful)
    return {"first": axis, "second": axis, "flip": flip, "lyapunov": exponent, "failed": failed}


def write_baumgarte_map(scene: Scene, t1: float, dt0: float, points: int, folder: Path, progress: bool) -> list[Path]:
    """The map as figure and data; the paths."""
    found = baumgarte_map(loss_of(scene, t1, dt0), points, folder / "store", progress)
    title = f"{scene.name} for {t1:g} s, Tsit5 with steps of {dt0:g} s"
    shown, best = np.where(found["failed"], np.nan, found["loss"]), None
    if not found["failed"].all():
        low = np.unravel_index(np.nanargmin(shown), shown.shape)
        best = (found["alpha"][low[0]], found["beta"][low[1]])
        title += f": best α = {best[0]:.3g}, β = {best[1]:.3g}"
    figure = plotting.sweep_map(
        found["alpha"], found["beta"], shown, ("α in 1/s", "β in 1/s", "loss (decades of drift and of error)"), title,
        log=True, mark=best, blank=f"failed: {np.mean(found['failed']):.0%}",
    )  # fmt: skip
    return _write(folder, f"baumgarte-{scene.name}", figure, found)


def write_angle_map(scene: Scene, t1: float, rtol: float, points: int, folder: Path, progress: bool) -> list[Path]:
    """Both maps as figures, and the data; the paths."""
    found = angle_map(scene, points, t1, rtol, folder / "store", progress)
    degrees = np.degrees(found["first"])
    axes = ("first angle in °", "second angle in °")
    flips = np.where(np.isfinite(found["flip"]), found["flip"], np.nan)
    failed = f"failed: {np.mean(found['failed']):.0%}" if found["failed"].any() else ""
    no_flip = ", or ".join(filter(None, (f"no flip within {t1:g} s", failed)))
    written = []
    for name, values, label, log, blank in (
        ("flip", flips, "time of the first flip in s", True, no_flip),
        ("lyapunov", found["lyapunov"], f"Lyapunov exponent over {t1:g} s in 1/s", False, failed),
    ):
        figure = plotting.sweep_map(
            degrees, degrees, values, (*axes, label), f"{scene.name}, released at rest", log_values=log,
            blank=blank,
        )  # fmt: skip
        written += _write(folder, f"angles-{name}", figure, found)
    return written


def write_tuned(
    scene: Scene, t1: float, dt0: float, steps: int, starts: int, folder: Path, progress: bool
) -> tuple[Point, Point, list[Path]]:
    """Before and after the descent, and the paths of figure and data. The data are written while it goes on."""
    loss = loss_of(scene, t1, dt0)
    arrays, picture = folder / f"tune-{scene.name}.npz", folder / f"tune-{scene.name}.png"
    for tuned in descent(loss, START, steps=steps, starts=starts, progress=progress):
        history = tuned.history
        np.savez(arrays, loss=history.loss, best=history.best, **history.params)
    start = jax.tree.map(lambda x: x[0, 0], history.params)
    plotting.tuning(history, f"{scene.name}, Tsit5 with steps of {dt0:g} s").savefig(picture)
    before, after = (
        Point(float(p["alpha"]), float(p["beta"]), float(value), loss.verify(p))
        for p, value in ((start, history.loss[0, 0]), (tuned.params, tuned.loss))
    )
    return before, after, [picture, arrays]


def _write(folder: Path, name: str, figure: Any, data: dict[str, Any]) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    picture, arrays = folder / f"{name}.png", folder / f"{name}.npz"
    figure.savefig(picture)
    numbers: dict[str, Any] = {key: np.asarray(x) for key, x in data.items()}
    np.savez(arrays, **numbers)
    return [picture, arrays]
