"""What parameters are called: how many are of any type, and how many of these are pytrees of the user's."""

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import dae_jax
from dae_jax import mechanisms


PACKAGE = Path(__file__).parents[2] / "dae_jax"
# An annotation of these names alone says nothing of what is in it.
CONTAINERS = {"Callable", "Iterable", "Iterator", "Mapping", "Sequence", "dict", "frozenset", "list", "set", "tuple"}
# What a user passes through, of whatever structure he likes.
OF_THE_USER = {"Args", "PyTree", "State", "Y"}


def annotations(source: str) -> Iterator[ast.expr | None]:
    """Those of all parameters but `self` and `cls`, of functions at any depth."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(x for x in (a.vararg, a.kwarg) if x)]
            yield from (x.annotation for x in every if x.arg not in ("self", "cls"))


def names(annotation: ast.AST | None) -> set[str]:
    found = ast.walk(annotation) if annotation else ()
    return {n.id if isinstance(n, ast.Name) else n.attr for n in found if isinstance(n, ast.Name | ast.Attribute)}


def says_nothing(annotation: ast.expr | None) -> bool:
    """Whether there is none, or nothing but `Any` in it."""
    found = names(annotation)
    return annotation is None or ("Any" in found and found <= CONTAINERS | {"Any"})


@pytest.mark.parametrize(
    ("source", "nothing"),
    [
        ("def f(x): ...", True),
        ("def f(x: Any): ...", True),
        ("def f(*x: list[Any]): ...", True),
        ("def f(x: Callable[..., Any] = g): ...", True),
        ("def f(x: dict[str, Any]): ...", False),
        ("def f(x: State): ...", False),
        ("class A:\n  def f(self, x: Array): ...", False),
    ],
)
def test_what_counts(source: str, nothing: bool):
    assert [says_nothing(x) for x in annotations(source)] == [nothing]


def test_one_parameter_in_ten_is_of_any_type_at_most():
    every = [x for path in PACKAGE.rglob("*.py") for x in annotations(path.read_text())]
    assert len(every) > 3000
    assert sum(map(says_nothing, every)) / len(every) <= 0.1
    of_the_user = sum(bool(names(x)) and names(x) <= OF_THE_USER | CONTAINERS | {"None"} for x in every)
    assert of_the_user / len(every) <= 0.1


def public_names() -> set[str]:
    """What `dae_jax/__init__.py` imports by its own name, and the modules and the version that it looks up."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names if a.asname == a.name}
    return imported | {"__version__"}


def test_every_public_name_is_used_in_the_file_that_pyright_reads_strictly():
    source = (Path(__file__).parent / "typed_use.py").read_text()
    assert source.startswith("# pyright: strict")
    missing = (
        public_names()
        - names(ast.parse(source))
        - {a.name for n in ast.walk(ast.parse(source)) if isinstance(n, ast.ImportFrom) for a in n.names}
    )
    assert not missing


def test_shapes_and_types_are_as_the_annotations_say():
    """In a process of its own, since the annotations are checked from the import on."""
    ran = subprocess.run(
        [sys.executable, "-m", "tests.checked_shapes"], cwd=PACKAGE.parent, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr[-3000:]


@pytest.mark.parametrize("module", [dae_jax, mechanisms], ids=["dae_jax", "mechanisms"])
def test_signatures_show_the_names_of_types(module):
    """Help on `distance` began with 2,200 letters, most of what a number may be."""
    for name in sorted(vars(module)):
        function = getattr(module, name)
        if inspect.isfunction(function) and not name.startswith("_"):
            annotations = [str(p.annotation) for p in inspect.signature(function).parameters.values()]
            assert max(map(len, annotations), default=0) <= 160, (name, max(annotations, key=len))
