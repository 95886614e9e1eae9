"""Incidence: which outputs of a JAX function depend on which inputs, entry by entry, read from its jaxpr.

Nothing is sampled. The jaxpr is interpreted once on `Cells`: for each entry of each array either the set of inputs that
it depends on, or, where it depends on none, its number. Numbers are followed so that a product with a constant zero, a
constant predicate and a constant index leave exactly the dependences that the function has. Loops are run step by step
where their length is known.

A primitive without a rule is refused: too many dependences would make a structural analysis report too low an index, as
surely as too few make it fail.
"""

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.typing import ArrayLike
from jaxtyping import Float, PyTree
from scipy.sparse import csr_array

from ..compiler import ALL_CALLS, WITH_DERIVATIVE, called
from ..compiler._compat import low
from ..compiler.types import Aval, Equation, aval_of
from . import (
    incidence_contractions as contractions,
    incidence_control as control,
    incidence_entries as entries,
    incidence_indexing as indexing,
)
from .cells import Cells, evaluate, has_extended_dtype
from .sets import Sets


# Primitives that move entries about.
MOVES: Mapping[str, Callable[[Any, list[Cells]], list[Cells]]] = {
    **dict.fromkeys(entries.MOVEMENT, entries.movement),
    **dict.fromkeys(entries.IDENTITY, lambda eqn, inputs: inputs),
    "concatenate": entries.concatenate,
    "iota": entries.iota,
    "pad": entries.pad,
    "platform_index": lambda eqn, inputs: [Cells.unknown(0, eqn.outvars[0].aval)],
    "split": entries.split,
    "stack": entries.stack,
    "unstack": entries.unstack,
}

# Primitives whose rule unites what the operands depend on.
RULES: Mapping[str, Callable[[Any, list[Cells], Sets], list[Cells]]] = {
    **dict.fromkeys(entries.ELEMENTWISE, entries.elementwise),
    **dict.fromkeys(contractions.REDUCTIONS, contractions.reduction),
    **dict.fromkeys(contractions.CUMULATIVE, contractions.cumulative),
    **dict.fromkeys([*contractions.DENSE, "fft"], contractions.dense),
    **dict.fromkeys(contractions.RANDOM, contractions.mixed),
    **dict.fromkeys(indexing.SCATTERS, indexing.scatter),
    "conv_general_dilated": contractions.convolution,
    "dot_general": contractions.dot_general,
    "dynamic_slice": indexing.dynamic_slice,
    "dynamic_update_slice": indexing.dynamic_update_slice,
    "gather": indexing.gather,
    "reduce": contractions.general_reduction,
    "select_n": entries.select_n,
    "sort": contractions.sort,
    "top_k": contractions.top_k,
    "triangular_solve": contractions.triangular_solve,
}

# Primitives whose rule runs inner jaxprs.
CONTROL: Mapping[str, Callable[[Any, list[Cells], control.Run, Sets], list[Cells]]] = {
    "cond": control.cond,
    "custom_linear_solve": control.linear_solve,
    "scan": control.scan,
    "while": control.while_loop,
}

# Primitives that evaluate another jaxpr, and the parameter that holds it.
CALLS = {**ALL_CALLS, "call": "call_jaxpr", "composite": "jaxpr", "core_call": "call_jaxpr"}

# Cheap on numbers by their own rule; everything else is evaluated as a whole where all its operands are known.
_CHEAP = frozenset({*entries.ELEMENTWISE, *MOVES, *CALLS, "select_n"})


def dependence(fn: Callable[..., Any], *example_args: PyTree, derivative: bool = False) -> list[np.ndarray]:
    """Which numbers of `fn(*args)` depend on which numbers of each argument.

    `example_args` are pytrees of arrays (or `jax.ShapeDtypeStruct`s), of which shapes and dtypes count, not values.
    Gives for each argument k a boolean array of shape (outputs, numbers in argument k), where the outputs are all
    numbers of the result in the order of its leaves, raveled. An argument is not used at all where its array has no
    `True`.

    `derivative=True` leaves out dependences whose derivative is zero wherever it exists: through comparisons, rounding,
    `sign`, integers, truth values and `stop_gradient`. It gives the pattern of the Jacobian of `fn`. What has a derivative of its own
    (`custom_jvp`, `custom_vjp`) may have one wherever its value depends.

    Arrays that `fn` closes over count as constants: a zero among them is a structural zero. Closed over while being
    traced (an argument of an outer `jit`), they count as unknown numbers that depend on nothing.

    Raises `NotImplementedError` for a primitive without a rule, with its name.
    """
    return [pattern.toarray() for pattern in dependence_patterns(fn, *example_args, derivative=derivative)]


def dependence_patterns(fn: Callable[..., Any], *example_args: PyTree, derivative: bool = False) -> list[csr_array]:
    """What `dependence` gives, as sparse matrices with sorted indices."""
    return interpreted(fn, *example_args, derivative=derivative).on


class Interpretation(NamedTuple):
    """What `dependence_patterns` gives, the part of it in which outputs `jump` (through comparisons, rounding, `sign`, integers,
    truth values and `stop_gradient`), and the outputs that are `numbers` whatever the arguments are, NaN where they are none.
    """

    on: list[csr_array]
    jumps: list[csr_array]
    numbers: Float[np.ndarray, " outputs"]


def interpreted(fn: Callable[..., Any], *example_args: PyTree, derivative: bool = False) -> Interpretation:
    """All that is known of a function before it is evaluated; for the arguments see `dependence`. With `derivative` no
    output jumps.
    """
    leaves, treedef = jax.tree.flatten(example_args)
    avals = [_aval(leaf) for leaf in leaves]
    closed = low(jax.make_jaxpr(lambda *flat: fn(*jax.tree.unflatten(treedef, flat)))(*avals))
    sizes = [math.prod(aval.shape) for aval in avals]
    sets = Sets(sum(sizes), slopes_only=derivative)
    inputs, start = [], 1
    for aval, size in zip(avals, sizes, strict=True):
        discrete = derivative and not jnp.issubdtype(aval.dtype, jnp.inexact)
        ids = np.arange(start, start + size).reshape(aval.shape)
        inputs.append(Cells.unknown(0 if discrete else ids, aval))
        start += size
    outputs = _run(closed, inputs, sets)
    found = sets.rows(np.concatenate([np.zeros(0, np.int64), *(cells.dependence.reshape(-1) for cells in outputs)]))
    ends = np.cumsum([1, *(sum(jax.tree.leaves(part)) for part in jax.tree.unflatten(treedef, sizes))])
    parts = list(itertools.pairwise(ends.astype(int).tolist()))
    on, jumps = ([pattern[:, low:high] for low, high in parts] for pattern in found)
    numbers = [np.where(cells.known, cells.value, np.nan).reshape(-1) for cells in outputs]
    return Interpretation(on, jumps, np.concatenate([np.zeros(0), *numbers]))


def is_linear(fn: Callable[..., Any], *example_args: Any, argument: int) -> bool:
    """Whether `fn` is linear in one of its arguments, an array: its slope there is the same everywhere, and it has no kinks
    (`abs`, `max`, `where`) and no jumps (`sign`, `floor`, comparisons). Raises as `dependence` does.
    """

    def slope(along: Any, *args: Any) -> Any:
        of = lambda x: fn(*args[:argument], x, *args[argument + 1 :])
        return jax.jvp(of, (args[argument],), (along,))

    found = interpreted(slope, example_args[argument], *example_args)
    values = len(found.numbers) // 2
    return not (found.jumps[1 + argument].nnz or found.on[1 + argument][values:].nnz)


def _run(closed: ClosedJaxpr, inputs: Sequence[Cells], sets: Sets) -> list[Cells]:
    """The outputs of a jaxpr on `inputs`."""
    jaxpr = closed.jaxpr
    env: dict[Any, Cells] = dict(zip(jaxpr.invars, inputs, strict=True))
    for variable, const in zip(jaxpr.constvars, closed.consts, strict=True):
        env[variable] = _constant(const, aval_of(variable))
    for eqn in jaxpr.eqns:
        if eqn.outvars:
            outputs = _run_eqn(eqn, [_read(env, atom) for atom in eqn.invars], sets)
            env.update(zip(eqn.outvars, outputs, strict=True))
    return [_read(env, atom) for atom in jaxpr.outvars]


def _run_eqn(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """The outputs of one equation of a jaxpr: numbers where the operands are, else by its rule."""
    name = eqn.primitive.name
    if name not in _CHEAP and not eqn.effects and all(cells.known.all() for cells in inputs):
        numbers = evaluate(eqn, [cells.value for cells in inputs])
        return [_constant(number, out.aval) for number, out in zip(numbers, eqn.outvars, strict=True)]
    run = functools.partial(_run, sets=sets)
    inner = called(eqn, CALLS)
    if inner is not None:
        # A function with a derivative of its own may have one through what jumps: rounding, a table, a loop that is cut off.
        with sets.smooth_through_jumps() if name in WITH_DERIVATIVE else contextlib.nullcontext():
            outputs = run(inner, inputs)
    elif name in CONTROL:
        outputs = CONTROL[name](eqn, inputs, run, sets)
    elif name in MOVES:
        outputs = MOVES[name](eqn, inputs)
    elif name in RULES:
        outputs = RULES[name](eqn, inputs, sets)
    else:
        raise NotImplementedError(
            f"How the outputs of the primitive `{name}` depend on its inputs is not known. "
            "Write this part of the function with other operations."
        )
    for cells, out in zip(outputs, eqn.outvars, strict=True):
        if cells.shape != out.aval.shape:
            raise AssertionError(f"The rule of `{name}` gave shape {cells.shape}, not {out.aval.shape}.")
    return [_flattened(cells, out.aval, name, sets) for cells, out in zip(outputs, eqn.outvars, strict=True)]


def _flattened(cells: Cells, aval: Aval, name: str, sets: Sets) -> Cells:
    """With what has a derivative that is zero wherever it exists as reached through a jump."""
    if name in entries.FLAT or not jnp.issubdtype(aval.dtype, jnp.inexact):
        return Cells(sets.through_jump(cells.dependence), cells.known, cells.value)
    return cells


def _read(env: Mapping[Any, Cells], atom: Any) -> Cells:
    return _constant(atom.val, aval_of(atom)) if isinstance(atom, Literal) else env[atom]


def _constant(value: ArrayLike, aval: Aval) -> Cells:
    """A constant of a jaxpr: known unless it is traced itself or no number."""
    if isinstance(value, Tracer) or has_extended_dtype(aval):
        return Cells.unknown(0, aval)
    return Cells.constant(np.asarray(value, aval.dtype))


def _aval(leaf: ArrayLike | jax.ShapeDtypeStruct) -> Any:
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf
    aval = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)
