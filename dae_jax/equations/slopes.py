"""The derivatives of 0 = F(t, y, ẏ), and of its derivatives with respect to time, by y, ẏ and so on, entry by entry."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import csr_array

from ..compiler import Polynomial, polynomials
from ..structure import column_colouring, seed_matrix, shape_of
from ..types import DType, Flat, Scalar, Time
from .taylor import total_derivatives


# For each derivative and each equation, by order and variable.
Polynomials = list[list[dict[tuple[int, int], Polynomial]]]
Places = Int[np.ndarray, " entries"]

# The gradient of an equation of more variables is found by itself.
FULL = 100


class Slopes:
    """∂F/∂y^(k), of dF/dt and so on up to a `degree`, along as few directions as tell them apart.

    Equations of more than `FULL` variables would need as many directions; their gradients are found one by one.
    """

    def __init__(self, residual: Callable[..., Flat], pattern: csr_array, degree: int, dtype: DType) -> None:
        # A derivative of an equation has no variables but those of the equation.
        self.pattern = pattern
        many = np.diff(self.pattern.indptr) > FULL
        self.full = np.flatnonzero(many)
        self.colours = column_colouring(self.pattern[np.flatnonzero(~many)])
        self.residual, self.degree, self.dtype = residual, degree, dtype
        self.shape = (degree + 2, shape_of(pattern)[1])

    def _levels(self, t: Scalar, orders: Float[Array, "orders n"]) -> Float[Array, "levels n"]:
        return jnp.stack(total_derivatives(self.residual, t, list(orders), self.degree + 1))

    @property
    def directions(self) -> Float[np.ndarray, "directions orders n"]:
        """Each colour, of each order."""
        return np.kron(np.eye(self.shape[0]), seed_matrix(self.colours).T).reshape(-1, *self.shape)

    def along(
        self, t: Scalar, orders: Float[Array, "orders n"], directions: Float[Array, "directions orders n"]
    ) -> Float[Array, "directions levels n"]:
        """The directional derivatives at t and (y, ẏ, …)."""
        return jax.vmap(lambda v: jax.jvp(lambda orders: self._levels(t, orders), (orders,), (v,))[1])(directions)

    def at(self, t: Time, orders: Float[Array, "orders n"]) -> tuple[np.ndarray, np.ndarray]:
        """What `along` gives, and the gradients of full equations, as numbers: (levels, equations, orders, n)."""
        along = np.asarray(jax.jit(self.along)(t, orders, jnp.asarray(self.directions, self.dtype)))
        if not len(self.full):
            return along, np.zeros((self.degree + 1, 0, *self.shape))
        rows = lambda t, orders: self._levels(t, orders)[:, self.full]
        try:
            return along, np.asarray(jax.jit(jax.jacrev(rows, 1))(t, orders))
        except ValueError:  # a loop that has no reverse mode
            return along, np.asarray(jax.jit(jax.jacfwd(rows, 1))(t, orders))

    def entries(
        self, found: tuple[np.ndarray, np.ndarray], k: Places, i: Places, order: Places, j: Places
    ) -> Float[np.ndarray, " entries"]:
        """Of the k-th derivatives of equations i by the derivatives of variables j of an order, from what `at` gives."""
        along, gradients = found
        directions = along.reshape(self.shape[0], -1, *along.shape[1:])
        value = np.where(self.pattern[i, j], directions[order, self.colours[j], k, i], 0)
        full = np.isin(i, self.full)
        row = np.searchsorted(self.full, i[full])
        value[full] = gradients[k[full], row, order[full], j[full]]
        return value

    def by_entry(self, found: np.ndarray, k: int, i: int) -> dict[tuple[int, int], Any]:
        """Of the k-th derivative of equation i, by order and variable, from what `along` gives."""
        found = found.reshape(self.shape[0], -1, *found.shape[1:])
        places = self.pattern.indices[self.pattern.indptr[i] : self.pattern.indptr[i + 1]]
        return {(m, int(j)): found[m, self.colours[j], k, i] for m in range(self.shape[0]) for j in places}

    def as_polynomials(self) -> Polynomials | None:
        """For each derivative and each equation, by order and variable; `None` where they have no such form."""
        if len(self.full):
            return None
        along = lambda t, orders: self.along(t, orders, jnp.asarray(self.directions, self.dtype))
        found = polynomials(along, *(jax.ShapeDtypeStruct(shape, self.dtype) for shape in ((), self.shape)))
        if found is None:
            return None
        return [[self.by_entry(found, k, i) for i in range(self.shape[1])] for k in range(self.degree + 1)]
