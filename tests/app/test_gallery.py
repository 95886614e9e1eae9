"""The indices of notebooks and scenes, and their pictures, are those of the notebooks and scenes as they are."""

import importlib.util
import io
from pathlib import Path

import pytest
from PIL import Image

from dae_jax.app.options import scenes


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


def size_of(picture):
    with Image.open(picture) as image:
        return image.size


def test_thumbnails_are_of_the_first_figures(gallery):
    notebooks = gallery.notebooks()
    assert {path.stem for path in GALLERY.glob("*.png")} == set(notebooks)
    for name, notebook in notebooks.items():
        figure = gallery.first_figure(notebook)
        said = gallery.said(GALLERY / f"{name}.png")["figure"]
        assert said == gallery.digest(figure), "run `python notebooks/gallery/write.py`"
        (width, height), (wide, high) = size_of(GALLERY / f"{name}.png"), size_of(io.BytesIO(figure))
        assert height == pytest.approx(width * high / wide, abs=1)


def test_every_scene_has_its_picture(gallery):
    assert {path.stem for path in (GALLERY / "scenes").glob("*.png")} == set(scenes())
    for path in GALLERY.rglob("*.png"):
        assert path.stat().st_size < 30_000
        with Image.open(path) as image:
            assert max(image.size) == gallery.SIZE
            assert len(image.getcolors(1000)) > 10, "an empty picture"


def test_one_scene_moves(gallery):
    name, t1, _ = gallery.MOVING
    path = GALLERY / f"{name}.gif"
    assert path.stat().st_size < 300_000
    assert f"notebooks/gallery/{name}.gif" in (GALLERY.parents[1] / "README.md").read_text()
    with Image.open(path) as image:
        assert image.n_frames == round(25 * t1) + 1


def test_a_scene_is_solved_and_drawn(gallery):
    drawn, kept = io.BytesIO(gallery.picture("pendulum")), GALLERY / "scenes" / "pendulum.png"
    assert size_of(drawn) == size_of(kept)
    now, then = gallery.said(drawn), gallery.said(kept)
    assert now["method"] == then["method"]
    assert 0.1 < float(now["error"]) / float(then["error"]) < 10
