"""What a formulation is: which equations of a system are integrated, and by which kind of solver."""

import abc
from typing import Any, ClassVar, Self

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike, Num

from ..equations.constraint_jacobian import Rank
from ..equations.linearised import LinearisedResidual
from ..equations.manifold_ode import Equations
from ..systems import System
from ..types import Args, BoolLike, Flat, State, Time, Y


class AbstractFormulation(eqx.Module):
    """Which equations of a system are integrated.

    For those who call `diffrax.diffeqsolve` themselves:

        y0, ode = formulation.encode(system, t0, state, args)
        formulation = formulation.towards(jnp.sign(t1 - t0))
        sol = diffrax.diffeqsolve(formulation.term(), solver, t0, t1, dt0, y0, args=ode)
        state = formulation.decode(t, y, ode)

    - `inverts_mass`: whether M⁻¹ is needed, so that no coordinate can be massless.
    - `keeps`: whether g and (ġ, h) hold whatever the solver does.
    - `leaves_constraints`: whether there are constraints left that a solver can keep.
    - `selects_states`: whether entries of the state are selected that alone are integrated.
    - `changes_field`: whether the field is another than that of the underlying ODE.
    - `counts_constraints`: whether the size of the state depends on how many constraints are independent.
    - `needs_independent`: whether constraints must be independent, so that of redundant ones it gets as many as are.
    """

    inverts_mass: ClassVar[bool] = True
    leaves_constraints: ClassVar[bool] = True
    selects_states: ClassVar[bool] = False
    changes_field: ClassVar[bool] = True
    counts_constraints: ClassVar[bool] = False
    needs_independent: ClassVar[bool] = False

    def named(self, system: System) -> str:
        """What the user calls it, for this system."""
        return type(self).__name__

    @property
    def keeps(self) -> tuple[bool, bool]:
        return False, False

    def refuse(self, system: System) -> None:
        """Refuses, by a `ValueError` with advice, what the formulation is not for."""

    def is_defined(self) -> BoolLike:
        """Whether its parameters, which may be traced, are such as it takes."""
        return True

    def towards(self, sign: Num[ArrayLike, ""]) -> Self:
        """The formulation for a solve in which time runs forwards, `sign` 1, or backwards, −1."""
        return self

    @abc.abstractmethod
    def encode(
        self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, Any]:
        """The integration variables of `state`, and the equations at one instant, which the solver gets as `args`."""

    @abc.abstractmethod
    def term(self) -> diffrax.AbstractTerm:
        """What diffrax gets."""

    def decode(self, t: Time, y: Y, ode: Equations) -> Any:
        """The state in the user's structure."""
        return ode.decode(t, y)


class AbstractFieldFormulation(AbstractFormulation):
    """A formulation as an ODE ẏ = field(t, y), for solvers of ODEs."""

    @abc.abstractmethod
    def field(self, t: Time, y: Y, ode: Equations) -> Any:
        """ẏ at (t, y)."""

    def term(self) -> diffrax.ODETerm:
        return diffrax.ODETerm(self.field)


class ResidualTerm(diffrax.AbstractTerm):
    """0 = F(t, y, ẏ) where diffrax wants a vector field: what it gets is F(t, y, 0). For solvers of residuals only."""

    def vf(self, t: Time, y: Flat, args: LinearisedResidual) -> Any:
        return args.residual(t, y, jnp.zeros_like(y))

    def contr(self, t0: Time, t1: Time, **kwargs: object) -> Any:
        return t1 - t0

    def prod(self, vf: Flat, control: Time) -> Any:
        return vf * control


class AbstractResidualFormulation(AbstractFormulation):
    """A formulation as a residual 0 = F(t, y, ẏ), for solvers of residuals."""

    def term(self) -> ResidualTerm:
        return ResidualTerm()
