"""Fast spin, the exact unstable equilibrium, a spring of 1e10 N/m beside a rod, dry friction, a passage close to a centre of 1/r².

The sign in Coulomb's friction chatters at rest: an answer must be right there, but words are as good. The other truths are
closed forms: elliptic functions, uniform rotation, Kepler's equation.
"""

import jax.numpy as jnp
import numpy as np

import dae_jax as dj

from ..cases import Case
from . import pendulum
from .scales import with_tolerance


STIFFNESS = 1e10


def spun(name, angle, rate, t1, steps, y0=None, gravity=9.81):
    """A pendulum with its weight, or fast."""
    args = {"gravity": np.asarray(gravity), **pendulum.NEVER}
    fastest = max(abs(rate), np.sqrt(gravity))
    truth = pendulum.exact(angle, rate, gravity)
    return Case(
        name, pendulum.SYSTEM, y0 or pendulum.start(angle, rate), t1, truth, args, (1.0, fastest), rate=fastest, steps=steps,
        chart=pendulum.chart,
    )  # fmt: skip


def balanced():
    """Upside down, exactly: it stays, and rounding must not make it fall in 5 s."""
    y0 = np.array([0.0, -1.0]), np.zeros(2)
    case = spun("unstable equilibrium", np.pi, 0.0, 5.0, 2000, y0)
    truth = lambda times: tuple(np.tile(x, (len(times), 1)) for x in y0)
    return Case(**{**vars(case), "truth": truth})


def stiff_spring():
    """A rod of 1 m turns at 1 rad/s, and beyond it, in line, a mass on a spring, stretched by what its rotation takes."""

    def force(t, q, v, args):
        inner, outer = q[:2], q[2:]
        length = jnp.sqrt(jnp.sum((outer - inner) ** 2))
        pull = (STIFFNESS * (length - 1) + 2) * (outer - inner) / length
        return jnp.concatenate([pull, -pull])

    def turning(times):
        c, s = np.cos(times), np.sin(times)
        rim, tangent = np.stack([c, s], -1), np.stack([-s, c], -1)
        return np.concatenate([rim, 2 * rim], -1), np.concatenate([tangent, 2 * tangent], -1)

    system = dj.ConstrainedSystem(force, lambda t, q, args: (q[:2] @ q[:2] - 1) / 2)
    chart = lambda z: jnp.stack([jnp.cos(z[0]), jnp.sin(z[0]), z[1], z[2]])
    y0 = tuple(x[0] for x in turning(np.zeros(1)))
    return Case("spring of 1e10 N/m", system, y0, 0.5, turning, size=(2.0, 2.0), steps=100_000, bound=1e-5, chart=chart)


DRAG = 0.3 * 9.81


def sliding(t, q, v, args):
    """−μg tanh(v/w), or −μg sign v where w is 0."""
    width = args["width"]
    law = jnp.where(width > 0, jnp.tanh(v[0] / jnp.where(width > 0, width, 1)), jnp.sign(v[0]))
    return jnp.stack([-DRAG * law, 0 * v[0]])


def along_x(t, q, args):
    return q[1]


def friction(name, width, **rest):
    """A block of 1 kg slides along y = 0 with 1 m/s, and stops after v / μg."""

    def truth(times):
        moved = np.minimum(times, 1 / DRAG)
        x, v = moved - DRAG * moved**2 / 2, stopping(np.asarray(times), width)
        return np.stack([x, 0 * x], -1), np.stack([v, 0 * x], -1)

    system = dj.ConstrainedSystem(sliding, along_x)
    y0 = np.zeros(2), np.array([1.0, 0.0])
    args = {"width": np.asarray(width)}
    return Case(name, system, y0, 0.6, truth, args, steps=20_000, chart=on_x, max_steps=20_000, **rest)


def on_x(z):
    return jnp.stack([z[0], 0 * z[0]])


def stopping(times, width):
    """v̇ = −d tanh(v/w): sinh(v/w) falls like exp(−d t / w)."""
    if width == 0:
        return np.maximum(1 - DRAG * times, 0)
    exponent = (1 - DRAG * times) / width - np.log(2)
    return width * np.where(exponent > 30, exponent + np.log(2), np.arcsinh(np.exp(np.minimum(exponent, 30))))


def attracted(t, q, v, args):
    return -q / jnp.sum(q * q) ** 1.5


def level(t, q, args):
    return q[2]


def in_plane(z):
    return jnp.stack([z[0], z[1], 0 * z[0]])


def passage(name, eccentricity, **rest):
    """Around a centre of 1/r² on the plane z = 0, from the far end of the ellipse past the near one; period 2π."""
    e = eccentricity

    def truth(times):
        mean = np.asarray(times) + np.pi
        anomaly = mean + e * np.sin(mean)
        low, high = mean - 1.0, mean + 1.0
        for _ in range(80):  # bisection: Newton's method runs away near e = 1
            middle = (low + high) / 2
            over = middle - e * np.sin(middle) > mean
            low, high = np.where(over, low, middle), np.where(over, middle, high)
        anomaly = (low + high) / 2
        c, s, minor = np.cos(anomaly), np.sin(anomaly), np.sqrt(1 - e**2)
        zero = 0 * c
        q = np.stack([c - e, minor * s, zero], -1)
        return q, np.stack([-s, minor * c, zero], -1) / (1 - e * c)[:, None]

    system = dj.ConstrainedSystem(attracted, level)
    y0 = tuple(x[0] for x in truth(np.zeros(1)))
    fastest = (1 - e) ** -1.5
    return Case(
        name, system, y0, 0.9 * 2 * np.pi, truth, rate=fastest, steps=90_000, chart=in_plane, **rest,
    )  # fmt: skip


def cases(quick):
    """Steps that are fixed are too long for the closest passage."""
    return [
        spun("spin of 1e4 rad/s", 0.5, 1e4, 20 * np.pi / 1e4, 20_000),
        balanced(),
        stiff_spring(),
        friction("friction: tanh(v / 1e-4)", 1e-4, bound=1e-5),
        friction("friction: sign(v)", 0.0, due="any"),
        passage("1/r² passed at 1e-2", 0.99),
        passage("1/r² passed at 1e-4", 0.9999, only=with_tolerance()),
    ]
