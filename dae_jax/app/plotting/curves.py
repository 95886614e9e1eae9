"""Curves: drift, energy, what changes over time, what is reached at what cost."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import PyTree

from .common import COLOURS, GREY, Curves, figure_of, legend_below, legend_beside, look, saved, tick_few_decades


# Where the arrow of a point stands whose error is above 1.
ABOVE, ARROW = 2.0, r"$\uparrow$"


def drift(curves: Curves, title: str = "Drift off the constraints", unit: str = "", violated: str = "g") -> Any:
    """The largest violation of the constraints until each time, on a log axis; `curves` maps a label to (times, max |g|).
    `violated`: which constraints, in the documentation's symbols.
    """
    return _largest_so_far(curves, f"largest |{violated}| so far{unit and ' in ' + unit}", title)


def energy(curves: Curves, title: str = "Energy", unit: str = "J") -> Any:
    """The largest change of the energy until each time, on a log axis; `curves` maps a label to (times, energies)."""
    changes = {label: (t, np.asarray(values) - values[0]) for label, (t, values) in curves.items()}
    return _largest_so_far(changes, f"largest |E − E(0)| so far in {unit}", title)


def _largest_so_far(curves: Curves, quantity: str, title: str) -> Any:
    """The largest of each curve until each time, on a log axis. The axis begins where the curves end, not in their first
    steps; zeros are left out, and a curve of nothing else says so. The legend is in the order in which the curves end.
    """
    figure, axes = figure_of(8.4, 5.0)
    lines, ends = [], []
    for i, (label, curve) in enumerate(curves.items()):
        t, values = saved(*curve)
        largest = np.maximum.accumulate(np.abs(values))
        ends.append(largest[-1])
        shown = np.where(largest > 0, largest, np.nan)
        label = label if ends[-1] > 0 else f"{label}: exactly 0"
        # A few markers each, at other places for each: curves on top of each other can be told apart.
        every = max(len(shown) // 8, 1)
        places = (every * (i + 1) // (len(curves) + 1), every)
        lines += axes.plot(t, shown, label=label, markevery=places, **look(label, i))
    positive = [end for end in ends if end > 0]
    axes.set(xlabel="time in s", ylabel=quantity, title=title)
    if positive:
        low, high = min(positive) / 4, max(positive) * 2
        # Three decades at least: a factor of two is no difference.
        wider = max(1e3 * low / high, 1) ** 0.5
        axes.set(yscale="log", ylim=(low / wider, high * wider))
    legend_beside(figure, [lines[i] for i in np.argsort(ends, kind="stable")[::-1]])
    return figure


def drift_growth(curves: Curves, title: str = "", unit: str = "", power: int = 2) -> Any:
    """The violations themselves on log axes, with a line that grows with a power of time to compare with."""
    figure, axes = figure_of()
    for i, (label, (t, g)) in enumerate(curves.items()):
        t, g = (x[1:] for x in saved(t, g))
        axes.loglog(t, np.where(g > 0, g, np.nan), color=look(label, i)["color"], linewidth=1.4, label=label)
        guide = 2 * g[-1] * (t / t[-1]) ** power
        late = t > t[-1] / 30
        axes.loglog(t[late], guide[late], "--", color=GREY, linewidth=1, label=None if i else f"∝ time$^{power}$")
    axes.set(xlabel="time in s", ylabel=f"max |g|{unit and ' in ' + unit}", title=title)
    tick_few_decades(axes.xaxis)
    legend_below(figure, 4)
    return figure


def over_time(
    curves: Curves,
    quantity: str,
    title: str = "",
    exact: str | None = None,
    along: str = "time in s",
    log_time: bool = False,
) -> Any:
    """Any quantity over time, or over what `along` says; `quantity` labels its axis, with the unit. With `log_time` times
    are logarithmic, without those that are not positive.

    The curve called `exact` is drawn wide and grey behind the others, so that what agrees with it stays visible.
    """
    figure, axes = figure_of()
    if exact is not None:
        axes.plot(*saved(*curves[exact]), color=GREY, alpha=0.6, linewidth=4, label=exact)
    others = {k: saved(*xy) for k, xy in curves.items() if k != exact}
    for i, (label, (x, y)) in enumerate(others.items()):
        shown = x > 0 if log_time else np.full(len(x), True)
        line = ("-", "--", "-.", ":")[i % 4]
        colour = look(label, i)["color"]
        axes.plot(x[shown], y[shown], color=colour, linewidth=1.4, linestyle=line, label=label)
    axes.set(xlabel=along, ylabel=quantity, title=title, xscale="log" if log_time else "linear")
    legend_below(figure, 3)
    return figure


def phase_portrait(curves: Curves, position: str, velocity: str, title: str = "Phase portrait") -> Any:
    """Velocity over position; `curves` maps a label to (positions, velocities), later ones on top."""
    figure, axes = figure_of(6.4)
    for i, (label, curve) in enumerate(curves.items()):
        x, y = saved(*curve)
        axes.plot(x, y, color=look(label, i)["color"], linewidth=1 if i == 0 else 2, label=label)
    axes.set(xlabel=position, ylabel=velocity, title=title)
    legend_below(figure)
    return figure


def work_precision(points: Mapping[str, tuple[Sequence[float], Sequence[float]]], title: str = "") -> Any:
    """Error against run time on log axes; `points` maps a label to (run times in s, errors). An error above 1 is drawn at 1, with an
    arrow that points upwards.
    """
    figure, axes = figure_of(8.4, 5.0)
    for i, (label, (times, errors)) in enumerate(points.items()):
        style = look(label, i)
        axes.loglog(times, np.minimum(errors, 1), label=label, **style)
        beyond = np.asarray(times)[np.asarray(errors) > 1]
        axes.plot(beyond, np.full(len(beyond), ABOVE), linestyle="", marker=ARROW, color=style["color"], markersize=9)
    axes.set(xlabel="run time in s", ylabel=f"largest error against the reference ({ARROW}: above 1)", title=title)
    tick_few_decades(axes.xaxis)
    legend_beside(figure)
    return figure


def scaling(curves: Curves, size: str, quantity: str, title: str = "") -> Any:
    """A cost over the size of a problem on log axes; `curves` maps a label to (sizes, costs)."""
    figure, axes = figure_of()
    for i, (label, (x, y)) in enumerate(curves.items()):
        axes.loglog(x, y, label=label, **look(label, i))
    axes.set(xlabel=size, ylabel=quantity, title=title)
    tick_few_decades(axes.xaxis)
    tick_few_decades(axes.yaxis)
    legend_beside(figure)
    return figure


def tuning(history: Any, title: str = "Descent") -> Any:
    """The `history` that `tune` returns: the loss of every start over the steps, and what the parameters did."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.2), layout="constrained", dpi=200)
    left, right = figure.subplots(1, 2)
    losses = np.asarray(history.loss)
    winner = int(np.argmin(np.asarray(history.best)[:, -1]))
    for i, loss in enumerate(losses):
        if i != winner:
            left.plot(loss, color=GREY, linewidth=0.8, alpha=0.7, label="other starts" if i == (winner == 0) else None)
    left.plot(losses[winner], color=COLOURS[0], linewidth=1.2, label="best start")
    left.plot(np.min(np.asarray(history.best), axis=0), "--", color=COLOURS[1], linewidth=1.2, label="best so far")
    left.axhline(losses[winner, 0], color="black", linestyle=":", linewidth=1, label="at the start")
    # Solves that failed are far above the rest, which is what is to be seen; a gain that is small should look so.
    usual = losses[np.isfinite(losses)]
    low, high = usual.min(), max(np.quantile(usual, 0.9), losses[winner, 0])
    span = max(high - low, 0.1 * np.abs(usual).min(), 1e-6)
    left.set(xlabel="step", ylabel="loss", ylim=(low - 0.1 * span, low + 1.2 * span))
    left.set_title(f"{title}: loss {losses[winner, 0]:.4g} → {low:.4g}", fontsize="medium")
    left.legend(frameon=False, fontsize="small")
    for i, (name, path) in enumerate(_leaves(history.params)):
        for j, component in enumerate(np.asarray(path)[winner].reshape(losses.shape[1], -1).T):
            label = name if j == 0 else None
            right.semilogy(component, color=COLOURS[i % len(COLOURS)], linewidth=1.4, label=label)
    right.set(xlabel="step", ylabel="parameters of the best start")
    right.legend(frameon=False, fontsize="small")
    for axes in (left, right):
        axes.grid(alpha=0.3, linewidth=0.5)
    return figure


def _leaves(tree: PyTree) -> list[tuple[str, Any]]:
    """The leaves of a pytree with their names."""
    import jax

    found = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator=".") or "parameter", leaf) for path, leaf in found]
