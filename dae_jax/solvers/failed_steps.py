"""Steps that fail have no part in a reverse derivative."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..types import BoolLike, Time


class WithoutFailedSteps(diffrax.AbstractWrappedSolver):
    """`solver` for reverse derivatives.

    A step whose equations have no solution ends in NaN, is rejected, and has the cotangent 0; but 0 times the NaN inside
    of it would be NaN. Its cotangents are set to 0 here.
    """

    solver: diffrax.AbstractSolver

    @property
    def term_structure(self) -> Any:
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:
        return self.solver.interpolation_cls

    def order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.error_order(terms)

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Any, args: Any) -> Any:
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        return self.solver.init(terms, t0, t1, y0, args)

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
            return jax.tree.map(lambda c: jnp.where(found, c, 0), pull_back(cotangent)[0]), None

        step = jax.custom_vjp(run)
        step.defvjp(forward, backward)
        return eqx.combine(step(numbers, others), tuple(static))
