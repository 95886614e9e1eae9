"""The gallery of the notebooks: `python notebooks/gallery/write.py` writes `notebooks/README.md` and the thumbnails beside this file.

A notebook's title is its first heading, its question the first line in italics, its thumbnail the first of its figures.
"""

import base64
import hashlib
import io
import re
from pathlib import Path
from typing import Any

import nbformat
from PIL import Image
from PIL.PngImagePlugin import PngInfo


HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent
WIDTH = 320  # pixels
HEAD = """# Notebooks

One question each, half a minute to a minute on two cores; their figures are in them.
"""
PAGES = """
## Pages

| | |
|---|---|
| [Which method](which_method.md) | a short list of decisions, and what each method does on one problem |
| [Coming from another solver](coming_from.md) | diffrax, scipy, SUNDIALS, Modelica, MuJoCo: theirs and ours |
| [Errors](errors.md) | each by name: cause, equation, remedy, a program that ends in it |
| [Reference](reference/README.md) | every public name |

This page is written by `python notebooks/gallery/write.py`.
"""


def notebooks() -> dict[str, Any]:
    """{name: notebook}, in order."""
    return {path.stem: nbformat.read(path, as_version=4) for path in sorted(NOTEBOOKS.glob("*.ipynb"))}


def first_figure(notebook: Any) -> bytes:
    """The first figure of a notebook, as a PNG."""
    outputs = (output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))
    return base64.b64decode(next(data["image/png"] for data in outputs if "image/png" in data))
    return base64.b64decode(next(data["image/png"] for data in outputs if "image/png" in data))


def digest(figure: bytes) -> str:
    """By which a thumbnail says of which figure it is."""
    return hashlib.sha256(figure).hexdigest()


def thumbnail(figure: bytes) -> bytes:
    """A figure, small, with its digest in it."""
    image = Image.open(io.BytesIO(figure)).convert("RGB")
    small = image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS)
    said, file = PngInfo(), io.BytesIO()
    said.add_text("figure", digest(figure))
    small.quantize(64).save(file, "PNG", pnginfo=said, optimize=True)
    return file.getvalue()


def index() -> str:
    """The text of `notebooks/README.md`."""
    rows = ["| | |", "|---|---|"]
    for name, notebook in notebooks().items():
        text = notebook.cells[0].source
        title, question = (re.search(p, text, re.MULTILINE)[1] for p in (r"^# (.*)$", r"^\*([^*]+\?)\*$"))
        rows.append(f"| [![{title}](gallery/{name}.png)]({name}.ipynb) | **[{title}]({name}.ipynb)**<br>{question} |")
    return "\n".join([HEAD, *rows, PAGES])


def main() -> None:
    """Writes the index and the thumbnails."""
    for name, notebook in notebooks().items():
        (HERE / f"{name}.png").write_bytes(thumbnail(first_figure(notebook)))
    (NOTEBOOKS / "README.md").write_text(index())


if __name__ == "__main__":
    main()
