"""An animation as one page of html that needs nothing else: `player.html`, with the data in it."""

import base64
import html
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from .film import joints, paths


if TYPE_CHECKING:
    from .animation import Animation

# Pixels of a notebook's view.
WIDTH, HEIGHT = 720, 560


def page(film: "Animation") -> str:
    """The page."""
    text = Path(__file__).with_name("player.html").read_text(encoding="utf-8")
    title = html.escape(film.title or "animation")
    # What would end the script element cannot be in it.
    data = json.dumps(_data(film), ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    return text.replace("{{title}}", title, 1).replace("{{data}}", data, 1)


def inline(film: "Animation") -> str:
    """The page in a frame of its own, for a notebook."""
    style = f"width:100%;max-width:{WIDTH}px;height:{HEIGHT}px;border:0"
    return f'<iframe srcdoc="{html.escape(page(film))}" style="{style}" title="{html.escape(film.title)}"></iframe>'


def _data(film: "Animation") -> dict[str, Any]:
    drawing, camera = film.drawing, film.camera
    step = (film.times[-1] - film.times[0]) / (len(film.times) - 1)
    data: dict[str, Any] = {
        "title": film.title,
        "pace": film.pace,
        "t0": float(film.times[0]),
        "dt": float(step),
        "fps": film.fps,
        "shape": film.points.shape,
        "points": _packed(film.points),
        "links": drawing.links,
        "springs": drawing.springs,
        "masses": paths(film),
        "fixed": film.fixed,
        "joints": joints(film),
        "down": drawing.down,
        "axes": drawing.axes,
        "trace": film.trace if np.isfinite(film.trace) else None,
    }
    if camera is not None:
        data["ground"] = camera.ground
    if film.violation is not None:
        times, values = film.violation
        data["drift"] = {"of": film.violated, "t": _packed(times), "g": _packed(values)}
    return data


def _packed(numbers: Float[np.ndarray, "..."]) -> str:
    """As float32, little endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(numbers, "<f4").tobytes()).decode()
