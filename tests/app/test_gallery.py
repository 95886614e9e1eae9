"""The indices of notebooks and scenes, and their pictures, are those of the notebooks and scenes as they are."""

import importlib.util
import io
from pathlib import Path

import pytest
from PIL import Image

import dae_jax


GALLERY = Path(__file__).parents[2] / "notebooks" / "gallery"


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("write_gallery", GALLERY / "write.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("page", "text"), [("README", "index"), ("scenes", "scenes")])
def test_pages_are_up_to_date(gallery, page, text):
    written = (GALLERY.parent / f"{page}.md").read_text()
    assert written == getattr(gallery, text)(), "run `python notebooks/gallery/write.py`"


def test_thumbnails_are_of_the_first_figures(gallery):
    notebooks = gallery.notebooks()
    assert {path.stem for path in GALLERY.glob("*.png")} == set(notebooks)
    for name, notebook in notebooks.items():
        small = Image.open(GALLERY / f"{name}.png")
        figure = gallery.first_figure(notebook)
        assert small.text["figure"] == gallery.digest(figure), "run `python notebooks/gallery/write.py`"
        large = Image.open(io.BytesIO(figure))
        assert small.height == pytest.approx(small.width * large.height / large.width, abs=1)


def test_every_scene_has_its_picture(gallery):
    assert {path.stem for path in (GALLERY / "scenes").glob("*.png")} == set(dae_jax.scenes.SCENES)
    for path in GALLERY.rglob("*.png"):
        assert path.stat().st_size < 30_000
        small = Image.open(path)
        assert max(small.size) == gallery.SIZE
        assert len(small.getcolors(1000)) > 10, "an empty picture"


def test_a_scene_is_solved_and_drawn(gallery):
    drawn = Image.open(io.BytesIO(gallery.picture("capacitor-loop")))
    kept = Image.open(GALLERY / "scenes" / "capacitor-loop.png")
    assert drawn.size == kept.size
    assert drawn.text["method"] == kept.text["method"]
    assert float(drawn.text["error"]) == pytest.approx(float(kept.text["error"]), rel=0.5)
