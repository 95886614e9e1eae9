"""The files that `dae-jax compare` writes: table, data and figures."""

import csv
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np

from ..diagnostics import drift, energy
from ..formulations import Baumgarte, StateSpace
from ..scenes import Scene
from ..solution import DAESolution
from ..solvers import DOP853, OrthogonalProjection, SymmetricProjection, Trapezoid
from ..systems import ConstrainedSystem, is_mechanism
from . import plotting
from .compare import Effort, Method, Row, solve


# More curves in one picture cannot be told apart.
CURVES = 9


def write_data(
    scene: Scene, rows: list[Row], efforts: list[Effort], solutions: dict[str, Any], folder: Path
) -> list[Path]:
    """The tables as CSV and the solutions as NPZ; the paths."""
    written = []
    for name, kind, records in (("table", Row, rows), ("work-precision", Effort, efforts)):
        written.append(folder / f"{name}.csv")
        with written[-1].open("w", newline="") as file:
            table = csv.DictWriter(file, [field.name for field in dataclasses.fields(kind)])
            table.writeheader()
            table.writerows([dataclasses.asdict(record) for record in records])
    written.append(folder / "solutions.npz")
    parts: dict[str, Any] = {
        f"{name}_{letter}": x for name, sol in solutions.items() for letter, x in _parts(scene, sol)
    }
    times: dict[str, Any] = {f"{name}_t": np.asarray(sol.ts) for name, sol in solutions.items()}
    np.savez(written[-1], **parts, **times)
    return written


def write_figures(figures: Iterator[tuple[str, Callable[[], Any]]], folder: Path) -> list[Path]:
    """The figures as PNG; the paths."""
    written = []
    for name, draw in figures:
        print(f"\rdrawing {name:24s}", end="", file=sys.stderr, flush=True)
        written.append(folder / f"{name}.png")
        draw().savefig(written[-1])
    print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)
    return written


def figures(
    scene: Scene, rows: list[Row], efforts: list[Effort], solutions: dict[str, Any], rtol: float, paper: bool
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """(file name, how to draw it): what each method costs; of a mechanism drift, energy, the mechanism itself and, with
    `paper`, the paper's figures that show it; of all else the solution.
    """
    if efforts:
        yield "work-precision", lambda: _work_precision(scene, efforts)
    if not solutions:
        return
    if not is_mechanism(scene.system):
        for name, sol in solutions.items():
            yield f"solution-{name}", functools.partial(_components, scene, name, sol)
        return
    for name, level, violated in _levels(scene.system):
        yield name, functools.partial(_drift, scene, solutions, level, violated)
    if scene.system.potential is not None:
        totals = {name: (np.asarray(sol.ts), np.asarray(energy(scene.system, sol))) for name, sol in solutions.items()}
        yield "energy", lambda: plotting.energy(totals, f"{scene.name}: change of the energy")
    if scene.drawing is not None:
        best = min(
            (row for row in rows if row.method in solutions), key=lambda row: np.nan_to_num(row.error, nan=np.inf)
        )
        yield "mechanism", lambda: _mechanism(scene, best.method, solutions[best.method])
    for name in scene.paper if paper else ():
        yield name, functools.partial(PAPER[name], scene, rtol)


def _work_precision(scene: Scene, efforts: list[Effort]) -> Any:
    points: dict[str, tuple[list[float], list[float]]] = {}
    for effort in efforts:
        times, errors = points.setdefault(effort.method, ([], []))
        times.append(effort.run_seconds)
        errors.append(effort.error)
    return plotting.work_precision(points, f"{scene.name}: error against run time, over tolerances or steps")


def _levels(system: ConstrainedSystem) -> Iterator[tuple[str, str, str]]:
    """(figure, field of `Drift`, symbols) of the constraints that there are."""
    if system.constraint is not None:
        yield "drift", "position", "g"
    if system.nonholonomic is not None:
        yield ("drift", "velocity", "h") if system.constraint is None else ("drift-velocity", "velocity", "(dg/dt, h)")


def _drift(scene: Scene, solutions: dict[str, Any], level: str, violated: str) -> Any:
    off = {name: drift(scene.system, sol) for name, sol in solutions.items()}
    curves = {name: (np.asarray(solutions[name].ts), np.asarray(getattr(x, level))) for name, x in off.items()}
    return plotting.drift(curves, f"{scene.name}: drift off the constraints", violated=violated)


def _mechanism(scene: Scene, method: str, sol: DAESolution) -> Any:
    drawing = scene.drawing
    assert drawing is not None
    times = np.asarray(sol.ts)
    early = times <= drawing.t1
    points = jax.vmap(drawing.points)(times[early], jax.tree.map(lambda x: x[early], sol.ys[0]))
    title = f"{scene.name} until {times[early][-1]:.3g} s, by {method}"
    return plotting.mechanism(
        times[early], points, drawing.masses, drawing.links, drawing.springs, down=drawing.down,
        axes_labels=drawing.axes, title=title,
    )  # fmt: skip


def _components(scene: Scene, name: str, sol: DAESolution) -> Any:
    times = np.asarray(sol.ts)
    curves = {}
    for letter, part in _parts(scene, sol):
        for i, component in enumerate(part.reshape(len(part), -1).T):
            # What is zero but for round-off is drawn as zero.
            largest = max(np.abs(component).max(), 1e-12 * scene.scale)
            curves[f"{letter}[{i}]"] = (times, component / largest)
    shown = dict(list(curves.items())[:CURVES])
    title = f"{scene.name} by {name}" + (f", the first {CURVES} of {len(curves)}" if len(curves) > CURVES else "")
    decades = scene.first is not None and scene.first < times[-1]
    return plotting.over_time(shown, "value / largest value", title, log_time=decades)


def _parts(scene: Scene, sol: DAESolution) -> list[tuple[str, np.ndarray]]:
    """The leaves of a solution, by the letters of the documentation."""
    system = scene.system
    letters = "".join(system.parts)
    return list(zip(letters, map(np.asarray, jax.tree.leaves(sol.ys)), strict=True))


# The paper's figures: of a scene, at a tolerance


def _drift_off(scene: Scene[ConstrainedSystem], rtol: float) -> Any:
    times = np.linspace(0, 100, 1001)
    curves = {}
    for h in (0.05, 0.02, 0.01):
        sol = solve(scene, Method(diffrax.Tsit5(), step=h), times, rtol)
        curves[f"Tsit5, h = {h:g} s"] = (times, np.asarray(drift(scene.system, sol).position))
    return plotting.drift_growth(curves, "Differentiation and substitution drifts off", "m²")


def _euler_speed(scene: Scene, rtol: float) -> Any:
    times = np.linspace(0, 10, 1001)
    curves = {}
    for label, method in {
        "projection-euler, h = 0.01 s": Method(OrthogonalProjection(diffrax.Euler()), step=0.01),
        "symmetric-trapezoid, h = 0.01 s": Method(SymmetricProjection(Trapezoid()), step=0.01),
    }.items():
        v = np.asarray(solve(scene, method, times, rtol).ys[1])
        curves[label] = (times, np.linalg.norm(v, axis=1))
    curves["exact"] = (times, np.linalg.norm(scene.reference(times)[1], axis=1))
    return plotting.over_time(curves, "speed in m/s", "With explicit Euler the speed grows", exact="exact")


def _phase_portrait(scene: Scene, rtol: float) -> Any:
    times = np.linspace(0, 10, 2001)
    curves = {}
    for label, method in {
        "projection-euler, h = 0.01 s": Method(OrthogonalProjection(diffrax.Euler()), step=0.01),
        "projection-dop853": Method(OrthogonalProjection(DOP853())),
    }.items():
        q, v = map(np.asarray, solve(scene, method, times, rtol).ys)
        curves[label] = (q[:, 0], v[:, 0])
    return plotting.phase_portrait(curves, "x in m", "dx/dt in m/s")


def _path_by_baumgarte(scene: Scene, rtol: float) -> Any:
    return _path(scene, Method(DOP853(), Baumgarte(100.0, 1000.0)), rtol, "Baumgarte, α = 100, β = 1000")


def _path_in_state_space(scene: Scene, rtol: float) -> Any:
    assert scene.chart is not None
    return _path(scene, Method(DOP853(), StateSpace(scene.chart)), rtol, "State-space form")


def _path(scene: Scene, method: Method, rtol: float, title: str) -> Any:
    drawing = scene.drawing
    assert drawing is not None
    times = np.linspace(0, 100, 10001)
    points = jax.vmap(drawing.points)(times, solve(scene, method, times, rtol).ys[0])
    name, last = list(drawing.masses.items())[-1]
    return plotting.trajectory(times, points[:, last], 10.0, f"{title}: path of {name}")


PAPER: dict[str, Callable[[Scene, float], Any]] = {
    "fig4_drift_off": _drift_off,
    "fig5_euler_speed": _euler_speed,
    "fig6_phase_portrait": _phase_portrait,
    "fig7_baumgarte": _path_by_baumgarte,
    "fig8_state_space": _path_in_state_space,
}
