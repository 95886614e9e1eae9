"""The formulas of steps, written down and taken again, of a solver that chooses one for each step by its errors."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int8

from ..solvers import AbstractResidualSolver
from ..solvers.wrapping import AbstractWrapper
from ..types import BoolLike, IntScalar, Time


class Chosen(NamedTuple):
    """What the solver's own step left, how many steps were accepted, and their formulas where these are written down."""

    inner: Any
    count: IntScalar
    formulas: Int8[Array, " steps"] | None


class KnownFormulas(AbstractWrapper):
    """`solver`, a wrapper of the solver `of`, with steps by the formulas `known`, all of which are accepted; where these are None, the
    formulas of accepted steps are written down, `most` of them.
    """

    solver: diffrax.AbstractSolver
    of: AbstractResidualSolver
    known: Int8[Array, " steps"] | None
    most: int = eqx.field(static=True)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Chosen:
        state = self.solver.init(terms, t0, t1, y0, args)
        written = self.known is None and self.of.formula(state) is not None
        return Chosen(state, jnp.asarray(0), jnp.zeros(self.most, jnp.int8) if written else None)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Chosen,
        made_jump: BoolLike,
    ) -> Any:
        state, count, formulas = solver_state
        formula = self.of.formula(state)
        if self.known is not None:
            state = self.of.by_formula(state, self.known[count].astype(int))
        elif formula is not None:
            formulas = lax.dynamic_update_index_in_dim(formulas, formula.astype(jnp.int8), count, 0)
        *found, state, result = self.solver.step(terms, t0, t1, y0, args, state, made_jump)
        return *found, Chosen(state, count + 1, formulas), result
