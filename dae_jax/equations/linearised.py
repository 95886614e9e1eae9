"""The linearisation of 0 = F(t, y, ẏ): what a solver of residuals needs to solve for a step."""

import dataclasses
import functools
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact, Int, PyTree
from scipy.sparse import csr_array

from ..linalg import fixed_point, powers, relative_change
from ..linalg.dense import LOOPED
from ..linalg.iterative import GMRES, Iterative
from ..linalg.sparse import Sparse
from ..linalg.storage import Banded, Dense
from ..structure import (
    highest_value_transversal,
    reverse_cuthill_mckee,
    shape_of,
    sigma_method,
    signature,
)
from ..types import BoolLike, Flat, Scalar, State, Time
from .compression import Compression
from .derivative_orders import Combination, Offsets, find_offsets
from .index1_form import Index1Form
from .initial_rates import is_nonlinear, rates_of
from .manifold_ode import at_one_instant, constant
from .probe import Probe
from .residual_form import LARGE, ResidualForm


Storage: TypeAlias = Dense | Banded | Sparse | Iterative

GAUSS_NEWTON = 5
# Where each takes a factorisation, no more than are needed, and at most:
DEAR_CORRECTIONS = 20
# What a multiplication by a band, and one of sparse factors, costs, in parts of one of a dense matrix: 150 unknowns with 14,000 entries in
# the factors take 12.7 ms and 19.2 dense, 80 with 5,500 take 10.5 and 5.7. Where pivots are chosen by numbers, SuperLU takes most of it.
BAND_COST, SPARSE_COST, PIVOTED_COST = 4, 2, 16
# Of more unknowns no dense matrix is factorised, however full the sparse factors are: that takes seconds.
NEVER_DENSE = 4000


@dataclasses.dataclass(frozen=True, eq=False)
class JacobianStructure:
    """What is known of a residual's linearisation before it is evaluated. Compared by identity: keep one for a pattern.

    `indices`, `offsets`: the index of each variable, and how often it is differentiated (d of the Σ-method);
    `differential`: whether its derivative occurs; `hidden`: whether an equation must be differentiated to see which values
    are consistent; `combination`: of the rows, before these are factored; `by_y`, `by_rate`: the compressed Jacobians,
    `None` for small ones.
    """

    storage: Storage
    indices: tuple[int, ...]
    offsets: tuple[int, ...]
    differential: Bool[np.ndarray, " n"]
    hidden: bool
    combination: Combination
    by_y: Compression | None
    by_rate: Compression | None


class LinearisedResidual(eqx.Module):
    """J + c M with J = ∂F/∂y and M = ∂F/∂ẏ, of a residual. It travels through `diffrax.diffeqsolve` as `args`.

    `start`: ẏ where a solve starts. `felt`: the smallest steps that are to be short enough for forward derivatives too, where the
    program is traced for these. `patient`: whether steps that fail are not tried again with a smaller size. `time_scale`: for
    each unknown the time in which the tolerance of a rate makes that of what it is the rate of; the unit of time if not known.
    """

    form: ResidualForm | Index1Form
    structure: JacobianStructure = eqx.field(static=True)
    start: Float[Array, " n"] | None = None
    felt: Scalar | None = None
    patient: BoolLike = False
    time_scale: Float[Array, " n"] | None = None

    @classmethod
    def of(
        cls, form: ResidualForm | Index1Form, y: Float[Array, " n"], indices: tuple[int, ...] | None = None
    ) -> "LinearisedResidual":
        """Finds, while tracing, which equation depends on which variable and derivative.

        Errors: `ValueError` for a structurally singular system.
        """
        try:
            found = find_offsets(form, y.dtype)
        except NotImplementedError:
            # A primitive that structural analysis does not know: all may depend on all.
            full = csr_array(np.ones((y.size, y.size), bool))
            rows = signature(full, full)
            found = Offsets(full, full, rows, sigma_method(rows))
        indices = indices or found.indices
        offsets = found.sigma.variable_offsets
        patterns = _PatternKey.of(found.by_y), _PatternKey.of(found.by_rate)
        on_gpu = jax.default_backend() == "gpu"
        return cls(form, _outline(*patterns, indices, offsets, found.index > 1, found.combination, on_gpu))

    @property
    def storage(self) -> Storage:
        """How J and M are stored."""
        return self.structure.storage

    def decode(self, t: Time, y: Float[Array, " n"]) -> Any:
        """The state in the user's structure."""
        return self.form.decode(t, y)

    def tolerances(self, t: Time, y: Float[Array, " n"], each: State, absolute: bool) -> Float[Array, " n"]:
        """A tolerance for each unknown, of one for `each` number of the state."""
        return self.form.tolerances(t, self.decode(t, y), each, absolute)

    def measured_in(self, t: Time, y: Float[Array, " n"], lengths: Float[Array, " n"]) -> "LinearisedResidual":
        """The same with the `time_scale` of these tolerances, where variables of an index above 1 count by the step size."""
        if isinstance(self.form, Index1Form) or max(self.structure.indices) < 2:
            return self
        found = self.form.time_scale(t, self.decode(t, y), self.decode(t, lengths))
        return dataclasses.replace(self, time_scale=jax.lax.stop_gradient(found))

    def residual(self, t: Time, y: Float[Array, " n"], yd: Float[Array, " n"]) -> Float[Array, " n"]:
        """F(t, y, ẏ)."""
        return self.form.residual(t, y, yd)

    def jacobians(self, t: Time, y: Float[Array, " n"], yd: Float[Array, " n"]) -> tuple[Array, Array]:
        """J and M."""
        t = jnp.asarray(t, y.dtype)
        return self._by_y(t, y, yd), self._by_rate(t, y, yd)

    @at_one_instant
    def _by_y(self, t: Scalar, y: Float[Array, " n"], yd: Float[Array, " n"]) -> Array:
        return self._by(1, self.structure.by_y, t, y, yd)

    @at_one_instant
    def _by_rate(self, t: Scalar, y: Float[Array, " n"], yd: Float[Array, " n"]) -> Array:
        return self._by(2, self.structure.by_rate, t, y, yd)

    def _by(self, argument: int, compression: Compression | None, *point: Array) -> Array:
        """The stored entries of the derivative of F(t, y, ẏ) by one of its arguments."""
        if compression is None:
            return jax.jacfwd(self.form.residual, argument)(*point)
        of = lambda x: self.residual(*(x if k == argument else given for k, given in enumerate(point)))
        return compression.jacobian(of, point[argument])

    def factor(self, j: Array, m: Array, c: Inexact[Array, ""], h: Time) -> Any:
        """The factors of J + c M, for c of the order of 1/h.

        With column j scaled by h^dⱼ, the rows tend with h → 0 to those of the Σ-method's system Jacobian, however high the
        index, or of the combination's; without, the condition would grow like h^(−index).
        """
        scale = self.column_scale(h)
        matrix = self.storage.scale_columns(self.combined(j + c * m, c), scale)
        return self.storage.factor(matrix), scale, c

    def probe(self, j: Array, m: Array, factors: PyTree) -> Probe:
        """That of J + c M by its factors."""
        _, scale, c = factors
        matrix = jax.lax.stop_gradient(j + c * m)
        return Probe.of(functools.partial(self.storage.apply, matrix), functools.partial(self.solve, factors), scale)

    def terms(self, j: Array, m: Array, c: Inexact[Array, ""], size: Float[Array, " n"]) -> Float[Array, " n"]:
        """How large the terms of each of the combined equations are together, (|J| + |c M|) |x|, for variables of that `size`."""
        terms = self.storage.apply(jnp.abs(j) + jnp.abs(c * m), size)
        return _combined(self.structure.combination.of_sizes, terms, jnp.abs(c))

    def column_scale(self, h: Time) -> Float[Array, " n"]:
        """h^dⱼ, or 1 where the storage takes the unknowns as they are."""
        offsets = self.structure.offsets
        return powers(jnp.minimum(jnp.abs(h), 1), offsets if self.storage.graded else (0,) * len(offsets))

    def solve(self, factors: PyTree, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with (J + c M) x = b."""
        inner, scale, c = factors
        return scale * self.storage.solve(inner, self.combined(b, c))

    def combined(self, rows: Array, c: Inexact[Array, ""]) -> Any:
        """Rows, or right-hand sides, in the combination in which highest derivatives do not cancel, with c for d/dt."""
        return _combined(self.structure.combination, rows, c)

    def ydot(self, t: Time, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """ẏ with F(t, y, ẏ) = 0 where y is consistent, else with the least F; for variables whose derivative does not occur
        what the form knows. Gauss–Newton's method, or a search where F is nonlinear in ẏ.
        """
        t = jnp.asarray(t, y.dtype)
        if is_nonlinear(self.form, y.dtype):
            return rates_of(self.form, t, y)[0]

        def improved(yd: Flat) -> Flat:
            return yd - self.storage.least_squares(self._by_rate(t, y, yd), self.residual(t, y, yd))

        def correct(yd: Flat) -> tuple[Flat, Scalar]:
            new = improved(yd)
            return new, relative_change(new - yd, yd)

        start = self.form.known_ydot(y)
        if self.storage.dear:
            return fixed_point(correct, start, max_steps=DEAR_CORRECTIONS)[0]
        return jax.lax.fori_loop(0, GAUSS_NEWTON, lambda _, yd: improved(yd), start)

    def solved_by(self, method: GMRES | None) -> "LinearisedResidual":
        """With another method for its linear equations, where one is given."""
        return self if method is None else dataclasses.replace(self, structure=_iterative(self.structure, method))

    def starting(self, t: Time, y: Float[Array, " n"]) -> "LinearisedResidual":
        """For a solve from (t, y)."""
        # Before they are computed, too: JAX would differentiate the search, and throw that away.
        fixed, t, y = constant((self, t, y))
        return dataclasses.replace(self, start=constant(fixed.ydot(t, y)))

    def weights(self, h: Time, raised: Time = 1.0) -> Float[Array, " n"]:
        """(h/T)^(k−1) for a variable of index k > 1, where h is below its `time_scale` T: how much of its error counts; up to
        `raised` times that, or (h/T)^(k−2), for those that the user sees.

        Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, VII.3 and the program RADAU5.
        """
        size = jnp.minimum(jnp.abs(h) if self.time_scale is None else jnp.abs(h) / self.time_scale, 1)
        indices = np.array(self.structure.indices)
        weights = powers(size, tuple(np.maximum(indices - 1, 0).tolist()))
        seen = self.followed
        return weights * jnp.where(seen, jnp.clip(raised, 1, 1 / size), 1) if seen.any() else weights

    def between(self, dense: bool) -> Bool[np.ndarray, " n"]:
        """Of which variables the way between the ends of a step counts: the user's of index 2 and higher, which follow from
        derivatives; with `dense` all of the user's.
        """
        return self.form.shown & (dense | self.followed)

    @property
    def followed(self) -> Bool[np.ndarray, " n"]:
        """Which of the user's variables of index 2 and higher are controlled by themselves."""
        return self.form.independent & (np.array(self.structure.indices) > 1)

    def counted(self, dense: bool) -> Bool[np.ndarray, " n"]:
        """Which variables are of index 0 or 1, or seen by the user where values between steps are wanted."""
        return (np.array(self.structure.indices) <= 1) | (dense & self.form.shown)


def _combined(combination: Combination, rows: Array, c: Inexact[Array, ""]) -> Any:
    return combination.of([rows * c**k if k else rows for k in range(combination.degree + 1)])[0]


class _PatternKey(NamedTuple):
    """Which entries of a square matrix may not be 0: rows of it one after the other, as a key of what was found."""

    size: int
    indices: bytes
    starts: bytes

    @classmethod
    def of(cls, pattern: "Bool[np.ndarray, 'n n'] | csr_array") -> "_PatternKey":
        rows = csr_array(pattern)
        rows.sort_indices()
        return cls(shape_of(rows)[0], rows.indices.astype(np.int64).tobytes(), rows.indptr.astype(np.int64).tobytes())

    def whole(self) -> csr_array:
        """As a matrix of truth values."""
        columns, starts = (np.frombuffer(x, np.int64) for x in (self.indices, self.starts))
        return csr_array((np.ones(len(columns), bool), columns, starts), shape=(self.size, self.size))


@functools.lru_cache(maxsize=64)
def _outline(
    on_y: _PatternKey,
    on_rate: _PatternKey,
    indices: tuple[int, ...],
    offsets: tuple[int, ...],
    hidden: bool,
    combination: Combination,
    on_gpu: bool,
) -> JacobianStructure:
    by_y, by_rate = on_y.whole(), on_rate.whole()
    storage = _storage(by_y + by_rate, by_rate, highest_value_transversal(signature(by_y, by_rate)), hidden or on_gpu)
    small = len(indices) <= LOOPED
    return JacobianStructure(
        storage,
        indices,
        offsets,
        np.bincount(by_rate.indices, minlength=len(indices)) > 0,
        hidden,
        combination if isinstance(storage, Dense) else Combination(),
        None if small else _compression(by_y, storage),
        None if small else _compression(by_rate, storage),
    )


@functools.lru_cache(maxsize=64)
def _iterative(structure: JacobianStructure, method: GMRES) -> JacobianStructure:
    return dataclasses.replace(structure, storage=Iterative(structure.storage, method))


def _storage(pattern: csr_array, by_rate: csr_array, transversal: list[int], pivots: bool) -> Storage:
    """Sparse factors or, where `pivots` are to be chosen within the kernel, a band with each equation in the place of its variable."""
    n = len(transversal)
    if n <= LOOPED:
        return Dense(n)
    pairing = np.array(transversal)
    # Where constraints are hidden, pivots along the diagonal are small, and a GPU cannot leave them to the host. Otherwise 144 unknowns
    # of a heat equation take 0.9 ms with sparse factors and 10.9 in a band.
    if pivots and n <= LARGE:
        equation_of = np.argsort(pairing)
        paired = pattern[equation_of]
        order = reverse_cuthill_mckee((paired + paired.T).toarray())
        rows, columns = paired[order][:, order].nonzero()
        lower, upper = (max(int((way * (rows - columns)).max(initial=0)), 0) for way in (1, -1))
        if BAND_COST * (lower + 1) * (lower + upper + 1) <= n * n:
            return Banded(equation_of[order], order, lower, upper)
    rows, columns = pattern.nonzero()
    sparse = Sparse(rows, columns, pairing, _is_in(by_rate, rows, columns))
    cost = PIVOTED_COST if pivots else SPARSE_COST
    return sparse if n > NEVER_DENSE or cost * sparse.symbolic.cost <= n**3 / 3 else Dense(n)


def _compression(pattern: csr_array, storage: Storage) -> Compression:
    rows, columns = storage.positions()
    return Compression.of(pattern, rows, columns, (columns >= 0) & _is_in(pattern, rows, columns))


def _is_in(pattern: csr_array, rows: Int[np.ndarray, "*stored"], columns: Int[np.ndarray, "*stored"]) -> Any:
    """Which of the positions a pattern has."""
    n, (i, j) = shape_of(pattern)[1], pattern.nonzero()
    return np.isin(rows.astype(np.int64) * n + columns, i.astype(np.int64) * n + j)
