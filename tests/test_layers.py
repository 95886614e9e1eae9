"""An import only ever points down, and importing the library costs and changes nothing that it need not."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


PACKAGE = Path(__file__).parent.parent / "dae_jax"
LAYERS = (
    {"_compat", "compiler", "interrupts", "linalg", "progress", "structure"},
    {
        "constraints",
        "initialise",
        "normals",
        "offsets",
        "pencil",
        "rates",
        "reduced",
        "regularity",
        "residual",
        "residual_drift",
        "states",
        "systems",
        "taylor",
        "underlying",
        "user_functions",
    },
    {"formulations", "solvers"},
    {
        "analyse",
        "checks",
        "diagnostics",
        "explain",
        "failures",
        "jumps",
        "program",
        "solution",
        "solve",
        "solve_options",
        "tape",
    },
    {"baumgarte_loss", "compare", "figures", "maps", "plotting", "reductions", "scenes", "sweep", "sweep_store", "tune"},
    {"__main__", "cli", "options"},
)
LAYER = {unit: level for level, units in enumerate(LAYERS) for unit in units}
FILES = sorted(PACKAGE.rglob("*.py"))
INTEGERS_ONLY = ("blocks", "matching", "pantelides")


def unit_of(path: Path) -> str:
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


def edges(path: Path) -> set[str]:
    """The units of the library that a file imports, its own left out."""
    names = [name.split(".") for name in imported(path, ast.parse(path.read_text()))]
    return {n[1] if len(n) > 1 else "" for n in names if n[0] == "dae_jax"} - {unit_of(path)}


def ids(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", [f for f in FILES if f != PACKAGE / "__init__.py"], ids=ids)
class TestEdges:
    def test_unit_has_a_layer(self, path: Path):
        assert unit_of(path) in LAYER, "state the layer of this file in LAYERS"

    def test_imports_point_down(self, path: Path):
        upward = {
            name
            for name in edges(path)
            # What is imported from the package itself, not from the file that has it, cannot be placed.
            if name not in LAYER or LAYER[name] > LAYER[unit_of(path)]
        }
        assert not upward

    def test_compiler_knows_nothing_of_the_rest(self, path: Path):
        if unit_of(path) == "compiler":
            assert not edges(path)

    def test_siblings(self, path: Path):
        allowed = {"formulations": "solvers", "solvers": "formulations"}
        assert allowed.get(unit_of(path)) not in edges(path)

    def test_scenes_import_systems_only(self, path: Path):
        if unit_of(path) == "scenes":
            assert edges(path) <= {"systems"}

    def test_matplotlib_inside_functions_of_plotting_only(self, path: Path):
        tree = ast.parse(path.read_text())
        anywhere = [n for n in imported(path, tree) if n.split(".")[0] == "matplotlib"]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and unit_of(path) == "plotting":
                node.body = []
        eager = [n for n in imported(path, tree) if n.split(".")[0] == "matplotlib"]
        assert not eager
        assert not anywhere or unit_of(path) == "plotting"


@pytest.mark.parametrize("name", INTEGERS_ONLY)
def test_pantelides_needs_the_standard_library_only(name: str):
    path = PACKAGE / "structure" / f"{name}.py"
    roots = {n.split(".")[0] for n in imported(path, ast.parse(path.read_text()))}
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
