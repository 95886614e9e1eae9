"""What a solver around another hands on to it."""

from typing import Any

import diffrax

from ..types import Time


class AbstractWrapper(diffrax.AbstractWrappedSolver):
    """A solver of the terms, order and dense output of `solver`, whose steps it changes."""

    @property
    def term_structure(self) -> Any:
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:
        return self.solver.interpolation_cls

    # diffrax looks for these, and fills them in.
    @property
    def scan_kind(self) -> Any:
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_finder(self) -> Any:
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> Any:
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.error_order(terms)

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Any, args: Any) -> Any:
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        return self.solver.init(terms, t0, t1, y0, args)
