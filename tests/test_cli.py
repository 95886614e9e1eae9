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
    assert np.load(tmp_path / "solutions.npz")["rattle_q"].shape == (501, 2)


def test_compare_takes_problems_that_are_no_mechanisms(tmp_path, capsys):
    assert main(["compare", "jay", "--rtol", "1e-6", "--methods", "radau", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "errors relative" in out
    assert "–" in out
    assert np.load(tmp_path / "solutions.npz")["radau_x"].shape == (501, 4)
    assert (tmp_path / "solution-radau.png").stat().st_size > 10_000


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
        [],
    ],
)
def test_wrong_arguments_end_with_status_2(argv):
    with pytest.raises(SystemExit) as end:
        main(argv)
    assert end.value.code == 2
