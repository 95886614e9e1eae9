"""Functions of events that cannot be called, or do not return what they must, are refused in a sentence."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from ..structure import dependence_patterns
from ..types import Args, BoolLike, State, Time
from ..validate.states import NUMBERS, brief, broadcast_to_state, describe
from ..validate.user_functions import refuse_other_arguments, returned
from .problem import Problem
from .resets import Reset
from .start import saved_parts


if TYPE_CHECKING:
    from .program import Solve


def known_to_conditions(solve: "Solve", problem: Problem) -> dict[str, Any]:
    """The keyword arguments that diffrax gives the condition of an event."""
    return {
        "terms": solve.formulation.term(), "solver": solve.solver, "t0": problem.t0, "t1": problem.t1, "dt0": problem.dt0,
        "saveat": solve.saveat, "stepsize_controller": solve.controller, "max_steps": solve.max_steps,
    }  # fmt: skip


def refuse_wrong_event(
    event: diffrax.Event | Reset | None, t: Time, y: State, args: Args, known: dict[str, Any]
) -> None:
    """Refuses functions of an event that cannot be called with (t, y, args), those of an `Event` also with what is `known` to them by
    name, or do not return what they must.
    """
    if event is None:
        return
    conditions = [event.condition] if isinstance(event, Reset) else jax.tree.leaves(event.cond_fn, is_leaf=callable)
    for condition in conditions:
        # A boolean that stays true is no event of which there is one.
        kinds, by_name = ("f", {}) if isinstance(event, Reset) else ("fb", known)
        refuse_other_arguments("condition(t, y, args, **kwargs)", condition, 3, **known)
        _refuse_wrong_condition(functools.partial(condition, **by_name) if by_name else condition, t, y, args, kinds)
    if isinstance(event, diffrax.Event) and isinstance(event.root_finder, optimistix.Bisection) and len(conditions) > 1:
        raise ValueError(
            "diffrax finds the first of several events by `optimistix.Newton`, not by bisection. For that give one condition: the product "
            "of these, or the least of them where they fall."
        )
    if isinstance(event, Reset):
        _refuse_condition_in_steps(event.condition, t, y, args)
        _refuse_wrong_reset(event, t, y, args)


def _refuse_wrong_condition(
    condition: Callable[..., Time | BoolLike], t: Time, y: State, args: Args, kinds: str
) -> None:
    found = returned("condition(t, y, args, **kwargs)", condition, t, y, args)
    fits = isinstance(found, NUMBERS) and jnp.shape(found) == ()
    if not fits or np.dtype(jnp.result_type(found)).kind not in kinds:
        raise ValueError(
            "`condition(t, y, args, **kwargs)` must return a real number, whose zero is the event, but returns "
            f"{describe(found)}."
        )


def _refuse_condition_in_steps(condition: Callable[..., Time], t: Time, y: State, args: Args) -> None:
    """Refuses one whose derivative is 0 wherever it exists: 1 where something holds and 0 elsewhere crosses no zero."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), (t, y))
    depends = lambda **how: any(x.nnz for x in dependence_patterns(lambda t, y: condition(t, y, args), *shapes, **how))
    try:
        in_steps = not depends(derivative=True) and depends()
    except NotImplementedError:
        return
    if in_steps:
        raise ValueError(
            "`condition(t, y, args, **kwargs)` of a Reset has steps and no slope: return what crosses zero, such as y[0] in place of "
            "where(y[0] < 0, 1.0, 0.0)."
        )


def _refuse_wrong_reset(event: Reset, t: Time, y: State, args: Args) -> None:
    found = returned("reset(t, y, args)", event.reset, t, y, args)
    shapes = lambda tree: (jax.tree.structure(tree), [jnp.shape(x) for x in jax.tree.leaves(tree)])
    if not isinstance(found, tuple | list) or len(found) != 2 or shapes(tuple(found)) != shapes((y, args)):
        raise ValueError(
            f"`reset(t, y, args)` must return (y, args), the state and the args to go on with, {describe((y, args))}, but "
            f"returns {describe(found)}."
        )
    for x, before in zip(jax.tree.leaves(found[1]), jax.tree.leaves(args), strict=True):
        if not isinstance(before, NUMBERS):
            if x is not before:
                raise ValueError(
                    f"`reset(t, y, args)` changes {brief(before)} in `args`, which is no number, to {brief(x)}."
                )
        elif not np.can_cast(jnp.result_type(x), jnp.result_type(before), "same_kind"):
            raise ValueError(
                f"`reset(t, y, args)` returns {describe(x)} for an entry of `args` that is {describe(before)}: it would be cut off. "
                "Start with 1.0 in place of 1."
            )
    if event.fixed is not None:
        broadcast_to_state("fixed", event.fixed, y, "booleans")


def refuse_other_outputs(saveat: diffrax.SaveAt) -> None:
    """Refuses what cannot be put together from the parts of a solve with resets."""
    parts = saved_parts(saveat)
    if len(parts) != 1 or parts[0].steps or saveat.dense or saveat.solver_state or saveat.controller_state:
        raise ValueError(
            "A solve with a Reset saves SaveAt(t0=..., ts=..., t1=..., fn=...) only, no steps or dense output."
        )
