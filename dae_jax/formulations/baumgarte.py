"""Baumgarte's stabilisation (Pöll, Hafner and Heinzl, sec. 2.2)."""

import math
from collections.abc import Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Num

from ..equations.constraint_jacobian import Rank
from ..equations.manifold_ode import ManifoldODE
from ..equations.structural_ode import underlying_ode
from ..systems import System
from ..types import Args, BoolLike, State, Time, Y
from .interface import AbstractFieldFormulation


class Baumgarte(AbstractFieldFormulation):
    """The constraint and its derivative are fed back:

        g̈ + 2α ġ + β² g = 0    in place of   g̈ = 0,

    and ḣ + α h = 0 for nonholonomic constraints. Errors decay like exp(s t) with s² + 2αs + β² = 0: critically damped
    for α = β. Backwards in time they decay too: −α takes the place of α there. Large values are stiff for an explicit
    solver. An equation of another system that has to be differentiated c times gets the factor
    (d²/dt² + 2α d/dt + β²) c/2 times over, and (d/dt + α) for an odd c.

    **Arguments**

    - `alpha`, `beta`: α and β, in 1/s; arrays may be batched over and differentiated.

    Errors: `ValueError` for a negative α, with which errors grow; where α is traced, as in a batch, such a solve fails at its start
    (`RESULTS.undefined_formulation`).

    Source: J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972), 1–16.
    """

    alpha: Float[Array, "..."]
    beta: Float[Array, "..."]

    def __init__(self, alpha: Float[ArrayLike, ""], beta: Float[ArrayLike, ""]) -> None:
        for name, value in (("alpha", alpha), ("beta", beta)):
            if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int) or isinstance(value, bool):
                raise TypeError(f"`{name}` of Baumgarte must be a number in 1/s, but is {value!r}.")
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"`{name}` of Baumgarte must be finite, but is {value}.")
        if not isinstance(alpha, Tracer) and np.any(np.asarray(alpha) < 0):
            raise ValueError(
                f"`alpha` of Baumgarte must not be negative, but is {alpha}: s² + 2αs + β² has a root with a positive real "
                "part then, and an error of the constraint grows without bound."
            )
        # Arrays, so that another value is not another compilation.
        alpha = jnp.asarray(alpha, jnp.result_type(float, alpha))
        # What is traced can be refused by its solve alone.
        self.alpha = jnp.where(alpha < 0, jnp.nan, alpha) if isinstance(alpha, Tracer) else alpha
        self.beta = jnp.asarray(beta, jnp.result_type(float, beta))

    def refuse(self, system: System) -> None:
        if np.shape(self.alpha) or np.shape(self.beta):
            raise ValueError(
                f"`alpha` and `beta` of Baumgarte must be numbers, but have the shapes {np.shape(self.alpha)} and "
                f"{np.shape(self.beta)}: batch over them with `jax.vmap`."
            )

    def is_defined(self) -> BoolLike:
        return ~(jnp.isnan(self.alpha) | jnp.isnan(self.beta))

    def towards(self, sign: Num[ArrayLike, ""]) -> Self:
        """With −α backwards in time: d/dt is −d/dτ in the time τ that the solve passes."""
        return eqx.tree_at(lambda b: b.alpha, self, self.alpha * jnp.asarray(sign, self.alpha.dtype))

    def encode(
        self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, ManifoldODE]:
        return underlying_ode(system, t, state, args, rank)

    def field(self, t: Time, y: Y, ode: ManifoldODE) -> Any:
        return ode.field(t, y, self)

    def __call__(self, *levels: Float[Array, " m"]) -> Any:
        """What is added to the highest derivative of a constraint, given the constraint and its lower derivatives."""
        dtype = jnp.result_type(*levels)
        alpha, beta = self.alpha.astype(dtype), self.beta.astype(dtype)
        polynomial = [jnp.ones((), dtype)]
        for _ in range(len(levels) // 2):
            polynomial = _product(polynomial, [1.0, 2 * alpha, beta**2])
        if len(levels) % 2:
            polynomial = _product(polynomial, [1.0, alpha])
        return sum(c * level for c, level in zip(polynomial[:0:-1], levels, strict=True))


def _product(a: Sequence[Array | float], b: Sequence[Array | float]) -> list[Any]:
    """The coefficients of a product of polynomials; `jnp.convolve` is a library call, which no kernel can have in it."""
    return [sum(a[i] * b[k - i] for i in range(len(a)) if 0 <= k - i < len(b)) for k in range(len(a) + len(b) - 1)]
