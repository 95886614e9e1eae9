"""Functions without the checks that their caller has made already."""

from collections.abc import Callable
from typing import Any

import jax
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr
from jaxtyping import PyTree

from .._compat import is_check
from ..types import Equation
from .substitution import Substitution


# Not loops: who calls knows nothing of what is checked at a turn.
_ENTERED = frozenset({"jit", "pjit", "custom_jvp_call", "cond"})


def without_checks(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` without `equinox.error_if`: for conditions that the caller has looked at already."""

    def unchecked(*args: PyTree) -> Any:
        jaxpr, out = jax.make_jaxpr(fn, return_shape=True)(*args)
        found = checks_dropped(jaxpr)
        return jax.tree.unflatten(
            jax.tree.structure(out), eval_jaxpr(found.jaxpr, found.consts, *jax.tree.leaves(args))
        )

    return unchecked


def checks_dropped(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same for a function that is traced."""
    return Substitution(_without_error, lambda eqn: eqn.primitive.name in _ENTERED)(closed)


def _without_error(eqn: Equation) -> ClosedJaxpr | None:
    """What a choice between going on and an error does where it goes on."""
    if eqn.primitive.name != "cond":
        return None
    branches = eqn.params["branches"]
    checked = [any(map(is_check, b.jaxpr.eqns)) for b in branches]
    return branches[checked.index(False)] if any(checked) and not all(checked) else None
