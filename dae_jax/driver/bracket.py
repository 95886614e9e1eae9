"""Where in a step an event is: bisection that ends in any unit, and that asks nothing of lanes without an event."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float

from ..types import Scalar, Time


# Of the resolution of time at the ends of a step, the width in which a zero is found.
RESOLVED = 4


class _Bracket(NamedTuple):
    """The ends of the interval, whether the condition falls there, its last value, the width that time resolves, and whether
    there is a zero between the ends of the step.
    """

    lower: Time
    upper: Time
    falls: Bool[Array, ""]
    value: Float[Array, ""]
    resolved: Float[Array, ""]
    has_zero: Bool[Array, ""]


class Bracket(optimistix.AbstractRootFinder):
    """As `optimistix.Bisection`, which ends where the interval is below atol + rtol · |t| and the condition below atol; but also
    where time resolves no smaller interval, however large the condition is in its unit. Where no zero is in the interval, the root
    is not found: in a batch also lanes without an event are asked, which must not stop the others.
    """

    rtol: Any
    atol: Any
    flip: Any

    norm: ClassVar[Callable[..., Any]] = jnp.abs

    def init(
        self, fn: Any, y: Scalar, args: Any, options: dict[str, Any], f_struct: Any, aux_struct: Any, tags: Any
    ) -> _Bracket:
        lower, upper = (jnp.asarray(options[end], f_struct.dtype) for end in ("lower", "upper"))
        largest = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
        resolved = RESOLVED * jnp.finfo(lower.dtype).eps * largest
        falls, has_zero = jnp.asarray(self.flip is True), jnp.asarray(True)
        if self.flip == "detect":
            (first, _), (last, _) = fn(lower, args), fn(upper, args)
            falls, has_zero = first > last, jnp.sign(first) * jnp.sign(last) <= 0
        return _Bracket(lower, upper, falls, jnp.full_like(lower, jnp.inf), resolved, has_zero)

    def step(
        self, fn: Any, y: Scalar, args: Any, options: dict[str, Any], state: _Bracket, tags: Any
    ) -> tuple[Scalar, _Bracket, Any]:
        value, aux = fn(y, args)
        before = state.falls ^ (value < 0)
        lower, upper = jnp.where(before, y, state.lower), jnp.where(before, state.upper, y)
        return lower + 0.5 * (upper - lower), state._replace(lower=lower, upper=upper, value=value), aux

    def terminate(
        self, fn: Any, y: Scalar, args: Any, options: dict[str, Any], state: _Bracket, tags: Any
    ) -> tuple[Bool[Array, ""], optimistix.RESULTS]:
        width = state.upper - state.lower
        near = (width < self.atol + self.rtol * jnp.abs(y)) & (jnp.abs(state.value) < self.atol)
        found, none = optimistix.RESULTS.successful, optimistix.RESULTS.nonlinear_divergence
        ends = near | (width <= state.resolved) | ~state.has_zero
        return ends, optimistix.RESULTS.where(state.has_zero, found, none)

    def postprocess(
        self,
        fn: Any,
        y: Scalar,
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: _Bracket,
        tags: Any,
        result: optimistix.RESULTS,
    ) -> tuple[Scalar, Any, dict[str, Any]]:
        return y, aux, {}


def bracketing(finder: Any) -> Any:
    """A root finder of an event, bisection as a `Bracket`."""
    if type(finder) is not optimistix.Bisection or finder.expand_if_necessary:
        return finder
    return Bracket(finder.rtol, finder.atol, finder.flip)
