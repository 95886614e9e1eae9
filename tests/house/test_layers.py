"""An import only ever points down, and importing the library costs and changes nothing that it need not."""

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


PACKAGE = Path(__file__).parents[2] / "dae_jax"
# Rooms: the folders and files directly below the package. Those on one floor do not know each other.
FLOORS = (
    {"tables", "types"},
    {"_compat", "compiler", "systems"},
    {"scenes", "solution", "structure", "validate"},
    {"linalg"},
    {"equations"},
    {"analyse", "consistent", "diagnostics", "formulations", "solvers"},
    {"driver", "mechanisms"},
    {"solve"},
    {"explain", "studies"},
    {"app"},
    {"__init__", "__main__"},
)
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
FILES = sorted(PACKAGE.rglob("*.py"))
INTEGERS_ONLY = ("blocks", "matching", "pantelides")


def room_of(path: Path) -> str:
    """The file or folder directly below the package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path, tree: ast.AST) -> Iterator[str]:
    """The dotted names that a file imports, made absolute."""
    package = ["dae_jax", *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from . import x` names modules; so does `from .. import x`.
            yield from (f"{module}.{alias.name}" for alias in node.names) if module == "dae_jax" else (module,)


@functools.cache
def parsed(path: Path) -> ast.AST:
    return ast.parse(path.read_text())


@functools.cache
def edges(path: Path) -> frozenset[str]:
    """The rooms of the library that a file imports, its own left out."""
    names = [name.split(".") for name in imported(path, parsed(path))]
    return frozenset(n[1] if len(n) > 1 else "__init__" for n in names if n[0] == "dae_jax") - {room_of(path)}


def name_of(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def test_every_room_has_a_floor():
    assert {room_of(path) for path in FILES} == set(FLOOR)


def test_imports_point_down():
    upward = {
        (name_of(path), room)
        for path in FILES
        for room in edges(path)
        if room not in FLOOR or FLOOR[room] >= FLOOR[room_of(path)]
    }
    assert not upward


def test_the_house_is_small_enough_to_know():
    assert len(FLOOR) <= 26
    assert len(FLOORS) <= 12
    assert len(list(PACKAGE.glob("*.py"))) <= 12


def test_the_compiler_knows_nothing_of_the_rest():
    assert not {(name_of(path), edges(path)) for path in FILES if room_of(path) == "compiler" and edges(path)}


def test_scenes_know_systems_only():
    assert all(edges(path) <= {"systems", "types"} for path in FILES if room_of(path) == "scenes")


def test_matplotlib_inside_functions_of_plotting_only():
    for path in FILES:
        tree, plots = ast.parse(path.read_text()), path.parent.name == "plotting"
        for node in ast.walk(tree):
            if plots and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                node.body = []
        assert not [n for n in imported(path, tree) if n.split(".")[0] == "matplotlib"], name_of(path)


@pytest.mark.parametrize("name", INTEGERS_ONLY)
def test_pantelides_needs_the_standard_library_only(name: str):
    path = PACKAGE / "structure" / f"{name}.py"
    roots = {n.split(".")[0] for n in imported(path, parsed(path))}
    assert roots <= set(sys.stdlib_module_names) | {"dae_jax"}
    assert edges(path) == set()


@pytest.mark.parametrize("x64", ["0", "1"])
def test_import_is_lean_and_changes_no_setting(x64: str):
    program = (
        "import os, sys, jax; before = jax.config.jax_enable_x64; import dae_jax; "
        "assert jax.config.jax_enable_x64 == before; "
        "loaded = {'matplotlib', 'scipy.integrate', 'optax', 'llvmlite'} & set(sys.modules); assert not loaded, loaded"
    )
    environment = {"JAX_ENABLE_X64": x64, "JAX_PLATFORMS": "cpu", "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=PACKAGE.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
