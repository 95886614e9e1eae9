"""An animation as pictures: one frame as a figure, all of them as .gif or .mp4."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from .camera import Camera, extent
from .common import BLANK, COLOURS, GREY, legend_below
from .plane import draw_ground


if TYPE_CHECKING:
    from .animation import Animation

    Pixels = UInt8[np.ndarray, "height width 4"]

# Dots in an inch of a film; its widths and heights are even, as codecs want them. A gif has so many frames in a second.
DPI, GIF_FPS = 100, 25
INK = "#333333"
COILS = 7


class Stage:
    """A figure of an animation: what stands still drawn once, and what moves put in place frame by frame."""

    def __init__(self, animation: "Animation", dpi: float = DPI) -> None:
        self.film, self.dpi = animation, dpi
        camera = animation.camera
        self.seen = animation.points if camera is None else camera(animation.points)[..., :2]
        self.shadows = None if camera is None else camera(camera.shadow(animation.points))[..., :2]
        self.figure, self.axes, self.strip = self._figure()
        self.moving: list[Any] = []
        self._still(camera)
        self._movable()

    def _figure(self) -> tuple[Any, Any, Any]:
        """Axes that the motion fills at equal scales, and below them those of the drift."""
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        camera = self.film.camera
        around = self.seen.reshape(-1, 2)
        if camera is not None:
            around = np.concatenate([around, camera.around()])
        low, high = around.min(0), around.max(0)
        whole = extent(around)
        size = np.maximum(high - low, 0.3 * whole) + 0.1 * whole
        size[0] = max(size[0], 0.8 * size[1])  # the title and the time side by side
        middle = (low + high) / 2
        width, height = size * min(6.0 / size[0], 4.6 / size[1])
        strip = self.film.violation is not None
        inches = (width + 0.7, height + 1.2 + 1.1 * strip)
        even = np.round(np.array(inches) * self.dpi / 2) * 2 / self.dpi
        figure = Figure(figsize=(even[0], even[1]), layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1), dpi=self.dpi)
        rows = figure.subplots(1 + strip, 1, squeeze=False, height_ratios=[height, 0.9][: 1 + strip])[:, 0]
        axes = rows[0]
        limits = np.stack([middle - size / 2, middle + size / 2])
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1], aspect="equal")
        axes.set_title(self.film.title, loc="left", fontsize="medium", fontweight="bold")
        return figure, axes, rows[1] if strip else None

    def _still(self, camera: Camera | None) -> None:
        """What does not move: the axes or the ground, the drift, the legend."""
        drawing, axes = self.film.drawing, self.axes
        if camera is None:
            axes.grid(alpha=0.3, linewidth=0.5)
            axes.set(xlabel=drawing.axes[0], ylabel=drawing.axes[1])
            if drawing.down:
                axes.invert_yaxis()
        else:
            draw_ground(axes, camera)
        names = [axes.plot([], [], "o", color=c, label=n)[0] for n, _, c in paths(self.film)]
        if self.film.violation is not None:
            self._draw_drift(self.strip, *self.film.violation)
        if names:
            legend_below(self.figure, min(len(names), 4), names)

    def _draw_drift(self, strip: Any, times: Float[np.ndarray, " saved"], values: Float[np.ndarray, " saved"]) -> None:
        strip.grid(alpha=0.3, linewidth=0.5)
        strip.set(xlabel="time in s", xlim=(times[0], times[-1]), ylabel=f"max |{self.film.violated}|")
        if np.any(values > 0):
            low, high = decades(values)
            # What is exactly 0 lies on the axis.
            strip.plot(times, np.maximum(values, low), color=INK, linewidth=0.9, zorder=2)
            strip.set(yscale="log", ylim=(low, high))
        else:
            words = "exactly 0" if np.isfinite(values).all() else "not a number"
            strip.text(0.5, 0.5, words, transform=strip.transAxes, ha="center", va="center", color=GREY)
            strip.set_yticks([])

    def _movable(self) -> None:
        from matplotlib.collections import LineCollection

        axes, drawing = self.axes, self.film.drawing
        add = lambda where, *args, **style: self._moving(where.plot(*args, **style)[0])
        pairs = (*drawing.links, *drawing.springs)
        self.shades = [add(axes, [], [], color=BLANK, linewidth=2.5) for _ in pairs if self.shadows is not None]
        self.trails = []
        for _, _, colour in paths(self.film):
            trail = LineCollection([], colors=colour, linewidths=1.5, capstyle="butt")
            self.trails.append(self._moving(axes.add_collection(trail, autolim=False)))
        style = {"color": INK, "solid_capstyle": "round", "solid_joinstyle": "round"}
        self.links = [add(axes, [], [], linewidth=3.2, **style) for _ in drawing.links]
        self.springs = [add(axes, [], [], linewidth=1.3, **style) for _ in drawing.springs]
        # In space a triangle on the end of a rod would be an arrow.
        flat = self.shadows is None
        self.pivots = add(axes, [], [], "^" if flat else "s", color="black", markersize=10 if flat else 7)
        self.joints = add(axes, [], [], "o", color="white", markeredgecolor=INK, markeredgewidth=1.4, markersize=6)
        dots = [add(axes, [], [], "o", color=c, markeredgecolor="white", markersize=11) for _, _, c in paths(self.film)]
        self.masses = dots
        still = {"fontsize": "small", "color": INK, "family": "monospace", "ha": "right", "va": "bottom"}
        self.clock = self._moving(axes.text(1, 1.015, "", transform=axes.transAxes, **still))
        if self.strip is not None:
            self.now = add(self.strip, [], [], color=COLOURS[1], linewidth=1.4)
            self.dot = add(self.strip, [], [], "o", color=COLOURS[1], markersize=5)

    def _moving(self, artist: Any) -> Any:
        self.moving.append(artist)
        return artist

    def place(self, k: int) -> None:
        """Puts what moves where it is in the frame `k`."""
        film, at = self.film, self.seen[k]
        drawing = film.drawing
        pairs = (*drawing.links, *drawing.springs)
        for line, pair in zip(self.shades, pairs, strict=False):
            assert self.shadows is not None
            line.set_data(*self.shadows[k, list(pair)].T)
        for line, pair in zip(self.links, drawing.links, strict=True):
            line.set_data(*at[list(pair)].T)
        width = 0.025 * float(np.ptp(self.axes.get_xlim()))
        for line, (a, b) in zip(self.springs, drawing.springs, strict=True):
            line.set_data(*coil(at[a], at[b], width).T)
        self.pivots.set_data(*at[film.fixed].T)
        self.joints.set_data(*at[joints(film)].T)
        self._place_masses(k)
        self.clock.set_text(f"{film.pace}   t = {time_of(film, k)} s")
        if self.strip is not None:
            low, high = self.strip.get_ylim()
            self.now.set_data([film.times[k]] * 2, [low, high])
            times, values = film.violation or ((), ())
            nearest = np.argmin(np.abs(times - film.times[k]))
            self.dot.set_data([film.times[k]], [np.maximum(values[nearest], low)])

    def _place_masses(self, k: int) -> None:
        film = self.film
        first = max(0, k - int(min(film.trace * film.fps / film.speed, len(film.times))))
        for (_, mass, colour), dot, trail in zip(paths(film), self.masses, self.trails, strict=True):
            path = self.seen[first : k + 1, mass]
            dot.set_data(*path[-1:].T)
            trail.set_segments(np.stack([path[:-1], path[1:]], 1) if len(path) > 1 else [])
            fading = np.isfinite(film.trace)
            strength = np.linspace(0.05, 0.9, len(path) - 1) if fading else np.full(len(path) - 1, 0.6)
            trail.set_color([(colour, alpha) for alpha in strength])

    def frames(self, every: int = 1) -> "Iterator[Pixels]":
        """The first frame and every so many after it; what stands still is drawn once."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.figure)
        self.place(0)
        canvas.draw()
        self.figure.set_layout_engine("none")
        for artist in self.moving:
            artist.set_animated(True)
        canvas.draw()
        still = canvas.copy_from_bbox(self.figure.bbox)
        for k in range(0, len(self.film.times), every):
            canvas.restore_region(still)
            self.place(k)
            for artist in sorted(self.moving, key=lambda a: a.get_zorder()):
                artist.axes.draw_artist(artist)
            yield np.asarray(canvas.buffer_rgba()).copy()


def paths(film: "Animation") -> list[tuple[str, int, str]]:
    """Name, point and colour of what is of interest."""
    return [(name, k, COLOURS[i % len(COLOURS)]) for i, (name, k) in enumerate(film.drawing.masses.items())]


def joints(film: "Animation") -> list[int]:
    """The points where bodies or springs meet, that are neither fixed nor of interest."""
    ends = [k for pair in (*film.drawing.links, *film.drawing.springs) for k in pair]
    other = {*film.fixed, *film.drawing.masses.values()}
    return sorted({k for k in ends if ends.count(k) > 1} - other)


def decades(values: Float[np.ndarray, " saved"]) -> tuple[float, float]:
    """Whole powers of ten around the values that are positive, two at least."""
    exponents = np.log10(values[(values > 0) & np.isfinite(values)])
    low, high = np.floor(exponents.min()), np.ceil(exponents.max())
    return 10.0**low, 10.0 ** max(high, low + 2)


def coil(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"], width: float) -> Float[np.ndarray, "corners 2"]:
    """A spring from one point to another, as a zigzag with straight ends."""
    along = b - a
    across = np.array([-along[1], along[0]]) / (np.linalg.norm(along) or 1.0)
    place = np.r_[0, np.linspace(0.15, 0.85, 2 * COILS + 2), 1]
    side = np.r_[0, 0, np.tile([1, -1], COILS), 0, 0]
    return a + place[:, None] * along + width * side[:, None] * across


def time_of(film: "Animation", k: int) -> str:
    """The time of a frame, with as many digits as tell frames apart; the width is that of the longest."""
    digits = max(0, int(np.ceil(-np.log10(film.speed / film.fps))))
    width = max(len(f"{t:.{digits}f}") for t in film.times[[0, -1]])
    return f"{film.times[k]:{width}.{digits}f}"


def figure_at(film: "Animation", k: int) -> Any:
    """The frame `k` as a figure."""
    stage = Stage(film, 2 * DPI)
    stage.place(k)
    return stage.figure


def write_gif(film: "Animation", path: Path, dpi: float) -> None:
    """Every so many frames, with colours in common, each shown for as long as it takes on average: a gif counts in 0.01 s."""
    from PIL import Image

    every = int(np.ceil(film.fps / GIF_FPS))
    colours = _tints({"#000000", INK, GREY, COLOURS[1], *(colour for _, _, colour in paths(film))})
    nearest = _nearest(colours)
    pictures = []
    for pixels in Stage(film, dpi).frames(every):
        red, green, blue = np.moveaxis(pixels[..., :3] >> 3, -1, 0)
        pictures.append(Image.fromarray(nearest[red, green, blue]))
        pictures[-1].putpalette(colours.ravel().tolist())
    first, *others = pictures
    ends = np.round(100 * every / film.fps * np.arange(len(pictures) + 1)).astype(int)
    durations = (10 * np.maximum(np.diff(ends), 1)).tolist()
    first.save(path, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def _tints(colours: set[str], steps: int = 12) -> UInt8[np.ndarray, "colours 3"]:
    """White, and colours from faint to full: all that is drawn, smoothed at its edges."""
    full = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in sorted(colours)])
    share = np.arange(1, steps + 1)[:, None, None] / steps
    return np.r_[[[255, 255, 255]], np.round(255 + share * (full - 255)).reshape(-1, 3)].astype(np.uint8)


def _nearest(colours: UInt8[np.ndarray, "colours 3"]) -> UInt8[np.ndarray, "32 32 32"]:
    """Which colour is nearest to red, green and blue of five bits each."""
    level = np.arange(32) * 255 / 31
    squares = (level[:, None] - colours.T[:, None, :]) ** 2
    distance = squares[0][:, None, None] + squares[1][None, :, None] + squares[2][None, None, :]
    return np.argmin(distance, -1).astype(np.uint8)


def write_mp4(film: "Animation", path: Path, dpi: float) -> None:
    """All frames, by ffmpeg."""
    stage = Stage(film, dpi)
    width, height = (round(x * dpi) for x in stage.figure.get_size_inches())
    command = (
        f"ffmpeg -loglevel error -y -f rawvideo -pix_fmt rgba -s {width}x{height} -r {film.fps} -i - -an -pix_fmt yuv420p "
        "-movflags +faststart"
    )
    with subprocess.Popen([*command.split(), str(path)], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # what ended it is in what it says
            for pixels in stage.frames():
                ffmpeg.stdin.write(pixels.tobytes())
        said = ffmpeg.communicate()[1].decode()
    if ffmpeg.returncode:
        raise OSError(f"ffmpeg could not write {path}: {said.strip()}")
