"""A whole loop compiled into one kernel on XLA's CPU backend.

XLA:CPU runs a loop body as a sequence of kernels and pays for each launch; for scenes of a few bodies the launches cost
4 to 12 times the arithmetic. A computation marked `xla_cpu_small_call` is emitted as a single function instead. All
that it contains must then be plain arithmetic, so the jaxpr is looked at first.
"""

import contextlib
import contextvars
import math
import os
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax._src import xla_bridge
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from .jaxprs import equations, equations_in
from .subroutine import subroutine


# What XLA:CPU cannot emit inside a single function: library calls, host callbacks, collectives, sorts. What lineax's
# `linear_solve` does, and checks, shows only when it is compiled.
_REFUSED = frozenset(
    "all_gather all_to_all approx_top_k cholesky conv_general_dilated custom_call debug_callback eig eigh ffi_call "
    "fft geqrf hessenberg householder_product infeed io_callback linear_solve lu ormqr outfeed ppermute psum pure_callback qr "
    "random_gamma schur sort svd threefry2x32 top_k triangular_solve tridiagonal tridiagonal_solve".split()
)
_REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or".split())
SMALL_DOT = 64
LARGE_REDUCTION = 4096
_enabled: contextvars.ContextVar[bool] = contextvars.ContextVar("one_kernel", default=True)


def configure(*, one_kernel: bool | None = None, process_wide: bool = False) -> contextlib.ExitStack:
    """Settings of the compilation.

    - `one_kernel`: switches one-kernel compilation on or off, at once; used in a `with` statement, until its end.
    - `process_wide`: for programs that solve many small problems. Every small loop of the process is compiled to one
      kernel, also those of other libraries, and a computation runs in the thread that calls it, which saves the 10 to
      50 µs of handing it to another. Call it before JAX computes anything.

    Errors: `RuntimeError` where JAX has computed something before a process-wide setting.
    """
    restore = contextlib.ExitStack()
    if one_kernel is not None:
        restore.callback(_enabled.reset, _enabled.set(one_kernel))
    if process_wide:
        _configure_process()
    return restore


def _configure_process() -> None:
    if xla_bridge.backends_are_initialized():
        raise RuntimeError(
            "`configure(process_wide=True)` comes too late: JAX has started already. Call it right after the imports."
        )
    options = "xla_cpu_small_while_loop_byte_threshold=65536,xla_cpu_use_multi_output_fusion"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_extra_options={options}"
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def one_kernel_enabled() -> bool:
    """Whether solves that are traced now may become one kernel."""
    return _enabled.get()


def hindrances(jaxpr: ClosedJaxpr | Jaxpr) -> tuple[str, ...]:
    """The names of the primitives in `jaxpr`, at any depth, that keep it from being one kernel; empty if none does."""
    return tuple(dict.fromkeys(eqn.primitive.name for eqn in equations(jaxpr) if _hinders(eqn)))


def _hinders(eqn: Any) -> bool:
    name = eqn.primitive.name
    if eqn.effects:
        return True
    if name.startswith("scatter"):
        # A single window is a dynamic update; several, as under `vmap`, are a loop that cannot be emitted.
        return math.prod(eqn.invars[1].aval.shape[:-1]) > 1
    if name in _REDUCTIONS:
        # XLA may hand the reduction of a large matrix to a library.
        return eqn.invars[0].aval.size > LARGE_REDUCTION and eqn.outvars[0].aval.size > 1
    if name == "dot_general":
        # XLA writes out a small product; a larger one is a library call.
        (contracted, _), _ = eqn.params["dimension_numbers"]
        shape = eqn.invars[0].aval.shape
        return eqn.outvars[0].aval.size * math.prod(shape[i] for i in contracted) > SMALL_DOT
    return name in _REFUSED


def without_checks(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` without `equinox.error_if`: for conditions that the caller has looked at already."""

    def unchecked(*args: Any) -> Any:
        jaxpr, out = jax.make_jaxpr(fn, return_shape=True)(*args)
        results = _evaluate(jaxpr.jaxpr, jaxpr.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(out), results)

    return unchecked


def _evaluate(jaxpr: Jaxpr, consts: Any, args: Any) -> list[Any]:
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(v: Any) -> Any:
        return v.val if isinstance(v, jax.extend.core.Literal) else env[v]

    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, _results(eqn, [read(v) for v in eqn.invars]), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _results(eqn: Any, values: list[Any]) -> list[Any]:
    """What an equation gives, without the checks in it."""
    name = eqn.primitive.name
    if name in ("jit", "pjit", "custom_jvp_call", "cond") and any(map(_is_check, equations_in(eqn))):
        inner = _unchecked(eqn)
        if inner is not None:
            return _evaluate(inner.jaxpr, inner.consts, values[len(values) - len(inner.jaxpr.invars) :])
        if name == "cond":
            index, *operands = values
            branches = [lambda *xs, b=b: _evaluate(b.jaxpr, b.consts, xs) for b in eqn.params["branches"]]
            return jax.lax.switch(index, branches, *operands)
    results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return results if eqn.primitive.multiple_results else [results]


def _unchecked(eqn: Any) -> ClosedJaxpr | None:
    """What to run in place of a check, or of a call with checks in it; `None` for other equations."""
    name = eqn.primitive.name
    if name == "cond":
        branches = eqn.params["branches"]
        checked = [any(map(_is_check, b.jaxpr.eqns)) for b in branches]
        return branches[checked.index(False)] if any(checked) and not all(checked) else None
    if name in ("jit", "pjit"):
        return eqn.params["jaxpr"]
    if name == "custom_jvp_call" and any(map(_is_checking, eqn.params["call_jaxpr"].jaxpr.eqns)):
        return eqn.params["call_jaxpr"]
    return None


def _is_checking(eqn: Any) -> bool:
    return eqn.primitive.name == "cond" and _unchecked(eqn) is not None


def _is_check(eqn: Any) -> bool:
    if eqn.primitive.name != "pure_callback":
        return False
    callback = getattr(eqn.params["callback"], "callback_func", None)
    return getattr(callback, "__module__", None) == "equinox._errors"


PullBack = Callable[[Any, Any], list[Any]]


def one_kernel(
    fn: Callable[..., Any],
    derivative: Literal["forward", "reverse", "any"] = "any",
    pull_back: PullBack | None = None,
) -> Callable[..., Any]:
    """`fn` (pytrees of arrays to a pytree of arrays), compiled to one kernel on the CPU where it qualifies.

    On another backend, or where `hindrances` finds a reason, it is `fn` itself. Under `vmap` the batched function is
    looked at afresh. `derivative` says in which mode `fn` can be differentiated: its derivative is again one kernel
    where it qualifies; with "any" it is the plain `fn` throughout. `pull_back(args, cotangent)` gives the cotangents of
    those leaves of `args` that are inexact, where a better way than JAX's is known.
    """
    if not _enabled.get() or jax.default_backend() != "cpu" or derivative == "any":
        return fn
    return _forward(fn) if derivative == "forward" else _reverse(fn, pull_back or _plain_pull_back(fn))


def _plain_pull_back(fn: Callable[..., Any]) -> PullBack:
    def pull_back(args: Any, cotangent: Any) -> list[Any]:
        leaves, treedef = jax.tree.flatten(args)
        exact = [not jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in leaves]

        def of_inexact(*zs: Any) -> list[Any]:
            rest = iter(zs)
            merged = [x if e else next(rest) for e, x in zip(exact, leaves, strict=True)]
            return inexact(fn(*jax.tree.unflatten(treedef, merged)))

        return list(jax.vjp(of_inexact, *inexact(args))[1](inexact(cotangent)))

    return pull_back


def _reverse(fn: Callable[..., Any], pull_back: PullBack) -> Callable[..., Any]:
    def flat(*args: Any) -> Any:
        # The custom rule sees a flat list, so that integers can have no cotangent.
        leaves, treedef = jax.tree.flatten(args)

        @jax.custom_vjp
        def solve(*xs: Any) -> Any:
            return _fused(fn)(*jax.tree.unflatten(treedef, xs))

        def backward(xs: Any, cotangent: Any) -> tuple[Any, ...]:
            known = jax.tree.map(lambda c: None if c.dtype == jax.dtypes.float0 else c, cotangent)
            found = iter(_fused(pull_back)(jax.tree.unflatten(treedef, xs), known))
            return tuple(next(found) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else None for x in xs)

        solve.defvjp(lambda *xs: (solve(*xs), xs), backward)
        return solve(*leaves)

    return flat


def inexact(tree: Any) -> list[Any]:
    """The leaves that have derivatives."""
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]


def _forward(fn: Callable[..., Any]) -> Callable[..., Any]:
    @jax.custom_jvp
    def solve(*args: Any) -> Any:
        return _fused(fn)(*args)

    @solve.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        return _forward(lambda p, t: jax.jvp(fn, p, t))(primals, tangents)

    return solve


def _fused(fn: Callable[..., Any]) -> Callable[..., Any]:
    def traced(*args: Any) -> Any:
        jaxpr, out = jax.make_jaxpr(without_checks(fn), return_shape=True)(*args)
        return jax.tree.unflatten(jax.tree.structure(out), _call(jaxpr)(*jax.tree.leaves(args)))

    return traced


def _call(jaxpr: ClosedJaxpr, batched: bool = False) -> Callable[..., list[Any]]:
    @custom_vmap
    def call(*xs: Any) -> list[Any]:
        return _compile(jaxpr, xs, batched)

    @call.def_vmap
    def _(axis_size: int, is_batched: list[bool], *xs: Any) -> Any:
        return _batch(jaxpr, axis_size, is_batched, xs)

    return call


def _batch(jaxpr: ClosedJaxpr, size: int, is_batched: list[bool], xs: Any) -> tuple[list[Any], list[bool]]:
    """All lanes in step, where that can be one kernel or where a lane alone cannot; else one after another in one kernel,
    where none waits for another (10,000 double pendulums: 0.6 s in place of 8). A single lane, such as the one direction
    of a derivative by a number, is no batch.
    """
    axes = [0 if b else None for b in is_batched]
    kept: list[bool] = []

    def lane(*ys: Any) -> list[Any]:
        out = jaxpr_as_fun(jaxpr)(*ys)
        # `jacfwd` asks that a value which does not depend on the direction stays unbatched.
        kept[:] = [getattr(o, "batch_dim", None) is not None for o in out]
        return out

    in_step = jax.make_jaxpr(jax.vmap(lane, in_axes=axes, axis_size=size))(*xs)
    if size == 1:
        out = _call(jaxpr)(*(x[0] if b else x for x, b in zip(xs, is_batched, strict=True)))
        return [o[None] if v else o for o, v in zip(out, kept, strict=True)], list(kept)

    def in_turn(*ys: Any) -> list[Any]:
        lanes = tuple(y for y, b in zip(ys, is_batched, strict=True) if b)

        def one_lane(lane: Any) -> list[Any]:
            of_lane = iter(lane)
            return jaxpr_as_fun(jaxpr)(*(next(of_lane) if b else y for y, b in zip(ys, is_batched, strict=True)))

        return jax.lax.map(one_lane, lanes)

    if _qualifies(in_step, batched=True) or not _qualifies(jaxpr):
        out = _call(in_step, batched=True)(*xs)
    else:
        out = _call(jax.make_jaxpr(in_turn)(*xs))(*xs)
    return [o if v else o[0] for o, v in zip(out, kept, strict=True)], list(kept)


def _compile(jaxpr: ClosedJaxpr, args: Any, batched: bool) -> list[Any]:
    if not _qualifies(jaxpr, batched):
        return jax.jit(jaxpr_as_fun(jaxpr))(*args)
    # The kernel has nothing but a call in it: XLA aborts where one of its parameters is not the operand of anything.
    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return jax.jit(lambda *xs: subroutine(jaxpr_as_fun(jaxpr))(*xs))(*args)


def _qualifies(jaxpr: ClosedJaxpr, batched: bool = False) -> bool:
    # Of the scatters only the update of one row becomes a copy, and that for certain only where nothing is batched.
    return not hindrances(jaxpr) and not (
        batched and any(eqn.primitive.name.startswith("scatter") for eqn in equations(jaxpr))
    )
