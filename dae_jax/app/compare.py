"""One scene by every method: the paper's comparison."""

import dataclasses
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from typing import Any, cast

import diffrax
import jax
import numpy as np
from jax import Array

from ..diagnostics import drift, energy
from ..formulations import AbstractFormulation, Baumgarte, DummyDerivatives, Residual, StateSpace
from ..scenes import Scene
from ..solution import AccuracyWarning
from ..solve import daesolve
from ..solvers import (
    BDF,
    DOP853,
    RATTLE,
    Gauss4,
    OrthogonalProjection,
    Radau,
    RadauIIA5,
    SymmetricProjection,
    TangentSpace,
    Trapezoid,
)
from ..systems import is_mechanism


# The work-precision picture: tolerances, or steps, as factors of those of the table. A method that takes longer than so
# many seconds is not asked for less error.
TOLERANCES, STEPS = (1e4, 1e2, 1.0, 1e-2), (4.0, 2.0, 1.0, 0.5)
LONG = 0.5
# At so many times.
SAVED = 501
# Run times are measured more than a few times where all of them take less than this, in s.
SHORT = 0.02


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
    if not is_mechanism(scene.system):
        implicit = {"radau": Method(RadauIIA5()), "radau-variable": Method(Radau()), "bdf": Method(BDF())}
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
        "radau-variable-ggl": Method(Radau()),
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


@dataclasses.dataclass(frozen=True)
class Effort:
    """A point of the work-precision picture; `setting` is the tolerance, or the step in s where steps are fixed."""

    method: str
    setting: float
    steps: int
    run_seconds: float
    error: float


def solve(scene: Scene, method: Method, times: np.ndarray, rtol: float, step: float | None = None) -> Any:
    """The scene by one method at the given times. The tolerance, and `step` in place of the method's, are numbers of the
    compiled program, not parts of it: another one compiles nothing.
    """
    controller = diffrax.PIDController(rtol=np.asarray(rtol), atol=np.asarray(scene.scale * rtol))
    with warnings.catch_warnings():
        # The comparison shows error and drift of each.
        warnings.simplefilter("ignore", AccuracyWarning)
        return daesolve(
            scene.system, method.solver, 0.0, times[-1], step or method.step, scene.y0, scene.args,
            formulation=method.formulation, stepsize_controller=None if method.step else controller,
            saveat=diffrax.SaveAt(ts=cast(Array, times)), max_steps=10_000_000,
        )  # fmt: skip


def measure(scene: Scene, name: str, method: Method, times: np.ndarray, rtol: float) -> tuple[Row, Any]:
    """A row of the table, and the solution."""
    try:
        sol, seconds = _timed(scene, method, times, rtol)
    except (RuntimeError, TypeError, ValueError) as refusal:
        return Row(name, reason=str(refusal).splitlines()[0]), None
    median = float(np.median(seconds[1:]))
    row = Row(name, int(sol.stats["num_steps"]), median, seconds[0] - median, scene.error(times, sol.ys))
    system = scene.system
    equations, *hidden = (float(level.max()) for level in drift(system, sol).levels)
    row = dataclasses.replace(row, position_drift=equations, velocity_drift=max(hidden, default=np.nan))
    if not is_mechanism(system):
        return row, sol
    if system.constraint is None:
        row = dataclasses.replace(row, position_drift=np.nan)
    if system.potential is not None:
        total = np.asarray(energy(system, sol))
        row = dataclasses.replace(row, energy_drift=float(np.abs(total - total[0]).max()))
    return row, sol


def efforts(scene: Scene, row: Row, method: Method, times: np.ndarray, rtol: float) -> list[Effort]:
    """Error and shortest run time at the row's tolerance and at others, or with other steps, from loose to tight; none
    without a reference. A solve that fails, at a loose tolerance say, is left out.
    """
    if np.isnan(row.error):
        return []
    # A tolerance is kept within what a solve can mean and what float64 can do.
    settings = [method.step * x for x in STEPS] if method.step else np.clip([rtol * x for x in TOLERANCES], 1e-13, 1e-2)
    found = []
    for setting in np.unique(settings)[::-1].tolist():
        if row.run_seconds > LONG and setting < (method.step or rtol):
            break
        change = {"rtol": rtol, "step": setting} if method.step else {"rtol": setting}
        try:
            sol, seconds = _timed(scene, method, times, **change)
        except (RuntimeError, ValueError):
            continue
        found.append(Effort(row.method, setting, int(sol.stats["num_steps"]), min(seconds), scene.error(times, sol.ys)))
    return found


def _timed(scene: Scene, method: Method, times: np.ndarray, rtol: float, step: float | None = None) -> Any:
    """The solution, and how long each solve took, in s: of four, or of more that take no time."""
    sol, seconds = None, []
    while len(seconds) < 4 or (len(seconds) < 12 and sum(seconds[1:]) < SHORT):
        start = time.perf_counter()
        sol = jax.block_until_ready(solve(scene, method, times, rtol, step))
        seconds.append(time.perf_counter() - start)
    return sol, seconds


def chosen(scene: Scene, names: list[str] | None) -> dict[str, Method]:
    """The methods of these names, by default all that apply.

    Errors: `ValueError` for a name that is none of them, and for one that is there twice.
    """
    known = methods(scene)
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise ValueError(f"unknown method {', '.join(map(repr, unknown))}; {scene.name} knows {', '.join(known)}")
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"method {', '.join(map(repr, twice))} is named more than once")
    return {name: known[name] for name in (known if names is None else names)}


def compare(scene: Scene, by: dict[str, Method], t1: float, rtol: float) -> Iterator[tuple[Row, Any, list[Effort]]]:
    """Rows, solutions and points of the work-precision picture, one method after the other; progress on stderr."""
    times = scene.times(t1, SAVED)
    for i, (name, method) in enumerate(by.items(), 1):
        print(f"\r{i}/{len(by)} {name:24s}", end="", file=sys.stderr, flush=True)
        row, sol = measure(scene, name, method, times, rtol)
        yield row, sol, efforts(scene, row, method, times, rtol)
    print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)


def largest(scene: Scene, t1: float) -> str:
    """Of what the table has the largest."""
    known = scene.known(scene.times(t1, SAVED))
    where = f", over {len(known)} of them, {known[0]:g} to {known[-1]:g} s, the reference's" if len(known) > 1 else ""
    if len(known) == 1:
        where = f", at {known[0]:g} s, the reference's only time"
    return (
        f"error and drifts are the largest over {SAVED} times, errors relative where the solution is larger than {scene.scale:g}"
        f"{where * (len(known) < SAVED)}"
    )


def table(rows: list[Row]) -> str:
    """The rows for a terminal."""
    head = ("method", "steps", "run ms", "compile s", "error", "drift g", "drift dg/dt,h", "energy drift")
    lines = ["{:22s}{:>9s}{:>10s}{:>11s}{:>10s}{:>10s}{:>15s}{:>14s}".format(*head)]
    for r in rows:
        if r.reason:
            lines.append(f"{r.method:22s}  {r.reason}")
        else:
            measured = zip((10, 10, 15, 14), (r.error, r.position_drift, r.velocity_drift, r.energy_drift), strict=True)
            numbers = "".join(f"{'–' if np.isnan(x) else f'{x:.1e}':>{width}}" for width, x in measured)
            lines.append(f"{r.method:22s}{r.steps:9d}{1e3 * r.run_seconds:10.3f}{r.compile_seconds:11.2f}{numbers}")
    return "\n".join(lines)
