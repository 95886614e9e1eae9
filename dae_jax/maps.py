"""The maps and the tuning that the command line draws: α and β of a scene, initial angles of the double pendulum."""

from pathlib import Path
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

from . import plotting
from .baumgarte_loss import FAILED, BaumgarteLoss, baumgarte_loss
from .reductions import first_flip, lyapunov
from .scenes import Scene, double_pendulum
from .solution import RESULTS
from .solve import daesolve
from .solvers import DOP853, OrthogonalProjection
from .sweep import grid, sweep
from .tune import Tuned, tune


def loss_of(scene: Scene, t1: float, dt0: float) -> BaumgarteLoss:
    """The loss of Baumgarte's parameters for a mechanism, against the scene's own reference."""
    return baumgarte_loss(scene.system, scene.y0, t1, dt0=dt0, args=scene.args, reference=scene.reference)


def baumgarte_map(loss: BaumgarteLoss, points: int, store: Path | None, progress: bool = True) -> dict[str, np.ndarray]:
    """The loss, the drift and the error over α and β from 0.1 to 10⁴."""
    axis = np.logspace(-1, 4, points)

    def of_pair(p: dict[str, Any]) -> Any:
        drift, error, _, result = loss.parts(p)
        return loss(p), drift, error, result

    values, drift, error, result = sweep(of_pair, grid(alpha=axis, beta=axis), store=store, progress=progress)
    failed = np.asarray(result != RESULTS.successful) | (np.asarray(values) >= FAILED)
    return {"alpha": axis, "beta": axis, "loss": values, "drift": drift, "error": error, "failed": failed}


def angle_map(points: int, t1: float, rtol: float, store: Path | None, progress: bool = True) -> dict[str, np.ndarray]:
    """The double pendulum released at rest at two angles from the downward vertical: the time of the first flip of either
    arm, and the finite-time Lyapunov exponent.
    """
    system = double_pendulum().system
    solver = OrthogonalProjection(DOP853())
    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    times = np.linspace(0, t1, max(int(t1 / 0.04), 2) + 1)

    def of_angles(p: dict[str, Any]) -> Any:
        first, second = (jnp.stack([jnp.sin(p[name]), jnp.cos(p[name])]) for name in ("first", "second"))
        y0 = (jnp.concatenate([first, first + second]), jnp.zeros(4))
        sol = daesolve(
            system,
            solver,
            0.0,
            t1,
            None,
            y0,
            saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=controller,
            throw=False,
        )
        q = sol.ys[0]
        flip = jnp.minimum(first_flip(sol.ts, q[:, :2]), first_flip(sol.ts, q[:, 2:] - q[:, :2]))
        exponent = lyapunov(system, solver, 0.0, t1, y0, stepsize_controller=controller, throw=False)
        return flip, exponent, sol.result

    # Half a cell off the middle, where both arms hang straight down and nothing moves.
    axis = (np.arange(points) + 0.5) / points * 2 * np.pi - np.pi
    flip, exponent, result = sweep(of_angles, grid(first=axis, second=axis), store=store, progress=progress)
    failed = np.asarray(result != RESULTS.successful)
    return {"first": axis, "second": axis, "flip": flip, "lyapunov": exponent, "failed": failed}


def write_baumgarte_map(scene: Scene, t1: float, dt0: float, points: int, folder: Path, progress: bool) -> list[Path]:
    """The map as figure and data; the paths."""
    found = baumgarte_map(loss_of(scene, t1, dt0), points, folder / "store", progress)
    low = np.unravel_index(np.argmin(found["loss"]), found["loss"].shape)
    best = (found["alpha"][low[0]], found["beta"][low[1]])
    title = f"{scene.name}, Tsit5 with steps of {dt0:g} s: α = {best[0]:.3g}, β = {best[1]:.3g} are the best"
    shown = np.where(found["failed"], np.nan, found["loss"])
    figure = plotting.sweep_map(
        found["alpha"], found["beta"], shown, ("α in 1/s", "β in 1/s", "loss"), title, log=True, mark=best
    )
    return _write(folder, f"baumgarte-{scene.name}", figure, found)


def write_angle_map(t1: float, rtol: float, points: int, folder: Path, progress: bool) -> list[Path]:
    """Both maps as figures, and the data; the paths."""
    found = angle_map(points, t1, rtol, folder / "store", progress)
    degrees = np.degrees(found["first"])
    axes = ("first arm's angle in °", "second arm's angle in °")
    flips = np.where(np.isfinite(found["flip"]), found["flip"], np.nan)
    written = []
    for name, values, label, log in (
        ("flip", flips, "time of the first flip in s", True),
        ("lyapunov", found["lyapunov"], f"Lyapunov exponent over {t1:g} s in 1/s", False),
    ):
        figure = plotting.sweep_map(
            degrees, degrees, values, (*axes, label), "Double pendulum, released at rest", log_values=log
        )
        written += _write(folder, f"angles-{name}", figure, found)
    return written


def write_tuned(
    scene: Scene, t1: float, dt0: float, steps: int, starts: int, folder: Path, progress: bool
) -> tuple[Tuned, Any, list[Path]]:
    """The descent from α = β = 1, the solves that verify it, and the paths of figure and data."""
    loss = loss_of(scene, t1, dt0)
    tuned = tune(loss, {"alpha": 1.0, "beta": 1.0}, steps=steps, starts=starts, progress=progress)
    history = tuned.history
    data = {
        "alpha": history.params["alpha"],
        "beta": history.params["beta"],
        "loss": history.loss,
        "best": history.best,
    }
    title = f"{scene.name}, Tsit5 with steps of {dt0:g} s"
    paths = _write(folder, f"tune-{scene.name}", plotting.tuning(history, title), data)
    return tuned, loss.verify(tuned.params), paths


def _write(folder: Path, name: str, figure: Any, data: dict[str, Any]) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    picture, arrays = folder / f"{name}.png", folder / f"{name}.npz"
    figure.savefig(picture)
    np.savez(arrays, **{key: np.asarray(x) for key, x in data.items()})
    return [picture, arrays]
