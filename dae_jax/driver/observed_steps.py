"""What is seen of the steps of a controller."""

import dataclasses
from typing import Any, NamedTuple, Protocol

import diffrax
import equinox as eqx

from ..types import BoolScalar, Time, Y


class Step(NamedTuple):
    """A step from (t0, y0) to (t1, y1) with the error that the method estimates, if it does, and whether it was `kept`. Times are
    those of the integration: the user's times `direction`.
    """

    t0: Time
    t1: Time
    y0: Y
    y1: Y
    args: Any
    error: Any
    kept: BoolScalar
    direction: Any


class Observer(Protocol):
    """What makes of a step, and of what was seen before, what has been seen."""

    def begin(self, t0: Time, y0: Y, args: Any) -> Any:
        """Before the first step."""
        ...

    def __call__(self, step: Step, before: Any) -> Any: ...


class Observed(NamedTuple):
    """The controller's state, and what each observer has seen."""

    steps: Any
    seen: dict[str, Any]


def observed(controller: diffrax.AbstractStepSizeController, observers: dict[str, Observer]) -> Any:
    """The steps of a controller under the eyes of observers."""
    adapts = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    steps: Any = ObservedAdaptiveSteps if adapts else ObservedSteps
    return steps(controller, observers) if observers else controller


class AbstractStepsOf(diffrax.AbstractAdaptiveStepSizeController):
    """The steps of another controller with tolerances."""

    steps: eqx.AbstractVar[Any]

    def wrap(self, direction: Any) -> Any:
        return dataclasses.replace(self, steps=self.steps.wrap(direction))

    @property
    def rtol(self) -> Any:
        return self.steps.rtol

    @property
    def atol(self) -> Any:
        return self.steps.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.steps.norm


class _AbstractObservedSteps(diffrax.AbstractStepSizeController):
    steps: eqx.AbstractVar[Any]
    observers: eqx.AbstractVar[dict[str, Observer]]
    direction: eqx.AbstractVar[Any]

    def wrap(self, direction: Any) -> Any:
        return type(self)(self.steps.wrap(direction), self.observers, direction)

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, Observed]:
        first, state = self.steps.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return first, Observed(state, {name: each.begin(t0, y0, args) for name, each in self.observers.items()})

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Observed,
    ) -> Any:
        keep, *rest, state, result = self.steps.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state.steps
        )
        step = Step(t0, t1, y0, y1_candidate, args, y_error, keep, self.direction)
        seen = {name: each(step, controller_state.seen[name]) for name, each in self.observers.items()}
        return keep, *rest, Observed(state, seen), result


class ObservedSteps(_AbstractObservedSteps):
    """Those of a controller without tolerances."""

    steps: Any
    observers: dict[str, Observer]
    direction: Any = 1


class ObservedAdaptiveSteps(_AbstractObservedSteps, AbstractStepsOf):
    """Those of a controller with tolerances."""

    steps: Any
    observers: dict[str, Observer]
    direction: Any = 1
