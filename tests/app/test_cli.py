"""The command line, as a user types it."""

import argparse
import csv
import dataclasses
import gc
import os
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stress import __main__ as stress
from dae_jax.app import cli, compare, maps
from dae_jax.app.cli import main
from dae_jax.app.interrupts import interruptible
from dae_jax.app.plotting import FILE_TYPES
from dae_jax.scenes import SCENES


ROOT = Path(cli.__file__).parents[2]


def test_compare_writes_table_data_and_figures(tmp_path, capsys):
    assert (
        main(["compare", "pendulum", "--t1", "0.5", "--methods", "projection-tsit5,rattle", "--out", str(tmp_path)])
        == 0
    )
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["projection-tsit5", "rattle"]
    assert all(np.isfinite(float(row["error"])) for row in rows)
    for figure in ("drift", "energy", "work-precision", "mechanism"):
        assert (tmp_path / f"{figure}.png").stat().st_size > 10_000
    # The paper's figures go to the scene's own end time.
    assert not list(tmp_path.glob("fig*.png"))
    with (tmp_path / "work-precision.csv").open() as file:
        efforts = [row for row in csv.DictReader(file) if row["method"] == "projection-tsit5"]
    errors = [float(row["error"]) for row in efforts]
    assert [float(row["setting"]) for row in efforts] == pytest.approx([1e-4, 1e-6, 1e-8, 1e-10])
    assert errors == sorted(errors, reverse=True)
    assert "projection-tsit5" in capsys.readouterr().out
    with np.load(tmp_path / "solutions.npz") as data:
        assert data["rattle_q"].shape == (501, 2)


def test_compare_takes_problems_that_are_no_mechanisms(tmp_path, capsys):
    assert main(["compare", "jay", "--rtol", "1e-6", "--methods", "radau", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "errors relative" in out
    assert "–" in out
    with np.load(tmp_path / "solutions.npz") as data:
        assert data["radau_x"].shape == (501, 4)
    assert (tmp_path / "solution-radau.png").stat().st_size > 10_000


def test_sweep_draws_the_map_of_alpha_and_beta(tmp_path, capsys):
    assert main(["sweep", "pendulum", "--points", "6", "--t1", "5", "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / "baumgarte-pendulum.npz") as data:
        found = dict(data)
    assert found["loss"].shape == (6, 6)
    # The map ends beyond what explicit steps can, and most of it is below.
    assert found["failed"][-1, -1]
    assert not found["failed"][0, 0]
    assert np.mean(found["failed"]) < 0.5
    assert (tmp_path / "baumgarte-pendulum.png").stat().st_size > 10_000
    captured = capsys.readouterr()
    assert "baumgarte-pendulum.png" in captured.out
    # Why elements failed is said, and how many.
    failed = int(np.sum(found["failed"]))
    counts = [int(count) for count in re.findall(r"(\d+) × The solution", captured.err)]
    assert sum(counts) == failed
    assert "× The solution is not finite" in captured.err


def test_of_errors_is_said_at_which_times_the_reference_is_known():
    """Those of chaotic scenes, and of published ones, were "over 501 times" too."""
    pendulum = SCENES["pendulum"]()
    assert compare.largest(pendulum, 10.0).endswith("larger than 1")
    known = dataclasses.replace(pendulum, horizon=2.0)
    assert compare.largest(known, 10.0).endswith(", over 101 of them, 0 to 2 s, the reference's")
    assert compare.largest(SCENES["akzo-nobel"](), 180.0).endswith(", at 180 s, the reference's only time")


@pytest.mark.parametrize(("failed", "mark"), [([[1, 1], [1, 1]], False), ([[1, 0], [1, 1]], True)])
def test_what_failed_is_not_the_best(failed, mark, monkeypatch, tmp_path):
    drawn = []
    axis, of_all = np.array([1.0, 2.0]), {name: np.full((2, 2), 51.0) for name in ("loss", "drift", "error")}
    found = {"alpha": axis, "beta": axis, **of_all, "failed": np.array(failed, bool)}
    monkeypatch.setattr(maps, "baumgarte_map", lambda *_: found)
    monkeypatch.setattr(maps, "loss_of", lambda *_: None)
    monkeypatch.setattr(maps, "_write", lambda folder, name, figure, data: drawn.append(figure) or [])
    maps.write_baumgarte_map(SCENES["pendulum"](), 5.0, 4.0, 2, tmp_path, False)
    (figure,) = drawn
    assert ("best α = 1, β = 2" in figure.axes[0].get_title()) == mark
    assert bool(figure.axes[0].lines) == mark


@pytest.mark.parametrize("failed", [False, True])
def test_what_failed_is_no_swing_without_a_flip(failed, monkeypatch, tmp_path):
    drawn = []
    axis = np.array([-1.0, 1.0])
    found = {"first": axis, "second": axis, "flip": np.array([[1.0, np.inf], [2.0, 3.0]]), "lyapunov": np.ones((2, 2))}
    found |= {"failed": np.array([[False, failed], [False, False]])}
    found["lyapunov"][found["failed"]] = np.nan
    monkeypatch.setattr(maps, "angle_map", lambda *_: found)
    monkeypatch.setattr(maps, "_write", lambda folder, name, figure, data: drawn.append(figure) or [])
    maps.write_angle_map(SCENES["double-pendulum"](), 3.0, 1e-6, 2, tmp_path, False)
    said = [[text.get_text() for legend in figure.legends for text in legend.get_texts()] for figure in drawn]
    assert said == (
        [["no flip within 3 s, or failed: 25%"], ["failed: 25%"]] if failed else [["no flip within 3 s"], []]
    )


def test_a_grid_beyond_the_memory_is_one_line(tmp_path, capsys):
    assert main(["sweep", "angles", "--points", "10000000", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("dae-jax: Unable to allocate")


def test_sweep_draws_the_maps_of_initial_angles(tmp_path):
    assert main(["sweep", "angles", "--points", "6", "--t1", "4", "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / "angles-flip.npz") as data:
        found = dict(data)
    # Both arms near the top turn over, both near the bottom do not; the map is symmetric about the middle.
    assert np.isinf(found["flip"][2:4, 2:4]).all()
    assert np.isfinite(found["flip"]).any()
    np.testing.assert_allclose(found["lyapunov"], found["lyapunov"][::-1, ::-1], atol=0.5)
    assert not found["failed"].any()
    for name in ("flip", "lyapunov"):
        assert (tmp_path / f"angles-{name}.png").stat().st_size > 10_000


def test_tune_prints_what_it_found_and_verifies_it(tmp_path, capsys):
    assert main(["tune", "pendulum", "--steps", "10", "--t1", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.index("before") < out.index("after")
    assert "verified with rtol 1e-11" in out
    with np.load(tmp_path / "tune-pendulum.npz") as data:
        assert data["alpha"].shape == (1, 10)
        # The example gains: a decade of drift or error weighs 1.
        assert data["best"][0, -1] < data["loss"][0, 0] - 3


def test_tune_says_where_no_solve_reaches_its_end(tmp_path, capsys):
    assert main(["tune", "pendulum", "--dt0", "0.5", "--t1", "20", "--steps", "1", "--out", str(tmp_path)]) == 1
    assert "No α and β were found with which all solves reach their end" in capsys.readouterr().err


def test_analyse_prints_and_draws_a_system_of_a_module(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "import dae_jax, numpy as np\nintegrator = dae_jax.ImplicitDAE(lambda t, y, yd, a: yd - y), np.ones(1)\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["analyse", "mine:integrator", "--out", "incidence.png"]) == 0
    assert "1 equation, index 0, 1 initial value to choose" in capsys.readouterr().out
    assert (tmp_path / "incidence.png").stat().st_size > 10_000


def test_a_method_that_does_not_apply_says_why(tmp_path, capsys):
    assert main(["compare", "knife-edge", "--t1", "0.5", "--methods", "rattle", "--out", str(tmp_path)]) == 0
    assert "holonomic constraints only" in capsys.readouterr().out


def test_methods_may_be_written_with_spaces(tmp_path):
    argv = ["compare", "knife-edge", "--t1", "0.1", "--methods", "rattle, projection-euler ", "--out", str(tmp_path)]
    assert main(argv) == 0
    with (tmp_path / "table.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["rattle", "projection-euler"]


def test_an_error_that_nothing_is_known_about_is_explained(tmp_path, capsys):
    assert main(["compare", "robertson", "--t1", "1", "--methods", "radau", "--out", str(tmp_path)]) == 0
    assert "the reference is known at 1e+11 s only" in capsys.readouterr().out
    assert not (tmp_path / "work-precision.png").exists()


def test_a_map_of_a_mechanism_whose_reference_is_known_at_the_end_only(tmp_path):
    argv = ["sweep", "car-axis", "--points", "2", "--t1", "0.1", "--dt0", "0.001", "--out", str(tmp_path)]
    assert main(argv) == 0
    with np.load(tmp_path / "baumgarte-car-axis.npz") as data:
        assert data["loss"][0, 0] < -10


WRONG = {
    "compare no-such-scene": "unknown scene 'no-such-scene'; choose from akzo-nobel",
    "compare pendulum --methods magic": "unknown method 'magic'; pendulum knows differentiation",
    "compare pendulum --methods rattle,": "unknown method ''; pendulum knows differentiation",
    "compare pendulum --methods=": "unknown method ''; pendulum knows differentiation",
    "compare pendulum --methods rattle,bdf-ggl,rattle": "method 'rattle' is named more than once",
    "compare robertson --methods rattle": "unknown method 'rattle'; robertson knows radau, radau-variable, bdf",
    "compare pendulum --t1 -1": "--t1 must be positive and finite, but is -1.0",
    "compare pendulum --t1 inf": "--t1 must be positive",
    "compare pendulum --t1 nan": "--t1 must be positive",
    "compare pendulum --rtol 0": "--rtol must be between 1e-14",
    "compare pendulum --rtol 1e-20": "--rtol must be between 1e-14",
    "compare pendulum --rtol 2": "--rtol must be between 1e-14",
    "compare pendulum --methods rattle --rtol 1e-6": "--rtol is for methods that choose their steps; rattle has fixed ones",
    "compare pendulum --no-such-option": "unrecognized arguments: --no-such-option",
    "compare pendulum --dt0 0.1": "unrecognized arguments: --dt0 0.1",
    "compare pendulum --out /proc/nope": "--out '/proc/nope' cannot be written",
    "analyse no-such-scene": "unknown scene 'no-such-scene'; choose from akzo-nobel",
    "analyse json:dumps": "'json:dumps' cannot be had: TypeError",
    "analyse json:JSONDecoder": "is no Scene, (system, y0) or (system, y0, args), but a JSONDecoder",
    "analyse json:": "'json:' cannot be had",
    "analyse :x": "':x' cannot be had",
    "analyse no_such_module:x": "No module named 'no_such_module'",
    "analyse math:pi": "but a float",
    "analyse sys:version_info": "is no Scene",
    "analyse pendulum --out incidence.xyz": "must end in .png",
    "analyse pendulum --out no-such-folder/incidence.png": "no-such-folder is no folder",
    "analyse pendulum --out /proc/incidence.png": "cannot be written",
    "sweep robertson": "robertson is no mechanism",
    "sweep no-such-scene": "unknown scene",
    "sweep angles --points 0": "--points must be at least 2, but is 0",
    "sweep pendulum --points 1": "--points must be at least 2, but is 1",
    "sweep angles --dt0 0.1": "--dt0 is not for `sweep angles`",
    "sweep pendulum --rtol 1e-3": "--rtol is not for `sweep pendulum`",
    "sweep pendulum --t1 -1": "--t1 must be positive",
    "sweep pendulum --dt0 7": "must satisfy 0 < dt0 ≤ t1",
    "sweep angles --rtol 1": "--rtol must be between 1e-14",
    "sweep pendulum --out /proc/nope": "--out '/proc/nope' cannot be written",
    "tune pendulum --dt0 -1": "--dt0 must be positive",
    "tune pendulum --steps 0": "--steps must be positive",
    "tune pendulum --starts -1": "--starts must be positive",
    "tune pendulum --t1 0": "--t1 must be positive",
    "tune pendulum --rtol 1e-3": "unrecognized arguments: --rtol 1e-3",
    "tune jay": "jay is no mechanism",
    "tune pendulum --out /proc/nope": "--out '/proc/nope' cannot be written",
    "animate no-such-scene": "unknown scene 'no-such-scene'",
    "animate robertson": "robertson has no drawing; choose from andrews",
    "animate pendulum --t1 0": "--t1 must be positive and finite, but is 0.0",
    "animate pendulum --speed nan": "--speed must be positive and finite, but is nan",
    "animate pendulum --speed 1e-9": "but must be 2 to 20000: at speed 1 they take 10 s",
    "animate pendulum --method magic": "unknown method 'magic'; pendulum knows differentiation",
    "animate pendulum --rtol 1e-6": "unrecognized arguments: --rtol 1e-6",
    "animate pendulum --out pendulum.avi": "An animation is saved as .html, .gif, .mp4, not as .avi",
    "animate pendulum --out no-such-folder/pendulum.gif": "no-such-folder is no folder",
    "animate pendulum --out /proc/pendulum.html": "cannot be written",
    "bench --parts magic": "invalid choice: 'magic'",
    "bench --repeats 0": "--repeats must be at least 1",
    "bench --quick --peers heyoka_peer": "--quick takes no --peers",
    "bench --out /proc/nope": "cannot be written",
    "stress no-such-scene": "unknown scene 'no-such-scene'",
    "stress robertson": "robertson is no mechanism",
    "stress --methods magic": "unknown method 'magic'; choose from projection-tsit5",
    "stress --methods=": "unknown method ''; choose from projection-tsit5",
    "stress --stressors magic": "unknown family 'magic'; choose from",
    "stress pendulum --stressors scales": "--stressors is not for scenes",
    "stress --limit 0": "--limit must be positive",
    "stress --quick --no-such-option": "unrecognized arguments: --no-such-option",
    "stress --out /proc/nope": "--out '/proc/nope' cannot be written",
    "no-such-verb": "invalid choice: 'no-such-verb'",
    "": "required: command",
}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_arguments_end_with_one_line_and_status_2_before_any_work(line, monkeypatch, tmp_path, capsys):
    def too_late(*arguments, **keywords):
        raise AssertionError("this is work")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "measure", too_late)
    monkeypatch.setattr(compare, "solve", too_late)
    monkeypatch.setattr(maps, "sweep", too_late)
    monkeypatch.setattr(maps, "descent", too_late)
    monkeypatch.setattr(stress, "run", too_late)
    with pytest.raises(SystemExit) as end:
        main(line.split())
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert WRONG[line] in captured.err
    assert not captured.out
    # The benchmarks have a parser of their own, which shows its usage too.
    assert captured.err.count("\n") == 1 or line.startswith(("bench", "stress"))


def test_every_option_of_every_verb_is_in_the_table():
    """An option that is new says here what it refuses."""
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    for add in (cli._add_compare, cli._add_analyse, cli._add_sweep, cli._add_tune, cli._add_animate):
        add(commands)
    for verb, command in commands.choices.items():
        options = {option for option in command._option_string_actions if option.startswith("--")} - {"--help"}
        assert options <= {word.rstrip("=") for line in WRONG if line.startswith(verb) for word in line.split()}


def test_every_type_of_picture_can_be_saved():
    from matplotlib.figure import Figure

    assert {end[1:] for end in FILE_TYPES} <= set(Figure().canvas.get_supported_filetypes())


def test_bench_says_where_the_benchmarks_are(monkeypatch, tmp_path, capsys):
    """As in an installed package, which has none."""
    monkeypatch.setattr(cli, "__file__", str(tmp_path / "dae_jax" / "app" / "cli.py"))
    assert main(["bench", "--help"]) == 0
    assert "part of the source repository" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        main(["bench", "--quick"])
    assert end.value.code == 2
    assert "part of the source repository" in capsys.readouterr().err


def test_bench_help_lists_its_options_where_they_are(capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "--help"])
    assert end.value.code == 0
    assert "--parts" in capsys.readouterr().out


def test_a_disk_that_is_full_is_one_line(monkeypatch, tmp_path, capsys):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dae_jax.app.figures.write_data", full)
    assert main(["compare", "pendulum", "--t1", "0.1", "--methods", "rattle", "--out", str(tmp_path)]) == 2
    assert "dae-jax: [Errno 28] No space left on device" in capsys.readouterr().err


# Interruptions


def raised_in_the_garbage_collector(phase, info):
    gc.callbacks.remove(raised_in_the_garbage_collector)
    raise KeyboardInterrupt


def raised_for_a_weak_reference(_):
    raise KeyboardInterrupt


class RaisedWhenDeleted:
    def __del__(self):
        raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["collector", "weak reference", "deletion"])
def test_an_interruption_where_python_ignores_exceptions_is_not_lost(where):
    """JAX has callbacks of the first two kinds."""

    def ignored():
        if where == "collector":
            gc.callbacks.append(raised_in_the_garbage_collector)
            gc.collect()
        elif where == "weak reference":
            target = {0}
            watch = weakref.ref(target, raised_for_a_weak_reference)
            del target
            assert watch() is None
        else:
            RaisedWhenDeleted()
        time.sleep(20)

    with pytest.raises(KeyboardInterrupt), interruptible():
        ignored()


def test_an_interruption_while_another_is_sent_again_is_not_lost(monkeypatch):
    """As on a busy machine, where the moment is over before `start` comes back."""
    start, late = threading.Timer.start, []

    def slow(self):
        start(self)
        if not late:
            late.append(True)
            time.sleep(1)

    def ignored():
        RaisedWhenDeleted()
        time.sleep(20)

    monkeypatch.setattr(threading.Timer, "start", slow)
    with pytest.raises(KeyboardInterrupt), interruptible():
        ignored()


def test_interrupted_comparison_keeps_what_is_finished(tmp_path):
    program = [sys.executable, "-m", "dae_jax", "compare", "pendulum", "--t1", "0.1", "--out", str(tmp_path)]
    running = subprocess.Popen(
        program, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not (tmp_path / "solutions.npz").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=120)
    assert running.returncode == 130
    assert "Traceback" not in err
    assert out == ""
    last = err.splitlines()[-1]
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["method"] == "differentiation"
    assert last == f"dae-jax: interrupted; {len(rows)} of 17 methods are done and kept in {tmp_path}"


def test_interrupted_descent_keeps_its_history(monkeypatch, tmp_path, capsys):
    whole = maps.descent

    def interrupted(*arguments, **keywords):
        yield next(whole(*arguments, **keywords))
        raise KeyboardInterrupt

    monkeypatch.setattr(maps, "descent", interrupted)
    assert main(["tune", "pendulum", "--steps", "20", "--t1", "1", "--out", str(tmp_path)]) == 130
    data = tmp_path / "tune-pendulum.npz"
    assert f"dae-jax: interrupted; the descent so far is in {data}" in capsys.readouterr().err
    with np.load(data) as found:
        assert found["alpha"].shape == (1, 10)


def test_interrupted_sweep_says_how_to_go_on(monkeypatch, tmp_path, capsys):
    def interrupted(*arguments, **keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr(maps, "sweep", interrupted)
    assert main(["sweep", "pendulum", "--points", "2", "--t1", "1", "--out", str(tmp_path)]) == 130
    assert "the same command goes on from there" in capsys.readouterr().err


def test_a_reader_that_has_seen_enough_is_no_failure():
    """As with `| head`."""
    reader, writer = os.pipe()
    os.close(reader)
    program = [sys.executable, "-m", "dae_jax", "analyse", "pendulum"]
    with open(writer, "wb") as out:
        done = subprocess.run(program, cwd=ROOT, stdout=out, stderr=subprocess.PIPE, check=False)
    assert done.returncode == 141
    assert done.stderr == b""
