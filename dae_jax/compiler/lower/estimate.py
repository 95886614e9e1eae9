"""About what a function will be compiled to, equation by equation: instructions, memory, where each result is."""

import dataclasses
from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal, Var

from .._compat import scan_counts
from ..emit.target import Target
from ..jaxprs.inline import Inlining
from ..jaxprs.numbers import is_on_numbers
from ..jaxprs.walk import equations
from ..thresholds import THRESHOLDS
from ..types import Aval, Equation
from .annotated import Annotated, Note
from .dtypes import BYTES, parts_of
from .registry import RULES, size
from .uniformity import results


# Of what moves entries these make an array of their own.
_MAKE_ARRAYS = frozenset({"concatenate", "stack", "pad"})


@dataclasses.dataclass(frozen=True)
class _State:
    """Where an array is, and whether it may differ from lane to lane."""

    storage: str
    varying: bool


def annotated(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], inlined: Inlining, target: Target) -> Annotated:
    """A function without calls, with what will become of each equation."""
    lanes = list(batched) or [False] * len(jaxpr.jaxpr.invars)
    found = _Estimate(inlined, target.width if any(batched) else 1)
    found.run(jaxpr, [found.loaded(v.aval, each) for v, each in zip(jaxpr.jaxpr.invars, lanes, strict=True)], 0, 1)
    return Annotated(jaxpr, batched, inlined, tuple(found.notes), found.bytes, target)


class _Estimate:
    def __init__(self, inlined: Inlining, width: int) -> None:
        self.inlined, self.lanes = inlined, width > 1
        self.few = THRESHOLDS.few if width == 1 else THRESHOLDS.carried
        self.notes: list[Note] = []
        self._procedures: dict[Hashable, list[_State]] = {}
        self.bytes = 0

    def loaded(self, aval: Aval, varying: bool) -> _State:
        """What a function, a loop or a branch gets or gives."""
        return _State("memory" if aval.size > THRESHOLDS.carried else "registers", self.lanes and varying)

    def run(self, jaxpr: ClosedJaxpr, args: Sequence[_State], depth: int, times: int) -> list[_State]:
        """Notes down the equations of a jaxpr, which is written so many times."""
        found: dict[Any, _State] = dict(zip(jaxpr.jaxpr.invars, args, strict=True))
        of_constant = lambda v: _State("memory" if v.aval.size > THRESHOLDS.folded else "known", False)
        found.update((v, of_constant(v)) for v in jaxpr.jaxpr.constvars)
        read = lambda v: of_constant(v) if isinstance(v, Literal) else found[v]
        uses = Counter(v for eqn in jaxpr.jaxpr.eqns for v in eqn.invars if isinstance(v, Var))
        uses.update(v for v in jaxpr.jaxpr.outvars if isinstance(v, Var))
        for eqn in jaxpr.jaxpr.eqns:
            states = [read(v) for v in eqn.invars]
            varying = results(eqn, [state.varying for state in states]) if self.lanes else [False] * len(eqn.outvars)
            if RULES[eqn.primitive.name].nested:
                self._note(eqn, depth, any(varying), "", 0)
                outs = self._nested(eqn, states, varying, depth + 1, times)
            else:
                outs = self._plain(eqn, states, varying, depth, times, max(uses[v] for v in eqn.outvars))
            found.update(zip(eqn.outvars, outs, strict=True))
        return list(map(read, jaxpr.jaxpr.outvars))

    def _note(self, eqn: Equation, depth: int, varying: bool, storage: str, cost: int) -> None:
        self.notes.append(Note(depth, eqn, varying, storage, cost))
        self.bytes += sum(v.aval.size * _bytes(v.aval) for v in eqn.outvars if v.aval.size > self.few)

    def _plain(
        self, eqn: Equation, args: list[_State], varying: list[bool], depth: int, times: int, uses: int
    ) -> list[_State]:
        storage, cost = self._of_equation(eqn, {state.storage for state in args}, uses)
        self._note(eqn, depth, any(varying), storage, cost * times)
        kept = lambda v: storage if storage in ("known", "fused") or v.aval.size > self.few else "registers"
        return [_State(kept(v), each) for v, each in zip(eqn.outvars, varying, strict=True)]

    def _of_equation(self, eqn: Equation, args: set[str], uses: int) -> tuple[str, int]:
        """Where the results are, and about how many instructions they take."""
        rule, largest = RULES[eqn.primitive.name], max(v.aval.size for v in eqn.outvars)
        folds = rule.moves or is_on_numbers(eqn)
        if folds and args <= {"known"} and largest <= THRESHOLDS.folded:
            return "known", 0
        if not args & {"memory", "fused"} and largest <= THRESHOLDS.in_registers:
            return "memory" if rule.by_memory and not args <= {"known"} else "registers", rule.cost(eqn)
        fuses = rule.fuses or (rule.moves and "fused" in args and eqn.primitive.name not in _MAKE_ARRAYS)
        of_entry = min(max(rule.cost(eqn) // max(size(eqn), 1), 1), 2 * THRESHOLDS.carried)
        cost = sum(min(v.aval.size, THRESHOLDS.loop_cost) for v in eqn.outvars) * of_entry
        return ("fused" if fuses and uses == 1 else "memory" if rule.moves or largest > self.few else "registers"), cost

    def _nested(self, eqn: Equation, args: list[_State], varying: list[bool], depth: int, times: int) -> list[_State]:
        p, outs = eqn.params, [self.loaded(v.aval, each) for v, each in zip(eqn.outvars, varying, strict=True)]
        if eqn.primitive.name == "while":
            n, m = p["cond_nconsts"], p["body_nconsts"]
            self.run(self.inlined(p["cond_jaxpr"]), [*args[:n], *outs], depth, times)
            self.run(self.inlined(p["body_jaxpr"]), [*args[n : n + m], *outs], depth, times)
        elif eqn.primitive.name == "procedure":
            form = id(p["jaxpr"].jaxpr), tuple(args)
            if form not in self._procedures:
                self._procedures[form] = self.run(self.inlined(p["jaxpr"]), args, depth, 1)
            outs = self._procedures[form]
        elif eqn.primitive.name == "scan":
            (n, m), body = scan_counts(p), p["jaxpr"]
            turns = p["length"] if is_written_out(eqn) else 1
            rows = [self.loaded(v.aval, True) for v in body.jaxpr.invars[n + m :]]
            self.run(self.inlined(body), [*args[:n], *outs[:m], *rows], depth, turns * times)
        else:
            for branch in p["branches"]:
                self.run(self.inlined(branch), args[1:], depth, times)
        return outs


def is_written_out(eqn: Equation) -> bool:
    """Whether the turns of a `scan` stand one after another."""
    p, of_ys = eqn.params, [v.aval for v in eqn.outvars[scan_counts(eqn.params)[1] :]]
    turn = equations(p["jaxpr"])
    numbers = p["length"] * sum(v.aval.size for e in turn for v in e.outvars)
    few = p["length"] * (1 + len(turn)) <= THRESHOLDS.written_out and numbers <= THRESHOLDS.numbers_written_out
    few = few and all(y.size <= THRESHOLDS.in_registers for y in of_ys)
    return few or p["length"] <= 1


def _bytes(aval: Aval) -> int:
    kind, count = parts_of(aval.dtype)
    return BYTES[kind] * count
