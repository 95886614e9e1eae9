"""Baumgarte's α and β from 0 to 1e6, in 1/s: a pendulum with the error control of DOP853 for 0.2 s. In the map, for fixed steps of
Tsit5, the largest stable step is measured and set against theory: h (−α ± √(α² − β²)) in the method's region of stability.
"""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import dae_jax as dj

from . import pendulum, steps
from .extremes import spun


# Powers of ten of α and β in the map, and zero; as many steps as let an error grow by GROWN count as unstable.
POWERS = np.linspace(0, 6, 19)
STEPS, GROWN = 2000, 1e8
SPIN = 1e-6


def cases(quick):
    """Both equal, one of them zero, and far apart."""
    pairs = [(0.0, 0.0), (1e2, 1e2), (1e4, 1e4), (1e6, 1e6), (0.0, 1e4), (1e4, 0.0), (1e6, 1e2)]
    return [
        dataclasses.replace(
            spun(f"α = {alpha:g}, β = {beta:g}", np.pi / 2, 0.0, 0.2, 1000), formulation=dj.Baumgarte(alpha, beta),
            only=("baumgarte",), max_steps=2_000_000,
        )
        for alpha, beta in pairs
    ]  # fmt: skip


def roots(alpha, beta):
    """Of s² + 2αs + β²; the small one without cancellation."""
    root = np.sqrt(complex(alpha**2 - beta**2))
    large = -alpha - root
    return np.array([large, beta**2 / large if large else 0.0])


def largest_step(alpha, beta, growth):
    """The largest h for which |R(h s)| ^ STEPS ≤ GROWN for both roots."""
    fastest = np.abs(roots(alpha, beta)).max()
    if fastest == 0:
        return np.inf
    h = np.linspace(0, 8, 1601) / fastest
    over = np.array([max(abs(growth(x * s)) for s in roots(alpha, beta)) for x in h]) > GROWN ** (1 / STEPS)
    return float(h[np.argmax(over) - 1]) if over.any() else np.inf


def turn(t, q, v, a):
    """No force: the mass turns on its circle, so slowly that its motion limits no step."""
    return 0 * q


CIRCLE = dj.ConstrainedSystem(turn, pendulum.constraint)


@functools.partial(jax.jit, static_argnums=3)
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
def drift(alpha, beta, h, count):
    """max |g| after so many steps; errors of 1e-16 are there from rounding."""
    y0 = jnp.array([0.6, 0.8]), SPIN * jnp.array([0.8, -0.6])
    sol = dj.daesolve(
        CIRCLE, diffrax.Tsit5(), 0.0, count * h, h, y0, formulation=dj.Baumgarte(alpha, beta), max_steps=count + 1, throw=False
    )  # fmt: skip
    q = sol.ys[0][-1]
    return jnp.abs(q @ q - 1) / 2


def measured(values, growth):
    """(theory, measured): the largest stable steps over a grid of α and β, by bisection of the factor between them."""
    theory = np.array([[largest_step(a, b, growth) for b in values] for a in values])
    a, b = (x.ravel() for x in np.meshgrid(values, values, indexing="ij"))
    known = np.isfinite(theory.ravel())
    a, b, h = a[known], b[known], theory.ravel()[known]
    low, high = np.full(h.shape, 0.25), np.full(h.shape, 4.0)
    for _ in range(10):
        middle = np.sqrt(low * high)
        left = np.asarray(drift(a, b, middle * h, STEPS))
        stable = left <= 1e-16 * GROWN
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    found = np.full(theory.size, np.nan)
    found[known] = np.sqrt(low * high) * h
    return theory, found.reshape(theory.shape)


def decay():
    """The largest difference between the drift of a start that is off by 1e-8 and the solution of g̈ + 2αġ + β²g = 0, as a part
    of that 1e-8, over nine pairs of α and β.
    """
    off, worst = 1e-8, 0.0
    for alpha in (1.0, 10.0, 100.0):
        for beta in (1.0, 10.0, 100.0):
            slow, fast = sorted(roots(alpha, beta * (1 + 1e-7)), key=lambda s: -s.real)
            times = np.linspace(0, 5 / -slow.real, 21)
            g0 = ((1 + off) ** 2 - 1) / 2
            exact = (g0 * (fast * np.exp(slow * times) - slow * np.exp(fast * times)) / (fast - slow)).real
            sol = dj.daesolve(
                CIRCLE, dj.DOP853(), 0.0, times[-1], None, (np.array([0.6, 0.8]) * (1 + off), np.array([0.8, -0.6])),
                formulation=dj.Baumgarte(alpha, beta), saveat=diffrax.SaveAt(ts=times), max_steps=1_000_000,
                stepsize_controller=diffrax.PIDController(rtol=1e-13, atol=1e-17),
            )  # fmt: skip
            q = np.asarray(sol.ys[0])
            worst = max(worst, np.abs((np.sum(q * q, -1) - 1) / 2 - exact).max() / g0)
    return worst


def figures(folder, quick, cells):
    """The map of the largest stable step, and how far it is off theory."""
    jax.config.update("jax_enable_x64", True)
    values = np.concatenate([[0.0], 10.0 ** (POWERS[::9] if quick else POWERS)])
    theory, found = measured(values, steps.tsit5())
    ratio = found / theory
    draw(values, theory, found, ratio).savefig(folder / "stress-baumgarte.png")
    low, high = np.nanmin(ratio), np.nanmax(ratio)
    said = (
        f"Baumgarte's feedback over {np.isfinite(ratio).sum()} pairs of α and β from 0 to 1e6: the largest stable step of Tsit5 is "
        f"{low:.3f} to {high:.3f} times that of theory, and the drift of a start that is off decays as the roots say, to "
        f"{decay():.0e} of it."
    )
    return {"stress-baumgarte.png": said}


def draw(values, theory, found, ratio):
    """Two maps over α and β; a gap sets zero apart from the decades."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    shown = Figure(figsize=(9.6, 4.6), layout="constrained", dpi=160)
    place = np.concatenate([[-0.9], np.log10(values[1:])])
    half = (place[2] - place[1]) / 2
    edges = np.concatenate([[-0.9 - half], [-0.9 + half], place[1:] - half, [place[-1] + half]])

    def spread(x):
        """With an empty row and column after zero's."""
        return np.insert(np.insert(x, 1, np.nan, 0), 1, np.nan, 1)

    panels = (
        (found, "largest stable step of Tsit5, in s", {"cmap": "viridis", "norm": LogNorm()}),
        (ratio, "measured / theory", {"cmap": "PuOr", "vmin": 0.95, "vmax": 1.05}),
    )
    for axes, (x, label, style) in zip(shown.subplots(1, 2), panels, strict=True):
        mesh = axes.pcolormesh(edges, edges, spread(x).T, rasterized=True, **style)
        shown.colorbar(mesh, ax=axes, label=label, shrink=0.75)
        axes.plot([-0.3, 6], [-0.3, 6], color="white" if x is found else "#3A3F45", linewidth=0.8, linestyle=":")
        ticks = [-0.9, 0, 2, 4, 6]
        names = ["0", "1", "10²", "10⁴", "10⁶"]
        axes.set_xticks(ticks, names)
        axes.set_yticks(ticks, names)
        axes.set(xlabel="α in 1/s", ylabel="β in 1/s", aspect="equal")
        axes.text(
            5.9,
            5.2,
            "α = β",
            fontsize=7.5,
            ha="right",
            va="top",
            rotation=45,
            color="white" if x is found else "#3A3F45",
        )
    return shown
