"""Arrays as the operands that hold them: one for each part of each entry, a complex number in two parts."""

import numpy as np

from ..jaxprs.objects import objects
from ..types import Aval
from .arrays import Operand, View
from .dtypes import kinds_of
from .instructions import Instructions
from .values import Complex, Value, parts


def texts(code: Instructions, aval: Aval, x: np.ndarray, lanes: bool) -> list[str]:
    """The operands of the entries; with `lanes` vectors, also of what is the same in all lanes."""
    numbers = [y for e in x.ravel() for y in (parts(e) if np.dtype(aval.dtype).kind == "c" else (e,))]
    if not lanes and any(isinstance(y, Value) and y.lanes for y in numbers):
        raise AssertionError("a number of each lane where one for all is expected")
    return [code.text(y, kind, lanes) for y, kind in zip(numbers, kinds_of(aval), strict=True)]


def of_texts(names: list[str], aval: Aval, lanes: bool) -> np.ndarray:
    """Entries from the operands that hold them."""
    values = [Value(name, kind, lanes) for name, kind in zip(names, kinds_of(aval), strict=True)]
    if np.dtype(aval.dtype).kind == "c":
        values = [Complex(*pair) for pair in zip(values[::2], values[1::2], strict=True)]
    return objects(values, aval.shape)


def has_lanes(x: Operand) -> bool:
    """Whether an array's entries may differ from lane to lane."""
    if isinstance(x, View):
        return x.buffer.lanes or (isinstance(x.offset, Value) and x.offset.lanes)
    assert isinstance(x, np.ndarray)
    return any(
        isinstance(p, Value) and p.lanes for e in x.ravel() for p in (parts(e) if isinstance(e, Complex) else (e,))
    )


def retain(x: Operand, by: int) -> None:
    """Counts the variables that hold a view of a buffer."""
    for buffer in getattr(x, "buffers", ()):
        buffer.references += by
