"""One version, said in one place; what is imported is what a wheel asks for."""

import ast
import importlib.metadata
import re
import sys
import tomllib
from pathlib import Path

import dae_jax


ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# A checkout's benchmarks, which the command line runs if they are there.
OWN = {"dae_jax", "benchmarks"}
# What is imported by another name than it is asked for.
ASKED_AS = {"PIL": "pillow"}


def test_version_is_the_same_everywhere():
    version = PROJECT["version"]
    assert dae_jax.__version__ == importlib.metadata.version("dae_jax") == version
    assert re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE) == [version]
    released = re.findall(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[0] == version
    assert released == sorted(released, key=lambda v: [int(n) for n in v.split(".")], reverse=True)


def test_what_is_imported_is_asked_for_with_a_lowest_version():
    asked = {one.partition(">=")[0] for one in PROJECT["dependencies"] if re.fullmatch(r"[\w-]+>=[\d.]+", one)}
    assert len(asked) == len(PROJECT["dependencies"])
    trees = [ast.parse(path.read_text()) for path in (ROOT / "dae_jax").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level}
    packages = {name.partition(".")[0] for name in names} - sys.stdlib_module_names - OWN
    assert {ASKED_AS.get(name, name) for name in packages} == asked
