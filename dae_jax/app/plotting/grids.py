"""Pictures of cells: the incidence matrix of a system, and the map of a sweep."""

from typing import Any

import numpy as np

from ...analyse import Structure
from .common import BLANK, COLOURS, figure_of, legend_below


# Equations and variables of a larger system are drawn without their names.
NAMED = 40


def incidence(structure: Structure, title: str = "Incidence") -> Any:
    """Which variable occurs in which equation of an `analyse`d system: light where it occurs itself, dark where its
    derivative does; framed are the pairs of the transversal, and the labels give the offsets c and d.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Rectangle

    n = len(structure.equations)
    size = min(max(0.26 * n + 2.4, 4.4), 12)
    figure, axes = figure_of(size, size)
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
    for handle, label in zip(shown, labels, strict=True):
        handle.set_label(label)
    legend_below(figure, 3, shown)
    if n <= NAMED:
        named = zip(structure.variables, structure.variable_offsets, strict=True)
        axes.set_xticks(range(n), [f"{name}  d={d}" for name, d in named], rotation=90, fontsize="small")
        named = zip(structure.equations, structure.equation_offsets, strict=True)
        axes.set_yticks(range(n), [f"{name}  c={c}" for name, c in named], fontsize="small")
    axes.set(xlabel="variables", ylabel="equations", title=f"{title}: index {structure.index}")
    return figure


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
    blank: str = "",
) -> Any:
    """Values over a grid as colours, `values[i, j]` at (x[i], y[j]); grey where they are NaN, which `blank` explains.
    `labels`: of x, y and the colours, with units. `log`: log axes; `log_values`: log colours; `mark`: a point to point out.

    The colours span all but the outer two percent of the values, so that a few extreme ones do not hide the rest.
    """
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator

    figure, axes = figure_of(6.4, 5.4)
    axes.set_facecolor(BLANK)
    axes.grid(visible=False)
    values = np.asarray(values, float)
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, (0.02, 0.98)) if known.size else (0.0, 1.0)
    if low == high and known.size:
        low, high = known.min(), known.max()
    norm = LogNorm(low, high) if log_values and 0 < low < high else Normalize(low, high)
    mesh = axes.pcolormesh(x, y, values.T, cmap="viridis_r" if log_values else "viridis", norm=norm, rasterized=True)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_title(title, fontsize="medium")
    if log:
        axes.set(xscale="log", yscale="log")
    if mark is not None:
        axes.plot(*mark, marker="o", markersize=9, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2)
        axes.plot(*mark, marker="o", markersize=5, markerfacecolor="none", markeredgecolor="black")
    extend = ("neither", "max", "min", "both")[2 * bool(np.any(known < low)) + bool(np.any(known > high))]
    ticks = {"ticks": LogLocator(subs=(1, 2, 5)), "format": "%g"} if isinstance(norm, LogNorm) else {}
    figure.colorbar(mesh, ax=axes, label=labels[2], extend=extend, **ticks).minorticks_off()
    if blank and known.size < values.size:
        legend_below(figure, handles=[Patch(color=BLANK, label=blank)])
    return figure
