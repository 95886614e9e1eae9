"""DOP853: an explicit Runge–Kutta method of order 8, for accuracies of 1e-6 and better."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..types import Args, BoolLike, Scalar, Time, Y
from . import dop853_coefficients as coefficients
from .explicit import Flat, advanced, combine, first_derivative, identity, stage_slopes, with_retraction


STAGES = 12
_ROWS = tuple(coefficients.A[i, :i] for i in range(1, 16))
# The method of order 3 differs from the method itself in few coefficients.
_B_MINUS_E3 = coefficients.B - coefficients.E3[:STAGES]


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """The interpolant of order 7; `f` are the coefficients of its nested form."""

    t0: Any
    t1: Any
    y0: Any
    f: Any

    def evaluate(self, t0: Time, t1: Time | None = None, left: bool = True) -> Any:
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        x = (t0 - self.t0) / jnp.where(self.t1 == self.t0, 1, self.t1 - self.t0)

        def nested(y0: Array, f: Array) -> Any:
            y = jnp.zeros_like(y0)
            for i in reversed(range(len(f))):
                y = (y + f[i]) * (x if i % 2 == 0 else 1 - x)
            return y0 + y

        return jax.tree.map(nested, self.y0, self.f)


class DOP853(diffrax.AbstractAdaptiveSolver):
    """Dormand and Prince's method of order 8 with twelve stages, first same as last.

    Two error estimates, of order 5 and 3, are combined as in Hairer and Wanner's program,
    err = |e₅| |e₅| / √(|e₅|² + 0.01 |e₃|²). Dense output of order 7 takes three more evaluations a step; with `dense`
    false they are left out and points between steps cannot be had (`daesolve` sets it as `saveat` and `event` need it).

    Source: E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations I*, 2nd ed., II.5, II.6, II.10.
    """

    dense: bool = True

    term_structure = diffrax.ODETerm
    interpolation_cls = _Interpolation

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return 8

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        args: Args,
        solver_state: PyTree,
        made_jump: BoolLike,
    ) -> Any:
        *step, _ = self.step_and_retract(terms, t0, t1, y0, args, solver_state, made_jump, identity)
        return *step, diffrax.RESULTS.successful

    def step_and_retract(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        args: Args,
        state: Y,
        made_jump: BoolLike,
        retract: Callable[..., tuple[Y, BoolLike]],
        excused: Scalar | float = 0.0,
    ) -> Any:
        """`step`, with its end moved to `retract(t1, y1)` → (y1, found); see `with_retraction`."""
        h = terms.contr(t0, t1)
        flat = Flat(terms, t0, y0, args, retract)
        f0 = first_derivative(flat, t0, state, made_jump)
        rows, nodes = _ROWS[: STAGES - 1], coefficients.C[1:STAGES]
        fs = stage_slopes(rows, nodes, flat.field, t0, t1, h, flat.y0, f0, flat.looped)
        slope = combine(coefficients.B, fs)
        ahead = flat.y0 + h * slope
        y1, found = flat.retract(t1, ahead)
        f1 = flat.field(t1, y1)
        fs.append(f1)
        error = h * _error(combine(coefficients.E5, fs), slope - combine(_B_MINUS_E3, fs), flat.y0, y1)
        error = with_retraction(error, ahead, y1, excused)
        rest = self._interpolant(flat, t0, t1, h, y1, fs) if self.dense else [y1 - flat.y0]
        dense = {"y0": y0, "f": jax.tree.map(lambda *f: jnp.stack(f), *map(flat.tree, rest))}
        return flat.tree(y1), flat.tree(error), dense, flat.tree(f1), found

    def _interpolant(self, flat: Flat, t0: Time, t1: Time, h: Time, y1: Array, fs: list[Array]) -> list[Any]:
        """The coefficients of the nested form."""
        for row, c in zip(_ROWS[STAGES:], coefficients.C[STAGES + 1 :], strict=True):
            fs = [*fs, flat.field(t0 + float(c) * (t1 - t0), advanced(flat.y0, h, row, fs))]
        first, last, change = h * fs[0], h * fs[STAGES], y1 - flat.y0
        slopes = [change, first - change, 2 * change - (first + last)]
        return slopes + [h * combine(row, fs) for row in coefficients.D]


def _error(e5: Array, e3: Array, y0: Array, y1: Array) -> Any:
    # Relative to 1 + |y|, the scale of equal relative and absolute tolerances; only the ratio of the two counts.
    weights = 1 / (1 + jnp.maximum(jnp.abs(y0), jnp.abs(y1))) ** 2
    five, three = jnp.sum(weights * e5**2), jnp.sum(weights * e3**2)
    both = five + 0.01 * three
    # The derivative of the ratio, and of the square root, at 0 is infinite; that of an error of 0 is that of e₅.
    some = (five > 0) & (both > float(jnp.finfo(both.dtype).tiny) ** 0.5)
    return e5 * jnp.sqrt(jnp.where(some, five, 1) / jnp.where(some, both, 1))
