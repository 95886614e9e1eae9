"""One version, said in one place; and what a wheel says of itself is what is tested."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

import dae_jax


ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_version_is_the_same_everywhere():
    version = PROJECT["version"]
    assert dae_jax.__version__ == importlib.metadata.version("dae_jax") == version
    assert re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == version
    released = re.findall(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[0] == version
    assert released == sorted(released, key=lambda v: [int(n) for n in v.split(".")], reverse=True)


def test_what_contributing_says_of_versions_is_what_the_project_asks_for():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    rows = dict(re.findall(r"^\| `?([\w-]+)`? \| ([\d.]+) \|", text, re.MULTILINE))
    asked = {name: bound for name, bound in re.findall(r"([\w-]+)>=([\d.]+)", " ".join(PROJECT["dependencies"]))}
    asked["python"] = PROJECT["requires-python"].removeprefix(">=")
    assert rows == asked
