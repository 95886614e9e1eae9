"""The command line, as a user types it."""

import csv

import numpy as np
import pytest

from dae_jax.cli import main


def test_compare_writes_table_data_and_figures(tmp_path, capsys):
    assert (
        main(["compare", "pendulum", "--t1", "0.5", "--methods", "projection-tsit5,rattle", "--out", str(tmp_path)])
        == 0
    )
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["projection-tsit5", "rattle"]
    assert all(np.isfinite(float(row["error"])) for row in rows)
    assert (tmp_path / "drift.png").stat().st_size > 10_000
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
    assert main(["sweep", "pendulum", "--points", "6", "--t1", "1", "--out", str(tmp_path)]) == 0
    with np.load(tmp_path / "baumgarte-pendulum.npz") as data:
        found = dict(data)
    assert found["loss"].shape == (6, 6)
    # α = β = 10⁴ at steps of 0.05 s is far beyond what an explicit method can.
    assert found["failed"][-1, -1]
    assert not found["failed"][0, 0]
    assert (tmp_path / "baumgarte-pendulum.png").stat().st_size > 10_000
    assert "baumgarte-pendulum.png" in capsys.readouterr().out


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
    assert "α = " in out
    assert "verified with rtol 1e-11" in out
    with np.load(tmp_path / "tune-pendulum.npz") as data:
        assert data["alpha"].shape == (1, 10)


def test_analyse_prints_and_draws_a_system_of_a_module(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "import dae_jax, numpy as np\nintegrator = dae_jax.ImplicitDAE(lambda t, y, yd, a: yd - y), np.ones(1)\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["analyse", "mine:integrator", "--out", "incidence.png"]) == 0
    assert "1 equation, index 0, 1 initial value to choose" in capsys.readouterr().out
    assert (tmp_path / "incidence.png").stat().st_size > 10_000
    for unwritable in ("incidence.xyz", "no-such-folder/incidence.png"):
        with pytest.raises(SystemExit) as end:
            main(["analyse", "mine:integrator", "--out", unwritable])
        assert end.value.code == 2


def test_a_method_that_does_not_apply_says_why(tmp_path, capsys):
    assert main(["compare", "knife-edge", "--t1", "0.5", "--methods", "rattle", "--out", str(tmp_path)]) == 0
    assert "holonomic constraints only" in capsys.readouterr().out


@pytest.mark.parametrize(
    "argv",
    [
        ["compare", "no-such-scene"],
        ["compare", "pendulum", "--methods", "magic"],
        ["compare", "pendulum", "--t1", "-1"],
        ["compare", "pendulum", "--t1", "inf"],
        ["compare", "pendulum", "--rtol", "0"],
        ["compare", "pendulum", "--no-such-option"],
        ["bench", "--parts", "magic"],
        ["sweep", "robertson"],
        ["sweep", "no-such-scene"],
        ["sweep", "angles", "--points", "0"],
        ["tune", "pendulum", "--dt0", "-1"],
        ["tune", "jay"],
        [],
    ],
)
def test_wrong_arguments_end_with_status_2(argv):
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 2
