"""What the equations are: the systems that a user writes down as plain JAX functions."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class ConstrainedSystem(eqx.Module):
    """A constrained mechanical system in redundant coordinates,

        q̇ = v,
        M v̇ = f(t, q, v) − Gᵀ λ − Hᵀ μ,        G = ∂g/∂q,  H = ∂h/∂v,
        0 = g(t, q),                            (holonomic, m equations)
        0 = h(t, q, v),                         (nonholonomic, p equations)

    a differential-algebraic system of index 3 (index 2 where there is no g).

    Functions take the user's `args` last. `q` and `v` are any pytree of arrays, of the same structure; they hold
    `n` numbers in all. Every function follows that structure; `constraint` and `nonholonomic` return a scalar or a
    vector.

    **Arguments**

    - `force(t, q, v, args)`: the applied forces, with the structure of `q`. Where M depends on q, the Coriolis and
      centrifugal terms belong here too.
    - `constraint(t, q, args)`: g. It may depend on time. `None` for a purely nonholonomic system.
    - `mass`: `None` (unit masses), a vector of `n` masses (also with the structure of `q`), an `(n, n)` symmetric
      positive definite matrix, or a function `(q, args) → (n, n)` matrix.
    - `nonholonomic(t, q, v, args)`: h, constraints at velocity level (rolling, knife edge).
    - `potential(q, args)`: the potential energy; used by `energy` alone.
    - `rank`: how many of the m + p constraints are independent, where some are redundant, or a pair, how many of the m
      and how many of all; a number takes the redundant ones to be holonomic. `daesolve` finds it at the initial state
      where that is concrete; say it here where the initial state is traced (`jit`, `vmap`).

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, eq. VII.1.46.
    """

    force: Callable[..., Any]
    constraint: Callable[..., Any] | None = None
    mass: Any = None
    nonholonomic: Callable[..., Any] | None = None
    potential: Callable[..., Any] | None = None
    rank: int | tuple[int, int] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        optional = ("constraint", "nonholonomic", "potential")
        _require_functions(self, "force", *(name for name in optional if getattr(self, name) is not None))
        if self.constraint is None and self.nonholonomic is None:
            raise TypeError(
                "A ConstrainedSystem needs a `constraint` or a `nonholonomic` constraint; "
                "without either it is an ODE, which `diffrax.diffeqsolve` solves."
            )
        counts = self.rank if isinstance(self.rank, tuple) else (self.rank,)
        if self.rank is not None and not (len(counts) < 3 and all(type(k) is int and k >= 0 for k in counts)):
            raise ValueError(
                "`rank` must be how many of the constraints are independent, an integer (or a pair, of the holonomic ones and "
                f"of all), or None for all of them, but is {self.rank!r}."
            )

    def mass_matrix(self, q: Any, args: Any = None) -> Float[Array, "n n"] | Float[Array, " n"] | None:
        """M at `q`: `None` for unit masses, a vector if diagonal, else a matrix."""
        mass = self.mass(q, args) if callable(self.mass) else self.mass
        if mass is None:
            return None
        if isinstance(mass, jax.Array | np.ndarray | float | int):
            return jnp.asarray(mass)
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(mass)])


class SemiExplicitDAE(eqx.Module):
    """A semi-explicit system,

        ẋ = f(t, x, z),
        0 = g(t, x, z),

    of index 1 where ∂g/∂z is regular, of a higher index otherwise. The state is the pair (x, z); both are any pytree of
    arrays.

    **Arguments**

    - `f(t, x, z, args)`: with the structure of x.
    - `g(t, x, z, args)`: any pytree with as many numbers as z.

    Source: U. M. Ascher, L. R. Petzold, *Computer Methods for Ordinary Differential Equations and
    Differential-Algebraic Equations*, eq. 9.2.
    """

    f: Callable[..., Any]
    g: Callable[..., Any]

    def __check_init__(self) -> None:
        _require_functions(self, "f", "g")


class ImplicitDAE(eqx.Module):
    """A fully implicit system, 0 = F(t, y, ẏ), of any index. The state y is any pytree of arrays.

    **Arguments**

    - `residual(t, y, yd, args)`: F, any pytree with as many numbers as y; `yd` is ẏ, with the structure of y.
    - `yd0`: ẏ at the start, or near it, with the structure of y: where F is nonlinear in ẏ, several may satisfy it.

    Source: K. E. Brenan, S. L. Campbell, L. R. Petzold, *Numerical Solution of Initial-Value Problems in
    Differential-Algebraic Equations*, eq. 1.1.1.
    """

    residual: Callable[..., Any]
    yd0: Any = None

    def __check_init__(self) -> None:
        _require_functions(self, "residual")


System = ConstrainedSystem | SemiExplicitDAE | ImplicitDAE


def _require_functions(system: eqx.Module, *names: str) -> None:
    for name in names:
        if not callable(getattr(system, name)):
            raise TypeError(f"`{name}` must be a function, but is {getattr(system, name)!r}.")
