"""What a derivative may be by, and a change of it that is like none that a user asks for."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..compiler import without_checks
from ..equations.consistent_change import consistent_change
from ..equations.manifold_ode import constant
from ..equations.mechanical import MechanicalODE
from ..equations.residual_form import ResidualForm
from ..systems import System, is_mechanism
from ..types import Args, Flat, Scalar, State, Time
from .problem import Problem


if TYPE_CHECKING:
    from .program import Solve


# Parameters change by this part of them. What they lead to counts where changes of the start have died down, and does not hide these
# elsewhere: errors are relative to the largest of all that changes, a multiplier too.
PARAMETERS = 0.1
# Where between the start and the end: not where what has a period is 0 again.
BETWEEN = 0.381966
# By how many units in the last place of its largest number a state may be off.
NOISE = 100


def changing(solve: "Solve", problem: Problem) -> tuple[Any, Any]:
    """What a derivative may be by, the inexact arrays in (formulation, system, args) and the start, and all else of these."""
    return eqx.partition(((solve.formulation, problem.system, problem.args), problem.y0), eqx.is_inexact_array)


def with_changes(solve: "Solve", problem: Problem, given: Any) -> tuple["Solve", Problem]:
    """The same with others of what is `changing`."""
    (formulation, system, args), y0 = given
    return (
        dataclasses.replace(solve, formulation=formulation),
        dataclasses.replace(problem, system=system, args=args, y0=y0),
    )


def some_changes(solve: "Solve", problem: Problem, end: tuple[Time, State], consistent: bool) -> Any:
    """A change of all that is `changing`, by no pattern, and, where the start must stay `consistent` and parameters may change the index,
    one of the start alone. Nothing changes where no such is found: then steps are those of the solution.
    """
    (parameters, start), (fixed, _) = changing(solve, problem)
    units = _units(problem, parameters, fixed, end)
    of_parameters = _by_no_pattern(parameters, lambda x: PARAMETERS * jnp.where(x == 0, units, jnp.abs(x)))
    change = _by_no_pattern(start, lambda x: 1 + jnp.abs(x))
    if not consistent:
        return jax.tree.map(lambda x: x[None], (of_parameters, change))
    system, t0, y0, args = problem.start
    # In any metric, where a mass may be 0.
    without_mass = lambda x: eqx.tree_at(lambda x: x.mass, x, None, is_leaf=lambda x: x is None)
    metric = without_mass if is_mechanism(system) else lambda x: x

    @functools.partial(jax.vmap, axis_size=2)
    def changes(of_parameters: Any) -> Any:
        along = consistent_change(metric(system), t0, y0, change, args, (metric(of_parameters[1]), of_parameters[2]))
        found = jnp.all(jnp.isfinite(ravel_pytree(along)[0]))
        return jax.tree.map(lambda x: jnp.where(found, x, 0), (of_parameters, along))

    return changes(jax.tree.map(lambda x: jnp.stack([x, jnp.zeros_like(x)]), of_parameters))


def _by_no_pattern(tree: PyTree[Array], sizes: Callable[[Array], Array]) -> Any:
    numbers, unflatten = ravel_pytree(tree)
    # Parameters may be complex.
    changes = unflatten((sizes(numbers) * _no_pattern(numbers.size)).astype(numbers.dtype))
    return jax.tree.map(_as_symmetric, tree, changes)


def _as_symmetric(x: Array, change: Array) -> Array:
    """A matrix of masses or of inertia stays symmetric."""
    if x.ndim < 2 or x.shape[-1] != x.shape[-2] or x.shape[-1] == 1:
        return change
    transposed = lambda x: jnp.swapaxes(x, -1, -2)
    return jnp.where(jnp.all(x == transposed(x)), (change + transposed(change)) / 2, change)


def _no_pattern(size: int) -> Flat:
    return jnp.cos(1.0 + jnp.arange(size) ** 2)


def _units(problem: Problem, parameters: PyTree[Array], fixed: PyTree, end: tuple[Time, State]) -> Flat:
    """How large each parameter is whose own size says nothing, as it is 0: 1, but where that would change the equations by less than all
    others and the state do together, which would hide it, or by more than a state of size 1 does, which it would hide: in a unit far off.

    Looked at are the user's functions at the start, at the end, and between, in a combination by no pattern.
    """
    numbers, _ = ravel_pytree(parameters)
    t0, y0 = problem.t0, problem.y0
    between = lambda a, b: a + BETWEEN * (b - a)
    points = (t0, y0), end, jax.tree.map(between, (t0, y0), end)
    t, state = jax.tree.map(lambda *x: jnp.stack(list(map(jnp.asarray, x))), *points)

    def combined(given: tuple[PyTree[Array], State], t: Scalar) -> Scalar:
        _, system, args = eqx.combine(given[0], fixed)
        values = _of_functions(system, t, given[1], args)
        return jnp.sum(values * _no_pattern(values.size))

    # What a user refuses need not be on the way.
    @without_checks
    def effects(t: Scalar, state: State) -> tuple[Flat, Scalar, Scalar]:
        flat, unflatten = ravel_pytree(state)
        slopes = lambda x: [jnp.abs(ravel_pytree(g)[0]) for g in jax.grad(combined)((parameters, unflatten(x)), t)]
        size = jnp.abs(flat)
        aside = flat + NOISE * jnp.finfo(flat.dtype).eps * jnp.max(size) * _no_pattern(flat.size)
        (each, by_state), (also, _) = slopes(flat), slopes(aside)
        # Where round-off of the state makes the difference, there is no effect.
        each = jnp.where(jnp.abs(each - also) < each / 2, each, 0)
        return each, jnp.max(by_state * size, initial=0.0), jnp.max(by_state * (1 + size), initial=0.0)

    try:
        found = lax.map(lambda at: effects(*at), constant((t, state)))
    except (TypeError, ValueError, NotImplementedError):
        # A function of the user's that has forward derivatives only.
        return jnp.ones_like(numbers, float)
    each, least, most = (jnp.max(jnp.nan_to_num(x, posinf=0.0), 0) for x in found)
    least = jnp.maximum(least, jnp.max(each * jnp.abs(numbers), initial=0.0))
    most = jnp.maximum(most, least)
    least = jnp.where(least > 0, least, most)
    known = (each > 0) & (most > 0)
    unit = lambda effect: effect / jnp.where(known, each, 1)
    # No farther off than numbers can tell from round-off.
    eps = jnp.finfo(each.dtype).eps
    return jnp.where(known, jnp.clip(jnp.clip(1, unit(least), unit(most)), eps, 1 / eps), 1)


def _of_functions(system: System, t: Scalar, state: State, args: Args) -> Flat:
    """What the user's functions give, where nothing moves but what the state has of it."""
    if is_mechanism(system):
        ode = MechanicalODE.of(system, t, state, args)
        q, v = ode.encode(state)
        return jnp.concatenate([ode.force(t, q, v), ode.constraint(t, q), ode.velocity_constraint(t, q, v)])
    form = ResidualForm.of(system, t, state, args)
    y = form.encode(state)
    return form.residual(t, y, jnp.zeros_like(y))
