"""The programs: of each family and method one, for a whole batch."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dae_jax

from .mechanisms import FAMILIES, T1, system


TIGHT = 1e-10
# Solver, formulation, tolerance.
METHODS: dict[str, tuple[Any, Any, float]] = {
    "projection": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None, TIGHT),
    "projection of order 8": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None, TIGHT),
    "tangent space": (dae_jax.TangentSpace(diffrax.Tsit5()), None, TIGHT),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives(), TIGHT),
    "baumgarte": (dae_jax.DOP853(), dae_jax.Baumgarte(5.0, 5.0), TIGHT),
    "ggl": (dae_jax.RadauIIA5(), dae_jax.GGL(), 1e-7),
}


def _clenshaw_curtis(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes, both ends among them, and weights on [0, 1]: every other node makes the rule of half as many."""
    angles = np.pi * np.arange(n + 1) / n
    orders = np.arange(n + 1)
    moments = np.where(orders % 2, 0, 2 / np.where(orders % 2, 1, 1 - orders**2))
    return (1 - np.cos(angles)) / 2, np.linalg.solve(np.cos(orders[:, None] * (np.pi - angles)), moments) / 2


# At which powers are summed up to energies, and with half of them.
NODES, WEIGHTS = _clenshaw_curtis(160)
_, HALF_OF_THEM = _clenshaw_curtis(80)


def _solved(
    name: str, method: str, p: Any, t0: Any, t1: Any, unit: Any, saved: Any, adjoint: Any = None
) -> dae_jax.DAESolution:
    """From `t0` to `t1`; `unit`: the size of a small number, times the tolerance."""
    solver, formulation, tolerance = METHODS[method]
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance * unit)
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    return dae_jax.daesolve(
        system(FAMILIES[name], p), solver, t0, t1, None, (p["q"], p["v"]), p, formulation=formulation, adjoint=adjoint,
        stepsize_controller=control, saveat=saved, max_steps=4000, throw=False,
    )  # fmt: skip


def _motion(name: str, p: Any, t0: Any, t1: Any, unit: Any) -> Any:
    """q, v, the result's code and the multipliers, at `NODES` of the time."""
    saved = diffrax.SaveAt(ts=t0 + (t1 - t0) * NODES)
    sol = _solved(name, "projection", p, t0, t1, unit, saved)
    return *sol.ys, sol.result._value, dae_jax.multipliers(system(FAMILIES[name], p), sol)


def _end(name: str, method: str, p: Any, adjoint: Any = None) -> Any:
    """q, v and the result's code, at T1: the dense output between the steps takes half of the time to compile."""
    sol = _solved(name, method, p, 0.0, T1, 1.0, diffrax.SaveAt(t1=True), adjoint)
    q, v = sol.ys
    return q[-1], v[-1], sol.result._value


@functools.lru_cache
def _batched(name: str) -> Any:
    return eqx.filter_jit(jax.vmap(functools.partial(_motion, name)))


@functools.lru_cache
def _ends(name: str, method: str, batched: bool) -> Any:
    end = functools.partial(_end, name, method)
    return eqx.filter_jit(jax.vmap(end) if batched else end)


def motions(name: str, p: Any, t0: Any = 0.0, t1: Any = T1, unit: Any = 1.0) -> list[np.ndarray]:
    numbers = (jnp.broadcast_to(jnp.asarray(x, float), (len(p["q"]),)) for x in (t0, t1, unit))
    return [np.asarray(x) for x in _batched(name)(p, *numbers)]


def ends(name: str, method: str, p: Any, batched: bool = True) -> list[np.ndarray]:
    return [np.asarray(x) for x in _ends(name, method, batched)(p)]


# Parameters that move no constraint, whose derivatives are asked for.
TUNED = "mass", "stiffness", "drag", "gravity"


@functools.lru_cache
def derivatives(name: str, method: str, forward: bool) -> Any:
    """Of a batch, the derivative of a weighted end state along `direction`."""

    def weighted(x: Any, p: Any, weights: Any, adjoint: Any) -> Any:
        q, v, _ = _end(name, method, p | x, adjoint)
        return jnp.sum(weights[0] * q) + jnp.sum(weights[1] * v)

    def along(p: Any, direction: Any, weights: Any) -> Any:
        x = {key: p[key] for key in TUNED}
        if forward:
            return jax.jvp(lambda x: weighted(x, p, weights, diffrax.ForwardMode()), (x,), (direction,))[1]
        reverse = jax.grad(weighted)(x, p, weights, diffrax.RecursiveCheckpointAdjoint())
        return sum(jnp.sum(reverse[key] * direction[key]) for key in TUNED)

    return eqx.filter_jit(jax.vmap(along))
