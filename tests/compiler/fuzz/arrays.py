"""Recipes of what moves, gathers, writes to and adds up the entries of arrays."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .numbers import ALL, BOOL, COMPLEX, FLOATS, INTEGERS, LARGE, REAL, Draw, Operand
from .operations import Operation, recipe


_NUMBERS = (*FLOATS, *INTEGERS, *COMPLEX)


@recipe("broadcast_in_dim expand_dims reshape rev slice squeeze transpose tile pad", ALL)
def moved(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape(1))
    fn = globals()[f"_{name}"](x.shape, draw)
    if name == "squeeze":
        x = x._replace(shape=(1, *x.shape[:1], 1, *x.shape[1:]))
    if name == "pad":
        return Operation(name, fn, (x, Operand(dtype)), smooth=dtype in FLOATS)
    return Operation(name, fn, (x,), smooth=dtype in FLOATS)


def _broadcast_in_dim(shape: Any, draw: Draw) -> Any:
    new = (2, *shape, 3) if draw.chance(0.5) else (*shape[:1], 2, *shape[1:])
    of = range(1, 1 + len(shape)) if len(new) == len(shape) + 2 else [0, *range(2, 1 + len(shape))]
    return lambda x: lax.broadcast_in_dim(x, [4 if n == 1 else n for n in new], list(of))


def _expand_dims(shape: Any, draw: Draw) -> Any:
    axis = draw.below(len(shape) + 1)
    return lambda x: lax.expand_dims(x, [axis])


def _reshape(shape: Any, draw: Draw) -> Any:
    to = draw.shape(1, int(np.prod(shape)))
    return lambda x: lax.reshape(x, to)


def _rev(shape: Any, draw: Draw) -> Any:
    axes = draw.axes(len(shape))
    return lambda x: lax.rev(x, axes)


def _slice(shape: Any, draw: Draw) -> Any:
    starts = [draw.below(n + 1) for n in shape]
    stops = [s + draw.below(n - s + 1) if draw.chance(0.3) else n for s, n in zip(starts, shape, strict=True)]
    steps = [1 + draw.below(3) for _ in shape] if draw.chance(0.5) else None
    return lambda x: lax.slice(x, starts, stops, steps)


def _squeeze(shape: Any, draw: Draw) -> Any:
    return lambda x: lax.squeeze(x, [0, 2])


def _transpose(shape: Any, draw: Draw) -> Any:
    order = draw.order(len(shape))
    return lambda x: lax.transpose(x, order)


def _tile(shape: Any, draw: Draw) -> Any:
    counts = [1 + draw.below(3) for _ in shape]
    return lambda x: jnp.tile(x, counts)


def _pad(shape: Any, draw: Draw) -> Any:
    config = [(draw.below(3), draw.below(3), draw.below(3)) for _ in shape]
    return lambda x, fill: lax.pad(x, fill, config)


@recipe("concatenate stack", ALL)
def joined(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(1)
    axis = draw.below(len(shape))
    count = 1 + draw.below(3)
    others = [
        shape if name == "stack" else (*shape[:axis], 1 + draw.below(4), *shape[axis + 1 :]) for _ in range(count)
    ]
    operands = tuple(Operand(dtype, s) for s in (shape, *others))
    fn = (lambda *xs: lax.concatenate(xs, axis)) if name == "concatenate" else (lambda *xs: jnp.stack(xs, axis))
    return Operation(name, fn, operands, smooth=dtype in FLOATS)


@recipe("split unstack", ALL)
def parted(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(1, draw.one_of([3, 8, 24, 25, 60]))
    axis = draw.below(len(shape))
    if name == "unstack":
        axis = int(np.argmin(shape))
        return Operation(name, lambda x: jnp.unstack(x, axis=axis), (Operand(dtype, shape),), smooth=dtype in FLOATS)
    first = draw.below(shape[axis] + 1)
    fn = lambda x: lax.split(x, [first, shape[axis] - first], axis)
    return Operation(name, fn, (Operand(dtype, shape),), smooth=dtype in FLOATS)


@recipe("reduce_sum", _NUMBERS)
@recipe("reduce_prod", _NUMBERS)
@recipe("reduce_max reduce_min", REAL)
@recipe("reduce_and reduce_or reduce_xor", (*INTEGERS, *BOOL))
def reduction(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(1)
    many = "grid" if dtype in FLOATS and math.prod(shape) > LARGE else "edges"
    domain = {"reduce_sum": "grid", "reduce_prod": "units"}.get(name, many)
    x = Operand(dtype, shape, "plain" if dtype in COMPLEX and name == "reduce_sum" else domain)
    axes = draw.axes(len(x.shape))
    bind = getattr(lax, f"{name}_p").bind
    more = {"out_sharding": None} if name in ("reduce_sum", "reduce_max", "reduce_min") else {}
    fn = lambda a: bind(a, axes=axes, **more)
    return Operation(name, fn, (x,), smooth=dtype in FLOATS and name == "reduce_sum")


@recipe("argmax argmin", REAL)
def place(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(1)
    axis, to = draw.below(len(shape)), draw.one_of(["int32", "int64"])
    shape = tuple(max(n, 1) for n in shape)
    return Operation(name, lambda x: getattr(lax, name)(x, axis, to), (Operand(dtype, shape),))


@recipe("cumsum", _NUMBERS)
@recipe("cumprod", _NUMBERS)
@recipe("cummax cummin", (*FLOATS, *INTEGERS))
def accumulated(name: str, dtype: str, draw: Draw) -> Operation:
    domain = {"cumsum": "grid", "cumprod": "units"}.get(name, "edges")
    shape = draw.shape(1, draw.one_of([1, 3, 8, 24, 25, 60]))
    x = Operand(dtype, shape, "plain" if dtype in COMPLEX and name == "cumsum" else domain)
    axis, reverse = draw.below(len(x.shape)), draw.chance(0.5)
    fn = lambda a: getattr(lax, name)(a, axis=axis, reverse=reverse)
    if name == "cumsum" and dtype in FLOATS and draw.chance(0.3):
        # Zeros of both signs, whose sums have one.
        return Operation(name, lambda a: fn(0 * a), (x,))
    return Operation(name, fn, (x,), smooth=dtype in FLOATS and name == "cumsum")


@recipe("cumlogsumexp", FLOATS)
def logarithmic(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape(1, draw.one_of([1, 3, 8, 25])), "plain")
    axis, reverse = draw.below(len(x.shape)), draw.chance(0.5)
    return Operation(name, lambda a: lax.cumlogsumexp(a, axis=axis, reverse=reverse), (x,), 64)


@recipe("dot_general", _NUMBERS)
def product(name: str, dtype: str, draw: Draw) -> Operation:
    sizes = {letter: draw.one_of([1, 2, 3]) for letter in "bijm"} | {"k": draw.one_of([0, 1, 3, 8, 26])}
    axes = [[letters[k] for k in draw.order(4)] for letters in ("bikm", "bjkm")]
    numbers = tuple(tuple(tuple(of.index(w) for w in which) for of in axes) for which in ("km", "b"))
    operands = tuple(Operand(dtype, tuple(sizes[i] for i in of), "plain") for of in axes)
    return Operation(name, lambda x, y: lax.dot_general(x, y, numbers), operands, smooth=dtype in FLOATS)


@recipe("lu cholesky triangular_solve", (*FLOATS, *COMPLEX))
def factorised(name: str, dtype: str, draw: Draw) -> Operation:
    """Matrices that are too large to be written, far from singular; results are compared beside 8, as their errors are not in
    proportion to each entry.
    """
    beside = lambda found: jax.tree.map(lambda x: x + 8, found)
    n = 33 + draw.below(3)
    x = Operand(dtype, (n, n), "plain")
    regular = lambda x: 0.1 * x / (1 + jnp.max(jnp.abs(x))) + 3 * jnp.eye(n, dtype=dtype)
    if name == "lu":
        return Operation(name, lambda x: beside(lax.linalg.lu(regular(x))), (x,), 64)
    if name == "cholesky":
        return Operation(name, lambda x: beside(lax.linalg.cholesky(regular(x))), (x,), 64)
    flags = ("left_side", "lower", "transpose_a", "conjugate_a", "unit_diagonal")
    solve = functools.partial(lax.linalg.triangular_solve, **{flag: draw.chance(0.5) for flag in flags})
    k = draw.one_of([1, 2])
    b = Operand(dtype, (n, k) if solve.keywords["left_side"] else (k, n), "plain")
    return Operation(name, lambda x, b: beside(solve(regular(x), b / (1 + jnp.max(jnp.abs(b))))), (x, b), 64)


@recipe("eigh", (*FLOATS, *COMPLEX))
def decomposed(name: str, dtype: str, draw: Draw) -> Operation:
    """Eigenvalues that are apart, and the matrix put together again: rounding turns eigenvectors of ones that are close."""
    n, lower = draw.one_of([1, 2, 5, 9]), draw.chance(0.5)

    def both(x: Any) -> Any:
        part = 0.1 * x / (1 + jnp.max(jnp.abs(x)))
        v, w = lax.linalg.eigh(part + jnp.diag(3 + jnp.arange(n, dtype=dtype)), lower=lower, symmetrize_input=False)
        return w, v @ (w[:, None] * v.conj().T) + 8

    return Operation(name, both, (Operand(dtype, (n, n), "plain"),), 64)


def _index(draw: Draw, n: int, shape: Any = ()) -> Operand:
    """Of a type that n is of: JAX counts from the end of an array in the type of the index."""
    dtypes = ["int32", "int64", "uint32", "uint64", "int16", "int8", "uint8"]
    return Operand(draw.one_of(dtypes if n < 100 else dtypes[:4]), shape, n)


@recipe("dynamic_slice dynamic_update_slice", ALL)
def window(name: str, dtype: str, draw: Draw) -> Operation:
    if name == "dynamic_update_slice" and draw.chance(0.3):
        return _onto_itself(name, dtype, draw)
    x = Operand(dtype, draw.shape(1))
    sizes = [draw.below(n + 1) if draw.chance(0.2) else min(n, 1 + draw.below(4)) for n in x.shape]
    starts = [_index(draw, n)._replace(dtype="int32" if d else _index(draw, n).dtype) for d, n in enumerate(x.shape)]
    starts = [s._replace(dtype=starts[0].dtype) for s in starts]
    if name == "dynamic_slice":
        return Operation(name, lambda a, *at: lax.dynamic_slice(a, at, sizes), (x, *starts), smooth=dtype in FLOATS)
    update = x._replace(shape=tuple(sizes))
    fn = lambda a, u, *at: lax.dynamic_update_slice(a, u, at)
    return Operation(name, fn, (x, update, *starts), smooth=dtype in FLOATS)


def _onto_itself(name: str, dtype: str, draw: Draw) -> Operation:
    """An array that nothing else reads, changed by a piece of it that lies over what it is written to."""
    n = draw.one_of([25, 30, 60])
    first, size = draw.below(3), n - 4 - draw.below(5)
    turned = lambda a: lax.concatenate([a[1:], a[:1]], 0)
    if name == "scatter":
        at = first + 1 + draw.below(3)
        fn = lambda a: (y := turned(a)).at[at + jnp.arange(min(size, n - at))].set(y[first:][: min(size, n - at)])
        return Operation(name, fn, (Operand(dtype, (n,)),))
    fn = lambda a, i: lax.dynamic_update_slice(y := turned(a), y[first:][:size], (i,))
    return Operation(name, fn, (Operand(dtype, (n,)), Operand("int32", (), 6)))


@recipe("gather", ALL)
def gathering(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, tuple(max(n, 1) for n in draw.shape(1)))
    axis = draw.below(len(x.shape))
    n, mode = x.shape[axis], draw.one_of(["clip", "fill"])
    at = _index(draw, n, draw.one_of([(), (1,), (3,), (2, 2), (9,), (30,)]))
    match draw.below(6):
        case 0 if len(x.shape) > 1:
            other = _index(draw, x.shape[1], at.shape)
            fn, operands = lambda a, i, j: a.at[i, j].get(mode=mode), (x, at, other)
        case 1:
            each = _index(draw, n, tuple(3 if d == axis else m for d, m in enumerate(x.shape)))._replace(dtype="int32")
            fn, operands = lambda a, i: jnp.take_along_axis(a, i, axis, mode=mode), (x, each)
        case 2:
            known = draw.numbers(_index(draw, n, (3,))._replace(dtype="int32"))
            fn, operands = lambda a: jnp.take(a, known, axis=axis, mode=mode), (x,)
        case 3:
            several = x._replace(shape=(2, *x.shape))
            both = at._replace(shape=(2, *at.shape))
            fn = jax.vmap(lambda a, i: jnp.take(a, i, axis=axis, mode=mode))
            operands = (several, both)
        case 4:
            where, mode = (slice(None),) * axis, "promise_in_bounds"
            fn, operands = lambda a, i: a.at[(*where, i)].get(mode=mode), (x, at)
        case _:
            fn, operands = lambda a, i: jnp.take(a, i, axis=axis, mode=mode), (x, at)
    return Operation(name, fn, operands, smooth=dtype in FLOATS and mode != "fill")


@recipe("scatter", ALL)
@recipe("scatter-add scatter-mul scatter-sub", _NUMBERS)
@recipe("scatter-min scatter-max", (*FLOATS, *INTEGERS))
def scattering(name: str, dtype: str, draw: Draw) -> Operation:
    """What is written to one place twice is the same, or added up."""
    if name == "scatter" and draw.chance(0.3):
        return _onto_itself(name, dtype, draw)
    x = Operand(dtype, tuple(max(n, 1) for n in draw.shape(1)), "plain")
    axis = draw.below(len(x.shape))
    n, mode = x.shape[axis], draw.one_of(["clip", "drop", "promise_in_bounds"])
    at = _index(draw, n, draw.one_of([(), (1,), (3,), (9,)]))
    how = {"scatter": "set", "scatter-sub": "subtract", "scatter-mul": "multiply"}.get(name, name[8:])
    kept = tuple(m for d, m in enumerate(x.shape) if d != axis)
    shape = (
        (*kept[:axis], *at.shape, *kept[axis:])
        if name != "scatter"
        else (*kept[:axis], *[1] * len(at.shape), *kept[axis:])
    )
    update, where = x._replace(shape=shape, domain="units" if how == "multiply" else "plain"), (slice(None),) * axis

    def one(a: Any, u: Any, i: Any) -> Any:
        return getattr(a.at[(*where, i)], how)(
            jnp.broadcast_to(u, a[(*where, jnp.zeros(at.shape, int))].shape), mode=mode
        )

    match draw.below(4):
        case 0:
            known = draw.numbers(at._replace(dtype="int32"))
            fn, operands = functools.partial(lambda a, u, i: one(a, u, i), i=known), (x, update)
        case 1:
            double = lambda o: o._replace(shape=(2, *o.shape))
            fn, operands = jax.vmap(one), (double(x), double(update), double(at))
        case _:
            fn, operands = one, (x, update, at)
    return Operation(name, fn, operands, smooth=dtype in FLOATS and name in ("scatter", "scatter-add"))


@recipe("sort", (*FLOATS, *INTEGERS))
def sorting(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape(1, draw.one_of([1, 3, 8, 24, 25])))
    axis = draw.below(len(x.shape))
    return Operation(name, lambda a: lax.sort(a, dimension=axis), (x,))


@recipe("threefry2x32", ("uint32",))
def random_bits(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(0, draw.one_of([1, 3, 8, 25]))
    fn = lambda key: jax.random.bits(jax.random.wrap_key_data(key), shape)
    return Operation(name, fn, (Operand(dtype, (2,)),))
