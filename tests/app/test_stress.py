"""`dae-jax stress`: what it writes, and that its judge finds what is wrong."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stress import growth, page
from benchmarks.stress.cases import Case
from benchmarks.stress.families import FAMILIES, cases_of
from benchmarks.stress.judge import judged
from benchmarks.stress.record import Record
from benchmarks.stress.runner import run
from benchmarks.stress.solve import Outcome, solved
from dae_jax.app.cli import main


NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def test_the_command_writes_table_page_and_map(tmp_path, capsys):
    argv = ["stress", "--quick", "--methods", "rattle", "--stressors", "broken", "--out", str(tmp_path)]
    assert main(argv) == 0
    with (tmp_path / "stress.csv").open() as file:
        rows = {row["stressor"]: row for row in csv.DictReader(file)}
    assert {row["verdict"] for row in rows.values()} == {"ok"}
    assert rows["force NaN after 1 s"]["ended"] == "failed"
    assert rows["start off by 1e-2"]["ended"] == "refused"
    assert 0 < float(rows["start off by 1e-14"]["error"]) < float(rows["start off by 1e-14"]["allowed"])
    said = (tmp_path / "stress.md").read_text()
    assert "| rattle | 5 |" in said
    assert "violates the constraints" in said
    assert (tmp_path / "stress.png").stat().st_size > 10_000
    assert "5 ok, 0 degraded, 0 warned, 0 refused, 0 failed, 0 WRONG" in capsys.readouterr().out
    # Another method is added to what is there.
    argv[argv.index("rattle")] = "state-space"
    assert main(argv) == 0
    assert "10 ok, 0 degraded" in capsys.readouterr().out
    said = (tmp_path / "stress.md").read_text()
    assert "| rattle | 5 |" in said
    assert "| state-space | 5 |" in said


def test_a_cell_without_an_answer_is_an_entry_and_the_next_ones_are_solved():
    found = [cell for cell, _ in run("broken", [("start off by 1e-14", "radau-ggl")], True, limit=0.01)]
    assert [(cell.verdict, cell.words) for cell in found] == [("failed", "no answer in 0.01 s of processor time")]


def case(**rest):
    truth = lambda times: (np.zeros((len(times), 1)), np.zeros((len(times), 1)))
    return Case("", None, (np.zeros(1), np.zeros(1)), 10.0, truth, **rest)


@pytest.mark.parametrize(
    ("verdict", "outcome", "rest"),
    [
        ("ok", Outcome("answer", error=9e-6), {}),
        ("degraded", Outcome("answer", error=1e-3), {}),
        ("WRONG", Outcome("answer", error=0.1), {}),
        ("WRONG", Outcome("answer", error=np.nan), {}),
        ("WRONG", Outcome("answer", error=np.inf), {}),
        ("refused", Outcome("refused", "…"), {}),
        ("failed", Outcome("failed", "…", end=5.0), {}),
        ("ok", Outcome("failed", "…", end=5.01), {"due": "failure", "ends": 5.0}),
        ("failed", Outcome("failed", "…", end=4.0), {"due": "failure", "ends": 5.0}),
        ("WRONG", Outcome("failed", "…", end=6.0), {"due": "failure", "ends": 5.0}),
        ("WRONG", Outcome("answer", error=0.0), {"due": "failure", "ends": 5.0}),
        ("WRONG", Outcome("answer", error=0.0), {"due": "refusal"}),
        ("ok", Outcome("refused", "…"), {"due": "refusal"}),
        ("ok", Outcome("refused", "…"), {"due": "any"}),
        ("WRONG", Outcome("answer", error=0.1), {"due": "any"}),
        ("WRONG", Outcome("answer", error=0.0), {"due": "words"}),
        ("warned", Outcome("answer", "…", error=0.1), {"due": "words"}),
        ("warned", Outcome("answer", "…", error=0.1), {}),
        ("degraded", Outcome("answer", "…", error=1e-3), {}),
        ("WRONG", Outcome("answer", "…", error=0.0), {"due": "failure", "ends": 5.0}),
    ],
)
def test_verdicts(verdict, outcome, rest):
    assert judged("", case(**rest), "projection-tsit5", outcome).verdict == verdict


def test_the_judge_finds_an_error_that_is_put_in():
    """A truth that is off by a tenth of a second."""
    right = next(c for c in cases_of("scales", True) if c.name == "as it is")
    late = dataclasses.replace(right, truth=lambda times: right.truth(np.asarray(times) + 0.03))
    verdicts = [judged("scales", c, "rattle", solved(c, "rattle")).verdict for c in (right, late)]
    assert verdicts == ["ok", "WRONG"]


def test_growth_laws():
    times = np.linspace(0, 100, 1001)
    assert growth.exponent(times, 3e-8 * times**2) == pytest.approx(2, abs=0.01)
    assert growth.exponent(times, np.sin(times)) == pytest.approx(0, abs=0.1)
    assert growth.trend(times) > 0.7
    assert growth.trend(np.sin(times)) < 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_truths_begin_at_the_start(family):
    """Unless a start is off on purpose."""
    names: set[tuple[str, tuple[str, ...]]] = set()
    for found in cases_of(family, False):
        assert (found.name, found.only) not in names
        names.add((found.name, found.only))
        if found.due in ("answer", "any"):
            rounding = 1e4 * np.finfo(found.y0[0].dtype).eps
            for x, e, size in zip(found.y0, found.truth(np.array([0.0, found.t1 / 8])), found.size, strict=True):
                np.testing.assert_allclose(x / size, e[0] / size, rtol=0, atol=rounding + 2 * found.off)


def test_the_page_of_the_repository_is_that_of_its_table(tmp_path):
    """And has all cells that there are."""
    record = Record.read(NOTEBOOKS)
    page.write(record, tmp_path)
    assert (tmp_path / page.PAGE).read_text() == (NOTEBOOKS / page.PAGE).read_text()
    assert "Not measured" not in (NOTEBOOKS / page.PAGE).read_text()
    for name in (page.MAP, *record.figures):
        assert (NOTEBOOKS / name).stat().st_size > 10_000


def test_counts_are_those_of_the_cells():
    cells = [judged("", case(), "rattle", Outcome("answer", error=x)) for x in (0.0, 1.0)]
    assert page.counts(cells) == "1 ok, 0 degraded, 0 warned, 0 refused, 0 failed, 1 WRONG"
