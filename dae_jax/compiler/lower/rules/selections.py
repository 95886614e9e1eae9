"""Rules of choices, entry by entry."""

from typing import Any

from ...jaxprs.objects import is_number
from ..arithmetic import compared
from ..context import Context
from ..dtypes import ALL, BOOL, INTEGERS, kind_of, part
from ..entrywise import entrywise
from ..values import Number


@entrywise("select_n", (BOOL | INTEGERS, ALL), moves=True)
def select_n(context: Context, which: Number, first: Number, *others: Number, **_: object) -> Any:
    """The case of the number that `which` is."""
    code, dtype, kind = context.code, context.dtypes[0], kind_of(part(context.to))
    if is_number(which):
        return (first, *others)[min(max(int(which), 0), len(others))]
    for k, other in enumerate(others, 1):
        condition = which if dtype.kind == "b" else compared(code, "ge", dtype, which, k)
        first = code.select(condition, other, first, kind)
    return first
