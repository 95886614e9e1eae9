"""The galleries: `python notebooks/gallery/write.py` writes `notebooks/README.md` and `notebooks/scenes.md`, with their pictures.

A notebook's title is its first heading, its question the first line in italics, its picture the first of its figures. A
scene is solved and drawn; `python notebooks/gallery/write.py SCENE ...` draws only these again. What a picture shows is in
the picture: of which figure it is, or by which method the scene was solved and how far off. One scene is written as it
moves, too, for the README.
"""

import base64
import hashlib
import inspect
import io
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import nbformat
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import dae_jax
from dae_jax import plotting
from dae_jax.app.compare import chosen, measure, solve
from dae_jax.app.figures import figures
from dae_jax.app.options import scenes as ready


HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent
SIZE = 320  # pixels of the longer side
RTOL = 1e-8
# The scene that moves on the README's page, until when, in s, and with how many dots in an inch.
MOVING = ("double-pendulum", 4.0, 72)
HEAD = """# Notebooks

One question each, half a minute to a minute on two cores; their figures are in them.
"""
PAGES = """
## Pages

| | |
|---|---|
| [Which method](which_method.md) | a short list of decisions, and what each method does, measured |
| [What each method can take](stress.md) | method × stressor, measured: scales, singularities, long times, large steps |
| [Scenes](scenes.md) | ready systems with independent references, solved and drawn |
| [Coming from another solver](coming_from.md) | diffrax, scipy, SUNDIALS, Modelica, MuJoCo: theirs and ours |
| [Errors](errors.md) | each by name: cause, equation, remedy, a program that ends in it |
| [Reference](reference/README.md) | every public name |

This page is written by `python notebooks/gallery/write.py`.
"""
SCENES_HEAD = f"""# Scenes

Ready systems: `dae_jax.scenes.SCENES["pendulum"]()` is one, of bodies and joints `dae_jax.mechanisms.EXAMPLES["engine"]()`, whose
mechanism is there too; `dae-jax compare pendulum` solves one by every method, `dae-jax animate engine` shows it. Each has a
reference that is independent of the library: a closed form, a tight solve in minimal coordinates by scipy, or a published end.
The error is the largest against it, at a tolerance of {RTOL:g}, of all entries, multipliers and accelerations too where they are
unknowns; relative where the solution is larger than the scene's scale.
"""


def notebooks() -> dict[str, Any]:
    """{name: notebook}, in order."""
    return {path.stem: nbformat.read(path, as_version=4) for path in sorted(NOTEBOOKS.glob("*.ipynb"))}


def first_figure(notebook: Any) -> bytes:
    """The first figure of a notebook, as a PNG."""
    outputs = (output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))
    return base64.b64decode(next(data["image/png"] for data in outputs if "image/png" in data))


def digest(figure: bytes) -> str:
    """By which a thumbnail says of which figure it is."""
    return hashlib.sha256(figure).hexdigest()


def thumbnail(figure: bytes, /, **words: str) -> bytes:
    """A figure, small, with what is said of it in it."""
    image = Image.open(io.BytesIO(figure)).convert("RGB")
    scale = SIZE / max(image.size)
    small = image.resize((round(scale * image.width), round(scale * image.height)), Image.Resampling.LANCZOS)
    info, file = PngInfo(), io.BytesIO()
    for key, value in words.items():
        info.add_text(key, value)
    coloured = small.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    coloured.save(file, "PNG", pnginfo=info, optimize=True)
    return file.getvalue()


def said(picture: Path | io.BytesIO) -> dict[Any, Any]:
    """What is said in a picture of what it shows."""
    with Image.open(picture) as image:
        image.load()
        return dict(image.info)


def index() -> str:
    """The text of `notebooks/README.md`."""
    rows = ["| | |", "|---|---|"]
    for name, notebook in notebooks().items():
        text = notebook.cells[0].source
        title, question = (re.findall(pattern, text, re.MULTILINE)[0] for pattern in (r"^# (.*)$", r"^\*([^*]+\?)\*$"))
        rows.append(f"| [![{title}](gallery/{name}.png)]({name}.ipynb) | **[{title}]({name}.ipynb)**<br>{question} |")
    return "\n".join([HEAD, *rows, PAGES])


def method_of(scene: Any) -> str:
    """By which method a scene is drawn: the one that the README recommends first for its kind."""
    return "projection-dop853" if isinstance(scene.system, dae_jax.ConstrainedSystem) else "radau"


def picture(name: str) -> bytes:
    """A scene, solved and drawn."""
    scene = ready()[name]()
    method = method_of(scene)
    row, sol = measure(scene, method, chosen(scene, [method])[method], scene.times(scene.t1, 501), RTOL)
    if sol is None:
        raise RuntimeError(f"{name} by {method}: {row.reason}")
    drawn = dict(figures(scene, [row], [], {method: sol}, RTOL, paper=False))
    file = io.BytesIO()
    (drawn.get("mechanism") or drawn[f"solution-{method}"])().savefig(file, format="png")
    return thumbnail(file.getvalue(), method=method, error=f"{row.error:.0e}")


def film(name: str, t1: float) -> plotting.Animation:
    """A scene as it moves."""
    scene = ready()[name]()
    method = method_of(scene)
    times = np.linspace(0, t1, round(50 * t1) + 1)
    return plotting.animate(scene, solve(scene, chosen(scene, [method])[method], times, RTOL))


def scenes() -> str:
    """The text of `notebooks/scenes.md`, of the pictures as they are."""
    end = "This page is written by `python notebooks/gallery/write.py`."
    return "\n".join([SCENES_HEAD, "| | |", "|---|---|", *_scene_rows(), "", end, ""])


def _scene_rows() -> Iterator[str]:
    for name, make in ready().items():
        function = getattr(make, "func", make)
        about = (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ").replace("|", r"\|").rstrip(":")
        shown = said(HERE / "scenes" / f"{name}.png")
        page = function.__module__.split(".")[1]
        links = f"[`{function.__name__}`](reference/{page}.md#{page}{function.__name__})"
        yield (
            f"| ![{name}](gallery/scenes/{name}.png) | **{name}**, {links}, index {make().index}<br>{about}<br>"
            f"By `{shown['method']}`: error {shown['error']} |"
        )


def main() -> None:
    """Writes both pages and their pictures."""
    jax.config.update("jax_enable_x64", True)
    for name, notebook in notebooks().items():
        figure = first_figure(notebook)
        (HERE / f"{name}.png").write_bytes(thumbnail(figure, figure=digest(figure)))
    (NOTEBOOKS / "README.md").write_text(index())
    for name in sys.argv[1:] or ready():
        print(name, file=sys.stderr, flush=True)
        (HERE / "scenes" / f"{name}.png").write_bytes(picture(name))
        if name == MOVING[0]:
            film(*MOVING[:2]).save(HERE / f"{name}.gif", dpi=MOVING[2])
    (NOTEBOOKS / "scenes.md").write_text(scenes())


if __name__ == "__main__":
    main()
