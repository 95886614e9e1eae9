"""What our compiler gives beside what XLA gives, number by number."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array


class Difference(AssertionError):
    """Two compilers give different numbers for the same function."""


def checked(ours: Sequence[Array], theirs: Sequence[Array], units: int) -> list[Any]:
    """`ours`, in a program that raises a `Difference` where they are not `theirs`."""
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ours]

    def compare(ours: Sequence[Array], theirs: Sequence[Array]) -> list[np.ndarray]:
        pairs = [(np.asarray(x), np.asarray(y)) for x, y in zip(ours, theirs, strict=True)]
        for k, (x, y) in enumerate(pairs):
            refuse_difference(k, x, y, units)
        return [x for x, _ in pairs]

    return list(jax.pure_callback(compare, shapes, list(ours), list(theirs)))


def refuse_difference(k: int, ours: np.ndarray, theirs: np.ndarray, units: int) -> None:
    """Raises for the k-th results of a function where they differ: integers at all, floats by more than `units` in the last
    place of the largest number.
    """
    if ours.dtype.kind in "fc":
        finite = np.abs(theirs[np.isfinite(theirs)])
        allowed = units * np.finfo(ours.dtype).eps * finite.max(initial=0.0)
        with np.errstate(invalid="ignore"):
            same = np.abs(ours - theirs) <= allowed
        same |= (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
    else:
        same = ours == theirs
    if not same.all():
        at = tuple(int(i) for i in np.argwhere(~np.atleast_1d(same))[0])
        x, y = (np.atleast_1d(z)[at].item() for z in (ours, theirs))
        raise Difference(
            f"Our compiler and XLA differ in result {k}, a {ours.dtype} array of shape {ours.shape}, in {(~same).sum()} of "
            f"{ours.size} numbers, first at {list(at)}: {x!r} and {y!r}."
        )
