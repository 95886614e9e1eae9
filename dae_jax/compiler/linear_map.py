"""Linear maps that are known together with their transposes and their derivatives, as a primitive.

JAX has functions with a rule for forward derivatives and functions with one for reverse derivatives, but none with both.
The derivative of a function in any mode is a linear map: applied to a direction it is the one, its transpose the other.
"""

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike
from jaxtyping import Array

from ._compat import as_varying, at_ease, varying_alike
from .kernel_call import as_kernel


Arrays = list[Any]

# Which of some arrays move, where a derivative is asked for.
Moving = tuple[bool, ...]

# Which axis of each array is that of a batch.
Axes = Sequence[int | None]


@dataclasses.dataclass(frozen=True, eq=False)
class LinearMap:
    """x ↦ A(at) x for lists of arrays, `apply(at, x)`.

    `transposed()` is y ↦ A(at)ᵀ y. `change(moving)` is how A(at) x changes with those arrays in `at`, a linear map of their changes at
    [*at, *x]. `inexact`: which arrays in `at` can move.
    """

    apply: Callable[[Arrays, Arrays], Arrays]
    inexact: Sequence[bool]
    transposed: Callable[[], "LinearMap"]
    change: Callable[[Moving], "LinearMap"]

    def __call__(self, at: Sequence[Array], x: Sequence[Array], shapes: Sequence[Array | ShapedArray]) -> Arrays:
        """A(at) x, whose arrays have the shapes and types of these."""
        avals = tuple(ShapedArray(jnp.shape(s), jnp.result_type(s)) for s in shapes)
        return linear_p.bind(*varying_alike([*at, *x]), of=self, avals=avals)


@jax.custom_batching.custom_vmap
def batched_alike(*xs: Array) -> tuple[Array, ...]:
    """These, in a batch all of them batched, as what a `LinearMap` gives is: of a function with a rule for its derivative JAX takes
    a value for batched whose derivative is, and one that is not for a value of another shape.
    """
    return xs


@batched_alike.def_vmap
def _(size: int, batched: Sequence[bool], *xs: Array) -> Any:
    alike = (x if b else jnp.broadcast_to(x, (size, *jnp.shape(x))) for x, b in zip(xs, batched, strict=True))
    return batched_alike(*alike), (True,) * len(xs)


def is_inexact(x: ArrayLike) -> bool:
    """Whether an array has derivatives."""
    return jnp.issubdtype(jnp.result_type(x), jnp.inexact)


def of_moving(fn: Callable[[Arrays], Any], at: Arrays, moving: Sequence[bool]) -> tuple[Callable[..., Any], Arrays]:
    """`fn(at)` as a function of those arrays in `at` that are `moving`, and these."""

    def values(*zs: Array) -> Any:
        rest = iter(zs)
        return fn([next(rest) if m else x for x, m in zip(at, moving, strict=True)])

    return values, [x for x, m in zip(at, moving, strict=True) if m]


def moved(fn: Callable[[Arrays], Arrays], at: Arrays, moving: Sequence[bool], changes: Arrays) -> Arrays:
    """How `fn(at)` changes with the arrays in `at` that are `moving`."""
    values, xs = of_moving(fn, at, moving)
    return jax.jvp(values, tuple(xs), tuple(changes))[1]


def either(*flags: Moving) -> Moving:
    """What moves in one of them, the shorter ones being of the first arrays."""
    return tuple(map(any, itertools.zip_longest(*flags, fillvalue=False)))


def forward_map(
    fn: Callable[[Moving, Arrays, Arrays], Arrays],
    inexact: Sequence[bool],
    count: int,
    transposed: Callable[[], LinearMap] | None = None,
) -> LinearMap:
    """`fn(later, at, x)`, linear in the `count` arrays x; its changes are forward derivatives of `fn`, and have no transpose. `later`:
    which of the arrays it will be differentiated by.
    """
    n = len(inexact)

    def no_transpose() -> LinearMap:
        raise NotImplementedError(
            "The third derivative of a solve is a forward one: put `jax.jacfwd` outside, or use "
            "`adjoint=diffrax.ForwardMode()` with `jax.jacfwd` throughout."
        )

    def change(moving: Moving) -> LinearMap:
        def changed(later: Moving, at: Arrays, changes: Arrays) -> Arrays:
            return moved(lambda a: fn(either(moving, later), a, at[n:]), at[:n], moving, changes)

        return forward_map(changed, [*inexact, *[True] * count], sum(moving))

    return LinearMap(as_kernel(functools.partial(fn, ())), inexact, transposed or no_transpose, change)


def derivative_map(
    fn: Callable[[Arrays], Arrays],
    inexact: Sequence[bool],
    moving: Sequence[bool],
    results: int,
    kernel: Callable[[Callable[..., Arrays]], Callable[..., Arrays]],
) -> LinearMap:
    """dx ↦ J(at) dx of the inexact results of `fn(at)`, so many, with regard to those arrays in `at` that are `moving`.

    It has derivatives of any order in both modes, as far as `fn` has them; each is compiled by `kernel`.
    """
    n, count = len(moving), sum(moving)

    def values(at: Arrays) -> Arrays:
        return list(filter(is_inexact, fn(at)))

    def pushed(at: Arrays, dxs: Arrays) -> Arrays:
        return moved(values, at, moving, dxs)

    def pulled(at: Arrays, cotangents: Arrays) -> Arrays:
        of_xs, xs = of_moving(values, at, moving)
        return list(jax.vjp(of_xs, *xs)[1](list(cotangents)))

    def change(apply: Callable[[Arrays, Arrays], Arrays], of: int, found: int, moving: Moving) -> LinearMap:
        also, still = [*inexact, *[True] * of], [*moving, *[False] * of]
        return derivative_map(lambda xs: apply(xs[:n], xs[n:]), also, still, found, kernel)

    push = LinearMap(kernel(pushed), inexact, lambda: pull, lambda moving: change(pushed, count, results, moving))
    pull = LinearMap(kernel(pulled), inexact, lambda: push, lambda moving: change(pulled, results, count, moving))
    return push


linear_p = Primitive("linear_map")
linear_p.multiple_results = True


@at_ease
def _evaluate(*args: Array, of: LinearMap, **_: object) -> Arrays:
    n = len(of.inexact)
    return of.apply(list(args[:n]), list(args[n:]))


linear_p.def_impl(_evaluate)
linear_p.def_abstract_eval(lambda *args, avals, **_: [as_varying(aval, args[0]) for aval in avals])
mlir.register_lowering(linear_p, mlir.lower_fun(_evaluate, multiple_results=True))


@at_ease
def _jvp(primals: Arrays, tangents: Sequence[Array], *, of: LinearMap, avals: Sequence[ShapedArray]) -> Any:
    n = len(of.inexact)
    moving = tuple(i and not _is_zero(t) for t, i in zip(tangents[:n], of.inexact, strict=True))
    found = []
    if not all(map(_is_zero, tangents[n:])):
        found.append(of(primals[:n], _instantiated(tangents[n:]), avals))
    if any(moving):
        changes = [t for t, m in zip(tangents[:n], moving, strict=True) if m]
        found.append(of.change(moving)(primals, changes, avals))
    return of(primals[:n], primals[n:], avals), [functools.reduce(operator.add, xs) for xs in zip(*found, strict=True)]


def _is_zero(tangent: object) -> bool:
    return type(tangent) is ad.Zero


def _instantiated(tangents: Sequence[Array]) -> Arrays:
    return [jnp.zeros(t.aval.shape, t.aval.dtype) if _is_zero(t) else t for t in tangents]


@at_ease
def _transpose(cotangents: Arrays, *args: Array, of: LinearMap, **_: object) -> list[Any]:
    n = len(of.inexact)
    return [None] * n + of.transposed()(args[:n], _instantiated(cotangents), [x.aval for x in args[n:]])


@at_ease
def _batch(args: Sequence[Array], axes: Axes, *, of: LinearMap, avals: Sequence[ShapedArray]) -> Any:
    args = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, axes, strict=True)]
    axes, n = [None if d is None else 0 for d in axes], len(of.inexact)
    size = next(x.shape[0] for x, d in zip(args, axes, strict=True) if d is not None)
    zeros = [0] * len(avals)
    shapes = [v.update(shape=(size, *v.shape)) for v in avals]
    return _batched(of, axes[:n], axes[n:], zeros)(args[:n], args[n:], shapes), zeros


def _batched(of: LinearMap, at: Axes, x: Axes, y: Axes) -> LinearMap:
    """A map for each element of a batch; an axis `None` is in `x` what all share, in `y` the sum of all."""

    def apply(where: Arrays, xs: Arrays) -> Arrays:
        found = jax.vmap(of.apply, in_axes=(at, x))(where, xs)
        return [r if d == 0 else jnp.sum(r, 0) for r, d in zip(found, y, strict=True)]

    def change(moving: Moving) -> LinearMap:
        return _batched(of.change(moving), [*at, *x], [d for d, m in zip(at, moving, strict=True) if m], y)

    return LinearMap(apply, of.inexact, lambda: _batched(of.transposed(), at, y, x), change)


ad.primitive_jvps[linear_p] = _jvp
ad.primitive_transposes[linear_p] = _transpose
batching.primitive_batchers[linear_p] = _batch
