"""All of JAX, XLA, equinox and llvmlite that the compiler leans on without being promised it.

Beside it XLA's interface for foreign functions, which has a version (`emit/interface.py`).
"""

import contextlib
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax._src import xla_bridge
from jax._src.core import eval_context as eval_context, trace_state_clean as trace_state_clean
from jax._src.interpreters.partial_eval import lower_jaxpr2
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array

from .types import Aval, Equation, Params


P = ParamSpec("P")
T = TypeVar("T")

# What JAX lets users forbid for their own code, and what it is by default.
_STRICT = {
    "jax_numpy_rank_promotion": ("allow",),
    "jax_numpy_dtype_promotion": ("standard",),
    "jax_transfer_guard_host_to_device": (None, "allow"),
    "jax_transfer_guard_device_to_host": (None, "allow"),
    "jax_transfer_guard_device_to_device": (None, "allow"),
}


def at_ease(fn: Callable[P, T]) -> Callable[P, T]:
    """`fn` by the default rules of JAX for promotion and transfers, whatever its caller has set for code of his own."""

    @functools.wraps(fn)
    def eased(*args: P.args, **kwargs: P.kwargs) -> T:
        if all(getattr(jax.config, name) in usual for name, usual in _STRICT.items()):
            return fn(*args, **kwargs)
        with (
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
            jax.transfer_guard("allow"),
        ):
            return fn(*args, **kwargs)

    return eased


def setting(name: str) -> bool:
    """One of JAX's settings by its name, which type checkers do not know."""
    return getattr(jax.config, name)


def backends_are_initialised() -> bool:
    """Whether JAX has chosen its devices, so that flags of XLA come too late."""
    return xla_bridge.backends_are_initialized()


def evaluated_now() -> contextlib.AbstractContextManager[Any]:
    """What is computed here is computed now, also where a user's function is being traced. Where none is, JAX's own context would only
    evaluate the constants of what is traced here one by one, each by a program of its own.
    """
    return contextlib.nullcontext() if trace_state_clean() else jax.ensure_compile_time_eval()


@functools.cache
def accepted_options(options: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    """Those of XLA's options that this version knows."""

    def accepts(name: str, value: Any) -> bool:
        try:
            jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
        except (RuntimeError, ValueError):
            return False
        return True

    return {name: value for name, value in options if accepts(name, value)}


def compilation_cache_folder() -> str | None:
    """The folder of JAX's compilation cache, where it is on and on this machine's file system."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder or "://" in folder or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    return folder


def low(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same function without primitives that are made of others, as which JAX 0.12 has `searchsorted`."""
    return lower_jaxpr2(closed) if getattr(closed, "is_high", False) else closed


def varying_alike(args: Sequence[Array]) -> list[Array]:
    """Arguments of a primitive, which within `jax.shard_map` vary from device to device all of them if one does, and are said to."""
    over = frozenset().union(*(jax.typeof(x).mat.varying for x in args))
    lacks = (over - jax.typeof(x).mat.varying for x in args)
    return [jax.lax.pcast(x, tuple(axes), to="varying") if axes else x for x, axes in zip(args, lacks, strict=True)]


def as_varying(aval: ShapedArray, like: ShapedArray) -> ShapedArray:
    """The type of a result, which varies from device to device as an argument does."""
    if not like.mat.varying:
        return aval
    whole = NamedSharding(like.sharding.mesh, PartitionSpec(*[None] * aval.ndim))
    return aval.update(sharding=whole, manual_axis_type=like.mat)


def scan_counts(params: Params) -> tuple[int, int]:
    """How many operands of a `scan` are the same at each turn, and how many it carries; from JAX 0.11 on two trees say so."""
    if "ft_in" in params:
        consts, carry, _ = map(len, params["ft_in"].unpack())
        return consts, carry
    return params["num_consts"], params["num_carry"]


def is_check(eqn: Equation) -> bool:
    """Whether an equation is the call that raises in `equinox.error_if`."""
    return (
        eqn.primitive.name == "pure_callback"
        and getattr(callback_function(eqn), "__module__", None) == "equinox._errors"
    )


def callback_function(eqn: Equation) -> Any:
    """The function of a `pure_callback`."""
    return getattr(eqn.params["callback"], "callback_func", None)


def is_key(aval: Aval) -> bool:
    """Whether an array is one of random keys."""
    dtype = getattr(aval, "dtype", bool)
    return not isinstance(dtype, np.dtype | type) and jax.numpy.issubdtype(dtype, jax.dtypes.prng_key)


def key_functions(dtype: Any) -> Any:
    """The generator of a type of keys: its `key_shape`, `seed`, `split`, `fold_in`, `random_bits`, of the numbers of a key."""
    return dtype._impl


def check_messages(eqn: Equation) -> list[str] | None:
    """The messages of such a call, one of which it raises, by its only operand; `None` where they are not found."""
    messages = inspect.getclosurevars(eqn.params["callback"].callback_func).nonlocals.get("msgs")
    return list(messages) if messages is not None and len(eqn.invars) == 1 else None


def without_lock(function: Any) -> Any:
    """A function of LLVM's without the lock by which llvmlite lets one thread at a time into LLVM. It may work on a module in a context
    of its own while other threads work on theirs.
    """
    return getattr(function, "_cfn", function)
