"""What formulations and solvers see of a system: its underlying ODE and the manifold that this lives on.

Differentiating a DAE often enough gives an underlying ODE ẏ = field(t, y) and the invariants H(t, y) = 0, the constraints
and their hidden derivatives.
"""

import abc
import functools
from collections.abc import Callable, Hashable
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..compiler import scalarise, subroutine
from ..types import State, Time, TreeDef, Y


_T = TypeVar("_T")
# The constraints' linearisation at a point, in the form that its equations keep it in.
ConstraintJacobian: TypeAlias = Array | tuple[Any, ...]
# What is added to the highest derivative of a constraint, of the constraint and its lower derivatives.
Feedback: TypeAlias = Callable[..., Array]


def constant(tree: Any) -> Any:
    """A pytree whose arrays have no derivative."""
    # Of what is differentiated by as a number of Python's, JAX gives that number.
    return jax.tree.map(lambda x: jnp.asarray(lax.stop_gradient(x)) if eqx.is_array(x) else x, tree)


@runtime_checkable
class Equations(Protocol):
    """What the solver gets as diffrax's `args`: a system at one instant, which knows the user's structure."""

    def decode(self, t: Time, y: Y) -> State: ...


def at_one_instant(method: Callable[..., _T]) -> Callable[..., _T]:
    """Runs a method of an `eqx.Module` as scalar arithmetic where it is small, traced once for all its call sites."""
    return traced_once(method, scalarise)


def traced_once(method: Callable[..., _T], rewritten: Callable[..., Any] = lambda fn: fn) -> Callable[..., _T]:
    """The same, as arrays: for what is large in any case."""

    @functools.wraps(method)
    def wrapped(*args: PyTree) -> Any:
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, treedef = jax.tree.flatten(static)
        return _evaluate(method, rewritten, tuple(leaves), treedef, arrays)

    return wrapped


@functools.partial(subroutine, static_argnums=(0, 1, 2, 3))
def _evaluate(
    method: Callable[..., Any],
    rewritten: Callable[..., Any],
    leaves: tuple[Hashable, ...],
    treedef: TreeDef,
    arrays: PyTree,
) -> Any:
    static = jax.tree.unflatten(treedef, leaves)
    return rewritten(lambda arrays: method(*eqx.combine(arrays, static)))(arrays)


class ManifoldODE(eqx.Module):
    """An ODE ẏ = field(t, y) with invariants H(t, y) = 0: what a formulation makes of a DAE.

    It travels through `diffrax.diffeqsolve` as `args`, so that its arrays can be batched over and differentiated. `y` is
    a pytree of flat vectors.
    """

    @abc.abstractmethod
    def field(self, t: Time, y: Y, feedback: Feedback | None = None) -> Any:
        """The underlying ODE at (t, y). `feedback`, a function of H and its derivatives level by level, is added to the
        highest derivative of each constraint, which is 0 otherwise (see `Baumgarte`).
        """

    @abc.abstractmethod
    def invariants(self, t: Time, y: Y) -> tuple[Float[Array, " levels"], ...]:
        """H(t, y), level by level: the constraints, then their hidden derivatives."""

    @abc.abstractmethod
    def jacobian(self, t: Time, y: Y) -> Any:
        """Directions that span a complement of the manifold's tangent space at (t, y), and what is needed to use them."""

    def lasting_jacobian(self, t0: Time, y0: Y, t1: Time, ahead: Y) -> Any:
        """Those at (t₀, y₀), or such as stay transversal to the manifold in a step to near (t₁, `ahead`)."""
        return self.jacobian(t0, y0)

    @abc.abstractmethod
    def displace(self, y: Y, jacobian: ConstraintJacobian, mu: Float[Array, " c"]) -> Any:
        """y + N μ, with the directions N of `jacobian` and a flat vector μ."""

    @abc.abstractmethod
    def retract_along(self, t: Time, y: Y, jacobian: ConstraintJacobian) -> tuple[Any, Bool[Array, ""]]:
        """The point y + N μ on the manifold at time t, and whether it was found."""

    def project(self, t: Time, y: Y) -> tuple[Any, Bool[Array, ""]]:
        """The nearest point on the manifold at time t, with the Jacobian at y itself, and whether it was found."""
        return self.retract_along(t, y, self.jacobian(t, y))

    def measured_in(self, t: Time, y: Y, lengths: Y) -> "ManifoldODE":
        """The same where points are near to each other by these lengths along each number of y, the tolerances of unknowns that have
        units of their own; but for what has a metric, as that of masses.
        """
        return self

    @abc.abstractmethod
    def tangent(self, dy: Y, jacobian: ConstraintJacobian) -> Any:
        """The part of a derivative ẏ in the tangent space to which the rows of `jacobian` are normal."""

    @abc.abstractmethod
    def decode(self, t: Time, y: Y) -> Any:
        """The state in the user's structure."""
