"""State-space form in a global chart (Pöll, Hafner and Heinzl, sec. 2.6)."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..equations.constraint_jacobian import Rank, dense_mass
from ..equations.manifold_ode import at_one_instant
from ..equations.mechanical import MechanicalODE
from ..linalg import newton, roundoff, semidefinite_solve
from ..systems import ConstrainedSystem, System, is_mechanism
from ..types import Args, DType, IntScalar, Phase, State, Time
from ..validate.states import NUMBERS
from .interface import AbstractFieldFormulation


class StateSpace(AbstractFieldFormulation):
    """Coordinates z in which the constraints hold by construction, q = ψ(t, z), and the equations of motion in them,

        Jᵀ M J z̈ = Jᵀ (f − M c),   J = ∂ψ/∂z,   c = d(J ż + ψ_t)/dt at z̈ = 0,

    without multipliers (Maggi's equations).

    **Arguments**

    - `chart`: ψ, as `chart(z)` or `chart(t, z, args)`, from a vector of n − m numbers to q in the structure of q. It
      must satisfy the constraints for every z. Its inverse at the start is found by Newton's method, from several
      guesses; of several z that are the start, the one with the smallest entries is taken.
    - `guess`: z near the start, where the chart folds and the default guesses end on a wrong sheet.

    Errors: a chart of the wrong dimension or one that does not reach the initial state is refused.
    """

    inverts_mass: ClassVar[bool] = False
    leaves_constraints: ClassVar[bool] = False
    counts_constraints: ClassVar[bool] = True

    chart: Callable[..., Any]
    guess: Any = None

    def __check_init__(self) -> None:
        if not callable(self.chart):
            raise TypeError(f"`chart` of StateSpace must be a function from coordinates z to q, but is {self.chart!r}.")
        if self.guess is not None and not isinstance(self.guess, (*NUMBERS, list, tuple)):
            raise TypeError(f"`guess` of StateSpace must be a vector of coordinates, but is {self.guess!r}.")

    @property
    def keeps(self) -> tuple[bool, bool]:
        return True, True

    def refuse(self, system: System) -> None:
        if not is_mechanism(system):
            raise ValueError("StateSpace takes a ConstrainedSystem: its chart gives the positions of a mechanism.")

    def encode(
        self, system: ConstrainedSystem, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, "ChartODE"]:
        mechanical = MechanicalODE.of(system, t, state, args, rank)
        if mechanical.nonholonomic:
            raise ValueError(
                "StateSpace needs a system whose constraints are all holonomic: no coordinates satisfy a nonholonomic "
                "constraint by construction. Use OrthogonalProjection or TangentSpace."
            )
        constraints = mechanical.holonomic if mechanical.rank is None else mechanical.rank[0]
        ode = ChartODE(mechanical, self.chart, _takes_time(self.chart), mechanical.layout.size - constraints)
        return ode.encode(t, mechanical.encode(state), self.guess), ode

    def field(self, t: Time, y: Phase, ode: "ChartODE") -> Any:
        return ode.field(t, y)


def _takes_time(chart: Callable[..., State]) -> bool:
    required = [
        p
        for p in inspect.signature(chart).parameters.values()
        if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    if len(required) not in (1, 3):
        raise ValueError(f"`chart` must be chart(z) or chart(t, z, args), but takes {len(required)} arguments.")
    return len(required) == 3


class ChartODE(eqx.Module):
    """The equations of motion in a chart; y = (z, ż)."""

    mechanical: MechanicalODE
    chart: Callable[..., Any]
    takes_time: bool = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def position(self, t: Time, z: Float[Array, " d"]) -> Float[Array, " n"]:
        """ψ(t, z) as a flat vector."""
        q = self.chart(t, z, self.mechanical.args) if self.takes_time else self.chart(z)
        return self.mechanical.layout.flatten(q)

    def velocity(self, t: Time, z: Float[Array, " d"], w: Float[Array, " d"]) -> Float[Array, " n"]:
        """J w + ψ_t."""
        return self.mechanical._along(self.position, self.takes_time, t, (z,), (w,))[1]

    @at_one_instant
    def field(self, t: Time, y: Phase) -> Any:
        z, w = y
        ode = self.mechanical
        jacobian = jax.jacfwd(self.position, 1)(t, z)
        q, v = self.position(t, z), self.velocity(t, z, w)
        _, bias = ode._along(lambda t, z: self.velocity(t, z, w), self.takes_time, t, (z,), (w,))
        mass = dense_mass(ode.mass(q))
        if mass is None:
            apply: Callable[[Any], Any] = lambda x: x
        elif mass.ndim < 2:
            apply = lambda x: (mass * x.T).T
        else:
            apply = functools.partial(jnp.dot, mass)
        reduced = jnp.dot(jacobian.T, apply(jacobian))
        return w, semidefinite_solve(reduced, jnp.dot(jacobian.T, ode.force(t, q, v) - apply(bias)))

    def decode(self, t: Time, y: Phase) -> Any:
        z, w = y
        return self.mechanical.decode(t, (self.position(t, z), self.velocity(t, z, w)))

    def encode(self, t: Time, y: Phase, guess: State) -> Any:
        """(z, ż) of a flat (q, v), by Newton's method on Jᵀ(ψ(z) − q) = 0 from several guesses."""
        q, v = y
        guesses = _guesses(self.dimension, q.dtype) if guess is None else jnp.atleast_2d(jnp.asarray(guess, q.dtype))
        if guesses.shape[1] != self.dimension:
            raise ValueError(f"`guess` must have {self.dimension} entries, but has {guesses.shape[1]}.")
        shape = jax.eval_shape(lambda: self.position(t, guesses[0])).shape
        if shape != q.shape:
            raise ValueError(f"`chart` must return {q.shape[0]} numbers, as many as q has, but returns {shape[0]}.")

        def refine(z: Float[Array, " d"]) -> tuple[Float[Array, " d"], Float[Array, ""]]:
            def step(_: IntScalar, z: Float[Array, " d"]) -> Float[Array, " d"]:
                delta = _least_squares(self, t, z, self.position(t, z) - q)
                return z - delta * jnp.minimum(1, 1 / (jnp.max(jnp.abs(delta)) + 1e-30))

            z = jax.lax.fori_loop(0, 40, step, z)
            distance = jnp.sum((self.position(t, z) - q) ** 2)
            return z, jnp.where(jnp.isfinite(distance), distance, jnp.inf)

        zs, distances = jax.vmap(refine)(jax.lax.stop_gradient(guesses))
        # Of lengths that are small beside 1 no point is near all others.
        largest = jnp.max(jnp.abs(q))
        reached = jnp.sqrt(distances) <= jnp.finfo(q.dtype).eps ** 0.5 * largest + 10 * roundoff(q.dtype) * (
            1 + largest
        )
        # Of the points that are q, such as an angle and whole turns more, that nearest 0: the distances of all are rounding.
        best = jnp.argmin(jnp.where(reached, jnp.max(jnp.abs(zs), 1), jnp.inf))
        z, _ = newton(_normal_equations, jax.lax.stop_gradient(zs[best]), (self, t, q))
        z = jnp.where(reached[best], z, jnp.nan)
        return z, _least_squares(self, t, z, v - self.velocity(t, z, jnp.zeros_like(z)))


def _normal_equations(z: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
    ode, t, q = params
    return jnp.dot(jax.jacfwd(ode.position, 1)(t, z).T, ode.position(t, z) - q)


def _least_squares(ode: ChartODE, t: Time, z: Float[Array, " d"], x: Float[Array, " n"]) -> Float[Array, " d"]:
    jacobian = jax.jacfwd(ode.position, 1)(t, z)
    return semidefinite_solve(jnp.dot(jacobian.T, jacobian), jnp.dot(jacobian.T, x))


def _guesses(dimension: int, dtype: DType) -> Float[Array, "guesses d"]:
    # Fixed, spread over the range of an angle: a chart is usually made of angles. The second one is near 0 in any unit.
    rng = np.random.default_rng(0)
    near = np.full((2, dimension), [[0.1], [1e-15]])
    return jnp.asarray(np.concatenate([near, rng.uniform(-3, 3, (31, dimension))]), dtype)
