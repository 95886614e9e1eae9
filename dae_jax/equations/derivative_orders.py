"""How often each equation of 0 = F(t, y, ẏ) is differentiated, also where highest derivatives cancel between equations."""

import dataclasses
import functools
import heapq
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Inexact
from scipy.sparse import csr_array

from ..linalg.dense import LOOPED
from ..linalg.pivoted_lu import factorised
from ..structure import (
    SigmaAnalysis,
    StructurallySingular,
    dependence_patterns,
    in_short,
    jacobian_pattern,
    sigma_method,
    signature,
    variable_indices,
)
from ..types import DType, Flat, Time
from .slopes import Polynomials, Slopes


@dataclasses.dataclass(frozen=True)
class Combination:
    """Equations F̄ₗ = Σ a dᵏFᵢ/dtᵏ that take the place of others; solutions stay the same. Compared by value.

    `rows`: (l, terms), with terms (i, k, a); Fₗ is one of them, with k = 0 and a = 1.
    """

    rows: tuple[tuple[int, tuple[tuple[int, int, float], ...]], ...] = ()

    @property
    def degree(self) -> int:
        """How many derivatives of F are needed for F̄."""
        return max((k for _, terms in self.rows for _, k, _ in terms), default=0)

    @functools.cached_property
    def _replaced(self) -> dict[int, tuple[tuple[int, int, float], ...]]:
        return dict(self.rows)

    @functools.cached_property
    def of_sizes(self) -> "Combination":
        """The same of the sizes of terms."""
        return Combination(tuple((i, tuple((j, k, abs(a)) for j, k, a in terms)) for i, terms in self.rows))

    def terms(self, equation: int) -> tuple[tuple[int, int, float], ...]:
        """What F̄ₗ is made of."""
        return self._replaced.get(equation, ((equation, 0, 1.0),))

    def of(self, levels: list[Inexact[Array, "n *k"]]) -> list[Inexact[Array, "n *k"]]:
        """F̄, dF̄/dt, … of F, dF/dt, …: as many fewer as the degree."""
        if not self.rows:
            return levels
        entry = lambda m, i: sum(a * levels[m + k][j] for j, k, a in self.terms(i))
        count, n = len(levels) - self.degree, len(levels[0])
        if n <= LOOPED:
            return [jnp.stack([entry(m, i) for i in range(n)]) for m in range(count)]
        places = np.array(list(self._replaced))
        return [levels[m].at[places].set(jnp.stack([entry(m, i) for i in places.tolist()])) for m in range(count)]

    def names(self, equations: tuple[str, ...]) -> tuple[str, ...]:
        """A name for each equation."""
        written = lambda i: "".join(
            _sign(a, n) + derivative_of(equations[j], k) for n, (j, k, a) in enumerate(self.terms(i))
        )
        return tuple(map(written, range(len(equations))))


@dataclasses.dataclass(frozen=True, eq=False)
class Offsets:
    """What the Σ-method finds of F̄. `by_y`, `by_rate`: the patterns of the Jacobians of F, with sorted indices."""

    by_y: csr_array
    by_rate: csr_array
    signature: list[dict[int, int]]
    sigma: SigmaAnalysis
    combination: Combination = Combination()

    @functools.cached_property
    def indices(self) -> tuple[int, ...]:
        """The index of each variable."""
        c, combination = self.sigma.equation_offsets, self.combination
        often = [c[i] + max(k for _, k, _ in combination.terms(i)) for i in range(len(c))]
        return variable_indices(self.pattern, self.sigma.transversal, often, self.sigma.variable_offsets)

    @property
    def variables(self) -> csr_array:
        """Which variables occur in which equation of F, with a derivative or without."""
        return self.by_y + self.by_rate

    @property
    def index(self) -> int:
        """The structural index: how often equations must be differentiated for the derivatives of all variables."""
        return max(self.indices, default=0)

    @functools.cached_property
    def occurrence(self) -> csr_array:
        """The variables of each equation F̄ᵢ, with any of their derivatives."""
        of_f = self.variables
        if not self.combination.rows:
            return of_f
        terms = [(i, j) for i in range(len(self.signature)) for j, *_ in self.combination.terms(i)]
        rows, columns = np.array(terms).T
        return csr_array((np.ones(len(terms), bool), (rows, columns)), shape=of_f.shape) @ of_f

    @functools.cached_property
    def pattern(self) -> list[list[int]]:
        """The variables of each row of the system Jacobian."""
        return jacobian_pattern(self.signature, self.sigma.equation_offsets, self.sigma.variable_offsets)


@runtime_checkable
class Form(Protocol):
    """What is asked of 0 = F(t, y, ẏ). `may_cancel`: whether highest derivatives may cancel between equations."""

    @property
    def size(self) -> int: ...
    @property
    def equations(self) -> tuple[str, ...]: ...
    @property
    def variables(self) -> tuple[str, ...]: ...
    @property
    def may_cancel(self) -> bool: ...
    def residual(self, t: Time, y: Flat, yd: Flat) -> Any: ...


# What was found of the last systems, of which a solve asks several times.
_found: dict[Hashable, Offsets] = {}
KEPT = 16


def find_offsets(form: Form, dtype: DType) -> Offsets:
    """`offsets_of`, remembered."""
    key = _known_by(form, dtype)
    if key is None:
        return offsets_of(form, dtype)
    found = _found.get(key)
    if found is None:
        found = _found[key] = offsets_of(form, dtype)
        for oldest in list(_found)[:-KEPT]:
            _found.pop(oldest, None)
    return found


def _known_by(form: Form, dtype: DType) -> Hashable:
    """What the offsets depend on; `None` where that are numbers, whose zeros count, or something that cannot be compared."""
    arrays, rest = eqx.partition(form, eqx.is_array)
    found = jax.tree.leaves(arrays)
    if not all(isinstance(x, Tracer) for x in found):
        return None
    leaves, treedef = jax.tree.flatten(rest)
    key = (*leaves, *map(type, leaves)), treedef, tuple((x.shape, x.dtype) for x in found), jnp.dtype(dtype)
    try:
        hash(key)
    except TypeError:
        return None
    return key


def offsets_of(form: Form, dtype: DType) -> Offsets:
    """The Σ-method, by the linear-combination method where it fails because terms cancel.

    Where u with constant entries makes uᵀ ∂F̄ᵢ/∂xⱼ^(dⱼ−cᵢ) = 0, one of the equations with the smallest offset c among those
    with uᵢ ≠ 0 is replaced by Σ uᵢ dᵏF̄ᵢ/dtᵏ, k = cᵢ − c, in which the cancelling terms are gone. Again until there is no such
    u: the degrees of freedom become fewer each time. What cancels is read from the equations, see
    `dae_jax.compiler.jaxprs.polynomials`, which takes a time for each number: where that is too much, from about a thousand
    equations that share their highest derivatives with others, it is not looked for, and offsets, index and degrees of freedom
    are those of the pattern. `analyse` then finds the system Jacobian singular.

    Errors: `ValueError` for a structurally singular system, naming its equations and variables; `NotImplementedError` for a
    primitive that structural analysis does not know.

    Source: G. Tan, N. S. Nedialkov, J. D. Pryce, Conversion methods for improving structural analysis of
    differential-algebraic equation systems, BIT 57 (2017).
    """
    y, time = jax.ShapeDtypeStruct((form.size,), dtype), jax.ShapeDtypeStruct((), dtype)
    _, by_y, by_rate = dependence_patterns(form.residual, time, y, y, derivative=True)
    rows = signature(by_y, by_rate)
    try:
        found = Offsets(by_y, by_rate, rows, sigma_method(rows))
    except StructurallySingular as singular:
        equations = in_short([form.equations[i] for i in singular.equations])
        variables = in_short([form.variables[j] for j in singular.variables])
        raise ValueError(singular.sentence(equations, variables)) from None
    slopes = functools.cache(lambda degree: Slopes(form.residual, found.variables, degree, dtype).as_polynomials())
    while form.may_cancel and (better := _combined(slopes, found)):
        found = better
    return found


def _combined(slopes: Callable[[int], Polynomials | None], before: Offsets) -> Offsets | None:
    """With some of the equations replaced; `None` where nothing cancels."""
    c, d = before.sigma.equation_offsets, before.sigma.variable_offsets
    candidates = _may_cancel(before.pattern)
    found = slopes(before.combination.degree) if candidates else None
    if found is None:
        return None
    entries = {i: _summed(before.combination.terms(i), found) for i in candidates}
    jacobian = [{(j, m): a for (k, j, m), a in entries[i].items() if k == d[j] - c[i]} for i in candidates]
    replaced: dict[int, Any] = {}
    touched: set[int] = set()
    for vector in _left_null_vectors(jacobian):
        support = {candidates[place]: u for place, u in vector.items()}
        if touched.isdisjoint(support):
            touched.update(support)
            lowest = min(c[i] for i in support)
            row = max(i for i in support if c[i] == lowest)
            terms: dict[tuple[int, int], float] = {}
            for i, u in support.items():
                for j, k, a in before.combination.terms(i):
                    at = (j, k + c[i] - lowest)
                    terms[at] = terms.get(at, 0.0) + u / support[row] * a
            replaced[row] = tuple((j, k, a) for (j, k), a in sorted(terms.items()))
    if not replaced:
        return None
    combination = Combination(tuple(sorted({**dict(before.combination.rows), **replaced}.items())))
    found = slopes(combination.degree)
    if found is None:
        return None
    rows = list(before.signature)
    for i, terms_of_row in replaced.items():
        rows[i] = {j: k for k, j, _ in sorted(_summed(terms_of_row, found))}
    try:
        after = dataclasses.replace(before, signature=rows, sigma=sigma_method(rows), combination=combination)
    except StructurallySingular:
        # An equation that says nothing: the system Jacobian is left singular.
        return None
    return after if after.sigma.degrees_of_freedom < before.sigma.degrees_of_freedom else None


def _summed(terms: Sequence[tuple[int, int, float]], slopes: Polynomials) -> dict[tuple[int, int, Any], float]:
    """The slopes of a combination: coefficients that are not 0, by order, variable and monomial."""
    value: dict[tuple[int, int, Any], float] = {}
    size: dict[tuple[int, int, Any], float] = {}
    for i, k, factor in terms:
        for (order, j), entry in slopes[k][i].items():
            for monomial, a in entry.items():
                at = (order, j, monomial)
                value[at] = value.get(at, 0.0) + factor * a
                size[at] = size.get(at, 0.0) + abs(factor * a)
    # What is left of numbers that cancel is none.
    return {at: a for at, a in value.items() if abs(a) > 1e-12 * size[at]}


def _may_cancel(pattern: list[list[int]]) -> list[int]:
    """The equations that are not alone in any of their columns, those left out that are."""
    occurs_in: dict[int, list[int]] = {}
    for i, variables in enumerate(pattern):
        for j in variables:
            occurs_in.setdefault(j, []).append(i)
    count = {j: len(equations) for j, equations in occurs_in.items()}
    left = set(range(len(pattern)))
    alone = [j for j, number in count.items() if number == 1]
    for j in alone:
        for i in left.intersection(occurs_in[j]):
            left.remove(i)
            for other in pattern[i]:
                count[other] -= 1
                if count[other] == 1:
                    alone.append(other)
    return sorted(left)


def _left_null_vectors(rows: Sequence[Mapping[Any, float]]) -> list[dict[int, float]]:
    """The combinations of rows, given as polynomials over their columns, that vanish; by sparse elimination."""
    if len(rows) > LOOPED and _are_independent(rows):
        return []
    basis: list[tuple[Any, dict[Any, float], dict[int, float]]] = []
    eliminates: dict[Any, int] = {}
    found = []
    for i, row in enumerate(rows):
        values, sizes, combined = dict(row), {at: abs(a) for at, a in row.items()}, {i: 1.0}
        # A row of the basis has no pivot of those before it: what it brings in is eliminated later.
        left = [eliminates[at] for at in values if at in eliminates]
        heapq.heapify(left)
        while left:
            pivot, other, how = basis[heapq.heappop(left)]
            factor = values.pop(pivot, 0.0) / other[pivot]
            for at, a in other.items():
                if at != pivot:
                    if at not in values and at in eliminates:
                        heapq.heappush(left, eliminates[at])
                    values[at] = values.get(at, 0.0) - factor * a
                    sizes[at] = sizes.get(at, 0.0) + abs(factor * a)
            for k, a in how.items():
                combined[k] = combined.get(k, 0.0) - factor * a
        values = {at: a for at, a in values.items() if abs(a) > 1e-12 * sizes[at]}
        if values:
            pivot = max(values, key=lambda at: abs(values[at]))
            eliminates[pivot] = len(basis)
            basis.append((pivot, values, combined))
        else:
            largest = max(map(abs, combined.values()))
            found.append({k: a for k, a in sorted(combined.items()) if abs(a) > 1e-12 * largest})
    return found


def _are_independent(rows: Sequence[Mapping[Any, float]]) -> bool:
    """Whether rows of polynomials, keyed by (column, monomial), are so for some numbers in place of their monomials: then no
    combination of them vanishes. False where that is not seen.
    """
    rng = np.random.default_rng(0)
    numbers: dict[Any, float] = {}
    columns: dict[Any, int] = {}
    entries = [
        (i, columns.setdefault(j, len(columns)), a * numbers.setdefault(m, rng.uniform(1, 2)))
        for i, row in enumerate(rows)
        for (j, m), a in row.items()
    ]
    if len(columns) != len(rows):
        return False
    i, j, a = map(np.array, zip(*entries, strict=True))
    return factorised(i, j, a, len(rows)).smallest > float(np.finfo(a.dtype).eps) ** 0.5


def derivative_of(equation: str, times: int) -> str:
    """Its name."""
    return (("", "d/dt ")[times] if times < 2 else f"d^{times}/dt^{times} ") + equation


def _sign(factor: float, place: int) -> str:
    sign = (" + ", " − ") if place else ("", "−")
    return sign[factor < 0] + ("" if abs(factor) == 1 else f"{abs(factor):.4g}·")
