"""What a scene is, and the tight solve in minimal coordinates that references are made with."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..systems import ConstrainedSystem


State = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Scene:
    """A system, where it starts, and a reference that does not use the library.

    - `name`; `system`; `args`.
    - `y0`: (q, v), consistent to round-off, as numpy float64 arrays.
    - `t1`: a natural end time, in s.
    - `reference(times)`: (q, v) at the given times, with a leading axis of times.
    - `horizon`: until when the reference can be trusted to about 1e-7 (chaos), in s.
    - `chart`: a global chart ψ for `StateSpace`, where there is one.
    """

    name: str
    system: ConstrainedSystem
    y0: State
    t1: float
    reference: Callable[[np.ndarray], State]
    horizon: float = np.inf
    chart: Callable[..., Any] | None = None
    args: Any = None


def minimal(
    field: Callable[[float, np.ndarray], np.ndarray], z0: list[float], embed: Callable[[np.ndarray, np.ndarray], State]
) -> Callable[[np.ndarray], State]:
    """A reference from ż = field(t, z) in minimal coordinates, by scipy's DOP853 at rtol 1e-13; `embed(t, z)` is (q, v)
    for one time and state.
    """

    def reference(times: np.ndarray) -> State:
        from scipy.integrate import solve_ivp

        times = np.atleast_1d(np.asarray(times, float))
        points = np.unique(np.concatenate([[0.0], times]))
        found = solve_ivp(field, (0.0, points[-1] or 1.0), z0, "DOP853", points, rtol=1e-13, atol=1e-14, max_step=0.05)
        rows = [embed(t, z) for t, z in zip(points, found.y.T, strict=True)]
        q, v = (np.stack(x) for x in zip(*rows, strict=True))
        at = np.searchsorted(points, times)
        return q[at], v[at]

    return reference
