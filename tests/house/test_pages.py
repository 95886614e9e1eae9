"""The pages beside the notebooks say what is true: their programs run, their links lead somewhere, none is out of date."""

import functools
import importlib.util
import re
from pathlib import Path

import pytest

import dae_jax
from dae_jax._compat import messages
from dae_jax.app.compare import Row, methods


ROOT = Path(__file__).parents[2]
NOTEBOOKS = ROOT / "notebooks"
PAGES = sorted(p for p in ROOT.rglob("*.md") if not {".venv", ".pytest_cache"} & set(p.relative_to(ROOT).parts))
CODES = {name: messages(dae_jax.RESULTS)[int(code._value)] for name, code in dae_jax.RESULTS._name_to_item.items()}


@functools.cache
def writer(folder):
    spec = importlib.util.spec_from_file_location(f"write_{folder}", NOTEBOOKS / folder / "write.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def programs(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


class TestReference:
    def test_is_up_to_date(self):
        folder = NOTEBOOKS / "reference"
        found = {path.name: path.read_text() for path in folder.glob("*.md")}
        assert found == writer("reference").pages(), "run `python notebooks/reference/write.py`"

    def test_has_every_public_name_with_its_signature(self):
        reference = writer("reference")
        on_pages = {id(reference._value(name)): page for page in reference.PAGES for name in reference.names_of(page)}
        for module in reference.MODULES:
            for name, value in reference.public(reference._value(module)).items():
                text = (NOTEBOOKS / "reference" / f"{on_pages[id(value)]}.md").read_text()
                assert re.search(rf"^dae_jax\.(\w+\.)?{name}\b", text, re.MULTILINE), (module, name)

    def test_says_something_of_every_name(self):
        reference = writer("reference")
        names = [name for page in reference.PAGES for name in reference.names_of(page)]
        assert len(names) > 100
        assert not [name for name in names if len(reference._summary(name)) < 10]


def anchors(path):
    """The headings of a page as GitHub links to them; what is in a block of code is no heading."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", path.read_text(), flags=re.M | re.S), re.M)
    plain = [writer("reference").slug(heading) for heading in headings]
    return {f"{s}-{plain[:k].count(s)}" if s in plain[:k] else s for k, s in enumerate(plain)}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.M | re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, fragment = target.partition("#")
        goal = (path.parent / file).resolve() if file else path
        assert goal.exists(), target
        assert not fragment or fragment in anchors(goal), target


ERRORS = (NOTEBOOKS / "errors.md").read_text()
SECTIONS = dict(re.findall(r"^### `(\w+)`\n(.*?)(?=^##)", ERRORS, re.MULTILINE | re.DOTALL))


class TestErrors:
    def test_has_every_code(self):
        named = set(SECTIONS) | set(re.findall(r"`(\w+)`", ERRORS.split("## Codes without an example")[1]))
        assert set(CODES) <= named
        assert set(SECTIONS) <= set(CODES)

    def test_sentences_are_those_that_are_raised(self):
        for name, section in SECTIONS.items():
            quoted = " ".join(re.findall(r"^> (.*)$", section, re.MULTILINE))
            assert quoted == " ".join(CODES[name].split()), name

    @pytest.fixture
    def names(self):
        found: dict = {}
        exec(programs(ERRORS)[0], found)
        return found

    def test_programs_end_in_their_codes(self, names):
        for name, section in SECTIONS.items():
            (program,) = programs(section)
            exec(program, names)
            assert names["result"] == getattr(dae_jax.RESULTS, name), (name, names["result"])

    def test_exceptions_are_raised(self, names):
        for program in programs(ERRORS.split("## Exceptions")[1].split("## Warnings")[0]):
            exec(program, names)

    def test_warnings_are_given(self, names):
        for program in programs(ERRORS.split("## Warnings")[1]):
            exec(program, names)


class TestWhichMethod:
    TEXT = (NOTEBOOKS / "which_method.md").read_text()

    def test_tables_have_every_method_of_their_scene(self):
        tables = writer("which_method").tables(self.TEXT)
        assert len(tables) >= 4
        for name, table in tables.items():
            rows = re.findall(r"^\| `([\w-]+)`", table, re.MULTILINE)
            assert rows == list(methods(dae_jax.scenes.SCENES[name]())), "run `python notebooks/which_method/write.py`"

    def test_a_table_is_what_is_measured(self):
        """Robertson's, whose three solves are short: steps and errors, some of which are round-off, are those of the page."""
        with dae_jax.configure(optimise=True):
            measured = writer("which_method").table("robertson")
        kept, found = (
            re.findall(r"^\| `([\w-]+)` \| (\d+) \|.*?\|.*?\| (\S+) \|", table, re.MULTILINE)
            for table in (writer("which_method").tables(self.TEXT)["robertson"], measured)
        )
        assert len(kept) == len(found) == 3
        for (name, steps, error), (method, count, off) in zip(kept, found, strict=True):
            assert method == name
            assert int(count) == pytest.approx(int(steps), rel=0.05)
            assert 0.1 < float(off) / float(error) < 10

    def test_refusals_are_rows(self):
        row = writer("which_method")._cells(Row("radau", reason="a | b"), "")
        assert row.count("|") == len(re.findall(r"\|", writer("which_method").HEAD)) + 1


@pytest.mark.parametrize("page", ["coming_from", "which_method"])
def test_programs_run(page):
    found = programs((NOTEBOOKS / f"{page}.md").read_text())
    assert found
    exec("\n".join(found), {})
