"""Mechanisms and differential-algebraic equations put together at random, solved with the compiler and without."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import dae_jax

from .numbers import Draw


# Round-off grows on the way: by the steps that are taken, and by what a step that is chosen otherwise leaves of the tolerance.
RTOL = 1e-7
TIMES = jnp.linspace(0.0, 0.5, 6)


@dataclasses.dataclass(frozen=True)
class Problem:
    name: str
    system: Any
    solver: Any
    y0: Any
    args: Any
    fixed: bool = False

    def solved(self, by_compiler: bool) -> Any:
        controller = diffrax.ConstantStepSize() if self.fixed else diffrax.PIDController(rtol=1e-6, atol=1e-6)
        with dae_jax.configure(one_kernel=by_compiler):
            return dae_jax.daesolve(
                self.system, self.solver, t0=0.0, t1=TIMES[-1], dt0=0.01 if self.fixed else None, y0=self.y0,
                args=self.args, saveat=diffrax.SaveAt(ts=TIMES), stepsize_controller=controller,
            )  # fmt: skip

    def difference(self) -> float:
        """The largest, relative to the largest number of its kind; not a number where one solution is none."""
        found, wanted = (jax.tree.leaves(self.solved(by_compiler).ys) for by_compiler in (True, False))
        relative = lambda a, b: float(jnp.abs(a - b).max() / jnp.abs(b).max())
        return max(map(relative, found, wanted), key=lambda x: x if x == x else np.inf)


# Of mechanisms, and whether the steps are fixed.
_MECHANICAL = [
    (dae_jax.OrthogonalProjection(diffrax.Tsit5()), False),
    (dae_jax.OrthogonalProjection(dae_jax.DOP853()), False),
    (dae_jax.DOP853(), False),
    (dae_jax.TangentSpace(diffrax.Tsit5()), False),
    (dae_jax.RadauIIA5(), False),
    (dae_jax.RATTLE(), True),
    (dae_jax.Gauss4(), True),
    (dae_jax.SymmetricProjection(dae_jax.Midpoint()), True),
]


def mechanism(seed: int) -> Problem:
    """A tree of one to three point masses, held by rods and springs, in two or three dimensions, at rest at first."""
    draw = Draw(seed, 10)
    solver, fixed = draw.one_of(_MECHANICAL)
    symplectic = isinstance(solver, dae_jax.RATTLE)
    n, d = 1 + draw.below(3), 2 + draw.below(2)
    parents = [draw.below(i + 1) - 1 for i in range(n)]
    rigid = np.array([i == 0 or draw.chance(0.6) for i in range(n)])
    at = np.zeros((n, d))
    for i, parent in enumerate(parents):
        along = draw.rng.normal(size=d)
        at[i] = (at[parent] if parent >= 0 else 0) + draw.rng.uniform(0.5, 1.5) * along / np.linalg.norm(along)
    args = {
        "stiffness": draw.rng.uniform(5, 50, n),
        "drag": draw.rng.uniform(0, 0.5),
        "mass": draw.rng.uniform(0.5, 2, n),
    }
    args = jax.tree.map(jnp.asarray, args)
    push, wind = (
        draw.one_of([jnp.sin, jnp.tanh, jnp.cos, lambda t: t**2, lambda t: jnp.where(t > 0.3, t, 0.3)]),
        draw.chance(0.5),
    )

    def spans(q: Any) -> Any:
        q = q.reshape(n, d)
        return q - jnp.stack([q[p] if p >= 0 else jnp.zeros(d) for p in parents])

    lengths = jnp.sum(spans(jnp.asarray(at)) ** 2, 1)

    def force(t: Any, q: Any, v: Any, args: Any) -> Any:
        pull = jnp.zeros((n, d)).at[:, -1].set(-9.81 * args["mass"])
        s = spans(q)
        stretch = jnp.where(rigid, 0.0, args["stiffness"] * (jnp.sum(s**2, 1) - lengths))
        pull = pull - stretch[:, None] * s
        for i, p in enumerate(parents):
            if p >= 0:
                pull = pull.at[p].add(stretch[i] * s[i])
        pull = pull.at[0, 0].add(push(3 * t)) if wind else pull
        pull = pull.reshape(-1)
        return pull if symplectic else pull - args["drag"] * v * jnp.sqrt(1e-3 + jnp.sum(v**2))

    system = dae_jax.ConstrainedSystem(
        force=force,
        constraint=lambda t, q, args: (jnp.sum(spans(q) ** 2, 1) - lengths)[np.flatnonzero(rigid)] / 2,
        mass=jnp.repeat(args["mass"], d) if symplectic else lambda q, args: jnp.repeat(args["mass"], d),
    )
    name = f"mechanism {seed}: {n} masses in {d} dimensions, {type(solver).__name__}"
    return Problem(name, system, solver, (jnp.asarray(at).reshape(-1), jnp.zeros(n * d)), args, fixed)


def equations(seed: int) -> Problem:
    """ẏ = f(y, z), 0 = z + k·g(y, z) with k so small that there is one z."""
    draw = Draw(seed, 11)
    n, m = 1 + draw.below(4), 1 + draw.below(3)
    curves = [jnp.sin, jnp.tanh, jnp.cos, lambda x: x / (1 + x * x), lambda x: jnp.exp(-x * x), jnp.arctan]
    f, g = draw.one_of(curves), draw.one_of(curves)
    parameters = {"a": draw.rng.normal(size=(n, n + m)), "b": 0.3 / m * draw.rng.uniform(-1, 1, (m, n + m))}
    rate = 10.0 ** draw.below(3)

    def residual(t: Any, y: Any, yd: Any, args: Any) -> Any:
        x = jnp.concatenate([y["y"], y["z"]])
        slow = yd["y"] + rate * y["y"] - f(args["a"] @ x + t)
        return jnp.concatenate([slow, y["z"] + g(args["b"] @ x)])

    y, z = draw.rng.normal(size=n), np.zeros(m)
    for _ in range(60):
        z = -np.asarray(g(parameters["b"] @ np.concatenate([y, z])))
    solver = draw.one_of([dae_jax.RadauIIA5(), dae_jax.BDF()])
    name = f"equations {seed}: {n} differential, {m} algebraic, {type(solver).__name__}"
    y0 = {"y": jnp.asarray(y), "z": jnp.asarray(z)}
    return Problem(name, dae_jax.ImplicitDAE(residual), solver, y0, jax.tree.map(jnp.asarray, parameters))
