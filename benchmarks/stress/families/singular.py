"""Configurations at and near a singularity of the constraints.

A slider-crank whose rod is longer than its crank by δ, in θ and s, 0 = s² − 2 s sin θ − η with η = 2δ + δ²: at θ = 0 the slider turns
within √η rad, which fixed steps do not see below 1e-6, and a drift of more than η makes another mechanism of it. At δ = 0 three
motions meet there, the smooth one and the limits of small δ of either sign: each is a solution, and words are as good. A
parallelogram passes its change point, or turns there into an antiparallelogram of the same energy, as it does in the limit of links
that are a little too long or too short; two rods are pulled apart until they are straight, after which there is no state: a failure
at that time is due.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import dae_jax as dj

from ..cases import Case
from . import pendulum
from .scales import with_tolerance


def no_force(t, q, v, args):
    """Inertia alone."""
    return 0 * q


def closing(t, q, args):
    """(|slider − pin|² − ℓ²)/2."""
    return (q[1] ** 2 - 2 * q[1] * jnp.sin(q[0]) - args["eta"]) / 2


def chart(t, z, args):
    """The sheet with s > 0."""
    sine = jnp.sin(z[0])
    return jnp.stack([z[0], sine + jnp.sqrt(sine**2 + args["eta"])])


SLIDER = dj.ConstrainedSystem(no_force, closing)


def dead_centre(excess, angle=0.8, rate=-2.0, **rest):
    """Passes θ = 0 with the slider turning within √(2δ) rad. With sin θ = √η sinh u all is smooth in u:
    s′(θ) = cos θ (1 + tanh u), and the energy (1 + s′²) θ̇²/2 gives t(u).
    """
    eta = 2 * excess + excess**2
    root = np.sqrt(eta)
    u0 = np.arcsinh(np.sin(angle) / root)
    angle_of = lambda u: np.arcsin(root * np.sinh(u))
    slope = lambda u: np.cos(angle_of(u)) * (1 + np.tanh(u))
    momentum = np.sqrt(1 + slope(u0) ** 2) * rate
    pace = lambda u: root * np.cosh(u) / np.cos(angle_of(u)) * np.sqrt(1 + slope(u) ** 2) / momentum
    time_of = lambda u: sum(quad(pace, a, b, epsabs=1e-13, epsrel=1e-12)[0] for a, b in _pieces(u0, u))

    def truth(times):
        rows = []
        for t in np.asarray(times, float):
            u = u0 if t == 0 else brentq(lambda u, t=t: time_of(u) - t, -u0, u0, xtol=1e-13, rtol=1e-14)
            speed = momentum / np.sqrt(1 + slope(u) ** 2)
            # s = √η eᵘ, without cancellation.
            rows.append(((angle_of(u), root * np.exp(u)), (speed, slope(u) * speed)))
        q, v = zip(*rows, strict=True)
        return np.array(q), np.array(v)

    y0 = tuple(x[0] for x in truth([0.0]))
    return Case(
        f"dead centre at {excess:g}", SLIDER, y0, 0.6, truth, {"eta": np.asarray(eta)}, (1.0, 4.0), rate=max(4.0, 1 / root), steps=4000,
        chart=chart, **rest,
    )  # fmt: skip


def _pieces(start, end):
    points = np.linspace(start, end, max(int(abs(end - start)), 1) + 1)
    return itertools.pairwise(points)


def crossing(name, angle, rate, due, **rest):
    """δ = 0: s = 2 sin θ, and (1 + 4 cos² θ) θ̇² stays."""
    momentum = np.sqrt(1 + 4 * np.cos(angle) ** 2) * rate

    def truth(times):
        time_of = lambda x: quad(lambda y: np.sqrt(1 + 4 * np.cos(y) ** 2) / momentum, angle, x, epsabs=1e-14)[0]
        ends = sorted((angle, angle + np.sign(rate) * 2.5)) if rate else (angle, angle)
        rows = [
            angle if t == 0 or not rate else brentq(lambda x, t=t: time_of(x) - t, *ends, xtol=1e-14) for t in times
        ]
        x = np.array(rows)
        speed = momentum / np.sqrt(1 + 4 * np.cos(x) ** 2)
        return np.stack([x, 2 * np.sin(x)], -1), np.stack([speed, 2 * np.cos(x) * speed], -1)

    y0 = tuple(x[0] for x in truth([0.0]))
    args = {"eta": np.asarray(0.0)}
    return Case(name, SLIDER, y0, 0.6, truth, args, (1.0, 4.0), rate=4.0, steps=4000, due=due, **rest)


def turned_back(times):
    """The limit from δ < 0, a rod shorter than the crank, which cannot pass: the mirror image of that from δ > 0."""
    q, v = dead_centre(1e-15).truth(times)
    past = q[:, 0] < 0
    q[past, 0], v[past, 0] = -q[past, 0], -v[past, 0]
    return q, v


def parallelogram():
    """Cranks and base in one line: it goes on as a parallelogram, smoothly, or could change to an antiparallelogram."""
    pivot = np.array([2.0, 0.0])

    def constraint(t, q, args):
        left, right = q[:2], q[2:] - pivot
        bar = right - left + pivot
        return jnp.stack([left @ left - 1, right @ right - 1, bar @ bar - 4]) / 2

    swing = pendulum.exact(1.0, 5.0, 9.81)

    def truth(times):
        q, v = swing(times)
        return np.concatenate([q, q + pivot], -1), np.concatenate([v, v], -1)

    def force(t, q, v, args):
        return jnp.array([0.0, 9.81, 0.0, 9.81])

    y0 = tuple(x[0] for x in truth(np.zeros(1)))
    system = dj.ConstrainedSystem(force, constraint)
    crossed = tuple(antiparallelogram(truth, pivot, way) for way in (1, -1))
    return Case(
        "parallelogram passes its change point", system, y0, 1.0, truth, size=(2.0, 6.0), rate=6.0, due="any", or_else=crossed
    )  # fmt: skip


def antiparallelogram(before, pivot, way):
    """times → (q, v): `before`, and from where the cranks lie along the base the other motion, in which tan(β/2) = −3 tan(α/2) for their
    angles α and β above it and (α̇² + β̇²)/2 + g (sin α + sin β), with y down, has the same value; α goes `way`.
    """
    g = 9.81
    other = lambda a: -2 * np.arctan2(3 * np.sin(a / 2), np.cos(a / 2))
    ratio = lambda a: -3 / (1 + 8 * np.sin(a / 2) ** 2)
    bend = lambda a: 12 * np.sin(a) / (1 + 8 * np.sin(a / 2) ** 2) ** 2

    def field(t, z):
        a, rate = z
        r = ratio(a)
        weight = g * (np.cos(a) + r * np.cos(other(a)))
        return rate, (weight - r * bend(a) * rate**2) / (1 + r**2)

    def truth(times):
        t = np.asarray(times, float)
        meets = brentq(lambda t: before([t])[0][0, 1], 0, 0.5, xtol=1e-15)
        speed = np.linalg.norm(before([meets])[1]) / np.sqrt(1 + ratio(0.0) ** 2)
        q, v = before(t)
        late = t > meets
        if late.any():
            found = solve_ivp(
                field, (meets, t[-1]), (0.0, way * speed), "DOP853", t[late], rtol=1e-13, atol=1e-14
            ).y  # fmt: skip
            a, rate = found
            for angle, turning, at, base in (
                (a, rate, slice(0, 2), 0 * pivot),
                (other(a), ratio(a) * rate, slice(2, 4), pivot),
            ):
                q[late, at] = base + np.stack([np.cos(angle), np.sin(angle)], -1)
                v[late, at] = turning[:, None] * np.stack([-np.sin(angle), np.cos(angle)], -1)
        return q, v

    return truth


def pulled_apart():
    """A joint on two unit rods, one from the origin, one from (1 + t, 0): straight at 1 s, and torn after."""

    def constraint(t, q, args):
        other = q - jnp.stack([1 + t, 0 * t])
        return jnp.stack([q @ q - 1, other @ other - 1]) / 2

    def truth(times):
        x = (1 + np.asarray(times)) / 2
        y = np.sqrt(1 - x**2)
        return np.stack([x, y], -1), np.stack([0.5 + 0 * x, -x / (2 * y)], -1)

    y0 = tuple(x[0] for x in truth(np.zeros(1)))
    system = dj.ConstrainedSystem(no_force, constraint)
    return Case("pulled beyond its reach", system, y0, 2.0, truth, due="failure", ends=1.0, steps=4000)


def cases(quick):
    """From afar to the singularity itself."""
    return [
        *(dead_centre(excess) for excess in (1e-1, 1e-3, 1e-6)),
        *(dead_centre(excess, only=with_tolerance()) for excess in (1e-9, 1e-12)),
        crossing("dead centre exactly", 0.8, -2.0, "any", or_else=(dead_centre(1e-15).truth, turned_back)),
        crossing("from 1e-6 off the dead centre", 1e-6, 2.0, "any"),
        crossing("from the dead centre", 0.0, 2.0, "refusal"),
        parallelogram(),
        pulled_apart(),
    ]
