"""Grids of parameters for `sweep`."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jax.typing import ArrayLike

from ..validate.user_functions import at_numbers


@dataclasses.dataclass(frozen=True)
class Grid:
    """All combinations of the values of named axes; see `grid`."""

    axes: dict[str, np.ndarray]

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values of each axis."""
        return tuple(len(x) for x in self.axes.values())

    def elements(self) -> dict[str, np.ndarray]:
        """The combinations, the last axis fastest: one array for each name, with one leading axis."""
        return {
            name: x.ravel() for name, x in zip(self.axes, np.meshgrid(*self.axes.values(), indexing="ij"), strict=True)
        }


@at_numbers
def grid(**axes: ArrayLike | Sequence[float]) -> Grid:
    """A grid for `sweep`: `grid(alpha=..., beta=...)`. The function gets {"alpha": α, "beta": β}, the results have a
    leading axis for each name, in this order.

    Errors: `ValueError` for an axis that is not one-dimensional or is empty.
    """
    if not axes:
        raise ValueError("`grid` needs at least one axis, such as alpha=jnp.logspace(-1, 4, 100).")
    arrays = {name: np.asarray(x) for name, x in axes.items()}
    for name, x in arrays.items():
        if x.ndim != 1 or not x.size:
            raise ValueError(f"`{name}` must be a sequence of numbers, but has the shape {x.shape}.")
    return Grid(arrays)
