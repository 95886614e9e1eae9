"""A step is traced once, although the loops around it trace what they repeat several times, and derivatives once more."""

import functools
from typing import Any

import diffrax
import jax

from ..compiler.types import Arrays
from ..solution import Split
from ..solvers.wrapping import AbstractWrapper
from ..types import BoolLike, Time
from .problem import Program, split


class TracedOnce(AbstractWrapper):
    """`solver`, with its steps as they were traced first."""

    solver: diffrax.AbstractSolver

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Any,
        made_jump: BoolLike,
    ) -> Any:
        return _step(*split((self.solver, (terms, t0, t1, y0, args, solver_state, made_jump)))).whole()


@functools.partial(jax.jit, static_argnums=0, inline=True)
def _step(program: Program, arrays: Arrays) -> Split:
    solver, inputs = program.whole(arrays)
    return Split.of(solver.step(*inputs))
