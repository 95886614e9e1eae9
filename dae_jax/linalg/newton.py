"""Nonlinear equations: Newton's method to round-off, and the derivative of its solution.

The tolerances of every nonlinear solve of the library are stated here and nowhere else.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..types import DType
from .dense import solve


MAX_STEPS = 20
# How often so many steps are made where each time an exponential has come down: a number has 709 factors of e.
ROUNDS = 9


def roundoff(dtype: DType) -> float:
    """How small the error of a solved unknown is, relative to 1 + its size, when it counts as solved."""
    return 4 * float(jnp.finfo(dtype).eps)


def amplified_roundoff(dtype: DType) -> float:
    """What corrections of a residual that is round-off may be, relative to 1 + the size of the unknowns, near a singular
    point, where it is amplified so much that they end below this without shrinking to less.
    """
    return float(jnp.finfo(dtype).eps) ** 0.55


def relative_change(delta: Float[Array, " n"], x: Float[Array, " n"]) -> Float[Array, ""]:
    """The size of a correction `delta` relative to 1 + the size of `x`, in the maximum norm."""
    return jnp.max(jnp.abs(delta), initial=0.0) / (1 + jnp.max(jnp.abs(x), initial=0.0))


def newton(
    residual: Callable[[Float[Array, " n"], Any], Float[Array, " n"]],
    x0: Float[Array, " n"],
    params: PyTree,
    *,
    linear_solve: Callable[[Float[Array, "n n"], Float[Array, " n"]], Float[Array, " n"]] = solve,
    max_steps: int = MAX_STEPS,
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """x with residual(x, params) = 0 by Newton's method from `x0`, and whether it was found.

    Corrections δₖ are made until what remains, δₖ²/δₖ₋₁ by the observed rate of convergence, is round-off, or until
    they no longer shrink, nor go on in one direction, and are within 1000 times of it (the residual's own round-off,
    amplified by an ill-conditioned Jacobian). A first correction says nothing of that, unless it is round-off itself:
    where F is steep it is small however far the solution is. The solution is differentiated implicitly, dx =
    −(∂F/∂x)⁻¹ ∂F/∂params dparams, in both modes and to any order; `x0` has no derivative.
    """

    def from_start(x: Float[Array, " n"], given: PyTree) -> Float[Array, " n"]:
        return residual(x, given[0])

    def iterate(given: PyTree) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
        params, start = given

        def correct(x: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
            delta = linear_solve(jax.jacfwd(residual)(x, params), residual(x, params))
            return x - delta, relative_change(delta, x)

        return fixed_point(correct, start, max_steps=max_steps)

    # The start is handed over, not closed over: the derivative rule may run when the trace it is of has ended.
    return implicit_root(from_start, iterate, (params, lax.stop_gradient(x0)), linear_solve=linear_solve)


def fixed_point(
    correct: Callable[[Any], tuple[Any, Any]],
    x: Any,
    last: Any = None,
    max_steps: int = MAX_STEPS,
) -> tuple[Any, Bool[Array, ""]]:
    """Applies `correct`: x ↦ (x, relative size of the correction) until what remains is round-off; see `newton`.

    The size may be a pair: by the first one corrections shrink, and by the second one those that no longer do may be round-off. `last`:
    the size of the correction δ that led to `x`, where one has been made that is known to leave about δ² behind.
    """
    dtype = jnp.result_type(*jax.tree.leaves(x))
    tolerance = roundoff(dtype)
    one = jnp.ones((), dtype)
    proves_nothing = last is None
    # Where an equation is steep corrections are as small without being round-off.
    noise = 0.0 if proves_nothing else amplified_roundoff(dtype)

    def pair(size: Any) -> Any:
        return size if isinstance(size, tuple) else (size, size)

    def stagnant(last: Any, previous: Any, turned: Any, bound: Any) -> Any:
        # Round-off has no direction; corrections that go on in one are on their way down an equation that is steep.
        return turned & (last > previous / 2) & (bound < 1000 * tolerance) | (last >= previous) & (bound < noise)

    def unfinished(carry: Any) -> Bool[Array, ""]:
        _, _, turned, (last, bound), previous, count = carry
        remaining = last * jnp.minimum(last / previous, 1)
        if proves_nothing:
            remaining = jnp.where(count == 1, last, remaining)
        # A NaN compares false and ends the loop.
        return (count < max_steps) & (remaining > tolerance) & ~stagnant(last, previous, turned, bound)

    def body(carry: Any) -> Any:
        x, delta, _, (last, _), _, count = carry
        new, size = correct(x)
        before, delta = delta, jax.tree.map(jnp.subtract, new, x)
        turned = _inner(delta, before) <= jnp.sqrt(_inner(delta, delta)) * jnp.sqrt(_inner(before, before)) / 2
        # The correction before the first counts as 1, as if it left δ² behind.
        return (
            new,
            delta,
            turned,
            pair(size),
            jnp.where(last < jnp.inf, jnp.maximum(last, jnp.finfo(dtype).tiny), one),
            count + 1,
        )

    none = jax.tree.map(jnp.zeros_like, x)
    first = (pair(jnp.full((), jnp.inf, dtype)), one, 0) if last is None else (pair(last), one, 1)
    x, _, turned, (size, bound), previous, _ = lax.while_loop(unfinished, body, (x, none, jnp.asarray(True), *first))
    remaining = size * jnp.minimum(size / previous, 1)
    return x, (remaining <= tolerance) | (size <= previous / 2) & (bound < 1000 * tolerance) | stagnant(
        size, previous, turned, bound
    )


def while_progress(
    correct: Callable[[Any], tuple[Any, Float[Array, ""]]],
    x: Any,
    residual: Callable[[Any], Float[Array, " m"]],
    max_steps: int,
) -> tuple[Any, Bool[Array, ""]]:
    """`fixed_point`, after each `max_steps` once more if the largest residual has become less than a thousandth in these: far up an
    exponential a correction takes it down by a factor of e.
    """

    def more(carry: Any) -> Any:
        x, _, now, _, count = carry
        new, found = fixed_point(correct, x, max_steps=max_steps)
        return new, found, jnp.max(jnp.abs(residual(new)), initial=0.0), now, count + 1

    def goes_on(carry: Any) -> Bool[Array, ""]:
        _, found, now, before, count = carry
        return (count == 0) | ~found & (now < before / 1000) & (count < ROUNDS)

    infinite = jnp.full((), jnp.inf, jnp.result_type(*jax.tree.leaves(x)))
    x, found, *_ = lax.while_loop(goes_on, more, (x, jnp.asarray(False), infinite, infinite, 0))
    return x, found


def _inner(a: Any, b: Any) -> Float[Array, ""]:
    return jax.tree.reduce(jnp.add, jax.tree.map(lambda a, b: jnp.sum(a * b), a, b))


def implicit_root(
    residual: Callable[[Float[Array, " n"], Any], Float[Array, " n"]],
    iterate: Callable[[Any], tuple[Float[Array, " n"], Any]],
    params: PyTree,
    *,
    linear_solve: Callable[[Any, Float[Array, " n"]], Float[Array, " n"]] = solve,
    jacobian: Callable[[Float[Array, " n"], Any], Any] | None = None,
) -> tuple[Float[Array, " n"], Any]:
    """`iterate(params)` → (x, how it went) with the derivative of the solution of residual(x, params) = 0.

    By the implicit function theorem; the iteration is not differentiated, and how it went (any pytree of arrays) has no
    derivative. Everything that is traced and that `residual` or `iterate` depends on must be in `params`, a pytree.
    `linear_solve` gets what `jacobian(x, params)` gives, by default the matrix ∂residual/∂x.
    """
    arrays, static = eqx.partition(params, eqx.is_array)
    jacobian = jax.jacfwd(residual) if jacobian is None else jacobian

    @jax.custom_jvp
    def find(arrays: PyTree) -> tuple[Float[Array, " n"], Any]:
        return iterate(eqx.combine(arrays, static))

    @find.defjvp
    def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        (arrays,), (directions,) = primals, tangents
        x, outcome = find(arrays)
        _, change = jax.jvp(lambda a: residual(x, eqx.combine(a, static)), (arrays,), (directions,))
        dx = -linear_solve(jacobian(x, eqx.combine(arrays, static)), change)
        return (x, outcome), (dx, jax.tree.map(_no_tangent, outcome))

    return find(arrays)


def _no_tangent(x: Any) -> Any:
    inexact = jnp.issubdtype(x.dtype, jnp.inexact)
    return jnp.zeros_like(x) if inexact else np.zeros(x.shape, jax.dtypes.float0)
