"""Dependence rules of branches, loops and implicitly given linear solves: what runs other jaxprs."""

from collections.abc import Callable, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr
from scipy.sparse import csr_array

from ..compiler import scan_counts
from ..compiler.types import Equation
from .blocks import block_triangular
from .cells import Cells
from .incidence_entries import together
from .matching import maximum_matching
from .patterns import variables_of
from .sets import Ids, Sets


# Loops of more steps than this are summarised by a fixed point.
LONGEST_LOOP = 10_000

# Runs another jaxpr on cells, with the same sets.
Run = Callable[[ClosedJaxpr, Sequence[Cells]], list[Cells]]


def cond(eqn: Equation, inputs: list[Cells], run: Run, sets: Sets) -> list[Cells]:
    """The branch, if it is known; else any branch, and what the choice depends on."""
    choice, *operands = inputs
    branches = eqn.params["branches"]
    if choice.known:
        return run(branches[min(max(int(choice.value), 0), len(branches) - 1)], operands)
    either, *others = (run(branch, operands) for branch in branches)
    for other in others:
        either = [a.join(b, sets) for a, b in zip(either, other, strict=True)]
    return [cells.also(choice.dependence, sets) for cells in either]


def scan(eqn: Equation, inputs: list[Cells], run: Run, sets: Sets) -> list[Cells]:
    """Step by step; a loop of more than `LONGEST_LOOP` steps as one step repeated any number of times."""
    p = eqn.params
    (n_consts, n_carry), length = scan_counts(p), p["length"]
    consts, carry, xs = inputs[:n_consts], inputs[n_consts : n_consts + n_carry], inputs[n_consts + n_carry :]
    if length > LONGEST_LOOP:
        return _long_scan(eqn, consts, carry, xs, run, sets)
    rows: list[list[Cells]] = []
    for step in reversed(range(length)) if p["reverse"] else range(length):
        now = [x.map(lambda a, step=step: a[step, ...]) for x in xs]
        outputs = run(p["jaxpr"], [*consts, *carry, *now])
        carry = outputs[:n_carry]
        rows.append(outputs[n_carry:])
    if not rows:
        return [*carry, *(Cells.unknown(0, out.aval) for out in eqn.outvars[n_carry:])]
    ys = zip(*(rows[::-1] if p["reverse"] else rows), strict=True)
    return [*carry, *(together(np.stack, list(y)) for y in ys)]


def _long_scan(
    eqn: Equation, consts: list[Cells], carry: list[Cells], xs: list[Cells], run: Run, sets: Sets
) -> list[Cells]:
    """A scan in which every step may see any entry of `xs`, after any number of steps."""
    body, n_carry = eqn.params["jaxpr"], len(carry)
    avals = [variable.aval for variable in body.jaxpr.invars[len(consts) + n_carry :]]
    any_x = [Cells.unknown(sets.over(x.dependence, (0,)), aval) for x, aval in zip(xs, avals, strict=True)]
    carry = _repeat(lambda state: run(body, [*consts, *state, *any_x])[:n_carry], carry, sets)
    ys = run(body, [*consts, *carry, *any_x])[n_carry:]
    outs = eqn.outvars[n_carry:]
    return [*carry, *(Cells.unknown(y.dependence, out.aval) for y, out in zip(ys, outs, strict=True))]


def while_loop(eqn: Equation, inputs: list[Cells], run: Run, sets: Sets) -> list[Cells]:
    """Step by step while the condition is known; from then on any number of steps, and what decides it."""
    p = eqn.params
    n_cond, n_body = p["cond_nconsts"], p["body_nconsts"]
    cond_consts, body_consts, state = inputs[:n_cond], inputs[n_cond : n_cond + n_body], inputs[n_cond + n_body :]
    for _ in range(LONGEST_LOOP):
        goes_on = run(p["cond_jaxpr"], [*cond_consts, *state])[0]
        if not goes_on.known.all():
            break
        if not goes_on.value.any():
            return state
        after = run(p["body_jaxpr"], [*body_consts, *state])
        state = [_where(goes_on.value, new, old) for new, old in zip(after, state, strict=True)]
    body = p["body_jaxpr"].jaxpr
    kept = [out is old for out, old in zip(body.outvars, body.invars[n_body:], strict=True)]

    def step(state: list[Cells]) -> list[Cells]:
        decided_by = run(p["cond_jaxpr"], [*cond_consts, *state])[0].dependence
        after = run(p["body_jaxpr"], [*body_consts, *state])
        return [
            cells if same else cells.also(_lanes(decided_by, cells), sets)
            for cells, same in zip(after, kept, strict=True)
        ]

    return _repeat(step, state, sets)


def _lanes(x: np.ndarray, like: Cells) -> np.ndarray:
    """What there is one of for each lane of a batch, along the first axes of what all lanes have."""
    return x.reshape(x.shape + (1,) * (like.dependence.ndim - x.ndim))


def _where(goes_on: np.ndarray, after: Cells, before: Cells) -> Cells:
    """In a batch each lane has a condition of its own, and stays as it is where that is false."""
    mask = _lanes(goes_on, after)
    parts = ((after.dependence, before.dependence), (after.known, before.known), (after.value, before.value))
    return Cells(*(np.where(mask, new, old) for new, old in parts))


def _repeat(step: Callable[[list[Cells]], list[Cells]], state: list[Cells], sets: Sets) -> list[Cells]:
    """What `state` may be after any number of steps."""
    while True:
        after = step(state)
        if all(new.within(old, sets) for new, old in zip(after, state, strict=True)):
            return state
        state = [old.join(new, sets) for old, new in zip(state, after, strict=True)]


def linear_solve(eqn: Equation, inputs: list[Cells], run: Run, sets: Sets) -> list[Cells]:
    """A x = b, given by the function x ↦ A x: the pattern of A⁻¹ by blocks, whatever algorithm solves it.

    A x is run for unknowns that depend on nothing, which gives what the coefficients of an equation depend on, and for unknowns
    that are new elements, which gives the unknowns in it. In block triangular order a block's unknowns depend on all that its
    equations depend on and on the unknowns found before.
    """
    lengths = eqn.params["const_lengths"]
    right, avals = inputs[sum(lengths) :], [out.aval for out in eqn.outvars]
    ends = np.cumsum([0, *(cells.dependence.size for cells in right)]).tolist()
    n = ends[-1]

    def shaped(entries: Ids) -> list[Cells]:
        return [
            Cells.unknown(entries[low:high].reshape(aval.shape), aval)
            for low, high, aval in zip(ends[:-1], ends[1:], avals, strict=True)
        ]

    def times(unknowns: Ids) -> Ids:
        return _flat(run(eqn.params["jaxprs"].matvec, [*inputs[: lengths.matvec], *shaped(unknowns)]))

    own = sets.union(times(np.zeros(n, np.int64)), _flat(right))
    unknowns = sets.new_elements(n)
    on, jumps = sets.rows(times(unknowns))
    rows = variables_of(csr_array(on + jumps)[:, unknowns])
    nonzero = np.concatenate([part.nonzero.reshape(-1) for part in right])
    return shaped(_solve_blocks(rows, own, nonzero, sets))


def _solve_blocks(rows: list[list[int]], own: Ids, nonzero: np.ndarray, sets: Sets) -> Ids:
    """What each unknown depends on, of equations with the given unknowns, own dependences and right-hand sides.

    A block without a right-hand side, its own or from the blocks before, is solved by 0.
    """
    matching = [variable for variable in maximum_matching(rows, len(rows)) if variable is not None]
    if len(matching) < len(rows):
        return np.broadcast_to(sets.over(own, (0,)), own.shape)
    found, moves = np.zeros_like(own), np.zeros(len(rows), bool)
    for block in block_triangular(rows, matching):
        equations, variables = list(block.equations), list(block.variables)
        before = {variable for equation in equations for variable in rows[equation]} - {*variables}
        before = [variable for variable in sorted(before) if moves[variable]]
        if before or nonzero[equations].any():
            found[variables] = sets.over(np.concatenate([own[equations], found[before]]), (0,))
            moves[variables] = True
    return found


def _flat(cells: list[Cells]) -> Ids:
    return np.concatenate([part.dependence.reshape(-1) for part in cells])
