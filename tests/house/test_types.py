"""What parameters are called: how many are of any type, and how many of these are pytrees of the user's."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest


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


def names(annotation: ast.expr | None) -> set[str]:
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
