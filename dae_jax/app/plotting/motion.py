"""Where the points of a drawing are at evenly spaced times, from a solution that was saved at any."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ...scenes import Drawing, Scene
from ...solution import AccuracyWarning, DAESolution
from ...systems import System, is_mechanism
from ...types import State, Time
from ...validate.states import as_floats, brief


# Frames in a second of a film, and in all at most. One that is shorter than SHORT or longer than LONG in real time takes
# USUAL where no speed is asked for, in s.
FPS, MOST, SHORT, USUAL, LONG = 50.0, 20_000, 1.0, 10.0, 120.0
# What a point may be off between saved times, in parts of the extent of the motion.
SEEN = 0.01

# points(t, q), as in a `Drawing`.
Points = Callable[[Any, Any], Any]


def drawing_of(what: Scene[System] | Drawing | Points) -> Drawing:
    """The drawing of a scene, or of a function of t and q that gives points: these are then all of interest."""
    if isinstance(what, Scene):
        if what.drawing is None:
            raise ValueError(
                f"The scene {what.name} has no drawing: pass a `dae_jax.scenes.Drawing`, or a function points(t, q)."
            )
        return what.drawing
    if isinstance(what, Drawing):
        return what
    if isinstance(what, type) or not callable(what):
        raise TypeError(
            "What is animated must be a Scene, a `dae_jax.scenes.Drawing`, or a function points(t, q) that gives (points, 2) or "
            f"(points, 3) positions, such as `lambda t, q: q.reshape(-1, 2)`, but is {brief(what)}."
        )
    return Drawing(what)


def saved_states(sol: DAESolution) -> tuple[np.ndarray, State]:
    """The saved times and states, without padding, without those that are not finite, and each time once.

    Errors: `TypeError` for what is no solution; `ValueError` where fewer than two times are left, and for a batch.
    """
    if not isinstance(sol, DAESolution):
        raise TypeError(f"`sol` must be what `daesolve` returns, but is {brief(sol)}.")
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((sol.ts, sol.ys))):
        raise ValueError("An animation needs the numbers of a solution: take it outside of `jit`, `vmap` and `grad`.")
    advice = "pass `saveat=diffrax.SaveAt(ts=jnp.linspace(t0, t1, 201))`"
    if not isinstance(sol.ts, jax.Array | np.ndarray):
        raise ValueError(f"An animation needs states saved over time, and of one kind; {advice}, without `subs`.")
    if sol.ts.ndim != 1:
        raise ValueError(
            "`sol` is a batch of solutions; animate one of them, "
            "`dataclasses.replace(sol, ts=sol.ts[0], ys=jax.tree.map(lambda y: y[0], sol.ys))`."
        )
    times = np.asarray(sol.ts, float)
    finite = [np.isfinite(np.asarray(y).reshape(len(times), -1)).all(1) for y in jax.tree.leaves(sol.ys)]
    kept = np.isfinite(times) & np.all(finite, axis=0)
    kept[:-1] &= times[:-1] != times[1:]
    if kept.sum() < 2:
        raise ValueError(f"An animation needs at least two saved times, but the solution has {kept.sum()}; {advice}.")
    return times[kept], jax.tree.map(lambda y: np.asarray(y)[kept], sol.ys)


def frame_times(times: Sequence[float] | np.ndarray, fps: float, speed: float | None) -> tuple[float, np.ndarray]:
    """Seconds shown in a second, and the times of the frames."""
    span = float(abs(times[-1] - times[0]))
    if speed is None:
        speed = 1.0 if SHORT <= span <= LONG else span / USUAL
    count = int(span / speed * fps * (1 + 1e-12)) + 1
    if not 2 <= count <= MOST:
        raise ValueError(
            f"{span:g} s at speed {speed:g} and {fps:g} frames a second are {count} frames, but must be 2 to {MOST}: at speed "
            f"{span / USUAL:.3g} they take {USUAL:g} s."
        )
    return speed, times[0] + np.sign(times[-1] - times[0]) * speed / fps * np.arange(count)


def motion(
    drawing: Drawing, sol: DAESolution, system: System | None, at: np.ndarray
) -> Float[np.ndarray, "frames points dimensions"]:
    """The points of a drawing at the times `at`. Of a solution with dense output they are those of its states there; of any
    other they are interpolated between the saved ones: of a mechanism by cubics with the velocities that (q, v) give, else
    linearly.

    Warns with an `AccuracyWarning` where the saved times are too far apart to say what happens between.
    """
    times, ys = saved_states(sol)
    pair = _is_pair(system, ys)
    states = ys[0] if pair else ys
    _refuse_wrong_points(drawing, times, states)
    place = jax.jit(jax.vmap(lambda t, q: jnp.asarray(drawing.points(t, q), jnp.result_type(t))))
    if sol.interpolation is not None:
        dense: Any = jax.vmap(sol.interpolation.evaluate)(jnp.asarray(at, sol.ts.dtype))
        return _finite(place(at, dense[0] if pair else dense))
    points = _finite(place(times, states))
    if not pair:
        return _linear(times, points, at)

    def velocity(t: Time, q: State, v: State) -> Array:
        return jax.jvp(drawing.points, (t, q), (jnp.ones_like(t), v))[1]

    rates = np.asarray(jax.jit(jax.vmap(velocity))(jnp.asarray(times), *map(as_floats, ys)))
    _warn_of_gaps(times, points, rates)
    return _cubic(times, points, rates, at)


def _is_pair(system: System | None, ys: State) -> bool:
    """Whether states are (q, v): those of a mechanism, or, where no system is given, what looks like them."""
    if system is not None:
        return is_mechanism(system)
    if not isinstance(ys, tuple | list) or len(ys) != 2:
        return False
    return jax.tree.map(np.shape, ys[0]) == jax.tree.map(np.shape, ys[1])


def _refuse_wrong_points(drawing: Drawing, times: np.ndarray, states: State) -> None:
    first = jax.tree.map(lambda y: jax.ShapeDtypeStruct(y.shape[1:], y.dtype), states)
    shape = np.shape(jax.eval_shape(drawing.points, times[0], first))
    if len(shape) != 2 or shape[1] not in (2, 3) or not shape[0]:
        raise ValueError(
            f"points(t, q) must give positions of the shape (points, 2) or (points, 3), but gives {shape}."
        )
    named = [*drawing.masses.values(), *(k for pair in (*drawing.links, *drawing.springs) for k in pair)]
    wrong = [k for k in named if not 0 <= k < shape[0]]
    if wrong:
        raise ValueError(f"The drawing names the point {wrong[0]}, but points(t, q) gives {shape[0]}, from 0 on.")


def _finite(points: Array) -> np.ndarray:
    found = np.asarray(points, float)
    if not np.isfinite(found).all():
        raise ValueError("points(t, q) must be finite, but gives NaN or infinity for a saved state.")
    return found


def _linear(times: np.ndarray, points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Between neighbours."""
    order = np.argsort(times)
    flat = points[order].reshape(len(times), -1)
    return np.stack([np.interp(at, times[order], x) for x in flat.T], 1).reshape(len(at), *points.shape[1:])


def _cubic(times: np.ndarray, points: np.ndarray, rates: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Hermite's cubics, with an error of fourth order."""
    from scipy.interpolate import CubicHermiteSpline

    sign = np.sign(times[-1] - times[0])
    return CubicHermiteSpline(sign * times, points, sign * rates)(sign * at)


def _warn_of_gaps(times: np.ndarray, points: np.ndarray, rates: np.ndarray) -> None:
    """Every other saved time is left out, and seen how far off the interpolant is there; that of all is 16 times nearer."""
    coarse = np.unique(np.r_[np.arange(0, len(times), 2), len(times) - 1])
    off = np.abs(_cubic(times[coarse], points[coarse], rates[coarse], times) - points).max() / 16
    if len(times) < 4 or off > SEEN * np.ptp(points, axis=(0, 1)).max():
        warnings.warn(
            f"{len(times)} saved times are too few to say how the mechanism moves between them: save it at more, "
            "`SaveAt(ts=jnp.linspace(t0, t1, 501))`, or with `dense=True`.",
            AccuracyWarning,
            stacklevel=4,
        )
