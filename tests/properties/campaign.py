"""Which mechanisms are solved, and what is asked of each family."""

import functools

from .checks import (
    Check,
    agrees,
    balances_its_energy,
    batch_is_one_at_a_time,
    comes_back,
    derives,
    ends_well,
    scales,
    stays_on_the_constraints,
)  # fmt: skip


FIXED = 140
# Seeds that once found something.
FOUND: dict[str, tuple[int, ...]] = {}

_ALL: list[Check] = [ends_well, stays_on_the_constraints, balances_its_energy, comes_back, scales]


def _other(method: str, keeps: bool = True) -> list[Check]:
    kept: list[Check] = [functools.partial(stays_on_the_constraints, method=method)] if keeps else []
    return [functools.partial(agrees, method=method), *kept]


# A program takes ten seconds to compile: each family has some of what could be asked of it, together they have all.
FAMILY_CHECKS: dict[str, list[Check]] = {
    "plane tree": [*_ALL, *_other("tangent space"), batch_is_one_at_a_time],
    "loop of heavy rods": [*_ALL, *_other("ggl")],
    "driven loop in space": [*_ALL, *_other("baumgarte", keeps=False), derives],
}
EVERYTHING = [
    *_ALL, *_other("tangent space"), *_other("dummy derivatives"), *_other("ggl"), *_other("baumgarte", keeps=False), derives,
    batch_is_one_at_a_time,
]  # fmt: skip
