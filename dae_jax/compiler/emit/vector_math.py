"""The C library's functions, for numbers and for vectors; none is called that was not looked up."""

import ctypes
import functools
from typing import Any

from .target import host, llvm


@functools.cache
def has_symbol(name: str) -> bool:
    """Whether the process has a function of the C library by this name."""
    return hasattr(ctypes.CDLL(None), name)


@functools.cache
def _vector_library() -> Any:
    try:
        library = ctypes.CDLL("libmvec.so.1")
    except OSError:
        return None
    llvm().load_library_permanently("libmvec.so.1")
    return library


def vector_function(name: str, arguments: int) -> str | None:
    """The C library's function of this name for vectors of doubles, right to a few units in the last place."""
    target = host()
    if target.vector_abi is None:
        return None
    full = f"_ZGV{target.vector_abi}N{target.width}{'v' * arguments}_{name}"
    return full if hasattr(_vector_library(), full) else None
