"""One cell: a case solved by a method, and how far the answer is from the truth and off the constraints."""

import dataclasses
import functools
import time
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import dae_jax as dj
from dae_jax.driver.failures import OKAY, in_words

from .cases import METHODS, Case


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a solve ended: "answer", "refused" or "failed"; the rest where it is known. `words`: why, or what it warned of; `series`:
    growth over time.
    """

    ended: str
    words: str = ""
    end: float = np.nan
    error: float = np.nan
    drift: float = np.nan
    steps: int = 0
    seconds: float = np.nan
    series: dict = dataclasses.field(default_factory=dict)


def solved(case: Case, name: str) -> Outcome:
    """The case by the method of this name."""
    method = METHODS[name]
    begin = time.perf_counter()
    formulation = dj.StateSpace(case.chart) if method.formulation == "chart" else case.formulation or method.formulation
    fixed = case.fixed or method.order is not None
    kind, shape = case.y0[0].dtype, case.y0[0].shape
    if case.tolerance_each and not isinstance(formulation, dj.StateSpace):
        sizes = tuple(np.broadcast_to(size, shape) for size in case.size)
    else:
        # The coordinates of a chart are angles, of size 1.
        sizes = min(1.0, *(float(np.min(x)) for x in case.size))
    tolerances = {
        "rtol": np.asarray(case.rtol, kind),
        "atol": jax.tree.map(lambda size: np.asarray(case.rtol * size, kind), sizes),
    }
    times = np.linspace(0.0, case.t1, case.times)
    said: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", dj.AccuracyWarning)
            sol = dj.daesolve(
                case.system, method.solver, 0.0, case.t1, case.t1 / case.steps if fixed else None, case.y0, case.args,
                formulation=formulation, stepsize_controller=None if fixed else diffrax.PIDController(**tolerances),
                saveat=diffrax.SaveAt(ts=times), max_steps=case.max_steps, throw=False,
            )  # fmt: skip
        code, steps, end = (
            np.asarray(x).item() for x in (sol.result._value, sol.stats["num_steps"], sol.stats["end_time"])
        )
    except (RuntimeError, TypeError, ValueError) as refusal:
        if "RESOURCE_EXHAUSTED" in str(refusal):
            raise MemoryError from refusal
        return Outcome("refused", " ".join(str(refusal).split()), seconds=time.perf_counter() - begin)
    taken = {"steps": steps, "end": end, "seconds": time.perf_counter() - begin}
    if code not in OKAY:
        return Outcome("failed" if end > 0 else "refused", str(in_words(sol)), **taken)
    q, v = map(np.asarray, sol.ys)
    errors = min(
        (_errors(case, q, v, _known(truth, case.t1, case.times)) for truth in (case.truth, *case.or_else)),
        key=np.max,
    )
    drifts = np.nan * errors if case.system.constraint is None else _drifts(case, times, q, v)
    series = {}
    if case.energy is not None:
        series = {"t": times, "error": errors, "drift": drifts, "energy": case.energy(q, v)}
    words = " ".join(str(each.message) for each in said if issubclass(each.category, dj.AccuracyWarning))
    return Outcome("answer", words, error=float(errors.max()), drift=float(drifts.max()), series=series, **taken)


@functools.cache
def _known(truth, t1, times):
    """Once for all methods."""
    return truth(np.linspace(0.0, t1, times))


def _errors(case, q, v, truth):
    """The largest at each time, of positions or velocities."""
    return np.max([_largest(x - e, size) for x, e, size in zip((q, v), truth, case.size, strict=True)], 0)


def _largest(x, size):
    """The largest component at each time, as a part of its size; infinite where it is not a number."""
    scaled = np.abs(np.reshape(x / size, (len(x), -1)))
    return np.max(np.where(np.isnan(scaled), np.inf, scaled), 1)


def _drifts(case, times, q, v):
    """The largest of |g| and |ġ| at each time, as parts of what the sizes of q and v make of them."""
    g, dg, gradients = (np.asarray(x) for x in _constraint(case.system.constraint)(times, q, v, case.args))
    shape = np.shape(q)[1:]
    sizes = [np.max(np.abs(gradients) @ np.ravel(np.broadcast_to(size, shape)), 0) for size in case.size]
    return np.max([np.max(np.abs(x) / size, 1) for x, size in zip((g, dg), sizes, strict=True)], 0)


@functools.cache
def _constraint(function):
    """g, ġ and G at given times."""

    def at(t, q, v, args):
        flat = lambda t, q: jnp.ravel(function(t, q, args))
        g, dg = jax.jvp(flat, (t, q), (jnp.ones_like(t), v))
        return g, dg, jax.jacfwd(flat, 1)(t, q).reshape(g.size, -1)

    return jax.jit(jax.vmap(at, (0, 0, 0, None)))
