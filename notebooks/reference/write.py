"""The API reference, from the docstrings: `python notebooks/reference/write.py` writes the pages beside this file."""

import ast
import functools
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import dae_jax


HERE = Path(__file__).parent
ROOT = HERE.parents[1]
WIDTH = 100

# Page: its title, what it is about, and its names: `module.*` stands for all public names of a module that no page has.
PAGES = {
    "problems": ("Problems", "The equations, as they are written.", "ConstrainedSystem SemiExplicitDAE ImplicitDAE"),
    "solving": (
        "Solving",
        "One solve, its result, and how it ended; [errors](../errors.md) has each code with an example.",
        "daesolve DAESolution RESULTS AccuracyWarning",
    ),
    "formulations": (
        "Formulations",
        "Which equations are integrated.",
        "Differentiation Baumgarte StateSpace DummyDerivatives Residual GGL AbstractFormulation "
        "AbstractFieldFormulation AbstractResidualFormulation",
    ),
    "solvers": (
        "Solvers",
        "How a step is taken; beside these, any solver of diffrax. [Which method when](../which_method.md).",
        "OrthogonalProjection TangentSpace SymmetricProjection Trapezoid Midpoint Gauss4 RATTLE DOP853 RadauIIA5 "
        "RadauIIA9 RadauIIA13 Radau BDF GMRES AbstractManifoldSolver AbstractResidualSolver",
    ),
    "starts_and_events": (
        "Starts and events",
        "States that satisfy the equations; what interrupts a solve.",
        "consistent_state Reset Jump",
    ),
    "diagnostics": ("Diagnostics", "What a solution keeps, and by which forces.", "drift Drift EquationDrift energy multipliers"),
    "structure": (
        "Structure",
        "What a system is, and what is done with it.",
        "analyse Structure explain Plan MechanicalPlan StructuralPlan ResidualPlan",
    ),
    "studies": (
        "Studies",
        "Many solves: sweeps, what to keep of each, tuning, parameters from data.",
        "sweep grid Grid tune Tuned identify Identified baumgarte_loss BaumgarteLoss reductions.*",
    ),
    "compiler": (
        "Compiler",
        "Any JAX function of small arrays and loops as machine code; [how it works](../../dae_jax/compiler/README.md). "
        "`jit` and `configure` are for everybody, the rest for those who build on it.",
        "compiler.jit compiler.Jitted configure compiler.*",
    ),
    "scenes": ("Scenes", "Ready systems, each with a reference of its own.", "scenes.Scene scenes.Drawing scenes.*"),
    "mechanisms": (
        "Mechanisms",
        "Bodies, joints, loads and files, as a system like any other.",
        "mechanisms.Body mechanisms.ground mechanisms.Mechanism mechanisms.revolute mechanisms.prismatic mechanisms.cylindrical "
        "mechanisms.spherical mechanisms.universal mechanisms.planar mechanisms.fixed mechanisms.distance mechanisms.*",
    ),
    "plotting": ("Plotting", "Figures; matplotlib is imported when one is drawn.", "plotting.*"),
}  # fmt: skip
MODULES = ("", "reductions", "compiler", "scenes", "mechanisms", "plotting")


def public(module: ModuleType) -> dict[str, Any]:
    """The names of a module that are for others: what is defined in its file or folder, or brought into its `__init__`."""
    package = hasattr(module, "__path__")
    return {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not inspect.ismodule(value)
        and (package or getattr(value, "__module__", "") == module.__name__)
        and getattr(value, "__module__", "dae_jax").startswith("dae_jax")
        and not (callable(value) and not hasattr(value, "__module__"))
    }


def names_of(page: str) -> list[str]:
    """The dotted names on a page, in its order."""
    named = [name for _, _, names in PAGES.values() for name in names.split()]
    found: list[str] = []
    for name in PAGES[page][2].split():
        module, _, rest = name.rpartition(".")
        if rest != "*":
            found.append(name)
            continue
        known = {id(_value(n)) for n in named if not n.endswith("*")}
        found += [f"{module}.{n}" for n, v in sorted(public(_value(module)).items()) if id(v) not in known]
    return found


def pages() -> dict[str, str]:
    """{file name: text} of the whole reference."""
    contents = [
        "# Reference",
        "",
        "Every public name, with its equations, shapes, errors and source. Written from the docstrings by",
        "`python notebooks/reference/write.py`; a test compares them.",
        "",
    ]
    for page, (title, about, _) in PAGES.items():
        links = ", ".join(f"[`{n}`]({page}.md#{a})" for n, a in zip(names_of(page), _anchors(page), strict=True))
        contents += [f"**[{title}]({page}.md)**: {about}", "", links, ""]
    return {"README.md": _ended(contents)} | {f"{page}.md": _ended(_page(page)) for page in PAGES}


def _page(page: str) -> Iterator[str]:
    title, about, _ = PAGES[page]
    names = names_of(page)
    yield from (f"# {title}", "", f"{about} Back to the [reference](README.md).", "", "| | |", "|---|---|")
    for name, anchor in zip(names, _anchors(page), strict=True):
        yield f"| [`{name}`](#{anchor}) | {_summary(name)} |"
    for name in names:
        yield from ("", f"## {name}", "", *_entry(name))


def _ended(lines: Any) -> str:
    return "\n".join(line.rstrip() for line in lines).strip() + "\n"


def _anchors(page: str) -> list[str]:
    """Where GitHub jumps to: the heading in small letters; the second of its kind with a number."""
    plain = [slug(title) for title in (PAGES[page][0], *names_of(page))]
    counts = [plain[:k].count(s) for k, s in enumerate(plain)]
    return [f"{s}-{n}" if n else s for s, n in zip(plain, counts, strict=True)][1:]


def slug(heading: str) -> str:
    """The anchor of a heading: small letters, without punctuation, hyphens for spaces."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def _value(name: str) -> Any:
    return functools.reduce(getattr, [part for part in name.split(".") if part], dae_jax)


def _summary(name: str) -> str:
    """The first sentence, without an end that leads over to an equation."""
    first = " ".join(_words(name).split("\n\n")[0].split())
    first = re.split(r"(?<=[^\sA-Z][.])\s+(?=[A-ZΑ-Ω`\[(])", first)[0]
    return first.rstrip(".,:").replace("|", r"\|")


def _words(name: str) -> str:
    value = _value(name)
    if callable(value):
        return inspect.getdoc(value) or ""
    return _comment(name)


def _entry(name: str) -> Iterator[str]:
    value = _value(name)
    yield from ("```python", signature(name), "```", "", *_markdown(_words(name)))
    if hasattr(value, "_index_to_message") or (isinstance(value, type) and issubclass(value, Warning)):
        members = [ast.unparse(node.targets[0]) for node in _tree(value).body if isinstance(node, ast.Assign)]
        yield from ("", *(f"- `{member}`: {value[getattr(value, member)]}" for member in members))
    elif isinstance(value, type):
        for member, of_class in _members(value).items():
            call = _parameters(of_class, None) if inspect.isfunction(of_class) else ""
            doc = inspect.getdoc(of_class) or ""
            yield from ("", f"### `{name}.{member}{call}`", "", *_markdown(doc))
    yield from ("", f"Defined in [`{_file(name)}`](../../{_file(name)})")


def _members(kind: type) -> dict[str, Any]:
    """Public methods and properties that say what they do, but for those that an interface on another page describes."""
    bases = [base for base in reversed(kind.__mro__) if base.__module__.startswith("dae_jax")]
    described = {m for base in bases[:-1] if base.__name__.startswith("Abstract") for m in vars(base)}
    return {
        member: value
        for base in bases
        for member, value in vars(base).items()
        if not member.startswith("_")
        and (member not in described)
        and (inspect.isfunction(value) or isinstance(value, property))
        and value.__doc__
    }


def signature(name: str) -> str:
    """How a name is called, with the annotations and defaults as they are written in the source."""
    value = _value(name)
    if not callable(value):
        return f"dae_jax.{name}"
    if hasattr(value, "_index_to_message") or (isinstance(value, type) and issubclass(value, Warning)):
        return f"dae_jax.{name}"
    returns = ""
    if inspect.isfunction(value):
        node = _tree(value)
        returns = f" -> {_unquoted(node.returns)}" if node.returns else ""
    return f"dae_jax.{name}{_parameters(value, WIDTH - len(name) - 8 - len(returns))}{returns}"


def _parameters(value: Any, width: int | None) -> str:
    written = _written(value)
    parts: list[str] = []
    keyword_only = False
    for parameter in inspect.signature(value).parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword_only:
            parts.append("*")
            keyword_only = True
        if parameter.kind is parameter.VAR_POSITIONAL:
            keyword_only = True
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        annotation, default = written.get(parameter.name, ("", ""))
        text = stars + parameter.name + (f": {annotation}" if annotation else "")
        if parameter.default is not parameter.empty:
            text += (" = " if annotation else "=") + (default or "...")
        parts.append(text)
    line = f"({', '.join(parts)})"
    if width is None or len(line) <= width:
        return line
    return "(\n" + "".join(f"    {part},\n" for part in parts) + ")"


def _written(value: Any) -> dict[str, tuple[str, str]]:
    """{parameter: (annotation, default)} as text, of a function, or of the fields and `__init__` of a class."""
    if not isinstance(value, type):
        return _arguments(_tree(inspect.unwrap(value)))
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(value.__mro__):
        if not base.__module__.startswith("dae_jax"):
            continue
        for node in _tree(base).body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found[node.target.id] = (ast.unparse(node.annotation), _default(node.value))
            elif isinstance(node, ast.FunctionDef) and node.name == "__init__":
                found |= _arguments(node)
    return found


def _default(node: Any) -> str:
    """The default of a field, which may be an argument of `field(...)`."""
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("field"):
        node = next((k.value for k in node.keywords if k.arg == "default"), None)
    return ast.unparse(node) if node else ""


def _arguments(node: Any) -> dict[str, tuple[str, str]]:
    plain = [*node.args.posonlyargs, *node.args.args]
    defaults = [None] * (len(plain) - len(node.args.defaults)) + node.args.defaults
    pairs = [*zip(plain, defaults, strict=True), *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)]
    pairs += [(a, None) for a in (node.args.vararg, node.args.kwarg) if a]
    return {
        a.arg: (_unquoted(a.annotation) if a.annotation else "", ast.unparse(d) if d else "") for a, d in pairs
    }  # fmt: skip


def _unquoted(annotation: ast.expr) -> str:
    return str(annotation.value) if isinstance(annotation, ast.Constant) else ast.unparse(annotation)


def _tree(value: Any) -> Any:
    return ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]


def _file(name: str) -> str:
    value = _value(name)
    if not callable(value):
        return _assignment(name)[0].relative_to(ROOT).as_posix()
    return (
        Path(inspect.getsourcefile(inspect.unwrap(value)) or "")
        .relative_to(Path(dae_jax.__file__).parents[1])
        .as_posix()
    )


def _assignment(name: str) -> tuple[Path, int, list[str]]:
    """Where a constant is written down: the file, the line and all lines."""
    module, _, constant = name.rpartition(".")
    home = Path(importlib.import_module(_value(module).__name__).__file__ or "")
    for path in (home, *sorted(home.parent.rglob("*.py"))):
        lines = path.read_text().splitlines()
        for k, line in enumerate(lines):
            if re.match(rf"{constant}(:.*)? = ", line):
                return path, k, lines
    raise LookupError(name)


def _comment(name: str) -> str:
    """The comment above a constant."""
    _, k, lines = _assignment(name)
    said: list[str] = []
    while k and lines[k - 1].startswith("# "):
        k -= 1
        said.insert(0, lines[k][2:])
    return "\n".join(said)


def _markdown(doc: str) -> Iterator[str]:
    """A docstring as markdown: what is indented after an empty line is a block of its own, headings are bold."""
    lines, k = doc.splitlines(), 0
    while k < len(lines):
        if lines[k].startswith("    ") and (k == 0 or not lines[k - 1].strip()):
            end = k
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            yield from ("```text", *textwrap.dedent("\n".join(lines[k:end])).strip("\n").splitlines(), "```", "")
            k = end
        else:
            yield re.sub(r"^(Errors?|Source|Sources):", r"**\1:**", lines[k])
            k += 1


def main() -> None:
    """Writes the pages, and takes away what is none any more."""
    written = pages()
    for path in HERE.glob("*.md"):
        if path.name not in written:
            path.unlink()
    for name, text in written.items():
        (HERE / name).write_text(text)


if __name__ == "__main__":
    main()
