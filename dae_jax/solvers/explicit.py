"""Explicit Runge–Kutta steps with the stages written out and the zero coefficients left out."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..compiler import is_large, scalarise, subroutine
from ..types import BoolLike, Scalar, Time
from .wrapping import AbstractWrapper


# A larger state goes through the stages in a loop, as one with a large field does: compiling takes a quarter of the time.
UNROLLED = 40


def identity(_: Any, y: Any) -> tuple[Any, bool]:
    """Lands nowhere else."""
    return y, True


def combine(coefficients: Sequence[float] | np.ndarray, slopes: Sequence[Any]) -> Any:
    """Σ cᵢ fᵢ over the coefficients that are not zero."""
    return sum(float(c) * f for c, f in zip(coefficients, slopes, strict=False) if c != 0)


def advanced(y: Any, h: Any, coefficients: Sequence[float] | np.ndarray, slopes: Sequence[Any]) -> Any:
    """y + h Σ cᵢ fᵢ; the newest slope comes last, one multiplication and one addition before the result."""
    for c, f in zip(coefficients, slopes, strict=False):
        y = y + (h * float(c)) * f if c != 0 else y
    return y


def stage_slopes(
    a: Sequence[np.ndarray],
    c: np.ndarray,
    field: Callable[[Any, Any], Any],
    t0: Any,
    t1: Any,
    h: Any,
    y0: Any,
    f0: Any,
    looped: bool,
) -> list[Any]:
    """fᵢ = f(t₀ + cᵢ h, y₀ + h Σ aᵢⱼ fⱼ) for an explicit tableau, `f0` the first.

    `looped`: the stages in a loop in place of one after the other.
    """
    if looped:
        return _slopes_in_a_loop(a, c, field, t0, t1, h, y0, f0)
    fs = [f0]
    for row, ci in zip(a, c, strict=True):
        ti = t1 if ci == 1 else t0 + float(ci) * (t1 - t0)
        fs.append(field(ti, advanced(y0, h, row, fs)))
    return fs


def _slopes_in_a_loop(a: Any, c: Any, field: Any, t0: Time, t1: Time, h: Any, y0: Any, f0: Any) -> list[Any]:
    # Of each row the coefficients that are not zero, and where they are; rows are filled up with zeros.
    used = [np.flatnonzero(row) for row in a]
    longest = max(map(len, used))
    places = np.array([np.pad(at, (0, longest - len(at))) for at in used])
    weights = h * jnp.asarray(
        [np.pad(row[at], (0, longest - len(at))) for row, at in zip(a, used, strict=True)], y0.dtype
    )
    nodes, places = jnp.asarray(c, jnp.result_type(t0)), jnp.asarray(places)

    def stage(i: Any, fs: Any) -> Any:
        ti = jnp.where(nodes[i] == 1, t1, t0 + nodes[i] * (t1 - t0))
        yi = y0
        for k in range(longest):
            yi = yi + weights[i, k] * jax.lax.dynamic_index_in_dim(fs, places[i, k], 0, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(fs, field(ti, yi), i + 1, 0)

    fs = jnp.zeros((len(a) + 1, y0.size), y0.dtype).at[0].set(f0)
    return list(jax.lax.fori_loop(0, len(a), stage, fs))


class Flat:
    """The field, the state and `retract` of a step on one vector, in which every linear combination is one loop."""

    def __init__(self, terms: diffrax.AbstractTerm, t0: Time, y0: Any, args: Any, retract: Callable[..., Any]) -> None:
        self.y0, self.tree = ravel_pytree(y0)
        self.field = subroutine(scalarise(lambda t, y: self.vector(terms.vf(t, self.tree(y), args))))
        self._retract = retract
        self.looped = self.y0.size > UNROLLED or getattr(terms, "looped", False) or is_large(self.field, t0, self.y0)

    @staticmethod
    def vector(tree: Any) -> Any:
        """The numbers of a pytree."""
        return ravel_pytree(tree)[0]

    def retract(self, t: Any, y: Any) -> tuple[Any, Any]:
        """Where a point lands, and whether it was found."""
        if self._retract is identity:
            return y, True
        end, found = self._retract(t, self.tree(y))
        return self.vector(end), found


class Unrolled(AbstractWrapper):
    """An explicit diffrax Runge–Kutta solver with its stages written out, equal to it up to round-off.

    The wrapped solver's tableau and interpolation are used as they are. `retract` is applied to the end of the step before
    the last stage of a method whose last stage is there, so that the derivative carried to the next step (first same as
    last) belongs to the point where the step really ended.
    """

    solver: diffrax.AbstractERK

    @property
    def term_structure(self) -> Any:
        return diffrax.ODETerm

    @property
    def tableau(self) -> diffrax.ButcherTableau:
        """The coefficients; a solver of several terms, which has several tableaus, is not wrapped."""
        assert isinstance(self.solver.tableau, diffrax.ButcherTableau)
        return self.solver.tableau

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args) if self.tableau.fsal else None

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
        *step, _ = self.step_and_retract(terms, t0, t1, y0, args, solver_state, made_jump, identity)
        return *step, diffrax.RESULTS.successful

    def step_and_retract(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        state: Any,
        made_jump: BoolLike,
        retract: Callable[..., Any],
        excused: Scalar | float = 0.0,
    ) -> Any:
        """`step`, with its end moved to `retract(t1, y1)` → (y1, found); see `with_retraction`."""
        tableau = self.tableau
        h = terms.contr(t0, t1)
        flat = Flat(terms, t0, y0, args, retract)
        f0 = first_derivative(flat, t0, state, made_jump)
        rows, nodes = tableau.a_lower, tableau.c
        f1 = None
        if tableau.fsal:
            fs = stage_slopes(rows[:-1], nodes[:-1], flat.field, t0, t1, h, flat.y0, f0, flat.looped)
            ahead = flat.y0 + h * combine(rows[-1], fs)
            y1, found = flat.retract(t1, ahead)
            f1 = flat.field(t1, y1)
            fs.append(f1)
        else:
            fs = stage_slopes(rows, nodes, flat.field, t0, t1, h, flat.y0, f0, flat.looped)
            ahead = flat.y0 + h * combine(tableau.b_sol, fs)
            y1, found = flat.retract(t1, ahead)
        estimates = np.any(tableau.b_error)
        error = flat.tree(with_retraction(h * combine(tableau.b_error, fs), ahead, y1, excused)) if estimates else None
        dense = {"y0": y0, "y1": flat.tree(y1), "k": jax.tree.map(lambda *f: h * jnp.stack(f), *map(flat.tree, fs))}
        return flat.tree(y1), error, dense, None if f1 is None else flat.tree(f1), found


def with_retraction(error: Array, ahead: Array, retracted: Array, excused: Scalar | float) -> Array:
    """The error, and where it is more how far the end was moved: a manifold that jumps does not show in the stages, nor does that
    the way back is long, as it is for a variable of another unit. Less than `excused` does not count.
    """
    if retracted is ahead:
        return error
    moved = retracted - ahead
    return jnp.where(jnp.abs(moved) > jnp.maximum(jnp.abs(error), excused), moved, error)


def first_derivative(flat: Flat, t0: Time, state: Any, made_jump: BoolLike) -> Any:
    """f(t₀, y₀), from the last step where that left it."""
    if state is None or made_jump is True:
        return flat.field(t0, flat.y0)
    state = flat.vector(state)
    if made_jump is False:
        return state
    return jax.lax.cond(made_jump, lambda: flat.field(t0, flat.y0), lambda: state)


def unrolled(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """`solver` with its stages written out where it is an explicit Runge–Kutta method of diffrax, else as it is."""
    if isinstance(solver, diffrax.AbstractERK) and type(solver).__module__.startswith("diffrax."):
        return Unrolled(solver)
    return solver
