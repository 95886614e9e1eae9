"""What the pictures show: looked at in matplotlib's objects, not in pixels."""

import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import plotting
from dae_jax.app import figures
from dae_jax.app.compare import Effort, Row, chosen, measure, methods, solve
from dae_jax.driver import program
from dae_jax.scenes import ANGLES, SCENES


TIMES = np.linspace(0, 1, 11)
DRAWN = [name for name, make in SCENES.items() if make().drawing is not None]


def look_of(figure, label):
    (line,) = [x for x in figure.axes[0].lines if x.get_label().split(":")[0] == label]
    return line.get_color(), line.get_marker()


def compared(scene, names, t1):
    """{figure: how to draw it} of a comparison, with the drifts it shows."""
    solutions, rows = {}, []
    for name, method in chosen(scene, names).items():
        solutions[name] = solve(scene, method, scene.times(t1, 501), 1e-8)
        rows.append(Row(name, error=1.0))
    return dict(figures.figures(scene, rows, [], solutions, 1e-8, paper=False)), solutions


def test_every_method_keeps_its_colour_and_marker_whatever_else_is_drawn():
    names = list(methods(SCENES["pendulum"]()))
    curves = {name: (TIMES, TIMES + 1e-9) for name in names}
    of_all = plotting.drift(curves)
    looks = {name: look_of(of_all, name) for name in names}
    for some in (names[3:5], names[::-3], names[-1:]):
        for figure in (plotting.drift({n: curves[n] for n in some}), plotting.energy({n: curves[n] for n in some})):
            assert all(look_of(figure, name) == looks[name] for name in some)
    costs = plotting.work_precision({name: ([1.0, 2.0], [1e-3, 1e-6]) for name in names[5:]})
    assert all(look_of(costs, name) == looks[name] for name in names[5:])


@pytest.mark.parametrize("name", SCENES)
def test_no_two_methods_of_a_scene_look_alike(name):
    looks = [plotting.METHODS[method] for method in methods(SCENES[name]())]
    for kind in zip(*looks, strict=True):
        assert len(set(kind)) == len(looks)


def lab(colour, seen_as):
    """CIELAB of a colour as it is seen with a colour blindness (G. M. Machado et al., IEEE TVCG 15 (2009))."""
    channels = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ np.clip(seen_as @ linear, 0, 1) / np.array([0.9505, 1, 1.089])
    root = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * root[1] - 16, 500 * (root[0] - root[1]), 200 * (root[1] - root[2])])


@pytest.mark.parametrize(
    "seen_as",
    [
        np.eye(3),
        np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
        np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
    ],
    ids=["normal", "deuteranopia", "protanopia"],
)
def test_the_colours_of_the_methods_can_be_told_apart(seen_as):
    colours = {colour for colour, _ in plotting.METHODS.values()}
    points = [lab(colour, seen_as) for colour in colours]
    # 10 is a difference that is seen at a glance; the lightness of white is 100.
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(points, 2)) > 15
    assert max(point[0] for point in points) < 85


# Drift and energy


def test_a_knife_edge_drifts_off_its_nonholonomic_constraint():
    scene = SCENES["knife-edge"]()
    drawn, solutions = compared(scene, ["differentiation"], 2.0)
    assert "drift-velocity" not in drawn
    axes = drawn["drift"]().axes[0]
    assert "|h|" in axes.get_ylabel()
    expected = dae_jax.drift(scene.system, solutions["differentiation"]).velocity
    assert np.nanmax(axes.lines[0].get_ydata()) == pytest.approx(float(expected.max()), rel=1e-12)
    assert float(expected.max()) > 1e-9


def test_a_comparison_has_no_drift_of_a_constraint_that_there_is_not():
    scene = SCENES["knife-edge"]()
    row, _ = measure(scene, "differentiation", methods(scene)["differentiation"], np.linspace(0, 1, 11), 1e-8)
    assert np.isnan(row.position_drift)
    assert row.velocity_drift > 0


def test_a_comparison_has_the_drift_of_equations_and_of_hidden_ones():
    """Of a system that is no mechanism; without hidden equations there is one number."""
    for name, hidden in (("capacitor-loop", True), ("robertson", False)):
        scene = SCENES[name]()
        method = "radau" if name == "robertson" else "differentiation"
        row, sol = measure(scene, method, methods(scene)[method], np.linspace(0, 0.1, 3), 1e-8)
        levels = dae_jax.drift(scene.system, sol).levels
        assert row.position_drift == float(levels[0].max())
        assert np.isnan(row.velocity_drift) if not hidden else row.velocity_drift == float(levels[1].max())


def test_a_system_with_both_kinds_of_constraints_has_both_drawn():
    levels = figures._levels(
        dae_jax.ConstrainedSystem(lambda t, q, v, a: q, lambda t, q, a: q[0], nonholonomic=lambda t, q, v, a: v[1])
    )
    assert [(name, field) for name, field, _ in levels] == [("drift", "position"), ("drift-velocity", "velocity")]


def test_zeros_are_not_drawn_and_said():
    figure = plotting.drift({"rattle": (TIMES, 0 * TIMES), "baumgarte": (TIMES, np.maximum(TIMES - 0.5, 0))})
    zero, other = figure.axes[0].lines
    assert zero.get_label() == "rattle: exactly 0"
    assert np.isnan(zero.get_ydata()).all()
    np.testing.assert_array_equal(np.isnan(other.get_ydata()), TIMES <= 0.5)
    assert plotting.drift({"rattle": (TIMES, 0 * TIMES)}).axes[0].get_yscale() == "linear"


def test_the_axis_begins_where_the_curves_end():
    """Not in the first steps, which reach down to round-off."""
    grows = np.geomspace(1e-16, 1e-3, 11)
    low, high = plotting.energy({"a": (TIMES, 5 + grows), "b": (TIMES, 5 + 10 * grows)}).axes[0].get_ylim()
    assert 1e-3 / 100 < low < 1e-3
    assert 1e-2 < high < 1


# Time axes


def test_robertson_is_drawn_over_the_logarithm_of_time():
    scene = SCENES["robertson"]()
    drawn, solutions = compared(scene, ["radau"], scene.t1)
    axes = drawn["solution-radau"]().axes[0]
    assert axes.get_xscale() == "log"
    assert axes.lines[0].get_xdata().min() > 0
    # As many points for the first second as for all the rest, about.
    assert 100 < np.sum(np.asarray(solutions["radau"].ts) < 1) < 400
    assert np.isfinite(scene.error(np.asarray(solutions["radau"].ts), solutions["radau"].ys))


def test_other_scenes_are_drawn_over_time():
    drawn, _ = compared(SCENES["jay"](), ["radau"], 1.0)
    assert drawn["solution-radau"]().axes[0].get_xscale() == "linear"


# Mechanisms


@pytest.mark.parametrize("name", DRAWN)
def test_links_of_a_drawing_are_rigid(name):
    """A joint that is drawn in the wrong place changes its distance."""
    scene = SCENES[name]()
    assert scene.drawing is not None
    # What is published is the end alone.
    later = 1.0 if np.isfinite(scene.reference(np.ones(1))[0]).all() else scene.t1
    times = np.array([0.0, later])
    q = jnp.stack([scene.y0[0], scene.reference(times)[0][-1]])
    points = np.asarray(jax.vmap(scene.drawing.points)(times, q))
    assert not np.allclose(q[0], q[1])
    assert points.shape[2] in (2, 3)
    assert set(scene.drawing.masses.values()) <= set(range(points.shape[1]))
    # What is seen from above looks shorter.
    for start, end in scene.drawing.links if "above" not in scene.drawing.axes[0] else ():
        lengths = np.linalg.norm(points[:, end] - points[:, start], axis=1)
        assert np.ptp(lengths) < 1e-6 * lengths[0]
    figure = figures._mechanism(scene, "radau", types.SimpleNamespace(ts=times, ys=(q, q)))
    assert figure.axes[0].yaxis_inverted() == (scene.drawing.down and points.shape[2] == 2)
    assert all(mass in [text.get_text() for text in figure.legends[0].get_texts()] for mass in scene.drawing.masses)


def test_the_path_of_the_paper_fills_its_figure_and_names_the_mass():
    scene = SCENES[ANGLES]()
    figure = plotting.trajectory(TIMES, np.stack([4 * TIMES, 1.5 * TIMES], 1), 0.5, "path of mass 2")
    axes = figure.axes[0]
    (left, right), (high, low) = axes.get_xlim(), axes.get_ylim()
    assert right - left < 1.2 * 4
    assert high - low < 1.5 + 0.2 * 4
    width, height = figure.get_size_inches()
    assert width > 1.5 * height
    assert scene.drawing is not None
    assert list(scene.drawing.masses)[-1] == "mass 2"


# Maps and descents


def test_a_few_extreme_cells_do_not_stretch_the_colours():
    values = np.linspace(0, 1, 400).reshape(20, 20)
    values[3, 4], values[5, 6] = 1e6, np.nan
    figure = plotting.sweep_map(np.arange(20.0), np.arange(20.0), values, ("x", "y", "z"), blank="failed")
    (mesh,) = figure.axes[0].collections
    assert mesh.get_clim()[1] < 1.01
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["failed"]


@pytest.mark.parametrize(("gain", "share"), [(0.02, 0.1), (5.0, 1.0)])
def test_a_small_gain_looks_small(gain, share):
    losses = -11.25 - gain * np.linspace(0, 1, 30)[None]
    params = {"alpha": np.ones((1, 30))}
    figure = plotting.tuning(types.SimpleNamespace(loss=losses, best=losses, params=params))
    low, high = figure.axes[0].get_ylim()
    assert gain / (high - low) < share
    assert f"{losses[0, 0]:.4g} → {losses[0, -1]:.4g}" in figure.axes[0].get_title()


def test_work_precision_is_drawn_where_there_is_a_reference():
    scene = SCENES["pendulum"]()
    efforts = [Effort("rattle", h, 10, 1e-3 / h, h**2) for h in (0.1, 0.05)]
    drawn = dict(figures.figures(scene, [], efforts, {}, 1e-8, paper=False))
    axes = drawn["work-precision"]().axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert look_of(drawn["work-precision"](), "rattle") == plotting.METHODS["rattle"]
    assert not dict(figures.figures(scene, [], [], {}, 1e-8, paper=False))


def test_errors_above_one_are_in_the_picture():
    """They were beyond its edge, and a method that had no other in the legend alone."""
    seconds = [1e-3, 1e-2, 1e-1]
    figure = plotting.work_precision(
        {"rattle": (seconds, [3e4, 30.0, np.inf]), "radau-ggl": (seconds, [5.0, 1e-2, 1e-5])}
    )
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    lines = {label: line for line in axes.lines if not (label := line.get_label()).startswith("_")}
    for name, errors in (("rattle", [1, 1, 1]), ("radau-ggl", [1, 1e-2, 1e-5])):
        np.testing.assert_allclose(lines[name].get_ydata(), errors)
    arrows = [line for line in axes.lines if line.get_label().startswith("_")]
    assert [line.get_xdata().tolist() for line in arrows] == [seconds, seconds[:1]]
    assert all(low < y < high for line in axes.lines for y in line.get_ydata())


@pytest.mark.parametrize("highest", [2e-3, 8e-3, 7e-2, 1.0, 1e3])
def test_numbers_along_an_axis_are_not_on_top_of_each_other(highest):
    """Run times from 1 to 70 ms had 2, 3, 4 and 6 times a power of ten, each over the next."""
    times = np.geomspace(1.2e-3, highest, 4)
    for figure in (
        plotting.work_precision({"rattle": (times, times)}),
        plotting.scaling({"a": (times, times)}, "n", "s"),
    ):
        figure.draw_without_rendering()
        axis = figure.axes[0].xaxis
        boxes = [label.get_window_extent() for label in axis.get_ticklabels(which="both") if label.get_text()]
        low, high = axis.get_view_interval()
        assert np.sum((axis.get_ticklocs() >= low) & (axis.get_ticklocs() <= high)) >= 1
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_other_tolerances_compile_nothing(nothing_forgotten):
    scene = SCENES["pendulum"]()
    times = scene.times(0.1, 5)
    for name in ("projection-tsit5", "rattle"):
        method = methods(scene)[name]
        solve(scene, method, times, 1e-6)
        before = _compilations()
        solve(scene, method, times, 1e-4, method.step and 2 * method.step)
        assert _compilations() == before


def _compilations():
    return program._jitted._cache_size()


def test_paper_figures_are_known():
    named = {figure for make in SCENES.values() for figure in make().paper}
    assert named == set(figures.PAPER)


def test_what_is_printed_fits_on_a_line_or_two():
    tuned = dae_jax.tune(lambda p: jnp.sum(jnp.log(p["a"]) ** 2), {"a": jnp.full(3, 3.0)}, steps=20, progress=False)
    many = dae_jax.tune(lambda p: jnp.sum(jnp.log(p) ** 2), jnp.full(300, 3.0), steps=20, progress=False)
    pendulum = SCENES["pendulum"]()
    loss = dae_jax.baumgarte_loss(pendulum.system, pendulum.y0, 1.0, dt0=0.05, reference=pendulum.reference)
    for thing in (tuned, tuned.history, many, loss):
        assert len(repr(thing)) < 300
        assert len(str(thing)) < 300
    assert "3.62" in repr(tuned)
    assert "float64[300]" in repr(many)
