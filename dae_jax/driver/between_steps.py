"""Points between the steps of a solve, and how they move with their time.

The polynomials there have slopes of a lower order than their values. So the derivative of a point by its time is that of the flow of
the equations through it, not that of the polynomial.
"""

from typing import Any

import equinox as eqx
import jax
from jax import lax

from ..equations.manifold_ode import Equations
from ..formulations import AbstractFieldFormulation
from ..types import Time, Y


@eqx.filter_custom_jvp
def along_flow(y: Y, t: Time, formulation: AbstractFieldFormulation, ode: Equations) -> Any:  # noqa: ARG001
    """y, a point at t that is still: it moves with t as ẏ = field(t, y) says. Derivatives by t are right to the fourth."""
    return y


@along_flow.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    if tangents[1] is None:
        return primals[0], tangents[0]
    return eqx.filter_jvp(_runge_kutta, primals, tangents)


def _runge_kutta(y: Y, t: Time, formulation: AbstractFieldFormulation, ode: Equations) -> Any:
    """A step of the classical method from y to itself, of the length 0 that grows with t."""
    start = lax.stop_gradient(t)
    h = t - start
    field = lambda t, y: formulation.field(t, y, ode)
    plus = lambda h, rates: jax.tree.map(lambda y, rate: y + h * rate, y, rates)
    first = field(start, y)
    second = field(start + h / 2, plus(h / 2, first))
    third = field(start + h / 2, plus(h / 2, second))
    fourth = field(t, plus(h, third))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, first, second, third, fourth)
    return plus(h, mean)
