"""What makes two sweeps the same: the function as it is traced, what it calls in Python, its numbers, the elements."""

import functools
import hashlib
import re
import types
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr
from jaxtyping import PyTree

from ..compiler.jaxprs.walk import equations, held_by


ADDRESS = re.compile(r"0x[0-9a-f]+")
# What a global may be that a function reads.
NUMBERS = (bool, int, float, complex, str, bytes, list, tuple, dict, np.ndarray, np.generic, jax.Array)


def fingerprint(fn: Callable[..., PyTree], one: PyTree, elements: PyTree, chunk: int) -> str:
    """A digest of all that results depend on; `one`: the shapes of an element."""
    closed = jax.make_jaxpr(fn)(one)
    found = hashlib.sha256(ADDRESS.sub("", str(closed)).encode())
    eqns = equations(closed)
    inner = (jaxpr for eqn in eqns for jaxpr in held_by(eqn))
    constants = [x for jaxpr in (closed, *inner) if isinstance(jaxpr, ClosedJaxpr) for x in jaxpr.consts]
    # What Python computes while the program runs stands in the jaxpr as an address.
    called = [eqn.params["callback"] for eqn in eqns if "callback" in eqn.params]
    for part in _parts([called, constants, jax.tree.leaves(elements)], {}):
        found.update(part)
    found.update(f"{chunk} {jax.__version__} {jnp.zeros(()).dtype}".encode())
    return found.hexdigest()


def _parts(x: Any, seen: dict[int, object]) -> Iterator[bytes]:
    """The numbers of arrays, the code of functions, what they close over and the globals that they read, the fields of objects, of
    other things what they print. `seen` keeps what it names by its address: another thing could have it later.
    """
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x = jax.random.key_data(x)
        x = np.asarray(x)
        yield f"{x.dtype}{x.shape}".encode() + x.tobytes()
    elif id(x) in seen:
        return
    elif isinstance(x, list | tuple | dict):
        seen[id(x)] = x
        yield f"{type(x).__name__}{len(x)}".encode()
        for item in x.items() if isinstance(x, dict) else x:
            yield from _parts(item, seen)
    elif isinstance(x, set | frozenset):
        # Their order is another one in each process.
        yield repr(sorted(ADDRESS.sub("", repr(item)) for item in x)).encode()
    elif isinstance(x, types.CodeType):
        yield x.co_code
        yield from _parts((x.co_names, x.co_consts), seen)
    elif isinstance(x, types.MethodType):
        yield from _parts((x.__func__, x.__self__), seen)
    elif isinstance(x, types.FunctionType):
        seen[id(x)] = x
        cells = [cell.cell_contents for cell in x.__closure__ or ()]
        read = map(x.__globals__.get, x.__code__.co_names)
        # Of functions those of the same module: a library's have caches.
        own = lambda value: getattr(value, "__globals__", None) is x.__globals__
        named = [value for value in read if isinstance(value, NUMBERS) or own(value)]
        yield from _parts((x.__code__, x.__defaults__ or (), x.__kwdefaults__ or {}, cells, named), seen)
    elif isinstance(x, functools.partial):
        yield from _parts((x.func, x.args, x.keywords), seen)
    elif callable(getattr(x, "callback_func", None)):
        yield from _parts(x.callback_func, seen)
    elif isinstance(getattr(x, "__wrapped__", None), types.FunctionType):
        yield from _parts(x.__wrapped__, seen)
    elif (fields := _fields(x)) is not None:
        seen[id(x)] = x
        yield repr(type(x)).encode()
        yield from _parts((vars(type(x)).get("__call__"), fields), seen)
    else:
        yield ADDRESS.sub("", repr(x)).encode()


def _fields(x: Any) -> dict[str, Any] | None:
    """What an object holds by names, in a dictionary of its own or in slots; `None` of what has neither."""
    slots = [name for of in type(x).__mro__ for name in vars(of).get("__slots__", ())]
    if isinstance(x, type | types.ModuleType) or not (slots or hasattr(x, "__dict__")):
        return None
    held = {name: getattr(x, name) for name in slots if name != "__dict__" and hasattr(x, name)}
    return held | getattr(x, "__dict__", {})
