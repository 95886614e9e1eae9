"""python -m tests.slow TIMES.xml: writes tests/slow.txt, the tests that take more than `LIMIT`, from what
`pytest -n 2 --junitxml=TIMES.xml` has measured.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree

from tests.conftest import SLOW


# Seconds, on a machine whose cores are all at work.
LIMIT = 4.0


def node(case: ElementTree.Element) -> str:
    """The name by which pytest knows a test: its file, and the class in it if there is one."""
    *folders, last = case.get("classname", "").split(".")
    inside = [last] if last[:1].isupper() else []
    path = [*folders, *([] if inside else [last])]
    return "::".join(["/".join(path) + ".py", *inside, case.get("name", "")])


def main(times: str) -> None:
    cases = ElementTree.parse(times).getroot().iter("testcase")
    slow = sorted({node(case) for case in cases if float(case.get("time", 0)) > LIMIT})
    SLOW.write_text("".join(f"{name}\n" for name in slow))
    print(f"{len(slow)} slow tests in {Path(SLOW).name}")


if __name__ == "__main__":
    main(*sys.argv[1:])
