"""What a scene is, and the tight solve in minimal coordinates that references are made with."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

from ..systems import AbstractSystem


State = tuple[np.ndarray, np.ndarray]
S = TypeVar("S", bound=AbstractSystem, covariant=True)


@dataclasses.dataclass(frozen=True)
class Drawing:
    """How a mechanism looks, in the plane or in space.

    - `points(t, q)`: the positions of pivots, joints and masses in m, (points, 2), or (points, 3) in space; a JAX function.
    - `masses`: the points whose paths are of interest, by their names.
    - `links`, `springs`: the pairs of points with a rigid body or a spring between them.
    - `down`: whether the last coordinate points down.
    - `t1`: until when paths can be told apart, in s.
    - `axes`: what the coordinates are.
    """

    points: Callable[[Any, Any], Any]
    masses: dict[str, int] = dataclasses.field(default_factory=dict)
    links: tuple[tuple[int, int], ...] = ()
    springs: tuple[tuple[int, int], ...] = ()
    down: bool = False
    t1: float = np.inf
    axes: tuple[str, ...] = ("x in m", "y in m", "z in m")


@dataclasses.dataclass(frozen=True)
class Scene(Generic[S]):
    """A system, where it starts, and a reference that does not use the library.

    - `name`; `system`; `args`.
    - `y0`: the start, consistent to round-off, as numpy float64 arrays: (q, v), (x, z) or y.
    - `t1`: a natural end time, in s.
    - `reference(times)`: the state at the given times, with a leading axis of times; NaN where nothing is known.
    - `horizon`: until when the reference can be trusted to about 1e-7 (chaos), in s.
    - `chart`: a global chart ψ for `StateSpace`, where there is one.
    - `index`: the differentiation index.
    - `scale`: the size below which a variable counts as zero: atol = scale · rtol, and errors are relative to the larger
      of it and the reference.
    - `stiff`: explicit methods are out of the question.
    - `first`: where the solution changes over decades of time: when it begins to, in s.
    - `kinks`: when sources have kinks or jumps, in s: for `jump_ts`.
    - `drawing`: how to draw it, a mechanism.
    - `paper`: the paper's figures that show it, by their names in `dae-jax compare`.
    """

    name: str
    system: S
    y0: Any
    t1: float
    reference: Callable[[np.ndarray], Any]
    horizon: float = np.inf
    chart: Callable[..., Any] | None = None
    args: Any = None
    index: int = 3
    scale: float = 1.0
    stiff: bool = False
    first: float | None = None
    kinks: tuple[float, ...] = ()
    drawing: Drawing | None = None
    paper: tuple[str, ...] = ()

    def times(self, t1: float, count: int) -> np.ndarray:
        """So many times from 0 to `t1`, evenly spaced; in the logarithm where the solution changes over decades."""
        if self.first is None or self.first >= t1:
            return np.linspace(0.0, t1, count)
        return np.concatenate([[0.0], np.geomspace(self.first, t1, count - 1)])

    def known(self, times: np.ndarray) -> np.ndarray:
        """Those of the times at which the reference knows anything of the state."""
        within = np.asarray(times)[np.asarray(times) <= self.horizon]
        something = [
            np.any(~np.isnan(x).reshape(len(within), -1), axis=1) for x in jax.tree.leaves(self.reference(within))
        ]
        return within[np.any(something, axis=0)]

    def error(self, times: np.ndarray, ys: State) -> float:
        """The largest error of states at the given times where they are `known`, relative where the reference is larger than `scale`."""
        within = np.asarray(times) <= self.horizon
        exact = jax.tree.leaves(self.reference(np.asarray(times)[within]))
        off = [
            np.abs(np.asarray(y)[within] - e) / np.maximum(np.abs(e), self.scale)
            for y, e in zip(jax.tree.leaves(ys), exact, strict=True)
        ]
        known = np.concatenate([x[~np.isnan(e)] for x, e in zip(off, exact, strict=True)])
        return float(known.max()) if known.size else np.nan


def published(t1: float, end: PyTree[np.ndarray]) -> Callable[[np.ndarray], Any]:
    """A reference of which only the state at `t1` is published."""

    def reference(times: np.ndarray) -> Any:
        at_end = np.asarray(times) == t1
        return jax.tree.map(lambda e: np.where(at_end[:, None], e, np.nan), end)

    return reference


def minimal(
    field: Callable[[float, np.ndarray], np.ndarray],
    z0: Sequence[float] | np.ndarray,
    embed: Callable[[float, np.ndarray], Any],
    method: str = "DOP853",
    kinks: tuple[float, ...] = (),
    max_step: float = 0.05,
) -> Callable[[np.ndarray], Any]:
    """A reference from ż = field(t, z) in minimal coordinates, by a method of scipy at rtol 1e-13, begun anew at `kinks`;
    `embed(t, z)` is the state for one time and z: one array or a tuple of arrays.
    """

    @functools.lru_cache(maxsize=4)
    def solved(moments: bytes) -> Any:
        from scipy.integrate import solve_ivp

        times = np.frombuffer(moments)
        points = np.unique(np.concatenate([[0.0], times]))
        rows, begin, z = [embed(0.0, np.asarray(z0, float))], 0.0, z0
        last = points[-1]
        for end in [*(kink for kink in kinks if kink < last), last] if last else []:
            # A jump at a kink belongs to what comes after it.
            stop = np.nextafter(end, 0) if end in kinks else end
            wanted = np.minimum(points[(points > begin) & (points <= end)], stop)
            found = solve_ivp(
                field, (begin, stop), z, method, np.union1d(wanted, [stop]), rtol=1e-13, atol=1e-14, max_step=max_step
            )
            rows += [embed(t, y) for t, y in zip(found.t[: len(wanted)], found.y.T, strict=False)]
            begin, z = end, found.y[:, -1]
        at = np.searchsorted(points, times)
        return jax.tree.map(lambda *x: _shared(np.stack(x)[at]), *rows)

    return lambda times: solved(np.atleast_1d(np.asarray(times, float)).tobytes())


def _shared(values: np.ndarray) -> np.ndarray:
    """What is cached is not to be written to."""
    values.setflags(write=False)
    return values
