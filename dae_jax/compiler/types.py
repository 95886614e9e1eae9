"""Parts of a jaxpr, as far as the library looks at them.

JAX types the aval of a variable as `AbstractValue`, which has no shape; these say what is asked of it.
"""

from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
from jax import Array
from jax.extend.core import JaxprEqn, Literal, Primitive, Var


# Parameters of a primitive.
Params: TypeAlias = Mapping[str, Any]
# The structure of a pytree.
TreeDef: TypeAlias = Hashable
# What goes into a jaxpr and comes out of it.
Arrays: TypeAlias = list[Array]
# A variable of a jaxpr or a constant in its place.
Atom: TypeAlias = Var | Literal
DType: TypeAlias = np.dtype | type


@runtime_checkable
class Aval(Protocol):
    """The shape and the type of an array."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def dtype(self) -> np.dtype: ...
    @property
    def size(self) -> int: ...
    @property
    def ndim(self) -> int: ...


if TYPE_CHECKING:

    class Equation(Protocol):
        """An equation of a jaxpr; its variables have an `Aval` each."""

        @property
        def primitive(self) -> Primitive: ...
        @property
        def params(self) -> dict[str, Any]: ...
        @property
        def invars(self) -> Sequence[Any]: ...
        @property
        def outvars(self) -> Sequence[Any]: ...
        @property
        def effects(self) -> Any: ...
        def replace(self, *args: Any, **kwargs: Any) -> Any: ...

else:
    Equation = JaxprEqn


def aval_of(atom: Atom) -> Aval:
    """The shape and the type of a variable or constant."""
    return cast(Aval, atom.aval)
