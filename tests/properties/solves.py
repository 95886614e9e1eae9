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
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None, TIGHT),
    "tangent space": (dae_jax.TangentSpace(diffrax.Dopri8()), None, TIGHT),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives(), TIGHT),
    "baumgarte": (dae_jax.DOP853(), dae_jax.Baumgarte(5.0, 5.0), TIGHT),
    "ggl": (dae_jax.RadauIIA5(), dae_jax.GGL(), 1e-8),
}
# Gauss's nodes, so that powers can be summed up to energies, and both ends.
_NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)
NODES = np.concatenate([[0.0], (1 + _NODES) / 2, [1.0]])
WEIGHTS = WEIGHTS / 2


def _solved(name: str, method: str, p: Any, t0: Any, t1: Any, unit: Any, adjoint: Any = None) -> dae_jax.DAESolution:
    """From `t0` to `t1`, saved at `NODES` of it; `unit`: the size of a small number, times the tolerance."""
    solver, formulation, tolerance = METHODS[method]
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance * unit)
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    return dae_jax.daesolve(
        system(FAMILIES[name], p), solver, t0, t1, None, (p["q"], p["v"]), p, formulation=formulation, adjoint=adjoint,
        stepsize_controller=control, saveat=diffrax.SaveAt(ts=t0 + (t1 - t0) * NODES), max_steps=4000, throw=False,
    )  # fmt: skip


def _one(name: str, method: str, p: Any, t0: Any, t1: Any, unit: Any) -> Any:
    """q, v, the result's code and, of the underlying ODE, the multipliers."""
    sol = _solved(name, method, p, t0, t1, unit)
    q, v = sol.ys
    return q, v, sol.result._value, dae_jax.multipliers(system(FAMILIES[name], p), sol)


@functools.lru_cache
def _batched(name: str, method: str) -> Any:
    return eqx.filter_jit(jax.vmap(functools.partial(_one, name, method)))


@functools.lru_cache
def _alone(name: str, method: str) -> Any:
    return eqx.filter_jit(functools.partial(_one, name, method))


def batch(name: str, method: str, p: Any, t0: Any = 0.0, t1: Any = T1, unit: Any = 1.0) -> list[np.ndarray]:
    lanes = len(p["q"])
    numbers = (jnp.broadcast_to(jnp.asarray(x, float), (lanes,)) for x in (t0, t1, unit))
    return [np.asarray(x) for x in _batched(name, method)(p, *numbers)]


def alone(name: str, method: str, p: Any) -> list[np.ndarray]:
    return [np.asarray(x) for x in _alone(name, method)(p, *(jnp.asarray(x) for x in (0.0, T1, 1.0)))]


# Parameters that move no constraint, whose derivatives are asked for.
TUNED = "mass", "stiffness", "drag", "gravity"


def _end(name: str, method: str, p: Any, x: Any, weights: Any, adjoint: Any) -> Any:
    q, v = _solved(name, method, p | x, 0.0, T1, 1.0, adjoint).ys
    return jnp.sum(weights[0] * q[-1]) + jnp.sum(weights[1] * v[-1])


@functools.lru_cache
def derivatives(name: str, method: str) -> Any:
    """Of a batch, the derivatives of a weighted end state along `direction`: (reverse, forward)."""

    def both(p: Any, direction: Any, weights: Any) -> Any:
        x = {key: p[key] for key in TUNED}
        reverse = jax.grad(lambda x: _end(name, method, p, x, weights, diffrax.RecursiveCheckpointAdjoint()))(x)
        forward = lambda x: _end(name, method, p, x, weights, diffrax.ForwardMode())
        along = sum(jnp.sum(reverse[key] * direction[key]) for key in TUNED)
        return along, jax.jvp(forward, (x,), (direction,))[1]

    return eqx.filter_jit(jax.vmap(both))
