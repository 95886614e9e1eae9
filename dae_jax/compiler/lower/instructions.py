"""Arithmetic on single numbers as LLVM instructions, for one element or for several lanes at once.

A number is a `Value`, the name of a result, or a numpy scalar where it is known. With `width` lanes a value is a vector
that holds one number of each lane, or a single number that is the same for all.
"""

import contextlib
import struct
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any

import numpy as np

from ..emit.target import Target, vector_size
from ..emit.vector_math import vector_function
from .values import Complex, Index, Number, Run, Value, parts


class Instructions:
    """A function's instructions, written one after another; `mask` says which lanes take part, all where it is `None`."""

    def __init__(self, width: int = 1, prefix: str = "", target: Target | None = None) -> None:
        self.width, self.target = width, target
        self._of_library = target.library if target else ""
        self._prefix = f"{prefix}v"
        self.mask: Value | None = None
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.block = "entry"
        # The turns of the longest loop over an array.
        self.longest = 0
        self._count = 0
        # What has been written, by its text: in the function, and in each scope that is open.
        self._known: list[dict[Hashable, Any]] = [{}]
        self._scaled: dict[str, tuple[Value, float]] = {}
        # The names of floats whose sign bit is 0, also if they are NaN.
        self.without_sign: set[str] = set()

    # Text

    def name(self) -> str:
        self._count += 1
        return f"{self._prefix}{self._count}"

    def type(self, kind: str, lanes: bool) -> str:
        return f"<{self.width} x {kind}>" if lanes else kind

    def write(self, text: str, kind: str, lanes: bool) -> Value:
        """Appends an instruction with a result."""
        name = f"%{self.name()}"
        self.lines.append(f"{name} = {text}")
        return Value(name, kind, lanes)

    def pure(self, text: str, kind: str, lanes: bool) -> Value:
        """An instruction whose result its operands decide: written once."""
        return self.once(text, lambda: self.write(text, kind, lanes))

    def once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """What `make` writes, where that has not been written in a scope that is open."""
        for known in self._known:
            if key in known:
                return known[key]
        found = self._known[-1][key] = make()
        return found

    @contextlib.contextmanager
    def scope(self) -> Iterator[None]:
        """Instructions that may not be run: what is written here is not known afterwards."""
        self._known.append({})
        yield
        self._known.pop()

    def text(self, x: Number, kind: str, lanes: bool = False) -> str:
        """An operand without its type."""
        if isinstance(x, Value):
            return self.in_lanes(x).name if lanes else x.name
        if isinstance(x, Complex | complex | np.complexfloating):
            raise TypeError("a complex number where a real one is written")
        if kind == "double" or kind == "float":
            literal = f"0x{struct.pack('>d', float(x)).hex().upper()}"
        else:
            literal = ("true" if x else "false") if kind == "i1" else str(int(x))
        return f"splat ({kind} {literal})" if lanes else literal

    def operand(self, x: Number, kind: str, lanes: bool = False) -> str:
        """An operand with its type."""
        return f"{self.type(kind, lanes)} {self.text(x, kind, lanes)}"

    def in_lanes(self, x: Value) -> Value:
        """The same number in each lane."""
        if x.lanes:
            return x
        vector = self.type(x.kind, True)
        one = self.pure(f"insertelement {vector} poison, {x.kind} {x.name}, i64 0", x.kind, True)
        return self.pure(
            f"shufflevector {vector} {one.name}, {vector} poison, <{self.width} x i32> zeroinitializer", x.kind, True
        )

    def lane(self, x: Number, kind: str, k: int) -> Any:
        """The number of one lane."""
        if not isinstance(x, Value) or not x.lanes:
            return x
        return self.pure(f"extractelement {self.type(kind, True)} {x.name}, i64 {k}", kind, False)

    def of_lanes(self, kind: str, numbers: Iterable[Number]) -> Value:
        """One number for each lane."""
        vector = "poison"
        out = None
        for k, number in enumerate(numbers):
            out = self.write(
                f"insertelement {self.type(kind, True)} {vector}, {self.operand(number, kind)}, i64 {k}", kind, True
            )
            vector = out.name
        assert out is not None
        return out

    def function(self, name: str, result: str, *kinds: str) -> str:
        """A function of LLVM or of the C library, declared."""
        self.declared[name] = f"declare {result} @{name}({', '.join(kinds)})"
        return f"@{name}"

    # Blocks

    def label(self, name: str) -> None:
        """A block begins."""
        self.lines.append(f"{name}:")
        self.block = name

    def jump(self, name: str, in_order: bool = False) -> None:
        """A block ends, and the one of this name comes next; `in_order`: of a loop that LLVM makes none of vectors."""
        self.lines.append(f"br label %{name}{', !llvm.loop !0' if in_order else ''}")

    def branch(self, condition: Value, yes: str, no: str) -> None:
        """A block ends, and one of two comes next."""
        self.lines.append(f"br i1 {condition.name}, label %{yes}, label %{no}")

    @contextlib.contextmanager
    def unmasked(self) -> Iterator[None]:
        """All lanes take part: for memory that nothing else sees yet."""
        mask, self.mask = self.mask, None
        yield
        self.mask = mask

    # Instructions

    def _in_lanes(self, xs: Iterable[Number]) -> bool:
        """Whether any of the operands differs from lane to lane."""
        if self.width > 1:
            for x in xs:
                if isinstance(x, Value) and x.lanes:
                    return True
        return False

    def op(self, code: str, kind: str, *xs: Number, result: str | None = None) -> Value:
        """An instruction whose operands have one type."""
        lanes = self._in_lanes(xs)
        texts = [self.text(x, kind, lanes) for x in xs]
        if code.partition(" ")[0] in ("fadd", "fmul"):
            texts.sort()
        return self.pure(f"{code} {self.type(kind, lanes)} {', '.join(texts)}", result or kind, lanes)

    def scaled(self, x: Value, factor: float, kind: str) -> Value:
        """x times a power of two, and x itself for x/2 + x/2."""
        base, before = self._scaled.get(x.name, (x, 1.0))
        factor *= before
        if factor == 1:
            return base
        out = self.op("fmul contract", kind, base, factor)
        self._scaled[out.name] = base, factor
        return out

    def intrinsic(self, name: str, kind: str, *xs: Number) -> Value:
        lanes = self._in_lanes(xs)
        vector = self.type(kind, lanes)
        suffix = kind.replace("double", "f64").replace("float", "f32")
        full = f"llvm.{name}.{f'v{self.width}' if lanes else ''}{suffix}"
        function = self.function(full, vector, *[vector] * len(xs))
        return self.pure(
            f"call {vector} {function}({', '.join(self.operand(x, kind, lanes) for x in xs)})", kind, lanes
        )

    def library(self, name: str, kind: str, *xs: Number) -> Value:
        """A function of the C library, lane by lane where it has none for vectors."""
        name = name if kind == "double" else f"{name}f"
        function = self.function(f"{self._of_library}{name}", kind, *[kind] * len(xs))
        call = lambda ys: self.pure(
            f"call {kind} {function}({', '.join(self.operand(y, kind) for y in ys)})", kind, False
        )
        if not self._in_lanes(xs):
            return call(xs)
        many = vector_function(name, len(xs)) if kind == "double" else None
        if many is not None:
            return self._by_vectors(many, kind, xs)
        return self.of_lanes(kind, [call([self.lane(x, kind, k) for x in xs]) for k in range(self.width)])

    def _by_vectors(self, name: str, kind: str, xs: tuple[Number, ...]) -> Value:
        """A function for vectors of the machine's size."""
        size = vector_size()
        vector = f"<{size} x {kind}>"
        function = self.function(name, vector, *[vector] * len(xs))
        whole, out = self.type(kind, True), ""
        for first in range(0, self.width, size):
            lanes = f"<{size} x i32> <{', '.join(f'i32 {first + k}' for k in range(size))}>"
            parts = [
                self.pure(f"shufflevector {self.operand(x, kind, True)}, {whole} poison, {lanes}", kind, True)
                for x in xs
            ]
            found = self.pure(f"call {vector} {function}({', '.join(f'{vector} {x.name}' for x in parts)})", kind, True)
            if size == self.width:
                return found
            places = [str(k - first) if first <= k < first + size else "poison" for k in range(self.width)]
            wide = f"<{self.width} x i32> <{', '.join(f'i32 {k}' for k in places)}>"
            there = self.pure(f"shufflevector {vector} {found.name}, {vector} poison, {wide}", kind, True).name
            if out:
                kept = ", ".join(f"i32 {k + self.width if k >= first else k}" for k in range(self.width))
                there = self.pure(
                    f"shufflevector {whole} {out}, {whole} {there}, <{self.width} x i32> <{kept}>", kind, True
                ).name
            out = there
        return Value(out, kind, True)

    def any(self, x: Value) -> Value:
        """Whether a condition holds in any lane."""
        if not x.lanes:
            return x
        vector = self.type("i1", True)
        function = self.function(f"llvm.vector.reduce.or.v{self.width}i1", "i1", vector)
        return self.pure(f"call i1 {function}({vector} {x.name})", "i1", False)

    def select(self, condition: Number, yes: Number, no: Number, kind: str) -> Any:
        if yes is no:
            return yes
        if any(isinstance(x, Complex | np.complexfloating) for x in (yes, no)):
            (a, b), (c, d) = parts(yes), parts(no)
            return Complex(self.select(condition, a, c, kind), self.select(condition, b, d, kind))
        if not isinstance(condition, Value):
            return yes if condition else no
        lanes = self._in_lanes((condition, yes, no))
        which = self.operand(condition, "i1", condition.lanes)
        return self.pure(
            f"select {which}, {self.operand(yes, kind, lanes)}, {self.operand(no, kind, lanes)}", kind, lanes
        )

    def times(self, a: Index, b: Index) -> Any:
        """The product of two indices."""
        if isinstance(a, int) and isinstance(b, int):
            return a * b
        if isinstance(a, int) or isinstance(b, int):
            number, value = (a, b) if isinstance(a, int) else (b, a)
            return 0 if number == 0 else value if number == 1 else self.op("mul", "i64", value, number)
        return self.op("mul", "i64", a, b)

    def plus(self, a: Index, b: Index) -> Any:
        """The sum of two indices."""
        if isinstance(a, int) and isinstance(b, int):
            return a + b
        if isinstance(a, int) and a == 0:
            return b
        if isinstance(b, int) and b == 0:
            return a
        for run, by in ((a, b), (b, a)):
            if isinstance(run, Run) and not (isinstance(by, Value) and by.lanes):
                return Run(self, self.plus(run.base, by))
        return self.op("add", "i64", a, b)

    def copy(self, x: Number, kind: str) -> Value:
        """A value in any case."""
        return x if isinstance(x, Value) else Value(self.text(x, kind), kind)

    def cast(self, code: str, x: Value, kind: str, joined: bool = False) -> Value:
        """A number as one of another type; `joined`: the bits of all lanes as one number."""
        to = self.type(kind, x.lanes and not joined)
        return self.pure(f"{code} {self.type(x.kind, x.lanes)} {x.name} to {to}", kind, x.lanes and not joined)
