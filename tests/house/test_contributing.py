"""What CONTRIBUTING says of the code is true of it."""

import re
from pathlib import Path

from tests.break_formulas import BREAKS
from tests.conftest import GONE
from tests.house.test_layers import FLOORS


ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()


def test_the_way_of_y0_names_what_is_there():
    found = re.findall(r"`(dae_jax/[\w/]+\.py)` `(\w+)`", TEXT)
    assert len(found) >= 8
    for path, name in found:
        assert re.search(rf"^\s*(def|class) {name}\b", (ROOT / path).read_text(), re.MULTILINE), (path, name)


def test_formulas_to_break_stand_where_they_are_looked_for():
    """Each once: a formula that has changed since would no longer be broken by `tests/break_formulas.py`."""
    for name, formula in BREAKS.items():
        assert (ROOT / "dae_jax" / formula.path).read_text().count(formula.old) == 1, name


def test_slow_tests_are_there(pytestconfig):
    """Else `python -m tests.slow` writes the list anew."""
    assert not pytestconfig.stash.get(GONE, set())


def test_files_that_are_named_exist():
    for path in re.findall(r"(?<![\w/])((?:dae_jax|tests)/[\w/]+(?:\.py|\.md)?)", TEXT):
        assert (ROOT / path).exists(), path


def test_the_house_is_that_of_the_layers():
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", TEXT, re.MULTILINE)
    assert [set(re.findall(r"`(\w+)`", rooms)) for _, rooms in rows] == [set(f) for f in FLOORS[:-1]]
