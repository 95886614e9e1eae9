"""A whole loop compiled into one kernel on the CPU, with its derivatives.

XLA:CPU runs a loop body as a sequence of kernels and pays for each launch; for scenes of a few bodies the launches cost
4 to 12 times the arithmetic.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .kernel_call import as_kernel
from .linear_map import Arrays, LinearMap, Moving, batched_alike, either, forward_map, is_inexact, moved, of_moving
from .settings import one_kernel_enabled
from .types import TreeDef


PullBack = Callable[[Any, Any, Moving], list[Any]]


def one_kernel(
    fn: Callable[..., Any],
    derivative: Literal["forward", "reverse", "any"] = "any",
    pull_back: PullBack | None = None,
    forward: Callable[..., Any] | None = None,
    way: Callable[..., PyTree[Array]] | None = None,
    often: bool = True,
    noticed: Callable[[Arrays, Moving], None] | None = None,
) -> Callable[..., Any]:
    """`fn` (pytrees of arrays to a pytree of arrays), compiled to one kernel on the CPU or a GPU where it qualifies.

    On another backend, or where `unsupported` finds a reason, it is `fn` itself. Under `vmap` the batched function is
    looked at afresh. `derivative` says in which mode `fn` can be differentiated: its derivative is again one kernel
    where it qualifies; with "any" it is the plain `fn` throughout.

    - `pull_back(args, cotangent, moving)`, with "reverse", gives the cotangents of those leaves of `args` that are `moving`, a flag for
      each of them, where a way is known that has forward derivatives.
    - `forward`, with "reverse": the same function, with forward derivatives of any order, where `fn` has none.
    - `way(args, result)`, with "reverse": integers that say which way the computation of derivatives goes. These get them as one more
      argument of `fn`, `forward` and `pull_back`, so that they go the same way, whatever their directions are.
    - `noticed(leaves of args, moving)`, with "reverse", is called when a derivative is traced.
    - `often`: `False` where a result is only looked at: a large kernel is then compiled in the least time.
    """
    if not one_kernel_enabled() or derivative == "any":
        return fn
    return (
        _forward(fn, often) if derivative == "forward" else _reverse(fn, pull_back, forward or fn, way, often, noticed)
    )


def _reverse(
    fn: Callable[..., Any],
    pull_back: PullBack | None,
    forward: Callable[..., Any],
    way: Callable[..., PyTree[Array]] | None,
    often: bool,
    noticed: Callable[[Arrays, Moving], None] | None,
) -> Callable[..., Any]:
    def flat(*args: PyTree) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        kernel, args_of = as_kernel(fn, often), functools.partial(jax.tree.unflatten, treedef)

        @jax.custom_jvp
        def solve(*xs: Array) -> Any:
            out, of_ys = jax.tree.flatten(kernel(*args_of(xs)))
            return jax.tree.unflatten(of_ys, batched_alike(*out))

        @functools.partial(solve.defjvp, symbolic_zeros=True)
        def _(xs: Sequence[Array], dxs: Sequence[Any]) -> Any:
            out = solve(*xs)
            ys, of_ys = jax.tree.flatten(out)
            at, of_at = jax.tree.flatten(args_of(xs) if way is None else (*args_of(xs), way(args_of(xs), out)))
            moving = [is_inexact(x) and type(dx) is not SymbolicZero for x, dx in zip(xs, dxs, strict=True)]
            if noticed is not None:
                noticed(list(xs), tuple(moving))
            flags = *moving, *[False] * (len(at) - len(xs))
            pulled = pull_back or _plain_pull_back(fn)
            changes = _Changes(
                pulled, bool(pull_back), forward, of_at, list(map(is_inexact, at)), of_ys, list(map(is_inexact, ys))
            )
            push = _derivative(changes)(flags)
            found = iter(push(at, [dx for dx, m in zip(dxs, moving, strict=True) if m], inexact(ys)))
            dys = [next(found) if is_inexact(y) else zero_from_primal(y, symbolic_zeros=True) for y in ys]
            return out, jax.tree.unflatten(of_ys, dys)

        return solve(*leaves)

    return flat


@dataclasses.dataclass(frozen=True, eq=False)
class _Changes:
    """How the inexact results y of a function change with those arrays in x that move."""

    pull_back: PullBack
    by_pull_back: bool
    forward: Callable[..., Any]
    of_xs: TreeDef
    inexact_xs: list[bool]
    of_ys: TreeDef
    inexact_ys: list[bool]

    def pushed(self, moving: Moving, xs: Arrays, dxs: Arrays) -> Arrays:
        """J dx."""
        return moved(lambda xs: inexact(self.forward(*jax.tree.unflatten(self.of_xs, xs))), xs, moving, dxs)

    def pulled(self, moving: Moving, xs: Arrays, cotangents: Arrays) -> Arrays:
        """c·J; 0 for c = 0 whatever J is: a result that a loss leaves out may be no number, nor J."""
        rest = iter(cotangents)
        cotangent = jax.tree.unflatten(self.of_ys, [next(rest) if i else None for i in self.inexact_ys])
        found = self.pull_back(jax.tree.unflatten(self.of_xs, xs), cotangent, moving)
        counts = jnp.asarray([jnp.any(c != 0) for c in cotangents], bool).any()
        return [jnp.where(counts, x, jnp.zeros_like(x)) for x in found]

    # What moves first, `moving`, may depend on what moves `then` in a way that a function leaves out where that stands still, and so
    # on with what moves `later`: the inner derivative is by all of them.

    def bent(self, moving: Moving, then: Moving, later: Moving, at: Arrays, dxs: Arrays) -> Arrays:
        """How c·J, at [*x, *c], changes with those that move `then`."""
        n, differentiable = len(self.inexact_xs), self.pulled if self.by_pull_back else self._pulled_forwards
        every = either(moving, then, later)[:n]
        ours = [m for m, e in zip(moving, every, strict=True) if e]
        pulled = lambda xs: [x for x, m in zip(differentiable(every, xs, at[n:]), ours, strict=True) if m]
        return moved(pulled, at[:n], then, dxs)

    def pushed_apart(self, moving: Moving, then: Moving, later: Moving, at: Arrays, dxs: Arrays) -> Arrays:
        """How J dx, at [*x, *dx], changes with those that move `then`."""
        n = len(self.inexact_xs)
        every = either(moving, then, later)[:n]

        def pushed(xs: Arrays) -> Arrays:
            rest = iter(at[n:])
            flags = zip(xs, moving, every, strict=True)
            return self.pushed(every, xs, [next(rest) if m else jnp.zeros_like(x) for x, m, e in flags if e])

        return moved(pushed, at[:n], then, dxs)

    def pulled_apart(self, moving: Moving, then: Moving, later: Moving, at: Arrays, cotangents: Arrays) -> Arrays:
        """The transpose of that."""
        n = len(self.inexact_xs)
        return self.bent(then, moving, later, [*at[:n], *cotangents], at[n:])

    def _pulled_forwards(self, moving: Moving, xs: Arrays, cotangents: Arrays) -> Arrays:
        """c·J by one forward derivative for each number that moves."""
        directions, unflatten = ravel_pytree([jnp.zeros_like(x) for x, m in zip(xs, moving, strict=True) if m])

        def slope(d: Array) -> Any:
            found = self.pushed(moving, xs, unflatten(d))
            return sum(jnp.sum(c * dy) for c, dy in zip(cotangents, found, strict=True))

        return unflatten(jax.vmap(slope)(jnp.eye(directions.size, dtype=directions.dtype)))


def _derivative(of: _Changes) -> Callable[[Moving], LinearMap]:
    """dx ↦ J(x) dx for those arrays in x that move, with its transpose and with the second derivative in both modes.

    The second derivative is symmetric: how c·J(x) changes along u is Σₖ cₖ Hₖ u; by x that moves first and then by another it is the
    transpose of what it is the other way round.
    """
    xs, results = of.inexact_xs, sum(of.inexact_ys)

    @functools.cache
    def push(moving: Moving) -> LinearMap:
        return LinearMap(
            as_kernel(partial(of.pushed, moving)), xs, lambda: pull(moving), lambda then: apart(moving, then)
        )

    @functools.cache
    def pull(moving: Moving) -> LinearMap:
        return LinearMap(
            as_kernel(partial(of.pulled, moving)), xs, lambda: push(moving), lambda then: bend(moving, then)
        )

    @functools.cache
    def bend(moving: Moving, then: Moving) -> LinearMap:
        at = [*xs, *[True] * results]
        return forward_map(partial(of.bent, moving, then), at, sum(then), lambda: bend(then, moving))

    @functools.cache
    def apart(moving: Moving, then: Moving) -> LinearMap:
        at = [*xs, *[True] * sum(moving)]
        transposed = forward_map(partial(of.pulled_apart, moving, then), at, results)
        return forward_map(partial(of.pushed_apart, moving, then), at, sum(then), lambda: transposed)

    return push


def _plain_pull_back(fn: Callable[..., Any]) -> PullBack:
    def pull_back(args: PyTree, cotangent: PyTree, moving: Moving) -> list[Any]:
        leaves, treedef = jax.tree.flatten(args)
        values, at = of_moving(lambda xs: inexact(fn(*jax.tree.unflatten(treedef, xs))), leaves, moving)
        return list(jax.vjp(values, *at)[1](inexact(cotangent)))

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
