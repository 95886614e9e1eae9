"""The types of numbers, as JAX names them and as LLVM does."""

import functools

import numpy as np

from ..types import Aval, DType


FLOATS = frozenset({"float32", "float64"})
SIGNED = frozenset({"int8", "int16", "int32", "int64"})
UNSIGNED = frozenset({"uint8", "uint16", "uint32", "uint64"})
COMPLEX = frozenset({"complex64", "complex128"})
BOOL = frozenset({"bool"})
INTEGERS = SIGNED | UNSIGNED
REALS = FLOATS | INTEGERS
NUMBERS = REALS | COMPLEX
ALL = NUMBERS | BOOL

_KINDS = {
    "float64": "double", "float32": "float", "bool": "i1", "int8": "i8", "uint8": "i8", "int16": "i16",
    "uint16": "i16", "int32": "i32", "uint32": "i32", "int64": "i64", "uint64": "i64",
}  # fmt: skip
BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}


@functools.cache
def kind_of(dtype: DType) -> str:
    """The LLVM type of a real number."""
    return _KINDS[np.dtype(dtype).name]


@functools.cache
def part(dtype: DType) -> np.dtype:
    """The type of the parts of a complex number; that of a real one."""
    dtype = np.dtype(dtype)
    return np.dtype(f"float{4 * dtype.itemsize}") if dtype.kind == "c" else dtype


@functools.cache
def parts_of(dtype: DType) -> tuple[str, int]:
    """The LLVM type of the parts of a number, and how many it has."""
    return kind_of(part(dtype)), 1 + (np.dtype(dtype).kind == "c")


def kinds_of(aval: Aval) -> list[str]:
    """The LLVM types of an array's numbers, two for a complex one."""
    kind, count = parts_of(aval.dtype)
    return [kind] * (count * aval.size)


def is_signed(dtype: DType) -> bool:
    """Whether it is one of signed integers."""
    return np.dtype(dtype).kind == "i"
