"""python -m tests.slow TIMES.xml: writes tests/slow.txt, the tests that take more than `LIMIT`, from what
`pytest -n 2 --junitxml=TIMES.xml` has measured; what was not run stays as it was.
"""

import sys
from xml.etree import ElementTree

from tests.conftest import SLOW


# Seconds, on a machine whose cores are all at work.
LIMIT = 2.0
# What is run at each commit however long it takes: what each method promises, what people read first.
ALWAYS = (
    "tests/solvers/test_methods.py",
    "tests/app/test_notebooks.py",
    "tests/house/test_readme.py",
    "tests/house/test_pages.py",
)


def node(case: ElementTree.Element) -> str:
    """The name by which pytest knows a test: its file, and the class in it if there is one."""
    *folders, last = case.get("classname", "").split(".")
    inside = [last] if last[:1].isupper() else []
    path = [*folders, *([] if inside else [last])]
    return "::".join(["/".join(path) + ".py", *inside, case.get("name", "")])


def main(times: str) -> None:
    measured = {node(case): float(case.get("time", 0)) for case in ElementTree.parse(times).getroot().iter("testcase")}
    found = {name for name, time in measured.items() if time > LIMIT} | (
        set(SLOW.read_text().splitlines()) - measured.keys()
    )
    slow = sorted(name for name in found if not name.startswith(ALWAYS))
    SLOW.write_text("".join(f"{name}\n" for name in slow))
    print(f"{len(slow)} slow tests in {SLOW.name}")


if __name__ == "__main__":
    main(*sys.argv[1:])
