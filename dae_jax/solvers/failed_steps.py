"""Steps that fail have no part in a reverse derivative."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..types import BoolLike, Time
from .wrapping import AbstractWrapper


class WithoutFailedSteps(AbstractWrapper):
    """`solver` for reverse derivatives.

    A step whose equations have no solution ends in NaN, is rejected, and has the cotangent 0; but 0 times the NaN inside
    of it would be NaN. Its cotangents are set to 0 here; NaN they are if it counts after all.
    """

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
        arrays, rest = eqx.partition((self.solver, terms, t0, t1, y0, args, solver_state, made_jump), eqx.is_array)
        numbers, others = eqx.partition(arrays, eqx.is_inexact_array)
        static: list[Any] = []

        def run(numbers: Any, others: Any) -> Any:
            solver, *inputs = eqx.combine(numbers, others, rest)
            out, static[:] = eqx.partition(solver.step(*inputs), eqx.is_array)
            return out

        def forward(numbers: Any, others: Any) -> Any:
            out = run(numbers, others)
            y1, error, *_ = out
            finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((y1, error))]
            return out, (numbers, others, jnp.all(jnp.stack(finite)))

        def backward(saved: Any, cotangent: Any) -> Any:
            numbers, others, found = saved
            _, pull_back = jax.vjp(lambda numbers: run(numbers, others), numbers)
            counts = jnp.any(
                jnp.stack([jnp.any(c != 0) for c in jax.tree.leaves(eqx.filter(cotangent, eqx.is_inexact_array))])
            )
            otherwise = jnp.where(counts, jnp.nan, 0)
            return jax.tree.map(lambda c: jnp.where(found, c, otherwise.astype(c.dtype)), pull_back(cotangent)[0]), None

        step = jax.custom_vjp(run)
        step.defvjp(forward, backward)
        return eqx.combine(step(numbers, others), tuple(static))
