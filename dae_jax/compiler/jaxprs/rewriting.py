"""Jaxprs run with some of their equations, at any depth, replaced by what knows of those before it, and can end loops."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from .._compat import scan_counts
from ..types import Arrays, Equation, Params
from .scalar_interpreter import Unsupported
from .walk import CALLS, WITH_DERIVATIVE, called, equations, equations_in, of_solve


_CALLS = {**CALLS, **WITH_DERIVATIVE}


class Rewriting:
    """Runs jaxprs with what replaces an equation in its place.

    `applies` says of an equation whether it is replaced. `replacement` gives its results for its operands, and the state
    that follows: a list of arrays that passes through all replacements in their order, also through loops and branches.
    `stops` says of the state whether all loops end.
    """

    def __init__(
        self,
        applies: Callable[[Any], bool],
        replacement: Callable[[Any, list[Any], list[Any]], tuple[list[Any], list[Any]]],
        stops: Callable[[Arrays], Array],
    ) -> None:
        self._applies, self._replacement, self._stops = applies, replacement, stops

    def run(
        self, jaxpr: Jaxpr, consts: Sequence[Array], args: Sequence[Array], state: Arrays
    ) -> tuple[list[Any], list[Any]]:
        """The results of a jaxpr, and the state after it."""
        env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))
        read = lambda v: v.val if isinstance(v, Literal) else env[v]
        for eqn in jaxpr.eqns:
            results, state = self._equation(eqn, list(map(read, eqn.invars)), state)
            env.update(zip(eqn.outvars, results, strict=True))
        return list(map(read, jaxpr.outvars)), state

    def _equation(self, eqn: Equation, args: Arrays, state: Arrays) -> tuple[list[Any], list[Any]]:
        name, p = eqn.primitive.name, eqn.params
        if self._applies(eqn):
            return self._replacement(eqn, args, state)
        if not any(map(self._applies, equations_in(eqn))):
            results = eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(p))
            return results if eqn.primitive.multiple_results else [results], state
        inner = called(eqn, _CALLS)
        if inner is not None:
            return self.run(inner.jaxpr, inner.consts, args, state)
        match name:
            case "cond":
                which, *operands = args
                found = jax.lax.switch(which, list(map(self._joined, p["branches"])), *operands, *state)
                return _parted(found, len(eqn.outvars))
            case "while":
                return _parted(self._while(eqn, args, state), len(eqn.outvars))
            case "scan":
                return self._scan(p, args, state)
            case "custom_linear_solve":
                solve = p["jaxprs"].solve
                return self.run(solve.jaxpr, solve.consts, of_solve(p, args), state)
        raise Unsupported(f"{name} with something in it that is to be replaced")

    def _joined(self, closed: ClosedJaxpr) -> Callable[..., list[Any]]:
        n = len(closed.jaxpr.invars)
        return lambda *xs: [y for ys in self.run(closed.jaxpr, closed.consts, xs[:n], list(xs[n:])) for y in ys]

    def _while(self, eqn: Equation, args: Arrays, state: Arrays) -> list[Any]:
        p, count = eqn.params, len(state)
        n, condition = p["cond_nconsts"], p["cond_jaxpr"]
        if any(map(self._applies, equations(condition))) or condition.out_avals[0].shape:
            raise Unsupported("a check in the condition of a loop, or in a loop with several conditions")
        holds = jaxpr_as_fun(condition)

        def goes_on(*xs: Array) -> Any:
            (found,) = holds(*xs[: len(xs) - count])
            return found & ~self._stops(list(xs[len(xs) - count :]))

        structs = list(map(jax.typeof, [*args, *state]))
        m = n + p["body_nconsts"]
        params = {
            **p,
            "cond_jaxpr": jax.make_jaxpr(goes_on)(*structs[:n], *structs[m:]),
            "body_jaxpr": jax.make_jaxpr(self._joined(p["body_jaxpr"]))(*structs[n:]),
        }
        return eqn.primitive.bind(*args, *state, **params)

    def _scan(self, p: Params, args: Arrays, state: Arrays) -> tuple[list[Any], list[Any]]:
        (n, k), body = scan_counts(p), p["jaxpr"]

        def turn(carry: tuple[Arrays, Arrays], xs: Sequence[Array]) -> Any:
            found, now = self.run(body.jaxpr, body.consts, [*args[:n], *carry[0], *xs], carry[1])
            return (found[:k], now), found[k:]

        (carry, state), ys = jax.lax.scan(
            turn, (args[n : n + k], state), args[n + k :], p["length"], p["reverse"], p["unroll"]
        )
        return [*carry, *ys], state


def _parted(found: Sequence[Array], n: int) -> tuple[list[Any], list[Any]]:
    return list(found[:n]), list(found[n:])
