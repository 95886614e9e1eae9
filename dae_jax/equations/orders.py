"""How often structural analysis differentiates each equation and each variable, and what of that is in the state."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Array, Float, Int

from ..linalg import powers, take


@dataclasses.dataclass(frozen=True)
class Orders:
    """How often each equation is differentiated, C, and each variable, D. Compared by value.

    The state of the underlying ODE holds, of each variable j, the derivatives of orders 0 to Dⱼ − 1.
    """

    equations: tuple[int, ...]
    variables: tuple[int, ...]

    @functools.cached_property
    def places(self) -> list[Int[np.ndarray, " n"]]:
        """For each order k, where y^(k) of each variable is in (Y, X), X the derivatives of order Dⱼ; −1 beyond."""
        d = np.array(self.variables)
        found, start = [], 0
        for k in range(d.max() + 1):
            inside = d > k
            found.append(
                np.where(inside, start + np.cumsum(inside) - 1, np.where(d == k, self.size + np.arange(len(d)), -1))
            )
            start += int(inside.sum())
        return found

    @functools.cached_property
    def derivatives(self) -> Int[np.ndarray, " N"]:
        """Where in (Y, X) the derivative of each entry of Y is."""
        d = np.array(self.variables)
        return np.concatenate([self.places[k + 1][d > k] for k in range(d.max())])

    @functools.cached_property
    def values(self) -> Int[np.ndarray, " N"]:
        """Which variable each entry of Y is the value of, −1 for derivatives."""
        first = np.flatnonzero(np.array(self.variables) > 0)
        return np.concatenate([first, np.full(self.size - len(first), -1)])

    @property
    def owners(self) -> Int[np.ndarray, " N"]:
        """Which variable each entry of Y is the value or a derivative of."""
        d = np.array(self.variables)
        return np.concatenate([np.flatnonzero(d > k) for k in range(d.max())])

    @property
    def levels(self) -> Int[np.ndarray, " N"]:
        """Of which order each entry of Y is."""
        d = np.array(self.variables)
        return np.concatenate([np.full(int(np.sum(d > k)), k) for k in range(d.max())])

    @property
    def first_derivatives(self) -> Int[np.ndarray, " N"]:
        """Which variable each entry of Y is the first derivative of, −1 for others."""
        found = np.full(self.size, -1)
        for j, d in enumerate(self.variables):
            if d > 1:
                found[self.places[1][j]] = j
        return found

    def of_derivatives(
        self, each: Float[Array, " n"], unit: Float[Array, " n"] | None
    ) -> tuple[Float[Array, " N"], Float[Array, " n"]]:
        """For Y and for the derivatives of order Dⱼ what is known for each variable: as it is, or over its unit of time for each order."""
        lower = take(each, self.owners)
        if unit is None:
            return lower, each
        return lower / powers(take(unit, self.owners), tuple(self.levels.tolist())), each / powers(unit, self.variables)

    @property
    def size(self) -> int:
        """The number of entries of Y."""
        return sum(self.variables)

    def rows(self, level: int) -> Int[np.ndarray, " rows"]:
        """The equations whose derivative of order `level` is an invariant."""
        return np.flatnonzero(np.array(self.equations) > level)

    def dummies(self, k: int) -> Int[np.ndarray, " n"]:
        """Where in Y the derivative of order Dⱼ − k of each variable is, a dummy derivative at level k; −1: nowhere."""
        return np.array([self.places[d - k][j] if d >= k else -1 for j, d in enumerate(self.variables)])
