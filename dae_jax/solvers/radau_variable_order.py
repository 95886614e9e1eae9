"""Radau IIA methods of order 5, 9 and 13, from which each step chooses."""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..equations.manifold_ode import constant
from ..types import BoolLike, Time
from .radau import AbstractRadauIIA, RadauIIA5, RadauIIA9, RadauIIA13, RadauState
from .radau_coefficients import coefficients
from .radau_step import CollocationPolynomial
from .replay import Replayable
from .residual_steps import AbstractResidualSolver, Work


METHODS: tuple[type[AbstractRadauIIA], ...] = (RadauIIA5, RadauIIA9, RadauIIA13)
STAGES = tuple(method.stages for method in METHODS)
MOST = STAGES[-1]
# θ/(1 − θ) of Newton's method: it contracts so fast that more stages are no risk, or so slowly that fewer are wanted, where it is not
# round-off that it comes to rest in; and how many steps an order is kept before it rises.
RISE, FALL, ROUND_OFF, KEPT = 1e-2, 4.0, 1e6, 10


class StagePolynomial(diffrax.AbstractLocalInterpolation):
    """The collocation polynomial of the method that a step was made by, number `which`."""

    t0: Any
    t1: Any
    y0: Any
    z: Any
    which: Any

    def evaluate(self, t0: Time, t1: Any = None, left: bool = True) -> Any:
        """The value at `t0`, or the increment from there to `t1`."""
        of = lambda s: CollocationPolynomial(t0=self.t0, t1=self.t1, y0=self.y0, z=self.z[:s])
        return lax.switch(self.which.astype(int), [lambda s=s: of(s).evaluate(t0, t1, left) for s in STAGES])


class _State(NamedTuple):
    """What a step leaves to the next.

    `within`: the state of the method with the most stages, of which one with fewer uses a part; `which` method the next step is
    made by; `kept`: for how many steps it has been.
    """

    within: RadauState
    which: Int[Array, ""]
    kept: Int[Array, ""]


class Radau(Replayable, AbstractResidualSolver):
    """The Radau IIA methods with three, five and seven stages, of order 5, 9 and 13, for 0 = F(t, y, ẏ) of index 0 to 3; each
    step is made by one of them.

    After ten steps by one method the next one with more stages takes over where Newton's method needs no second correction, or
    contracts by θ/(1 − θ) ≤ 0.01; one with fewer stages where θ ≥ 0.8. The first steps are of order 5. So the order rises with the
    smoothness of the solution at the step sizes that the tolerance allows. What holds for `RadauIIA5` otherwise holds here;
    there are three methods to compile, which takes longer than one.

    **Arguments**

    - `dense`, `rtol`, `atol`, `linear_solver`: as for `RadauIIA5`. The error that a step-size controller is given is one from which
      it finds the size for the order of the step, where its coefficients are the default ones; with others steps are of other
      sizes, and as accurate.

    Source: E. Hairer, G. Wanner, *Stiff differential equations solved by Radau methods*, J. Comput. Appl. Math. 111 (1999),
    section 3, and the program RADAU.
    """

    highest_index = 3
    default_index = 2
    interpolation_cls = StagePolynomial
    counts = tuple(f"within.work.{name}" for name in Work._fields)

    dense: bool = True

    @property
    def kept(self) -> int:
        return MOST + 1

    @property
    def methods(self) -> list[AbstractRadauIIA]:
        """Those to choose from, by the number of their stages."""
        return [method(self.rtol, self.atol, self.dense, linear_solver=self.linear_solver) for method in METHODS]

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return self.methods[-1].order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> int:
        return self.methods[0].error_order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> _State:
        none = jnp.zeros((), int)
        return _State(self.methods[-1].init(terms, t0, t1, y0, args), none, none)

    def invalidate_jacobian(self, state: _State) -> _State:
        return state._replace(within=self.methods[-1].invalidate_jacobian(state.within))

    def formula(self, state: _State) -> Int[Array, ""]:
        return state.which

    def by_formula(self, state: _State, formula: Int[Array, ""]) -> _State:
        return state._replace(which=formula, within=_changed(state.within, state.which, formula))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: _State,
        made_jump: BoolLike,
    ) -> Any:
        state = solver_state

        def by(method: AbstractRadauIIA) -> Any:
            part = _part(state.within, method.stages)
            y1, error, dense, new, result = method.step(terms, t0, t1, y0, args, part, made_jump)
            tol = method.fitted_tolerances(y0.dtype)
            size = constant(tol.norm(error, y0, y1))
            # From it the controller finds the size for this order.
            exponent = self.error_order(terms) / method.error_order(terms) - 1
            usual = (size > 0) & jnp.isfinite(size)
            error = error * jnp.where(usual, jnp.where(usual, size, 1) ** exponent, 1)
            return y1, error, _filled(dense["z"]), _whole(new, state.within), result

        y1, error, z, new, result = lax.switch(state.which, [lambda m=m: by(m) for m in self.methods])
        which, kept = _next(state, new)
        dense = {"y0": y0, "z": z, "which": state.which.astype(y0.dtype)}
        return y1, error, dense, _State(_changed(new, state.which, which), which, kept), result

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> Any:
        def by(method: AbstractRadauIIA) -> Any:
            known = {"y0": dense["y0"], "z": dense["z"][: method.stages]}
            y1, _, found = method.replay(terms, t0, t1, y0, args, (), known)
            return y1, _filled(found["z"])

        y1, z = lax.switch(dense["which"].astype(int), [lambda m=m: by(m) for m in self.methods])
        return y1, history, {"y0": y0, "z": z, "which": dense["which"]}


def _next(state: _State, new: RadauState) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The method of the next step, and for how many steps it has been the same."""
    corrections = new.work.num_corrections - state.within.work.num_corrections
    rises = (state.kept >= KEPT) & ((corrections == 1) | (new.eta <= RISE)) & (state.which < len(METHODS) - 1)
    falls = (corrections > 1) & (new.eta >= FALL) & (new.eta < ROUND_OFF) & (state.which > 0)
    which = state.which + rises - falls
    return which, jnp.where(which == state.which, state.kept + 1, 0)


def _changed(state: RadauState, before: Int[Array, ""], after: Int[Array, ""]) -> RadauState:
    """What a step by one method leaves to a step by another."""
    z_at_nodes = lax.cond(after == before, lambda: state.z, lambda: _sampled(state.z, before, after))
    # The factors are those of a method.
    return state._replace(z=constant(z_at_nodes), factored=jnp.where(after == before, state.factored, 0))


def _filled(z: Float[Array, "s n"]) -> Float[Array, "7 n"]:
    return jnp.concatenate([z, jnp.zeros((MOST - len(z), z.shape[1]), z.dtype)])


def _part(state: RadauState, stages: int) -> RadauState:
    """What a method with so many stages knows of the state."""
    factors = state.factors._replace(complex=state.factors.complex[: stages // 2])
    return state._replace(z=state.z[:stages], factors=factors)


def _whole(part: RadauState, before: RadauState) -> RadauState:
    """The state of the method with the most stages, what another has not used being as it was."""
    pairs = part.factors.complex
    factors = part.factors._replace(complex=(*pairs, *before.factors.complex[len(pairs) :]))
    return part._replace(z=_filled(part.z), factors=factors)


def _sampled(z: Float[Array, "7 n"], before: Int[Array, ""], after: Int[Array, ""]) -> Float[Array, "7 n"]:
    """The polynomial of one method at the nodes of another."""
    table = jnp.asarray(_between_nodes(), z.dtype)[before, after]
    return jnp.sum(table[:, :, None] * z, 1)


def _between_nodes() -> Float[np.ndarray, "3 3 7 7"]:
    table = np.zeros((len(STAGES), len(STAGES), MOST, MOST))
    for i, before in enumerate(map(coefficients, STAGES)):
        for k, after in enumerate(map(coefficients, STAGES)):
            powers = after.nodes[:, None] ** np.arange(1, before.stages + 1)
            table[i, k, : after.stages, : before.stages] = powers @ before.polynomial
    return table
