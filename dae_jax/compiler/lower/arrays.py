"""Arrays in memory, as strided views of buffers, and arrays that are yet to be computed.

What is computed entry by entry and used once is computed where it is used, so that one loop does what several operations
on arrays say.

Who may write into whose memory, in the order in which instructions are run:

1. Who reads a buffer later refers to it: each variable of a frame that holds an array, and a loop, to what it reads at
   each turn. A buffer is written to by who made it, and then by an update (or a loop that carries it on) whose operand it
   is, once nothing refers to it (`Memory.own`). With lanes each writes to the lanes that take part only.
2. A buffer is used for another array (`Memory.recycle`) when nothing refers to it and nothing holds it. What is read by
   instructions that are written now and run again or later is held: what a loop carries, the operands of branches.
3. Memory is taken before the first instruction that is run between its first and its last use is written. So it is none
   that these have let go; only such memory may be written to in all lanes.

With `always_copies` no buffer is ever used twice: what that gives, this must give to the last bit.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np


@dataclasses.dataclass(eq=False)
class Buffer:
    """Memory for numbers of one type. `references` counts who reads it later, `held` says that it is needed though nothing
    may refer to it; `bytes` is 0 for memory that is not ours. A complex number has two `parts`: all
    imaginary ones come `plane` numbers after the real ones, or each after its real one where that is 0. Where `apart` is not 0,
    the numbers of one thread lie %threads numbers apart, and have so many bytes each.
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
    apart: int = 0


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
class Fused(_Array):
    """Entry i is what `read` writes the instructions for; `flat` those for an entry by its place in row-major order.

    `buffers`: what is read; `depth`: how many operations one reading goes through.
    """

    read: Callable[[Sequence[Any]], Any]
    buffers: tuple[Buffer, ...]
    flat: Callable[[Any], Any] | None = None
    depth: int = 0

    def moved(
        self, shape: Sequence[int], read: Callable[[Sequence[Any]], Any], flat: Callable[[Any], Any] | None = None
    ) -> "Fused":
        """The same entries at other indices."""
        return dataclasses.replace(self, shape=tuple(shape), read=read, flat=flat, depth=self.depth + 1)


# An array: as entries, each a `Number`; in memory; or yet to be computed.
Operand: TypeAlias = np.ndarray | View | Fused


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    """The strides of an array whose last index runs fastest."""
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


def shared(x: Operand, y: Operand) -> bool:
    """Whether two arrays read the same memory."""
    return bool(set(getattr(x, "buffers", ())).intersection(getattr(y, "buffers", ())))
