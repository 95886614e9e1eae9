"""A derivative that is no number is an error where the solution is one."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..compiler import inexact
from .failures import refused_where


UNKNOWN = (
    "A derivative of a solve is not known (NaN): a reset has led to equations whose index is higher by two or more than their structure "
    "has it, or that are singular there, so that they do not determine all rates; or what is made of the solution has no derivative. Write "
    "a small and a large resistance in place of an ideal switch. With `throw=False` the derivative is NaN instead."
)


def refused_if_unknown(tree: PyTree, given: bool) -> Any:
    """The numbers of a `tree`, of which the derivatives in forward mode are refused where they are NaN, or those in reverse mode where
    they are what is `given` to a solve.
    """
    numbers, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(_checked(given, numbers), others) if inexact(numbers) else tree


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _checked(given: bool, numbers: PyTree[Array]) -> PyTree[Array]:  # noqa: ARG001
    return numbers


@_checked.defjvp
def _(given: bool, primals: tuple[PyTree[Array]], tangents: tuple[PyTree[Array]]) -> tuple[PyTree, PyTree]:
    finite, _ = ravel_pytree(jax.tree.map(jnp.isfinite, primals[0]))
    as_it_is = lambda change: change

    def known(change: Float[Array, " n"]) -> Array:
        return refused_where(jnp.any(jnp.isnan(change) & finite), UNKNOWN, change)

    return primals[0], with_transpose(tangents[0], *((as_it_is, known) if given else (known, as_it_is)))


def with_transpose(
    changes: PyTree[Array], forward: Callable[[Array], Array], backward: Callable[[Array], Array]
) -> Any:
    """`forward` of all numbers of a tree as one vector, which is linear, with `backward` as its transpose, in batches and derivatives of
    any order.
    """
    # As one array, as in reverse mode all of a linear system's right-hand sides must have a cotangent; as the identity's linear system,
    # which is the one way to give both.
    flat, as_before = ravel_pytree(changes)
    return as_before(lax.custom_linear_solve(lambda x: x, flat, lambda _, x: forward(x), lambda _, x: backward(x)))
