"""Primitives of JAX on arrays of entries; what is large, or at a place found at run time, is in memory."""

import functools
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from ..jaxprs.inline import inlined
from ..jaxprs.numbers import on_numbers
from ..jaxprs.scalar_interpreter import ELEMENTWISE, STRUCTURAL, Unsupported, columns, is_number, objects
from .in_memory import FOLDS, LARGE, MORE_ELEMENTWISE, InMemory, identity, in_pairs
from .instructions import KINDS, Value, parts
from .memory import Memory


# Larger constants are data of the module; what smaller ones give is worked out here.
KNOWN = 4096
_MOVES = frozenset(
    "broadcast_in_dim concatenate expand_dims iota pad reshape rev slice split squeeze stack transpose unstack".split()
)
_CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_OF_KIND = {kind: name for name, kind in KINDS.items() if not name.startswith("u")}
SIMPLE = (
    (ELEMENTWISE - {"digamma", "erf_inv", "lgamma"})
    | STRUCTURAL
    | MORE_ELEMENTWISE
    | FOLDS.keys()
    | _CUMULATIVE.keys()
    | {"argmax", "argmin", "dynamic_update_slice", "scatter", "scatter-add", "unstack"}
)


class Primitives(InMemory):
    """Runs jaxprs by writing instructions for what is not known."""

    def __init__(self, code: Memory, limit: int) -> None:
        super().__init__(code, limit)
        self._flat: dict[int, tuple[ClosedJaxpr, ClosedJaxpr]] = {}

    def flat(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        """A jaxpr without calls."""
        if id(closed) not in self._flat:
            self._flat[id(closed)] = closed, inlined(closed)
        return self._flat[id(closed)][1]

    # Arithmetic of entries

    def apply(self, eqn: Any, x: list[Any]) -> Any:
        return self.code.apply(eqn, x)

    def scalar(self, eqn: Any, x: list[Any]) -> Any:
        # Arithmetic as JAX defines it: 0·x is not 0 where x is not finite.
        name = eqn.primitive.name
        if name in ("mul", "add", "neg", "sub", "div") or (name == "select_n" and not is_number(x[0])):
            return self.code.apply(eqn, x)
        return super().scalar(eqn, x)

    def product(self, a: Any, b: Any) -> Any:
        return self.combined("mul", _of_any_sign(a, b), a, b)

    def total(self, a: Any, b: Any) -> Any:
        return b if is_number(a, 0) else a if is_number(b, 0) else self.combined("add", _of_any_sign(a, b), a, b)

    def constant(self, x: Any) -> Any:
        if isinstance(x, jax.core.Tracer):
            raise Unsupported("a constant that is traced")
        x = np.asarray(x)
        return self.code.constant_view(x) if x.size > KNOWN else super().constant(x)

    # Primitives

    def equation(self, eqn: Any, args: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        outs = [v.aval for v in eqn.outvars]
        largest = max((a.size for a in outs), default=0)
        large = largest > KNOWN or (largest > LARGE and not _stays_known(eqn, args))
        if large or any(not isinstance(a, np.ndarray) and a.size > self.code.few for a in args):
            return self.in_memory(eqn, args)
        args = [self.code.entries(a) for a in args]
        if name == "dynamic_slice" and not all(is_number(a[()]) for a in args[1:]):
            return self.in_memory(eqn, args)
        if name == "dynamic_update_slice":
            if all(is_number(a[()]) for a in args[2:]):
                return [self._updated(args)]
            return self.in_memory(eqn, args)
        if name in ("gather", "scatter", "scatter-add") and not all(map(is_number, args[1].ravel())):
            return self.in_memory(eqn, args)
        if name in FOLDS:
            return [self._folded(eqn, args[0])]
        if name in _CUMULATIVE:
            return [self._accumulated(eqn, args[0])]
        if name in ("argmax", "argmin"):
            return [self._extreme(eqn, args[0])]
        if name in MORE_ELEMENTWISE:
            return [self.elementwise(eqn, args)]
        if name == "unstack":
            return [
                x.reshape(a.shape) for x, a in zip(np.split(args[0], len(outs), eqn.params["axis"]), outs, strict=True)
            ]
        if name == "bitcast_convert_type":
            raise Unsupported(name)
        return super().equation(eqn, args)

    def dot_general(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        to = np.dtype(eqn.outvars[0].aval.dtype)
        convert = lambda x, v: objects([self.code.convert(e, np.dtype(v.aval.dtype), to) for e in x.ravel()], x.shape)
        return super().dot_general(eqn, list(map(convert, args, eqn.invars)))

    def add_any(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        if np.dtype(eqn.outvars[0].aval.dtype).kind != "c":
            return super().add_any(eqn, args)
        return objects(
            [self.code.apply(eqn, list(x)) for x in zip(*(a.ravel() for a in args), strict=True)], args[0].shape
        )

    def _updated(self, args: list[np.ndarray]) -> np.ndarray:
        x, update, *starts = args
        out = x.copy()
        first = [min(max(int(s[()]), 0), d - k) for s, d, k in zip(starts, x.shape, update.shape, strict=True)]
        out[tuple(slice(s, s + k) for s, k in zip(first, update.shape, strict=True))] = update
        return out

    def _folded(self, eqn: Any, x: np.ndarray) -> np.ndarray:
        x, dtype = columns(x, eqn.params["axes"]), np.dtype(eqn.outvars[0].aval.dtype)
        combine = functools.partial(self.combined, FOLDS[eqn.primitive.name], dtype)
        first = [] if x.shape[0] else [identity(FOLDS[eqn.primitive.name], dtype)]
        return objects([in_pairs(combine, [*x[(slice(None), *i)], *first]) for i in np.ndindex(x.shape[1:])], x.shape[1:])

    def _accumulated(self, eqn: Any, x: np.ndarray) -> np.ndarray:
        combine = functools.partial(self.combined, _CUMULATIVE[eqn.primitive.name], eqn.outvars[0].aval.dtype)
        out = np.moveaxis(x.copy(), eqn.params["axis"], 0)
        out = out[::-1] if eqn.params["reverse"] else out
        for i in range(1, len(out)):
            for j in np.ndindex(out.shape[1:]):
                out[(i, *j)] = combine(out[(i - 1, *j)], out[(i, *j)])
        return np.moveaxis(out[::-1] if eqn.params["reverse"] else out, 0, eqn.params["axis"])

    def _extreme(self, eqn: Any, x: np.ndarray) -> np.ndarray:
        (axis,), to = eqn.params["axes"], np.dtype(eqn.params["index_dtype"])
        moved = np.moveaxis(x, axis, 0)
        better = functools.partial(self.better, eqn)
        found = [
            functools.reduce(better, [(moved[(i, *j)], to.type(i)) for i in range(len(moved))])
            for j in np.ndindex(moved.shape[1:])
        ]
        return objects([place for _, place in found], moved.shape[1:])


def _of_any_sign(*x: Any) -> np.dtype:
    """The type of numbers that are added or multiplied, signed where they are integers: both come to the same."""
    kinds = [p.kind for e in x for p in parts(e) if isinstance(p, Value)]
    return np.dtype(_OF_KIND[kinds[0]] if kinds else x[0].dtype)


def _stays_known(eqn: Any, args: list[Any]) -> bool:
    """Whether all operands are numbers, and the results are then too, without an instruction."""
    if not all(isinstance(a, np.ndarray) and all(map(is_number, a.ravel())) for a in args):
        return False
    if eqn.primitive.name not in ELEMENTWISE:
        return eqn.primitive.name in _MOVES
    values = [np.array(list(a.ravel()), v.aval.dtype).reshape(a.shape) for a, v in zip(args, eqn.invars, strict=True)]
    return eqn.primitive.name in ("select_n", "convert_element_type") or on_numbers(eqn, values) is not None
