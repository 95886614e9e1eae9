"""Structural analysis: the index of a system, its hidden constraints and its degrees of freedom, before it is solved."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from .compiler import at_ease
from .equations.derivative_orders import Offsets, find_offsets
from .equations.initial_rates import is_nonlinear, rates_of
from .equations.residual_form import ResidualForm
from .equations.slopes import Slopes
from .equations.taylor import total_derivatives
from .linalg.rank import is_nonsingular
from .structure import Block, block_triangular, pantelides
from .systems import System, is_mechanism
from .tables import table
from .types import Args, Flat, State, Time
from .validate.captured import current
from .validate.states import as_floats, counted, refuse_no_time, refuse_not_finite, refuse_wrong_state
from .validate.user_functions import at_numbers, refuse_wrong_functions


# A system of more variables is summed up in words; its incidence matrix would not fit a page.
DRAWN = 60
# The ranks of the derivative array of more equations would take minutes.
RANKED = 500
# A table in a notebook names so many hidden constraints at most.
HIDDEN = 8


@dataclasses.dataclass(frozen=True)
class Structure:
    """What structural analysis finds in 0 = F(t, y, ẏ); `print` it.

    - `equations`, `variables`: names. An equation whose highest derivatives cancel against those of others is replaced by
      the combination in which they are gone, `residual[1] + residual[0]`.
    - `signature`: for each equation, its variables with the highest derivative that occurs: 0 or 1, more in a combination
      with derivatives of equations.
    - `index`: the structural index, an upper bound of the `differential_index` where `regular`.
    - `degrees_of_freedom`: how many initial values can be chosen; of a mechanism, whose positions and velocities both are
      initial values, `mechanical_degrees_of_freedom` is the engineer's count, the velocities that can be chosen.
    - `equation_offsets`, `variable_offsets`: c and d; equation i is to be differentiated cᵢ times, and then determines
      derivatives up to the order dⱼ of variable j (Pryce's Σ-method).
    - `pantelides_offsets`: how often Pantelides' algorithm differentiates each equation; the same where its result is
      the canonical one.
    - `transversal`: the variable that each equation is paired with.
    - `blocks`: the block triangular form of the differentiated system, in the order of solution.
    - `regular`: whether the system Jacobian ∂Fᵢ/∂xⱼ^(dⱼ−cᵢ) is nonsingular near the given state, at generic
      derivatives or, where the equations are nonlinear in ẏ, at those that they have there. If not, the structure misleads
      and the index may be higher.
    - `nonzeros`, `bandwidth`: of the incidence matrix, as the equations and variables are ordered.

    Source: J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001); C. C. Pantelides, SIAM J. Sci.
    Stat. Comput. 9 (1988).
    """

    form: ResidualForm = dataclasses.field(repr=False, compare=False)
    offsets: Offsets = dataclasses.field(repr=False, compare=False)
    point: tuple[Any, Any] = dataclasses.field(repr=False, compare=False)
    index: int
    degrees_of_freedom: int
    equation_offsets: tuple[int, ...]
    variable_offsets: tuple[int, ...]
    pantelides_offsets: tuple[int, ...]
    transversal: tuple[int, ...]
    blocks: tuple[Block, ...] = dataclasses.field(repr=False)
    regular: bool

    @property
    def signature(self) -> tuple[dict[int, int], ...]:
        """For each equation, its variables with the highest derivative that occurs."""
        return tuple(self.offsets.signature)

    @property
    def equations(self) -> tuple[str, ...]:
        """A name for each equation."""
        return self.offsets.combination.names(self.form.equations)

    @property
    def variables(self) -> tuple[str, ...]:
        """A name for each variable."""
        return self.form.variables

    @property
    def nonzeros(self) -> int:
        """How many variables occur in the equations, in all."""
        return sum(map(len, self.signature))

    @property
    def mechanical_degrees_of_freedom(self) -> int | None:
        """Coordinates minus constraints, for a `ConstrainedSystem`; `None` for other systems."""
        if not is_mechanism(self.form.system):
            return None
        return self.form.layout.size // 2 - self.form.extra

    @property
    def bandwidth(self) -> int:
        """The greatest distance of an entry from the diagonal."""
        return max((abs(i - j) for i, row in enumerate(self.signature) for j in row), default=0)

    def derivative(self, times: int) -> Callable[[Any, Float[Array, "orders n"]], Float[Array, " n"]]:
        """The k-th derivative of the `equations`, k = `times`, as a function of t and of (y, ẏ, …), one below the other."""

        def along(t: Time, derivatives: Float[Array, "orders n"]) -> Float[Array, " n"]:
            t = jnp.asarray(t, derivatives.dtype)
            combination = self.offsets.combination
            count = times + 1 + combination.degree
            return combination.of(total_derivatives(self.form.residual, t, list(derivatives), count))[times]

        return along

    @functools.cached_property
    def differential_index(self) -> int | None:
        """The smallest k for which F = 0, …, dᵏF/dtᵏ = 0 determine ẏ, found by the ranks of their Jacobian at the given
        state for generic derivatives; at most `index`. `None` where not `regular`: what is singular there on the solution need
        not be so for generic derivatives; and for systems of more than `RANKED` equations. Takes a moment.

        Source: S. L. Campbell, C. W. Gear, The index of general nonlinear DAEs, Numer. Math. 72 (1995).
        """
        n = len(self.equations)
        equations, variables = self.offsets.variables.nonzero()
        for k in range(self.index + 1 if self.regular and n <= RANKED else 0):
            slopes = Slopes(self.form.residual, self.offsets.variables, k, self.point[1].dtype)
            values = _at_state(slopes, self.form, *self.point)
            array = np.zeros((k + 1, n, k + 1, n))
            for level, order in np.ndindex(k + 1, k + 1):
                at = (np.full_like(equations, x) for x in (level, order + 1))
                level_of, order_of = at
                array[level, equations, order, variables] = slopes.entries(
                    values, level_of, equations, order_of, variables
                )
            matrix = array.reshape((k + 1) * n, -1)
            for axis in (1, 0):
                largest = np.abs(matrix).max(axis, keepdims=True)
                matrix = matrix / np.where(largest > 0, largest, 1)
            rank = lambda m: np.linalg.matrix_rank(m, rtol=1e-9) if m.size else 0
            if rank(matrix) == n + rank(matrix[:, n:]):
                return k
        return None

    def hidden_constraints(self) -> tuple[tuple[str, int], ...]:
        """Which equations, differentiated how often, restrict the initial values: those of lower order than cᵢ."""
        names = self.equations
        return tuple((names[i], k) for i, c in enumerate(self.equation_offsets) for k in range(c))

    @property
    def _index_in_words(self) -> str:
        return f"{self.index}{'' if self.regular else ' or higher'}"

    @property
    def _blocks_in_words(self) -> str:
        """How many there are; of many, how many of each size, the largest first."""
        sizes = sorted(Counter(len(block.equations) for block in self.blocks).items(), reverse=True)
        if len(self.equations) <= DRAWN or len(sizes) > HIDDEN:
            return counted(len(self.blocks), "block")
        return " and ".join(f"{counted(number, 'block')} of {counted(size, 'equation')}" for size, number in sizes)

    def __str__(self) -> str:
        freedom = counted(self.degrees_of_freedom, "initial value") + " to choose"
        if self.mechanical_degrees_of_freedom is not None:
            many = ("degree of freedom of the mechanism", "degrees of freedom of the mechanism")
            freedom = f"{counted(self.mechanical_degrees_of_freedom, *many)} ({freedom})"
        if not self.regular:
            freedom = f"{freedom} by the count of equations"
        lines = [
            f"{counted(len(self.equations), 'equation')}, index {self._index_in_words}, {freedom}, "
            f"{self._blocks_in_words}, {counted(self.nonzeros, 'nonzero')}, bandwidth {self.bandwidth}",
        ]
        if not self.regular:
            lines.append(
                "The system Jacobian is singular, or not finite, near the given state although its structure is not: the index may be "
                "higher. Replace an equation by a combination of equations in which the cancelling terms are gone, or "
                "introduce the cancelling expression as a variable."
            )
            if self.mechanical_degrees_of_freedom is not None:
                lines.append(
                    "Constraints that say nothing new leave more degrees of freedom than the count says: `explain` says how many "
                    "are independent, and `daesolve` takes so many."
                )
        if len(self.equations) > DRAWN:
            return "\n".join(lines)
        width = max(map(len, self.equations))
        lines += ["", f"{'':{width}}  c  variables in order; ' marks a derivative, [ ] the pairing"]
        for i, row in enumerate(self.signature):
            cells = [self._cell(row, i, j) for j in range(len(self.variables))]
            lines.append(f"{self.equations[i]:{width}}  {self.equation_offsets[i]}  {''.join(cells)}")
        lines += ["", "variable: d"]
        lines += [f"  {name}: {d}" for name, d in zip(self.variables, self.variable_offsets, strict=True)]
        hidden = [f"  0 = {name}" + _differentiated(k) for name, k in self.hidden_constraints()]
        free = [
            f"consistent are the values, with derivatives of orders below d, that satisfy{'' if hidden else ' nothing more'}"
        ]
        return "\n".join([*lines, "", *free, *hidden])

    def _repr_html_(self) -> str:
        """A table for a notebook, and the whole page folded."""
        freedom = self.mechanical_degrees_of_freedom
        by_count = "" if self.regular else ", by the count of equations"
        rows = {
            "equations": str(len(self.equations)),
            "index": self._index_in_words,
            "degrees of freedom": "" if freedom is None else f"{freedom}, of the mechanism{by_count}",
            "initial values to choose": f"{self.degrees_of_freedom}{by_count}",
            "hidden constraints": _named(self.hidden_constraints()),
            "blocks": self._blocks_in_words,
            "nonzeros, bandwidth": f"{self.nonzeros}, {self.bandwidth}",
            "system Jacobian": "regular near the given state"
            if self.regular
            else "singular, or not finite, near the given state",
        }
        return table("Structure", {name: text for name, text in rows.items() if text}, str(self))

    def _cell(self, row: dict[int, int], i: int, j: int) -> str:
        if j not in row:
            return " ·  "
        mark = "x" + "'" * row[j]
        return (f"[{mark}]" if self.transversal[i] == j else f" {mark}").ljust(4)


@at_ease
@at_numbers
def analyse(system: System, t0: Time, y0: State, args: Args = None) -> Structure:
    """The structure of a system: index, offsets, degrees of freedom, hidden constraints.

    A `ConstrainedSystem` is read as its index-3 equations of first order in (q, v, λ). Which equation depends on which
    variable is read from the jaxpr, for any t; `y0` gives shapes, and the place where the Jacobian is looked at.

    Errors: `ValueError` for a structurally singular system, naming the equations that have too few variables and the
    variables that have too few equations, for a state or a time that is not finite, and within `jit`, `vmap` and `grad` of
    what is looked at.
    """
    refuse_wrong_state(system, y0)
    system, args = current((system, args))
    y0 = as_floats(y0)
    refuse_no_time("t0", t0)
    refuse_not_finite("y0", y0)
    refuse_wrong_functions(system, t0, y0, args)
    form = ResidualForm.of(system, t0, y0, args)
    y = form.encode(y0)
    point = jnp.asarray(t0, y.dtype), y
    found = find_offsets(form, y.dtype)
    sigma = found.sigma
    blocks = tuple(block_triangular(found.pattern, sigma.transversal))
    return Structure(
        form,
        found,
        point,
        found.index,
        sigma.degrees_of_freedom,
        sigma.equation_offsets,
        sigma.variable_offsets,
        pantelides(found.signature).equation_offsets,
        sigma.transversal,
        blocks,
        _regular(form, found, blocks, *point),
    )


def _named(hidden: tuple[tuple[str, int], ...]) -> str:
    """The first of the hidden constraints, one a line, and how many more there are."""
    lines = [name + _differentiated(k) for name, k in hidden[:HIDDEN]]
    return "\n".join([*lines, *([f"and {len(hidden) - HIDDEN} more"] if len(hidden) > HIDDEN else [])])


def _differentiated(times: int) -> str:
    return (
        ("", ", differentiated once", ", differentiated twice")[times]
        if times < 3
        else f", differentiated {times} times"
    )


def _regular(form: ResidualForm, found: Offsets, blocks: tuple[Block, ...], t: Time, y: Flat) -> bool:
    """Whether the system Jacobian has full rank at the state, for generic multipliers and derivatives; see `_rates`."""
    slopes = Slopes(form.residual, found.variables, found.combination.degree, y.dtype)
    rows, columns, equations, times, orders, factors = (
        np.array(part)
        for part in zip(
            *(
                (i, j, k, often, found.signature[i][j], factor)
                for i, variables in enumerate(found.pattern)
                for k, often, factor in found.combination.terms(i)
                for j in variables
            ),
            strict=True,
        )
    )
    yd = _rates(form, t, y)
    for seed in range(3):
        values = factors * slopes.entries(_at_state(slopes, form, t, y, seed, yd), times, equations, orders, columns)
        matrix = csr_array((values, (rows, columns)), shape=(len(y), len(y)))
        if is_nonsingular(matrix, blocks, float(jnp.finfo(y.dtype).eps)):
            return True
    return False


def _at_state(
    slopes: Slopes, form: ResidualForm, t: Time, y: Flat, seed: int = 0, yd: Flat | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What `slopes` give at a state, for generic multipliers and derivatives, the first ones `yd` where that is given."""
    rng = np.random.default_rng(seed)
    at = y.at[form.layout.size :].set(rng.normal(size=form.extra))
    derivatives = jnp.asarray(rng.normal(size=slopes.shape), y.dtype)[1:]
    if yd is not None:
        derivatives = derivatives.at[0].set(yd)
    return slopes.at(t, jnp.concatenate([at[None], derivatives]))


def _rates(form: ResidualForm, t: Time, y: Flat) -> Flat | None:
    """ẏ of the equations, where they are nonlinear in it and have one at the state: what is regular for others may be singular there."""
    if not is_nonlinear(form, y.dtype):
        return None
    yd, _ = rates_of(form, t, y)
    off = jnp.max(jnp.abs(form.residual(t, y, yd)))
    return yd if off <= jnp.finfo(y.dtype).eps ** 0.5 * (1 + jnp.max(jnp.abs(yd))) else None
