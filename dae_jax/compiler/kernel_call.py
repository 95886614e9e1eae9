"""A traced function that is compiled to one kernel, as a primitive.

What the kernel is made with is decided when the program that calls it is compiled, since until then a `vmap` may come:
our own compiler where it can, else XLA's single kernels, else XLA as it is. A batch becomes lanes of vectors.
"""

import collections
import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import batching, mlir
from jaxtyping import Array, PyTree

from . import fallbacks, lower, waiting, xla_kernel
from ._compat import as_varying, at_ease, dce_jaxpr, setting, varying_alike
from .check import checked
from .emit.target import Target
from .jaxprs.equal_functions import content
from .jaxprs.expansions import expanded, kernel_written_out
from .jaxprs.scalar_interpreter import Unsupported
from .jaxprs.unchecked import checks_dropped
from .on_gpu import gpu
from .settings import current


# Functions that were traced last, by what they compute; in any thread.
KEPT = 8
_last: collections.OrderedDict[Any, tuple[ClosedJaxpr, ClosedJaxpr]] = collections.OrderedDict()

kernel_p = Primitive("one_kernel")
kernel_p.multiple_results = True


@dataclasses.dataclass(frozen=True)
class Decision:
    """Who compiles a function, and what our compiler does not take of it.

    `compiler`: "llvm", our compiler, as one kernel; "xla kernel", XLA as one kernel; "xla", XLA as many.
    """

    compiler: str
    unsupported: tuple[Unsupported, ...]


def decision(jaxpr: ClosedJaxpr, batched: Sequence[bool] = ()) -> Decision:
    """Who compiles a function on JAX's default device, and all that our compiler does not take of it; `batched`: of a batch, in which
    these arguments have a leading axis.
    """
    try:
        kernel, used = _needed(jaxpr)
    except Unsupported as reason:
        return Decision("xla", (reason,))
    kept = tuple(b for b, u in zip(batched, used, strict=True) if u) if batched else ()
    return _decided(kernel, kept, jax.default_backend() == "gpu", lower.unsupported)


def unsupported(jaxpr: ClosedJaxpr) -> tuple[str, ...]:
    """The names of the primitives in `jaxpr`, at any depth, that keep it from being one kernel; empty if none does."""
    found = decision(jaxpr)
    return tuple(dict.fromkeys(x.primitive for x in found.unsupported)) if found.compiler == "xla" else ()


def hindrances(jaxpr: ClosedJaxpr) -> tuple[str, ...]:
    """The former name of `unsupported`."""
    warnings.warn("`compiler.hindrances` is called `compiler.unsupported` now.", DeprecationWarning, stacklevel=2)
    return unsupported(jaxpr)


def _first(kernel: ClosedJaxpr, batched: tuple[bool, ...], target: Target | None) -> tuple[Unsupported, ...]:
    judged = lower.annotate(kernel, batched, target)
    return (judged,) if isinstance(judged, Unsupported) else ()


def _decided(
    kernel: ClosedJaxpr,
    batched: tuple[bool, ...],
    on_gpu: bool = False,
    look: Callable[..., tuple[Unsupported, ...]] = _first,
) -> Decision:
    """`look`: finds the first of what our compiler does not take, or all of it."""
    if current().compiler != "llvm":
        found = (Unsupported(f"our compiler is switched off: `compiler={current().compiler!r}`"),)
    elif on_gpu and gpu() is None:
        found = (Unsupported("there is no GPU that kernels work on", primitive="system"),)
    else:
        found = look(kernel, batched, gpu() if on_gpu else None)
    if not found:
        return Decision("llvm", ())
    # XLA's single kernels are the CPU's; which form of a batch it takes depends on its size.
    by_xla = not on_gpu and current().compiler != "off" and not xla_kernel.unsupported(kernel)
    return Decision("xla kernel" if by_xla else "xla", found)


@functools.lru_cache(maxsize=KEPT)
def _needed(jaxpr: ClosedJaxpr) -> tuple[ClosedJaxpr, list[bool]]:
    """A function as it is compiled to a kernel, and which of its arguments that has."""
    # Tangents of integers are no numbers. XLA aborts where a parameter of a kernel is not used.
    known = [v.aval.dtype != jax.dtypes.float0 for v in jaxpr.jaxpr.outvars]
    needed, used = dce_jaxpr(jaxpr.jaxpr, known)
    return expanded(ClosedJaxpr(needed, jaxpr.consts), checks=False), used


def as_kernel(fn: Callable[..., Any], often: bool = True) -> Callable[..., Any]:
    """`fn` (pytrees of arrays to a pytree of arrays) as one kernel where it can be one; it has no derivative then. `often`: whether more
    than a look at a result, for which a large kernel is compiled in the least time.
    """
    known: dict[Any, Any] = {}

    def traced(*args: PyTree) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        shapes = tuple(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves)
        jaxpr, out = known.get((treedef, shapes)) or _traced(fn, jax.tree.unflatten(treedef, shapes))
        if not any(isinstance(x, Tracer) for x in jaxpr.consts):
            known[treedef, shapes] = jaxpr, out
        results = called(jaxpr, leaves, often)
        return jax.tree.unflatten(out, jax.jit(jaxpr_as_fun(jaxpr))(*leaves) if results is None else results)

    return traced


def _traced(fn: Callable[..., Any], shapes: PyTree) -> tuple[ClosedJaxpr, Any]:
    """The jaxpr, and the tree of the results."""
    with without_mesh():
        jaxpr, out = jax.make_jaxpr(fn, return_shape=True)(*shapes)
        return _recent(jaxpr), jax.tree.structure(out)


def _recent(jaxpr: ClosedJaxpr) -> ClosedJaxpr:
    """A traced function without the checks of its caller: the same object for those of the last that were equal, as which a solve within
    a derivative is one with the solve alone: what is found of it is found once.
    """
    if any(isinstance(x, Tracer) for x in jaxpr.consts):
        return checks_dropped(jaxpr)
    key = content(jaxpr)
    # What was traced first is kept: its parts are known by where they are.
    traced, found = _last.pop(key, None) or (jaxpr, checks_dropped(jaxpr))
    _last[key] = traced, found
    while len(_last) > KEPT:
        _last.popitem(last=False)
    return found


def without_mesh() -> AbstractContextManager[Any]:
    """A kernel knows of no mesh; JAX would write down for each number that it lies on none."""
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ()))


def called(jaxpr: ClosedJaxpr, args: Sequence[Array], often: bool = True) -> list[Any] | None:
    """The results of a traced function as one kernel; `None` where it cannot be one."""
    outvars = jaxpr.jaxpr.outvars
    known = [v.aval.dtype != jax.dtypes.float0 for v in outvars]
    if jaxpr.effects or any(isinstance(x, Tracer) for x in jaxpr.consts):
        return None
    try:
        kernel, used = _needed(jaxpr)
    except Unsupported:
        return None
    if _decided(kernel, ()).compiler == "xla":
        return None
    numbers = iter(_bind(kernel, (), [x for x, u in zip(args, used, strict=True) if u], often))
    return [
        next(numbers) if k else np.zeros(v.aval.shape, jax.dtypes.float0) for v, k in zip(outvars, known, strict=True)
    ]


def _bind(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], args: Sequence[Array], often: bool) -> list[Any]:
    return kernel_p.bind(*varying_alike(args), jaxpr=jaxpr, batched=batched, often=often)


@kernel_p.def_impl
def _(*args: Array, **params: Any) -> Any:
    # JAX looks for what is not a number by calling a function without compiling it, again where that compiles.
    if any(map(setting, ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs"))):
        return kernel_written_out(*args, **params)
    return jax.jit(lambda *xs: kernel_p.bind(*xs, **params))(*args)


@kernel_p.def_abstract_eval
def _(*args: Any, jaxpr: ClosedJaxpr, batched: tuple[bool, ...], **_: bool) -> Any:
    lead = next(((x.shape[0],) for x, b in zip(args, batched or [False] * len(args), strict=True) if b), ())
    found = [v.aval.update(shape=(*lead, *v.aval.shape)) for v in jaxpr.jaxpr.outvars]
    return [as_varying(aval, args[0]) for aval in found] if args else found


@at_ease
def _lower(*args: Array, jaxpr: ClosedJaxpr, batched: tuple[bool, ...], often: bool, on_gpu: bool) -> list[Any]:
    began = waiting.begin()
    try:
        return _lowered(args, jaxpr, batched, often, on_gpu)
    finally:
        if began:
            waiting.end()


def _lowered(
    args: Sequence[Array], jaxpr: ClosedJaxpr, batched: tuple[bool, ...], often: bool, on_gpu: bool
) -> list[Any]:
    ours = _by_llvm(jaxpr, batched, args, often, on_gpu)
    if ours is None:
        return kernel_written_out(*args, jaxpr=jaxpr, batched=batched) if on_gpu else _by_xla(jaxpr, batched, args)
    if current().check:
        return checked(
            ours, jax.jit(lambda *xs: kernel_written_out(*xs, jaxpr=jaxpr, batched=batched))(*args), current().check
        )
    return ours


def _by_llvm(
    jaxpr: ClosedJaxpr, batched: tuple[bool, ...], args: Sequence[Array], often: bool, on_gpu: bool
) -> list[Any] | None:
    if _decided(jaxpr, batched, on_gpu).compiler != "llvm":
        return None
    try:
        return lower.compiled(jaxpr, batched, target=gpu() if on_gpu else None, often=often or bool(batched))(*args)
    except Unsupported as reason:
        fallbacks.note(str(reason))
    except Exception as error:  # XLA can still do it
        fallbacks.note(repr(error))
        warnings.warn(f"A kernel is left to XLA, please report it: {error!r}", RuntimeWarning, stacklevel=2)
    return None


def _by_xla(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], args: Sequence[Array]) -> list[Any]:
    if not batched:
        return xla_kernel.compiled(jaxpr)(*args)
    axes = [0 if b else None for b in batched]
    in_step = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(jaxpr), in_axes=axes))(*args)
    if xla_kernel.qualifies(in_step, batched=True) or not xla_kernel.qualifies(jaxpr):
        return xla_kernel.compiled(in_step, batched=True)(*args)
    # One lane after another in one kernel: none waits for another.
    return xla_kernel.compiled(jax.make_jaxpr(lambda *xs: _in_turn(jaxpr, batched, xs))(*args))(*args)


def _in_turn(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], args: Sequence[Array]) -> list[Any]:
    def one_lane(lane: Sequence[Array]) -> list[Any]:
        of_lane = iter(lane)
        return jaxpr_as_fun(jaxpr)(*(next(of_lane) if b else x for x, b in zip(args, batched, strict=True)))

    return jax.lax.map(one_lane, tuple(x for x, b in zip(args, batched, strict=True) if b))


for _platform in ("cpu", "cuda"):
    _here = functools.partial(_lower, on_gpu=_platform == "cuda")
    mlir.register_lowering(kernel_p, mlir.lower_fun(_here, multiple_results=True), platform=_platform)
mlir.register_lowering(kernel_p, mlir.lower_fun(kernel_written_out, multiple_results=True))


@at_ease
def _batch(
    args: Sequence[Array], dims: Sequence[int | None], *, jaxpr: ClosedJaxpr, batched: tuple[bool, ...], often: bool
) -> tuple[list[Any], list[Any]]:
    mapped = [d is not None for d in dims]
    args = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]
    size = next(x.shape[0] for x, b in zip(args, mapped, strict=True) if b)
    # `jacfwd` asks that a value which does not depend on the direction stays unbatched.
    differs = lower.varying(jaxpr, mapped, in_memory=False)
    if size == 1:  # the one direction of a derivative by a number
        out = _bind(jaxpr, batched, [x[0] if b else x for x, b in zip(args, mapped, strict=True)], often)
        out = [o[None] for o in out]
    elif not batched:
        out = _bind(jaxpr, tuple(mapped), args, often)
    else:
        inner = next(x.shape[b] for x, b, of in zip(args, mapped, batched, strict=True) if of)
        joined = tuple(map(max, mapped, batched))
        flat = [_joined(x, size, inner, b, of) for x, b, of in zip(args, mapped, batched, strict=True)]
        out = [o.reshape(size, inner, *o.shape[1:]) for o in _bind(jaxpr, joined, flat, often)]
    return [o if d else o[0] for o, d in zip(out, differs, strict=True)], [0 if d else None for d in differs]


def _joined(x: Array, outer: int, inner: int, is_outer: bool, is_inner: bool) -> Any:
    """Two batch axes as one."""
    if not (is_outer or is_inner):
        return x
    own = x.shape[is_outer + is_inner :]
    x = x.reshape(outer if is_outer else 1, inner if is_inner else 1, *own)
    return jnp.broadcast_to(x, (outer, inner, *own)).reshape(outer * inner, *own)


batching.primitive_batchers[kernel_p] = _batch
