"""Any function of small arrays and loops as one piece of machine code: `jit`."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer, eval_jaxpr
from jax.custom_derivatives import zero_from_primal
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, PyTree

from .inspection import Lowered
from .jaxprs.checks import checks_apart
from .jaxprs.expansions import expanded
from .jaxprs.scalar_interpreter import Unsupported
from .kernel_call import called, without_mesh
from .linear_map import Arrays, batched_alike, derivative_map, is_inexact
from .settings import Settings, current, one_kernel_enabled


def jit(
    fn: Callable[..., Any],
    *,
    static_argnums: int | Sequence[int] | None = None,
    static_argnames: str | Sequence[str] | None = None,
) -> "Jitted":
    """`jax.jit(fn)`, compiled to one kernel on the CPU or an NVIDIA GPU: for functions of small arrays, with loops of many turns.

    XLA runs the operations of a loop's body one after another and pays for each; here the whole loop is one function in
    machine code. A solve by `diffrax.diffeqsolve` is such a function.

    - `static_argnums`, `static_argnames`: as `jax.jit` has them.

    Under `jax.vmap` the elements of the batch become lanes of vectors, on all cores; on a GPU threads. Derivatives in either
    mode and of any order, as far as `fn` has them, are compiled in the same way, as programs of their own, which round differently:
    of a solve with steps of its own choice save points at times, not at its steps, of which a derivative may take one more. Checks by
    `equinox.error_if` raise when the kernel is done.
    What cannot be one kernel is compiled by XLA as `jax.jit` does it, and so is everything on other backends;
    `jit(fn).lower(*args)` says which it is, and why.
    """
    return Jitted(fn, static_argnums, static_argnames)


class Jitted:
    """A function that is compiled when it is called; see `jit`."""

    def __init__(
        self,
        fn: Callable[..., Any],
        static_argnums: int | Sequence[int] | None,
        static_argnames: str | Sequence[str] | None,
    ) -> None:
        functools.update_wrapper(self, fn, updated=())
        self._fn = fn
        self._statics = {"static_argnums": static_argnums, "static_argnames": static_argnames}
        self._compiled = jax.jit(self._like_fn(self._traced), **self._statics)

    def __call__(self, *args: PyTree, **kwargs: PyTree) -> Any:
        """What `fn` gives."""
        return self._compiled(*args, **kwargs)

    def lower(self, *args: PyTree, **kwargs: PyTree) -> Lowered:
        """How a call with these arguments is compiled; nothing is run."""
        found: list[Lowered] = []

        def look(*args: PyTree, **kwargs: PyTree) -> None:
            flat, arrays, _ = _of_arrays(self._fn, args, kwargs)
            jaxpr = jax.make_jaxpr(flat)(*arrays)
            try:
                found.append(Lowered.of(jaxpr, *checks_apart(expanded(jaxpr))))
            except Unsupported as reason:
                found.append(Lowered(jaxpr, jaxpr, "xla", (reason,)))

        jax.jit(self._like_fn(look), **self._statics).trace(*args, **kwargs)
        return found[0]

    def _like_fn(self, body: Callable[..., Any]) -> Callable[..., Any]:
        """`body` by the name of `fn` and with its signature, by which JAX finds static arguments."""
        return functools.wraps(self._fn)(lambda *args, **kwargs: body(*args, **kwargs))

    def __get__(self, instance: object, owner: object = None) -> Any:
        return self if instance is None else functools.partial(self, instance)

    def _traced(self, *args: PyTree, **kwargs: PyTree) -> Any:
        if not one_kernel_enabled():
            return self._fn(*args, **kwargs)
        flat, arrays, tree = _of_arrays(self._fn, args, kwargs)
        jaxpr = jax.make_jaxpr(flat)(*arrays)
        # Of what an outer transformation traces the kernel has derivatives and lanes too.
        traced = [isinstance(x, Tracer) for x in jaxpr.consts]
        constants = [x for x, t in zip(jaxpr.consts, traced, strict=True) if t]

        def closed(*xs: Array) -> Arrays:
            given = iter(xs)
            consts = [next(given) if t else x for x, t in zip(jaxpr.consts, traced, strict=True)]
            return eval_jaxpr(jaxpr.jaxpr, consts, *given)

        return jax.tree.unflatten(tree[0], _differentiable(closed)(*constants, *arrays))


@functools.lru_cache(maxsize=256)
def _compiles(jitted: Jitted, leaves: tuple[jax.ShapeDtypeStruct, ...], tree: Any, settings: Settings) -> bool:
    return jitted.lower(*jax.tree.unflatten(tree, leaves)).compiler == settings.compiler == "llvm"


def compiles(jitted: Jitted, *args: PyTree) -> bool:
    """Whether our compiler makes one kernel of a call with arguments of these shapes (`jax.ShapeDtypeStruct`s), here and now."""
    if not one_kernel_enabled():
        return False
    leaves, tree = jax.tree.flatten(args)
    return _compiles(jitted, tuple(leaves), tree, current())


def _of_arrays(
    fn: Callable[..., Any], args: tuple[PyTree, ...], kwargs: dict[str, PyTree]
) -> tuple[Callable[..., Arrays], Arrays, list[Any]]:
    """`fn` as a function of the traced leaves of its arguments, these, and where the tree of its results will be."""
    leaves, treedef = jax.tree.flatten((args, kwargs))
    traced = [isinstance(x, Tracer) for x in leaves]
    tree: list[Any] = []

    def flat(*arrays: Array) -> Arrays:
        given = iter(arrays)
        args, kwargs = jax.tree.unflatten(
            treedef, [next(given) if t else x for x, t in zip(leaves, traced, strict=True)]
        )
        out, tree[:] = _flattened(fn(*args, **kwargs))
        return out

    return flat, [x for x, t in zip(leaves, traced, strict=True) if t], tree


def _flattened(tree: PyTree) -> tuple[Arrays, list[Any]]:
    leaves, treedef = jax.tree.flatten(tree)
    return leaves, [treedef]


def _differentiable(fn: Callable[..., Arrays]) -> Callable[..., Arrays]:
    """`fn` as one kernel, with its derivatives."""

    @jax.custom_jvp
    def call(*xs: Array) -> Arrays:
        return list(batched_alike(*_kernel(fn)(*xs)))

    @functools.partial(call.defjvp, symbolic_zeros=True)
    def _(xs: Sequence[Array], dxs: Sequence[Array]) -> Any:
        out = call(*xs)
        moving = [not isinstance(dx, jax.custom_derivatives.SymbolicZero) for dx in dxs]
        known = list(filter(is_inexact, out))
        push = derivative_map(lambda at: fn(*at), list(map(is_inexact, xs)), moving, len(known), _kernel)
        found = iter(push(xs, [dx for dx, m in zip(dxs, moving, strict=True) if m], known))
        return out, [next(found) if is_inexact(y) else zero_from_primal(y, symbolic_zeros=True) for y in out]

    return call


def _kernel(fn: Callable[..., Arrays]) -> Callable[..., Arrays]:
    """`fn`, of arrays and lists of them, as one kernel; its checks raise when that is done."""

    def call(*args: PyTree) -> Arrays:
        leaves, treedef = jax.tree.flatten(args)
        with without_mesh():
            jaxpr = jax.make_jaxpr(lambda *xs: fn(*jax.tree.unflatten(treedef, xs)))(*leaves)
            try:
                kernel, messages = checks_apart(expanded(jaxpr))
                results = called(kernel, leaves)
            except Unsupported:
                results = None
        return jaxpr_as_fun(jaxpr)(*leaves) if results is None else _raising(results, messages)

    return call


def _raising(out: Arrays, messages: tuple[str, ...]) -> Arrays:
    if not messages:
        return out
    *out, failed = out
    return eqx.branched_error_if(out, failed != 0, failed - 1, messages)
