"""Which equations do not determine which unknowns, where an iteration matrix is singular."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..structure import Block, StructurallySingular, block_triangular, in_short, require_nonsingular
from ..systems import System, is_mechanism
from ..types import Args, State, Time
from .linearised import LinearisedResidual
from .residual_form import ResidualForm


# A step that is small beside all that moves; what of a row counts as 0; and a smallest singular value that does.
STEP, NOTHING, SINGULAR = 1e-6, 1e-12, 1e-10
# Larger blocks are not looked into.
LARGEST = 2000


def singular_block(system: System, t: Time, state: State, args: Args) -> str:
    """A sentence about the block of equations that leaves unknowns undetermined at a state, with ẏ as the equations have it
    there; empty for a mechanism, and where there is none.
    """
    if is_mechanism(system):
        return ""
    form = ResidualForm.of(system, t, state, args)
    y = form.encode(state)
    try:
        linearised = LinearisedResidual.of(form, y)
    except ValueError:
        return ""
    j, m = linearised.jacobians(t, y, linearised.ydot(t, y))
    scaled = linearised.storage.scale_columns(j + m / STEP, linearised.column_scale(jnp.asarray(STEP, y.dtype)))
    rows, columns = (np.ravel(x) for x in linearised.storage.positions())
    found = _block(rows, columns, np.ravel(np.asarray(scaled)), y.size)
    if found is None:
        return ""
    equations, variables = (
        in_short([names[i] for i in chosen])
        for names, chosen in ((form.equations, found.equations), (form.variables, found.variables))
    )
    return f"There the equations {equations} do not determine {variables}."


def _block(rows: np.ndarray, columns: np.ndarray, entries: Float[np.ndarray, " entries"], n: int) -> Block | None:
    """The first block of the block triangular form that is singular."""
    if not np.isfinite(entries).all():
        return None
    largest = np.zeros(n)
    np.maximum.at(largest, rows, np.abs(entries))
    there = (columns >= 0) & (np.abs(entries) > NOTHING * largest[rows])
    rows, columns, entries = rows[there], columns[there], entries[there] / largest[rows[there]]
    incidence: list[dict[int, float]] = [{} for _ in range(n)]
    for i, j, a in zip(rows.tolist(), columns.tolist(), entries.tolist(), strict=True):
        incidence[i][j] = a
    try:
        matching = require_nonsingular(incidence, n)
    except StructurallySingular as singular:
        return Block(singular.equations, singular.variables)
    for block in block_triangular(incidence, matching):
        if 1 < len(block.equations) <= LARGEST:
            matrix = np.array([[incidence[i].get(j, 0.0) for j in block.variables] for i in block.equations])
            sizes = np.linalg.svd(matrix, compute_uv=False)
            if sizes[-1] <= SINGULAR * sizes[0]:
                return block
    return None
