"""Derivatives along several directions at once, which are the last axis of all that is computed, and lie together in memory.

`jax.vmap` has such an axis first: sums over a few entries, and entries at indices, become loops over those few. Here each is a loop
over the directions, in vectors.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, Literal
from jaxtyping import Array, Float

from ..compiler.jaxprs.walk import CALLS, called
from ..compiler.types import Equation, Params
from ..structure.incidence_entries import ELEMENTWISE
from ..types import Flat


# An array, and whether it has the axis of directions.
_Marked = tuple[Any, bool]


def along_each(
    function: Callable[[Flat], Float[Array, " m"]], at: Flat, directions: Float[Array, "n k"]
) -> Float[Array, "m k"]:
    """∂f/∂x D, for the columns of D."""
    along = jax.make_jaxpr(lambda direction: jax.jvp(function, (at,), (direction,))[1])(directions[:, 0])
    ((found, marked),) = _run(along.jaxpr, along.consts, [(directions, True)])
    return found if marked else _repeated(found, directions.shape[1])


def _run(jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[_Marked]) -> list[_Marked]:
    known: dict[Any, _Marked] = dict(zip(jaxpr.invars, args, strict=True))
    known.update((v, (x, False)) for v, x in zip(jaxpr.constvars, consts, strict=True))
    read = lambda v: (v.val, False) if isinstance(v, Literal) else known[v]
    for eqn in jaxpr.eqns:
        known.update(zip(eqn.outvars, _step(eqn, [read(v) for v in eqn.invars]), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _step(eqn: Equation, args: list[_Marked]) -> list[_Marked]:
    xs, marks, name = [x for x, _ in args], [mark for _, mark in args], eqn.primitive.name
    inner = called(eqn, CALLS)
    if not any(marks):
        found = _bound(eqn, eqn.params, *xs)
    elif inner is not None:
        return _run(inner.jaxpr, inner.consts, args)
    elif name in ELEMENTWISE and name not in _ALIKE:
        rank = eqn.outvars[0].aval.ndim
        found = _bound(eqn, eqn.params, *(_beside(x, mark, rank) for x, mark in args))
    elif name in _ALIKE:
        count = next(x.shape[-1] for x, mark in args if mark)
        # One truth chooses between whole arrays.
        stays = [mark or (name == "select_n" and k == 0 and jnp.ndim(x) == 0) for k, (x, mark) in enumerate(args)]
        found = _bound(
            eqn, eqn.params, *(x if same else _repeated(x, count) for x, same in zip(xs, stays, strict=True))
        )
    elif name in _EXTENDED and marks == [True, *[False] * (len(marks) - 1)]:
        found = _bound(eqn, _EXTENDED[name](eqn.params, *xs), *xs)
    else:
        axes = tuple(-1 if mark else None for mark in marks)
        found = jax.vmap(functools.partial(_bound, eqn, eqn.params), axes, -1)(*xs)
    return [(x, any(marks)) for x in (found if eqn.primitive.multiple_results else [found])]


def _bound(eqn: Equation, params: Params, *xs: Any) -> Any:
    return eqn.primitive.bind(*xs, **eqn.primitive.get_bind_params(params))


def _beside(x: Any, marked: bool, rank: int) -> Any:
    """An operand of an entrywise operation whose result has so many other axes; a number goes with all entries."""
    if not marked:
        return x[..., None] if jnp.ndim(x) else x
    return x if x.ndim > rank else x.reshape((1,) * rank + x.shape)


def _repeated(x: Any, count: int) -> Any:
    return jnp.broadcast_to(jnp.asarray(x)[..., None], (*jnp.shape(x), count))


# What has the same parameters for arrays with one axis more at the end, where all have it.
_ALIKE = frozenset({
    "concatenate", "copy", "cumsum", "expand_dims", "reduce_max", "reduce_min", "reduce_prod", "reduce_sum", "rev", "select_n",
    "split", "squeeze", "stack", "unstack",
})  # fmt: skip


def _gather(p: Params, x: Any, indices: Any) -> Params:
    numbers = p["dimension_numbers"]
    inner = x.ndim - 1 - len(numbers.collapsed_slice_dims) - len(numbers.operand_batching_dims)
    offsets = (*numbers.offset_dims, jnp.ndim(indices) - 1 + inner)
    return {
        **p,
        "dimension_numbers": numbers._replace(offset_dims=offsets),
        "slice_sizes": (*p["slice_sizes"], x.shape[-1]),
    }


# The parameters for a first operand with that axis; other operands have none.
_EXTENDED: dict[str, Callable[..., Params]] = {
    "broadcast_in_dim": lambda p, x: {
        **p,
        "shape": (*p["shape"], x.shape[-1]),
        "broadcast_dimensions": (*p["broadcast_dimensions"], len(p["shape"])),
    },
    "gather": _gather,
    "pad": lambda p, x, _: {**p, "padding_config": (*p["padding_config"], (0, 0, 0))},
    "reshape": lambda p, x: {**p, "new_sizes": (*p["new_sizes"], x.shape[-1])},
    "slice": lambda p, x: {
        **p,
        "start_indices": (*p["start_indices"], 0),
        "limit_indices": (*p["limit_indices"], x.shape[-1]),
        "strides": None if p["strides"] is None else (*p["strides"], 1),
    },
    "transpose": lambda p, x: {**p, "permutation": (*p["permutation"], x.ndim - 1)},
}
