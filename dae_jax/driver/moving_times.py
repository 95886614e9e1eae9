"""Derivatives by times: by those that are saved at, and by the ends of a solve whose steps are chosen.

With such a time the state there moves by ẏ. The steps, and what is between them, would say it with an error of a lower order. So the
numerical solve has constant times, and ẏ is found apart, where a derivative asks for it.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from ..solution import RESULTS, DAESolution
from ..types import Scalar, State
from ..validate.captured import settled
from .ends import Start
from .problem import Problem, split
from .rates import Rates, chooses_steps, have_rates, plus
from .start import is_saved_part


if TYPE_CHECKING:
    from .program import Solve


_STATES = diffrax.SubSaveAt(t1=True).fn
# So many states at once.
CHUNK = 64


def from_fixed_start(solve: "Solve", problem: Problem) -> Problem:
    """The problem with a constant t₀: that the start is there later is that the state at that time was another before."""
    if not (chooses_steps(solve) and have_rates(problem)):
        return problem
    program, arrays = split((solve, problem))

    @eqx.filter_custom_jvp
    def before(y0: State, t0: Scalar, arrays: list[Array]) -> Any:  # noqa: ARG001
        return y0

    @before.def_jvp
    def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        (y0, t0, arrays), (dy0, dt0, _) = primals, tangents
        if dt0 is None:
            return y0, dy0
        # Over an interval without length nothing moves.
        with settled(program.leaves):
            solve, problem = program.whole(arrays)
            dt0 = jnp.where(t0 == problem.t1, 0, dt0)
            found = Rates.of(solve, problem)(t0, y0, problem.args)
        return y0, jax.tree.map(lambda dy, rate: plus(dy, -rate * dt0), dy0, found, is_leaf=_is_none)

    y0 = before(problem.y0, problem.t0, arrays)
    return dataclasses.replace(problem, y0=y0, t0=lax.stop_gradient(problem.t0))


def with_moving_times(solved: Callable[..., Any], solve: "Solve", problem: Problem) -> tuple[DAESolution, Start]:
    """`solved(solve, problem)`, of which what was saved moves with its times."""
    if not have_rates(problem):
        return solved(solve, problem)
    chosen, fixed = chooses_steps(solve), lax.stop_gradient
    times = [part.ts for part in jax.tree.leaves(solve.saveat.subs, is_leaf=is_saved_part)]
    ends = {"t0": problem.t0, "t1": problem.t1} if chosen else {}
    held = dataclasses.replace(problem, t1=fixed(problem.t1), dt0=fixed(problem.dt0)) if chosen else problem
    still = _with_times(solve, fixed(times))
    sol, start = solved(still, held)
    if not (chosen or jax.tree.leaves(times)):
        return sol, start
    program, arrays = split((still, held))

    @eqx.filter_custom_jvp
    def moving(sol: Any, times: PyTree[Array], arrays: list[Array]) -> Any:  # noqa: ARG001
        return sol

    @moving.def_jvp
    def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        (sol, times, arrays), (dsol, dtimes, _) = primals, tangents
        if not jax.tree.leaves(dtimes):
            return sol, dsol
        # Moved themselves, for the next derivative.
        found = moving(sol, times, arrays)
        with settled(program.leaves):
            solve, problem = program.whole(arrays)
            solve = _with_times(solve, times["ts"])
            problem = dataclasses.replace(problem, t1=times["t1"]) if "t1" in times else problem
            return found, _moved(solved, solve, problem, found, dsol, dtimes)

    saved = {"t0": sol.t0, "t1": sol.t1, "ts": sol.ts, "ys": sol.ys, "end_time": sol.stats["end_time"]}
    also = {"code": sol.result._value, "changed": sol.changed}
    found = moving({**saved, **also}, {**ends, "ts": times}, arrays)
    stats = {**sol.stats, "end_time": found["end_time"]}
    return dataclasses.replace(sol, **{k: found[k] for k in ("t0", "t1", "ts", "ys")}, stats=stats), start


def _with_times(solve: "Solve", times: list[Any]) -> "Solve":
    """The solve with these times to save at, part by part."""
    parts, structure = jax.tree.flatten(solve.saveat.subs, is_leaf=is_saved_part)
    parts = [dataclasses.replace(part, ts=ts) for part, ts in zip(parts, times, strict=True)]
    return dataclasses.replace(
        solve, saveat=dataclasses.replace(solve.saveat, subs=jax.tree.unflatten(structure, parts))
    )


def _moved(solved: Callable[..., Any], solve: "Solve", problem: Problem, sol: Any, dsol: Any, dtimes: Any) -> Any:
    """The tangents of what was saved, with those that come with the tangents of times."""
    of_t0, of_t1 = dtimes.get("t0"), dtimes.get("t1")
    went_well = sol["code"] == RESULTS.successful._value
    ended = went_well & (sol["end_time"] == problem.t1)
    dsol = {**dsol, "t0": plus(dsol["t0"], of_t0), "t1": plus(dsol["t1"], of_t1)}
    dsol["end_time"] = plus(dsol["end_time"], None if of_t1 is None else jnp.where(ended, of_t1, 0))
    parts, structure = jax.tree.flatten(solve.saveat.subs, is_leaf=is_saved_part)
    if any(part.fn is not _STATES for part in parts):
        # States that were not saved.
        subs = jax.tree.unflatten(structure, [dataclasses.replace(part, fn=_STATES) for part in parts])
        again = dataclasses.replace(solve, saveat=dataclasses.replace(solve.saveat, subs=subs))
        states = with_moving_times(solved, again, problem)[0].ys
    else:
        states = sol["ys"]
    sign = jnp.where(problem.t1 < problem.t0, -1, 1)
    rates = Rates.of(dataclasses.replace(solve, formulation=solve.formulation.towards(sign)), problem)
    all_of = [
        structure.flatten_up_to(x) if x is not None else [None] * len(parts)
        for x in (sol["ts"], sol["ys"], states, dsol["ts"], dsol["ys"])
    ]
    dtimes = [(of_ts, of_t0, jnp.where(went_well, of_t1, 0) if of_t1 is not None else None) for of_ts in dtimes["ts"]]
    parts = [_Part(*x) for x in zip(parts, dtimes, *all_of, strict=True)]
    moved = [part.moved(problem, rates, sol["changed"]) if part.ts is not None else (None, None) for part in parts]
    dts, dys = (jax.tree.unflatten(structure, list(x)) for x in zip(*moved, strict=True)) if parts else (None, None)
    return {**dsol, "ts": dts, "ys": dys}


class _Part(NamedTuple):
    """A part of what is saved, the tangents of its times to save at, of t₀ and of t₁, what it saved, the states there, and the tangents
    of what it saved.
    """

    wanted: Any
    dtimes: tuple[Any, Any, Any]
    ts: Any
    ys: Any
    states: Any
    dts: Any
    dys: Any

    def moved(self, problem: Problem, rates: Rates, changed: Any) -> tuple[Any, Any]:
        """The tangents of what was saved, with those that come with the times."""
        rows, at, along = self._rows(problem)
        if not rows.size:
            return self.dts, self.dys
        there = self.ts[rows] == at
        along = jnp.where(there, along, 0)

        def rate(row: Any) -> Any:
            t, y, changed, along = row
            args = eqx.combine(changed, problem.args)
            of = lambda t, y: self.wanted.fn(t, y, args)
            found = jax.jvp(of, (t, y), (jnp.ones_like(t), rates(t, y, args)))[1]
            return jax.tree.map(lambda x: x * along if jnp.issubdtype(x.dtype, jnp.inexact) else None, found)

        # Where nothing was saved any state will do.
        known = lambda y, y0: jnp.where(there.reshape(-1, *[1] * y0.ndim), y[rows], y0)
        states, changed = jax.tree.map(known, self.states, problem.y0), jax.tree.map(lambda x: x[rows], changed)
        moving = jnp.where(problem.t0 == problem.t1, 0, along)
        found = lax.map(rate, (at, states, changed, moving), batch_size=CHUNK)
        more = jax.tree.map(lambda y, x: None if x is None else jnp.zeros_like(y).at[rows].add(x), self.ys, found)
        dys = jax.tree.map(plus, self.dys, more, is_leaf=_is_none)
        return plus(self.dts, jnp.zeros_like(self.ts).at[rows].add(along)), dys

    def _rows(self, problem: Problem) -> Any:
        """In which rows there is what was asked for at times with tangents; these times, and tangents."""
        part, saved, (of_ts, of_t0, of_t1) = self.wanted, self.ts, self.dtimes
        none = jnp.zeros(0, saved.dtype)
        found = [(jnp.zeros(0, int), none, none)]
        if of_ts is not None:
            ts, index = part.ts, jnp.arange(part.ts.size)
            rows = int(part.t0) + index
            if part.steps:
                # Between the steps; the times of the same step come before it.
                sign = jnp.where(problem.t1 < problem.t0, -1, 1)
                earlier = jnp.isfinite(saved) & (sign * saved < sign * ts[:, None])
                same = (ts == ts[:, None]) & (index < index[:, None])
                rows = jnp.sum(earlier, 1) + jnp.sum(same, 1) + (part.t0 & (ts == problem.t0))
            found.append((rows, ts, of_ts))
        if of_t0 is not None and part.t0:
            found.append((jnp.zeros(1, int), problem.t0[None], of_t0[None]))
        if of_t1 is not None and (part.t1 or part.steps):
            last = jnp.maximum(jnp.sum(jnp.isfinite(saved)) - 1, 0)
            found.append((last[None], problem.t1[None], of_t1[None]))
        return [jnp.concatenate(x) for x in zip(*found, strict=True)]


def _is_none(x: object) -> bool:
    return x is None
