"""Arithmetic on single numbers as LLVM instructions, for one element or for several lanes at once.

A number is a `Value`, the name of a result, or a numpy scalar where it is known. With `width` lanes a value is a vector
that holds one number of each lane, or a single number that is the same for all.
"""

import contextlib
import dataclasses
import math
import struct
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ..entries import NotEntryByEntry
from .machine import has_symbol, vector_function, vector_size


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Value:
    """The result of an instruction: its name, the LLVM type of one number, and whether each lane has its own."""

    name: str
    kind: str
    lanes: bool = False


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Complex:
    """A complex number in two."""

    real: Any
    imag: Any


KINDS = {
    "float64": "double", "float32": "float", "bool": "i1", "int8": "i8", "uint8": "i8", "int16": "i16",
    "uint16": "i16", "int32": "i32", "uint32": "i32", "int64": "i64", "uint64": "i64",
    "complex64": "", "complex128": "",
}  # fmt: skip
_BITS = {"double": "i64", "float": "i32"}
BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}

_OF_FLOATS = {"add": "fadd contract", "sub": "fsub contract", "mul": "fmul contract", "div": "fdiv", "rem": "frem"}
_OF_INTEGERS = {
    "add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor", "shift_left": "shl",
    "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr",
}  # fmt: skip
_COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil"}
_ROOTS = {0.5: 1, 0.25: 2, 0.125: 3}
_LIBRARY = frozenset(
    "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p pow cbrt erf erfc atan2".split()
)


def kind_of(dtype: Any) -> str:
    """The LLVM type of a number."""
    kind = KINDS.get(np.dtype(dtype).name)
    if not kind:
        raise NotEntryByEntry(str(dtype))
    return kind


def _signed(dtype: Any) -> bool:
    return np.dtype(dtype).kind == "i"


class Instructions:
    """A function's instructions, written one after another."""

    def __init__(self, width: int = 1) -> None:
        self.width = width
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.block = "entry"
        self._count = 0
        self._known: ChainMap[str, Value] = ChainMap()
        self._scaled: dict[str, tuple[Value, float]] = {}

    # Text

    def name(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def type(self, kind: str, lanes: bool) -> str:
        return f"<{self.width} x {kind}>" if lanes else kind

    def write(self, text: str, kind: str, lanes: bool) -> Value:
        """Appends an instruction with a result."""
        name = f"%{self.name()}"
        self.lines.append(f"{name} = {text}")
        return Value(name, kind, lanes)

    def pure(self, text: str, kind: str, lanes: bool) -> Value:
        """An instruction whose result its operands decide: written once."""
        found = self._known.get(text)
        if found is None:
            found = self._known[text] = self.write(text, kind, lanes)
        return found

    @contextlib.contextmanager
    def scope(self) -> Iterator[None]:
        """Instructions that may not be run: what is written here is not known afterwards."""
        self._known = self._known.new_child()
        yield
        self._known = self._known.parents

    def text(self, x: Any, kind: str, lanes: bool = False) -> str:
        """An operand without its type."""
        if isinstance(x, Value):
            return self.in_lanes(x).name if lanes else x.name
        if kind == "double" or kind == "float":
            literal = f"0x{struct.pack('>d', float(x)).hex().upper()}"
        else:
            literal = ("true" if x else "false") if kind == "i1" else str(int(x))
        return f"splat ({kind} {literal})" if lanes else literal

    def operand(self, x: Any, kind: str, lanes: bool = False) -> str:
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

    def lane(self, x: Any, kind: str, k: int) -> Any:
        """The number of one lane."""
        if not isinstance(x, Value) or not x.lanes:
            return x
        return self.pure(f"extractelement {self.type(kind, True)} {x.name}, i64 {k}", kind, False)

    def of_lanes(self, kind: str, numbers: Iterable[Any]) -> Value:
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

    # Instructions

    def op(self, code: str, kind: str, *xs: Any, result: str | None = None) -> Value:
        """An instruction whose operands have one type."""
        lanes = any(isinstance(x, Value) and x.lanes for x in xs)
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

    def intrinsic(self, name: str, kind: str, *xs: Any) -> Value:
        lanes = any(isinstance(x, Value) and x.lanes for x in xs)
        vector = self.type(kind, lanes)
        suffix = kind.replace("double", "f64").replace("float", "f32")
        full = f"llvm.{name}.{f'v{self.width}' if lanes else ''}{suffix}"
        function = self.function(full, vector, *[vector] * len(xs))
        return self.pure(
            f"call {vector} {function}({', '.join(self.operand(x, kind, lanes) for x in xs)})", kind, lanes
        )

    def library(self, name: str, kind: str, *xs: Any) -> Value:
        """A function of the C library, lane by lane where it has none for vectors."""
        name = name if kind == "double" else f"{name}f"
        if not has_symbol(name):
            raise NotEntryByEntry(name)
        function = self.function(name, kind, *[kind] * len(xs))
        call = lambda ys: self.pure(
            f"call {kind} {function}({', '.join(self.operand(y, kind) for y in ys)})", kind, False
        )
        if not any(isinstance(x, Value) and x.lanes for x in xs):
            return call(xs)
        many = vector_function(name, len(xs)) if kind == "double" else None
        if many is not None:
            return self._by_vectors(many, kind, xs)
        return self.of_lanes(kind, [call([self.lane(x, kind, k) for x in xs]) for k in range(self.width)])

    def _by_vectors(self, name: str, kind: str, xs: tuple[Any, ...]) -> Value:
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

    def select(self, condition: Any, yes: Any, no: Any, kind: str) -> Any:
        if yes is no:
            return yes
        if isinstance(yes, Complex) or isinstance(no, Complex):
            (a, b), (c, d) = parts(yes), parts(no)
            return Complex(self.select(condition, a, c, kind), self.select(condition, b, d, kind))
        if not isinstance(condition, Value):
            return yes if condition else no
        lanes = any(isinstance(x, Value) and x.lanes for x in (condition, yes, no))
        which = self.operand(condition, "i1", condition.lanes)
        return self.pure(
            f"select {which}, {self.operand(yes, kind, lanes)}, {self.operand(no, kind, lanes)}", kind, lanes
        )

    # Primitives of JAX

    def apply(self, eqn: Any, x: list[Any]) -> Any:
        """An elementwise primitive."""
        name, params = eqn.primitive.name, eqn.params
        dtype, to = np.dtype(eqn.invars[-1].aval.dtype), np.dtype(eqn.outvars[0].aval.dtype)
        if name == "convert_element_type":
            return self.convert(x[0], dtype, to)
        if name == "select_n":
            return self._chosen(x, eqn.invars[0].aval.dtype, kind_of(_part(to)))
        if name in ("real", "imag"):
            return getattr(x[0], name)
        if name == "complex":
            return Complex(*x)
        if dtype.kind == "c":
            return self._complex(name, x, kind_of(_part(dtype)), params)
        kind = kind_of(dtype)
        if name in _COMPARISONS:
            return self.compare(name, dtype, *x)
        if name == "integer_pow":
            return self._power(x[0], params["y"], lambda a, b: self.arithmetic("mul", dtype, a, b), dtype)
        if name == "square":
            return self.arithmetic("mul", dtype, x[0], x[0])
        if name == "clamp":
            low, y, high = x
            return self.arithmetic("min", dtype, self.arithmetic("max", dtype, y, low), high)
        if dtype.kind == "f":
            return self._of_float(name, x, kind, params)
        if name == "not":
            return self.op("xor", kind, x[0], dtype.type(True if kind == "i1" else -1))
        if name == "sign" and _signed(dtype):
            return self.intrinsic("smax", kind, self.intrinsic("smin", kind, x[0], 1), -1)
        if name == "abs" and _signed(dtype):
            return self.intrinsic("smax", kind, x[0], self.op("sub", kind, 0, x[0]))
        return self.arithmetic(name, dtype, *x)

    def arithmetic(self, name: str, dtype: Any, *x: Any) -> Value:
        """`add`, `sub`, `mul`, `div`, `rem`, `max`, `min` and bitwise operations of real numbers."""
        dtype = np.dtype(dtype)
        kind = kind_of(dtype)
        if name in ("max", "min"):
            if kind == "i1":
                return self.op("or" if name == "max" else "and", kind, *x)
            prefix = "" if dtype.kind == "f" else "s" if _signed(dtype) else "u"
            return self.intrinsic({"": name + "imum"}.get(prefix, prefix + name), kind, *x)
        if dtype.kind == "f" and name in _OF_FLOATS:
            return self._of_floats(name, kind, *x)
        if dtype.kind != "f" and name in ("div", "rem"):
            return self._quotient(name, dtype, kind, *x)
        if dtype.kind == "f" or name not in _OF_INTEGERS:
            raise NotEntryByEntry(name)
        return self.op(_OF_INTEGERS[name], kind, *x)

    def _of_floats(self, name: str, kind: str, a: Any, b: Any) -> Value:
        if name == "add" and a is b and isinstance(a, Value):
            return self.scaled(a, 2.0, kind)
        if name in ("mul", "div"):
            value, number = (b, a) if name == "mul" and isinstance(b, Value) else (a, b)
            if isinstance(value, Value) and not isinstance(number, Value) and _is_power_of_two(number):
                return self.scaled(value, float(number) if name == "mul" else 1 / float(number), kind)
        return self.op(_OF_FLOATS[name], kind, a, b)

    def compare(self, name: str, dtype: Any, a: Any, b: Any) -> Value:
        dtype = np.dtype(dtype)
        code = _COMPARISONS[name]
        if dtype.kind == "f":
            return self.op(f"fcmp {code}", kind_of(dtype), a, b, result="i1")
        signed = "" if name in ("eq", "ne") else "s" if _signed(dtype) else "u"
        return self.op(f"icmp {signed}{name}", kind_of(dtype), a, b, result="i1")

    def _quotient(self, name: str, dtype: np.dtype, kind: str, a: Any, b: Any) -> Value:
        # The processor traps at x/0 and at −2^(n−1)/−1; XLA gives −1 (x for the remainder) and the number itself (0).
        harmless = self.select(
            self.op("or", "i1", self.compare("eq", dtype, b, 0), self.compare("eq", dtype, b, -1)), 1, b, kind
        ) if isinstance(b, Value) or b in (0, -1) else b  # fmt: skip
        prefix = "s" if _signed(dtype) else "u"
        out = self.op(f"{prefix}{name}", kind, a, harmless)
        if harmless is b:
            return out
        if _signed(dtype):
            by_minus = self.op("sub", kind, 0, a) if name == "div" else dtype.type(0)
            out = self.select(self.compare("eq", dtype, b, -1), by_minus, out, kind)
        return self.select(self.compare("eq", dtype, b, 0), -1 if name == "div" else a, out, kind)

    def _of_float(self, name: str, x: list[Any], kind: str, params: Any) -> Value:
        if name in _INTRINSICS:
            return self.intrinsic(_INTRINSICS[name], kind, *x)
        if name == "pow" and not isinstance(x[1], Value) and x[1] in _ROOTS:
            return self._root(x[0], _ROOTS[x[1]], kind)
        if name in _LIBRARY:
            return self.library(name, kind, *x)
        match name:
            case "neg":
                return self.op("fneg", kind, x[0])
            case "rsqrt":
                return self.op("fdiv", kind, 1.0, self.intrinsic("sqrt", kind, x[0]))
            case "logistic":
                grown = self.library("exp", kind, self.op("fneg", kind, x[0]))
                return self.op("fdiv", kind, 1.0, self.op("fadd", kind, 1.0, grown))
            case "round":
                return self.intrinsic("round" if int(params["rounding_method"]) == 0 else "roundeven", kind, x[0])
            case "is_finite":
                size = self.intrinsic("fabs", kind, x[0])
                return self.op("fcmp olt", kind, size, np.inf, result="i1")
            case "sign":
                unit = self.intrinsic("copysign", kind, 1.0, x[0])
                return self.select(self.op("fcmp one", kind, x[0], 0.0, result="i1"), unit, x[0], kind)
            case "nextafter":
                return self._next_after(kind, *x)
        return self.arithmetic(name, "float64" if kind == "double" else "float32", *x)

    def _root(self, x: Any, times: int, kind: str) -> Value:
        """The square root of the square root …; of −0 and −∞ as a power has it."""
        x = self.select(self.op("fcmp oeq", kind, x, -np.inf, result="i1"), np.inf, x, kind)
        x = self.op("fadd", kind, x, 0.0)
        for _ in range(times):
            x = self.intrinsic("sqrt", kind, x)
        return x

    def _next_after(self, kind: str, x: Any, y: Any) -> Value:
        integer = _BITS[kind]
        x, y = (self.copy(z, kind) for z in (x, y))
        bits = self.cast("bitcast", x, integer)
        away = self.op("xor", "i1", *(self.op("fcmp olt", kind, a, b, result="i1") for a, b in ((x, y), (0.0, x))))
        step = self.select(away, -1, 1, integer)
        moved = self.cast("bitcast", self.op("add", integer, bits, step), kind)
        least = self.cast("bitcast", Value("1", integer), kind)
        moved = self.select(
            self.op("fcmp oeq", kind, x, 0.0, result="i1"), self.intrinsic("copysign", kind, least, y), moved, kind
        )
        same = self.op("fcmp oeq", kind, x, y, result="i1")
        undefined = self.op("fcmp uno", kind, x, y, result="i1")
        return self.select(undefined, self.op("fadd", kind, x, y), self.select(same, y, moved, kind), kind)

    def copy(self, x: Any, kind: str) -> Value:
        """A value in any case."""
        return x if isinstance(x, Value) else Value(self.text(x, kind), kind)

    def cast(self, code: str, x: Value, kind: str, joined: bool = False) -> Value:
        """A number as one of another type; `joined`: the bits of all lanes as one number."""
        lanes = x.lanes and not joined
        return self.pure(f"{code} {self.type(x.kind, x.lanes)} {x.name} to {self.type(kind, lanes)}", kind, lanes)

    def convert(self, x: Any, dtype: np.dtype, to: np.dtype) -> Any:
        if to.kind == "c":
            half, (real, imag) = _part(to), parts(x)
            return Complex(self.convert(real, _part(dtype), half), self.convert(imag, _part(dtype), half))
        if dtype.kind == "c":
            return self.convert(parts(x)[0], _part(dtype), to)
        if not isinstance(x, Value):
            return to.type(x)
        a, b = kind_of(dtype), kind_of(to)
        if a == b:
            return x
        if b == "i1":
            return self.compare("ne", dtype, x, 0)
        if dtype.kind == "f" and to.kind == "f":
            return self.cast("fptrunc" if BYTES[b] < BYTES[a] else "fpext", x, b)
        if dtype.kind == "f":
            prefix = "fptosi" if _signed(to) else "fptoui"
            names = [f"v{self.width}{n}" if x.lanes else n for n in (b, {"double": "f64", "float": "f32"}[a])]
            result, operand = self.type(b, x.lanes), self.type(a, x.lanes)
            function = self.function(f"llvm.{prefix}.sat.{'.'.join(names)}", result, operand)
            return self.pure(f"call {result} {function}({operand} {x.name})", b, x.lanes)
        if to.kind == "f":
            return self.cast("sitofp" if _signed(dtype) else "uitofp", x, b)
        return self.cast("trunc" if BYTES[b] < BYTES[a] else "sext" if _signed(dtype) else "zext", x, b)

    def _chosen(self, x: list[Any], dtype: Any, kind: str) -> Any:
        which, first, *others = x
        for k, other in enumerate(others, 1):
            condition = which if np.dtype(dtype) == bool else self.compare("ge", dtype, which, k)
            first = self.select(condition, other, first, kind)
        return first

    def _power(self, x: Any, exponent: int, product: Callable[[Any, Any], Any], dtype: Any) -> Any:
        n, out = abs(exponent), None
        while n:
            if n & 1:
                out = x if out is None else product(out, x)
            n >>= 1
            x = product(x, x) if n else x
        one = np.dtype(dtype).type(1)
        if out is None:
            return one
        return self.arithmetic("div", dtype, one, out) if exponent < 0 else out

    def _complex(self, name: str, x: list[Any], kind: str, params: Any) -> Any:
        a, b = parts(x[0])
        minus = lambda y: self.op("fneg", kind, y)
        if name in ("neg", "conj"):
            return Complex(minus(a) if name == "neg" else a, minus(b))
        if name == "abs":
            return self.library("hypot", kind, a, b)
        if name == "integer_pow" and params["y"] > 0:
            dtype = f"float{8 * BYTES[kind]}"
            return self._power(x[0], params["y"], lambda y, z: self.complex_product(y, z, kind), dtype)
        if name not in ("add", "sub", "mul", "div", "add_any"):
            raise NotEntryByEntry(f"{name} of complex numbers")
        if name == "mul":
            return self.complex_product(x[0], x[1], kind)
        c, d = parts(x[1])
        if name == "div":
            return self._complex_quotient(a, b, c, d, kind)
        code = _OF_FLOATS[name.removesuffix("_any")]
        return Complex(self.op(code, kind, a, c), self.op(code, kind, b, d))

    def complex_product(self, x: Any, y: Any, kind: str) -> Complex:
        (a, b), (c, d) = parts(x), parts(y)
        times = lambda u, v: self.op("fmul contract", kind, u, v)
        return Complex(
            self.op("fsub contract", kind, times(a, c), times(b, d)),
            self.op("fadd contract", kind, times(a, d), times(b, c)),
        )

    def _complex_quotient(self, a: Any, b: Any, c: Any, d: Any, kind: str) -> Complex:
        # Smith's algorithm: no overflow in c² + d².
        size = lambda u: self.intrinsic("fabs", kind, u)
        wide = self.op("fcmp oge", kind, size(c), size(d), result="i1")
        big, small = self.select(wide, c, d, kind), self.select(wide, d, c, kind)
        ratio = self.op("fdiv", kind, small, big)
        times = lambda u, v: self.op("fmul", kind, u, v)
        bottom = self.op("fadd", kind, big, times(small, ratio))
        u, v = self.select(wide, a, b, kind), self.select(wide, b, a, kind)
        real = self.op("fadd", kind, u, times(v, ratio))
        imag = self.op("fsub", kind, v, times(u, ratio))
        imag = self.select(wide, imag, self.op("fneg", kind, imag), kind)
        return Complex(self.op("fdiv", kind, real, bottom), self.op("fdiv", kind, imag, bottom))


def _is_power_of_two(x: Any) -> bool:
    return bool(x > 0) and math.frexp(x)[0] == 0.5 and 1e-30 < x < 1e30


def parts(x: Any) -> tuple[Any, Any]:
    """The real and the imaginary part of a number."""
    if isinstance(x, Complex):
        return x.real, x.imag
    return (np.float64(x.real), np.float64(x.imag)) if np.iscomplexobj(x) else (x, np.float64(0))


def _part(dtype: Any) -> np.dtype:
    """The type of the parts of a complex number."""
    dtype = np.dtype(dtype)
    return np.dtype(f"float{4 * dtype.itemsize}") if dtype.kind == "c" else dtype
