"""What the command writes: the table as CSV, the page as markdown, the map as a figure."""

import re
from collections import Counter

from . import figure, growth
from .cases import METHODS, ON_THE_CONSTRAINTS, SYMMETRIC
from .families import FAMILIES, cells_of
from .judge import WRONG
from .record import TABLE


PAGE, MAP = "stress.md", "stress.png"
NAMES = (TABLE, PAGE, MAP)
VERDICTS = ("ok", "degraded", "warned", "refused", "failed", "WRONG")
HEAD = """# What each method can take

Written by `dae-jax stress`: {count} solves in {minutes:.0f} minutes; nothing here is typed by hand. The command prints each cell, and
writes all numbers to a table, `stress.csv`.

A cell is judged by a truth that does not come from this library: elliptic functions, closed forms, minimal coordinates by
scipy at 1e-13. Errors are relative to the size of the motion, and drift is |g| and |ġ| relative to what that size makes of them.

- **ok**: the error is at most a thousand tolerances (1e-8 where nothing else is said); of methods with fixed steps h at most ten
  times (ωh)^p a radian of motion. Or words, where words are what must come: a state that does not exist is refused, a
  mechanism beyond its reach fails at its time.
- **degraded** by so many digits below that, with at least two digits left.
- **warned**: fewer than two digits, and an `AccuracyWarning` that says why.
- **refused** before the solve or **failed** in it, with a sentence that says why, though there is an answer.
- **WRONG**: fewer than two digits, and no word.

![Method × stressor](stress.png)

"""


def write(record, folder):
    """The page and the map."""
    cells = record.cells
    minutes = sum(cell.seconds for cell in cells) / 60
    text = [
        HEAD.format(count=len(cells), minutes=minutes),
        _not_measured(record),
        _counted(cells),
        _statements(record),
        growth.table(record.growth),
    ]
    text += [f"{said}\n\n![{said.split(':')[0]}]({name})\n" for name, said in record.figures.items()]
    text += [_family(family, record.of(family)) for family in dict.fromkeys(cell.family for cell in cells)]
    (folder / PAGE).write_text("\n".join(filter(None, text)))
    figure.table(cells).savefig(folder / MAP)


def counts(cells):
    """How many cells of each verdict."""
    found = Counter(cell.verdict for cell in cells)
    return ", ".join(f"{found[verdict]} {verdict}" for verdict in VERDICTS)


def _not_measured(record):
    """Families of which cells are missing, and how many; empty where there are none."""
    lacking = []
    for family in FAMILIES:
        cells = cells_of(family, METHODS, False)
        missing = len(set(cells) - {(cell.stressor, cell.method) for cell in record.of(family)})
        if missing:
            lacking.append(
                f"{family}, all {missing}" if missing == len(cells) else f"{family}, {missing} of {len(cells)}"
            )
    return f"**Not measured** yet, and not in what follows: the cells of {'; '.join(lacking)}.\n" if lacking else ""


def _counted(cells):
    lines = [f"| method | {' | '.join(VERDICTS)} |", "|---|" + "---:|" * len(VERDICTS)]
    for method in [*METHODS, "all"]:
        found = Counter(cell.verdict for cell in cells if method in (cell.method, "all"))
        if found:
            lines.append(f"| {method} | {' | '.join(str(found[verdict] or '') for verdict in VERDICTS)} |")
    return "\n".join(["## Cells by verdict", "", *lines, ""])


def _statements(record):
    """What is promised, and whether the table shows it."""
    cells = record.cells
    okay = [cell for cell in cells if cell.verdict == "ok" and cell.ended == "answer"]
    lines = ["## What is promised", ""]
    off = [
        cell for cell in okay if cell.method in ON_THE_CONSTRAINTS and cell.drift >= 0 and cell.stressor != "float32"
    ]
    for method in dict.fromkeys(cell.method for cell in off):
        mine = [cell for cell in off if cell.method == method]
        worst = max(mine, key=lambda cell: cell.drift)
        lines.append(
            f"- {method} is on the constraints to 1e-11 in {sum(cell.drift <= 1e-11 for cell in mine)} of the {len(mine)} cells that "
            f"it passes in float64; the largest drift is {worst.drift:.0e} ({worst.stressor})."
        )
    for stressor, by in record.growth.items():
        trends = [f"{method} {by[method]['trend of the energy']:.2f}" for method in SYMMETRIC if method in by]
        if trends:
            lines.append(f"- The trend of the energy, as a part of its swing, {stressor}: {', '.join(trends)}.")
    if okay:
        worst = max(okay, key=lambda cell: cell.error / cell.allowed)
        lines.append(
            f"- In each of the {len(okay)} `ok` cells with an answer the error is at most what is allowed; the closest is "
            f"{worst.error:.1e} of {worst.allowed:.0e} ({worst.method}, {worst.stressor})."
        )
    wrong = [f"{cell.method}, {cell.stressor}" for cell in cells if cell.verdict == "WRONG"]
    said = f"{len(wrong)}: " + "; ".join(wrong) if wrong else "none"
    lines.append(f"- Cells with fewer than two digits ({WRONG:g}) and no word: {said}.")
    return "\n".join([*lines, ""])


def _family(family, cells):
    """One table: stressors down, methods across, and the sentences that solves ended in."""
    by = {(cell.stressor, cell.method): cell for cell in cells}
    methods = [name for name in METHODS if any(cell.method == name for cell in cells)]
    doc = " ".join(
        (
            FAMILIES[family].__doc__ if family in FAMILIES else "A scene of the library under stressors that fit all."
        ).split()
    )
    lines = [f"## {family}", "", doc, "", f"| | {' | '.join(methods)} |", "|---|" + "---|" * len(methods)]
    words: dict[str, int] = {}
    for stressor in dict.fromkeys(cell.stressor for cell in cells):
        row = [_entry(by.get((stressor, method)), words) for method in methods]
        lines.append(f"| {stressor} | {' | '.join(row)} |")
    lines += ["", *(f"{number}. {said}" for said, number in words.items()), ""]
    return "\n".join(lines)


def _entry(cell, words):
    if cell is None:
        return ""
    if cell.ended == "answer" and cell.verdict != "warned":
        lost = f" −{cell.lost:.1f}" if cell.verdict == "degraded" else ""
        return f"{cell.verdict}{lost} {cell.error:.0e}"
    said = re.sub(r" The solve from t = .*", "", cell.words)
    number = words.setdefault(re.sub(r"-?\d+\.?\d*e?[-+]?\d*", "…", said)[:400], len(words) + 1)
    at = f" at {cell.end:.3g} s" if cell.ended == "failed" and cell.end == cell.end else ""
    return f"{cell.verdict}{'' if cell.verdict == cell.ended else f', {cell.ended}'}{at} ({number})"
