"""A whole loop compiled into one kernel on the CPU, with its derivatives.

XLA:CPU runs a loop body as a sequence of kernels and pays for each launch; for scenes of a few bodies the launches cost
4 to 12 times the arithmetic.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .kernel_call import as_kernel
from .linear_map import Arrays, LinearMap, batched_alike, forward_map, is_inexact, moved
from .settings import one_kernel_enabled
from .types import TreeDef


PullBack = Callable[[Any, Any], list[Any]]


def one_kernel(
    fn: Callable[..., Any],
    derivative: Literal["forward", "reverse", "any"] = "any",
    pull_back: PullBack | None = None,
    forward: Callable[..., Any] | None = None,
    way: Callable[..., PyTree[Array]] | None = None,
    often: bool = True,
) -> Callable[..., Any]:
    """`fn` (pytrees of arrays to a pytree of arrays), compiled to one kernel on the CPU or a GPU where it qualifies.

    On another backend, or where `hindrances` finds a reason, it is `fn` itself. Under `vmap` the batched function is
    looked at afresh. `derivative` says in which mode `fn` can be differentiated: its derivative is again one kernel
    where it qualifies; with "any" it is the plain `fn` throughout.

    - `pull_back(args, cotangent)`, with "reverse", gives the cotangents of those leaves of `args` that are inexact, where
      a way is known that has forward derivatives.
    - `forward`, with "reverse": the same function, with forward derivatives of any order, where `fn` has none.
    - `way(args, result)`, with "reverse": integers that say which way the computation of derivatives goes. These get them as one more
      argument of `fn`, `forward` and `pull_back`, so that they go the same way, whatever their directions are.
    - `often`: `False` where a result is only looked at: a large kernel is then compiled in the least time.
    """
    if not one_kernel_enabled() or derivative == "any":
        return fn
    return _forward(fn, often) if derivative == "forward" else _reverse(fn, pull_back, forward or fn, way, often)


def _reverse(
    fn: Callable[..., Any],
    pull_back: PullBack | None,
    forward: Callable[..., Any],
    way: Callable[..., PyTree[Array]] | None,
    often: bool,
) -> Callable[..., Any]:
    def flat(*args: PyTree) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        kernel, args_of = as_kernel(fn, often), functools.partial(jax.tree.unflatten, treedef)

        @jax.custom_jvp
        def solve(*xs: Array) -> Any:
            out, of_ys = jax.tree.flatten(kernel(*args_of(xs)))
            return jax.tree.unflatten(of_ys, batched_alike(*out))

        @solve.defjvp
        def _(xs: Sequence[Array], dxs: Sequence[Array]) -> Any:
            out = solve(*xs)
            ys, of_ys = jax.tree.flatten(out)
            at, of_at = jax.tree.flatten(args_of(xs) if way is None else (*args_of(xs), way(args_of(xs), out)))
            push = _derivative(
                fn, pull_back, forward, of_at, list(map(is_inexact, at)), of_ys, list(map(is_inexact, ys))
            )
            found = iter(push(at, [dx for x, dx in zip(xs, dxs, strict=True) if is_inexact(x)], inexact(ys)))
            dys = [next(found) if is_inexact(y) else np.zeros(jnp.shape(y), jax.dtypes.float0) for y in ys]
            return out, jax.tree.unflatten(of_ys, dys)

        return solve(*leaves)

    return flat


def _derivative(
    fn: Callable[..., Any],
    pull_back: PullBack | None,
    forward: Callable[..., Any],
    of_xs: TreeDef,
    inexact_xs: list[bool],
    of_ys: TreeDef,
    inexact_ys: list[bool],
) -> LinearMap:
    """dx ↦ J(x) dx, with its transpose and with the second derivative in both modes.

    The second derivative is symmetric: how c·J(x) changes along u is Σₖ cₖ Hₖ u, and its transpose is itself.
    """
    n, count, results = len(inexact_xs), sum(inexact_xs), sum(inexact_ys)

    def values(xs: Arrays) -> Arrays:
        return inexact(forward(*jax.tree.unflatten(of_xs, xs)))

    def pushed(xs: Arrays, dxs: Arrays) -> Arrays:
        return moved(values, xs, dxs)

    def pulled(xs: Arrays, cotangents: Arrays) -> Arrays:
        rest = iter(cotangents)
        cotangent = jax.tree.unflatten(of_ys, [next(rest) if i else None for i in inexact_ys])
        return (pull_back or _plain_pull_back(fn))(jax.tree.unflatten(of_xs, xs), cotangent)

    def pulled_forwards(xs: Arrays, cotangents: Arrays) -> Arrays:
        """The same by one forward derivative for each number in `xs`."""
        directions, unflatten = ravel_pytree([jnp.zeros_like(x) for x in inexact(xs)])

        def slope(d: Array) -> Any:
            return sum(jnp.sum(c * dy) for c, dy in zip(cotangents, pushed(xs, unflatten(d)), strict=True))

        return unflatten(jax.vmap(slope)(jnp.eye(directions.size, dtype=directions.dtype)))

    def bent(at: Arrays, dxs: Arrays) -> Arrays:
        differentiable = pulled if pull_back else pulled_forwards
        return moved(lambda xs: differentiable(xs, at[n:]), at[:n], dxs)

    def pushed_apart(at: Arrays, dxs: Arrays) -> Arrays:
        return moved(lambda xs: pushed(xs, at[n:]), at[:n], dxs)

    def pulled_apart(at: Arrays, cotangents: Arrays) -> Arrays:
        return bent([*at[:n], *cotangents], at[n:])

    of_both = [*inexact_xs, *[True] * count]
    push = LinearMap(as_kernel(pushed), inexact_xs, lambda: pull, lambda: apart)
    pull = LinearMap(as_kernel(pulled), inexact_xs, lambda: push, lambda: bend)
    bend = forward_map(bent, [*inexact_xs, *[True] * results], count, lambda: bend)
    apart = forward_map(pushed_apart, of_both, count, lambda: forward_map(pulled_apart, of_both, results))
    return push


def _plain_pull_back(fn: Callable[..., Any]) -> PullBack:
    def pull_back(args: PyTree, cotangent: PyTree) -> list[Any]:
        leaves, treedef = jax.tree.flatten(args)
        exact = [not is_inexact(x) for x in leaves]

        def of_inexact(*zs: Array) -> list[Any]:
            rest = iter(zs)
            merged = [x if e else next(rest) for e, x in zip(exact, leaves, strict=True)]
            return inexact(fn(*jax.tree.unflatten(treedef, merged)))

        return list(jax.vjp(of_inexact, *inexact(args))[1](inexact(cotangent)))

    return pull_back


def inexact(tree: PyTree) -> list[Any]:
    """The leaves that have derivatives."""
    return list(filter(is_inexact, jax.tree.leaves(tree)))


def _forward(fn: Callable[..., Any], often: bool = True) -> Callable[..., Any]:
    @jax.custom_jvp
    def solve(*args: PyTree) -> Any:
        return as_kernel(fn, often)(*args)

    @solve.defjvp
    def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
        def pushed(primals: tuple[PyTree, ...], directions: list[Array]) -> Any:
            # An integer's tangent has no numbers.
            rest = iter(directions)
            nothing = lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0)
            whole = jax.tree.map(lambda x: next(rest) if is_inexact(x) else nothing(x), primals)
            return jax.jvp(fn, primals, whole)

        pairs = zip(jax.tree.leaves(primals), jax.tree.leaves(tangents), strict=True)
        return _forward(pushed)(primals, [dx for x, dx in pairs if is_inexact(x)])

    return solve
