"""Consistent initial states: how far a state is off, and the nearest one that is not."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PyTree

from .compiler import at_ease, quickly_compiled
from .equations.constraint_jacobian import dense_mass, of_free, shortest
from .equations.initial_rates import is_nonlinear, rates_of
from .equations.linearised import LinearisedResidual
from .equations.manifold_ode import constant
from .equations.mechanical import MechanicalODE
from .equations.nearest_point import nearest_point
from .equations.raised_index import FOR_VALUES
from .equations.regularity import ALONG, mass_is_regular, mass_message
from .equations.residual_form import ResidualForm, weighted
from .equations.structural_ode import StructuralODE
from .linalg import fixed_point, implicit_root, relative_change, take
from .systems import ConstrainedSystem, System, is_mechanism
from .types import Args, Flat, Phase, State, Time
from .validate.captured import current
from .validate.closures import opened
from .validate.states import as_floats, broadcast_to_state, refuse_not_finite, refuse_wrong_state, with_rates
from .validate.user_functions import refuse_wrong_functions


# How many equations a message lists.
LISTED = 12


class Violation(eqx.Module):
    """By how much a state (q, v) violates its constraints.

    `residuals`: g and (ġ, h); `distances`: the same divided by the length of each constraint's gradient, that is about
    how far the state is from satisfying it; `allowed`: the distance that counts as round-off of the user's numbers.
    """

    residuals: tuple[Float[Array, " m"], Float[Array, " mp"]]
    distances: tuple[Float[Array, " m"], Float[Array, " mp"]]
    allowed: tuple[Float[Array, " m"], Float[Array, " mp"]]

    def consistent(self) -> Bool[Array, ""]:
        """Whether every level is within `allowed`; false for NaN."""
        within = [jnp.all(d <= a) for d, a in zip(self.distances, self.allowed, strict=True)]
        return jnp.asarray(within[0] & within[1])

    def message(self) -> str:
        """Which equations are off, at which level and by how much."""
        lines = []
        names = (("position level", "g"), ("velocity level", "dg/dt, then h"))
        for (level, symbol), residual, distance, allowed in zip(
            names, self.residuals, self.distances, self.allowed, strict=True
        ):
            for i in np.flatnonzero(~(np.asarray(distance) <= np.asarray(allowed))):
                lines.append(f"  {level}: 0 = constraint[{i}] ({symbol}) is off by {float(residual[i]):.6g}")
        return "The initial state `y0` violates the constraints:\n" + "\n".join(lines)


def violation(ode: MechanicalODE, t: Time, y: Phase) -> Violation:
    """How far the flat state y = (q, v) is from the manifold."""
    q, v = y
    eps = jnp.finfo(q.dtype).eps
    of_q, of_v = (eps**0.5 * size for size in ode.sizes(t, y, (_of_entries(q), _of_entries(v))))
    # A mechanism of micrometres: what is more than a part of itself off is no round-off, whatever the unit.
    of_q = jnp.minimum(of_q, jnp.maximum(eps**0.25 * jnp.max(jnp.abs(q)), 1e4 * eps))
    return Violation(ode.invariants(t, y), ode.distances(t, y), (of_q, of_v))


def _of_entries(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """A part √ε of which is round-off of the user's numbers: for each its own size, as lengths of 1e7 say nothing of the angles beside
    them. But what is computed along with large ones has their round-off.
    """
    return 1 + jnp.abs(x) + ALONG * jnp.finfo(x.dtype).eps ** 0.5 * jnp.max(jnp.abs(x))


class Unsolved(eqx.Module):
    """What is left of the equations and the hidden ones for the best derivatives, and how much of it counts as round-off
    of the user's numbers; how large it is for variables as they were `on_the_way` here, as one that is large may just cross zero.
    Whether `several` derivatives satisfy the equations.
    """

    residuals: Float[Array, " m"]
    allowed: Float[Array, " m"]
    on_the_way: Float[Array, " m"]
    equations: tuple[str, ...] = eqx.field(static=True)
    several: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(False))

    def consistent(self) -> Bool[Array, ""]:
        """Whether every equation has a solution; false for NaN."""
        return jnp.all(jnp.abs(self.residuals) <= self.allowed)

    def as_part(self) -> Float[Array, ""]:
        """By which part of the state on the way here the worst equation is off, round-off aside."""
        off = jnp.abs(self.residuals) - self.allowed
        return jnp.max(off / jnp.where(self.on_the_way > 0, self.on_the_way, 1), initial=0)

    def message(self) -> str:
        """Which equations are off, and by how much."""
        residuals, allowed = np.abs(np.asarray(self.residuals)), np.asarray(self.allowed)
        off = np.flatnonzero(~(residuals <= allowed))
        sizes = residuals[off] / np.maximum(allowed[off], np.finfo(allowed.dtype).tiny)
        by_size = np.lexsort((-np.nan_to_num(sizes), ~np.isnan(residuals[off])))
        worst = np.sort(off[by_size[:LISTED]])
        lines = [f"  0 = {self.equations[i]} is off by {float(self.residuals[i]):.6g}" for i in worst]
        lines += [f"  and {len(off) - LISTED:,} more"] if len(off) > LISTED else []
        return "The initial state `y0` violates the equations, whatever its derivatives:\n" + "\n".join(lines)


def unsolved(system: System, t: Time, state: State, args: Args, way: tuple[State, Time] | None = None) -> Unsolved:
    """What no derivatives of a state make vanish of the equations of a system that is no mechanism. `way`: the state at the start of
    the solve that has led here, and how long it was.
    """
    form = ResidualForm.of(system, t, state, args)
    y = form.encode(state)
    t = jnp.asarray(t, y.dtype)
    start, span = (y, jnp.zeros_like(t)) if way is None else (form.encode(way[0]), way[1])
    linearised = LinearisedResidual.of(form, y)
    if linearised.structure.hidden:
        ode = StructuralODE.of(form, y.dtype, complete=1)
        return _left_over(ode, t, ode.encode(t, state), start, span)
    several = rates_of(form, t, y)[1] if is_nonlinear(form, y.dtype) else jnp.asarray(False)
    yd = linearised.ydot(t, y)
    j, m = linearised.jacobians(t, y, yd)
    apply, root = linearised.storage.apply, jnp.finfo(y.dtype).eps ** 0.5
    largest = _on_the_way(y, start, yd, span)
    sizes = lambda x, xd: apply(jnp.abs(j), x) + apply(jnp.abs(m), xd)
    own, on_the_way = sizes(_of_entries(y), _of_entries(yd)), sizes(1 + largest, 1 + jnp.abs(yd))
    return Unsolved(linearised.residual(t, y, yd), root * own, on_the_way, form.equations, several)


def _left_over(ode: StructuralODE, t: Time, y: Float[Array, " N"], start: Flat, span: Time) -> Unsolved:
    root = jnp.finfo(y.dtype).eps ** 0.5
    # Derivatives of the highest order are not in the state.
    ydot = take(jnp.concatenate([y, jnp.zeros_like(start)]), ode.orders.derivatives)
    largest = _on_the_way(y, take(start, ode.orders.values), ydot, span)
    own, on_the_way = ode.sizes(t, y, (_of_entries(y), 1 + largest))
    return Unsolved(ode.violations(t, y), root * own, on_the_way, ode.invariant_names)


def _on_the_way(y: Flat, start: Flat, ydot: Flat, span: Time) -> Flat:
    """How large each variable has been on the way from `start`, as far as its ends show; over a second, where that is long."""
    return jnp.maximum(jnp.maximum(jnp.abs(y), jnp.abs(start)), jnp.minimum(span, 1) * jnp.abs(ydot))


@at_ease
def consistent_state(
    system: System,
    t0: Time,
    y0: State,
    args: Args = None,
    *,
    fixed: State = None,
    rates: State = None,
    yd0: State = None,
) -> Any:
    """The nearest state that satisfies the equations and the hidden ones.

    For a `ConstrainedSystem`, positions first: the q with g(t₀, q) = 0 nearest to q₀ in the metric of the mass matrix at
    q₀; then the v with G v + g_t = 0 and h = 0 nearest to v₀ in the same metric. For other systems all entries count
    alike, and the derivatives are whatever the equations ask for. Differentiable with respect to `y0` and `args`.

    **Arguments**

    - `fixed`: a pytree of booleans (or boolean arrays) with the structure of `y0`; entries marked true are kept, such as
      the differential variables of a circuit.
    - `rates`: ẏ in the structure of `y0`, where that is given: all 0 for a state of rest. It counts for the variables
      whose derivative occurs in the equations. All entries of the state then count alike for mechanisms also.
    - `yd0`: near which ẏ is looked for, for an `ImplicitDAE` that is nonlinear in it.

    Errors: `ValueError` where no such state is found from here, naming the equations that remain off; NaN where the arguments are
    traced, of a mechanism within `jit` and `vmap` only.
    """
    return _consistent(system, t0, y0, args, fixed, rates, yd0)


def consistent_after(system: System, t: Time, y: State, args: Args, fixed: State, raised: bool = False) -> Any:
    """The nearest consistent state to one that a reset has made. Of a system that is no mechanism, variables whose derivative occurs in
    the equations alone count for the distance, if they move less so: who lets a ball bounce does not say what becomes of a contact's
    force, and no part of the way to that is one of its velocity. `raised`: whether the index may be higher than the structure has it.
    """
    return _consistent(system, t, y, args, fixed, keeps=True, raised=raised)


def _consistent(
    system: System,
    t0: Time,
    y0: State,
    args: Args,
    fixed: State,
    rates: State = None,
    yd0: State = None,
    keeps: bool = False,
    raised: bool = False,
) -> Any:
    refuse_wrong_state(system, y0)
    system, args = opened(current((with_rates(system, yd0, y0), args)))
    y0 = as_floats(y0)
    refuse_not_finite("y0", y0)
    refuse_wrong_functions(system, t0, y0, args)
    masks = jax.tree.map(lambda x: jnp.zeros_like(x, dtype=bool), y0)
    if fixed is not None:
        masks = jax.tree.map(lambda f: f.astype(bool), broadcast_to_state("fixed", fixed, y0, "booleans"))
    if rates is not None:
        rates = broadcast_to_state("rates", rates, y0, "numbers")
        rates = jax.tree.map(lambda r, x: r.astype(x.dtype), rates, y0)
    if is_mechanism(system) and rates is None:
        found, fine, remains = _nearest_of_mechanism(system, t0, y0, args, masks)
    else:
        found, fine, remains = _nearest_of_any(system, t0, y0, args, masks, rates, keeps, raised)
    if not isinstance(fine, Tracer) and not bool(fine):
        said, instead = "The initial state `y0` violates", "No consistent state was found near `y0`; left over are"
        raise ValueError(
            remains.message().replace(said, instead).replace(", whatever its derivatives", "")
            + "\nThe equations may contradict each other, too many entries may be fixed, or their derivatives vanish at `y0`, as at "
            "the centre of a circle: begin elsewhere then."
        )
    return found


def _nearest_of_mechanism(system: ConstrainedSystem, t: Time, y0: State, args: Args, masks: State) -> Any:
    ode = MechanicalODE.of(system, t, y0, args)
    q, v = ode.encode(y0)
    of_q, of_v = (jnp.where(mask, 0, 1).astype(q.dtype) for mask in ode.encode(masks))
    params = ode, jnp.asarray(t, q.dtype), (q, v), (of_q, of_v)
    # What derivatives are by is known where they are not within another program.
    ode, t, y, free = constant(params)
    found, fine, remains, regular = _nearest(ode, t, y, free)
    if not isinstance(regular, Tracer) and not bool(regular):
        raise ValueError(mass_message(np.asarray(dense_mass(ode.unchecked_mass(y[0]))), True, "at `y0`"))
    q, v = jnp.split(_with_derivatives(found, params), 2)
    return ode.decode(t, (q, v)), fine, remains


@quickly_compiled
def _nearest_of_any(
    system: System,
    t: Time,
    y0: State,
    args: Args,
    masks: State,
    rates: State,
    keeps: bool = False,
    raised: bool = False,
) -> Any:
    form = ResidualForm.of(system, t, y0, args)
    values = form.encode(y0)
    t = jnp.asarray(t, values.dtype)
    ode = StructuralODE.of(form, values.dtype, FOR_VALUES if raised else 1)
    rates = None if rates is None else form.encode(rates)
    freedom = jnp.where(form.encode(masks), 0, 1)

    def nearest(ode: StructuralODE, values: Flat, counted: Bool[Array, " n"]) -> tuple[Flat, Unsolved]:
        y = ode.start(t, values, freedom, rates, counted)
        return y, _left_over(ode, t, y, values, jnp.zeros_like(t))

    counted = jnp.ones(values.shape, bool)
    if keeps and not (own := LinearisedResidual.of(form, values).structure.differential).all():
        still, held = constant((ode, values))

        def moved(counted: Bool[Array, " n"]) -> Float[Array, ""]:
            y, remains = nearest(still, held, counted)
            way = jnp.where(own, form.encode(ode.decode(t, y)) - held, 0)
            return jnp.where(remains.consistent(), jnp.sum(way**2), jnp.inf)

        # Where others cannot follow, as z of x² + z² = 1 from 0, there may be no such state, or one farther off.
        kept, alike = jax.lax.map(moved, jnp.stack([own, counted]))
        counted = jnp.where(kept <= alike, own, counted)
    y, remains = nearest(ode, values, counted)
    fine = remains.consistent()
    return jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), ode.decode(t, y)), fine, remains


@quickly_compiled
def _nearest(ode: MechanicalODE, t: Time, y: Phase, free: Phase) -> Any:
    params = ode, t, y, free
    (q0, v0), (of_q, _) = y, free
    start = jnp.concatenate([q0, v0])
    mass = of_free(dense_mass(ode.mass(q0)), of_q)
    near = nearest_point(
        lambda x, aim: _improved(x, aim, params),
        start,
        lambda x: start,
        lambda a, b: jnp.sum(a[: q0.size] * weighted(mass, b[: q0.size])),
        jnp.concatenate([of_q > 0, jnp.zeros_like(of_q, bool)]),
        jnp.concatenate(
            [weighted(mass, jnp.ones_like(q0)) if mass is None or mass.ndim < 2 else jnp.diagonal(mass), 0 * q0]
        ),
    )

    def correct(x: Float[Array, " 2n"]) -> Any:
        new = _improved(x, x, params)
        return new, relative_change(new - x, x)

    # What is left of the constraints at the nearest point.
    x, _ = fixed_point(correct, near, max_steps=100)
    q, v = jnp.split(x, 2)
    remains, regular = violation(ode, t, (q, v)), mass_is_regular(ode, q0, True)
    found = remains.consistent() & regular
    return jnp.where(found, x, jnp.nan), found, remains, regular


def _with_derivatives(x: Float[Array, " 2n"], params: PyTree) -> Float[Array, " 2n"]:
    """What has been found, with its derivatives by what it was found for."""
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(params))
    return _implicit(x, params) if traced else x


@eqx.filter_jit
def _implicit(x: Float[Array, " 2n"], params: PyTree) -> Float[Array, " 2n"]:
    def off(x: Float[Array, " 2n"], given: PyTree) -> Float[Array, " 2n"]:
        return x - _improved(x, jnp.concatenate(given[1][2]), given[1])

    return implicit_root(off, lambda given: (given[0], None), (x, params))[0]


def _improved(x: Float[Array, " 2n"], aim: Float[Array, " 2n"], params: PyTree) -> Float[Array, " 2n"]:
    """The q next to that of `aim` on the linearisation of the constraints at x, and there the v next to the given one."""
    ode, t, (q0, v0), (of_q, of_v) = params
    q, v = jnp.split(x, 2)
    m = ode.holonomic
    a, mass = ode.constraint_jacobian(t, q, v), ode.mass(q0)
    g, _ = ode.invariants(t, (q, v))
    towards = aim[: q.size]
    q = towards - shortest(a[:m], mass, of_q, g + jnp.dot(a[:m], towards - q)) if m else towards
    _, h = ode.invariants(t, (q, v))
    v = v0 - shortest(a, mass, of_v, h + jnp.dot(a, v0 - v))
    return jnp.concatenate([q, v])
