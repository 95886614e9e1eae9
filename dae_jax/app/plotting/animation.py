"""A mechanism that moves: inline in a notebook, and as a file."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...diagnostics import drift
from ...scenes import Drawing, Scene
from ...solution import DAESolution
from ...systems import System, is_mechanism
from ...validate.states import brief, refuse_wrong_system
from .camera import Camera
from .film import DPI, figure_at, write_gif, write_mp4
from .motion import FPS, Points, drawing_of, frame_times, motion, saved_states
from .player import inline, page


# The files that an animation can be saved as.
FILM_TYPES = (".html", ".gif", ".mp4")


@dataclasses.dataclass(frozen=True, eq=False)
class Animation:
    """A mechanism at evenly spaced times. A notebook shows it; `save` writes it.

    - `drawing`: what is drawn; `title`: what is said above it.
    - `times`: of the frames, in s; `points`: where the drawing's points are, in m.
    - `fps`: frames in a second of playing, of which a .gif shows 25 at most; `speed`: seconds of the motion in a second of
      playing.
    - `trace`: how much of the paths is shown, in s; `inf` for all until now.
    - `violation`: (saved times, largest violation of the constraints there), or `None`; `violated`: of which, by their
      letter in the documentation.
    """

    drawing: Drawing
    title: str
    times: Float[np.ndarray, " frames"]
    points: Float[np.ndarray, "frames points dimensions"]
    fps: float
    speed: float
    trace: float
    violation: tuple[Float[np.ndarray, " saved"], Float[np.ndarray, " saved"]] | None = None
    violated: str = "g"

    def __post_init__(self) -> None:
        object.__setattr__(self, "drawing", _with_names(self.drawing, self.points.shape[1]))

    def __repr__(self) -> str:
        """What it holds, in a line."""
        played = len(self.times) / self.fps
        length = f"{len(self.times)} frames, {played:.3g} s at speed {self.speed:.3g}"
        return f"Animation({self.title!r}, {length}; save(...) writes it)"

    @property
    def pace(self) -> str:
        """How fast it is played, in words."""
        if abs(self.speed - 1) < 1e-3:
            return "real time"
        return f"{self.speed:.3g} × faster" if self.speed > 1 else f"{1 / self.speed:.3g} × slower"

    @property
    def camera(self) -> Camera | None:
        """Through which what is in space is seen; `None` in the plane."""
        return Camera.around_motion(self.points, self.drawing.down) if self.points.shape[2] == 3 else None

    @property
    def fixed(self) -> list[int]:
        """The points of links and springs that stay where they are."""
        joined = sorted({k for pair in (*self.drawing.links, *self.drawing.springs) for k in pair})
        extent = np.ptp(self.points, axis=(0, 1)).max()
        return [k for k in joined if np.ptp(self.points[:, k], axis=0).max() <= 1e-9 * extent]

    def figure(self, t: float) -> Any:
        """The frame next to the time `t` in s, as a `matplotlib.figure.Figure`."""
        return figure_at(self, int(np.argmin(np.abs(self.times - t))))

    def html(self) -> str:
        """A page that plays it, with all that it needs in it: a slider, keys, the drift; what is in space can be turned."""
        return page(self)

    def save(self, path: str | Path, *, dpi: float = DPI) -> Path:
        """Writes it, by the file's ending: .html, a page of its own; .gif; .mp4, where the program ffmpeg is. `dpi`: dots in an
        inch of the last two, whose frames are up to 6.7 inches wide.

        Errors: `ValueError` for another ending; `RuntimeError` for an mp4 without ffmpeg; `OSError` where none can be written.
        """
        path = Path(path)
        refuse_film_type(path)
        if path.suffix.lower() == ".html":
            path.write_text(self.html(), encoding="utf-8")
        else:
            (write_gif if path.suffix.lower() == ".gif" else write_mp4)(self, path, dpi)
        return path

    def _repr_html_(self) -> str:
        return inline(self)


def animate(
    what: Scene[System] | Drawing | Points,
    sol: DAESolution,
    *,
    system: System | None = None,
    speed: float | None = None,
    fps: float = FPS,
    trace: float | None = None,
    title: str | None = None,
) -> Animation:
    """A solution as a moving mechanism, with its drift off the constraints beside.

    - `what`: a scene, a `scenes.Drawing`, or a function points(t, q) that gives positions in m, (points, 2) or (points, 3).
      q is the position of a mechanism; of any other solution it is the whole state.
    - `sol`: a solution with saved times; between them points are interpolated, or taken from its dense output.
    - `system`: whose drift is shown; by default the scene's, and none without a scene.
    - `speed`: seconds of the motion in a second of playing. By default 1, real time; where that takes less than 1 s or more
      than 120 s, such that it takes 10 s.
    - `trace`: how much of the paths is shown, in s; by default the drawing's `t1`.

    Errors: `TypeError`, `ValueError` for wrong input, and for a solution with fewer than two saved times. An
    `AccuracyWarning` where the saved times are too far apart to tell how it moves between them.
    """
    drawing = drawing_of(what)
    scene = what if isinstance(what, Scene) else None
    for name, value in {"speed": speed, "fps": fps, "trace": trace}.items():
        if value is not None and not (isinstance(value, int | float | np.number) and value > 0 and not np.isnan(value)):
            raise ValueError(f"`{name}` must be positive, but is {brief(value)}.")
    if system is None and scene is not None:
        system = scene.system
    if system is not None:
        refuse_wrong_system(system)
    times, _ = saved_states(sol)
    speed, at = frame_times(times, float(fps), speed)
    found = motion(drawing, sol, system, at)
    violated, violation = ("g", None) if system is None else _violation(system, sol, times)
    return Animation(
        drawing=drawing,
        title=(scene.name if scene else "") if title is None else title,
        times=at,
        points=found,
        fps=float(fps),
        speed=speed,
        trace=float(drawing.t1 if trace is None else trace),
        violation=violation,
        violated=violated,
    )


def refuse_film_type(path: Path) -> None:
    """An ending that no animation can be saved with, and .mp4 without the program that writes it."""
    kind = path.suffix.lower()
    if kind not in FILM_TYPES:
        raise ValueError(
            f"An animation is saved as {', '.join(FILM_TYPES)}, not as {kind or 'a file without an ending'}."
        )
    if kind == ".mp4" and shutil.which("ffmpeg") is None:
        raise RuntimeError(
            "An .mp4 is written by the program ffmpeg, which is not found: install it, or save .html or .gif."
        )


def _with_names(drawing: Drawing, count: int) -> Drawing:
    """A drawing in which something is joined or of interest: else all points are."""
    if drawing.masses or drawing.links or drawing.springs:
        return drawing
    return dataclasses.replace(drawing, masses={f"point {k}": k for k in range(count)})


def _violation(system: System, sol: DAESolution, times: np.ndarray) -> tuple[str, Any]:
    """The letter of the constraints that are shown, and (saved times, their largest violation)."""
    level, violated = 0, "F"
    if is_mechanism(system):
        level, violated = (1, "h") if system.constraint is None else (0, "g")
    off = np.asarray(drift(system, sol).levels[level])
    first = [int(np.flatnonzero(np.asarray(sol.ts) == t)[-1]) for t in times]
    return violated, (times, off[first])
