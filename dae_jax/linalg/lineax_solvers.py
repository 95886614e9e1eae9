"""The small dense solves as `lineax` linear solvers, for optimistix, diffrax's implicit methods and one's own code."""

import abc
from typing import Any

import equinox as eqx
import jax
import lineax
import numpy as np
from jaxtyping import Array, Float

from ..structure.layout import Layout
from .dense import solve
from .semidefinite import semidefinite_solve


class _Matrix(eqx.Module):
    entries: Float[Array, "n n"]
    rows: Layout = eqx.field(static=True)
    columns: Layout = eqx.field(static=True)


class _AbstractSmallSolver(lineax.AbstractLinearSolver):
    @abc.abstractmethod
    def solve(self, a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """x with A x = b."""

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> _Matrix:
        if operator.in_size() != operator.out_size():
            raise ValueError(
                f"{type(self).__name__} solves square systems, but got {operator.out_size()} equations for "
                f"{operator.in_size()} unknowns."
            )
        rows, columns = (
            Layout.of(jax.tree.map(lambda s: np.zeros(s.shape), s))
            for s in (operator.out_structure(), operator.in_structure())
        )
        return _Matrix(operator.as_matrix(), rows, columns)

    def compute(
        self, state: _Matrix, vector: Array, options: dict[str, Any]
    ) -> tuple[Any, lineax.RESULTS, dict[str, Any]]:
        x = self.solve(state.entries, state.rows.flatten(vector))
        return state.columns.unflatten(x), lineax.RESULTS.successful, {}

    def transpose(self, state: _Matrix, options: dict[str, Any]) -> tuple[_Matrix, dict[str, Any]]:
        return _Matrix(state.entries.T, state.columns, state.rows), {}

    def conj(self, state: _Matrix, options: dict[str, Any]) -> tuple[_Matrix, dict[str, Any]]:
        return _Matrix(state.entries.conj(), state.rows, state.columns), options

    def assume_full_rank(self) -> bool:
        return True


class SmallLU(_AbstractSmallSolver):
    """`linalg.solve` for `lineax.linear_solve`: elimination with pivoting in plain arithmetic up to 32 unknowns, LAPACK
    above. Unlike `lineax.LU` it can be part of a kernel.
    """

    def solve(self, a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        return solve(a, b)


class SmallCholesky(_AbstractSmallSolver):
    """`linalg.semidefinite_solve` for `lineax.linear_solve`, for symmetric positive definite operators; NaN where it is
    not definite.
    """

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> _Matrix:
        if not lineax.is_positive_semidefinite(operator):
            raise ValueError(
                "SmallCholesky needs a positive definite operator; tag it with `lineax.positive_semidefinite_tag`, or "
                "use SmallLU."
            )
        return super().init(operator, options)

    def solve(self, a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        return semidefinite_solve(a, b)
