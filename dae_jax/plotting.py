"""Figures. The only module that imports matplotlib, and only when a figure is drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


# Okabe and Ito's colours, told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")


def _figure(width: float = 6.4, height: float = 4.0) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    axes = figure.subplots()
    axes.grid(alpha=0.3, linewidth=0.5)
    return figure, axes


def _curves(
    axes: Any, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], plot: str, floor: float | None = None
) -> None:
    for i, (label, (x, y)) in enumerate(curves.items()):
        y = np.asarray(y) if floor is None else np.maximum(y, floor)
        style = "-" if i < len(COLOURS) else "--"
        getattr(axes, plot)(np.asarray(x), y, style, color=COLOURS[i % len(COLOURS)], linewidth=1.2, label=label)


def drift(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], title: str = "Drift off the constraints") -> Any:
    """The largest constraint violation max |g| over time on a log axis; `curves` maps a label to (times, drift).

    What is below 1e-17 is drawn there.
    """
    figure, axes = _figure(7.2)
    _curves(axes, curves, "semilogy", 1e-17)
    axes.set(xlabel="time in s", ylabel="max |g|", title=title)
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure


def over_time(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], quantity: str, title: str = "") -> Any:
    """Any quantity over time; `quantity` labels its axis, with the unit."""
    figure, axes = _figure(7.2)
    _curves(axes, curves, "plot")
    axes.set(xlabel="time in s", ylabel=quantity, title=title)
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure


def phase_portrait(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], position: str, velocity: str) -> Any:
    """Velocity over position; `curves` maps a label to (positions, velocities)."""
    figure, axes = _figure()
    _curves(axes, curves, "plot")
    axes.set(xlabel=position, ylabel=velocity, title="Phase portrait")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    return figure


def trajectory(times: np.ndarray, path: np.ndarray, first: float = 10.0, title: str = "") -> Any:
    """A path in the plane, `path` of shape (times, 2) with y pointing down: until `first` in red, then in black."""
    figure, axes = _figure(5.0, 5.0)
    early = np.asarray(times) <= first
    late = np.asarray(times) >= first
    if late.sum() > 1:
        axes.plot(*path[late].T, color="black", linewidth=0.4, label=f"{first:g} to {times[-1]:g} s")
    axes.plot(*path[early].T, color="#D00000", linewidth=1.2, label=f"0 to {min(first, times[-1]):g} s")
    axes.set(xlabel="x in m", ylabel="y in m", title=title, aspect="equal")
    axes.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize="small")
    return figure


def work_precision(points: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> Any:
    """Error against run time on log axes; `points` maps a label to (run times in s, errors)."""
    figure, axes = _figure(7.2)
    for i, (label, (times, errors)) in enumerate(points.items()):
        axes.loglog(times, errors, "o-", color=COLOURS[i % len(COLOURS)], markersize=3, linewidth=1, label=label)
    axes.set(xlabel="run time in s", ylabel="error", title="Work and precision")
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure
