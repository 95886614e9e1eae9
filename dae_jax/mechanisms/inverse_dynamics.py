"""Inverse dynamics: the efforts of motors that do what leads a mechanism.

What leads, motors with a given motion and points on a path, are constraints l(t, q) = 0 with multipliers λ beside those of the
joints, which leave the velocities G v = 0. Motors of efforts τ along coordinates c(q) do the same where, for each of these,

    vᵀ Cᵀ τ = −vᵀ Lᵀ λ,    C = ∂c/∂q, L = ∂l/∂q:        P Cᵀ τ = −P Lᵀ λ,    P = 1 − G⁺G,

the principle of virtual power, here in coordinates scaled by √mass, so that units do not count. Where motors reach what is led by
way of the dynamics only (a load on a crane's rope), there is no such τ: the efforts are unknowns of an `ImplicitDAE` of higher
index, which `analyse` finds.

Source: A. A. Shabana, *Computational Dynamics*, section 5.10; W. Blajer, K. Kołodziejczyk, *A geometric approach to solving problems
of control constraints*, Multibody System Dynamics 11 (2004), 343–364.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..consistent import violation
from ..equations.mechanical import MechanicalODE, allowed_contradiction
from ..solution import DAESolution
from ..types import Args, Time
from .bodies import inverse_roots
from .configuration import Coordinate, Coordinates
from .outputs import at_saved_times, coordinate_named, multipliers
from .paths import LEADING


if TYPE_CHECKING:
    from .mechanism import Mechanism

# States may be off the constraints by this part of the largest coordinate, and velocity, of all times.
OFF = 1e-3
# The smallest singular value of all constraints beside the largest, in square roots of round-off: of λ it loses the square.
NEAR = 100.0


class _Found(NamedTuple):
    """At each time: τ, what it leaves undone of what is wanted, the size of the loads, and how far the state is off its constraints,
    at both levels, in parts of `sizes`.
    """

    tau: Float[Array, "times motors"]
    left: Float[Array, " times"]
    wanted: Float[Array, " times"]
    loads: Float[Array, " times"]
    off: Float[Array, "times 2"]
    sizes: Float[Array, "times 2"]


def inverse_dynamics(
    mechanism: "Mechanism", sol: DAESolution, motors: Sequence[str]
) -> dict[str, Float[Array, " times"]]:
    """τ of each motor."""
    if isinstance(motors, str) or not motors or len(set(motors)) < len(motors):
        raise ValueError(f"`motors` must be names of joints, each once, as ['hinge'], but is {motors!r}.")
    along = [coordinate_named(mechanism, name) for name in motors]
    leading = [joint for joint in mechanism.joints if isinstance(joint, LEADING)]
    if not leading:
        raise ValueError("Nothing leads the mechanism: it has no `point_on_path` and no `motor(..., motion=...)`.")
    rows = mechanism.rows()
    led = tuple(row for joint in leading for row in rows[joint.name][0])
    lam = multipliers(mechanism, sol)[..., np.array(led)]
    if lam.ndim > 2:
        raise ValueError(
            "`inverse_dynamics` takes one solution, but `sol` is a batch: "
            "`jax.vmap(lambda sol: mechanism.inverse_dynamics(sol, motors))(sol)`."
        )
    efforts = functools.partial(_efforts, led=led, rank=sol.rank)
    found = at_saved_times(sol, efforts, (mechanism, along), lam)
    return dict(zip(motors, _checked(motors, sol, found).T, strict=True))


def _efforts(
    what: tuple["Mechanism", list[Coordinate]],
    t: Time,
    y: tuple[Coordinates, Coordinates],
    lam: Array,
    args: Args,
    led: tuple[int, ...],
    rank: int | None,
) -> _Found:
    (mechanism, along), (q, v), taken = what, y, np.array(led)
    ode = MechanicalODE.of(mechanism.system(), t, y, args)
    flat_q, flat_v = ode.encode(y)
    scale = inverse_roots(mechanism.mass(q, args))
    flat = lambda slopes: slopes.values.reshape(-1, scale.size) * scale
    given = flat(jax.jacfwd(lambda q: mechanism.constraint(t, q, args))(q))
    rolling = flat(jax.jacfwd(lambda v: mechanism.nonholonomic(t, q, v, args))(v))
    reach = flat(jax.jacfwd(lambda q: jnp.stack([c(mechanism.configuration(q)) for c in along]))(q))
    free = _free(jnp.concatenate([jnp.delete(given, taken, axis=0), rolling]))
    wanted, can = -free @ (given[taken].T @ lam), free @ reach.T
    tau = jnp.linalg.pinv(can, rtol=_half_of_the_digits(can)) @ wanted
    s = jnp.linalg.svd(_of_length_one(jnp.concatenate([given, rolling])), compute_uv=False)
    independent = s[(rank or len(s)) - 1] > NEAR * _half_of_the_digits(s) * s[0]
    tau = jnp.where(independent, tau, jnp.nan)
    loads = jnp.linalg.norm(scale * ode.force(t, flat_q, flat_v))
    off = jnp.stack([jnp.max(d, initial=0) for d in violation(ode, t, (flat_q, flat_v)).distances])
    sizes = jnp.stack([jnp.max(jnp.abs(x)) for x in (flat_q, flat_v)])
    return _Found(tau, jnp.linalg.norm(can @ tau - wanted), jnp.linalg.norm(wanted), loads, off, sizes)


def _checked(motors: Sequence[str], sol: DAESolution, found: _Found) -> Float[Array, "times motors"]:
    """τ where it is one."""
    eps = float(jnp.finfo(found.tau.dtype).eps)
    lost = ~jnp.all(jnp.isfinite(found.tau), 1)
    known = lambda x: jnp.max(jnp.where(jnp.isfinite(x), x, 0), 0)
    off = jnp.any(found.off > OFF * known(found.sizes) + eps**0.5, 1)
    # Where all that leads is in balance without it, nothing is wanted but round-off.
    allowed = allowed_contradiction(found.tau.dtype) * known(found.wanted) + eps**0.75 * known(found.loads)
    beyond = found.left > allowed
    if isinstance(beyond, Tracer):
        return jnp.where((lost | off | beyond)[:, None], jnp.nan, found.tau)
    first = lambda when: f"{float(np.asarray(sol.ts)[np.argmax(when)]):.6g}"
    if np.any(off):
        place, speed = np.max(found.off, 0)
        raise ValueError(
            f"`sol` must be a solution of this mechanism, with what leads it, but at t = {first(off)} it is off the equations: by up to "
            f"{place:.2g} in place (m, or rad of an angle) and {speed:.2g} in velocity."
        )
    if np.any(lost):
        raise ValueError(
            f"At t = {first(lost)} efforts are not determined: the joints and what leads depend on each other there (a singular "
            "configuration, such as an arm stretched out that is led by its tip), or a load is not a number. Save other times, or lead "
            "the joints by `motor(..., motion=...)`."
        )
    if np.any(beyond):
        part = float(np.max(np.where(beyond, found.left / found.wanted, 0)))
        raise ValueError(
            f"Motors on {', '.join(map(repr, motors))} cannot do what leads the mechanism: at t = {first(beyond)} up to {part:.2g} of it "
            "is left. Name a motor for each degree of freedom. Where what is led moves by way of the dynamics only, as a load on a "
            "crane's rope, efforts are unknowns of an `ImplicitDAE`, and the path one of its equations."
        )
    return found.tau


def _free(rows: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """P, on the velocities that rows of constraints leave."""
    n = rows.shape[1]
    if not len(rows):
        return jnp.eye(n, dtype=rows.dtype)
    rows = _of_length_one(rows)
    # Singular vectors of values that are equal, as those of one hinge are, have no derivative; the pseudoinverse has.
    return jnp.eye(n, dtype=rows.dtype) - jnp.linalg.pinv(rows, rtol=_half_of_the_digits(rows)) @ rows


def _of_length_one(rows: Float[Array, "m n"]) -> Float[Array, "m n"]:
    lengths = jnp.linalg.norm(rows, axis=1, keepdims=True)
    return rows / jnp.where(lengths > 0, lengths, 1)


def _half_of_the_digits(x: Array) -> float:
    return float(jnp.finfo(x.dtype).eps) ** 0.5
