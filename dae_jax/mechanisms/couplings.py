"""Gears, racks and screws: coordinates of joints that go together."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..types import Args, Time
from .bodies import Numbers, numbers
from .configuration import Configuration, Coordinate, Kind, Marker
from .interface import AbstractHolonomicJoint, AbstractJoint, only_coordinate


# A ratio counts as whole up to this.
WHOLE = 1e-9


class Coupling(AbstractHolonomicJoint):
    """Two coordinates that go together, c₁ = Σ aₖ c₂ᵏ: a gear, a rack, a screw. Whole turns of an angle c₁ in space do not count."""

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    first: Coordinate
    second: Coordinate | None
    coefficients: Float[Array, " k"]

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        other = jnp.zeros(()) if self.second is None else self.second(at)
        return self.first.off(at, jnp.polyval(self.coefficients[::-1], other))[None]

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {}


def coupling(
    first: AbstractJoint | Coordinate,
    second: AbstractJoint | Coordinate | None,
    coefficients: Numbers,
    *,
    name: str | None = None,
) -> Coupling:
    """Two coordinates that go together, c₁ = Σ aₖ c₂ᵏ, or one that is held, c₁ = a₀.

    **Arguments**

    - `first`, `second`: joints with one coordinate, or their coordinates. `Mechanism.reaction` is that on the second body of `first`
      (where that is the ground, the opposite of that on its first body).
    - `coefficients`: (a₀, a₁, ...): (0, −2) is a gear of ratio 2 that turns the other way.

    Errors: `ValueError` for an angle in space that would have to count its turns, which are not known there: c₂ may be one where
    the coupling is linear and either c₁ is none, or a₁ or 1/a₁ is a whole number.
    """
    one, other = only_coordinate(first), None if second is None else only_coordinate(second)
    # Whichever coordinate the equation is solved for, the reaction is that on the body of the first.
    on_a, on_b = one.on_a, one.on_b
    label = f"coupling of {one.name}" if name is None else name
    a = numbers(f"Joint {label!r}: `coefficients`", coefficients)
    if a.ndim > 1 or not a.size:
        raise ValueError(f"Joint {label!r}: `coefficients` must be (a₀, a₁, ...), but has the shape {a.shape}.")
    # Of what is known, `atleast_1d` is known no more in `jit`.
    a = _without_zeros(a if a.ndim else a[None])
    if other is None and len(a) > 1:
        raise ValueError(
            f"Joint {label!r}: without a second coordinate a₀ is all of `coefficients`, which has {len(a)}."
        )
    if other is not None and other.is_turn and len(a) > 1:
        ratio = None if isinstance(a, Tracer) else float(np.asarray(a)[1])
        whole = lambda x: abs(x - round(x)) < WHOLE
        follows, leads = (False, False) if ratio is None else (whole(ratio), ratio != 0 and whole(1 / ratio))
        if len(a) > 2 or (one.is_turn and not (follows or leads)):
            raise ValueError(
                f"Joint {label!r}: {other.name!r} has an angle in space, whose turns are not known: its powers, and multiples that are "
                "not whole (or 1 over a whole number), would change with each. In the plane any will do."
            )
        if not (one.is_turn and follows):
            # c₂ = (c₁ − a₀)/a₁ is the same, and smooth whatever turns c₂ has made.
            one, other, a = other, one, jnp.stack([-a[0], jnp.ones_like(a[0])]) / a[1]
    return Coupling(label, on_a, on_b, one, other, a)


def _without_zeros(a: Float[Array, " k"]) -> Float[Array, " k"]:
    if isinstance(a, Tracer):
        return a
    needed = np.flatnonzero(np.asarray(a)).max(initial=0) + 1
    return a if needed == len(a) else a[:needed]
