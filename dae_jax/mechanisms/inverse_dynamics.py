"""Inverse dynamics: the efforts of motors that do what leads a mechanism.

What leads, motors with a given motion and points on a path, are constraints l(t, q) = 0 with multipliers λ beside those of the
joints, which leave the velocities G v = 0. Motors of efforts τ along coordinates c(q) do the same where, for each of these,

    vᵀ Cᵀ τ = −vᵀ Lᵀ λ,    C = ∂c/∂q, L = ∂l/∂q:        P Cᵀ τ = −P Lᵀ λ,    P = 1 − G⁺G,

the principle of virtual power. Where motors reach what is led by way of the dynamics only (a load on a crane's rope), there is no
such τ: the efforts are unknowns of an `ImplicitDAE` of higher index, which `analyse` finds.

Source: A. A. Shabana, *Computational Dynamics*, section 5.10; W. Blajer, K. Kołodziejczyk, *A geometric approach to solving problems
of control constraints*, Multibody System Dynamics 11 (2004), 343–364.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..solution import DAESolution
from ..types import Args, Scalar, Time
from .configuration import Coordinates
from .outputs import at_saved_times, coordinate_named, leading_force
from .paths import LEADING


if TYPE_CHECKING:
    from .mechanism import Mechanism

# What is left of the largest force that leads, up to this part, is round-off.
ROUND_OFF = 1e-6


def inverse_dynamics(
    mechanism: "Mechanism", sol: DAESolution, motors: Sequence[str]
) -> dict[str, Float[Array, " times"]]:
    """τ of each motor."""
    if isinstance(motors, str) or not motors:
        raise ValueError(f"`motors` must be names of joints, as ['hinge'], but is {motors!r}.")
    along = [coordinate_named(mechanism, name) for name in motors]
    leading = [joint for joint in mechanism.joints if isinstance(joint, LEADING)]
    if not leading:
        raise ValueError("Nothing leads the mechanism: it has no `point_on_path` and no `motor(..., motion=...)`.")
    asked = jnp.sum(jnp.stack([leading_force(mechanism, sol, joint.name) for joint in leading]), 0)
    rows = mechanism.rows()
    taken = np.array([row for joint in leading for row in rows[joint.name][0]])

    def efforts(t: Time, y: tuple[Coordinates, Coordinates], force: Array, args: Args) -> tuple[Array, Scalar, Scalar]:
        q, v = y
        flat = lambda slopes: slopes.values.reshape(-1, force.size)
        joints = jnp.delete(flat(jax.jacfwd(lambda q: mechanism.constraint(t, q, args))(q)), taken, axis=0)
        rolling = flat(jax.jacfwd(lambda v: mechanism.nonholonomic(t, q, v, args))(v))
        reach = flat(jax.jacfwd(lambda q: jnp.stack([c(mechanism.configuration(q)) for c in along]))(q))
        free = _free(jnp.concatenate([joints, rolling]))
        wanted, can = free @ jnp.ravel(force), free @ reach.T
        tau = jnp.linalg.lstsq(can, wanted, rcond=_half_of_the_digits(can))[0]
        return tau, jnp.linalg.norm(can @ tau - wanted), jnp.linalg.norm(wanted)

    tau, left, wanted = at_saved_times(sol, efforts, asked)
    beyond = left > ROUND_OFF * jnp.max(wanted)
    if isinstance(beyond, Tracer):
        tau = jnp.where(beyond[:, None], jnp.nan, tau)
    elif np.any(beyond):
        _refuse(motors, float(np.asarray(sol.ts)[np.argmax(beyond)]), float(np.max(left / wanted)))
    return dict(zip(motors, tau.T, strict=True))


def _free(rows: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """P, on the velocities that rows of constraints leave."""
    if not len(rows):
        return jnp.eye(rows.shape[1], dtype=rows.dtype)
    _, s, vt = jnp.linalg.svd(rows, full_matrices=False)
    held = vt * (s > _half_of_the_digits(rows) * s[0])[:, None]
    return jnp.eye(rows.shape[1], dtype=rows.dtype) - held.T @ held


def _half_of_the_digits(x: Array) -> float:
    return float(jnp.finfo(x.dtype).eps) ** 0.5


def _refuse(motors: Sequence[str], t: float, part: float) -> None:
    raise ValueError(
        f"Motors on {', '.join(map(repr, motors))} cannot do what leads the mechanism: at t = {t:.6g} up to {part:.2g} of it is left. "
        "Name a motor for each degree of freedom. Where what is led moves by way of the dynamics only, as a load on a crane's "
        "rope, efforts are unknowns of an `ImplicitDAE`, and the path one of its equations."
    )
