"""Loops over arrays in memory: reading, writing, adding up.

With lanes a buffer holds the numbers of all lanes side by side, entry after entry.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..jaxprs.scalar_interpreter import is_number, objects
from .arithmetic import Arithmetic
from .arrays import SMALL, Buffer, Fused, View, row_major
from .instructions import BYTES, Complex, Value, parts, parts_of


# Bytes of a buffer that the stack holds; larger ones are taken from the heap, all at once.
ON_STACK = 1024
# A loop's body has no more entries written out than these.
WRITTEN_OUT = 4


class Memory(Arithmetic):
    """Instructions with arrays in memory."""

    def __init__(self, width: int = 1, always_copies: bool = False) -> None:
        super().__init__(width)
        self.always_copies = always_copies
        self.mask: Value | None = None
        # What is in memory stays there, unless it has fewer entries; with lanes each of them is a vector.
        self.few = 8 if width == 1 else SMALL
        self.stack: list[str] = []
        self.heap = 0
        self.free: dict[int, list[str]] = {}
        self.recycles = not always_copies
        self.longest = 0
        self.constants: list[str] = []

    # Integers that index

    def times(self, a: Any, b: Any) -> Any:
        if isinstance(a, int) and isinstance(b, int):
            return a * b
        if isinstance(a, int) or isinstance(b, int):
            number, value = (a, b) if isinstance(a, int) else (b, a)
            return 0 if number == 0 else value if number == 1 else self.op("mul", "i64", value, number)
        return self.op("mul", "i64", a, b)

    def plus(self, a: Any, b: Any) -> Any:
        if isinstance(a, int) and isinstance(b, int):
            return a + b
        return (
            b if isinstance(a, int) and a == 0 else a if isinstance(b, int) and b == 0 else self.op("add", "i64", a, b)
        )

    def at(self, view: View, index: Sequence[Any]) -> Any:
        """The place of an entry in the buffer."""
        place = view.offset
        for i, stride in zip(index, view.strides, strict=True):
            place = self.plus(place, self.times(i, stride))
        return place

    # One entry

    def _stored(self, buffer: Buffer) -> str:
        return "i8" if buffer.kind == "i1" else buffer.kind

    def _address(self, buffer: Buffer, place: Any) -> tuple[str, bool]:
        """The address of a number, or a vector of addresses (and whether it is one)."""
        stored = self._stored(buffer)
        each = isinstance(place, Value) and place.lanes
        if buffer.lanes:
            place = self.times(place, self.width)
            if each:
                lane = ", ".join(f"i64 {k}" for k in range(self.width))
                place = self.pure(f"add {self.type('i64', True)} {place.name}, <{lane}>", "i64", True)
        index = self.operand(place, "i64", each)
        out = self.pure(f"getelementptr {stored}, ptr {buffer.pointer}, {index}", "ptr", each)
        return out.name, each

    def load(self, buffer: Buffer, place: Any) -> Any:
        """A number."""
        if buffer.parts == 1:
            return self._load(buffer, place)
        return Complex(*(self._load(buffer, self._part(buffer, place, k)) for k in range(2)))

    def _part(self, buffer: Buffer, place: Any, k: int) -> Any:
        """Where the k-th part of a complex number is."""
        return self.plus(place, k * buffer.plane) if buffer.plane else self.plus(self.times(place, 2), k)

    def _load(self, buffer: Buffer, place: Any) -> Value:
        stored = self._stored(buffer)
        address, each = self._address(buffer, place)
        lanes = each or buffer.lanes
        vector = self.type(stored, lanes)
        if each:
            full = f"llvm.masked.gather.v{self.width}{_suffix(stored)}.v{self.width}p0"
            mask, pointers = self.type("i1", True), self.type("ptr", True)
            function = self.function(full, vector, pointers, mask, vector)
            active = self.text(self.mask, "i1", True) if self.mask else "splat (i1 true)"
            x = self.write(
                f"call {vector} {function}({pointers} align {BYTES[stored]} {address}, {mask} {active}, {vector} zeroinitializer)",
                stored, lanes,
            )  # fmt: skip
        else:
            x = self.write(f"load {vector}, ptr {address}, align {BYTES[stored]}", stored, lanes)
        return self.cast("trunc", x, "i1") if buffer.kind == "i1" else x

    def store(self, buffer: Buffer, place: Any, x: Any) -> None:
        """Stores a number, in the lanes that take part."""
        if buffer.parts == 1:
            self._store(buffer, place, x)
            return
        for k, part in enumerate(parts(x)):
            self._store(buffer, self._part(buffer, place, k), part)

    def _store(self, buffer: Buffer, place: Any, x: Any) -> None:
        stored = self._stored(buffer)
        if buffer.kind == "i1":
            x = self.cast("zext", x, "i8") if isinstance(x, Value) else np.int8(x)
        address, each = self._address(buffer, place)
        number = self.operand(x, stored, buffer.lanes or each)
        if not each and self.mask is None:
            self.lines.append(f"store {number}, ptr {address}, align {BYTES[stored]}")
            return
        vector, mask = self.type(stored, True), self.type("i1", True)
        to = self.type("ptr", True) if each else "ptr"
        name = "scatter" if each else "store"
        full = f"llvm.masked.{name}.v{self.width}{_suffix(stored)}.{f'v{self.width}' if each else ''}p0"
        function = self.function(full, "void", vector, to, mask)
        active = self.text(self.mask, "i1", True) if self.mask else "splat (i1 true)"
        self.lines.append(f"call void {function}({number}, {to} align {BYTES[stored]} {address}, {mask} {active})")

    # Loops

    def label(self, name: str) -> None:
        self.lines.append(f"{name}:")
        self.block = name

    def jump(self, name: str) -> None:
        self.lines.append(f"br label %{name}")

    @contextlib.contextmanager
    def loop(self, count: Any, phis: list[str] | None = None) -> Iterator[Value]:
        """Runs what is written inside for an index from 0 to `count`; `phis` are other variables of the loop."""
        head, body, after, index, following = (self.name() for _ in range(5))
        before = self.block
        self.longest = max(self.longest, count if isinstance(count, int) else 0)
        self.jump(head)
        self.label(head)
        here = len(self.lines)
        i = Value(f"%{index}", "i64")
        more = self.op("icmp slt", "i64", i, count, result="i1")
        self.lines.append(f"br i1 {more.name}, label %{body}, label %{after}")
        self.label(body)
        with self.scope():
            yield i
        self.lines.append(f"%{following} = add i64 %{index}, 1")
        own = f"%{index} = phi i64 [ 0, %{before} ], [ %{following}, %{self.block} ]"
        self.lines[here:here] = [own, *(phis or [])]
        self.jump(head)
        self.label(after)

    def for_each(self, shape: Sequence[int], action: Callable[[list[Any]], None], few: int = WRITTEN_OUT) -> None:
        """Does something with each index, in loops whose body has the last `few` written out."""
        outer, size = len(shape), 1
        while outer and size * shape[outer - 1] <= few:
            outer, size = outer - 1, size * shape[outer - 1]
        with contextlib.ExitStack() as stack:
            index = [0 if n == 1 else stack.enter_context(self.loop(n)) for n in shape[:outer]]
            for inner in np.ndindex(*shape[outer:]):
                action([*index, *inner])

    def accumulated(
        self,
        shape: Sequence[int],
        first: Sequence[Any],
        kinds: Sequence[str],
        step: Callable[[list[Any], list[Any]], Sequence[Any]],
    ) -> list[Any]:
        """What `step(found, index)` makes of the first numbers, index after index."""
        lanes = self.width > 1

        def over(index: list[Any], found: list[Any]) -> list[Any]:
            if len(index) == len(shape):
                return list(step(found, index))
            before, phis = self.block, []
            carried = [Value(f"%{self.name()}", kind, lanes) for kind in kinds]
            with self.loop(shape[len(index)], phis) as i:
                for x, y, z in zip(carried, found, over([*index, i], carried), strict=True):
                    start, after = (self.text(n, x.kind, lanes) for n in (y, z))
                    vector = self.type(x.kind, lanes)
                    phis.append(f"{x.name} = phi {vector} [ {start}, %{before} ], [ {after}, %{self.block} ]")
            return list(carried)

        found = [self.copy(x, kind) if lanes else x for x, kind in zip(first, kinds, strict=True)]
        return over([], [self.in_lanes(x) for x in found] if lanes else found)

    # Arrays

    def _buffer(self, dtype: np.dtype, size: int) -> Buffer:
        kind, parts = parts_of(dtype)
        plane, size = size, size * parts * BYTES[kind] * self.width
        free = self.free.get(size)
        if free:
            return Buffer(free.pop(), kind, self.width > 1, parts=parts, plane=plane, bytes=size)
        pointer = f"%{self.name()}"
        if size <= ON_STACK:
            self.stack.append(f"{pointer} = alloca [{size} x i8], align 64")
        else:
            self.stack.append(f"{pointer} = getelementptr i8, ptr %heap, i64 {self.heap}")
            self.heap += -(-size // 64) * 64 + 192
        return Buffer(pointer, kind, self.width > 1, parts=parts, plane=plane, bytes=size)

    def recycle(self, buffers: Iterable[Buffer]) -> None:
        """Memory that nothing needs any more is used again, while it is in the cache."""
        for buffer in buffers:
            if buffer.bytes and not buffer.references and not buffer.held and self.recycles:
                self.free.setdefault(buffer.bytes, []).append(buffer.pointer)
                buffer.bytes = 0

    def new(self, dtype: Any, shape: Sequence[int]) -> View:
        dtype = np.dtype(dtype)
        shape = tuple(shape)
        return View(dtype, shape, self._buffer(dtype, max(math.prod(shape), 1)), row_major(shape))

    def constant_view(self, x: np.ndarray) -> View:
        """A known array, as data of the module."""
        kind, parts = parts_of(x.dtype)
        stored = "i8" if kind == "i1" else kind
        name = f"@{{name}}.{self.name()}"
        numbers = np.ascontiguousarray(x).ravel()
        numbers = numbers.view(numbers.real.dtype) if parts == 2 else numbers
        texts = ", ".join(f"{stored} {self.text(y, kind) if kind != 'i1' else int(y)}" for y in numbers)
        self.constants.append(f"{name} = private constant [{len(numbers)} x {stored}] [{texts}], align 64")
        return View(x.dtype, x.shape, Buffer(name, kind, False, writable=False, parts=parts), row_major(x.shape))

    def entry(self, x: Any, index: Sequence[Any]) -> Any:
        """One entry of an array."""
        if isinstance(x, View):
            return self.load(x.buffer, self.at(x, index))
        return x.read(index) if isinstance(x, Fused) else x[tuple(index)] if x.ndim else x[()]

    def entries(self, x: Any) -> np.ndarray:
        """An array as entries."""
        if isinstance(x, np.ndarray):
            return x
        return objects([self.entry(x, i) for i in np.ndindex(x.shape)], x.shape)

    def flat(self, x: Any) -> Callable[[Any], Any] | None:
        """How an entry is read by its place in row-major order, where that is as simple as by its index."""
        if isinstance(x, View) and x.contiguous:
            return lambda place: self.load(x.buffer, self.plus(x.offset, place))
        if not isinstance(x, np.ndarray) and x.ndim == 1:
            return lambda place: self.entry(x, [place])
        return x.flat if isinstance(x, Fused) else None

    def memory(self, x: Any, dtype: Any) -> View:
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
        out = self.new(dtype, x.shape)
        with self.unmasked():
            for k, number in enumerate(numbers):
                self.store(out.buffer, k, number)
        return out

    def materialised(self, x: Any) -> Any:
        """An array whose entries are known from here on."""
        if not isinstance(x, Fused):
            return x
        return self.memory(x, x.dtype) if x.size > self.few else self.entries(x)

    @contextlib.contextmanager
    def unmasked(self) -> Iterator[None]:
        """All lanes take part: for memory that nothing else sees yet."""
        mask, self.mask = self.mask, None
        yield
        self.mask = mask

    def made(self, dtype: Any, shape: Sequence[int], entry: Callable[[list[Any]], Any]) -> View:
        """A new array, entry by entry."""
        return self.copied(Fused(np.dtype(dtype), tuple(shape), entry, ()), dtype)

    def copied(self, x: Any, dtype: Any) -> View:
        """A new array with the same entries."""
        out = self.new(dtype, x.shape)
        self.assign(out, x, fresh=True)
        return out

    def row(self, x: View, i: Any) -> View:
        """x[i]."""
        return View(x.dtype, x.shape[1:], x.buffer, x.strides[1:], self.at(x, [i, *[0] * (x.ndim - 1)]))

    def assign(self, to: View, x: Any, fresh: bool = False) -> None:
        """Copies the entries of `x`, in the lanes that take part; `fresh`: nothing else sees that memory yet."""

        def put(place: Any, number: Any) -> None:
            with self.unmasked() if fresh else contextlib.nullcontext():
                self.store(to.buffer, place, number)

        if isinstance(x, np.ndarray) and x.size > SMALL and all(map(is_number, x.ravel())):
            x = self.memory(x, to.dtype)
        flat = self.flat(x) if to.contiguous and len(to.shape) > 1 else None
        if flat:
            self.for_each([to.size], lambda i: put(self.plus(to.offset, i[0]), flat(i[0])))
        else:
            few = x.size if isinstance(x, np.ndarray) else WRITTEN_OUT
            self.for_each(x.shape, lambda index: put(self.at(to, index), self.entry(x, index)), few)


def _suffix(kind: str) -> str:
    return kind.replace("double", "f64").replace("float", "f32")
