"""What the solvers that keep their steps on the manifold have in common."""

import abc
from typing import Any, ClassVar, Protocol

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..equations.manifold_ode import Equations, ManifoldODE
from ..systems import System
from ..types import Args, State, Time, Y


class Formulation(Protocol):
    """What a solver asks of a formulation."""

    changes_field: ClassVar[bool]


class AbstractManifoldSolver(diffrax.AbstractSolver):
    """A solver whose steps end on the manifold H(t, y) = 0; needs a `ManifoldODE` as `args`.

    What a solver can do is asked of it, by these and by the fields `solver`, of one that wraps another, and `dense`, of
    one that can do without dense output:

    - `recomputable`: whether a step can be done once more from its start alone.
    - `locates_events`: whether diffrax can look for an event on its dense output.
    - `needs_independent`: whether constraints must be independent, so that of redundant ones it gets as many as are.
    - `counts`: which entries of its state at the end of a solve are counts for `stats`.
    """

    recomputable: ClassVar[bool] = True
    locates_events: ClassVar[bool] = True
    needs_independent: ClassVar[bool] = False
    counts: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def retract(self, t: Time, y: Y, ode: ManifoldODE) -> Any:
        """The point of the manifold that a point of the solver's dense output stands for."""

    def refuse(self, system: System, formulation: Formulation, t0: Time, y0: State, args: Args) -> None:
        """Refuses, by a `ValueError` with advice, what the method is not for."""

    def whole_path(self, path: diffrax.DenseInterpolation) -> diffrax.DenseInterpolation:
        """The dense output of a solve, also that of an interval of length 0."""
        return path

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Y, args: Equations) -> Any:
        return terms.vf(t0, y0, args)


def time_sign(terms: diffrax.AbstractTerm, t0: Time, t1: Time) -> Any:
    """±1: diffrax steps forwards in t·(±1); a constraint is to be evaluated at t itself."""
    return jnp.sign(terms.contr(t0, t1)) * jnp.sign(t1 - t0)


def or_nan(found: Bool[Array, ""], y: Y) -> Any:
    """`y`, or NaN where it was not found: an adaptive controller then tries a smaller step."""
    return jax.tree.map(lambda x: jnp.where(found, x, jnp.nan), y)


def outcome(found: Bool[Array, ""]) -> diffrax.RESULTS:
    """The code of a step whose nonlinear equations were solved or not."""
    # pyright knows no code that is inherited.
    failed: Any = diffrax.RESULTS.nonlinear_divergence
    return diffrax.RESULTS.where(found, diffrax.RESULTS.successful, failed)
