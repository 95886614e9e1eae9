"""Arrays in memory, as strided views of buffers, and arrays that are yet to be computed.

A buffer that nothing else refers to is updated in place. What is computed entry by entry and used once is computed where
it is used, so that one loop does what several operations on arrays say.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


# More entries than these are kept in memory where a loop carries them, and where an operation makes them.
SMALL = 24


@dataclasses.dataclass(eq=False)
class Buffer:
    """Memory for numbers of one type. `references` counts the variables that hold an array that reads it, `held` says
    that something else needs it too; `bytes` is 0 for memory that is not ours. A complex number has two `parts`: all
    imaginary ones come `plane` numbers after the real ones, or each after its real one where that is 0.
    """

    pointer: str
    kind: str
    lanes: bool
    writable: bool = True
    parts: int = 1
    plane: int = 0
    bytes: int = 0
    references: int = 0
    held: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class _Array:
    dtype: np.dtype
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def ndim(self) -> int:
        return len(self.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class View(_Array):
    """Entry i is number offset + i·strides of the buffer."""

    buffer: Buffer
    strides: tuple[int, ...]
    offset: Any = 0

    @property
    def contiguous(self) -> bool:
        return self.strides == row_major(self.shape)

    @property
    def whole(self) -> bool:
        """Whether the entries are those of the buffer, in order."""
        return self.contiguous and isinstance(self.offset, int) and self.offset == 0

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        return (self.buffer,)


@dataclasses.dataclass(frozen=True, eq=False)
class Deferred(_Array):
    """Entry i is what `read` writes the instructions for; `flat` those for an entry by its place in row-major order.

    `buffers`: what is read; `depth`: how many operations one reading goes through.
    """

    read: Callable[[Sequence[Any]], Any]
    buffers: tuple[Buffer, ...]
    flat: Callable[[Any], Any] | None = None
    depth: int = 0

    def moved(
        self, shape: Sequence[int], read: Callable[[Sequence[Any]], Any], flat: Callable[[Any], Any] | None = None
    ) -> "Deferred":
        """The same entries at other indices."""
        return dataclasses.replace(self, shape=tuple(shape), read=read, flat=flat, depth=self.depth + 1)


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    """The strides of an array whose last index runs fastest."""
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


def shared(x: Any, y: Any) -> bool:
    """Whether two arrays read the same memory."""
    return bool(set(getattr(x, "buffers", ())).intersection(getattr(y, "buffers", ())))
