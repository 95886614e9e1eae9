"""Steps in coordinates that are chosen among the entries of the state, and chosen again when they turn bad."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from .manifold import clock
from .tangent_space import TangentSpace


class Selection(NamedTuple):
    """What a step leaves to the next: ẏ at its end, the directions of the entries that are not integrated, and how often
    these have changed.
    """

    derivative: Any
    directions: Any
    switches: Any


class SelectedStates(TangentSpace):
    """A step of an explicit solver in some entries of the state, its *states*; the others, as many as there are
    constraints, are found from H(t, y) = 0 by Newton's method at each stage. Used by `DummyDerivatives`, which see.
    """

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Selection:
        directions, _ = args.selection(clock(terms, t0, t1) * t0, y0, None)
        return Selection(terms.vf(t0, y0, args), directions, jnp.asarray(0))

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Selection, made_jump: Any) -> Any:
        directions, switched = args.selection(clock(terms, t0, t1) * t0, y0, solver_state.directions)
        y1, error, dense, derivative, result = self.step_in(
            directions, terms, t0, t1, y0, args, solver_state.derivative, made_jump
        )
        return y1, error, dense, Selection(derivative, directions, solver_state.switches + switched), result
