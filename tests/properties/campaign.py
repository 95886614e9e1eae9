"""Which mechanisms are solved, and what is asked of each family."""

import functools
from collections.abc import Iterable

import numpy as np

from .checks import (
    Batch,
    Check,
    agrees,
    balances_its_energy,
    batch_is_one_at_a_time,
    comes_back,
    derives,
    ends_well,
    is_the_motion_in_minimal_coordinates,
    knows_no_order_and_no_frame,
    scales,
    stays_on_the_constraints,
)  # fmt: skip


FIXED = 120
# Seeds that once found something.
FOUND: dict[str, tuple[int, ...]] = {}

_ALL: list[Check] = [
    ends_well, stays_on_the_constraints, balances_its_energy, comes_back, scales, knows_no_order_and_no_frame,
]  # fmt: skip


def _other(method: str, keeps: bool = True) -> Check:
    return functools.partial(agrees, method=method, keeps=keeps)


# A program takes up to ten seconds to compile: each family has some of what could be asked of it, together they have all.
FAMILY_CHECKS: dict[str, list[Check]] = {
    "plane tree": [*_ALL, is_the_motion_in_minimal_coordinates, _other("tangent space"), batch_is_one_at_a_time],
    "loop of heavy rods": _ALL,
    "driven loop in space": [*_ALL, _other("baumgarte", keeps=False)],
}
EVERYTHING = [
    *_ALL, *map(_other, ("projection of order 8", "tangent space", "dummy derivatives", "ggl")),
    _other("baumgarte", keeps=False), derives, functools.partial(derives, forward=True), batch_is_one_at_a_time,
]  # fmt: skip


def broken(batch: Batch, checks: Iterable[Check]) -> list[str]:
    """A line for each mechanism and each law that does not hold."""
    # What ended at a dead centre is infinite.
    with np.errstate(invalid="ignore", over="ignore"):
        return [line for check in checks for line in check(batch)]
