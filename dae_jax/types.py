"""What passes from room to room, by name. It imports nothing of the library.

A shape in an alias is checked where it is used, like any of jaxtyping's: two `Flat`s of one function have one length.
"""

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, TypeAlias

import diffrax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree, Real
from typing_extensions import TypeAliasType


# Pytrees of the user's, of any structure: his state, (q, v), (x, z) or y, and what he calls `args`.
State: TypeAlias = Any
Args: TypeAlias = Any

# What is integrated: a pytree of arrays whose structure the formulation decides.
Y: TypeAlias = PyTree[Float[Array, "..."]]
# A vector of n numbers, and (q, v) as two of them.
Flat: TypeAlias = Float[Array, " n"]
Phase: TypeAlias = tuple[Flat, Flat]

Scalar: TypeAlias = Float[Array, ""]
BoolScalar: TypeAlias = Bool[Array, ""]
IntScalar: TypeAlias = Int[Array, ""]

# An array's type of number, or numpy's class of it.
DType: TypeAlias = np.dtype | type
# The structure of a pytree.
TreeDef: TypeAlias = Hashable

# Those of diffrax, whatever they keep from step to step.
Solver: TypeAlias = diffrax.AbstractSolver[Any]
Controller: TypeAlias = diffrax.AbstractStepSizeController[Any, Any]
ProgressMeter: TypeAlias = diffrax.AbstractProgressMeter[Any]

# Numbers that a user may write as Python's: of time, and yes or no. Signatures show the names.
if TYPE_CHECKING:
    Time: TypeAlias = float | Array | np.ndarray
    BoolLike: TypeAlias = bool | Array | np.ndarray
else:
    Time = TypeAliasType("Time", Real[Array, ""] | Real[np.ndarray, ""] | np.number | float | int)
    BoolLike = TypeAliasType("BoolLike", Bool[Array, ""] | Bool[np.ndarray, ""] | np.bool_ | bool)
