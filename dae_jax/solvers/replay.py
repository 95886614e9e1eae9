"""Steps that are done once more, for their derivative, from what their dense output holds."""

from typing import Any


class Replayable:
    """A solver whose accepted steps can be replayed without an iteration: their dense output holds what was found.

    A step is a function of its start y₀, its times, the problem, and a `history`: numbers that the step before it left.
    """

    def history_at_start(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The history before the first step."""
        return ()

    def history_after(self, dense: Any) -> Any:
        """The history that the step with this dense output left."""
        return ()

    def replay(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, history: Any, dense: Any
    ) -> tuple[Any, Any, Any]:
        """(y₁, history, dense output) of the step with this dense output, with their derivatives."""
        raise NotImplementedError
