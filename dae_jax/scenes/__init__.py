"""Ready scenes, each with a reference that is independent of the library."""

import functools
from collections.abc import Callable

from .double_pendulum import chain as chain, double_pendulum as double_pendulum
from .mechanisms import four_bar as four_bar, slider_crank as slider_crank
from .pendulum import (
    moving_pivot_pendulum as moving_pivot_pendulum,
    pendulum as pendulum,
    spherical_pendulum as spherical_pendulum,
)
from .scene import Scene as Scene
from .surfaces import bead_on_torus as bead_on_torus, knife_edge as knife_edge


SCENES: dict[str, Callable[[], Scene]] = {
    "bead-on-torus": bead_on_torus,
    "chain": chain,
    "double-pendulum": double_pendulum,
    "four-bar": four_bar,
    "four-bar-redundant": functools.partial(four_bar, redundant=True),
    "knife-edge": knife_edge,
    "moving-pivot-pendulum": moving_pivot_pendulum,
    "pendulum": pendulum,
    "slider-crank": slider_crank,
    "spherical-pendulum": spherical_pendulum,
}
