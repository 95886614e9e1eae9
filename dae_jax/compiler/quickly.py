"""Programs that run a few times: what it takes to compile them counts, not how fast they are."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from ._compat import accepted_options, eval_context


P = ParamSpec("P")
T = TypeVar("T")

# Beyond as many numbers it matters how fast they are.
FEW = 100_000
_QUICK = (("xla_backend_optimization_level", 0), ("xla_cpu_use_fusion_emitters", False))


def quickly_compiled(fn: Callable[P, T]) -> Callable[P, T]:
    """`eqx.filter_jit(fn)`, on the CPU without most of XLA's optimisations: compiled in a third to a fifth of the time (the search for
    a consistent state of a four-bar linkage in space: 2.6 s in place of 5.9). Of numbers that are traced, and of many, as usual; of
    others at once, also where others still are being traced.
    """
    usual = eqx.filter_jit(fn)

    @functools.wraps(fn)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        arrays = [x for x in jax.tree.leaves((args, kwargs)) if eqx.is_array(x)]
        few = sum(x.size for x in arrays) <= FEW and not any(isinstance(x, Tracer) for x in arrays)
        if not few or jax.default_backend() != "cpu":
            return usual(*args, **kwargs)
        try:
            with eval_context():
                return quick()(*args, **kwargs)
        except jax.errors.UnexpectedTracerError:
            # One that a function holds.
            return usual(*args, **kwargs)

    @functools.cache
    def quick() -> Any:
        # Options of `jax.jit` are handed on.
        jitted: Any = eqx.filter_jit
        return jitted(fn, compiler_options=accepted_options(_QUICK))

    return called
