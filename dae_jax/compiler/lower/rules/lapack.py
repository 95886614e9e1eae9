"""The rules of factorisations that are too large to be written: LAPACK's and BLAS's, on the host."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Inexact, Int

from ...emit.lapack import symbol
from ...jaxprs.expansions.factorisations import lu_pivots_to_permutation
from ...types import Equation
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
    (m, n), pivots = context.outs[0].shape, context.outs[1]
    call = functools.partial(_call, context, factorise, m, n)
    columns = _transposed(_numbers(context, a, 0))
    found = _on_copies(context, [columns, pivots, _OUTCOME], lambda a, pivots, outcome: call(a, m, pivots, outcome))
    # LAPACK counts from 1.
    exchanges = jax.make_jaxpr(lambda p: (p - 1, lu_pivots_to_permutation(p - 1, permutation_size=m)))(pivots)
    return [_transposed(_joined(context, found[0])), *context.run(exchanges, [found[1]])]


@_factorisation("cholesky")
def cholesky(context: Context, a: Operand, **_: object) -> list[Any]:
    """L with L Lᴴ = a, of its lower half; not a number where a is not positive definite."""
    factorise = _native(context, "potrf")
    if factorise is None:
        return on_host(context, _cholesky, [a])
    n = context.out.shape[0]
    # The lower half by rows is the upper one by columns, of the conjugate.
    call = functools.partial(_call, context, factorise, "U", n)
    found, outcome = _on_copies(context, [_numbers(context, a, 0), _OUTCOME], lambda a, outcome: call(a, n, outcome))
    lower = jax.make_jaxpr(lambda a, failed: jnp.where(failed == 0, jnp.tril(a), jnp.nan))
    return context.run(lower(context.out, _OUTCOME), [_joined(context, found), outcome])


@_factorisation("triangular_solve")
def triangular_solve(context: Context, a: Operand, b: Operand, **options: Any) -> list[Any]:
    """x with op(a) x = b, or x op(a) = b."""
    names = [field.name for field in dataclasses.fields(_TriangularSolve)]
    of = _TriangularSolve(**{name: options[name] for name in names})
    solve = _native(context, "trsm")
    if solve is None:
        return on_host(context, of, [a, b])
    rows, columns = context.out.shape
    matrix, right = _numbers(context, a, 0, of.conjugate_a), _numbers(context, b, 1)
    by_columns = context.dtype.kind != "c" and _transposed(matrix).contiguous
    # In BLAS's eyes, which reads by columns, x and b are transposed, and so is a matrix that lies by rows.
    flags = (
        "R" if of.left_side else "L",
        "L" if of.lower == by_columns else "U",
        "N" if of.transpose_a == by_columns else "T",
        "U" if of.unit_diagonal else "N",
    )
    one = context.memory.constant_view(np.ones((), context.dtype))
    call = functools.partial(_call, context, solve, *flags, columns, rows, one)
    n = matrix.shape[0]
    if context.code.width == 1 and (by_columns or matrix.contiguous):
        (x,) = _on_copies(context, [right], lambda x: call(matrix, n, x, columns))
    else:
        by_rows = _transposed(matrix) if by_columns else matrix
        _, x = _on_copies(context, [by_rows, right], lambda a, x: call(a, n, x, columns))
    return [_joined(context, x)]


def _of_all(eqn: Equation) -> str | None:
    n = eqn.outvars[0].aval.shape[-2]
    return "some of the eigenvalues" if eqn.params["subset_by_index"] not in (None, (0, n)) else None


@_factorisation("eigh", requires=_of_all)
def eigh(context: Context, a: Operand, *, lower: bool, **_: object) -> list[Any]:
    """Eigenvectors, as columns, and eigenvalues in ascending order of a Hermitian matrix, of one half of it."""
    decompose = _native(context, "syevd") if context.dtype.kind == "f" else None
    if decompose is None:
        return on_host(context, functools.partial(_eigh, lower=lower), [a])
    n = context.out.shape[0]
    values = context.outs[1]
    room, whole = (
        jax.ShapeDtypeStruct((1 + 6 * n + 2 * n * n,), context.dtype),
        jax.ShapeDtypeStruct((3 + 5 * n,), np.int32),
    )
    call = functools.partial(_call, context, decompose, "V", "L" if lower else "U", n)
    vectors, values, *_rooms, outcome = _on_copies(
        context,
        [_transposed(_numbers(context, a, 0)), values, room, whole, _OUTCOME],
        lambda a, values, room, whole, outcome: call(a, n, values, room, room.size, whole, whole.size, outcome),
    )
    checked = jax.make_jaxpr(lambda v, w, failed: tuple(jnp.where(failed == 0, x, jnp.nan) for x in (v, w)))
    found = checked(context.outs[0], context.outs[1], _OUTCOME)
    return context.run(found, [_transposed(vectors), values, outcome])


# Whether a factorisation was possible.
_OUTCOME: Any = jax.ShapeDtypeStruct((), np.int32)


def _native(context: Context, name: str) -> str | None:
    """The symbol of a function of LAPACK or BLAS for one matrix; `None` for stacks of them."""
    letter = {"float32": "s", "float64": "d", "complex64": "c", "complex128": "z"}[context.dtype.name]
    return symbol(letter + name) if len(context.outs[0].shape) == 2 else None


def _numbers(context: Context, x: Operand, k: int, conjugated: bool = False) -> View:
    """Operand k as LAPACK has numbers: imaginary parts beside their real ones, as a last axis."""
    if context.dtype.kind != "c":
        return context.view(x, k)
    parts = jax.make_jaxpr(lambda x: jnp.stack([x.real, -x.imag if conjugated else x.imag], -1))
    (found,) = context.run(parts(jax.ShapeDtypeStruct(x.shape, context.dtype)), [context.view(x, k)])
    return context.memory.view(found, part(context.dtype))


def _joined(context: Context, x: View) -> Any:
    """The matrix of what `_numbers` gives."""
    if context.dtype.kind != "c":
        return x
    whole = jax.make_jaxpr(lambda x: jax.lax.complex(x[..., 0], x[..., 1]))
    (found,) = context.run(whole(jax.ShapeDtypeStruct(x.shape, x.dtype)), [x])
    return context.view(found)


def _transposed(x: View) -> View:
    """With the first two axes exchanged."""
    swap = lambda of: (of[1], of[0], *of[2:])
    return dataclasses.replace(x, shape=swap(x.shape), strides=swap(x.strides))


def _on_copies(context: Context, arrays: Sequence[Any], call: Callable[..., None]) -> list[View]:
    """What `call` makes of copies of the arrays, in place, one lane after another; of what has a shape only it gets memory."""
    code, memory = context.code, context.memory
    fresh = lambda: [memory.new(x.dtype, x.shape) for x in arrays]
    given = [memory.copied(x, x.dtype) if isinstance(x, View) and not isinstance(x.offset, int) else x for x in arrays]
    found = fresh()
    work = found if code.width == 1 else fresh()
    for lane in range(code.width):
        here = [_block(x, lane) if code.width > 1 else x for x in work]
        for to, x in zip(here, given, strict=True):
            if isinstance(x, View):
                memory.assign(to, _lane(x, lane, code.width), fresh=True)
        call(*here)
        for to, x in zip(found if code.width > 1 else [], here, strict=False):
            memory.assign(_lane(to, lane, code.width), x, fresh=True)
    if code.width > 1:
        memory.recycle([x.buffer for x in work])
    return found


def _lane(x: View, lane: int, width: int) -> View:
    """The array of one lane, which lies between those of the others."""
    if not x.buffer.lanes:
        return x
    of_lane = dataclasses.replace(x.buffer, lanes=False)
    return dataclasses.replace(
        x, buffer=of_lane, strides=tuple(width * s for s in x.strides), offset=width * x.offset + lane
    )


def _block(x: View, lane: int) -> View:
    """A part of the memory of an array of all lanes that is as large as that of one."""
    return dataclasses.replace(x, buffer=dataclasses.replace(x.buffer, lanes=False), offset=lane * max(x.size, 1))


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


def _eigh(a: Inexact[np.ndarray, "*stack n n"], lower: bool) -> tuple[np.ndarray, ...]:
    from scipy.linalg.lapack import get_lapack_funcs

    (decompose,) = get_lapack_funcs(("heevd" if np.iscomplexobj(a) else "syevd",), (a,))
    found = []
    for (matrix,) in _of_each(a):
        values, vectors, failed = decompose(matrix, lower=lower)
        found.append([np.full_like(x, np.nan) if failed else x for x in (vectors, values)])
    return tuple(np.reshape(part, (*a.shape[:-2], *part[0].shape)) for part in zip(*found, strict=True))


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
