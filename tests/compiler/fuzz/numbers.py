"""Numbers of every type, with the edges of their types among them, and choices among what an operation may be given."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dae_jax.compiler.thresholds import THRESHOLDS


FLOATS = ("float64", "float32")
SIGNED = ("int8", "int16", "int32", "int64")
UNSIGNED = ("uint8", "uint16", "uint32", "uint64")
INTEGERS = SIGNED + UNSIGNED
BOOL = ("bool",)
COMPLEX = ("complex128", "complex64")
REAL = FLOATS + INTEGERS + BOOL
ALL = REAL + COMPLEX

# On both sides of what is kept as values, written out and kept known.
SMALL, LARGE, KNOWN = THRESHOLDS.carried, THRESHOLDS.in_registers, THRESHOLDS.folded
SIZES = {0: 1, 1: 4, 3: 9, 4: 1, SMALL: 0.7, SMALL + 1: 2, LARGE + 1: 0.4, KNOWN + 1: 0.1}


class Operand(NamedTuple):
    """What an operation takes. `domain`: "edges" of the type, "grid" (eighths, sums of which are exact), "units" (products of
    which are exact), "smooth" (0.2 to 0.8), "shifts", or the number of places that an index has.
    """

    dtype: str
    shape: tuple[int, ...] = ()
    domain: str | int = "edges"


class Draw:
    """Choices from a seed."""

    def __init__(self, *seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def below(self, n: int) -> int:
        return int(self.rng.integers(n))

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def one_of(self, choices: Sequence[Any]) -> Any:
        return choices[self.below(len(choices))]

    def size(self) -> int:
        weights = np.array(list(SIZES.values()))
        return int(self.rng.choice(list(SIZES), p=weights / weights.sum()))

    def shape(self, least: int = 0, size: int | None = None) -> tuple[int, ...]:
        """A shape of at least so many axes."""
        size = self.size() if size is None else size
        if size == 1 and least == 0 and self.chance(0.7):
            return ()
        shape = [size]
        while len(shape) < least or (len(shape) < 3 and self.chance(0.4)):
            n = shape.pop()
            factors = [k for k in range(1, max(n, 1) + 1) if k * (n // k) == n] if n else [1, 2]
            k = self.one_of(factors[: 4 if self.chance(0.5) else None])
            shape += [k, n // k]
        return tuple(shape)

    def order(self, n: int) -> list[int]:
        return self.rng.permutation(n).tolist()

    def axes(self, ndim: int) -> tuple[int, ...]:
        """At least one."""
        return tuple(sorted(self.order(ndim)[: 1 + self.below(ndim)]))

    def numbers(self, operand: Operand, batch: tuple[int, ...] = ()) -> np.ndarray:
        shape, dtype = (*batch, *operand.shape), np.dtype(operand.dtype)
        if dtype.kind == "c":
            part = operand._replace(dtype=f"float{4 * dtype.itemsize}")
            if operand.domain == "units":
                return self.rng.choice(np.array([1, -1, 1j, -1j], dtype), shape)
            return (self.numbers(part, batch) + 0j + 1j * np.nan_to_num(self.numbers(part, batch), posinf=7)).astype(
                dtype
            )
        if dtype.kind == "b":
            return self.rng.integers(0, 2, shape).astype(bool)
        if isinstance(operand.domain, int):
            return self._places(operand.domain, dtype, shape)
        return getattr(self, f"_{operand.domain}")(dtype, shape)

    def _mixed(self, special: list[Any], ordinary: np.ndarray, p: float) -> np.ndarray:
        chosen = self.rng.choice(np.array(special, ordinary.dtype), ordinary.shape)
        return np.where(self.rng.random(ordinary.shape) < p, chosen, ordinary)

    def _edges(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        if dtype.kind == "f":
            info = np.finfo(dtype)
            special = [0.0, -0.0, np.inf, -np.inf, np.nan, info.max, info.min, info.tiny, 1.0, -1.0, -0.5, 2.5, 300.0]
            return self._mixed(special, self.rng.normal(0, 3, shape).astype(dtype), 0.6)
        info, bits = np.iinfo(dtype), 8 * dtype.itemsize
        special = [
            info.min,
            info.min + 1,
            info.max,
            info.max - 1,
            info.max // 2 + 1,
            0,
            1,
            2,
            7,
            bits - 1,
            bits,
            bits + 1,
        ]
        return self._mixed(special, self.rng.integers(0, 100, shape).astype(dtype), 0.6)

    def _grid(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        if dtype.kind != "f":
            return self._edges(dtype, shape)
        ordinary = (self.rng.integers(-40, 41, shape) / 8).astype(dtype)
        return self._mixed([0.0, -0.0, np.inf, -np.inf, np.nan], ordinary, 0.1 if self.chance(0.3) else 0.0)

    def _plain(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        """Of the grid, and finite."""
        return (self.rng.integers(-40, 41, shape) / 8).astype(dtype) if dtype.kind == "f" else self._edges(dtype, shape)

    def _units(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        if dtype.kind != "f":
            return self._edges(dtype, shape)
        return self._mixed([2.0, -2.0, 0.5], self.rng.choice([1.0, -1.0], shape).astype(dtype), 0.1)

    def _smooth(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        return self.rng.uniform(0.2, 0.8, shape).astype(dtype) if dtype.kind == "f" else self._edges(dtype, shape)

    def _shifts(self, dtype: np.dtype, shape: Any) -> np.ndarray:
        bits = 8 * dtype.itemsize
        most = np.iinfo(dtype).max
        special = [0, 1, bits - 1, bits, bits + 1, most, most // 2 + 1, np.iinfo(dtype).min]
        return self._mixed(special, self.rng.integers(0, bits, shape).astype(dtype), 0.6)

    def _places(self, n: int, dtype: np.dtype, shape: Any) -> np.ndarray:
        """Indices of n places, a few of them outside."""
        info = np.iinfo(dtype)
        low = max(info.min, -3)
        ordinary = self.rng.integers(low, min(n + 3, info.max) + 1, shape).astype(dtype)
        special = [info.min, info.max, max(info.min, -n), min(n, info.max), min(n - 1, info.max) if n else 0, 0]
        return self._mixed(special, ordinary, 0.3)
