"""Ready scenes, each with a reference that is independent of the library."""

import functools
from collections.abc import Callable

from ..systems import System
from .charge_pump import charge_pump as charge_pump
from .chemistry import (
    akzo_nobel as akzo_nobel,
    robertson as robertson,
    robertson_copies as robertson_copies,
)
from .circuit_chain import circuit_chain as circuit_chain
from .circuits import amplifier as amplifier, capacitor_loop as capacitor_loop
from .double_pendulum import chain as chain, double_pendulum as double_pendulum
from .elastic_crank import elastic_crank as elastic_crank
from .flow import stokes as stokes
from .hessenberg import hessenberg_2 as hessenberg_2, integrators as integrators, jay as jay
from .mechanisms import four_bar as four_bar, slider_crank as slider_crank
from .pendulum import (
    moving_pivot_pendulum as moving_pivot_pendulum,
    pendulum as pendulum,
    spherical_pendulum as spherical_pendulum,
)
from .power_grid import power_grid as power_grid
from .reaction_diffusion import food_web as food_web, heat as heat
from .scene import Drawing as Drawing, Scene as Scene
from .stiff_mechanisms import andrews as andrews, car_axis as car_axis
from .surfaces import bead_on_torus as bead_on_torus, knife_edge as knife_edge
from .wheelset import wheelset as wheelset


# The scenes by their names on the command line, each a function without arguments that makes it.
SCENES: dict[str, Callable[[], Scene[System]]] = {
    "akzo-nobel": akzo_nobel,
    "amplifier": amplifier,
    "andrews": andrews,
    "bead-on-torus": bead_on_torus,
    "capacitor-loop": capacitor_loop,
    "car-axis": car_axis,
    "chain": chain,
    "charge-pump": charge_pump,
    "circuit-chain": circuit_chain,
    "double-pendulum": double_pendulum,
    "elastic-crank": elastic_crank,
    "food-web": food_web,
    "four-bar": four_bar,
    "four-bar-redundant": functools.partial(four_bar, redundant=True),
    "heat": heat,
    "hessenberg-2": hessenberg_2,
    "integrators-4": functools.partial(integrators, 4),
    "integrators-5": functools.partial(integrators, 5),
    "jay": jay,
    "knife-edge": knife_edge,
    "moving-pivot-pendulum": moving_pivot_pendulum,
    "pendulum": pendulum,
    "power-grid": power_grid,
    "robertson": robertson,
    "robertson-copies": robertson_copies,
    "slider-crank": slider_crank,
    "spherical-pendulum": spherical_pendulum,
    "stokes": stokes,
}
# The scene whose two initial angles `dae-jax sweep angles` varies.
ANGLES = "double-pendulum"
