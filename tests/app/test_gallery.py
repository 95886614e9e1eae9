"""The index of the notebooks, and its thumbnails, are those of the notebooks as they are."""

import importlib.util
import io
from pathlib import Path

import pytest
from PIL import Image


GALLERY = Path(__file__).parents[2] / "notebooks" / "gallery"


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("write_gallery", GALLERY / "write.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_index_is_up_to_date(gallery):
    assert (GALLERY.parent / "README.md").read_text() == gallery.index(), "run `python notebooks/gallery/write.py`"


def test_thumbnails_are_of_the_first_figures(gallery):
    notebooks = gallery.notebooks()
    assert {path.stem for path in GALLERY.glob("*.png")} == set(notebooks)
    for name, notebook in notebooks.items():
        data = (GALLERY / f"{name}.png").read_bytes()
        assert len(data) < 30_000
        small = Image.open(io.BytesIO(data))
        figure = gallery.first_figure(notebook)
        assert small.text["figure"] == gallery.digest(figure), "run `python notebooks/gallery/write.py`"
        large = Image.open(io.BytesIO(figure))
        assert small.width == gallery.WIDTH
        assert small.height == pytest.approx(small.width * large.height / large.width, abs=1)
