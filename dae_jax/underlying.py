"""The underlying ODE of any system 0 = F(t, y, ẏ), from the offsets of its structural analysis."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .constraints import ManifoldODE, MechanicalODE, at_one_instant
from .linalg import fixed_point, implicit_root, relative_change, semidefinite_solve, solve, take
from .residual import ResidualForm
from .structure import StructurallySingular, dependence, sigma_method, signature
from .systems import ConstrainedSystem
from .taylor import total_derivatives


# Gauss–Newton's method for the derivatives of the initial state.
STARTING = 20


@dataclasses.dataclass(frozen=True)
class Orders:
    """How often each equation is differentiated, C, and each variable, D. Compared by value.

    The state of the underlying ODE holds, of each variable j, the derivatives of orders 0 to Dⱼ − 1.
    """

    equations: tuple[int, ...]
    variables: tuple[int, ...]

    @functools.cached_property
    def places(self) -> list[Int[np.ndarray, " n"]]:
        """For each order k, where y^(k) of each variable is in (Y, X), X the derivatives of order Dⱼ; −1 beyond."""
        d = np.array(self.variables)
        found, start = [], 0
        for k in range(d.max() + 1):
            inside = d > k
            found.append(
                np.where(inside, start + np.cumsum(inside) - 1, np.where(d == k, self.size + np.arange(len(d)), -1))
            )
            start += int(inside.sum())
        return found

    @functools.cached_property
    def derivatives(self) -> Int[np.ndarray, " N"]:
        """Where in (Y, X) the derivative of each entry of Y is."""
        d = np.array(self.variables)
        return np.concatenate([self.places[k + 1][d > k] for k in range(d.max())])

    @functools.cached_property
    def values(self) -> Int[np.ndarray, " N"]:
        """Which variable each entry of Y is the value of, −1 for derivatives."""
        first = np.flatnonzero(np.array(self.variables) > 0)
        return np.concatenate([first, np.full(self.size - len(first), -1)])

    @property
    def size(self) -> int:
        """The number of entries of Y."""
        return sum(self.variables)

    def rows(self, level: int) -> Int[np.ndarray, " rows"]:
        """The equations whose derivative of order `level` is an invariant."""
        return np.flatnonzero(np.array(self.equations) > level)

    def names(self, form: ResidualForm) -> tuple[str, ...]:
        """A name for each invariant, in the order of `StructuralODE.invariants`."""
        marks = ("", "d/dt ", *(f"d^{k}/dt^{k} " for k in range(2, 10)))
        return tuple(marks[k] + form.equations[i] for k in range(max(self.equations)) for i in self.rows(k))


class StructuralODE(ManifoldODE):
    """From the offsets c of the equations and d of the variables (Pryce's Σ-method): the equations Fᵢ^(Cᵢ) = 0 are linear
    in the derivatives X of order Dⱼ and give these, the state Y holds the lower ones, and

        H = (Fᵢ^(k), k < Cᵢ) = 0

    are the invariants: the constraints and the hidden ones. C = c and D = d where Fᵢ^(cᵢ) is linear in X; else, and where
    a derivative of order 0 would have to be found from a nonlinear equation, each is differentiated once more.

    Source: J. D. Pryce, BIT 41 (2001), 364–394.
    """

    form: ResidualForm
    orders: Orders = eqx.field(static=True)

    @classmethod
    def of(cls, form: ResidualForm, dtype: Any, complete: bool = False) -> "StructuralODE":
        """Finds the offsets while tracing. `complete`: once more than needed, so that all variables are in the state and
        all that restricts them is among the invariants.

        Errors: `ValueError` for a structurally singular system.
        """
        y = jax.ShapeDtypeStruct((form.size,), dtype)
        time = jax.ShapeDtypeStruct((), y.dtype)
        _, on_y, on_rate = dependence(form.residual, time, y, y, derivative=True)
        try:
            found = sigma_method(signature(on_y, on_rate))
        except StructurallySingular as singular:
            names = ", ".join(form.equations[i] for i in singular.equations)
            raise ValueError(
                f"The system is structurally singular: the equations {names} have too few variables between them. "
                "`dae_jax.analyse(system, t0, y0, args)` names all."
            ) from None
        ode = cls(form, Orders(found.equation_offsets, found.variable_offsets))
        if max(found.variable_offsets) > 0 and not complete and ode._linear(y):
            return ode
        return cls(
            form, Orders(*(tuple(k + 1 for k in offsets) for offsets in (ode.orders.equations, ode.orders.variables)))
        )

    def _linear(self, y: Any) -> bool:
        """Whether the highest derivatives enter linearly: whether their coefficients do not depend on them."""
        state = jax.ShapeDtypeStruct((self.orders.size,), y.dtype)
        time = jax.ShapeDtypeStruct((), y.dtype)
        coefficients = lambda t, s, x: jax.jacfwd(lambda x: self._highest(t, s, x))(x)
        return not dependence(coefficients, time, state, y, derivative=True)[2].any()

    # The equations and their derivatives

    def _levels(self, t: Any, y: Float[Array, " N"], x: Float[Array, " n"], count: int) -> list[Float[Array, " n"]]:
        """F, dF/dt, … at (Y, X): `count` of them, each right in the equations of which only Y and X are needed."""
        both = jnp.concatenate([y, x])
        orders = [take(both, place) for place in self.orders.places]
        return total_derivatives(self.form.residual, jnp.asarray(t, y.dtype), orders, count)

    def _highest(self, t: Any, y: Any, x: Any) -> Float[Array, " n"]:
        """Fᵢ^(Cᵢ)."""
        levels = self._levels(t, y, x, max(self.orders.equations) + 1)
        return jnp.stack([levels[k][i] for i, k in enumerate(self.orders.equations)])

    @at_one_instant
    def _system(self, t: Any, y: Any, feedback: Any) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
        """The matrix and the right-hand side of the equations for X."""
        zero = jnp.zeros(self.form.size, y.dtype)
        right = -self._highest(t, y, zero)
        if feedback is not None:
            levels = self._levels(t, y, zero, max(self.orders.equations, default=0))
            terms = [
                feedback(*(levels[k][i] for k in range(c))) if c else 0 for i, c in enumerate(self.orders.equations)
            ]
            right = right - jnp.stack([jnp.asarray(term, y.dtype) for term in terms])
        return jax.jacfwd(lambda x: self._highest(t, y, x))(zero), right

    def highest(self, t: Any, y: Float[Array, " N"], feedback: Any = None) -> Float[Array, " n"]:
        """X, the derivatives of order Dⱼ."""
        return solve(*self._system(t, y, feedback))

    # The underlying ODE and the manifold

    def field(self, t: Any, y: Any, feedback: Any = None) -> Any:
        both = jnp.concatenate([y, self.highest(t, y, feedback)])
        return take(both, self.orders.derivatives)

    @at_one_instant
    def invariants(self, t: Any, y: Any) -> tuple[Float[Array, " levels"], ...]:
        highest = max(self.orders.equations)
        if not highest:
            return (jnp.zeros(0, y.dtype),)
        levels = self._levels(t, y, jnp.zeros(self.form.size, y.dtype), highest)
        return tuple(take(level, self.orders.rows(k)) for k, level in enumerate(levels))

    def violations(self, t: Any, y: Any) -> Float[Array, " m"]:
        """H(t, Y), all levels."""
        return jnp.concatenate(self.invariants(t, y))

    @at_one_instant
    def normals(self, t: Any, y: Any) -> Float[Array, "m N"]:
        """∂H/∂Y, whose rows are normal to the manifold in the metric in which all entries of Y count alike."""
        return jax.jacfwd(self.violations, 1)(t, y)

    def tangent(self, dy: Any, normals: Float[Array, "m N"]) -> Any:
        if not len(normals):
            return dy
        gram = jnp.sum(normals[:, None] * normals, -1)
        return dy - self.shift(0, normals, semidefinite_solve(gram, jnp.sum(normals * dy, 1)))

    def shift(self, y: Any, normals: Any, mu: Float[Array, " m"]) -> Any:
        return y + jnp.sum(normals * mu[:, None], 0)

    def restore(self, t: Any, y: Any, normals: Any) -> tuple[Any, Bool[Array, ""]]:
        if not len(normals):
            return y, jnp.asarray(True)

        def iterate(params: Any) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
            ode, t, y, normals = params

            def correct(mu: Any) -> tuple[Any, Any]:
                here = ode.shift(y, normals, mu)
                matrix = jnp.sum(ode.normals(t, here)[:, None] * normals, -1)
                delta = solve(matrix, ode.violations(t, here))
                return mu - delta, relative_change(ode.shift(0, normals, delta), here)

            return fixed_point(correct, correct(jnp.zeros(len(normals), y.dtype)))

        residual = lambda mu, params: params[0].violations(params[1], params[0].shift(params[2], params[3], mu))
        mu, found = implicit_root(residual, iterate, (self, t, y, normals))
        return self.shift(y, normals, mu), found

    # The user's state

    def decode(self, t: Any, y: Any) -> Any:
        if 0 not in self.orders.variables:
            return self.form.decode(t, take(y, self.orders.places[0]))
        return self.form.decode(t, take(jnp.concatenate([y, self.highest(t, y)]), self.orders.places[0]))

    def encode(self, t: Any, state: Any) -> Float[Array, " N"]:
        """Y of a state: the derivatives of order 1 and higher are those with which the equations hold, or nearly hold."""
        return self.start(t, self.form.encode(state), jnp.zeros(self.form.size))

    def start(self, t: Any, values: Float[Array, " n"], freedom: Float[Array, " n"]) -> Float[Array, " N"]:
        """Y near the values of the variables, each of which may move as much as its `freedom` says (0: not at all; 1: no
        more than the others), with the least H. Gauss–Newton's method, the derivatives from 0.
        """
        index = self.orders.values
        weights = take(freedom.astype(values.dtype), index) + np.where(index < 0, FREE, 0)
        return _nearest(self, t, take(values, index), weights)


# How much more the derivatives may move than the values: these are what is given.
FREE = 1e3


def _nearest(ode: StructuralODE, t: Any, known: Any, weights: Any) -> Any:
    if not any(ode.orders.equations):
        return known

    def improved(y: Any, params: Any) -> Any:
        ode, t, known, weights = params
        a, h = ode.normals(t, y), ode.violations(t, y)
        largest = jnp.max(jnp.abs(a * weights), 1)
        scale = 1 / jnp.where(largest > 0, largest, 1)
        a, off = a * scale[:, None], scale * (h + jnp.sum(a * (known - y), 1))
        gram = jnp.sum((a * weights)[:, None] * (a * weights), -1)
        # What the free entries cannot mend stays as it is, in place of growing without bound.
        cut = 100 * jnp.finfo(y.dtype).eps * jnp.maximum(jnp.trace(gram), 1)
        return known - weights**2 * jnp.sum(a * solve(gram + cut * jnp.eye(len(h), dtype=y.dtype), off)[:, None], 0)

    def iterate(params: Any) -> Any:
        def correct(y: Any) -> Any:
            new = improved(y, params)
            return new, relative_change(new - y, y)

        return fixed_point(correct, correct(params[2]), STARTING)

    return implicit_root(lambda y, p: y - improved(y, p), iterate, (ode, t, known, weights))[0]


def underlying_ode(system: Any, t: Any, state: Any, args: Any, rank: int | None = None) -> tuple[Any, ManifoldODE]:
    """The state and the underlying ODE of any system; a mechanism's is found faster than from the offsets."""
    if isinstance(system, ConstrainedSystem):
        mechanical = MechanicalODE.of(system, t, state, args, rank)
        return mechanical.encode(state), mechanical
    ode = StructuralODE.of(ResidualForm.of(system, t, state, args), jnp.result_type(*jax.tree.leaves(state)))
    return ode.encode(t, state), ode
