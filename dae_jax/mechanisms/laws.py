"""What acts along a coordinate: springs, friction and drives, as laws of its value and its rate."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..types import Args, Scalar, Time


# Nearer to half a turn than this an angle in space may be on either side of it.
HALF_TURN = np.pi - 0.1


class Law(eqx.Module):
    """An effort τ(t, c, ċ), and the energy that it is from where it is from one."""

    @abc.abstractmethod
    def effort(self, t: Time, c: Scalar, rate: Scalar, args: Args) -> Scalar:
        """τ."""

    @abc.abstractmethod
    def energy(self, c: Scalar) -> Scalar | None:
        """V(c)."""


class Spring(Law):
    """τ = −k (c − c₀); of an angle in space, whose turns are not known, NaN near half a turn, so that none passes it unseen."""

    stiffness: Float[Array, ""]
    rest: Float[Array, ""]
    is_turn: bool = eqx.field(static=True)

    def effort(self, t: Time, c: Scalar, rate: Scalar, args: Args) -> Scalar:
        known = (jnp.abs(c) < HALF_TURN) | (not self.is_turn)
        return -self.stiffness * jnp.where(known, c - self.rest, jnp.nan)

    def energy(self, c: Scalar) -> Scalar | None:
        return self.stiffness * (c - self.rest) ** 2 / 2


class Friction(Law):
    """τ = −d ċ − τ_C tanh(ċ/ε)."""

    viscous: Float[Array, ""]
    coulomb: Float[Array, ""] | None
    smoothing: Float[Array, ""]

    def effort(self, t: Time, c: Scalar, rate: Scalar, args: Args) -> Scalar:
        dry = 0 if self.coulomb is None else self.coulomb * jnp.tanh(rate / self.smoothing)
        return -self.viscous * rate - dry

    def energy(self, c: Scalar) -> Scalar | None:
        return None


class Drive(Law):
    """τ = torque(t, c, ċ, args)."""

    torque: Callable[..., Array] | Float[Array, ""]

    def effort(self, t: Time, c: Scalar, rate: Scalar, args: Args) -> Scalar:
        given = jnp.asarray(self.torque(t, c, rate, args) if callable(self.torque) else self.torque)
        if jnp.iscomplexobj(given):
            raise ValueError(
                "`torque(t, c, rate, args)` of a motor must return a real number, but returns a complex one."
            )
        if given.size != 1:
            raise ValueError(
                f"`torque(t, c, rate, args)` of a motor must return a number, but what it returns has the shape {given.shape}."
            )
        return jnp.reshape(given, ()).astype(c.dtype)

    def energy(self, c: Scalar) -> Scalar | None:
        return None
