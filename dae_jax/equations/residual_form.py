"""Any system as 0 = F(t, y, ẏ) on flat vectors: what structural analysis and the solvers of residuals see."""

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ..linalg import row_products, solve
from ..structure.layout import Layout
from ..systems import SemiExplicitDAE, System, is_implicit, is_mechanism
from ..types import Args, DType, Phase, State, Time
from .constraint_jacobian import dense_mass
from .manifold_ode import at_one_instant
from .mechanical import MechanicalODE


# Up to this many unknowns multipliers are found without M⁻¹, where coordinates may be massless.
BORDERED = 200
# Above so many unknowns nothing is stored, or looked for, that grows with their square.
LARGE = 256
Form = Literal["index-3", "index-2", "GGL"]


class ResidualForm(eqx.Module):
    """0 = F(t, y, ẏ). For a `ConstrainedSystem`, in the given form, y = (q, v, λ) or (q, v, λ, η) and

        index-3:  0 = q̇ − v,            0 = M v̇ − f + Aᵀλ,   0 = (g, h);
        index-2:  0 = q̇ − v,            0 = M v̇ − f + Aᵀλ,   0 = (G v + g_t, h);
        GGL:      0 = M (q̇ − v) + Gᵀη,  0 = M v̇ − f + Aᵀλ,   0 = (G v + g_t, h),   0 = g,

    for a `SemiExplicitDAE` y = (x, z) and F = (ẋ − f, g). The multipliers in y are those of the equations divided by `units`,
    so that a multiplier has the size of the acceleration, and η of the velocity, that it brings about.

    Source of GGL: C. W. Gear, B. Leimkuhler, G. K. Gupta, J. Comput. Appl. Math. 12–13 (1985), 77–90.
    """

    system: System
    args: Any
    form: Form = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)
    extra: int = eqx.field(static=True)
    equations: tuple[str, ...] = eqx.field(static=True)
    units: Float[Array, " extra"] | None = None

    @classmethod
    def of(cls, system: System, t: Time, state: State, args: Args, form: Form = "index-3") -> "ResidualForm":
        """The residual of `system`; `state` gives shapes only."""
        layout = Layout.of(state)
        if is_mechanism(system):
            ode = MechanicalODE.of(system, t, state, args)
            names = ode.layout.names()
            rows = [f"constraint[{i}]" for i in range(ode.holonomic)]
            rolls = [f"nonholonomic[{i}]" for i in range(ode.nonholonomic)]
            dots = [f"d/dt {row}" for row in rows]
            levels = rows if form == "index-3" else dots
            equations = [f"dq/dt − v{n}" for n in names] + [f"force{n}" for n in names] + levels + rolls
            equations += rows if form == "GGL" else []
            extra = ode.holonomic * (2 if form == "GGL" else 1) + ode.nonholonomic
            return cls(system, args, form, layout, extra, tuple(equations))
        if isinstance(system, SemiExplicitDAE):
            x, z = state
            out = jax.eval_shape(lambda: system.g(t, x, z, args))
            equations = tuple(f"dx/dt − f{n}" for n in Layout.of(x).names()) + _names("g", out)
        else:
            out = jax.eval_shape(lambda: system.residual(t, state, state, args))
            equations = _names("residual", out)
        if len(equations) != layout.size:
            raise ValueError(
                f"{type(system).__name__} must have as many equations as unknowns, but has {len(equations)} equations "
                f"for {layout.size} unknowns."
            )
        return cls(system, args, form, layout, 0, equations)

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.layout.size + self.extra

    @property
    def shown(self) -> Bool[np.ndarray, " n"]:
        """Which unknowns are the user's."""
        return np.arange(self.size) < self.layout.size

    @property
    def independent(self) -> Bool[np.ndarray, " n"]:
        """Which unknowns are the user's and do not follow from others of them that are controlled, as the velocities of a
        mechanism do from its positions.
        """
        return self.shown & (not is_mechanism(self.system))

    @property
    def may_cancel(self) -> bool:
        """Whether highest derivatives may cancel between equations: for a mechanism where constraints are redundant only."""
        return not is_mechanism(self.system)

    @property
    def variables(self) -> tuple[str, ...]:
        """A name for each unknown."""
        parts, names = self.system.parts, self.layout.names()
        names = [parts[0] + n for n in names] if len(parts) == 1 else [parts[int(n[1])] + n[3:] for n in names]
        multipliers = [f"multiplier[{i}]" for i in range(self.extra)]
        return (*names, *multipliers)

    def at_start(self, t: Time, state: State) -> tuple["ResidualForm", Float[Array, " n"]]:
        """The form in units of a mechanism's own, and the flat vector of a state with its multipliers.

        The unit of a multiplier is the mass in the direction of its constraint, aᵀ M a / aᵀ a, over the length of a: then
        neither the unit of mass nor a factor of the constraint makes a difference.
        """
        if not is_mechanism(self.system):
            return self, self.encode(state)
        ode = MechanicalODE.of(self.system, t, state, self.args)
        flat = ode.encode(state)
        a, mass = ode.constraint_jacobian(t, *flat), dense_mass(ode.mass(flat[0]))
        squares = jnp.sum(a * a, 1)
        squares = jnp.where(squares > 0, squares, 1)
        masses = jnp.ones_like(squares) if mass is None else jnp.sum(a * weighted(mass, a.T).T, 1) / squares
        # Where all that a constraint ties together is massless, that of the others has to do.
        masses = jnp.where(masses > 0, masses, jnp.max(masses))
        units = jax.lax.stop_gradient(jnp.where(masses > 0, masses, 1) / jnp.sqrt(squares))
        multipliers = bordered_multipliers(ode, t, flat, a, mass, units)
        form = dataclasses.replace(self, units=jnp.concatenate([units, units])[: self.extra])
        rest = jnp.zeros(self.extra - multipliers.size, a.dtype)
        return form, jnp.concatenate([self.layout.flatten(state), multipliers, rest])

    def encode(self, state: State) -> Float[Array, " n"]:
        """The flat vector of a state, multipliers 0."""
        y = self.layout.flatten(state)
        return jnp.concatenate([y, jnp.zeros(self.extra, y.dtype)]) if self.extra else y

    def decode(self, t: Time, y: Float[Array, " n"]) -> Any:
        """The state in the user's structure."""
        return self.layout.unflatten(y[: self.layout.size])

    def tolerances(self, t: Time, state: State, each: State, absolute: bool) -> Float[Array, " n"]:
        """A tolerance for each unknown, of one for `each` number of the state, τ: a multiplier has that of the velocities along its
        constraint, (Σ aᵢ² τᵢ² / Σ aᵢ²)^½; λ, the size of an acceleration, an `absolute` one over the `time_scale`.
        """
        own = self.layout.flatten(each)
        if not is_mechanism(self.system):
            return own
        of_q, of_v = self._along_constraints(t, state, each)
        return jnp.concatenate([own, _over(of_v, _over(of_q, of_v)) if absolute else of_v, of_v])[: self.size]

    def time_scale(self, t: Time, state: State, each: State) -> Float[Array, " n"] | None:
        """For each unknown the time in which the absolute tolerance of velocities makes that of positions, for `each` number of the
        state; None where nothing is known to be a rate.
        """
        if not is_mechanism(self.system):
            return None
        own = _over(*MechanicalODE.of(self.system, t, state, self.args).encode(each))
        along = _over(*self._along_constraints(t, state, each))
        return jnp.concatenate([own, own, along, along])[: self.size]

    def _along_constraints(self, t: Time, state: State, each: State) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        """The tolerances of positions and of velocities along the constraints."""
        assert is_mechanism(self.system)
        ode = MechanicalODE.of(self.system, t, state, self.args)
        squares = jax.lax.stop_gradient(ode.constraint_jacobian(t, *ode.encode(state))) ** 2
        sums = jnp.sum(squares, 1)
        weights = jnp.where(sums[:, None] > 0, squares / jnp.where(sums > 0, sums, 1)[:, None], 1 / squares.shape[1])
        q, v = (jnp.sqrt(jnp.sum(weights * x**2, 1)) for x in ode.encode(each))
        return q, v

    @property
    def may_be_nonlinear(self) -> bool:
        """Whether ẏ may occur other than linearly."""
        return is_implicit(self.system)

    @property
    def rates_are_given(self) -> bool:
        """Whether the user said what ẏ is near at the start."""
        return is_implicit(self.system) and self.system.yd0 is not None

    def known_ydot(self, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """What is known of ẏ: what the user said of it, else nothing, 0."""
        if is_implicit(self.system) and self.system.yd0 is not None:
            return self.layout.flatten(self.system.yd0).astype(y.dtype)
        return jnp.zeros_like(y)

    @at_one_instant
    def residual(self, t: Time, y: Float[Array, " n"], yd: Float[Array, " n"]) -> Float[Array, " n"]:
        """F(t, y, ẏ)."""
        system = self.system
        if is_mechanism(system):
            return self._mechanical(t, y, yd)
        state, ydot = self.layout.unflatten(y), self.layout.unflatten(yd)
        if is_implicit(system):
            return _flat(system.residual(t, state, ydot, self.args), y.dtype)
        (x, z), (xd, _) = state, ydot
        f = system.f(t, x, z, self.args)
        return jnp.concatenate([_flat(xd, y.dtype) - _flat(f, y.dtype), _flat(system.g(t, x, z, self.args), y.dtype)])

    def _mechanical(self, t: Time, y: Float[Array, " n"], yd: Float[Array, " n"]) -> Float[Array, " n"]:
        assert is_mechanism(self.system)
        ode = MechanicalODE.of(self.system, t, self.layout.unflatten(y[: self.layout.size]), self.args)
        n, m, p = ode.layout.size, ode.holonomic, ode.nonholonomic
        q, v = y[:n], y[n : 2 * n]
        multipliers, eta = jnp.split(y[2 * n :] if self.units is None else y[2 * n :] * self.units, [m + p])
        pull, mass = ode.reaction(t, q, v), dense_mass(ode.mass(q))
        momentum = weighted(mass, yd[n : 2 * n]) - ode.force(t, q, v) + pull(multipliers)
        velocity = ode.velocity_constraint(t, q, v)
        kinematics = yd[:n] - v
        if self.form == "index-3":
            return jnp.concatenate([kinematics, momentum, ode.constraint(t, q), velocity[m:]])
        if self.form == "index-2":
            return jnp.concatenate([kinematics, momentum, velocity])
        stabilised = weighted(mass, kinematics) + pull(eta)
        return jnp.concatenate([stabilised, momentum, velocity, ode.constraint(t, q)])


def _over(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """a / b; 1 where one of them is 0, a tolerance that is not asked for."""
    asked = (a > 0) & (b > 0)
    return jnp.where(asked, a / jnp.where(asked, b, 1), 1)


def weighted(mass: Float[Array, "..."] | None, x: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """M x."""
    if mass is None:
        return x
    if mass.ndim < 2:
        return mass * x if x.ndim < 2 else (mass * x.T).T
    return jnp.sum(mass * x, 1) if x.ndim < 2 else row_products(mass, x.T)


def bordered_multipliers(
    ode: MechanicalODE,
    t: Time,
    y: Phase,
    a: Float[Array, "c n"],
    mass: Float[Array, "..."] | None,
    units: Float[Array, " c"],
) -> Float[Array, " c"]:
    """λ at a state, in its `units`, from M v̇ + Aᵀλ = f and A v̇ = −γ: M may be singular."""
    if mass is None or ode.layout.size + len(a) > BORDERED:
        return ode.multipliers(t, y) / units
    return _bordered(ode, t, y, a, mass, units)[ode.layout.size :]


def accelerations(ode: MechanicalODE, t: Time, y: Phase) -> Float[Array, " n"]:
    """v̇ at a state: M may be singular."""
    a, mass = ode.constraint_jacobian(t, *y), dense_mass(ode.mass(y[0]))
    if mass is None or ode.layout.size + len(a) > BORDERED:
        return ode.field(t, y)[1]
    return _bordered(ode, t, y, a, mass, jnp.ones(len(a), a.dtype))[: ode.layout.size]


def _bordered(
    ode: MechanicalODE, t: Time, y: Phase, a: Float[Array, "c n"], mass: Float[Array, "..."], units: Float[Array, " c"]
) -> Float[Array, " nc"]:
    """(v̇, λ)."""
    n, c = ode.layout.size, len(a)
    momentum = jnp.concatenate([weighted(mass, jnp.eye(n, dtype=a.dtype)), a.T * units], 1)
    matrix = jnp.concatenate([momentum, jnp.concatenate([a, jnp.zeros((c, c), a.dtype)], 1)])
    right = jnp.concatenate([ode.force(t, *y), -ode.bias(t, *y)])
    largest = jnp.max(jnp.abs(matrix), 1)
    scale = 1 / jnp.where(largest > 0, largest, 1)
    return solve(matrix * scale[:, None], right * scale)


def _names(stem: str, out: PyTree) -> tuple[str, ...]:
    shapes = jax.tree.map(lambda s: np.zeros(s.shape), out)
    return tuple(stem + name for name in Layout.of(shapes).names())


def _flat(tree: PyTree, dtype: DType) -> Float[Array, " n"]:
    leaves = [jnp.ravel(jnp.asarray(leaf, dtype)) for leaf in jax.tree.leaves(tree)]
    return jnp.concatenate(leaves) if len(leaves) > 1 else leaves[0]
