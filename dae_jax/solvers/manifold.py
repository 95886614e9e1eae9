"""What the solvers that keep their steps on the manifold have in common."""

import abc
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


class AbstractManifoldSolver(diffrax.AbstractSolver):
    """A solver whose steps end on the manifold H(t, y) = 0; needs a `ManifoldODE` as `args`."""

    @abc.abstractmethod
    def land(self, t: Any, y: Any, ode: Any) -> Any:
        """The point of the manifold that a point of the solver's dense output stands for."""

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)


def clock(terms: Any, t0: Any, t1: Any) -> Any:
    """±1: diffrax steps forwards in t·(±1); a constraint is to be evaluated at t itself."""
    return jnp.sign(terms.contr(t0, t1)) * jnp.sign(t1 - t0)


def or_nan(found: Bool[Array, ""], y: Any) -> Any:
    """`y`, or NaN where it was not found: an adaptive controller then tries a smaller step."""
    return jax.tree.map(lambda x: jnp.where(found, x, jnp.nan), y)


def outcome(found: Bool[Array, ""]) -> diffrax.RESULTS:
    """The code of a step whose nonlinear equations were solved or not."""
    return diffrax.RESULTS.where(found, diffrax.RESULTS.successful, diffrax.RESULTS.nonlinear_divergence)
