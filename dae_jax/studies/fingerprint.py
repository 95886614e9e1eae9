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
    """The numbers of arrays, the code of functions and what they close over, the fields of objects, of other things what they
    print. `seen` keeps what it names by its address: another thing could have it later.
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
        yield from _parts((x.__code__, x.__defaults__ or (), x.__kwdefaults__ or {}, cells), seen)
    elif isinstance(x, functools.partial):
        yield from _parts((x.func, x.args, x.keywords), seen)
    elif callable(getattr(x, "callback_func", None)):
        yield from _parts(x.callback_func, seen)
    elif isinstance(getattr(x, "__wrapped__", None), types.FunctionType):
        yield from _parts(x.__wrapped__, seen)
    elif hasattr(x, "__dict__") and not isinstance(x, type | types.ModuleType):
        seen[id(x)] = x
        yield repr(type(x)).encode()
        yield from _parts((vars(type(x)).get("__call__"), vars(x)), seen)
    else:
        yield ADDRESS.sub("", repr(x)).encode()
