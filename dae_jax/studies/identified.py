"""What `identify` has found, with what the data say and do not say of it."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..tables import table
from ..validate.states import counted


# So many parameters are written one by one.
FEW = 8
# A positive parameter whose logarithm has this standard error may be e times larger or smaller.
UNCERTAIN = 1.0
# Noise alone gives residuals less likely than this once in a million experiments.
UNLIKELY = 1e-6
# What is left of a parameter in a combination that it has no part in.
NOTHING = 1e-6


class Identified(NamedTuple):
    """What `identify` returns. Rows and columns of matrices are the parameters in the order of `names`.

    - `params`: the estimate.
    - `standard_errors`: √diag of the covariance, in the structure of `params`; infinite of a parameter that the data do not determine.
    - `covariance`: σ² (JᵀJ)⁻¹, J the derivative of the model by `params` at the estimate; `correlation`: that over the standard
      errors. NaN where one of two parameters is not determined.
    - `information`: Fisher's, JᵀJ/σ².
    - `deviation`: √(r·r/(m − p)), the estimate of σ from m residuals and p parameters that are determined; about 1 where `sigma`
      was given, in units of which r then is.
    - `residuals`: data − model, in the structure of the data and in their units.
    - `cost`: r·r/2.
    - `iterations`: evaluations of the model with its derivatives.
    - `offset`: how far the minimum of the linear model still is, in standard errors; 0 where that is round-off.
    - `sensitivities`: the lengths of the columns of J, by the logarithm of those parameters that are `in_log`: how much each shows.
    - `singular_values`: of J with its columns scaled to length 1, largest first; `combinations`: in rows, the changes that belong
      to them, times `sensitivities`.
    - `probability`: that noise of the size `sigma` gives residuals as large as these; NaN where σ is estimated.
    """

    params: PyTree
    standard_errors: PyTree
    covariance: Float[Array, "p p"]
    correlation: Float[Array, "p p"]
    information: Float[Array, "p p"]
    deviation: Float[Array, ""]
    residuals: PyTree
    cost: Float[Array, ""]
    iterations: Int[Array, ""]
    offset: Float[Array, ""]
    sensitivities: Float[Array, " p"]
    singular_values: Float[Array, " p"]
    combinations: Float[Array, "p p"]
    in_log: Bool[Array, " p"]
    probability: Float[Array, ""]

    @property
    def names(self) -> list[str]:
        """Of the parameters, entry by entry: "mass", "friction[1]"."""
        return [
            name for path, leaf in jax.tree_util.tree_leaves_with_path(self.params) for name in _entries(path, leaf)
        ]

    @property
    def condition(self) -> float:
        """The ratio of the largest singular value to the smallest: 1 where each parameter shows by itself, above 30 where some are
        told apart badly (D. A. Belsley, E. Kuh, R. E. Welsch, *Regression Diagnostics*, ch. 3).
        """
        s = np.asarray(self.singular_values)
        return float(s[0] / s[-1]) if s[-1] > 0 else np.inf

    @property
    def doubts(self) -> list[str]:
        """In sentences, what the data do not determine, and residuals larger than `sigma` allows."""
        return [*_undetermined(self), *_uncertain(self), *_too_large(self), *_too_far(self)]

    def __repr__(self) -> str:
        """The estimate with its standard errors, in a line."""
        found = ", ".join(f"{name}={text}" for name, text in _estimates(self))
        doubts = f", {counted(len(self.doubts), 'doubt')}" if self.doubts else ""
        return f"Identified({found}, deviation={self.deviation:.3g}, iterations={int(self.iterations)}{doubts})"

    def _repr_html_(self) -> str:
        """A table for a notebook."""
        m = sum(np.size(r) for r in jax.tree.leaves(self.residuals))
        rows = dict(_estimates(self)) | {
            "noise": f"{self.deviation:.3g}" + ("" if np.isnan(self.probability) else " of `sigma`"),
            "correlations": _correlated(self),
            "condition": f"{self.condition:.3g}",
            "descent": f"{counted(m, 'datum', 'data')}, {counted(int(self.iterations), 'iteration')}",
        }
        return table("Identified", rows | ({"doubts": "\n".join(self.doubts)} if self.doubts else {}))


def named(path: tuple[Any, ...], index: tuple[int, ...]) -> str:
    """An entry of a pytree, as its keys and indices: "wheel.mass[2]"."""
    keys = jax.tree_util.keystr(path, simple=True, separator=".")
    return keys + "".join(f"[{k}]" for k in index)


def _entries(path: tuple[Any, ...], leaf: Any) -> Iterator[str]:
    for index in np.ndindex(np.shape(leaf)):
        yield named(path, index) if path else "params" + named(path, index)


def _flat(tree: PyTree) -> Float[np.ndarray, " p"]:
    return np.concatenate([np.zeros(0), *(np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(tree))])


def _estimates(found: Identified) -> list[tuple[str, str]]:
    values, errors = _flat(found.params), _flat(found.standard_errors)
    if len(values) > FEW:
        return [("params", counted(len(values), "parameter"))]
    return [(name, estimate(*pair)) for name, *pair in zip(found.names, values, errors, strict=True)]


def estimate(value: float, error: float) -> str:
    """A number with two digits of its standard error: "9.812 ± 0.014"."""
    if not np.isfinite(error):
        return f"{value:.6g} ± {error:g}"
    if error == 0:
        return f"{value:.12g} ± 0"
    places = 1 - int(np.floor(np.log10(error)))
    if not -4 <= places <= 12:
        return f"{value:.12g} ± {error:.2g}"
    return f"{round(value, places):.{max(places, 0)}f} ± {round(error, places):.{max(places, 0)}f}"


def _correlated(found: Identified) -> str:
    """The pair that is told apart worst."""
    apart = np.abs(np.triu(np.asarray(found.correlation), 1))
    if not np.any(apart > 0):
        return "none"
    i, j = np.unravel_index(np.nanargmax(apart), apart.shape)
    return f"{found.names[i]} and {found.names[j]} {float(found.correlation[i, j]):.2f}, the largest"


def _undetermined(found: Identified) -> Iterator[str]:
    s, log = np.asarray(found.singular_values), np.asarray(found.in_log)
    small = s <= np.sqrt(np.finfo(s.dtype).eps) * s[0]
    lengths = np.asarray(found.sensitivities)
    for row in _reduced(np.asarray(found.combinations)[small]):
        part = np.flatnonzero(np.abs(row) > NOTHING)
        if len(part) == 1:
            what = found.names[part[0]]
        else:
            change = row[part] / lengths[part]
            ratio = " : ".join(f"{c:.3g}" for c in change / change[np.argmax(np.abs(change))])
            names = [f"log {found.names[j]}" if log[j] else found.names[j] for j in part]
            what = f"changes of {', '.join(names)} as {ratio}"
        yield f"The data do not determine {what}: what was found depends on the start."


def _reduced(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Other rows of the same space, each with an entry 1 where all others are 0: as few parameters in each as can be."""
    rows = rows.copy()
    for k in range(len(rows)):
        # The entry that is largest among all rows that have no 1 yet.
        i, j = np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape)
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, j][:, None] * rows[k]
    return rows


def _uncertain(found: Identified) -> Iterator[str]:
    values, errors = _flat(found.params), _flat(found.standard_errors)
    for name, log, value, error in zip(found.names, np.asarray(found.in_log), values, errors, strict=True):
        if log and np.isfinite(error) and error > UNCERTAIN * value:
            yield (
                f"The data hardly determine {name}: its standard error, {error:.2g}, is larger than itself, {value:.2g}, and holds "
                "for small changes only."
            )


def _too_large(found: Identified) -> Iterator[str]:
    if found.probability < UNLIKELY:
        yield (
            f"The residuals are {found.deviation:.3g} times as large as `sigma` says, which noise alone is with a probability of "
            f"{found.probability:.1g}: the model is not that of the data, or `sigma` is too small, and the standard errors with it."
        )


def _too_far(found: Identified) -> Iterator[str]:
    if found.offset > 1:
        yield (
            f"The estimate is {found.offset:.2g} standard errors from the minimum: the noise is too small for the digits of the model, "
            "and what it leaves uncertain is more than the standard errors say."
        )
