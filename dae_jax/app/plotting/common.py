"""Colours, markers, figures and legends that all pictures share."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax import Array


Numbers = np.ndarray | Array
Curves = Mapping[str, tuple[Numbers, Numbers]]

# Okabe and Ito's colours, told apart by colour-blind readers too; markers tell apart what shares a colour or a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX<>*hp"
# The methods that `dae-jax compare` knows keep their colour and marker, whatever else is in a figure. The colours stay
# apart under red- and green-blindness too.
METHODS = {
    "differentiation": ("#D55E00", "o"),
    "differentiation-fixed": ("#E69F00", "s"),
    "baumgarte": ("#009E73", "D"),
    "projection-euler": ("#56B4E9", "^"),
    "projection-tsit5": ("#0072B2", "v"),
    "projection-dop853": ("#161280", "P"),
    "symmetric-trapezoid": ("#32DC74", "X"),
    "symmetric-gauss4": ("#682C00", "<"),
    "tangent-space": ("#CC79A7", ">"),
    "rattle": ("#DC0A45", "*"),
    "radau-ggl": ("#000000", "p"),
    "radau-variable-ggl": ("#785870", "H"),
    "radau-index-2": ("#533161", "d"),
    "radau-index-3": ("#9167FF", "h"),
    "bdf-ggl": ("#5200F8", "1"),
    "dummy-derivatives": ("#1703B0", "x"),
    "state-space": ("#791037", "+"),
    "radau": ("#000000", "p"),
    "radau-variable": ("#785870", "H"),
    "bdf": ("#5200F8", "1"),
}
# So far apart are the ends of an axis on which there is room for three ticks a decade.
FEW_DECADES = 300
GREY = "#999999"
BLANK = "#DDDDDD"
# The files that a figure can be saved as.
FILE_TYPES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".eps", ".ps", ".tif", ".tiff", ".webp")


def saved(times: Numbers, *values: Numbers) -> tuple[np.ndarray, ...]:
    """Times and what belongs to them without the padding of a solve that ended early or saved its steps."""
    kept = np.isfinite(np.asarray(times))
    return tuple(np.asarray(x)[kept] for x in (times, *values))


def figure_of(width: float = 7.2, height: float = 4.4) -> tuple[Any, Any]:
    """A figure of so many inches and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=200)
    axes = figure.subplots()
    axes.grid(alpha=0.3, linewidth=0.5)
    return figure, axes


def figure_around(x: np.ndarray, y: np.ndarray, largest: float = 5.4) -> tuple[Any, Any]:
    """A figure that points in the plane fill, at equal scales."""
    (left, right), (low, high) = ((np.nanmin(values), np.nanmax(values)) for values in (x, y))
    margin = 0.04 * max(right - left, high - low)
    width, height = right - left + 2 * margin, high - low + 2 * margin
    scale = largest / max(width, height)
    figure, axes = figure_of(max(scale * width, 2.4) + 0.9, max(scale * height, 1.2) + 1.4)
    axes.set(xlim=(left - margin, right + margin), ylim=(low - margin, high + margin), aspect="equal")
    return figure, axes


def tick_few_decades(axis: Any) -> None:
    """A logarithmic axis of few decades has ticks at 1, 2 and 5 times the powers of ten: by default it has all of them from 2 to 6, on
    top of each other.
    """
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    if high < FEW_DECADES * low:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def legend_beside(figure: Any, handles: Sequence[Any] | None = None) -> None:
    """A legend outside the axes, of all that has a label or of the handles given."""
    figure.legend(handles=handles, loc="outside right upper", frameon=False, fontsize="small")


def legend_below(figure: Any, columns: int = 2, handles: Sequence[Any] | None = None) -> None:
    """The same, below the axes."""
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def look(label: str, i: int) -> dict[str, Any]:
    """Colour and marker of a method, the same in every figure; of any other curve by its place. What follows a comma or a
    colon in the label is about the method.
    """
    method = re.split("[,:]", label)[0]
    colour, marker = METHODS.get(method, (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]))
    return {"color": colour, "marker": marker, "markersize": 5, "linewidth": 1.2}
