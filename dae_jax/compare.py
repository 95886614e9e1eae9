"""One scene by every method: the paper's comparison."""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np

from . import plotting
from .diagnostics import drift, energy
from .formulations import AbstractFormulation, Baumgarte, DummyDerivatives, Residual, StateSpace
from .scenes import Scene
from .solve import daesolve
from .solvers import (
    BDF,
    DOP853,
    RATTLE,
    Gauss4,
    OrthogonalProjection,
    RadauIIA5,
    SymmetricProjection,
    TangentSpace,
    Trapezoid,
)
from .systems import ConstrainedSystem, ImplicitDAE


@dataclasses.dataclass(frozen=True)
class Method:
    """A formulation and a solver; `step` where steps are fixed, in s."""

    solver: diffrax.AbstractSolver
    formulation: AbstractFormulation | None = None
    step: float | None = None


def methods(scene: Scene) -> dict[str, Method]:
    """The methods by their command-line names that apply: the state-space form where the scene has a chart, explicit ones
    where it is not stiff.
    """
    if not isinstance(scene.system, ConstrainedSystem):
        implicit = {"radau": Method(RadauIIA5()), "bdf": Method(BDF())}
        if scene.stiff:
            return implicit
        return implicit | {
            "differentiation": Method(DOP853()),
            "baumgarte": Method(DOP853(), Baumgarte(20.0, 20.0)),
            "projection-dop853": Method(OrthogonalProjection(DOP853())),
            "tangent-space": Method(TangentSpace(DOP853())),
            "dummy-derivatives": Method(DOP853(), DummyDerivatives()),
        }
    found = {
        "differentiation": Method(DOP853()),
        "differentiation-fixed": Method(diffrax.Tsit5(), step=0.02),
        "baumgarte": Method(DOP853(), Baumgarte(20.0, 20.0)),
        "projection-euler": Method(OrthogonalProjection(diffrax.Euler()), step=0.001),
        "projection-tsit5": Method(OrthogonalProjection(diffrax.Tsit5())),
        "projection-dop853": Method(OrthogonalProjection(DOP853())),
        "symmetric-trapezoid": Method(SymmetricProjection(Trapezoid()), step=0.01),
        "symmetric-gauss4": Method(SymmetricProjection(Gauss4()), step=0.01),
        "tangent-space": Method(TangentSpace(DOP853())),
        "rattle": Method(RATTLE(), step=0.01),
        "radau-ggl": Method(RadauIIA5()),
        "radau-index-2": Method(RadauIIA5(), Residual("index-2")),
        "radau-index-3": Method(RadauIIA5(), Residual("index-3")),
        "bdf-ggl": Method(BDF()),
        "dummy-derivatives": Method(DOP853(), DummyDerivatives()),
    }
    if scene.chart is not None:
        found["state-space"] = Method(DOP853(), StateSpace(scene.chart))
    return found


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of one method; `reason` where it does not apply or failed."""

    method: str
    steps: int = 0
    run_seconds: float = np.nan
    compile_seconds: float = np.nan
    error: float = np.nan
    position_drift: float = np.nan
    velocity_drift: float = np.nan
    energy_drift: float = np.nan
    reason: str = ""


def solve(scene: Scene, method: Method, times: np.ndarray, rtol: float) -> Any:
    """The scene by one method at the given times."""
    controller = None if method.step else diffrax.PIDController(rtol=rtol, atol=scene.scale * rtol)
    return daesolve(
        scene.system, method.solver, 0.0, times[-1], method.step, scene.y0, scene.args,
        formulation=method.formulation, stepsize_controller=controller,
        saveat=diffrax.SaveAt(ts=times), max_steps=10_000_000,
    )  # fmt: skip


def measure(scene: Scene, name: str, method: Method, times: np.ndarray, rtol: float) -> tuple[Row, Any]:
    """A row of the table, and the solution."""
    seconds = []
    sol = None
    try:
        for _ in range(4):
            start = time.perf_counter()
            sol = jax.block_until_ready(solve(scene, method, times, rtol))
            seconds.append(time.perf_counter() - start)
    except (RuntimeError, TypeError, ValueError) as refusal:
        return Row(name, reason=str(refusal).splitlines()[0]), None
    assert sol is not None
    median = float(np.median(seconds[1:]))
    error = scene.error(times, sol.ys)
    row = Row(name, int(sol.stats["num_steps"]), median, seconds[0] - median, error)
    if not isinstance(scene.system, ConstrainedSystem):
        return row, sol
    off = drift(scene.system, sol)
    row = dataclasses.replace(row, position_drift=float(off.position.max()), velocity_drift=float(off.velocity.max()))
    if scene.system.potential is not None:
        total = np.asarray(energy(scene.system, sol))
        row = dataclasses.replace(row, energy_drift=float(np.abs(total - total[0]).max()))
    return row, sol


def compare(scene: Scene, names: list[str] | None, t1: float, rtol: float) -> Iterator[tuple[Row, Any]]:
    """Rows and solutions, one method after the other; progress on stderr."""
    known = methods(scene)
    chosen = list(known) if names is None else names
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise ValueError(f"unknown method {', '.join(unknown)}; {scene.name} knows {', '.join(known)}")
    times = np.linspace(0.0, t1, 501)
    for i, name in enumerate(chosen, 1):
        print(f"\r{i}/{len(chosen)} {name:24s}", end="", file=sys.stderr, flush=True)
        yield measure(scene, name, known[name], times, rtol)
    print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)


def table(rows: list[Row]) -> str:
    """The rows for a terminal."""
    head = ("method", "steps", "run ms", "compile s", "error", "drift g", "drift dg/dt", "energy drift")
    lines = ["{:22s}{:>9s}{:>10s}{:>11s}{:>10s}{:>10s}{:>13s}{:>14s}".format(*head)]
    for r in rows:
        if r.reason:
            lines.append(f"{r.method:22s}  {r.reason}")
        else:
            measured = zip((10, 10, 13, 14), (r.error, r.position_drift, r.velocity_drift, r.energy_drift), strict=True)
            numbers = "".join(f"{'–' if np.isnan(x) else f'{x:.1e}':>{width}}" for width, x in measured)
            lines.append(f"{r.method:22s}{r.steps:9d}{1e3 * r.run_seconds:10.3f}{r.compile_seconds:11.2f}{numbers}")
    return "\n".join(lines)


# The paper's figures


def figures(scene: Scene, solutions: dict[str, Any], rtol: float) -> Iterator[tuple[str, Callable[[], Any]]]:
    """(file name, how to draw it): the drift of all methods, and the paper's figures where the scene is one of its two;
    the solution itself where the scene is no mechanism.
    """
    if not isinstance(scene.system, ConstrainedSystem):
        for name, sol in solutions.items():
            yield f"solution-{name}", functools.partial(_components, scene, name, sol)
        return
    curves = {
        name: (np.asarray(sol.ts), np.asarray(drift(scene.system, sol).position)) for name, sol in solutions.items()
    }
    if not curves:
        return
    yield "drift", lambda: plotting.drift(curves, f"{scene.name}: drift off the constraints")
    if scene.system.potential is not None:
        totals = {name: (np.asarray(sol.ts), np.asarray(energy(scene.system, sol))) for name, sol in solutions.items()}
        yield "energy", lambda: plotting.energy(totals, f"{scene.name}: change of the energy")
    if scene.name == "pendulum":
        yield "fig4_drift_off", lambda: _drift_off(scene)
        yield "fig5_euler_speed", lambda: _euler_speed(scene)
        yield "fig6_phase_portrait", lambda: _phase_portrait(scene, rtol)
    if scene.name == "double-pendulum":
        yield (
            "fig7_baumgarte",
            lambda: _trace(scene, Method(DOP853(), Baumgarte(100.0, 1000.0)), "Baumgarte, α = 100, β = 1000"),
        )
        yield "fig8_state_space", lambda: _trace(scene, Method(DOP853(), StateSpace(scene.chart)), "State-space form")


def _components(scene: Scene, name: str, sol: Any) -> Any:
    curves = {}
    for letter, part in _parts(scene, sol):
        for i, component in enumerate(part.reshape(len(part), -1).T):
            curves[f"{letter}[{i}]"] = (np.asarray(sol.ts), component / max(np.abs(component).max(), 1e-300))
    return plotting.over_time(curves, "value / largest value", f"{scene.name} by {name}")


def _parts(scene: Scene, sol: Any) -> list[tuple[str, np.ndarray]]:
    """The leaves of a solution, by the letters of the documentation."""
    system = scene.system
    letters = "y" if isinstance(system, ImplicitDAE) else "qv" if isinstance(system, ConstrainedSystem) else "xz"
    return list(zip(letters, map(np.asarray, jax.tree.leaves(sol.ys)), strict=True))


def _drift_off(scene: Scene) -> Any:
    times = np.linspace(0, 100, 1001)
    curves = {}
    for h in (0.05, 0.02, 0.01):
        sol = solve(scene, Method(diffrax.Tsit5(), step=h), times, 1e-8)
        curves[f"Tsit5, h = {h:g} s"] = (times, np.asarray(drift(scene.system, sol).position))
    return plotting.drift_growth(curves, "Differentiation and substitution drifts off", "m²")


def _euler_speed(scene: Scene) -> Any:
    times = np.linspace(0, 10, 1001)
    curves = {}
    for label, method in {
        "orthogonal projection, Euler, h = 0.01 s": Method(OrthogonalProjection(diffrax.Euler()), step=0.01),
        "symmetric projection, trapezoid, h = 0.01 s": Method(SymmetricProjection(Trapezoid()), step=0.01),
    }.items():
        v = np.asarray(solve(scene, method, times, 1e-8).ys[1])
        curves[label] = (times, np.linalg.norm(v, axis=1))
    curves["exact"] = (times, np.linalg.norm(scene.reference(times)[1], axis=1))
    return plotting.over_time(curves, "speed in m/s", "With explicit Euler the speed grows", exact="exact")


def _phase_portrait(scene: Scene, rtol: float) -> Any:
    times = np.linspace(0, 10, 2001)
    curves = {}
    for label, method in {
        "orthogonal projection, Euler, h = 0.01 s": Method(OrthogonalProjection(diffrax.Euler()), step=0.01),
        "orthogonal projection, DOP853": Method(OrthogonalProjection(DOP853())),
    }.items():
        q, v = map(np.asarray, solve(scene, method, times, rtol).ys)
        curves[label] = (q[:, 0], v[:, 0])
    return plotting.phase_portrait(curves, "x in m", "dx/dt in m/s")


def _trace(scene: Scene, method: Method, title: str) -> Any:
    times = np.linspace(0, 100, 10001)
    sol = solve(scene, method, times, 1e-8)
    return plotting.trajectory(times, np.asarray(sol.ys[0])[:, 2:], 10.0, title)


def write(scene: Scene, rows: list[Row], solutions: dict[str, Any], rtol: float, folder: Path) -> list[Path]:
    """The table as CSV, the solutions as NPZ and the figures as PNG; the paths that were written."""
    folder.mkdir(parents=True, exist_ok=True)
    fields = [f.name for f in dataclasses.fields(Row)]
    lines = [",".join(fields), *(",".join(f'"{getattr(r, f)}"' for f in fields) for r in rows)]
    (folder / "table.csv").write_text("\n".join(lines) + "\n")
    arrays = {f"{name}_{letter}": x for name, sol in solutions.items() for letter, x in _parts(scene, sol)}
    np.savez(folder / "solutions.npz", **arrays)
    written = [folder / "table.csv", folder / "solutions.npz"]
    for name, draw in figures(scene, solutions, rtol):
        print(f"\rdrawing {name:24s}", end="", file=sys.stderr, flush=True)
        written.append(folder / f"{name}.png")
        draw().savefig(written[-1])
    print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)
    return written
