"""A whole loop compiled into one kernel on the CPU, with its derivatives.

XLA:CPU runs a loop body as a sequence of kernels and pays for each launch; for scenes of a few bodies the launches cost
4 to 12 times the arithmetic.
"""

import contextlib
import contextvars
import os
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax._src import xla_bridge

from .kernel_call import called
from .unchecked import without_checks


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
        # A kernel knows of no mesh; JAX would write down for each number that it lies on none.
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), args)
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            jaxpr, out = jax.make_jaxpr(without_checks(fn), return_shape=True)(*shapes)
        return jax.tree.unflatten(jax.tree.structure(out), called(jaxpr, jax.tree.leaves(args)))

    return traced
