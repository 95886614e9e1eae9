"""Checks of equinox (`error_if`) taken out of a function: what has failed becomes a number that the function gives too.

Machine code cannot raise. It tells instead which check failed first, and who called it raises.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from .._compat import check_messages, dce_jaxpr, is_check
from ..types import Arrays, Equation
from .rewriting import Rewriting
from .scalar_interpreter import Unsupported
from .walk import equations


def checks_apart(closed: ClosedJaxpr) -> tuple[ClosedJaxpr, tuple[str, ...]]:
    """The function without its checks, with one result more, and the messages of all checks; without checks, itself.

    The result is 0, or 1 + the place of the message of the check that failed first. A loop ends where a check in it fails.
    Raises `Unsupported` where a check is in the condition of a loop, or its message cannot be found.
    """
    needed, _ = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    closed = ClosedJaxpr(needed, closed.consts)
    if not any(map(_is_check, equations(closed))):
        return closed, ()
    messages: list[str] = []
    first: dict[int, int] = {}

    def apart(eqn: Equation, args: Arrays, state: Arrays) -> tuple[list[Any], list[Any]]:
        found, index, wrong = _without_error(eqn, args)
        place = first.setdefault(id(eqn), len(messages))
        messages.extend(found if place == len(messages) else ())
        results = eval_jaxpr(_passing(eqn).jaxpr, _passing(eqn).consts, *args[1:])
        (failed,) = state
        code = jnp.where(wrong, jnp.asarray(index, jnp.int32) + (place + 1), 0)
        return results, [jnp.where(failed == 0, code, failed)]

    def fn(*args: Array) -> list[Any]:
        results, (failed,) = rewriting.run(closed.jaxpr, closed.consts, args, [jnp.int32(0)])
        return [*results, failed]

    rewriting = Rewriting(_is_check, apart, lambda state: state[0] != 0)
    return jax.make_jaxpr(fn)(*closed.in_avals), tuple(messages)


def _without_error(eqn: Equation, args: Arrays) -> tuple[list[str], Any, Any]:
    """The messages of a check, which of them it would give, and whether it fails."""
    (bad,) = (b for b in eqn.params["branches"] if _raising(b) is not None)
    raising = _raising(bad)
    messages = check_messages(raising)
    if messages is None:
        raise Unsupported("a check whose message is not known")
    before = bad.jaxpr.eqns[: bad.jaxpr.eqns.index(raising)]
    chooses = bad.jaxpr.replace(eqns=before, outvars=raising.invars)
    (index,) = eval_jaxpr(chooses, bad.consts, *args[1:])
    return messages, index, args[0] == eqn.params["branches"].index(bad)


def _is_check(eqn: Equation) -> bool:
    """Whether an equation chooses between going on and an error."""
    if eqn.primitive.name != "cond" or len(eqn.params["branches"]) != 2:
        return False
    return sum(_raising(b) is not None for b in eqn.params["branches"]) == 1


def _passing(eqn: Equation) -> ClosedJaxpr:
    """What a check does where nothing is wrong."""
    return next(b for b in eqn.params["branches"] if _raising(b) is None)


def _raising(branch: ClosedJaxpr) -> Any:
    """The equation that raises."""
    return next(filter(is_check, branch.jaxpr.eqns), None)
