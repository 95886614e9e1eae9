"""What must hold of a batch of random mechanisms: each check gives the lines that say what does not."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from . import solves
from .mechanisms import (
    FAMILIES,
    NEAR_SINGULAR,
    T1,
    conditioning,
    constraint_jacobian,
    energy,
    in_another_frame,
    mass_matrix,
    mechanism,
    off_constraints,
    power,
    scaled,
)  # fmt: skip
from .minimal_coordinates import motion_in_minimal_coordinates


class Batch:
    """Mechanisms of a family, their solves by the method that the others are compared with, and which pass near a dead centre."""

    def __init__(self, name: str, seeds: Sequence[int]):
        self.name, self.seeds = name, list(seeds)
        self.each = [mechanism(FAMILIES[name], seed) for seed in self.seeds]
        self.p = jax.tree.map(lambda *x: np.stack(x), *self.each)
        self.q, self.v, self.code, self.multipliers = solves.motions(name, self.p)
        self.size = 1 + np.abs(self.v).max((1, 2, 3)) + np.abs(self.q).max((1, 2, 3))
        worst = np.array([self._worst(p, q) for p, q in zip(self.each, self.q, strict=True)])
        # What ended may not have been saved near where it ended.
        self.near = worst < np.where(self.code == 0, 1, 10) * NEAR_SINGULAR

    @staticmethod
    def _worst(p: Any, qs: np.ndarray) -> float:
        """The conditioning of the constraints where they are worst; times that a solve did not reach are left out."""
        inverse = np.linalg.inv(mass_matrix(p))
        reached = [(T1 * x, q) for x, q in zip(solves.NODES, qs, strict=True) if np.isfinite(q).all()]
        return min(conditioning(constraint_jacobian(p, t, q), inverse) for t, q in reached)

    def beyond(self, what: str, off: np.ndarray, allowed: float) -> list[str]:
        """A line for each mechanism whose number is larger, or none at all."""
        wrong = ~(off <= allowed) & ~self.near
        return [
            f"{self.name} {s}: {what} {x:.2g} > {allowed:.2g}"
            for s, x in zip(np.array(self.seeds)[wrong], off[wrong], strict=True)
        ]

    def differ(self, what: str, q: np.ndarray, v: np.ndarray, allowed: float) -> list[str]:
        """From the motion, or from its end."""
        mine, rates = (self.q, self.v) if q.ndim == self.q.ndim else (self.q[:, -1], self.v[:, -1])
        largest = lambda x: np.abs(x).reshape(len(x), -1).max(1)
        return self.beyond(what, np.maximum(largest(q - mine), largest(v - rates)) / self.size, allowed)


def ends_well(b: Batch) -> list[str]:
    return b.beyond("a result code", b.code.astype(float), 0)


def stays_on_the_constraints(b: Batch) -> list[str]:
    off = [
        np.max([off_constraints(p, T1 * x, *y) for x, *y in zip(solves.NODES, *ys, strict=True)])
        for p, *ys in zip(b.each, b.q, b.v, strict=True)
    ]
    return b.beyond("off the constraints", np.array(off) / b.size, 1e-11)


def balances_its_energy(b: Batch) -> list[str]:
    """What is gained is the work of drag and of what drives the joints."""
    off = []
    for p, q, v, m in zip(b.each, b.q, b.v, b.multipliers, strict=True):
        powers = np.array([power(p, T1 * x, *y) for x, *y in zip(solves.NODES, q, v, m, strict=True)])
        work, roughly = T1 * solves.WEIGHTS @ powers, T1 * solves.HALF_OF_THEM @ powers[::2]
        scale = 1 + abs(energy(p, q[0], v[0])) + T1 * np.max(np.abs(powers))
        # Where multipliers have a peak between the nodes, the quadrature knows no better.
        missing = abs(energy(p, q[-1], v[-1]) - energy(p, q[0], v[0]) - work) - abs(work - roughly)
        off.append(missing / scale)
    return b.beyond("off the balance of energy", np.array(off), 1e-7)


def is_the_motion_in_minimal_coordinates(b: Batch) -> list[str]:
    return b.differ("minimal coordinates differ by", *motion_in_minimal_coordinates(b.p, T1 * solves.NODES), 1e-7)


def agrees(b: Batch, method: str, keeps: bool = True) -> list[str]:
    """The end of another method, which lies on the constraints if `keeps`."""
    q, v, code = solves.ends(b.name, method, b.p)
    lines = b.beyond(f"a result code ({method})", code.astype(float), 0)
    lines += b.differ(f"{method} differs from projection by", q, v, 1000 * solves.METHODS[method][2])
    if keeps:
        off = np.array([max(off_constraints(p, T1, *y)) for p, *y in zip(b.each, q, v, strict=True)])
        lines += b.beyond(f"off the constraints ({method})", off / b.size, 1e-11)
    return lines


def comes_back(b: Batch) -> list[str]:
    """Backwards from the end."""
    # Those that ended at a dead centre have no end to come back from.
    end = {key: np.where(np.isfinite(x[:, -1]), x[:, -1], b.p[key]) for key, x in (("q", b.q), ("v", b.v))}
    q, v, *_ = solves.motions(b.name, b.p | end, T1, 0.0)
    # The nodes lie symmetrically.
    return b.differ("backwards differs by", q[:, ::-1], v[:, ::-1], 1e-6)


def scales(b: Batch) -> list[str]:
    """Other units of mass, length and time: the same motion."""
    units = np.array([10 ** np.random.default_rng([7, s]).uniform(-3, 3, 3) for s in b.seeds]).T
    _, length, time = units
    small = np.minimum(length, length / time)
    q, v, *_ = solves.motions(b.name, scaled(b.p, *units), 0.0, T1 * time, small)
    wide = lambda x: x[:, None, None, None]
    return b.differ("in other units differs by", q / wide(length), v / wide(length / time), 1e-6)


def knows_no_order_and_no_frame(b: Batch) -> list[str]:
    """Unknowns and constraints in another order, space turned, mirrored and shifted: the same motion."""
    moved, turned = zip(*(in_another_frame(p, seed) for p, seed in zip(b.each, b.seeds, strict=True)), strict=True)
    q, v, *_ = solves.motions(b.name, jax.tree.map(lambda *x: np.stack(x), *moved))
    there = lambda xs: np.stack([turn(x) for turn, x in zip(turned, xs, strict=True)])
    off = np.maximum(np.abs(q - 1 - there(b.q)).max((1, 2, 3)), np.abs(v - there(b.v)).max((1, 2, 3)))
    return b.beyond("in another order and frame differs by", off / b.size, 1e-7)


def batch_is_one_at_a_time(b: Batch, count: int = 5) -> list[str]:
    q, v, code = solves.ends(b.name, "tangent space", b.p)
    lines = []
    for k in range(0, len(b.seeds), max(1, len(b.seeds) // count)):
        own_q, own_v, own_code = solves.ends(b.name, "tangent space", b.each[k], batched=False)
        off = max(np.abs(own_q - q[k]).max(), np.abs(own_v - v[k]).max()) / b.size[k]
        if not (off <= 1e-9 and own_code == code[k]) and not b.near[k]:
            lines.append(f"{b.name} {b.seeds[k]}: alone differs from a lane of the batch by {off:.2g}")
    return lines


def derives(b: Batch, method: str = "projection", forward: bool = False) -> list[str]:
    """The derivative of the end is the central difference."""
    drawn = [np.random.default_rng([8, s]) for s in b.seeds]
    direction = {
        key: np.stack([r.uniform(-1, 1, x.shape) * x for r, x in zip(drawn, b.p[key], strict=True)]) for key in solves.TUNED
    }  # fmt: skip
    weights = tuple(np.stack([r.normal(size=b.q.shape[2:]) for r in drawn]) for _ in "qv")
    found = np.asarray(solves.derivatives(b.name, method, forward)(b.p, direction, weights))
    h, ends = 1e-4, []
    for sign in (1, -1):
        moved = b.p | {key: b.p[key] + sign * h * direction[key] for key in solves.TUNED}
        q, v, _ = solves.ends(b.name, method, moved)
        ends.append(np.sum(weights[0] * q, (1, 2)) + np.sum(weights[1] * v, (1, 2)))
    central = (ends[0] - ends[1]) / (2 * h)
    mode = "forward" if forward else "reverse"
    return b.beyond(f"{mode} mode off differences by", np.abs(found - central) / b.size / (1 + np.abs(central)), 1e-5)


Check = Callable[[Batch], list[str]]
