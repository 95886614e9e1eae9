"""The rules of factorisations that are too large to be written: LAPACK's and BLAS's, on the host."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, Int

from ...emit.lapack import symbol
from ..access import address_of
from ..arrays import Operand, View
from ..context import Context
from ..dtypes import COMPLEX, FLOATS, part
from ..registry import rule
from .host import addresses, on_host


_factorisation = functools.partial(rule, dtypes=FLOATS | COMPLEX, cost=addresses, by_memory=True, on_host=True)


@_factorisation("lu")
def lu(context: Context, a: Operand, **_: object) -> list[Any]:
    """L and U in one matrix, the rows that were exchanged, and the permutation."""
    factorise = _native(context, "getrf")
    if factorise is None:
        return on_host(context, _lu, [a])
    (m, n), memory = context.outs[0].shape, context.memory
    columns = _own(context, _transposed(context.view(a)), 0)
    pivots, outcome = memory.new(np.int32, context.outs[1].shape), memory.new(np.int32, ())
    _call(context, factorise, m, n, columns, m, pivots, outcome)
    exchanges = jax.make_jaxpr(functools.partial(_exchanges, rows=m))(context.outs[1])
    return [_transposed(_joined(context, columns)), *context.run(exchanges, [pivots])]


@_factorisation("cholesky")
def cholesky(context: Context, a: Operand, **_: object) -> list[Any]:
    """L with L Lᴴ = a, of its lower half; not a number where a is not positive definite."""
    factorise = _native(context, "potrf")
    if factorise is None:
        return on_host(context, _cholesky, [a])
    n, found, outcome = context.out.shape[0], _own(context, a, 0), context.memory.new(np.int32, ())
    # The lower half by rows is the upper one by columns, of the conjugate.
    _call(context, factorise, "U", n, found, n, outcome)
    lower = jax.make_jaxpr(lambda a, failed: jnp.where(failed == 0, jnp.tril(a), jnp.nan))
    return context.run(lower(context.out, jax.ShapeDtypeStruct((), np.int32)), [_joined(context, found), outcome])


@_factorisation("triangular_solve")
def triangular_solve(context: Context, a: Operand, b: Operand, **options: Any) -> list[Any]:
    """x with op(a) x = b, or x op(a) = b."""
    names = [field.name for field in dataclasses.fields(_TriangularSolve)]
    of = _TriangularSolve(**{name: options[name] for name in names})
    solve = _native(context, "trsm")
    if solve is None:
        return on_host(context, of, [a, b])
    view, is_complex = context.view(a), context.dtype.kind == "c"
    by_columns = _transposed(view).contiguous and not is_complex
    view = view if by_columns or (view.contiguous and not is_complex) else _own(context, view, 0, of.conjugate_a)
    x = _own(context, b, 1)
    rows, columns = context.out.shape
    # In BLAS's eyes, which reads by columns, x and b are transposed, and so is a matrix that lies by rows.
    flags = (
        "R" if of.left_side else "L",
        "L" if of.lower == by_columns else "U",
        "N" if of.transpose_a == by_columns else "T",
        "U" if of.unit_diagonal else "N",
    )
    one = context.memory.constant_view(np.ones((), context.dtype))
    _call(context, solve, *flags, columns, rows, one, view, view.shape[0], x, columns)
    return [_joined(context, x)]


def _native(context: Context, name: str) -> str | None:
    """The symbol of a function of LAPACK or BLAS for one matrix; `None` for stacks of them, and in lanes."""
    alone = context.code.width == 1 and len(context.outs[0].shape) == 2
    letter = {"float32": "s", "float64": "d", "complex64": "c", "complex128": "z"}[context.dtype.name]
    return symbol(letter + name) if alone else None


def _own(context: Context, x: Operand, k: int, conjugated: bool = False) -> View:
    """Operand k, or what was made of it, in memory of its own, as LAPACK has numbers: imaginary parts beside their real ones."""
    if context.dtype.kind != "c":
        return context.memory.copied(x, context.dtype)
    parts = jax.make_jaxpr(lambda x: jnp.stack([x.real, -x.imag if conjugated else x.imag], -1))
    (found,) = context.run(parts(jax.ShapeDtypeStruct(x.shape, context.dtype)), [context.view(x, k)])
    return context.memory.copied(found, part(context.dtype))


def _joined(context: Context, x: View) -> Any:
    """The matrix of what `_own` gave."""
    if context.dtype.kind != "c":
        return x
    whole = jax.make_jaxpr(lambda x: jax.lax.complex(x[..., 0], x[..., 1]))
    (found,) = context.run(whole(jax.ShapeDtypeStruct(x.shape, x.dtype)), [x])
    return context.view(found)


def _transposed(x: View) -> View:
    return dataclasses.replace(x, shape=x.shape[::-1], strides=x.strides[::-1])


def _call(context: Context, name: str, *args: View | str | int) -> None:
    """Calls a function of addresses; numbers and letters are data of the module."""
    code, memory = context.code, context.memory
    addresses = []
    for x in args:
        if not isinstance(x, View):
            x = memory.constant_view(
                np.frombuffer(x.encode(), np.uint8) if isinstance(x, str) else np.array([x], np.int32)
            )
        addresses.append(f"ptr {address_of(code, x.buffer, x.offset)}")
    function = code.function(name, "void", *["ptr"] * len(args))
    code.lines.append(f"call void {function}({', '.join(addresses)})")


def _exchanges(pivots: Array, rows: int) -> tuple[Array, Array]:
    """LAPACK's pivots counted from 0, and the order of the rows after the exchanges."""

    def exchanged(k: Any, order: Array) -> Array:
        j = pivots[k]
        return order.at[k].set(order[j]).at[j].set(order[k])

    pivots = pivots - 1
    return pivots, jax.lax.fori_loop(0, len(pivots), exchanged, jnp.arange(rows, dtype=jnp.int32))


def _of_each(*arrays: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """The matrices of stacks of them, in turn."""
    for place in np.ndindex(arrays[0].shape[:-2]):
        yield tuple(x[place] for x in arrays)


def _stacked(found: Sequence[np.ndarray], of: np.ndarray) -> np.ndarray:
    return np.reshape(found, (*of.shape[:-2], *found[0].shape))


def _lu(a: Inexact[np.ndarray, "*stack m n"]) -> tuple[np.ndarray, ...]:
    from scipy.linalg.lapack import get_lapack_funcs

    (factorise,) = get_lapack_funcs(("getrf",), (a,))
    found = []
    for (matrix,) in _of_each(a):
        factors, pivots, _ = factorise(matrix)
        found.append((factors, pivots, _order(pivots, len(matrix))))
    return tuple(_stacked(part, a) for part in zip(*found, strict=True))


def _order(pivots: Int[np.ndarray, " k"], rows: int) -> Int[np.ndarray, " rows"]:
    order = np.arange(rows, dtype=np.int32)
    for k, j in enumerate(pivots):
        order[[k, j]] = order[[j, k]]
    return order


def _cholesky(a: Inexact[np.ndarray, "*stack n n"]) -> tuple[np.ndarray]:
    from scipy.linalg.lapack import get_lapack_funcs

    (factorise,) = get_lapack_funcs(("potrf",), (a,))
    found = []
    for (matrix,) in _of_each(a):
        factor, failed = factorise(matrix, lower=True, clean=True)
        found.append(np.full_like(factor, np.nan) if failed else factor)
    return (_stacked(found, a),)


@dataclasses.dataclass(frozen=True)
class _TriangularSolve:
    left_side: bool
    lower: bool
    transpose_a: bool
    conjugate_a: bool
    unit_diagonal: bool

    def __call__(self, a: Inexact[np.ndarray, "*stack n n"], b: Inexact[np.ndarray, "*stack m k"]) -> tuple[np.ndarray]:
        from scipy.linalg.blas import get_blas_funcs

        (solve,) = get_blas_funcs(("trsm",), (a, b))
        of: Callable[[np.ndarray], np.ndarray] = np.conj if self.conjugate_a else np.asarray
        side, trans = not self.left_side, int(self.transpose_a)
        found = [
            solve(1, of(matrix), right, side=side, lower=self.lower, trans_a=trans, diag=self.unit_diagonal)
            for matrix, right in _of_each(a, b)
        ]
        return (_stacked(found, b),)
