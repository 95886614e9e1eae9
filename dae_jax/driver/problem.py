"""What is solved, and how a pytree is taken apart into its arrays and the rest, which is known while tracing."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from ..compiler import one_kernel_enabled
from ..compiler.types import Arrays
from ..equations.constraint_jacobian import Rank
from ..equations.independent import Rows
from ..systems import System
from ..types import Args, Scalar, State
from ..validate.closures import opened


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("system", "t0", "t1", "dt0", "y0", "args"),
    meta_fields=("rank", "rows"),
)
@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """All of a solve but its method: a system from `t0` to `t1`, its start, how many of its constraints are independent there
    (`None`: all), and which of them a method gets that cannot do with more (`None`: found in the solve).
    """

    system: System
    t0: Scalar
    t1: Scalar
    dt0: Scalar | None
    y0: State
    args: Args
    rank: int | Rank | None
    rows: Rows | None = None

    @property
    def start(self) -> tuple[System, Scalar, State, Args]:
        """(system, t0, y0, args)."""
        return self.system, self.t0, self.y0, self.args


def count_of(rank: int | Rank | None) -> int | None:
    """How many constraints are independent in all."""
    return rank[1] if isinstance(rank, tuple) else rank


class Program(NamedTuple):
    """All of a pytree but its arrays: hashable, and different for 1 and 1.0."""

    treedef: Any
    leaves: tuple[Any, ...]
    types: tuple[type, ...]
    one_kernel: bool

    def whole(self, arrays: Arrays) -> Any:
        """The pytree with these arrays."""
        rest = iter(arrays)
        return jax.tree.unflatten(self.treedef, [next(rest) if x is _ARRAY else x for x in self.leaves])


_ARRAY = object()


def split(tree: PyTree) -> tuple[Program, list[Any]]:
    """What a solve is given, as a program and its arrays."""
    leaves, treedef = jax.tree.flatten(opened(tree))
    arrays = [x for x in leaves if isinstance(x, jax.Array | np.ndarray | np.generic)]
    static = tuple(_ARRAY if isinstance(x, jax.Array | np.ndarray | np.generic) else x for x in leaves)
    return Program(treedef, static, tuple(map(type, static)), one_kernel_enabled()), arrays
