"""Dependence rules of primitives in which an entry comes from many: sums, products of matrices, linear algebra."""

from collections.abc import Callable, Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from ..compiler.types import Equation
from ..types import DType
from .cells import Cells, evaluate, unless
from .set_elements import ragged
from .sets import Sets


# So many terms of a product of matrices are looked at together.
MANY = 1 << 20

REDUCTIONS = frozenset(
    [
        "argmax",
        "argmin",
        "reduce_and",
        "reduce_max",
        "reduce_min",
        "reduce_or",
        "reduce_prod",
        "reduce_sum",
        "reduce_xor",
    ]
)
CUMULATIVE = frozenset(["cumlogsumexp", "cummax", "cummin", "cumprod", "cumsum"])

# Random numbers: every entry comes from the whole key.
RANDOM = frozenset(
    ["random_bits", "random_fold_in", "random_seed", "random_split", "random_unwrap", "random_wrap", "threefry2x32"]
)

# Every entry of a result depends on every entry of the operands that has the same leading indices: the number of
# trailing axes of the first operand that are mixed so.
DENSE = {
    "cholesky": 2,
    "cholesky_update": 2,
    "eig": 2,
    "eigh": 2,
    "geqp3": 2,
    "geqrf": 2,
    "hessenberg": 2,
    "householder_product": 2,
    "lu": 2,
    "lu_pivots_to_permutation": 1,
    "ormqr": 2,
    "qr": 2,
    "schur": 2,
    "svd": 2,
    "tridiagonal": 2,
    "tridiagonal_solve": 1,
}


def dense(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Linear algebra and Fourier transforms, matrix by matrix."""
    name = eqn.primitive.name
    batch = inputs[0].dependence.ndim - (len(eqn.params["fft_lengths"]) if name == "fft" else DENSE[name])
    total = np.zeros((), np.int64)
    for cells in inputs:
        total = sets.union(total, sets.over(cells.dependence, tuple(range(batch, cells.dependence.ndim))))
    return [
        Cells.unknown(total.reshape(total.shape + (1,) * (len(out.aval.shape) - batch)), out.aval)
        for out in eqn.outvars
    ]


def mixed(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Every entry depends on all entries of all operands."""
    total = sets.over(np.concatenate([cells.dependence.reshape(-1) for cells in inputs]), (0,))
    return [Cells.unknown(total, out.aval) for out in eqn.outvars]


def reduction(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Sums, products, extrema along axes. A product with a known 0 is 0."""
    (operand,), axes = inputs, tuple(eqn.params["axes"])
    known = np.asarray(operand.known.all(axes))
    if eqn.primitive.name == "reduce_prod":
        known = known | ~operand.nonzero.all(axes)
    return [_finish(eqn, inputs, sets.over(operand.dependence, axes), known)]


def cumulative(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Cumulative sums, products and extrema along an axis."""
    (operand,), axis = inputs, eqn.params["axis"]

    def along(accumulate: Callable[[np.ndarray], np.ndarray], a: np.ndarray) -> np.ndarray:
        forward = slice(None, None, -1 if eqn.params["reverse"] else 1)
        return np.moveaxis(accumulate(np.moveaxis(a, axis, 0)[forward])[forward], 0, axis)

    dependence = along(sets.accumulated, operand.dependence)
    return [_finish(eqn, inputs, dependence, along(np.logical_and.accumulate, operand.known))]


def general_reduction(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """`lax.reduce` with any function: each result depends on all operands along the axes."""
    axes, half = tuple(eqn.params["dimensions"]), len(inputs) // 2
    total = np.zeros((), np.int64)
    for operand, start in zip(inputs[:half], inputs[half:], strict=True):
        total = sets.union(sets.union(total, sets.over(operand.dependence, axes)), start.dependence)
    return [Cells.unknown(total, out.aval) for out in eqn.outvars]


def dot_general(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Sums of products a_bmk c_bkn; a term with a known 0 adds nothing."""
    (a_sum, c_sum), (a_batch, c_batch) = eqn.params["dimension_numbers"]
    a = inputs[0].map(lambda x: _as_batch_matrix(x, a_batch, a_sum))
    c = inputs[1].map(lambda x: _as_batch_matrix(x, c_batch, c_sum))
    a_nonzero, c_nonzero = a.nonzero, c.nonzero
    dependence = np.zeros(a.shape[0] * a.shape[1] * c.shape[1], np.int64)
    if a_nonzero.all() and c_nonzero.all():
        left, right = sets.over(a.dependence, (2,)), sets.over(c.dependence, (2,))
        dependence = sets.union(left[:, :, None], right[:, None, :])
    else:
        for b, m, n, k in _terms(a_nonzero, c_nonzero):
            entries = sets.union(a.dependence[b, m, k], c.dependence[b, n, k])
            dependence = sets.at(dependence, (b * a.shape[1] + m) * c.shape[1] + n, entries)
    open_terms = _batch_product(a_nonzero, c_nonzero) - _batch_product(a_nonzero & a.known, c_nonzero & c.known)
    shape = eqn.outvars[0].aval.shape
    return [_finish(eqn, inputs, dependence.reshape(shape), (open_terms == 0).reshape(shape))]


def convolution(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Sums of products of image and kernel; a term with a known 0 adds nothing.

    The image entry that meets a kernel entry is found by convolving an image of positions with that entry alone.
    """
    image, kernel = inputs
    aval = eqn.outvars[0].aval
    places = np.arange(1, image.dependence.size + 1, dtype=np.float32).reshape(image.shape)
    flat_dependence, flat_known = image.dependence.reshape(-1), image.known.reshape(-1)
    flat_nonzero = image.nonzero.reshape(-1)
    dependence, known = np.zeros(aval.shape, np.int64), np.ones(aval.shape, bool)
    for tap in np.argwhere(kernel.nonzero):
        tap = tuple(tap)
        alone = np.zeros(kernel.shape, np.float32)
        alone[tap] = 1
        place = np.asarray(evaluate(_with_dtype(eqn, np.float32), [places, alone])[0]).round().astype(int) - 1
        meets = (place >= 0) & flat_nonzero[place]
        term = unless(~meets, sets.union(flat_dependence[place], kernel.dependence[tap]))
        dependence = sets.union(dependence, term)
        known &= ~meets | (flat_known[place] & kernel.known[tap])
    return [_finish(eqn, inputs, dependence, known)]


def triangular_solve(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Substitution, row by row: the pattern of the triangle is kept."""
    p, (a, b) = eqn.params, inputs
    lower = p["lower"]
    if p["transpose_a"] == p["left_side"]:  # x A = b is Aᵀ xᵀ = bᵀ
        a, lower = a.map(lambda x: x.swapaxes(-1, -2)), not lower
    if not p["left_side"]:
        b = b.map(lambda x: x.swapaxes(-1, -2))
    n = a.shape[-1]
    a_nonzero = a.nonzero
    x, nonzero = b.dependence.copy(), b.nonzero.copy()
    beside = np.tril(a_nonzero, -1) if lower else np.triu(a_nonzero, 1)
    for batch in np.ndindex(a.shape[:-2]):
        for i in range(n) if lower else range(n - 1, -1, -1):
            used = np.flatnonzero(beside[(*batch, i)])
            there = nonzero[batch][used]
            terms = sets.union(x[batch][used], a.dependence[(*batch, i)][used][:, None])
            entry = np.concatenate([x[batch][[i]], unless(~there, terms)])
            nonzero[(*batch, i)] |= there.any(0)
            if not p["unit_diagonal"]:
                entry = np.append(entry, np.broadcast_to(a.dependence[(*batch, i, i)], (1, x.shape[-1])), 0)
            x[(*batch, i)] = unless(~nonzero[(*batch, i)], sets.over(entry, (0,)))
    result = Cells(x, ~nonzero, np.zeros(x.shape, b.value.dtype))
    return [result if p["left_side"] else result.map(lambda x: x.swapaxes(-1, -2))]


def sort(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Operands put in the order of their keys, on which they depend by jumps: every entry along the axis may end up anywhere."""
    axis, keys = eqn.params["dimension"], inputs[: eqn.params["num_keys"]]
    order = np.zeros((), np.int64)
    for key in keys:
        order = sets.union(order, sets.through_jump(key.dependence))
    return [
        Cells.unknown(sets.over(sets.union(cells.dependence, order), (axis,), keepdims=True), out.aval)
        for cells, out in zip(inputs, eqn.outvars, strict=True)
    ]


def top_k(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """The largest entries along an axis, and where they are."""
    axis = eqn.params.get("axis", -1) % len(inputs[0].shape)
    total = sets.over(inputs[0].dependence, (axis,), keepdims=True)
    return [Cells.unknown(total, out.aval) for out in eqn.outvars]


def _finish(eqn: Equation, inputs: list[Cells], dependence: np.ndarray, known: np.ndarray) -> Cells:
    """The result, with its known entries computed from the operands, 0 in place of what is not known."""
    aval = eqn.outvars[0].aval
    known = np.asarray(known)
    if not known.any():
        return Cells.unknown(dependence, aval)
    values = [np.where(cells.known, cells.value, np.zeros((), cells.value.dtype)) for cells in inputs]
    return Cells(unless(known, dependence), known, evaluate(eqn, values)[0])


def _as_batch_matrix(array: np.ndarray, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """The array with axes (batch, free, summed)."""
    free = [axis for axis in range(array.ndim) if axis not in {*batch, *summed}]
    sizes = [int(np.prod([array.shape[axis] for axis in axes])) for axes in (batch, free, summed)]
    return array.transpose([*batch, *free, *summed]).reshape(sizes)


def _terms(a: np.ndarray, c: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """The places (b, m, n, k) with a_bmk and c_bnk, so many at a time."""
    b, k, m = np.nonzero(a.transpose(0, 2, 1))
    count = c.sum(1)[b, k]
    of_k, n = np.nonzero(c.transpose(0, 2, 1).reshape(c.shape[0] * c.shape[2], c.shape[1]))
    first = np.searchsorted(of_k, b * c.shape[2] + k)
    for part in np.split(np.arange(len(b)), np.flatnonzero(np.diff(np.cumsum(count) // MANY)) + 1):
        which, places = ragged(first[part], count[part])
        which = part[which]
        yield b[which], m[which], n[places], k[which]


def _batch_product(a: np.ndarray, c: np.ndarray) -> np.ndarray:
    """How many k have both a_bmk and c_bnk."""
    return np.matmul(a.astype(np.float32), c.astype(np.float32).swapaxes(-1, -2))


def _with_dtype(eqn: Equation, dtype: DType) -> Equation:
    """The equation with another dtype of its result."""
    params = eqn.params | {"preferred_element_type": jnp.dtype(dtype)}
    return eqn.replace(params=params)
