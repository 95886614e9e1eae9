"""What keeps the compiler readable, and its judge right: sizes, bases, declared types, and that what is annotated is written."""

import ast
import statistics
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import Annotated, annotate, lowering, unsupported, written
from dae_jax.compiler.lower.dtypes import ALL
from dae_jax.compiler.lower.registry import RULES


FOLDER = Path(dae_jax.__file__).parent / "compiler"
TREES = {path: ast.parse(path.read_text()) for path in sorted(FOLDER.rglob("*.py"))}
X = np.array([0.3, -0.7, 1.2])


def nodes(kind):
    return [(path, node) for path, tree in TREES.items() for node in ast.walk(tree) if isinstance(node, kind)]


def test_files_and_functions_are_short():
    assert [path.name for path in TREES if len(path.read_text().splitlines()) > 300] == []
    lengths = {(path.name, f.name): f.end_lineno - f.lineno + 1 for path, f in nodes(ast.FunctionDef)}
    assert [name for name, length in lengths.items() if length > 60] == []
    assert statistics.median(lengths.values()) <= 8


def test_no_tower_of_classes():
    """Of the classes that one comes from at most one is of the compiler's own."""
    bases = {node.name: [ast.unparse(b).split(".")[-1] for b in node.bases] for _, node in nodes(ast.ClassDef)}

    def ancestors(name):
        return [a for b in bases.get(name, []) if b in bases for a in (b, *ancestors(b))]

    assert {name: found for name in bases if len(found := ancestors(name)) > 1} == {}


def test_every_rule_declares_its_types():
    assert len(RULES) > 100
    for name, rule in RULES.items():
        assert rule.dtypes, name
        assert all(types and types <= ALL for types in rule.dtypes), name


def program(seed):
    """A function of three numbers: operations put together at random, on arrays in registers and in memory."""
    rng = np.random.default_rng(seed)
    size = int(rng.choice([3, 9, 30, 600, 5000]))
    lax = jax.lax
    operations = [
        lambda a, k: jnp.cumsum(a), lambda a, k: a[::-1], lambda a, k: jnp.sum(a) * a, lambda a, k: a.at[k].multiply(2.0),
        lambda a, k: lax.dynamic_slice(a, (k,), (a.size // 2 + 1,)), lambda a, k: jnp.concatenate([a, a[:2]]),
        lambda a, k: jnp.where(a > 0, a, jnp.argmax(a)), lambda a, k: jnp.stack([a, a]).T.reshape(-1)[: a.size],
        lambda a, k: lax.fori_loop(0, k, lambda i, b: b.at[i].add(jnp.prod(b)), a), lambda a, k: jnp.tile(a, 2)[:700],
        lambda a, k: lax.cond(k > 1, jnp.sin, lambda b: b, a), lambda a, k: lax.pad(a, 0.0, [(-1, 2, 1)])[: a.size],
        lambda a, k: jnp.interp(a, jnp.linspace(0, 1, 50), jnp.linspace(1, 3, 50)), lambda a, k: jnp.outer(a[:9], a[:30]) @ a[:30],
        lambda a, k: lax.scan(lambda c, x: (c + x, c), a[:4], jnp.outer(a, a[:4]))[1].reshape(-1)[: a.size],
        lambda a, k: jax.random.uniform(jax.random.fold_in(jax.random.PRNGKey(3), k), a.shape), lambda a, k: jnp.sort(a),
        lambda a, k: jnp.fft.fft(a).real, lambda a, k: jnp.exp(a + 0j).real, lambda a, k: a.astype("float16").astype(float),
    ]  # fmt: skip
    chosen = rng.choice(len(operations), 5, p=np.where(np.arange(20) < 16, 1, 0.3) / (16 + 4 * 0.3))

    def fn(x):
        a, k = jnp.linspace(0, 1, size) * x[0] + x[1], jnp.int32(5 * x[2])
        for i in chosen:
            a = operations[i](a, k)
        return [a]

    return fn


@pytest.mark.parametrize("batched", [(), (True,)])
def test_what_is_annotated_is_written(batched):
    """The judge refuses in words, or nothing fails."""
    refused = 0
    for seed in range(40):
        jaxpr = jax.make_jaxpr(program(seed))(X)
        judged = annotate(jaxpr, batched)
        if isinstance(judged, Annotated):
            assert unsupported(jaxpr, batched) == ()
            text = written(jaxpr, batched)
            assert judged.cost / 4 < text.count("\n") < 200 + 6 * judged.cost
            assert len(str(judged).splitlines()) == 1 + len(judged.notes)
        else:
            refused += 1
            assert judged.reason
            assert judged.equation
            with pytest.raises(Unsupported, match=r"is no type|is not written|has no rule"):
                written(jaxpr, batched)
    assert 0 < refused < 15


def test_a_rule_that_fails_is_told_with_its_equation(monkeypatch):
    broken = lowering.RULES["sin"]
    monkeypatch.setitem(lowering.RULES, "sin", type(broken)(**{**vars(broken), "lower": lambda *_, **__: 1 / 0}))
    with pytest.raises(lowering.LoweringError, match=r"`sin` failed at f64\[3\] = sin f64\[3\]: ZeroDivisionError"):
        written(jax.make_jaxpr(jnp.sin)(X))
    monkeypatch.setitem(lowering.RULES, "sin", type(broken)(**{**vars(broken), "lower": lambda context, x, **_: x[:1]}))
    with pytest.raises(lowering.LoweringError, match=r"it gave float64\[1\]"):
        written(jax.make_jaxpr(jnp.sin)(X))
