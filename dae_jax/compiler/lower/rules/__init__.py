"""The rules, by kind of primitive; importing this enters them into the table."""

from . import (
    bits as bits,
    branches as branches,
    calls as calls,
    contractions as contractions,
    elementwise as elementwise,
    floats as floats,
    host as host,
    indexing as indexing,
    integers as integers,
    lapack as lapack,
    loops as loops,
    movement as movement,
    reductions as reductions,
    selections as selections,
)
