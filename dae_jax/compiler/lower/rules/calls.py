"""The rule of calls that stay calls."""

from typing import Any

from jax.extend.core import ClosedJaxpr

from ..arrays import Operand
from ..context import Context
from ..dtypes import ALL
from ..registry import free, rule


@rule("procedure", ALL, cost=free, nested=True)
def procedure(context: Context, *args: Operand, jaxpr: ClosedJaxpr) -> list[Any]:
    """A function that is written once."""
    return context.call(jaxpr, list(args))
