"""A mechanism at a few times, and paths."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .camera import Camera
from .common import BLANK, COLOURS, GREY, figure_around, legend_below, saved


def trajectory(times: np.ndarray, path: np.ndarray, first: float = 10.0, title: str = "") -> Any:
    """A path in the plane, `path` of shape (times, 2) with y pointing down: until `first` in red, then in black."""
    times, path = saved(times, path)
    figure, axes = figure_around(*path.T)
    early, late = times <= first, times >= first
    axes.plot(*path[early].T, color="#D00000", linewidth=1.3, zorder=3, label=f"0 to {min(first, times[-1]):g} s")
    if late.sum() > 1:
        axes.plot(*path[late].T, color="black", linewidth=0.4, zorder=2, label=f"{first:g} to {times[-1]:g} s")
    axes.set(xlabel="x in m", ylabel="y in m, downwards", title=title)
    axes.invert_yaxis()
    legend_below(figure)
    return figure


def mechanism(
    times: np.ndarray,
    points: np.ndarray,
    masses: Mapping[str, int],
    links: Sequence[tuple[int, int]] = (),
    springs: Sequence[tuple[int, int]] = (),
    *,
    down: bool = False,
    axes_labels: tuple[str, ...] = ("x in m", "y in m", "z in m"),
    title: str = "",
    shown: int = 6,
) -> Any:
    """A mechanism at a few times, light to dark, and the paths of its masses.

    `points` has the shape (times, points, 2), or (times, points, 3) in space, seen in perspective; `masses` names those whose
    paths are drawn; `links` and `springs` are pairs of points; `down`: whether the last coordinate points down. Points that
    stay where they are, are marked as pivots.
    """
    from matplotlib.lines import Line2D

    times, points = np.asarray(times), np.asarray(points)
    camera = None
    if points.shape[2] == 3:
        camera = Camera.around_motion(points, down)
        points, down = camera(points)[..., :2], False
    around = points.reshape(-1, 2) if camera is None else camera.around()
    figure, axes = figure_around(around[:, 0], around[:, 1])
    paths, ends = [], []
    for i, (name, k) in enumerate(masses.items()):
        paths += axes.plot(*points[:, k].T, color=COLOURS[i % len(COLOURS)], linewidth=1, zorder=2, label=name)
    moments = np.unique(np.linspace(0, len(times) - 1, shown).round().astype(int))
    for place, at in enumerate(moments):
        grey = str(0.8 * (1 - place / max(len(moments) - 1, 1)))
        for pair in (*links, *springs):
            style = {"linestyle": "-" if pair in links else ":", "linewidth": 2, "zorder": 1 + at / len(times)}
            axes.plot(*points[at, list(pair)].T, color=grey, **style)
        for i, k in enumerate(masses.values()):
            colour = COLOURS[i % len(COLOURS)]
            axes.plot(*points[at, k], "o", color=grey, markeredgecolor=colour, markersize=6, zorder=3)
        if at in (moments[0], moments[-1]):
            ends.append(Line2D([], [], color=grey, marker="o", linewidth=2, label=f"at {times[at]:.3g} s"))
    joined = sorted({k for pair in (*links, *springs) for k in pair})
    still = [k for k in joined if np.ptp(points[:, k], axis=0).max() <= 1e-12]
    if still:
        paths += axes.plot(*points[0, still].T, "^", color="black", markersize=9, zorder=4, label="fixed")
    if camera is None:
        axes.set(xlabel=axes_labels[0], ylabel=axes_labels[1])
    else:
        draw_ground(axes, camera)
    axes.set_title(title, fontsize="medium")
    if down:
        axes.invert_yaxis()
    legend_below(figure, min(len(paths + ends), 4), paths + ends)
    return figure


def draw_ground(axes: Any, camera: Camera) -> None:
    """A grid on the ground in place of axes, and how wide its cells are."""
    step, lines = camera.grid()
    for line in lines[..., :2]:
        axes.plot(*line.T, color=BLANK, linewidth=0.8, zorder=0)
    axes.set_axis_off()
    axes.text(0, 0, f"grid {step:g} m", transform=axes.transAxes, color=GREY, fontsize="small", va="bottom")
