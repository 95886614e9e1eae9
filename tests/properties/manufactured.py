"""Random nonlinear DAEs of index 1, 2 and 3 whose solution is chosen first: 0 = R(y, ẏ) − R(y*(t), ẏ*(t)), y* = a sin(ω t + φ)."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dae_jax


T1 = 1.0
TOLERANCE = 1e-9
DIFFERENTIAL, ALGEBRAIC = 4, 2
# Where unknowns and equations stand: not with the differential ones first.
UNKNOWNS, EQUATIONS = (3, 0, 5, 2, 1, 4), (4, 1, 0, 5, 3, 2)
# Solver, formulation.
METHODS: dict[str, tuple[Any, Any]] = {
    "projection": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
    "dummy derivatives": (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
    "tangent space": (dae_jax.TangentSpace(diffrax.Tsit5()), None),
    "radau": (dae_jax.RadauIIA5(), dae_jax.DummyDerivatives()),
}


def drawn(index: int, seed: int) -> dict[str, np.ndarray]:
    """The numbers of a system. Units of the equations are 1e-3 to 1e3, of either sign."""
    rng = np.random.default_rng([index, seed])
    n, m = DIFFERENTIAL, ALGEBRAIC
    near = lambda *shape: np.eye(*shape) + 0.25 * rng.uniform(-1, 1, shape)
    return {
        "rates": near(n, n), "linear": rng.uniform(-1, 1, (n, n)), "quadratic": rng.uniform(-0.2, 0.2, (n, n)),
        "inputs": near(m, m), "others": 0.3 * rng.uniform(-1, 1, (n - m, m)), "outputs": near(m, m),
        "algebraic": near(m, m), "bend": rng.uniform(-0.1, 0.1, m),
        "unit": rng.choice([-1, 1], n + m) * 10 ** rng.uniform(-3, 3, n + m),
        "amplitude": rng.uniform(0.3, 1, n + m), "frequency": rng.uniform(1, 5, n + m), "phase": rng.uniform(0, 6, n + m),
    }  # fmt: skip


def exact(p: Any, t: Any) -> tuple[Any, Any]:
    """y* and its rate."""
    angle = p["frequency"] * t + p["phase"]
    xp = jnp if isinstance(angle, jax.Array) else np
    return p["amplitude"] * xp.sin(angle), p["amplitude"] * p["frequency"] * xp.cos(angle)


def _left(index: int, y: Any, yd: Any, p: Any) -> Any:
    """R. Of index 3, z acts on the rates of the second half of x, these on those of the first, which the constraint is about."""
    n, m = DIFFERENTIAL, ALGEBRAIC
    x, z = y[jnp.array(UNKNOWNS[:n])], y[jnp.array(UNKNOWNS[n:])]
    rates = yd[jnp.array(UNKNOWNS[:n])]
    upper, lower = x[:m], x[m:]
    if index == 3:
        first = rates[:m] - p["outputs"] @ lower + p["linear"][:m, :m] @ jnp.sin(upper)
        second = p["rates"][m:, m:] @ rates[m:] + lower**2 * rates[m:] / 5 + p["linear"][m:] @ x + p["inputs"] @ z
        differential = jnp.concatenate([first, second + x[0] * z / 5])
    else:
        acts = jnp.concatenate([p["inputs"] @ z, p["others"] @ z])
        differential = p["rates"] @ rates + p["linear"] @ x + (p["quadratic"] @ x) * x + acts
    algebraic = (
        p["algebraic"] @ z + z**3 / 3 + upper * lower if index == 1 else upper + p["bend"] * upper**2 + p["bend"]
    )
    return p["unit"] * jnp.concatenate([differential, algebraic])[jnp.array(EQUATIONS)]


def _end(index: int, method: str, p: Any) -> Any:
    def residual(t: Any, y: Any, yd: Any, p: Any) -> Any:
        return _left(index, y, yd, p) - _left(index, *exact(p, t), p)

    solver, formulation = METHODS[method]
    y0, yd0 = exact(p, jnp.zeros(()))
    sol = dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual, yd0), solver, 0.0, T1, None, y0, p, formulation=formulation, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE), max_steps=4000,
    )  # fmt: skip
    return sol.ys[-1], sol.result._value


@functools.lru_cache
def ends(index: int, method: str) -> Any:
    """Of a batch, y(T1) and the result's code."""
    return eqx.filter_jit(jax.vmap(functools.partial(_end, index, method)))


@functools.lru_cache
def gradients(index: int, method: str) -> Any:
    """The same, and the gradient of weights·y(T1) with respect to all numbers of the system."""

    def weighted(p: Any, weights: Any) -> Any:
        y, code = _end(index, method, p)
        return jnp.dot(weights, y), (y, code)

    def both(p: Any, weights: Any) -> Any:
        gradient, (y, code) = jax.grad(weighted, has_aux=True)(p, weights)
        return y, code, gradient

    return eqx.filter_jit(jax.vmap(both))


def broken(index: int, seeds: Any, method: str = "projection", derivatives: bool = False) -> list[str]:
    """A line for each system that does not end where it should or whose derivatives are others than those of y*(T1)."""
    each = [drawn(index, seed) for seed in seeds]
    p = jax.tree.map(lambda *x: np.stack(x), *each)
    weights = np.stack([np.random.default_rng([4, s]).normal(size=DIFFERENTIAL + ALGEBRAIC) for s in seeds])
    y, code, *found = gradients(index, method)(p, weights) if derivatives else ends(index, method)(p)
    off = np.abs(y - exact(p, T1)[0]).max(1)
    laws = [("a result code", np.asarray(code), 0), ("off the solution", off, 1000 * TOLERANCE)]
    for gradient in found:
        angle = p["frequency"] * T1 + p["phase"]
        turned = weights * p["amplitude"] * np.cos(angle)
        # Nothing else moves the solution.
        wanted = jax.tree.map(np.zeros_like, p) | {
            "amplitude": weights * np.sin(angle), "phase": turned, "frequency": T1 * turned,
        }  # fmt: skip
        # A small unit is a number whose derivative is large.
        size = {key: np.abs(p["unit"]) if key == "unit" else 1.0 for key in p}
        for key in p:
            wrong = np.abs(np.asarray(gradient[key]) - wanted[key]) * size[key]
            laws.append((f"derivative by {key} off by", wrong.reshape(len(seeds), -1).max(1), 1e-6))
    return [
        f"index {index} {method} {seed}: {what} {x:.2g}"
        for what, xs, allowed in laws
        for seed, x in zip(seeds, xs, strict=True)
        if not x <= allowed
    ]
