"""References of mechanisms that do not use the library: their motion in minimal coordinates z, solved by scipy.

With the coordinates of the bodies as a closed form q(z), a twist of each, u = W q̇ = (v, ω), ω = 2 E(e) ė in body axes (in the plane
u = q̇), and D = diag(m, m, m, I), Newton's and Euler's equations D u̇ + (0, ω × I ω) = f become, as W(e, ė) q̇ = 0,

    Kᵀ D K z̈ = Kᵀ (f − D W q″ − (0, ω × I ω)) + Cᵀ τ,     K = W ∂q/∂z,  q″ = d²q(z + s ż)/ds²,  C = ∂c/∂z,

with gravity as f and efforts τ along coordinates c(z). Source: J. G. de Jalón, E. Bayo, *Kinematic and Dynamic Simulation of Multibody
Systems*, section 5.2.
"""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
from jaxtyping import Array

from ...scenes.scene import minimal
from ..bodies import Body
from ..configuration import Coordinates


Function = Callable[[np.ndarray], np.ndarray]
Reference = Callable[[np.ndarray], tuple[Coordinates, Coordinates]]


def reduced(
    bodies: Sequence[Body],
    places: Function,
    start: tuple[Sequence[float], Sequence[float]],
    gravity: Sequence[float],
    along: Function,
    effort: Callable[[float, np.ndarray, np.ndarray], np.ndarray],
) -> Reference:
    """The motion from (z, ż) = `start`.

    **Arguments**

    - `places(z)`: q, (bodies, 3) or (bodies, 7), analytic in z.
    - `along(z)`: the coordinates c of springs and motors, analytic in z; `effort(t, c, rates)`: their τ.
    """
    masses = np.array([float(body.mass) for body in bodies])
    inertias = np.stack([np.asarray(body.inertia, float) for body in bodies])
    weight = np.concatenate([gravity, np.zeros(1 if inertias.ndim == 1 else 3)]) * masses[:, None]
    n = len(start[0])

    def field(t: float, state: np.ndarray) -> np.ndarray:
        z, rates = state[:n], state[n:]
        slopes, c_slopes = jacobian(places, z), jacobian(along, z)
        q, velocities, change = np.real(places(z)), slopes @ rates, _second(places, z, rates)
        k = np.stack([_twists(q, slope) for slope in np.moveaxis(slopes, -1, 0)], -1)
        bias = _inertial(masses, inertias, _twists(q, change)) + _gyroscopic(inertias, _twists(q, velocities))
        mass = np.stack([_inertial(masses, inertias, column) for column in np.moveaxis(k, -1, 0)], -1)
        torque = effort(t, np.real(along(z)), c_slopes @ rates)
        right = np.einsum("bik,bi->k", k, weight - bias) + c_slopes.T @ torque
        return np.concatenate([rates, np.linalg.solve(np.einsum("bik,bil->kl", k, mass), right)])

    def embed(t: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, rates = state[:n], state[n:]
        return np.real(places(z)), jacobian(places, z) @ rates

    return named(bodies, minimal(field, np.concatenate(start), embed))


def named(bodies: Sequence[Body], solved: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Reference:
    """A reference of arrays (times, bodies, k) as one of states of a mechanism."""
    names = tuple(body.name for body in bodies)

    def reference(times: np.ndarray) -> tuple[Coordinates, Coordinates]:
        # A scene's states are arrays of numpy.
        q, v = (Coordinates(cast(Array, x), names) for x in solved(times))
        return q, v

    return reference


def at_start(reference: Reference) -> tuple[Coordinates, Coordinates]:
    """The state at time 0."""
    q, v = (Coordinates(x.values[0], x.names) for x in reference(np.zeros(1)))
    return q, v


def jacobian(function: Function, z: np.ndarray) -> np.ndarray:
    """∂f/∂z by complex steps, z last."""
    return np.stack([np.imag(function(z + 1e-30j * unit)) / 1e-30 for unit in np.eye(len(z))], -1)


def _second(function: Function, z: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """d²f(z + s ż)/ds² by fourth-order differences of first derivatives, at steps of 1e-3 in z."""
    h = 1e-3 / (1 + np.abs(rates).max())
    near = [np.imag(function(z + k * h * rates + 1e-30j * rates)) / 1e-30 for k in (-2, -1, 1, 2)]
    return (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * h)


def _twists(q: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """W q̇ of all bodies."""
    if q.shape[1] == 3:
        return velocities
    e0, e = q[:, 3:4], q[:, 4:]
    rate0, rate = velocities[:, 3:4], velocities[:, 4:]
    return np.concatenate([velocities[:, :3], 2 * (e0 * rate - rate0 * e - np.cross(e, rate))], 1)


def _inertial(masses: np.ndarray, inertias: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """D u of all bodies."""
    d = 2 if inertias.ndim == 1 else 3
    turned = inertias[:, None] * twists[:, d:] if d == 2 else np.einsum("bij,bj->bi", inertias, twists[:, d:])
    return np.concatenate([masses[:, None] * twists[:, :d], turned], 1)


def _gyroscopic(inertias: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """(0, ω × I ω) of all bodies."""
    if inertias.ndim == 1:
        return np.zeros_like(twists)
    spin = twists[:, 3:]
    return np.concatenate([0 * spin, np.cross(spin, np.einsum("bij,bj->bi", inertias, spin))], 1)


# Quaternions, analytic in their arguments


def turn(axis: Sequence[float], angle: np.ndarray) -> np.ndarray:
    """That of a turn about a unit axis."""
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis)])


def after(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """That of the turn a after the turn b."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def rotated(e: np.ndarray, p: np.ndarray) -> np.ndarray:
    """R(e) p."""
    twice = 2 * np.cross(e[1:], p)
    return p + e[0] * twice + np.cross(e[1:], twice)


def from_matrix(r: np.ndarray) -> np.ndarray:
    """Those of rotations by less than half a turn."""
    e0 = np.sqrt(1 + np.trace(r, axis1=-2, axis2=-1))[..., None] / 2
    skew = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    return np.concatenate([e0, skew / (4 * e0)], -1)


def normalised(p: np.ndarray) -> np.ndarray:
    """p/|p|."""
    return p / np.sqrt(np.sum(p**2, -1, keepdims=True))
