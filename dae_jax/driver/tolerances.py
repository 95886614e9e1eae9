"""A tolerance for each unknown: in the user's structure of the state, and in that of what is integrated."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import PyTree

from ..equations.manifold_ode import Equations
from ..types import Args, Controller, Scalar, State, Time, Y
from ..validate.states import NUMBERS, brief, describe
from .observed_steps import AbstractStepsOf


NAMES = ("rtol", "atol")


def with_tolerances(controller: Controller, state: State) -> Any:
    """The controller with tolerances that are no numbers in the structure of the state, an array for each of its arrays.

    Errors: `ValueError` for those that are not positive, or cannot be brought into it.
    """
    inner = getattr(controller, "controller", None)
    if inner is not None:
        whole = with_tolerances(inner, state)
        return controller if whole is inner else eqx.tree_at(lambda c: c.controller, controller, whole)
    if type(controller) is not diffrax.PIDController:
        return controller
    given = controller.rtol, controller.atol
    if all(type(x) is float and x > 0 for x in given):
        return controller
    known = [x for x in jax.tree.leaves(given) if not isinstance(x, Tracer)]
    if all(isinstance(x, NUMBERS) for x in known) and all(np.all(np.asarray(x) >= 0) for x in known):
        whole = changed(controller, lambda name, x: _in_structure(name, x, state))
        if all(map(_may_be_positive, *(jax.tree.leaves(of_state(whole, name, state)) for name in NAMES))):
            return whole
    raise ValueError(
        "`stepsize_controller` must have positive tolerances, numbers or one for each unknown, but has "
        f"rtol = {brief(given[0])} and atol = {brief(given[1])}: write PIDController(rtol=1e-6, atol=1e-6)."
    )


def _may_be_positive(rtol: ArrayLike, atol: ArrayLike) -> bool:
    return any(isinstance(x, Tracer) for x in (rtol, atol)) or bool(np.all(np.asarray(rtol) + np.asarray(atol) > 0))


def _is_number(x: object) -> bool:
    return isinstance(x, NUMBERS) and not getattr(x, "shape", ())


def _in_structure(name: str, tolerance: PyTree, state: State) -> Any:
    def broadcast(x: ArrayLike, part: State) -> Any:
        to: Any = jnp if isinstance(x, jax.Array) else np
        return jax.tree.map(lambda y: to.broadcast_to(to.asarray(x, y.dtype), y.shape), part)

    try:
        return jax.tree.map(broadcast, tolerance, state)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`{name}` of the step-size control must be a number or have one for each of {describe(state)}, in that structure, but is "
            f"{describe(tolerance)}."
        ) from error


def changed(
    controller: Controller, change: Callable[[str, PyTree], Any], norm: Callable[[PyTree], Scalar] | None = None
) -> Any:
    """The controller with `change(name, tolerance)` in place of tolerances that are no numbers, and another `norm`."""
    inner = getattr(controller, "controller", None)
    if inner is not None:
        return eqx.tree_at(lambda c: c.controller, controller, changed(inner, change, norm))
    given = {name: getattr(controller, name, 0.0) for name in NAMES}
    each = {name: change(name, x) for name, x in given.items() if not _is_number(x)}
    known = {} if norm is None else {"norm": norm}
    return dataclasses.replace(controller, **each, **known) if each else controller


def in_integrated(controller: Controller, t: Time, y: Y, ode: Equations, formulation: object) -> Any:
    """The controller with tolerances for each unknown in the structure of `y`, what is integrated.

    Errors: `ValueError` where these are no unknowns of the user's.
    """

    def change(name: str, tolerance: PyTree) -> Any:
        found = getattr(ode, "tolerances", None)
        if found is None:
            raise ValueError(
                f"`{name}` of the step-size control has a tolerance for each unknown, but {type(formulation).__name__} integrates "
                "coordinates of its own: give a number."
            )
        return found(t, y, tolerance, name == "atol")

    return changed(controller, change)


def measured(ode: Any, controller: Controller, t: Time, y: Y) -> Any:
    """The equations with distances and times in tolerances, where each unknown has one of its own."""
    inner = getattr(controller, "controller", None)
    if inner is not None:
        return measured(ode, inner, t, y)
    atol = getattr(controller, "atol", 0.0)
    return ode if _is_number(atol) else ode.measured_in(t, y, atol)


def in_one_vector(controller: Any, y: Y) -> Any:
    """The steps of a controller that may have tolerances for each number of a pytree; diffrax's has them of one array."""
    given = [getattr(controller, name, 0.0) for name in NAMES]
    if all(map(_is_number, given)) or len(jax.tree.leaves(y)) == 1:
        return controller
    norm, unravel = controller.norm, ravel_pytree(y)[1]
    flat = changed(controller, lambda _, tolerance: ravel_pytree(tolerance)[0], lambda x: norm(unravel(x)))
    steps: Any = StepsOfVector
    return steps(flat, norm)


class StepsOfVector(AbstractStepsOf):
    """Those of another controller, which gets the numbers of a pytree one behind the other, as its tolerances are. Who asks for one
    tolerance gets the smallest.
    """

    steps: Any
    norm_of_tree: Any

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.norm_of_tree

    @property
    def rtol(self) -> Any:
        return jnp.min(self.steps.rtol)

    @property
    def atol(self) -> Any:
        return jnp.min(self.steps.atol)

    def init(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        dt0: Time | None,
        args: Args,
        func: Callable[..., Y],
        error_order: Time | None,
    ) -> tuple[Any, Any]:
        flat, unravel = ravel_pytree(y0)
        of_vector = lambda terms, t, y, args: ravel_pytree(func(terms, t, unravel(y), args))[0]
        return self.steps.init(terms, t0, t1, flat, dt0, args, of_vector, error_order)

    def adapt_step_size(
        self,
        t0: Time,
        t1: Time,
        y0: Y,
        y1_candidate: Y,
        args: Args,
        y_error: Y,
        error_order: Time,
        controller_state: State,
    ) -> Any:
        flat = [None if x is None else ravel_pytree(x)[0] for x in (y0, y1_candidate, y_error)]
        return self.steps.adapt_step_size(t0, t1, *flat[:2], args, flat[2], error_order, controller_state)


def of_state(controller: Controller, name: str, state: State) -> Any:
    """The tolerances in the structure of the state; 0 where steps are fixed."""
    tolerance = getattr(controller, name, 0.0)
    return jax.tree.map(lambda _: tolerance, state) if _is_number(tolerance) else tolerance


def span_of(tolerance: PyTree) -> tuple[Scalar, Scalar]:
    """The smallest and the largest tolerance."""
    leaves = [jnp.asarray(x) for x in jax.tree.leaves(tolerance)]
    least, most = jnp.stack([jnp.min(x) for x in leaves]), jnp.stack([jnp.max(x) for x in leaves])
    return jnp.min(least), jnp.max(most)
