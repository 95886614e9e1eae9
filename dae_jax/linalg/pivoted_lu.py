"""LU of a sparse matrix with partial pivoting, whole or incomplete, by SuperLU on the host.

Each call is a function of numbers alone; that the same matrix has been factorised before is remembered beside it.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact, Int


# How many matrices stay factorised: the iteration matrices of a step, and a few threads.
KEPT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class PivotedLU:
    """For matrices with entries at (`rows`, `columns`). Compared by identity.

    `drop`: entries of the factors that are less than this part of their column are left out; then what is called an inverse is
    about one.
    """

    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    size: int
    drop: float | None = None

    def solve(self, a: Inexact[Array, " entries"], b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with A x = b, and its derivative; NaN where A is singular or not finite."""
        apply = lambda x: jax.ops.segment_sum(a * x[self.columns], self.rows, self.size)
        at_hand, needed = jax.lax.stop_gradient(a), jnp.asarray(True)
        return jax.lax.custom_linear_solve(
            apply,
            b,
            solve=lambda _, b: self.inverse(at_hand, b, needed),
            transpose_solve=lambda _, b: self.inverse(at_hand, b, needed, transposed=True),
        )

    def inverse(
        self, a: Inexact[Array, " entries"], b: Inexact[Array, " n"], needed: Bool[Array, ""], transposed: bool = False
    ) -> Inexact[Array, " n"]:
        """x with A x = b, or Aᵀ x = b, where that is `needed`; without a derivative."""
        found = jax.ShapeDtypeStruct(b.shape, jnp.result_type(a, b))
        return jax.pure_callback(_OnHost(self, transposed), found, a, b, needed, vmap_method="sequential")


@dataclasses.dataclass(frozen=True)
class _OnHost:
    """x with A x = b, or Aᵀ x = b, where that is `needed`."""

    pattern: PivotedLU
    transposed: bool

    # So that it may be called from within a kernel.
    never_raises: ClassVar[bool] = True

    def __call__(self, a: Any, b: Any, needed: Any) -> np.ndarray:
        dtype = np.result_type(a.dtype, b.dtype)
        if not needed:
            return np.zeros(b.shape, dtype)
        return _remembered(self.pattern, *_key(a)).solve(np.asarray(b, dtype), self.transposed)


@dataclasses.dataclass(frozen=True)
class HostFactors:
    """What SuperLU made of the matrix whose rows were multiplied by `scale`; `None` of a singular one."""

    lu: Any
    scale: Float[np.ndarray, " n"]

    @property
    def smallest(self) -> float:
        """The smallest pivot where the largest entry of each row is 1, 0 of a singular matrix."""
        return 0.0 if self.lu is None else float(np.abs(self.lu.U.diagonal()).min())

    def solve(self, b: np.ndarray, transposed: bool) -> np.ndarray:
        if self.lu is None or not np.isfinite(b).all():
            return np.full_like(b, np.nan)
        found = self.lu.solve(b, "T") * self.scale if transposed else self.lu.solve(b * self.scale)
        return found.astype(b.dtype)


def _key(a: Any) -> tuple[bytes, str]:
    a = np.asarray(a)
    return a.tobytes(), a.dtype.str


@functools.lru_cache(maxsize=KEPT)
def _remembered(pattern: PivotedLU, entries: bytes, dtype: str) -> HostFactors:
    return factorised(pattern.rows, pattern.columns, np.frombuffer(entries, dtype), pattern.size, pattern.drop)


def factorised(
    rows: Int[np.ndarray, " entries"],
    columns: Int[np.ndarray, " entries"],
    a: Inexact[np.ndarray, " entries"],
    n: int,
    drop: float | None = None,
) -> HostFactors:
    """The factors of the n × n matrix with entries `a`; `drop` as for `PivotedLU`."""
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import spilu, splu

    largest = np.zeros(n, np.finfo(a.dtype).dtype)
    if not np.isfinite(a).all():
        return HostFactors(None, largest)
    np.maximum.at(largest, rows, np.abs(a))
    if not largest.all():
        return HostFactors(None, largest)
    scale = 1 / largest
    matrix = csc_array((a * scale[rows], (rows, columns)), shape=(n, n))
    matrix.eliminate_zeros()
    try:
        lu = splu(matrix) if drop is None else spilu(matrix, drop, permc_spec="MMD_AT_PLUS_A", drop_rule="basic")
    except RuntimeError:
        # Exactly singular.
        lu = None
    return HostFactors(lu, scale)


@dataclasses.dataclass(frozen=True, eq=False)
class Augmented:
    """r + B x = b, Bᵀ r − ε x = c, for B with `shape` and entries at (`rows`, `columns`): with c = 0 and ε → 0 the least squares
    of B x = b, with b = 0 the shortest r with Bᵀ r = c. Compared by identity.
    """

    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    shape: tuple[int, int]

    def solve(
        self, b_entries: Float[Array, " entries"], cut: Float[Array, ""], b: Float[Array, " m"], c: Float[Array, " n"]
    ) -> tuple[Float[Array, " m"], Float[Array, " n"]]:
        """r and x."""
        entries = jnp.concatenate([jnp.ones_like(b), b_entries, b_entries, jnp.full_like(c, -1) * cut])
        both = self._whole.solve(entries, jnp.concatenate([b, c]))
        return both[: self.shape[0]], both[self.shape[0] :]

    @functools.cached_property
    def _whole(self) -> PivotedLU:
        m, n = self.shape
        first, second = np.arange(m), m + np.arange(n)
        rows = np.concatenate([first, self.rows, m + self.columns, second])
        columns = np.concatenate([first, m + self.columns, self.rows, second])
        return PivotedLU(rows, columns, m + n)
