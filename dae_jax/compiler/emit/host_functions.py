"""Functions of numpy arrays that machine code calls on the host, lane by lane."""

import ctypes
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..types import Aval


# The symbol by which machine code calls `run`.
HOST = "dae_jax_host_1"


@dataclasses.dataclass(frozen=True)
class _Numbers:
    """Arrays of one shape and type, one for each lane, as machine code has them: the numbers of all lanes side by side, and imaginary
    parts after all real ones.
    """

    shape: tuple[int, ...]
    dtype: np.dtype

    def at(self, address: int, width: int) -> np.ndarray:
        """The memory there of so many lanes, with the parts of numbers first and the lanes last."""
        parts, real = (2 if self.dtype.kind == "c" else 1), np.real(np.zeros((), self.dtype)).dtype
        shape = (parts, *self.shape, width)
        memory: Any = (ctypes.c_char * (math.prod(shape) * real.itemsize)).from_address(address)
        return np.frombuffer(memory, real).reshape(shape)

    def read(self, memory: np.ndarray, lane: int) -> np.ndarray:
        """The array of one lane."""
        real, *imaginary = memory[..., lane]
        return np.array(real + 1j * imaginary[0] if imaginary else real, self.dtype, order="C")

    def write(self, memory: np.ndarray, lane: int, x: Any) -> None:
        """Replaces the array of one lane."""
        for part, numbers in zip(memory, (np.real(x), np.imag(x)), strict=False):
            part[..., lane] = numbers


@dataclasses.dataclass(frozen=True)
class _Call:
    fn: Callable[..., Sequence[Any]]
    arguments: tuple[_Numbers, ...]
    results: tuple[_Numbers, ...]
    width: int

    def run(self, lanes: int, addresses: int) -> None:
        arrays, count = (*self.arguments, *self.results), len(self.arguments)
        places = (ctypes.c_int64 * len(arrays)).from_address(addresses)
        memory = [x.at(place, self.width) for x, place in zip(arrays, places, strict=True)]
        ins, outs = memory[:count], memory[count:]
        for lane in (k for k in range(self.width) if lanes >> k & 1):
            for x, memory in zip(self.results, outs, strict=True):
                x.write(memory, lane, np.nan if x.dtype.kind in "fc" else 0)
            found = self.fn(*(x.read(memory, lane) for x, memory in zip(self.arguments, ins, strict=True)))
            for x, memory, numbers in zip(self.results, outs, found, strict=True):
                x.write(memory, lane, numbers)


# By their places, which machine code has as numbers. They are kept: code that calls them may be run as long as the process lives.
_calls: list[_Call] = []
_places: dict[_Call, int] = {}


def place(fn: Callable[..., Sequence[Any]], ins: Sequence[Aval], outs: Sequence[Aval], width: int) -> int:
    """The number by which machine code of `width` lanes calls a function of arrays like these, the same for equal functions."""
    numbers = lambda avals: tuple(_Numbers(tuple(v.shape), np.dtype(v.dtype)) for v in avals)
    call = _Call(fn, numbers(ins), numbers(outs), width)
    if call not in _places:
        _calls.append(call)
        _places[call] = len(_calls) - 1
    return _places[call]


@ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
def run(place: int, lanes: int, addresses: int) -> None:
    """Calls function number `place` in the lanes whose bits are set; `addresses`: of the memory of the arguments, then of the
    results. One that raises leaves NaN.
    """
    _calls[place].run(lanes, addresses)
