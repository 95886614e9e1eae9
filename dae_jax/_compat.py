"""All of JAX, diffrax and equinox that the package leans on without being promised it; `compiler/_compat.py` has the compiler's.

The value of a `RESULTS` is read as `result._value` where it is needed: a number, or a tracer of one.
"""

from diffrax._root_finder import use_stepsize_tol as use_stepsize_tol
from diffrax._term import WrapTerm as WrapTerm
from equinox.internal import (
    nextafter as nextafter,
    nondifferentiable as nondifferentiable,
    prevbefore as prevbefore,
    unvmap_any as unvmap_any,
    while_loop as while_loop,
)


# Whose log has the traceback of an error that a callback raised, before JAX raises its own.
CALLBACK_LOG = "jax._src.callback"


def messages(enumeration: type) -> list[str]:
    """The messages of an equinox enumeration by number; what is written here is said."""
    return getattr(enumeration, "_index_to_message")  # noqa: B009


def lacks_reverse_derivatives(error: ValueError) -> bool:
    """Whether a function was differentiated in reverse that has forward derivatives only."""
    return str(error).startswith("Linearization failed")


def is_a_loop_without_reverse(error: ValueError) -> bool:
    """Whether a loop was differentiated in reverse whose number of turns is found on the way."""
    return str(error).startswith("Reverse-mode differentiation does not work")


def is_captured(error: TypeError) -> bool:
    """Whether a compiled function closes over a number that is being differentiated."""
    return str(error).startswith("No constant handler for type") and "Tracer" in str(error)
