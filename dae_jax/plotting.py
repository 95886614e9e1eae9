"""Figures. The only module that imports matplotlib, and only when a figure is drawn.

Every function returns a `matplotlib.figure.Figure` and leaves pyplot's state alone. `curves` maps a label to (x, y).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


Curves = Mapping[str, tuple[np.ndarray, np.ndarray]]

# Okabe and Ito's colours, told apart by colour-blind readers too; markers tell apart what shares a colour or a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX<>*hp"
GREY = "#999999"
# What is below is round-off of round-off; a log axis needs a floor.
FLOOR = 1e-17
# Equations and variables of a larger system are drawn without their names.
NAMED = 40


def _saved(times: Any, *values: Any) -> tuple[np.ndarray, ...]:
    """Times and what belongs to them without the padding of a solve that ended early or saved its steps."""
    kept = np.isfinite(np.asarray(times))
    return tuple(np.asarray(x)[kept] for x in (times, *values))


def _figure(width: float = 7.2, height: float = 4.4) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=200)
    axes = figure.subplots()
    axes.grid(alpha=0.3, linewidth=0.5)
    return figure, axes


def _legend_beside(figure: Any) -> None:
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")


def _legend_below(figure: Any, columns: int = 2) -> None:
    figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def _look(i: int) -> dict[str, Any]:
    """Colour and marker of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)], "markersize": 4, "linewidth": 1.2}


def _marked(axes: Any, curves: Curves) -> None:
    """Curves with a few markers each, at other places for each, so that curves on top of each other can be told apart."""
    for i, (label, (x, y)) in enumerate(curves.items()):
        every = max(len(x) // 8, 1)
        axes.plot(x, y, label=label, markevery=(every * (i + 1) // (len(curves) + 1), every), **_look(i))


def drift(curves: Curves, title: str = "Drift off the constraints", unit: str = "") -> Any:
    """The largest constraint violation until each time, on a log axis; `curves` maps a label to (times, max |g|).

    What is below 1e-17 is drawn there.
    """
    figure, axes = _figure()
    kept = {label: _saved(t, g) for label, (t, g) in curves.items()}
    _marked(axes, {label: (t, np.maximum.accumulate(np.maximum(g, FLOOR))) for label, (t, g) in kept.items()})
    axes.set(xlabel="time in s", ylabel=f"largest |g| so far{unit and ' in ' + unit}", title=title, yscale="log")
    _legend_beside(figure)
    return figure


def drift_growth(curves: Curves, title: str = "", unit: str = "", power: int = 2) -> Any:
    """As `drift`, with both axes logarithmic and a line that grows with a power of time to compare with."""
    figure, axes = _figure()
    for i, (label, (t, g)) in enumerate(curves.items()):
        t, g = (x[1:] for x in _saved(t, g))
        axes.loglog(t, np.maximum(g, FLOOR), color=COLOURS[i % len(COLOURS)], linewidth=1.4, label=label)
        guide = 2 * g[-1] * (t / t[-1]) ** power
        late = t > t[-1] / 30
        axes.loglog(t[late], guide[late], "--", color=GREY, linewidth=1, label=None if i else f"∝ time$^{power}$")
    axes.set(xlabel="time in s", ylabel=f"max |g|{unit and ' in ' + unit}", title=title)
    _legend_below(figure, 4)
    return figure


def energy(curves: Curves, title: str = "Energy", unit: str = "J") -> Any:
    """The largest change of the energy until each time, on a log axis; `curves` maps a label to (times, energies)."""
    figure, axes = _figure()
    change = {}
    for label, curve in curves.items():
        times, values = _saved(*curve)
        change[label] = (times, np.maximum.accumulate(np.maximum(np.abs(values - values[0]), FLOOR)))
    _marked(axes, change)
    axes.set(xlabel="time in s", ylabel=f"largest |E − E(0)| so far in {unit}", title=title, yscale="log")
    _legend_beside(figure)
    return figure


def over_time(
    curves: Curves, quantity: str, title: str = "", exact: str | None = None, along: str = "time in s"
) -> Any:
    """Any quantity over time, or over what `along` says; `quantity` labels its axis, with the unit.

    The curve called `exact` is drawn wide and grey behind the others, so that what agrees with it stays visible.
    """
    figure, axes = _figure()
    if exact is not None:
        axes.plot(*_saved(*curves[exact]), color=GREY, alpha=0.6, linewidth=4, label=exact)
    others = {k: _saved(*xy) for k, xy in curves.items() if k != exact}
    for i, (label, (x, y)) in enumerate(others.items()):
        axes.plot(
            x, y, color=COLOURS[i % len(COLOURS)], linewidth=1.4, linestyle=("-", "--", "-.", ":")[i % 4], label=label
        )
    axes.set(xlabel=along, ylabel=quantity, title=title)
    _legend_below(figure, 3)
    return figure


def phase_portrait(curves: Curves, position: str, velocity: str, title: str = "Phase portrait") -> Any:
    """Velocity over position; `curves` maps a label to (positions, velocities), later ones on top."""
    figure, axes = _figure(6.4)
    for i, (label, curve) in enumerate(curves.items()):
        x, y = _saved(*curve)
        axes.plot(x, y, color=COLOURS[i % len(COLOURS)], linewidth=1 if i == 0 else 2, label=label)
    axes.set(xlabel=position, ylabel=velocity, title=title)
    _legend_below(figure)
    return figure


def trajectory(times: np.ndarray, path: np.ndarray, first: float = 10.0, title: str = "") -> Any:
    """A path in the plane, `path` of shape (times, 2) with y pointing down: until `first` in red, then in black."""
    figure, axes = _figure(5.4, 5.4)
    times, path = _saved(times, path)
    early, late = times <= first, times >= first
    axes.plot(*path[early].T, color="#D00000", linewidth=1.3, zorder=3, label=f"0 to {min(first, times[-1]):g} s")
    if late.sum() > 1:
        axes.plot(*path[late].T, color="black", linewidth=0.4, zorder=2, label=f"{first:g} to {times[-1]:g} s")
    axes.set(xlabel="x in m", ylabel="y in m, downwards", title=title, aspect="equal")
    axes.invert_yaxis()
    _legend_below(figure)
    return figure


def work_precision(points: Mapping[str, tuple[Sequence[float], Sequence[float]]], title: str = "") -> Any:
    """Error against run time on log axes; `points` maps a label to (run times in s, errors)."""
    figure, axes = _figure()
    for i, (label, (times, errors)) in enumerate(points.items()):
        axes.loglog(times, errors, label=label, **_look(i))
    axes.set(xlabel="run time in s", ylabel="largest error against the reference", title=title)
    _legend_beside(figure)
    return figure


def scaling(curves: Curves, size: str, quantity: str, title: str = "") -> Any:
    """A cost over the size of a problem on log axes; `curves` maps a label to (sizes, costs)."""
    figure, axes = _figure()
    for i, (label, (x, y)) in enumerate(curves.items()):
        axes.loglog(x, y, label=label, **_look(i))
    axes.set(xlabel=size, ylabel=quantity, title=title)
    _legend_beside(figure)
    return figure


def incidence(structure: Any, title: str = "Incidence") -> Any:
    """Which variable occurs in which equation of an `analyse`d system: light where it occurs itself, dark where its
    derivative does; framed are the pairs of the transversal, and the labels give the offsets c and d.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Rectangle

    n = len(structure.equations)
    size = min(max(0.26 * n + 2.4, 4.4), 12)
    figure, axes = _figure(size, size)
    axes.grid(visible=False)
    occurs = np.zeros((n, n))
    for i, row in enumerate(structure.signature):
        for j, order in row.items():
            occurs[i, j] = 1 + min(order, 1)
    colours = ["white", COLOURS[5], COLOURS[0]]
    axes.imshow(occurs, cmap=ListedColormap(colours), vmin=0, vmax=2)
    lines = np.arange(n + 1) - 0.5
    axes.hlines(lines, -0.5, n - 0.5, color="white", linewidth=1)
    axes.vlines(lines, -0.5, n - 0.5, color="white", linewidth=1)
    frame = {"fill": False, "edgecolor": COLOURS[1], "linewidth": 1.6, "zorder": 3}
    for i, j in enumerate(structure.transversal):
        axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, **frame))
    shown = [Rectangle((0, 0), 1, 1, color=colour) for colour in colours[1:]] + [Rectangle((0, 0), 1, 1, **frame)]
    labels = ("the variable", "its derivative", "paired")
    figure.legend(shown, labels, loc="outside lower center", ncols=3, frameon=False, fontsize="small")
    if n <= NAMED:
        named = zip(structure.variables, structure.variable_offsets, strict=True)
        axes.set_xticks(range(n), [f"{name}  d={d}" for name, d in named], rotation=90, fontsize="small")
        named = zip(structure.equations, structure.equation_offsets, strict=True)
        axes.set_yticks(range(n), [f"{name}  c={c}" for name, c in named], fontsize="small")
    axes.set(xlabel="variables", ylabel="equations", title=f"{title}: index {structure.index}")
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
    # Solves that failed are far above the rest, which is what is to be seen.
    usual = losses[np.isfinite(losses)]
    low, high = usual.min(), np.quantile(usual, 0.9)
    margin = 0.1 * max(high - low, 1e-6)
    left.set(xlabel="step", ylabel="loss", title=title, ylim=(low - margin, high + 2 * margin))
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


def _leaves(tree: Any) -> list[tuple[str, Any]]:
    """The leaves of a pytree with their names."""
    import jax

    found = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator=".") or "parameter", leaf) for path, leaf in found]


def sweep_map(
    x: np.ndarray,
    y: np.ndarray,
    values: np.ndarray,
    labels: tuple[str, str, str],
    title: str = "",
    *,
    log: bool = False,
    log_values: bool = False,
    mark: tuple[float, float] | None = None,
) -> Any:
    """Values over a grid as colours, `values[i, j]` at (x[i], y[j]); white where they are NaN. `labels`: of x, y and the
    colours, with units. `log`: log axes; `log_values`: log colours; `mark`: a point to point out.
    """
    from matplotlib.colors import LogNorm

    figure, axes = _figure(6.4, 5.2)
    axes.grid(visible=False)
    norm = LogNorm() if log_values and np.nanmin(values) < np.nanmax(values) else None
    mesh = axes.pcolormesh(
        x, y, np.asarray(values).T, cmap="viridis_r" if log_values else "viridis", norm=norm, rasterized=True
    )
    axes.set(xlabel=labels[0], ylabel=labels[1], title=title)
    axes.title.set_fontsize("medium")
    if log:
        axes.set(xscale="log", yscale="log")
    if mark is not None:
        axes.plot(*mark, marker="o", markersize=9, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2)
        axes.plot(*mark, marker="o", markersize=5, markerfacecolor="none", markeredgecolor="black")
    figure.colorbar(mesh, ax=axes, label=labels[2])
    return figure
