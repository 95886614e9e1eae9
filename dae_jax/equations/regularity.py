"""What must hold of a mechanism where a solve starts and where it ends: its masses, its constraints' rank, and no drift."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from ..linalg import factorised, least_sign, row_products, semidefinite_solve, smallest_pivot, solve_with
from ..types import IntScalar, Phase, Time
from .constraint_jacobian import Rank, mass_solve, matvec, unit_diagonal
from .mechanical import MechanicalODE, allowed_contradiction
from .sparse_constraint_jacobian import SparseConstraintJacobian


# A drift that counts as large as the solution itself, as a part of this: the distance to |q| = 1 is nowhere more than |q|/2.
LARGE = 0.25
# What a step may leave of the constraints that its method keeps, in parts of the tolerance, and what is left where the answer is
# not to be trusted: a thousand tolerances, or of coarse ones a few and a visible part of the solution.
LEFT = 100
DRIFTED, FEW, VISIBLE = 1000, 10, 0.05
# The change of the constraints' gradients on the way back from a drift that is suspicious, as one part in so many of them.
FAR = 6
# Tolerances that stand in for those of fixed steps.
COARSE = 1e-3
# In digits of the largest of all numbers, what may be round-off of each that is computed along with it.
ALONG = 100
# The smallest and the largest of the tolerances of all unknowns.
Span: TypeAlias = tuple[Time, Time]


def mass_is_regular(ode: MechanicalODE, q: Float[Array, " n"], invertible: bool) -> Bool[Array, ""]:
    """Whether M(q) is symmetric and positive definite; semidefinite is enough where it need not be `invertible`."""
    mass = ode.unchecked_mass(q)
    if mass is None:
        return jnp.asarray(True)
    if mass.ndim == 3:
        return jnp.all(jax.vmap(lambda block: _is_regular(block, invertible))(mass))
    if mass.ndim < 2:
        return jnp.all(mass > 0) if invertible else jnp.all(mass >= 0)
    return _is_regular(mass, invertible)


def _is_regular(mass: Float[Array, "n n"], invertible: bool) -> Bool[Array, ""]:
    diagonal = jnp.diagonal(mass)
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    roundoff = jnp.finfo(mass.dtype).eps ** 0.75
    least = 8 * len(mass) * jnp.finfo(mass.dtype).eps if invertible else -roundoff
    scaled = mass * scale[:, None] * scale + (0 if invertible else 2 * roundoff) * jnp.eye(len(mass), dtype=mass.dtype)
    symmetric = jnp.max(jnp.abs(mass - mass.T)) <= roundoff * jnp.max(jnp.abs(mass))
    return symmetric & jnp.all(diagonal >= 0) & (smallest_pivot(scaled) > least)


def mass_message(mass: Float[np.ndarray, "..."], invertible: bool, where: str = "at the start") -> str:
    """What is wrong with a mass matrix that is not regular."""
    least = "symmetric and positive definite" if invertible else "symmetric and positive semidefinite"
    advice = ""
    if mass.ndim < 2:
        (at,) = np.nonzero(~((mass > 0) if invertible else (mass >= 0))) if mass.ndim else ([0],)
        what = f"mass[{at[0]}] is {np.atleast_1d(mass)[at[0]]:.6g}"
        massless = invertible and np.all(mass >= 0)
    elif np.max(np.abs(mass - mass.T)) > np.finfo(mass.dtype).eps ** 0.75 * np.max(np.abs(mass)):
        i, j = np.unravel_index(np.argmax(np.abs(mass - mass.T)), mass.shape)
        what = f"it is not symmetric: mass[{i}, {j}] is {mass[i, j]:.6g}, mass[{j}, {i}] is {mass[j, i]:.6g}"
        massless = False
    else:
        smallest = np.linalg.eigvalsh(mass)[0]
        what = f"its smallest eigenvalue is {smallest:.6g}"
        massless = invertible and smallest > -(np.finfo(mass.dtype).eps ** 0.75) * np.max(np.abs(mass))
    if massless:
        advice = (
            " A massless coordinate that the constraints determine is for methods that do without M⁻¹: RadauIIA5() or BDF() "
            "with GGL() or Residual(...), DummyDerivatives(), or StateSpace(...)."
        )
    return f"The mass matrix must be {least} {where}, but {what}.{advice}"


class Redundancy(eqx.Module):
    """How the constraints depend on each other at a state.

    `holonomic`, `all`: how many are independent of the holonomic ones and of all; `weak`: the least eigenvalue of A Aᵀ for
    rows of length 1; `contradiction`: the part of the accelerations' right-hand side that no multipliers can satisfy,
    relative to its size; `agree`: whether at a state nearby that satisfies as many constraints the others hold too, which
    are therefore redundant and not only dependent here; `zero`: whose gradient vanishes.
    """

    holonomic: Any
    all: Any
    weak: Float[Array, ""]
    contradiction: Float[Array, ""]
    agree: Bool[Array, ""]
    zero: Bool[Array, " mp"]


def redundancy(ode: MechanicalODE, t: Time, y: Phase) -> Redundancy:
    """Whether constraints depend on each other at the flat state y = (q, v)."""
    m = ode.holonomic
    a, scale = unit_rows(ode, t, y)
    values, vectors = jnp.linalg.eigh(a @ a.T)
    cut = jnp.finfo(a.dtype).eps ** 0.5
    independent = values > cut * values[-1]
    holonomic = jnp.sum((h := jnp.linalg.eigvalsh(a[:m] @ a[:m].T)) > cut * h[-1]) if m else 0
    target = ode.bias(t, *y) * scale
    contradiction = jnp.max(jnp.abs(jnp.where(independent, 0, vectors.T @ target))) / (1 + jnp.max(jnp.abs(target)))
    agree = _agree_nearby(ode, t, y, holonomic, jnp.sum(independent))
    return Redundancy(holonomic, jnp.sum(independent), values[0], contradiction, agree, jnp.all(a == 0, 1))


def weakest(ode: MechanicalODE, t: Time, y: Phase) -> Float[Array, ""]:
    """The smallest pivot of A Aᵀ for rows of length 1: of round-off size where constraints depend on each other."""
    if isinstance(ode.linear, SparseConstraintJacobian):
        ones = jnp.ones(ode.holonomic, y[0].dtype)
        regular = jnp.all(jnp.isfinite(ode.linear.schur_solve(ode, ode.jacobian(t, y), ones)))
        return jnp.where(regular, 1.0, 0.0).astype(y[0].dtype)
    a, _ = unit_rows(ode, t, y)
    return smallest_pivot(jnp.sum(a[:, None] * a, -1))


def unit_rows(ode: MechanicalODE, t: Time, y: Phase) -> tuple[Float[Array, "mp n"], Float[Array, " mp"]]:
    """A with rows of length 1, and what they were multiplied by; rows of zeros as they are."""
    a = ode.constraint_jacobian(t, *y)
    lengths = jnp.sqrt(jnp.sum(a * a, 1))
    scale = 1 / jnp.where(lengths > 0, lengths, 1)
    return a * scale[:, None], scale


def _agree_nearby(
    ode: MechanicalODE, t: Time, y: Phase, holonomic: IntScalar | int, rank: IntScalar | int
) -> Bool[Array, ""]:
    """Whether all constraints hold where the state has moved along the manifold of as many of them."""
    m, (q, v) = ode.holonomic, y
    eps = jnp.finfo(q.dtype).eps
    step = eps**0.25
    rng = np.random.default_rng(0)
    away = lambda x: step * (1 + jnp.max(jnp.abs(x))) * jnp.asarray(rng.uniform(-1, 1, x.shape), x.dtype)

    def nearest(a: Float[Array, "c n"], off: Float[Array, " c"], rank: IntScalar | int) -> Any:
        """The shortest x with A x = off in `rank` directions."""
        values, vectors = jnp.linalg.eigh(a @ a.T)
        kept = jnp.arange(len(values)) >= len(values) - rank
        return a.T @ (vectors @ jnp.where(kept, vectors.T @ off / jnp.where(kept, values, 1), 0))

    def corrected(_: IntScalar, y: Phase) -> Any:
        q, v = y
        a, scale = unit_rows(ode, t, (q, v))
        if m:
            q = q - nearest(a[:m], ode.constraint(t, q) * scale[:m], holonomic)
        return q, v - nearest(a, ode.velocity_constraint(t, q, v) * scale, rank)

    a, _ = unit_rows(ode, t, y)
    tangent = lambda a, x, rank: x - nearest(a, a @ x, rank)
    moved = q + tangent(a[:m], away(q), holonomic) if m else q + away(q), v + tangent(a, away(v), rank)
    nearby = jax.lax.fori_loop(0, 8, corrected, moved)
    agrees = [
        jnp.all(there <= 4 * jnp.max(here, initial=0) + eps**0.75 * (1 + jnp.max(jnp.abs(x))))
        for here, there, x in zip(ode.distances(t, y), ode.distances(t, nearby), (q, v), strict=True)
    ]
    return agrees[0] & agrees[1]


def rank_message(
    ode: MechanicalODE, found: Redundancy, given: int | Rank | None, where: str = "at the start"
) -> str | None:
    """What is wrong with the constraints' rank at a state; `None` where they are independent or redundant."""
    count = ode.holonomic + ode.nonholonomic
    rank = int(found.all)
    here = (int(found.holonomic), rank) if isinstance(given, tuple) else rank
    if given is not None and given != here:
        return (
            f"`rank` says that {given} of the {count} constraints are independent, but the constraints have rank {here} of "
            f"{count} {where}. Leave `rank` out to have it found, or correct it."
        )
    if rank == count:
        return None
    stands = f"rank {rank} of {count} {where}"
    if not bool(found.agree):
        names = [f"constraint[{i}]" for i in range(ode.holonomic)]
        names += [f"nonholonomic[{i}]" for i in range(ode.nonholonomic)]
        zero = [name for name, vanishes in zip(names, np.asarray(found.zero), strict=True) if vanishes]
        if zero:
            return (
                f"The constraints have {stands}: the gradient of {', '.join(zero)} vanishes there, so that no force "
                "belongs to it. Write the constraint itself, not its square or a multiple that is zero there, or start "
                "from another state."
            )
        if float(found.weak) > jnp.finfo(found.weak.dtype).eps ** 0.75:
            return None
        return (
            f"The constraints have {stands}, and more beside it: a singular configuration, as a dead centre or a stretched "
            "linkage is one, from which motion is not determined. Start from another state; or, where lengths are far from 1 in their "
            "unit and angles beside them, in another unit."
        )
    if float(found.contradiction) > allowed_contradiction(found.contradiction.dtype):
        return (
            f"Only {rank} of the {count} constraints are independent {where}, and the others contradict them: no "
            "acceleration satisfies all. Remove the redundant constraints or make them agree."
        )
    return None


def rank_of(ode: MechanicalODE, found: Redundancy) -> Rank | None:
    """The rank to solve with, where `rank_message` finds no fault; `None`: all are independent."""
    redundant = int(found.all) < ode.holonomic + ode.nonholonomic and bool(found.agree)
    return (int(found.holonomic), int(found.all)) if redundant else None


def has_rank(ode: MechanicalODE, t: Time, y: Phase, rank: Rank | None) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the constraints have the given rank (`None`: all are independent): to working accuracy, and beyond doubt."""
    if rank is None:
        least, eps = weakest(ode, t, y), jnp.finfo(y[0].dtype).eps
        return least > eps**0.75, least > eps**0.5
    found = redundancy(ode, t, y)
    consistent = found.contradiction <= allowed_contradiction(y[0].dtype)
    fits = (found.holonomic == rank[0]) & (found.all == rank[1]) & found.agree & consistent
    return fits, fits


def passes_singularity(ode: MechanicalODE, t0: Time, y0: Phase, t1: Time, y1: Phase, drifts: bool) -> Bool[Array, ""]:
    """Whether A₁ M₀⁻¹ A₀ᵀ has a negative pivot: between two flat states, the ends of a step, the gradients A of the constraints (of as
    many as are independent) have passed a configuration in which some depend on each other, or turned by over a right angle. Of a method
    that `drifts`, also whether the drift off the holonomic ones may have led past one.
    """
    a0, a1 = ode.constraint_jacobian(t0, *y0), ode.constraint_jacobian(t1, *y1)
    _, lifted, scale = _schur_complement(ode, y0, a0)
    turned = _is_turned(row_products(a1, lifted), scale, ode.rank and ode.rank[1])
    return turned | _drifted_over(ode, t1, y1, a1[: ode.holonomic]) if drifts and ode.holonomic else turned


def _drifted_over(ode: MechanicalODE, t: Time, y: Phase, g: Float[Array, "m n"]) -> Bool[Array, ""]:
    """Whether the gradients G at a flat state and G′ at the nearest one on the constraints, q − M⁻¹Gᵀ(G M⁻¹Gᵀ)⁻¹g to first order,
    are as different as if a configuration in which they depend on each other were near: G M⁻¹Gᵀ + c (G′ − G) M⁻¹Gᵀ has a negative pivot
    for a large c, of either sign. The drift may then have led to another branch of the motion.
    """
    schur, lifted, scale = _schur_complement(ode, y, g)
    rank = None if ode.rank is None else ode.rank[0]
    off = ode.constraint(t, y[0])
    if rank is None:
        multipliers = semidefinite_solve(schur, off)
    else:
        scaled = schur * scale[:, None] * scale
        multipliers = scale * solve_with(factorised(scaled, ((len(g), rank),)), scaled, scale * off)
    nearest = y[0] - matvec(lifted.T, multipliers)
    change = row_products(jax.jacfwd(ode.constraint, 1)(t, nearest), lifted) - schur
    return _is_turned(schur + FAR * change, scale, rank) | _is_turned(schur - FAR * change, scale, rank)


def _schur_complement(ode: MechanicalODE, y: Phase, g: Float[Array, "m n"]) -> tuple[Array, Array, Array]:
    """G M⁻¹Gᵀ, G M⁻¹, and what makes the diagonal of the first 1."""
    lifted = mass_solve(ode.mass(y[0]), g.T).T
    schur = row_products(g, lifted)
    return schur, lifted, unit_diagonal(schur)


def _is_turned(product: Float[Array, "m m"], scale: Float[Array, " m"], rank: int | None) -> Bool[Array, ""]:
    rank = len(product) if rank is None else rank
    return least_sign(jax.lax.stop_gradient(product * scale[:, None] * scale), rank) < 0


def bearable_drift(tolerance: Float[ArrayLike, "..."], size: Num[ArrayLike, "..."]) -> Float[Array, "..."]:
    """How far a solution of that size may be off what its method lets drift, and still be trusted."""
    return jnp.minimum(DRIFTED * tolerance, FEW * tolerance + VISIBLE * size)


def is_near_constraints(
    ode: MechanicalODE,
    t: Time,
    start: Phase,
    end: Phase,
    keeps: tuple[bool, bool],
    tolerances: tuple[Span, Span],
    residual: bool,
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether a flat state at the end of a solve satisfies g and (ġ, h), and whether it has drifted by more than the tolerances.

    A level that the method `keeps` must hold to round-off, or to the tolerances (relative, absolute) where it solves for a
    `residual`. One that it lets drift may be off by a part of the solution's size; of constraints that depend on each
    other, all as much as any. Where each unknown has tolerances of its own, the largest ones are allowed, and the smallest were asked for.
    """
    (rtol, largest_rtol), (atol, largest_atol) = tolerances
    root = jnp.finfo(end[0].dtype).eps ** 0.5
    size = lambda x: jnp.max(jnp.abs(x), initial=0)
    lengths = jnp.maximum(size(start[0]), size(end[0]))
    # A pendulum at rest has a natural speed too.
    field = jnp.zeros_like(end[1]) if keeps[1] else jnp.abs(ode.field(t, end)[1])
    field = jnp.where(jnp.isfinite(field), field, 0)
    natural = jnp.sqrt(size(field) * lengths)
    speeds = jnp.maximum(jnp.maximum(size(start[1]), size(end[1])), natural)
    near, drifted = jnp.asarray(True), jnp.asarray(False)
    own = tuple(jnp.maximum(jnp.abs(a), jnp.abs(b)) for a, b in zip(start, end, strict=True))
    own = own[0], jnp.maximum(own[1], jnp.sqrt(field * own[0]))
    levels = ode.distances(t, end), keeps, (lengths, speeds), ode.sizes(t, end, own)
    for distance, kept, here, each in zip(*levels, strict=True):
        by_tolerance = LEFT * (largest_atol + largest_rtol * here) if residual or not kept else 0
        allowed = root * (1 + here) + by_tolerance + (0 if kept else LARGE * here)
        near = near & jnp.all(distance <= allowed)
        if not kept:
            floor = root * (1 + each + ALONG * root * here)
            drifted = drifted | jnp.any(distance > floor + bearable_drift(atol + rtol * each, each))
    return near & _redundant_agree(ode, t, end, root), drifted & (rtol + atol > 0)


def _redundant_agree(ode: MechanicalODE, t: Time, y: Phase, root: float | np.floating) -> Bool[Array, ""]:
    """Whether constraints that depend on others are off as these are: by what they have in common, not by a difference."""
    if ode.rank is None:
        return jnp.asarray(True)
    a, scale = unit_rows(ode, t, y)
    agree = jnp.asarray(True)
    for level, rank, x in zip(ode.invariants(t, y), ode.rank, y, strict=True):
        rows = len(level)
        if rows:
            off = level * scale[:rows]
            _, vectors = jnp.linalg.eigh(a[:rows] @ a[:rows].T)
            parts = jnp.abs(matvec(vectors.T, off))
            kept, others = jnp.max(parts[rows - rank :], initial=0), jnp.max(parts[: rows - rank], initial=0)
            agree = agree & (others <= kept / 2 + root * (1 + jnp.max(jnp.abs(x))))
    return agree
