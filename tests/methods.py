"""The table of methods that the property tests run over."""

import dataclasses
from typing import Any

import diffrax
import jax.numpy as jnp

import dae_jax


def pendulum_chart(z):
    """q of the pendulum at the angle z from the downward vertical."""
    return jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])])


@dataclasses.dataclass(frozen=True)
class Method:
    name: str
    solver: Any
    order: float
    keeps: bool = False
    formulation: Any = None
    adaptive: bool = False
    # Another tableau inside the same code: derivatives and batches are those of the first.
    twin: bool = False


METHODS = [
    Method("differentiation", diffrax.Tsit5(), 5, adaptive=True),
    Method("differentiation-dop853", dae_jax.DOP853(), 8, adaptive=True),
    Method("baumgarte", diffrax.Tsit5(), 5, formulation=dae_jax.Baumgarte(2.0, 2.0), adaptive=True),
    Method("projection-euler", dae_jax.OrthogonalProjection(diffrax.Euler()), 1, True, twin=True),
    Method("projection-tsit5", dae_jax.OrthogonalProjection(diffrax.Tsit5()), 5, True, adaptive=True),
    Method("projection-dopri8", dae_jax.OrthogonalProjection(diffrax.Dopri8()), 8, True, adaptive=True, twin=True),
    Method("projection-dop853", dae_jax.OrthogonalProjection(dae_jax.DOP853()), 8, True, adaptive=True),
    Method("projection-trapezoid", dae_jax.OrthogonalProjection(dae_jax.Trapezoid()), 2, True, twin=True),
    Method("trapezoid", dae_jax.Trapezoid(), 2),
    Method("midpoint", dae_jax.Midpoint(), 2, twin=True),
    Method("gauss4", dae_jax.Gauss4(), 4),
    Method("symmetric-trapezoid", dae_jax.SymmetricProjection(dae_jax.Trapezoid()), 2, True),
    Method("symmetric-midpoint", dae_jax.SymmetricProjection(dae_jax.Midpoint()), 2, True, twin=True),
    Method("symmetric-gauss4", dae_jax.SymmetricProjection(dae_jax.Gauss4()), 4, True, twin=True),
    Method("tangent-tsit5", dae_jax.TangentSpace(diffrax.Tsit5()), 5, True, adaptive=True),
    Method("tangent-dopri8", dae_jax.TangentSpace(diffrax.Dopri8()), 8, True, adaptive=True, twin=True),
    Method("state-space", diffrax.Tsit5(), 5, True, dae_jax.StateSpace(pendulum_chart), adaptive=True),
    Method("radau", dae_jax.RadauIIA5(), 5, adaptive=True),
    Method("rattle", dae_jax.RATTLE(), 2, True),
]
