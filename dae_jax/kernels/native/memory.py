"""Arrays in memory: strided views of buffers, and loops over them.

With lanes a buffer holds the numbers of all lanes side by side, entry after entry. A buffer that nothing else refers to
is updated in place.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..entries import NotEntryByEntry, objects
from .arithmetic import Arithmetic
from .instructions import BYTES, Complex, Value, kind_of


# Bytes of a buffer that the stack holds; larger ones are taken from the heap, all at once.
ON_STACK = 1024


@dataclasses.dataclass(eq=False)
class Buffer:
    """Memory for numbers of one type. `references` counts the variables that hold a view of it."""

    pointer: str
    kind: str
    lanes: bool
    writable: bool = True
    references: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """Entry i is number offset + i·strides of the buffer."""

    buffer: Buffer
    dtype: np.dtype
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: Any = 0

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def contiguous(self) -> bool:
        return self.strides == row_major(self.shape)

    @property
    def whole(self) -> bool:
        """Whether the entries are those of the buffer, in order."""
        return self.contiguous and isinstance(self.offset, int) and self.offset == 0


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    """The strides of an array whose last index runs fastest."""
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


class Memory(Arithmetic):
    """Instructions with arrays in memory."""

    def __init__(self, width: int = 1) -> None:
        super().__init__(width)
        self.mask: Value | None = None
        self.stack: list[str] = []
        self.heap = 0
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

    def load(self, buffer: Buffer, place: Any) -> Value:
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

    @contextlib.contextmanager
    def each(self, shape: Sequence[int]) -> Iterator[list[Any]]:
        """The indices of an array, one after another."""
        with contextlib.ExitStack() as stack:
            yield [0 if n == 1 else stack.enter_context(self.loop(n)) for n in shape]

    # Arrays

    def buffer(self, kind: str, size: int) -> Buffer:
        """New memory."""
        if kind not in BYTES:
            raise NotEntryByEntry(kind)
        size *= BYTES[kind] * self.width
        pointer = f"%{self.name()}"
        if size <= ON_STACK:
            self.stack.append(f"{pointer} = alloca [{size} x i8], align 64")
        else:
            self.stack.append(f"{pointer} = getelementptr i8, ptr %heap, i64 {self.heap}")
            self.heap += -(-size // 64) * 64
        return Buffer(pointer, kind, self.width > 1)

    def new(self, dtype: Any, shape: Sequence[int]) -> View:
        dtype = np.dtype(dtype)
        shape = tuple(shape)
        return View(self.buffer(kind_of(dtype), max(math.prod(shape), 1)), dtype, shape, row_major(shape))

    def constant_view(self, x: np.ndarray) -> View:
        """A known array, as data of the module."""
        kind = kind_of(x.dtype)
        stored = "i8" if kind == "i1" else kind
        name = f"@{{name}}.{self.name()}"
        numbers = ", ".join(
            f"{stored} {self.text(y, kind) if kind != 'i1' else int(y)}" for y in np.ascontiguousarray(x).ravel()
        )
        self.constants.append(f"{name} = private constant [{x.size} x {stored}] [{numbers}], align 64")
        return View(Buffer(name, kind, False, writable=False), x.dtype, x.shape, row_major(x.shape))

    def entry(self, x: Any, index: Sequence[Any]) -> Any:
        """One entry of an array."""
        if isinstance(x, View):
            return self.load(x.buffer, self.at(x, index))
        return x[tuple(index)] if x.ndim else x[()]

    def entries(self, x: Any) -> np.ndarray:
        """An array as entries."""
        if isinstance(x, np.ndarray):
            return x
        return objects([self.entry(x, i) for i in np.ndindex(x.shape)], x.shape)

    def memory(self, x: Any, dtype: Any) -> View:
        """An array in memory."""
        if isinstance(x, View):
            return x
        out = self.new(dtype, x.shape)
        with self.unmasked():
            for k, number in enumerate(x.ravel()):
                self._real(number)
                self.store(out.buffer, k, number)
        return out

    def _real(self, x: Any) -> None:
        if isinstance(x, Complex) or np.iscomplexobj(x):
            raise NotEntryByEntry("large arrays of complex numbers")

    @contextlib.contextmanager
    def unmasked(self) -> Iterator[None]:
        """All lanes take part: for memory that nothing else sees yet."""
        mask, self.mask = self.mask, None
        yield
        self.mask = mask

    def made(self, dtype: Any, shape: Sequence[int], entry: Callable[[list[Any]], Any]) -> View:
        """A new array, entry by entry."""
        out = self.new(dtype, shape)
        with self.each(shape) as index:
            x = entry(index)
            self._real(x)
            with self.unmasked():
                self.store(out.buffer, self.at(out, index), x)
        return out

    def copied(self, x: Any, dtype: Any) -> View:
        """A new array with the same entries."""
        if isinstance(x, np.ndarray):
            return self.memory(x, dtype)
        return self.made(dtype, x.shape, lambda index: self.entry(x, index))

    def row(self, x: View, i: Any) -> View:
        """x[i]."""
        return View(x.buffer, x.dtype, x.shape[1:], x.strides[1:], self.at(x, [i, *[0] * (x.ndim - 1)]))

    def assign(self, to: View, x: View) -> None:
        """Copies the entries of `x`, in the lanes that take part."""
        if isinstance(x, np.ndarray):
            for index in np.ndindex(x.shape):
                self.store(to.buffer, self.at(to, index), x[index])
            return
        with self.each(x.shape) as index:
            self.store(to.buffer, self.at(to, index), self.entry(x, index))


def _suffix(kind: str) -> str:
    return kind.replace("double", "f64").replace("float", "f32")
