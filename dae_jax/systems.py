"""What the equations are: the systems that a user writes down as plain JAX functions."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from typing_extensions import TypeIs

from .types import Args, State, Time


class Call(NamedTuple):
    """A function of the user as it is to be called, `force(t, q, v, args)`, with these values; it `returns` what has the
    structure of `like`, as many numbers as that, or a vector of any length. `of` is what `like` is called.
    """

    signature: str
    function: Callable[..., Any]
    values: tuple[Any, ...]
    returns: Literal["structure", "count", "vector"]
    like: Any = None
    of: str = ""


class AbstractSystem(eqx.Module):
    """A system of equations. `parts` are the names of the parts of its state; where there is one the state is that, else the
    tuple of them, which `pair` describes.
    """

    parts: eqx.AbstractClassVar[tuple[str, ...]]
    pair: ClassVar[str] = ""

    @abc.abstractmethod
    def calls(self, t: Time, state: State, args: Args) -> list[Call]:
        """How the user's functions are called."""


class ConstrainedSystem(AbstractSystem):
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
      positive definite matrix, `(b, k, k)` for b blocks on the diagonal of a matrix (n = b k), or a function `(q, args)` that
      returns any of these.
    - `nonholonomic(t, q, v, args)`: h, constraints at velocity level (rolling, knife edge).
    - `potential(q, args)`: the potential energy; used by `energy` alone.
    - `rank`: how many of the m + p constraints are independent, where some are redundant, or a pair, how many of the m
      and how many of all; a number takes the redundant ones to be holonomic. `daesolve` finds it at the initial state
      where that is concrete; say it here where the initial state is traced (`jit`, `vmap`).

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, eq. VII.1.46.
    """

    parts: ClassVar[tuple[str, ...]] = ("q", "v")
    pair: ClassVar[str] = "(q, v) of positions and velocities"

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

    def calls(self, t: Time, state: State, args: Args) -> list[Call]:
        q, v = state
        found = [Call("force(t, q, v, args)", self.force, (t, q, v, args), "structure", q, "q")]
        if self.constraint is not None:
            found.append(Call("constraint(t, q, args)", self.constraint, (t, q, args), "vector"))
        if self.nonholonomic is not None:
            found.append(Call("nonholonomic(t, q, v, args)", self.nonholonomic, (t, q, v, args), "vector"))
        return found

    def mass_matrix(self, q: State, args: Args = None) -> Float[Array, "..."] | None:
        """M at `q`: `None` for unit masses, a vector if diagonal, else a matrix, or (b, k, k) if block-diagonal."""
        mass = self.mass(q, args) if callable(self.mass) else self.mass
        if mass is None:
            return None
        if isinstance(mass, jax.Array | np.ndarray | float | int):
            mass = jnp.asarray(mass)
            # Where q is one array of several axes, masses in its shape are no matrix.
            return jnp.ravel(mass) if mass.ndim > 1 and mass.shape == getattr(q, "shape", None) else mass
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(mass)])


class SemiExplicitDAE(AbstractSystem):
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

    parts: ClassVar[tuple[str, ...]] = ("x", "z")
    pair: ClassVar[str] = "(x, z) of a SemiExplicitDAE"

    f: Callable[..., Any]
    g: Callable[..., Any]

    def __check_init__(self) -> None:
        _require_functions(self, "f", "g")

    def calls(self, t: Time, state: State, args: Args) -> list[Call]:
        x, z = state
        return [
            Call("f(t, x, z, args)", self.f, (t, x, z, args), "structure", x, "x"),
            Call("g(t, x, z, args)", self.g, (t, x, z, args), "count", z, "z"),
        ]


class ImplicitDAE(AbstractSystem):
    """A fully implicit system, 0 = F(t, y, ẏ), of any index. The state y is any pytree of arrays.

    **Arguments**

    - `residual(t, y, yd, args)`: F, any pytree with as many numbers as y; `yd` is ẏ, with the structure of y.
    - `yd0`: ẏ at the start, or near it, with the structure of y: where F is nonlinear in ẏ, several may satisfy it.

    Source: K. E. Brenan, S. L. Campbell, L. R. Petzold, *Numerical Solution of Initial-Value Problems in
    Differential-Algebraic Equations*, eq. 1.1.1.
    """

    parts: ClassVar[tuple[str, ...]] = ("y",)

    residual: Callable[..., Any]
    yd0: Any = None

    def __check_init__(self) -> None:
        _require_functions(self, "residual")

    def calls(self, t: Time, state: State, args: Args) -> list[Call]:
        rates = jax.tree.map(lambda x: np.zeros(jnp.shape(x), jnp.result_type(x)), state)
        return [Call("residual(t, y, yd, args)", self.residual, (t, state, rates, args), "count", state, "y")]


System = ConstrainedSystem | SemiExplicitDAE | ImplicitDAE


def is_mechanism(system: System) -> TypeIs[ConstrainedSystem]:
    """Whether a system has masses, forces and constraints, from which its underlying ODE is found fastest."""
    return isinstance(system, ConstrainedSystem)


def is_implicit(system: System) -> TypeIs[ImplicitDAE]:
    """Whether ẏ may occur in the equations in any way."""
    return isinstance(system, ImplicitDAE)


def _require_functions(system: eqx.Module, *names: str) -> None:
    for name in names:
        if not callable(getattr(system, name)):
            raise TypeError(f"`{name}` must be a function, but is {getattr(system, name)!r}.")
