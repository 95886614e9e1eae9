"""What the start and the end of a solve show: whether they satisfy the equations, and whether these determine what they should."""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..consistent import Violation, unsolved, violation
from ..equations.constraint_jacobian import Rank
from ..equations.independent import Rows, independent
from ..equations.mechanical import MechanicalODE
from ..equations.regularity import LARGE, Span, bearable_drift, has_rank, is_near_constraints, mass_is_regular, weakest
from ..systems import System, is_mechanism
from ..types import Args, Scalar, State, Time


# What part of the interval a solve that failed is looked on beyond its end; and the second and third power of it.
AHEAD = 1e-3
# A smallest pivot below this power of round-off is that of constraints that become dependent.
SINGULAR = 1 / 3


class Start(NamedTuple):
    """What is wrong with a start: 0 for nothing, 1: it is inconsistent, 2: the constraints have not the given rank (`None`:
    all are independent), 3: the masses, 4: several ẏ satisfy the equations; whether nothing is wrong beyond doubt; and of a
    mechanism how far it is from its constraints.
    """

    wrong: Int[Array, ""]
    surely: Bool[Array, ""]
    off: Violation | None = None


class End(NamedTuple):
    """What the state at the end of a solve says: whether it satisfies the equations as far as to have any meaning (see
    `is_near_constraints`); of a mechanism, whether constraints nearly depend on each other; whether the masses are regular
    there, and also beyond, where a solve that failed did not get. `drifted`: whether it is off the equations by more than the
    tolerances.
    """

    near: Bool[Array, ""]
    singular: Bool[Array, ""]
    masses: Bool[Array, ""]
    masses_ahead: Bool[Array, ""]
    drifted: Bool[Array, ""]


def look(
    system: System,
    t0: Time,
    start: State,
    args: Args,
    rank: int | Rank | None,
    rows: Rows | None,
    invertible: bool,
    end: tuple[Scalar, State],
    keeps: tuple[bool, bool],
    tolerances: tuple[Span, Span],
    residual: bool,
) -> tuple[Start, End]:
    """The start and the `end` (t, y) of a solve. `rows`: the constraints that the method gets where not all; `invertible`: whether M
    must be.
    """
    if not is_mechanism(system):
        return _look_at_equations(system, t0, start, args, end, tolerances)
    ode = MechanicalODE.of(system, t0, start, args, rank)
    y, (t, y_end) = ode.encode(start), (end[0], ode.encode(end[1]))
    off, regular = violation(ode, t0, y), mass_is_regular(ode, y[0], invertible)
    fits, surely = has_rank(ode, t0, y, ode.rank)
    some = ode
    if rows is not None:
        some = MechanicalODE.of(independent(system, t0, start, args, ode.rank, rows), t0, start, args)
        fits, surely = (a & b for a, b in zip((fits, surely), has_rank(some, t0, y, None), strict=True))
    wrong = jnp.where(regular, jnp.where(off.consistent(), jnp.where(fits, 0, 2), 1), 3)
    at_start = Start(wrong, (wrong == 0) & surely, off)

    near, drifted = is_near_constraints(ode, t, y, y_end, keeps, tolerances, residual)
    yes = jnp.asarray(True)
    singular = ~yes if some.rank else weakest(some, t, y_end) < jnp.finfo(t.dtype).eps ** SINGULAR
    if not callable(system.mass):
        return at_start, End(near, singular, yes, yes, drifted)
    (q, v), finite = y_end, jnp.all(jnp.isfinite(y_end[0]))
    regular = lambda q: mass_is_regular(ode, q, invertible) | ~finite
    ahead = [regular(q + AHEAD**k * (t - t0) * v) for k in (1, 2, 3)]
    return at_start, End(near, singular, regular(q), ahead[0] & ahead[1] & ahead[2], drifted)


def _look_at_equations(
    system: System, t0: Time, start: State, args: Args, end: tuple[Scalar, State], tolerances: tuple[Span, Span]
) -> tuple[Start, End]:
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(end)]))
    both = jax.tree.map(lambda a, b: jnp.stack([a, jnp.where(finite, b, a)]), (jnp.asarray(t0), start), end)
    # One after the other, so that it is compiled once.
    way = start, jnp.abs(end[0] - t0)
    left = jax.lax.map(lambda at: unsolved(system, at[0], at[1], args, way), both)
    at_start, at_end = (jax.tree.map(operator.itemgetter(k), left) for k in (0, 1))
    consistent, off = at_start.consistent(), at_end.as_part()
    wrong = jnp.where(consistent, jnp.where(at_start.several, 4, 0), 1)
    rtol, atol = (least for least, _ in tolerances)
    drifted = (off > bearable_drift(rtol + atol, 1)) & (rtol + atol > 0)
    no = jnp.asarray(False)
    return Start(wrong, wrong == 0), End(~(off > LARGE), no, ~no, ~no, drifted)
