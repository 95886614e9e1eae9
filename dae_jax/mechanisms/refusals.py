"""What does not fit a mechanism, parts, states and solutions, is refused in a sentence."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ..solution import DAESolution
from ..validate.states import brief
from .bodies import GROUND, Body
from .configuration import Coordinate, Coordinates
from .couplings import Coupling
from .interface import AbstractJoint
from .loads import AbstractLoad, Along, Applied, Gravity


if TYPE_CHECKING:
    from .mechanism import Mechanism


def bodies_of(element: AbstractJoint | AbstractLoad) -> dict[str, int]:
    """The bodies that a joint or a load names, and the dimension in which it was made."""
    if isinstance(element, Applied):
        return {element.body: element.point.shape[0]}
    on = [element.coordinate if isinstance(element, Along) else element]
    if isinstance(element, Coupling):
        on += [element.first, element.second]
    parts = [part for part in on if isinstance(part, AbstractJoint | Coordinate)]
    return {x.body: x.point.shape[0] for part in parts for x in (part.on_a, part.on_b)}


def refuse_what_does_not_fit(mechanism: "Mechanism", given: Sequence[AbstractJoint | AbstractLoad]) -> None:
    """Refuses parts that make no mechanism together."""
    if not mechanism.bodies:
        raise ValueError("A mechanism needs a body.")
    for body in mechanism.bodies:
        if not isinstance(body, Body):
            raise TypeError(
                f"`bodies` must be made by `Body`, but has {brief(body)}: the order is bodies, joints, loads."
            )
    for x in given:
        if not isinstance(x, AbstractJoint | AbstractLoad):
            raise TypeError(f"A mechanism is made of bodies, joints and loads, but {brief(x)} is no joint and no load.")
    names = [body.name for body in mechanism.bodies]
    for what, listed in (("bodies", names), ("joints or loads", [x.name for x in given])):
        twice = sorted({name for name in listed if listed.count(name) > 1})
        if twice:
            raise ValueError(f"Two {what} have the name {twice[0]!r}: give one of them another by `name=`.")
    coordinates = {f"{x.name}.{kind}" for x in given if isinstance(x, AbstractJoint) for kind in x.coordinates}
    for x in given:
        if x.name in coordinates:
            joint, _, kind = x.name.rpartition(".")
            raise ValueError(
                f"{x.name!r} is the name of the {kind} of joint {joint!r} too: give one of them another by `name=`."
            )
    planar = [body.name for body in mechanism.bodies if body.dimension == 2]
    if planar and len(planar) < len(names):
        spatial = next(name for name in names if name not in planar)
        raise ValueError(
            f"Body {planar[0]!r} is planar and body {spatial!r} is spatial: a mechanism is one or the other."
        )
    for x in given:
        if isinstance(x, Gravity) and x.acceleration.shape != (mechanism.dimension,):
            raise ValueError(f"{x.name!r} must have {mechanism.dimension} components, but has {x.acceleration.shape}.")
        for name, made_in in bodies_of(x).items():
            if name not in (*names, GROUND):
                raise ValueError(
                    f"{x.name!r} is on the body {name!r}, which is none of the mechanism's: {', '.join(names)}."
                )
            if made_in != mechanism.dimension and name != GROUND:
                this, that = (("planar", "spatial")[d - 2] for d in (made_in, mechanism.dimension))
                raise ValueError(
                    f"{x.name!r} was made of a {this} body {name!r}, but the mechanism is {that}: make it of the bodies that are listed."
                )


def refuse_other_bodies(mechanism: "Mechanism", part: Coordinates) -> None:
    """Refuses what is no part of this mechanism's states: rows go with bodies by their order."""
    if not isinstance(part, Coordinates):
        raise TypeError(
            f"A state of a Mechanism is a pair of `Coordinates`, as `assemble` gives it and takes it from a guess by name, but "
            f"is {brief(part)}."
        )
    names = tuple(body.name for body in mechanism.bodies)
    if part.names != names:
        raise ValueError(
            f"A state of this Mechanism has the bodies {', '.join(names)}, in this order, but this one is of another mechanism, with "
            f"{', '.join(part.names)}."
        )


def refuse_no_solution(mechanism: "Mechanism", sol: Any) -> None:
    """Refuses what is no solution of this mechanism with saved states."""
    if not isinstance(sol, DAESolution):
        raise TypeError(f"`sol` must be what `daesolve` returns, but is {brief(sol)}.")
    if not isinstance(sol.ts, jax.Array | np.ndarray):
        raise ValueError("`sol` must have saved states: `SaveAt(t1=True)` or `SaveAt(ts=...)`, without `subs`.")
    if not isinstance(sol.ys, tuple | list) or len(sol.ys) != 2:
        raise ValueError("`sol.ys` must hold states of this mechanism: leave out `SaveAt(fn=...)`.")
    for part in sol.ys:
        refuse_other_bodies(mechanism, part)
