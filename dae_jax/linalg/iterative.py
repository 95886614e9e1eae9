"""Matrices that are too large to factorise: solved by GMRES, with factors that are incomplete or a preconditioner of the user's."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Inexact, Int, PyTree

from .gmres import gmres
from .pivoted_lu import PivotedLU
from .storage import magnitude, scaling


# The part of the right-hand side that is left where `rtol` does not say it, as a power of the resolution of numbers: with less care an
# implicit derivative would have fewer digits than the solution.
LEFT = 0.65


@dataclasses.dataclass(frozen=True)
class GMRES:
    """Linear equations by the generalised minimal residual method, for `linear_solver=` of the solvers of residuals: for systems whose
    factors would be too many, as those of equations in three dimensions.

        x with |A x − b| ≤ rtol |b|,   A = ∂F/∂y + c ∂F/∂ẏ, c ~ 1/h,   in the norm in which the largest entry of each row is 1.

    **Arguments**

    - `preconditioner`: a function of A, a `jax.experimental.sparse.BCOO` matrix of the equations and unknowns in their order, real or,
      for Radau methods, complex; what it returns takes a vector b and gives about A⁻¹ b, linearly. It is a pytree whose arrays are
      computed with each new matrix and kept while that is: a `jax.tree_util.Partial` of a function and arrays, or an
      `equinox.Module`. By default incomplete factors by SuperLU with partial pivoting (ILUTP) on the host, which are right for most
      sparse systems; reverse derivatives of Radau methods, whose stages are coupled there, take these in any case.
    - `rtol`: by default about 1e-10 in float64, 1e-5 in float32.
    - `restart`: how many vectors are kept, each as long as y.
    - `most`: products with A after which a step fails; a smaller one has a matrix that is easier.
    - `drop`: entries of the incomplete factors that are less than this part of their column are left out.

    In `stats` of a solution, `num_factorisations` counts the preconditioners. Reverse derivatives solve with Aᵀ, by the transpose of
    the preconditioner, which JAX derives.

    Errors: `ValueError` for a number that makes no sense, and where the preconditioner is no such function.

    Source: Y. Saad, *Iterative Methods for Sparse Linear Systems*, 2nd ed., chapters 6, 9 and 10; X. S. Li, M. Shao, A supernodal
    approach to incomplete LU factorization with partial pivoting, ACM Trans. Math. Softw. 37 (2011).
    """

    preconditioner: Callable[[Any], Callable[[Array], Array]] | None = None
    rtol: float | None = None
    restart: int = 30
    most: int = 300
    drop: float = 1e-3

    def __post_init__(self) -> None:
        if self.preconditioner is not None and not callable(self.preconditioner):
            raise ValueError(f"`preconditioner` must be a function of the matrix, but is {self.preconditioner!r}.")
        for name in ("restart", "most"):
            number = getattr(self, name)
            if type(number) is not int or number < 1:
                raise ValueError(f"`{name}` must be a whole number of at least 1, but is {number!r}.")
        for name in ("rtol", "drop"):
            number = getattr(self, name)
            if number is not None and not (isinstance(number, int | float) and 0 < number < np.inf):
                raise ValueError(f"`{name}` must be a positive number, but is {number!r}.")


@dataclasses.dataclass(frozen=True, eq=False)
class Iterative:
    """The entries that another storage, `inner`, keeps, with products in place of factors. Compared by identity.

    To factorise is to find the preconditioner.
    """

    inner: Any
    method: GMRES

    dear: ClassVar[bool] = True
    graded: ClassVar[bool] = False

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.inner.size

    def describe(self) -> str:
        """In words."""
        by = "incomplete factors" if self.method.preconditioner is None else "the preconditioner that is given"
        return f"GMRES with {by}, {self.size:,} unknowns, {len(self._at[0]):,} entries"

    def positions(self) -> Any:
        """Row and column of each entry."""
        return self.inner.positions()

    @functools.cached_property
    def _at(self) -> tuple[Int[np.ndarray, " used"], Int[np.ndarray, " used"], Int[np.ndarray, " used"]]:
        """Rows and columns of the entries inside the matrix, and where they are kept."""
        rows, columns = (np.asarray(x).reshape(-1) for x in self.positions())
        inside = np.flatnonzero(columns >= 0)
        return rows[inside], columns[inside], inside

    @functools.cached_property
    def _incomplete(self) -> PivotedLU:
        rows, columns, _ = self._at
        return PivotedLU(rows, columns, self.size, self.method.drop)

    def factor(self, a: Inexact[Array, "*stored"]) -> Any:
        """The entries with rows scaled, the scale, and the preconditioner."""
        rows, columns, inside = self._at
        entries = a.reshape(-1)[inside]
        scale = scaling(jax.ops.segment_max(magnitude(entries), rows, self.size))
        scaled = entries * scale[rows]
        if self.method.preconditioner is None:
            return scaled, scale, None
        return scaled, scale, self._preconditioner(lax.stop_gradient(entries), np.stack([rows, columns], 1))

    def _preconditioner(self, entries: Array, at: Int[np.ndarray, "used 2"]) -> Any:
        from jax.experimental.sparse import BCOO

        make = self.method.preconditioner
        assert make is not None
        matrix = BCOO((entries, jnp.asarray(at)), shape=(self.size, self.size))
        found, again = make(matrix), jax.eval_shape(make, matrix)
        vector = jax.ShapeDtypeStruct((self.size,), entries.dtype)
        if not callable(found) or jax.tree.structure(found) != jax.tree.structure(again):
            raise ValueError(
                "`preconditioner(A)` must return a pytree that can be called, the same but for its arrays each time: "
                "`jax.tree_util.Partial(fn, *arrays)` with a function that is not made anew, or an `equinox.Module`."
            )
        result = jax.eval_shape(found, vector)
        if jax.tree.structure(result) != jax.tree.structure(vector) or result.shape != vector.shape:
            raise ValueError(
                f"`preconditioner(A)(b)` must be a vector of {self.size} numbers, as b is, but is {result}."
            )
        return found

    def solve(self, factors: PyTree, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with A x = b, NaN where it is not found; A's derivative is that of the equation."""
        entries, scale, preconditioner = factors
        at_hand = lax.stop_gradient(entries)
        b = (b * scale).astype(jnp.result_type(entries, b))
        rtol = self.method.rtol or float(jnp.finfo(b.dtype).eps) ** LEFT

        def precondition(x: Array, transposed: bool) -> Array:
            if preconditioner is None:
                return self._incomplete.inverse(at_hand, x, jnp.asarray(True), transposed)
            usual = lambda x: preconditioner(x / scale).astype(b.dtype)
            return jax.linear_transpose(usual, x)(x)[0] if transposed else usual(x)

        def found(b: Array, transposed: bool) -> Array:
            x, well = gmres(
                functools.partial(self._product, at_hand, transposed=transposed),
                functools.partial(precondition, transposed=transposed),
                b,
                rtol=rtol,
                restart=min(self.method.restart, self.size),
                most=self.method.most,
            )
            return jnp.where(well, x, jnp.nan)

        return lax.custom_linear_solve(
            functools.partial(self._product, entries),
            b,
            solve=lambda _, b: found(b, False),
            transpose_solve=lambda _, b: found(b, True),
        )

    def _product(self, entries: Array, x: Array, transposed: bool = False) -> Array:
        """A x or Aᵀ x, by the entries inside the matrix."""
        rows, columns, _ = self._at
        of, into = (rows, columns) if transposed else (columns, rows)
        return jax.ops.segment_sum(entries * x[of], into, self.size)

    def apply(self, a: Inexact[Array, "*stored"], x: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """A x."""
        return self.inner.apply(a, x)

    def scale_columns(self, a: Inexact[Array, "*stored"], scale: Inexact[Array, " n"]) -> Inexact[Array, "*stored"]:
        """A diag(scale)."""
        return self.inner.scale_columns(a, scale)

    def least_squares(self, a: Float[Array, "*stored"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """About the least x that makes |A x − b| least, for a singular A; repeat with what remains of b."""
        return self.inner.least_squares(a, b)

    def coupled(self, parts: list[Any], others: list[Any], weights: Float[Array, "s s"]) -> tuple["Iterative", Any]:
        """The matrix of s coupled copies, block (i, j) = δᵢⱼ partsᵢ + weightsᵢⱼ othersᵢ, unknowns of a copy interleaved."""
        storage, matrix = self.inner.coupled(parts, others, weights)
        return _of(storage, dataclasses.replace(self.method, preconditioner=None)), matrix


@functools.lru_cache(maxsize=16)
def _of(storage: Any, method: GMRES) -> Iterative:
    return Iterative(storage, method)
