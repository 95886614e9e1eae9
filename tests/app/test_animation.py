"""Animations: what is where at which time, what is in a page, and what a notebook shows."""

import base64
import dataclasses
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import dae_jax
from dae_jax import plotting
from dae_jax.app.cli import main
from dae_jax.app.compare import methods, solve
from dae_jax.app.plotting import animation as animations
from dae_jax.app.plotting.camera import Camera, nice
from dae_jax.app.plotting.film import coil
from dae_jax.scenes import SCENES, Drawing


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def solution(name: str, times) -> tuple[Any, Any]:
    scene = SCENES[name]()
    return scene, solve(scene, methods(scene)["projection-tsit5"], np.asarray(times), 1e-10)


@pytest.fixture(scope="module")
def double():
    return solution("double-pendulum", np.linspace(0, 2, 81))


@pytest.fixture(scope="module")
def film(double):
    scene, sol = double
    return plotting.animate(scene, sol)


@pytest.fixture(scope="module")
def spherical():
    scene, sol = solution("spherical-pendulum", np.linspace(0, 2, 41))
    return plotting.animate(scene, sol, title="in <space> & </script>")


# Where points are, and when


@pytest.mark.parametrize("name", ["moving-pivot-pendulum", "spherical-pendulum"])
def test_points_are_where_an_independent_solution_has_them(name):
    scene, sol = solution(name, np.linspace(0, 2, 81))
    film = plotting.animate(scene, sol)
    np.testing.assert_allclose(film.times, np.arange(101) / 50, atol=1e-12)
    expected = jax.vmap(scene.drawing.points)(film.times, scene.reference(film.times)[0])
    # Cubics over 25 ms: the fourth derivative is of the order of 10⁴ m/s⁴, times h⁴/384.
    np.testing.assert_allclose(film.points, expected, atol=2e-5)


def test_dense_output_is_taken_where_it_is():
    scene: Any = SCENES["pendulum"]()
    sol = dae_jax.daesolve(
        scene.system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 1.0, None, scene.y0,
        saveat=diffrax.SaveAt(ts=jnp.array([0.0, 1.0]), dense=True), max_steps=300,
    )  # fmt: skip
    film = plotting.animate(scene, sol)
    expected = jax.vmap(scene.drawing.points)(film.times, scene.reference(film.times)[0])
    np.testing.assert_allclose(film.points, expected, atol=1e-6)


def test_saved_steps_and_their_padding_are_no_frames(double):
    scene, _ = double
    sol = dae_jax.daesolve(
        scene.system, dae_jax.OrthogonalProjection(diffrax.Dopri8()), 0.0, 2.0, None, scene.y0,
        saveat=diffrax.SaveAt(steps=True, t0=True), max_steps=300,
    )  # fmt: skip
    assert not np.isfinite(sol.ts).all()
    film = plotting.animate(scene, sol)
    assert film.times[-1] == pytest.approx(2.0)
    expected = jax.vmap(scene.drawing.points)(film.times, scene.reference(film.times)[0])
    np.testing.assert_allclose(film.points, expected, atol=2e-3)


def test_a_solution_backwards_in_time_runs_backwards(double):
    scene, sol = double
    back = dataclasses.replace(sol, ts=sol.ts[::-1], ys=jax.tree.map(lambda y: y[::-1], sol.ys))
    forth, film = plotting.animate(scene, sol), plotting.animate(scene, back)
    assert film.times[0] == 2.0
    np.testing.assert_allclose(film.points, forth.points[::-1], atol=1e-9)


def test_speed_is_real_time_unless_that_takes_no_time_or_for_ever(film):
    assert (film.speed, film.pace, len(film.times)) == (1.0, "real time", 101)
    assert animations.frame_times([0.0, 0.03], 50, None)[0] == pytest.approx(0.003)
    assert animations.frame_times([0.0, 1e6], 50, None)[0] == pytest.approx(1e5)
    speed, times = animations.frame_times([5.0, 7.0], 10, 0.5)
    assert speed == 0.5
    np.testing.assert_allclose(times, 5 + 0.05 * np.arange(41))


def test_the_drift_is_that_of_the_saved_states(double, film):
    scene, sol = double
    times, values = film.violation
    np.testing.assert_array_equal(times, sol.ts)
    np.testing.assert_array_equal(values, dae_jax.drift(scene.system, sol).position)
    assert plotting.animate(scene.drawing, sol).violation is None
    knife, of_knife = solution("knife-edge", np.linspace(0, 2, 41))
    edge: Any = plotting.animate(knife, of_knife)
    assert edge.violated == "h"
    np.testing.assert_array_equal(edge.violation[1], dae_jax.drift(knife.system, of_knife).velocity)


def test_a_mechanism_without_a_drawing_needs_a_function_only(double):
    scene, sol = double
    film = sol.animate(lambda t, q: q.reshape(-1, 2), system=scene.system)
    assert isinstance(film, plotting.Animation)
    assert film.drawing.masses == {"point 0": 0, "point 1": 1}
    np.testing.assert_allclose(film.points[0], scene.y0[0].reshape(-1, 2))
    assert film.violated == "g"


def test_a_system_that_is_no_mechanism_gives_its_whole_state(double):
    turn = dae_jax.ImplicitDAE(lambda t, y, yd, a: yd - jnp.stack([-y[1], y[0]]))
    _, sol = double
    sol = dataclasses.replace(sol, ys=jnp.stack([jnp.cos(sol.ts), jnp.sin(sol.ts)], 1))
    film = sol.animate(lambda t, y: y[None], system=turn)
    np.testing.assert_allclose(film.points[:, 0], np.stack([np.cos(film.times), np.sin(film.times)], 1), atol=1e-4)
    assert film.violated == "F"


# In space


def test_the_camera_keeps_right_handed_coordinates_and_makes_the_near_larger():
    box = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    for down in (False, True):
        camera = Camera(box, down)
        assert np.linalg.det(camera.axes) == pytest.approx(1)
        assert camera(np.array([0.0, 0.0, 1.0]))[1] * (-1 if down else 1) > 0
        eye = camera.axes[2]
        right = camera.axes[0]
        near, far = (camera(0.5 * right + z * eye)[0] for z in (1.0, -1.0))
        assert near > 0.5 > far > 0
    assert [nice(x) for x in (0.011, 0.02, 0.3, 7, 0.099)] == pytest.approx([0.02, 0.02, 0.5, 10, 0.1])


def test_a_spring_is_drawn_from_end_to_end():
    a, b = np.array([1.0, 2.0]), np.array([4.0, 6.0])
    corners = coil(a, b, 0.2)
    np.testing.assert_allclose(corners[[0, -1]], [a, b])
    across = (corners - a) @ np.array([-4, 3]) / 5
    assert np.abs(across).max() == pytest.approx(0.2)
    assert across.sum() == pytest.approx(0)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_what_rests_is_drawn_at_a_size_of_its_own(double, dimensions):
    _, sol = double
    still = jnp.ones((len(sol.ts), dimensions))
    sol = dataclasses.replace(sol, ys=(still, 0 * still))
    film = sol.animate(lambda t, q: q[None] + 1e-17 * t)
    (left, right), (bottom, top) = film.figure(0.0).axes[0].get_xlim(), film.figure(0.0).axes[0].get_ylim()
    assert 0.1 < right - left < 10
    assert 0.1 < top - bottom < 10


# Pictures


def test_a_frame_shows_links_masses_time_and_drift(double, film):
    _, sol = double
    figure = film.figure(1.0)
    axes, strip = figure.axes
    xy = [line.get_xydata() for line in axes.lines]
    assert any(x.shape == (2, 2) and np.allclose(x, film.points[50, :2]) for x in xy)
    assert any(x.shape == (1, 2) and np.allclose(x, film.points[50, 2]) for x in xy)
    assert axes.yaxis_inverted()
    assert "t = 1.00 s" in next(text.get_text() for text in axes.texts)
    assert strip.lines[1].get_xdata()[0] == 1.0
    low, high = strip.get_ylim()
    values = np.asarray(dae_jax.drift(SCENES["double-pendulum"]().system, sol).position)
    assert low <= values[values > 0].min() <= values.max() <= high
    # All points of all frames are within the axes.
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < film.points[..., 0].min() < film.points[..., 0].max() < right
    assert top < film.points[..., 1].min() < film.points[..., 1].max() < bottom


def test_a_gif_has_its_frames_and_takes_the_time_it_shows(film, tmp_path):
    path = film.save(tmp_path / "pendulum.gif")
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.info["loop"] == 0
        durations = []
        for k in range(image.n_frames):
            image.seek(k)
            durations.append(image.info["duration"])
    assert len(durations) == 51
    assert sum(durations) == pytest.approx(2000, abs=40)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_an_mp4_has_its_frames(spherical, tmp_path):
    path = spherical.save(tmp_path / "pendulum.mp4")
    assert path.read_bytes()[4:8] == b"ftyp"
    probe = "ffprobe -v error -count_frames -show_entries stream=nb_read_frames,r_frame_rate -of csv=p=0".split()
    assert subprocess.run([*probe, str(path)], capture_output=True, text=True).stdout.strip() == "50/1,101"


def test_an_mp4_without_ffmpeg_says_what_to_do(film, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="ffmpeg, which is not found: install it, or save"):
        film.save(tmp_path / "pendulum.mp4")
    assert not (tmp_path / "pendulum.mp4").exists()


# The page


class Page(HTMLParser):
    """Elements that are open, what they hold, and what they load."""

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.scripts, self.text = [], [], {}, {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.loads += [value for name, value in found.items() if name in ("src", "href", "srcset", "action", "poster")]
        if tag not in ("meta", "input", "link", "br"):
            self.open.append((tag, found.get("id")))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        if self.open:
            self.text[self.open[-1]] = self.text.get(self.open[-1], "") + data


def data_of(page):
    data = json.loads(page.text[("script", "data")])
    floats = lambda text: np.frombuffer(base64.b64decode(text), "<f4")
    return data, floats


@pytest.mark.parametrize("which", ["film", "spherical"])
def test_a_page_is_whole_and_needs_nothing_from_outside(which, request, tmp_path):
    film = request.getfixturevalue(which)
    text = film.save(tmp_path / "page.html").read_text()
    page = Page(text)
    assert not page.open
    assert not page.loads
    code = text.replace(page.text[("script", "data")], "")
    assert not re.search(r"https?:|[\"'(]//|@import|url\(|fetch\(|XMLHttp|WebSocket|import\(", code)
    assert "{{" not in text
    assert "prefers-color-scheme: dark" in text
    assert len(text) < 60_000
    data, floats = data_of(page)
    assert data["title"] == film.title
    np.testing.assert_allclose(floats(data["points"]).reshape(data["shape"]), film.points, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(data["t0"] + data["dt"] * np.arange(len(film.times)), film.times)
    np.testing.assert_allclose(floats(data["drift"]["g"]), film.violation[1], rtol=1e-6)
    assert [name for name, _, _ in data["masses"]] == list(film.drawing.masses)


def test_a_notebook_shows_the_page_in_a_frame(spherical):
    shown = spherical._repr_html_()
    page = Page(shown)
    assert not page.open
    assert shown.startswith("<iframe srcdoc=")
    found = {}

    class Frame(HTMLParser):
        def handle_starttag(self, tag, attributes):
            found[tag] = dict(attributes)

    Frame().feed(shown)
    assert found["iframe"]["srcdoc"] == spherical.html()


# What a browser makes of it, asked by a script at the end of the page.
ASKS = """
<script>
const said = {}, key = k => dispatchEvent(new KeyboardEvent("keydown", { key: k, bubbles: true, cancelable: true }));
addEventListener("error", e => { said.error = e.message; });
const ink = id => { const c = $(id); return c.getContext("2d").getImageData(0, 0, c.width, c.height).data.filter(x => x).length; };
said.autoplay = playing;
key(" "); said.paused = !playing && $("play").textContent;
key("Home"); said.home = at;
const [c, w, h] = sheet($("scene")); said.first = fit(w, h).to(point(0, POINTS - 1)).slice(0, 2);
said.size = [w, h];
key("ArrowRight"); key("ArrowRight"); said.two = at; said.time = $("time").textContent;
key("ArrowLeft"); said.one = at;
key("End"); said.end = at; said.slider = +$("at").value;
$("at").value = 30.5; $("at").dispatchEvent(new Event("input")); said.sought = at; said.between = point(at, POINTS - 1);
$("drift").dispatchEvent(new PointerEvent("pointermove", { buttons: 1, clientX: $("drift").getBoundingClientRect().left + 58 }));
said.clicked = at;
if (SPACE) {
  const turned = view.azimuth;
  $("scene").dispatchEvent(new PointerEvent("pointermove", { buttons: 1, movementX: 10, movementY: 5 }));
  said.turned = [view.azimuth - turned, view.elevation];
}
said.ink = [ink("scene"), ink("drift")];
said.background = getComputedStyle(document.body).backgroundColor;
said.scrolls = document.documentElement.scrollHeight > innerHeight;
key(" "); const from = at; said.playing = playing;
setTimeout(() => { said.moved = at - from; document.body.dataset.said = JSON.stringify(said); }, 400);
</script>
"""


def asked(film, path, *flags):
    path.write_text(film.html().replace("</body>", ASKS + "</body>"))
    profile = f"--user-data-dir={path.parent / 'profile'}"
    command = f"{CHROMIUM} --headless --no-sandbox --disable-gpu --window-size=720,560 --virtual-time-budget=3000 {profile} --dump-dom"
    run = subprocess.run(
        [*command.split(), *flags, path.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    found = re.search(r'data-said="([^"]*)"', run.stdout)
    assert found, run.stderr[-2000:]
    return json.loads(found[1].replace("&quot;", '"'))


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_plays_it(film, spherical, tmp_path):
    said = asked(film, tmp_path / "plane.html")
    assert "error" not in said
    assert said["autoplay"] is True
    assert said["paused"] == "Play"
    assert (said["home"], said["one"], said["two"], said["end"], said["slider"]) == (0, 1, 2, 100, 100)
    assert said["time"] == "0.04"
    assert said["sought"] == 30.5
    np.testing.assert_allclose(said["between"], film.points[30:32, 2].mean(0), rtol=1e-6)
    assert said["clicked"] == 0
    # The second mass begins to the right of the pivot, at x = 2 m, y = 0.
    (x, y), (width, height) = said["first"], said["size"]
    assert width / 2 < x < width
    assert 0 < y < height / 2
    assert min(said["ink"]) > 2000
    assert said["background"] == "rgb(255, 255, 255)"
    assert not said["scrolls"]
    assert said["playing"] is True
    assert said["moved"] > 0

    said = asked(spherical, tmp_path / "space.html", "--blink-settings=preferredColorScheme=0")
    assert "error" not in said
    assert said["background"] == "rgb(22, 24, 28)"
    assert said["turned"] == [-4, 20]
    assert min(said["ink"]) > 2000


# Wrong input


def test_wrong_input_is_refused_in_a_sentence(double):
    scene, sol = double
    one = dae_jax.daesolve(scene.system, dae_jax.DOP853(), 0.0, 0.1, None, scene.y0)
    batch = jax.vmap(lambda _: one)(jnp.arange(2))
    refused = [
        (ValueError, "at least two saved times, but the solution has 1; pass `saveat", lambda: plotting.animate(scene, one)),
        (ValueError, "a batch of solutions; animate one of them", lambda: plotting.animate(scene, batch)),
        (ValueError, "take it outside of `jit`", lambda: jax.jit(lambda s: plotting.animate(scene, s).points)(sol)),
        (ValueError, "saved over time", lambda: plotting.animate(scene, dataclasses.replace(sol, ts=None))),
        (TypeError, "`sol` must be what `daesolve` returns, but is 3", lambda: plotting.animate(scene, 3)),
        (ValueError, "The scene jay has no drawing", lambda: plotting.animate(SCENES["jay"](), sol)),
        (TypeError, "must be a Scene", lambda: sol.animate(7)),
        (TypeError, "but is the class Drawing", lambda: sol.animate(Drawing)),
        (TypeError, "`system` must be", lambda: sol.animate(scene, system=3)),
        (ValueError, r"\(points, 2\) or \(points, 3\), but gives \(4,\)", lambda: sol.animate(lambda t, q: q)),
        (ValueError, "names the point 9, but points", lambda: sol.animate(Drawing(scene.drawing.points, {"a": 9}))),
        (ValueError, "must be finite, but gives NaN", lambda: sol.animate(lambda t, q: jnp.sqrt(-q[None, :2] - 9))),
        (ValueError, "`speed` must be positive, but is 0", lambda: sol.animate(scene, speed=0)),
        (ValueError, "`fps` must be positive, but is -1", lambda: sol.animate(scene, fps=-1)),
        (ValueError, "`trace` must be positive, but is nan", lambda: sol.animate(scene, trace=float("nan"))),
        (ValueError, "are 1 frames, but must be 2 to 20000: at speed 0.2", lambda: sol.animate(scene, speed=1e3)),
        (ValueError, r"saved as .html, .gif, .mp4, not as .avi", lambda: sol.animate(scene).save("x.avi")),
        (ValueError, "a file without an ending", lambda: sol.animate(scene).save("x")),
    ]  # fmt: skip
    for kind, words, call in refused:
        with pytest.raises(kind, match=words):
            call()


def test_saved_times_that_are_too_far_apart_are_said(double):
    scene, sol = double
    few = dataclasses.replace(sol, ts=sol.ts[::20], ys=jax.tree.map(lambda y: y[::20], sol.ys))
    with pytest.warns(dae_jax.AccuracyWarning, match="5 saved times are too few"):
        plotting.animate(scene, few)


# The command line


def test_animate_writes_a_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["animate", "pendulum", "--t1", "1", "--speed", "0.5", "--method", "rattle"]) == 0
    assert capsys.readouterr().out.split("\n")[:2] == ["pendulum, 1 s by rattle, 2 × slower", "animate-pendulum.html"]
    data, floats = data_of(Page((tmp_path / "animate-pendulum.html").read_text()))
    assert data["shape"] == [101, 2, 2]
    expected = SCENES["pendulum"]().reference(np.linspace(0, 1, 101))[0]
    np.testing.assert_allclose(floats(data["points"]).reshape(101, 2, 2)[:, 1], expected, atol=1e-3)


# What a notebook shows of other things


def test_tables_of_a_notebook_say_what_is_printed_and_escape_it(double):
    scene, sol = double
    structure = dae_jax.analyse(scene.system, 0.0, scene.y0)
    plan = dae_jax.explain(scene.system, diffrax.Tsit5(), 0.0, scene.y0)
    tuned = dae_jax.tune(lambda p: jnp.sum(jnp.log(p["<a>"]) ** 2), {"<a>": 3.0}, steps=2, progress=False)
    batch = jax.vmap(lambda y: dae_jax.daesolve(scene.system, dae_jax.RATTLE(), 0.0, 0.1, 0.05, y, throw=False))
    many = batch(jax.tree.map(lambda y: jnp.stack([y, y + 1]), scene.y0))
    for thing, words in (
        (sol, ("successful", "0 to 2", "f64[81]", "(f64[81,4], f64[81,4])", "accepted", "float64")),
        (many, ("1 of 2 successful", "f64[2,1]")),
        (structure, ("index", ">3<", "2, of the mechanism", "constraint[0], differentiated once", str(structure))),
        (plan, (plan.method, plan.precision, "4 coordinates, 2 constraints")),
        (tuned, ("{'<a>': ", "1 start, 2 steps")),
    ):
        shown = thing._repr_html_()
        page = Page(shown)
        assert not page.open
        assert not page.loads
        assert "<a>" not in shown
        for word in words:
            assert (html.escape(word) if word[0] != ">" else word) in shown, word
        # Colours are those of the notebook, light or dark.
        assert not re.search(r"#[0-9a-f]{3}|https?:", html.unescape(shown))
        assert len(shown) < 6000


def test_a_table_of_what_is_traced_says_so(double):
    _, sol = double
    seen = []
    jax.jit(lambda ys: seen.append(dataclasses.replace(sol, ys=ys)._repr_html_()))(sol.ys)
    assert "inside jit, vmap or grad" in seen[0]
