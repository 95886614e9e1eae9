"""Steps that are done once more, for their derivative, from what their dense output holds."""

from typing import Any

import diffrax

from ..types import Time


class Replayable:
    """A solver whose accepted steps can be replayed without an iteration: their dense output holds what was found.

    A step is a function of its start y₀, its times, the problem, and a `history`: numbers that the step before it left.
    """

    @property
    def kept(self) -> int:
        """How many vectors the dense output of a step holds."""
        return 1

    def history_at_start(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        """The history before the first step."""
        return ()

    def history_after(self, dense: Any) -> Any:
        """The history that the step with this dense output left."""
        return ()

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> tuple[Any, Any, Any]:
        """(y₁, history, dense output) of the step with this dense output, with their derivatives."""
        raise NotImplementedError
