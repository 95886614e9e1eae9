"""Redundant constraints, closed loops of 5, 20 and 100 links, a chain of 256.

A regular polygon of rods that turns while it falls freely is an exact motion; the chain is released from the horizontal, its
truth in angles.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

import dae_jax as dj

from ..cases import Case
from . import pendulum
from .truth import by_angles


G = 9.81
# One of each kind for the large ones: most of the time goes into compiling.
LARGE = ("projection-dop853", "tangent-space", "dummy-dop853", "radau-ggl", "rattle")


def weights(t, q, v, args):
    """y points down."""
    return jnp.tile(jnp.array([0.0, G]), q.size // 2)


def redundant():
    """A parallelogram with a third, parallel rod: four constraints, three of them independent."""
    pivot = np.array([2.0, 0.0])

    def constraint(t, q, args):
        left, right = q[:2], q[2:] - pivot
        middle = (left + right) / 2
        bar = right - left + pivot
        return jnp.stack([left @ left - 1, right @ right - 1, bar @ bar - 4, middle @ middle - 1]) / 2

    swing = pendulum.exact(1.0, 0.0, G)

    def truth(times):
        q, v = swing(times)
        return np.concatenate([q, q + pivot], -1), np.concatenate([v, v], -1)

    chart = lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0]), 2 + jnp.sin(z[0]), jnp.cos(z[0])])
    y0 = tuple(x[0] for x in truth(np.zeros(1)))
    system = dj.ConstrainedSystem(weights, constraint)
    return Case("a rod too many", system, y0, 2.0, truth, size=(2.0, 3.0), rate=np.sqrt(G), chart=chart)


def ring(n, spin=2.0):
    """n unit masses on n unit rods."""

    def constraint(t, q, args):
        points = q.reshape(n, 2)
        rods = jnp.roll(points, -1, 0) - points
        return (jnp.sum(rods * rods, 1) - 1) / 2

    radius = 1 / (2 * np.sin(np.pi / n))

    def truth(times):
        t = np.asarray(times)[:, None]
        angle = 2 * np.pi * np.arange(n) / n + spin * t
        fallen = np.stack([0 * t, G * t**2 / 2], -1)
        q = radius * np.stack([np.cos(angle), np.sin(angle)], -1) + fallen
        v = spin * radius * np.stack([-np.sin(angle), np.cos(angle)], -1) + np.stack([0 * t, G * t], -1)
        return q.reshape(len(t), -1), v.reshape(len(t), -1)

    y0 = tuple(x[0] for x in truth(np.zeros(1)))
    size = (radius + G / 2, spin * radius + G)
    return Case(f"loop of {n} links", dj.ConstrainedSystem(weights, constraint), y0, 1.0, truth, size=size, rate=spin)


def chain(n):
    """n unit masses on n unit rods that hang on one another, the first at the origin."""

    def constraint(t, q, args):
        points = q.reshape(n, 2)
        rods = points - jnp.concatenate([jnp.zeros((1, 2)), points[:-1]])
        return (jnp.sum(rods * rods, 1) - 1) / 2

    below = n - np.maximum.outer(np.arange(n), np.arange(n))

    def field(t, z):
        angle, rate = np.split(z, 2)
        turn = angle[:, None] - angle[None, :]
        right = -np.diagonal(below) * G * np.sin(angle) - (below * np.sin(turn)) @ rate**2
        return np.concatenate([rate, np.linalg.solve(below * np.cos(turn), right)])

    def embed(t, z):
        angle, rate = np.split(z, 2)
        q = np.cumsum(np.stack([np.sin(angle), np.cos(angle)], 1), 0)
        v = np.cumsum(rate[:, None] * np.stack([np.cos(angle), -np.sin(angle)], 1), 0)
        return q.ravel(), v.ravel()

    z0 = np.concatenate([np.full(n, np.pi / 2), np.zeros(n)])
    system = dj.ConstrainedSystem(weights, constraint)
    truth = by_angles(field, z0, embed, 1e-11)
    return Case(f"chain of {n}", system, embed(0.0, z0), 0.2, truth, size=(float(n), 10.0), rate=20.0, steps=200)


def cases(quick):
    """The small ones first."""
    large = (dataclasses.replace(case, only=LARGE) for case in (ring(20), ring(100), chain(256)))
    return [redundant(), ring(5), *large]
