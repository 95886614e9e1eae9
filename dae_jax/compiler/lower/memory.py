"""Arrays in memory: made, read entry by entry, copied, let go."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from ..jaxprs.objects import is_number, objects
from ..thresholds import THRESHOLDS
from ..types import DType
from .access import load, store
from .arrays import Buffer, Fused, Operand, View, row_major
from .blocks import for_each, for_each_in_vectors
from .dtypes import BYTES, parts_of
from .instructions import Instructions
from .values import Index, Number


# A byte as LLVM has it in a string, which it reads faster than numbers one by one.
_ESCAPED = np.array([f"\\{byte:02X}" for byte in range(256)], "S3")


class Memory:
    """A function's arrays; `heap` is how many bytes of them are not on the stack; `stack` and `on_heap` find them.

    With a thread for each element, `room` is how many bytes of the largest each has in a buffer that they share; `in_room`
    finds these.
    """

    def __init__(self, code: Instructions, always_copies: bool = False) -> None:
        self.code = code
        self.always_copies = always_copies
        # What is in memory stays there, unless it has fewer entries; with lanes each of them is a vector.
        self.few = THRESHOLDS.few if code.width == 1 else THRESHOLDS.carried
        self.stack: list[str] = []
        self.on_heap: list[str] = []
        self.heap = 0
        self.in_room: list[str] = []
        self.room = 0
        self.free: dict[tuple[int, int], list[str]] = {}
        self.recycles = not always_copies
        # Names of what is known, by its text: the same numbers are there once.
        self.constants: dict[str, str] = {}

    def at(self, view: View, index: Sequence[Index]) -> Any:
        """The place of an entry in the buffer."""
        place = view.offset
        for i, stride in zip(index, view.strides, strict=True):
            place = self.code.plus(place, self.code.times(i, stride))
        return place

    def _buffer(self, dtype: np.dtype, size: int) -> Buffer:
        kind, parts = parts_of(dtype)
        plane, size = size, size * parts * BYTES[kind] * self.code.width
        threads = self.code.target is not None and self.code.target.threads
        apart = BYTES[kind] if threads and size > THRESHOLDS.thread_bytes else 0
        free = self.free.get((size, apart))
        pointer = free.pop() if free else self._new(size, kind, apart)
        return Buffer(pointer, kind, self.code.width > 1, parts=parts, plane=plane, bytes=size, apart=apart)

    def _new(self, size: int, kind: str, apart: int) -> str:
        pointer = f"%{self.code.name()}"
        if apart:
            self.in_room += [
                f"{pointer}.at = mul i64 %threads, {self.room}",
                f"{pointer}.all = getelementptr i8, ptr %room, i64 {pointer}.at",
                f"{pointer} = getelementptr {'i8' if kind == 'i1' else kind}, ptr {pointer}.all, i64 %first",
            ]
            self.room += -(-size // 64) * 64
        elif size <= THRESHOLDS.stack_bytes:
            self.stack.append(f"{pointer} = alloca [{size} x i8], align 64")
        else:
            self.on_heap.append(f"{pointer} = getelementptr i8, ptr %heap, i64 {self.heap}")
            self.heap += -(-size // 64) * 64 + 192
        return pointer

    def recycle(self, buffers: Iterable[Buffer]) -> None:
        """Memory that nothing needs any more is used again, while it is in the cache."""
        for buffer in buffers:
            if buffer.bytes and not buffer.references and not buffer.held and self.recycles:
                self.free.setdefault((buffer.bytes, buffer.apart), []).append(buffer.pointer)
                buffer.bytes = 0

    def new(self, dtype: DType, shape: Sequence[int]) -> View:
        dtype = np.dtype(dtype)
        shape = tuple(shape)
        return View(dtype, shape, self._buffer(dtype, max(math.prod(shape), 1)), row_major(shape))

    def constant_view(self, x: np.ndarray) -> View:
        """A known array, as data of the module."""
        kind, parts = parts_of(x.dtype)
        numbers = np.frombuffer(np.ascontiguousarray(x).tobytes(), np.uint8)
        text = f'private constant [{len(numbers)} x i8] c"{_ESCAPED[numbers].tobytes().decode()}", align 64'
        name = self.constants.setdefault(text, f"@{{name}}.{self.code.name()}")
        return View(x.dtype, x.shape, Buffer(name, kind, False, writable=False, parts=parts), row_major(x.shape))

    def entry(self, x: Operand, index: Sequence[Index]) -> Any:
        """One entry of an array."""
        if isinstance(x, View):
            return load(self.code, x.buffer, self.at(x, index))
        known: Any = tuple(index)
        return x.read(index) if isinstance(x, Fused) else x[known] if x.ndim else x[()]

    def entries(self, x: Operand) -> np.ndarray:
        """An array as entries."""
        if isinstance(x, np.ndarray):
            return x
        return objects([self.entry(x, i) for i in np.ndindex(x.shape)], x.shape)

    def number(self, x: Operand) -> Any:
        """An array's only entry."""
        return self.entries(x)[()]

    def flat(self, x: Operand) -> Callable[[Any], Any] | None:
        """How an entry is read by its place in row-major order, where that is as simple as by its index."""
        if isinstance(x, View) and x.contiguous:
            return lambda place: load(self.code, x.buffer, self.code.plus(x.offset, place))
        if not isinstance(x, np.ndarray) and x.ndim == 1:
            return lambda place: self.entry(x, [place])
        return x.flat if isinstance(x, Fused) else None

    def view(self, x: Operand, dtype: DType) -> View:
        """An array in memory."""
        if isinstance(x, View):
            return x
        if isinstance(x, Fused):
            return self.copied(x, x.dtype)
        numbers = list(x.ravel())
        if numbers and all(map(is_number, numbers)):
            known = np.array(numbers, dtype).reshape(x.shape)
            if known.tobytes() != known.size * known.ravel()[:1].tobytes():
                return self.constant_view(known)
            return dataclasses.replace(self.constant_view(known.ravel()[:1]), shape=x.shape, strides=(0,) * x.ndim)
        if len(numbers) <= THRESHOLDS.carried:
            return self._stored(x, dtype)
        return self.code.once((dtype, x.shape, *map(id, numbers)), lambda: self._kept(x, dtype))[0]

    def _kept(self, x: np.ndarray, dtype: DType) -> tuple[View, np.ndarray]:
        """Entries in memory that stays as it is, and the entries, which are known by their place."""
        out = self._stored(x, dtype)
        out.buffer.references += 1
        return out, x

    def _stored(self, x: np.ndarray, dtype: DType) -> View:
        once = _without_repeats(x)
        out = self.new(dtype, once.shape)
        with self.code.unmasked():
            for k, number in enumerate(once.ravel()):
                store(self.code, out.buffer, k, number)
        strides = tuple(s if n == m else 0 for s, n, m in zip(out.strides, once.shape, x.shape, strict=True))
        return dataclasses.replace(out, shape=x.shape, strides=strides)

    def materialised(self, x: Operand) -> Any:
        """An array whose entries are known from here on."""
        if not isinstance(x, Fused):
            return x
        return self.view(x, x.dtype) if x.size > self.few else self.entries(x)

    def made(self, dtype: DType, shape: Sequence[int], entry: Callable[[Sequence[Index]], Number]) -> View:
        """A new array, entry by entry."""
        return self.copied(Fused(np.dtype(dtype), tuple(shape), entry, ()), dtype)

    def copied(self, x: Operand, dtype: DType) -> View:
        """A new array with the same entries."""
        out = self.new(dtype, x.shape)
        self.assign(out, x, fresh=True)
        return out

    def own(self, x: Operand, dtype: DType) -> View:
        """The array if nothing else refers to it, else a copy."""
        if isinstance(x, View) and x.buffer.writable and not x.buffer.references and x.whole and not self.always_copies:
            return x
        return self.copied(x, dtype)

    def row(self, x: View, i: Index) -> View:
        """x[i]."""
        return View(x.dtype, x.shape[1:], x.buffer, x.strides[1:], self.at(x, [i, *[0] * (x.ndim - 1)]))

    def assign(self, to: View, x: Operand, fresh: bool = False) -> None:
        """Copies the entries of `x`, in the lanes that take part; `fresh`: nothing else sees that memory yet."""

        def put(place: Index, number: Number) -> None:
            with self.code.unmasked() if fresh else contextlib.nullcontext():
                store(self.code, to.buffer, place, number)

        if isinstance(x, np.ndarray) and x.size > THRESHOLDS.carried and all(map(is_number, x.ravel())):
            x = self.view(x, to.dtype)
        flat = self.flat(x) if to.contiguous and len(to.shape) > 1 else None
        if flat:
            shape, few = (to.size,), THRESHOLDS.per_turn
            one = lambda index: put(self.code.plus(to.offset, index[0]), flat(index[0]))
        else:
            shape, few = x.shape, x.size if isinstance(x, np.ndarray) else THRESHOLDS.per_turn
            one = lambda index: put(self.at(to, index), self.entry(x, index))
        if self._in_vectors(to, x, shape):
            for_each_in_vectors(self.code, shape, one)
        else:
            for_each(self.code, shape, one, few)

    def _in_vectors(self, to: View, x: Operand, shape: Sequence[int]) -> bool:
        """Whether entries that follow one another may be computed at once, and the last of them twice."""
        follow_one_another = bool(shape) and shape[-1] >= THRESHOLDS.vectors[-1] and to.strides[-1] == 1
        apart = not isinstance(x, np.ndarray) and to.buffer not in x.buffers
        threads = self.code.target is not None and self.code.target.threads
        return self.code.width == 1 and follow_one_another and apart and not threads and to.buffer.parts == 1


def _without_repeats(x: np.ndarray) -> np.ndarray:
    """Entries without those that a broadcast has repeated: of length 1 along an axis along which all are the same."""
    for axis in (k for k, n in enumerate(x.shape) if n > 1):
        first = x.take([0], axis)
        if all(a is b for a, b in np.broadcast(x, first)):
            x = first
    return x
