"""JAX's elementwise primitives as instructions."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..jaxprs.numbers import converted
from ..jaxprs.scalar_interpreter import Unsupported
from .instructions import BYTES, Complex, Instructions, Value, kind_of, parts


_BITS = {"double": "i64", "float": "i32"}

_OF_FLOATS = {"add": "fadd contract", "sub": "fsub contract", "mul": "fmul contract", "div": "fdiv", "rem": "frem"}
_OF_INTEGERS = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor"}
_OF_TRUTH_VALUES = {"add": "or", "mul": "and", "max": "or", "min": "and"}
_SHIFTS = {"shift_left": "shl", "shift_right_logical": "lshr", "shift_right_arithmetic": "ashr"}
_COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTRINSICS = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil"}
_ROOTS = {0.5: 1, 0.25: 2, 0.125: 3}
_LIBRARY = frozenset(
    "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p pow cbrt erf erfc atan2".split()
)


class Arithmetic(Instructions):
    """Instructions for primitives of JAX."""

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
            return Complex(*x) if any(isinstance(y, Value) for y in x) else to.type(x[0] + 1j * x[1])
        if name == "pow" and to.kind == "f":  # of a whole number too
            return self._of_float(name, [x[0], self.convert(x[1], dtype, to)], kind_of(to), params)
        if dtype.kind == "c":
            return self.of_complex(name, x, kind_of(_part(dtype)), params)
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
        return self._of_integers(name, dtype, kind, *x)

    def _of_integers(self, name: str, dtype: np.dtype, kind: str, *x: Any) -> Any:
        if name in _SHIFTS:
            return self._shifted(name, kind, *x)
        match name:
            case "not":
                return self.op("xor", kind, x[0], -1)
            case "neg":
                return self.op("sub", kind, 0, x[0])
            case "sign":
                limited = self.arithmetic("min", dtype, x[0], 1)
                return self.arithmetic("max", dtype, limited, -1) if _signed(dtype) else limited
            case "abs":
                return self.intrinsic("smax", kind, x[0], self.op("sub", kind, 0, x[0])) if _signed(dtype) else x[0]
        return self.arithmetic(name, dtype, *x)

    def _shifted(self, name: str, kind: str, x: Any, by: Any) -> Value:
        """By the width and more, and by less than none, all bits are shifted out; a shift of LLVM's is undefined there."""
        last = 8 * BYTES[kind] - 1
        if name == "shift_right_arithmetic":
            return self.op("ashr", kind, x, self.intrinsic("umin", kind, by, last))
        shifted = self.op(_SHIFTS[name], kind, x, self.op("and", kind, by, last))
        return self.select(self.op("icmp ule", kind, by, last, result="i1"), shifted, 0, kind)

    def arithmetic(self, name: str, dtype: Any, *x: Any) -> Value:
        """`add`, `sub`, `mul`, `div`, `rem`, `max`, `min` and bitwise operations of real numbers."""
        dtype = np.dtype(dtype)
        kind = kind_of(dtype)
        if kind == "i1":
            name = _OF_TRUTH_VALUES.get(name, name)
        if name in ("max", "min"):
            prefix = "" if dtype.kind == "f" else "s" if _signed(dtype) else "u"
            return self.intrinsic({"": name + "imum"}.get(prefix, prefix + name), kind, *x)
        if dtype.kind == "f" and name in _OF_FLOATS:
            return self._of_floats(name, kind, *x)
        if dtype.kind != "f" and name in ("div", "rem"):
            return self._quotient(name, dtype, kind, *x)
        if dtype.kind == "f" or name not in _OF_INTEGERS:
            raise Unsupported(name)
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
        if not isinstance(b, Value) and b not in (0, -1):
            return self.op(f"{'s' if _signed(dtype) else 'u'}{name}", kind, a, b)
        by_none, harmless = self.compare("eq", dtype, b, 0), b
        by_minus = self.compare("eq", dtype, b, -1) if _signed(dtype) else None
        for trap in (by_none, by_minus):
            harmless = self.select(trap, 1, harmless, kind) if trap else harmless
        out = self.op(f"{'s' if _signed(dtype) else 'u'}{name}", kind, a, harmless)
        if by_minus:
            out = self.select(by_minus, self.op("sub", kind, 0, a) if name == "div" else 0, out, kind)
        return self.select(by_none, -1 if name == "div" else a, out, kind)

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

    def convert(self, x: Any, dtype: np.dtype, to: np.dtype) -> Any:
        if dtype == to:
            return x
        if to.kind == "c":
            half, (real, imag) = _part(to), parts(x)
            return Complex(self.convert(real, _part(dtype), half), self.convert(imag, _part(dtype), half))
        if dtype.kind == "c":
            return self.convert(parts(x)[0], _part(dtype), to)
        if not isinstance(x, Value):
            return converted(x, to)
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

    def of_complex(self, name: str, x: Sequence[Any], kind: str, params: Any = None) -> Any:
        """Arithmetic on complex numbers whose parts are of a kind."""
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
            raise Unsupported(f"{name} of complex numbers")
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


def _signed(dtype: Any) -> bool:
    return np.dtype(dtype).kind == "i"


def _is_power_of_two(x: Any) -> bool:
    return bool(x > 0) and math.frexp(x)[0] == 0.5 and 1e-30 < x < 1e30


def _part(dtype: Any) -> np.dtype:
    """The type of the parts of a complex number."""
    dtype = np.dtype(dtype)
    return np.dtype(f"float{4 * dtype.itemsize}") if dtype.kind == "c" else dtype
