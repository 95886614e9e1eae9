"""Implicit Runge–Kutta steps solved by Newton's method on all stages together."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ..linalg import newton
from ..types import Args, BoolLike, Flat, Time, Y
from .manifold import or_nan, outcome


class Tableau:
    """A Runge–Kutta tableau; rows of zeros in `a` are explicit stages at the start of the step."""

    def __init__(self, a: list[list[float]], b: list[float]) -> None:
        self.a, self.b = np.asarray(a), np.asarray(b)
        self.c = self.a.sum(1)
        self.implicit = np.flatnonzero(np.any(self.a != 0, axis=1))


class AbstractImplicitSolver(diffrax.AbstractSolver):
    """An implicit Runge–Kutta method with fixed steps: Yᵢ = y₀ + h Σ aᵢⱼ f(Yⱼ), y₁ = y₀ + h Σ bⱼ f(Yⱼ)."""

    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k
    recomputable: ClassVar[bool] = True

    @property
    def tableau(self) -> Tableau:
        """The method's coefficients."""
        raise NotImplementedError

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Y, args: Args) -> None:
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        args: Args,
        solver_state: None,
        made_jump: BoolLike,
    ) -> Any:
        flat, _ = ravel_pytree(y0)
        size = len(self.tableau.implicit) * flat.size

        def residual(z: Flat, params: PyTree) -> Any:
            terms, args, t0, t1, y0 = params
            return stage_residual(self.tableau, terms, args, t0, t1, y0, z)

        params = (terms, args, t0, t1, y0)
        z, found = newton(residual, predictor(self.tableau, *params)[:size], params)
        y1 = or_nan(found, stage_end(self.tableau, *params, z))
        return y1, None, hermite(terms, args, t0, t1, y0, y1), None, outcome(found)


def predictor(tableau: Tableau, terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time, y0: Y) -> Any:
    """zᵢ = Yᵢ − y₀ of the implicit stages by explicit Euler."""
    k0, _ = ravel_pytree(vector_field(terms, args, t0, t1)(t0, y0))
    return jnp.concatenate([float(tableau.c[i]) * k0 for i in tableau.implicit])


def vector_field(terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time) -> Callable[[Any, Any], Any]:
    """(t, y) ↦ h f(t, y)."""
    control = terms.contr(t0, t1)
    return lambda t, y: jax.tree.map(lambda x: jnp.asarray(control, x.dtype) * x, terms.vf(t, y, args))


def _stages(
    tableau: Tableau, terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time, y0: Y, z: Flat
) -> tuple[Any, list[Any]]:
    flat, unravel = ravel_pytree(y0)
    pieces = iter(jnp.split(z, len(tableau.implicit)))
    points = [flat + next(pieces) if i in tableau.implicit else flat for i in range(len(tableau.c))]
    vector = vector_field(terms, args, t0, t1)
    times = [t1 if c == 1 else t0 + float(c) * (t1 - t0) for c in tableau.c]
    return flat, [ravel_pytree(vector(t, unravel(y)))[0] for t, y in zip(times, points, strict=True)]


def stage_residual(
    tableau: Tableau, terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time, y0: Y, z: Flat
) -> Any:
    """zᵢ − h Σ aᵢⱼ f(Yⱼ)."""
    _, ks = _stages(tableau, terms, args, t0, t1, y0, z)
    sums = [sum(float(a) * k for a, k in zip(tableau.a[i], ks, strict=True)) for i in tableau.implicit]
    return z - jnp.concatenate(sums)


def stage_end(tableau: Tableau, terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time, y0: Y, z: Flat) -> Any:
    """y₁ from the stages."""
    flat, ks = _stages(tableau, terms, args, t0, t1, y0, z)
    _, unravel = ravel_pytree(y0)
    return unravel(flat + sum(float(b) * k for b, k in zip(tableau.b, ks, strict=True)))


def hermite(terms: diffrax.AbstractTerm, args: Args, t0: Time, t1: Time, y0: Y, y1: Y) -> Any:
    """What the cubic Hermite interpolant needs."""
    vector = vector_field(terms, args, t0, t1)
    k = jax.tree.map(lambda a, b: jnp.stack([a, b]), vector(t0, y0), vector(t1, y1))
    return {"y0": y0, "y1": y1, "k": k}
