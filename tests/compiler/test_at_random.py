"""Programs put together at random: what our compiler makes of them gives what XLA makes of them."""

import functools
import os
import secrets

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import configure
from dae_jax.compiler.jaxprs.special_functions import SPECIAL
from dae_jax.compiler.lower.registry import RULES

from .fuzz import campaign, check, programs, systems
from .fuzz.break_rules import BREAKS, found
from .fuzz.numbers import ALL, BOOL, INTEGERS, UNSIGNED, Operand
from .fuzz.operations import RECIPES


PARTS = 4
# What a rule declares and no recipe asks for: JAX has it not, it is what programs are nested in, or another operand's type.
NOT_ASKED_FOR = {
    "abs": UNSIGNED,
    "cond": ALL, "procedure": ALL, "scan": ALL, "while": ALL,
    "pow": INTEGERS,
    **dict.fromkeys("cummax cummin reduce_prod reduce_sum scatter-add scatter-max scatter-min".split(), BOOL),
}  # fmt: skip


@functools.cache
def bundles():
    return list(campaign.bundles(campaign.fixed()))


def agree(bundles):
    differing = [line for bundle in bundles for line in campaign.report(bundle)]
    assert not differing, "\n\n".join(differing)


def test_every_rule_has_a_recipe_for_every_type():
    declared = {(name, dtype) for name, rule in RULES.items() for dtype in frozenset().union(*rule.dtypes)}
    assert declared - RECIPES.keys() == {(name, dtype) for name, dtypes in NOT_ASKED_FOR.items() for dtype in dtypes}
    assert {name for name, _ in RECIPES} >= SPECIAL.keys() - {"iota_2x32_shape"}


@pytest.mark.parametrize("part", range(PARTS))
def test_programs_that_are_always_the_same(part):
    """500 of them."""
    agree(bundles()[part::PARTS])


def test_machine_code_that_is_ready_soon():
    """An eighth of them: LLVM selects and places its instructions by other rules."""
    with configure(optimise=False):
        agree(bundles()[::8])


def test_new_programs(capsys):
    """100, other ones each time."""
    seed = int(os.environ.get("DAE_JAX_FUZZ_SEED") or secrets.randbelow(2**31))
    with capsys.disabled():
        print(f"\nDAE_JAX_FUZZ_SEED={seed}")
    agree(campaign.bundles(campaign.new(seed)))


@pytest.mark.parametrize("name", ["division by zero", "windows one short"])
def test_a_broken_rule_is_found(name):
    """By programs that are always the same, and shown in ten lines; the script breaks more rules."""
    broken = BREAKS[name]
    of_it = [p for p in campaign.fixed() if p.name.split()[0] in broken.primitives]
    seen = found(broken, of_it)
    assert seen is not None
    said = seen[1]
    assert broken.primitives & {word for line in said.splitlines()[1:] for word in line.replace("[", " ").split()}
    assert len(said.splitlines()) <= 11


@pytest.mark.parametrize(("kind", "seed"), [(systems.mechanism, 1), (systems.equations, 2)])
def test_systems_with_and_without_the_compiler(kind, seed):
    assert kind(seed).difference() <= systems.RTOL


def by_name(fn, *shapes):
    """A program of integers that is run with copies, too."""
    operands = tuple(Operand(dtype, shape, domain) for dtype, shape, domain in shapes)
    return programs.Program(fn.__name__, lambda *xs: jax.tree.leaves(fn(*xs)), operands, (False,) * 3, copies=True)


def memory_let_go(a, b, k):
    """The branch that comes last lets memory go, which what the first gives may not be in."""

    def last(a, b):
        c = (a + b).at[k].add(1)
        return (c[::-1] * 3 + c).at[k].add(2)

    return jax.lax.cond(k % 2 == 0, last, lambda a, b: (a[::-1] * 2).at[k].add(1), a, b)


def memory_of_rows(a, b, k):
    """What a loop reads at each turn is not let go by the first."""
    rows = jnp.stack([x[k % 3] * (i + 1) for x in (a, b) for i in range(50)]).reshape(4, 25)

    def turn(c, row):
        c = c.at[:25].add(row)
        for i in range(30):
            c = (c[::-1] + i).at[k].add(1)
        return c, c[0]

    # As large as what the rows are in.
    return jax.lax.scan(turn, jnp.concatenate([a, b, a, b]), rows)


def loops_in_step(a, b, k):
    """Of a loop with a condition for each of several elements those that are done stay as they are."""
    each = lambda x, n: jax.lax.while_loop(lambda c: c[1] < n, lambda c: (c[0] * 2 + c[1], c[1] + 1), (x, 0))[0]
    return jax.vmap(each)(jnp.stack([a, b, a - b]), jnp.stack([k % 5, k % 7, k % 3]))


def known_complex_numbers(a, b, k):
    """A choice of one of two."""
    return jnp.where(a > b, 1 + 2j, 3 - 1j), jnp.where(k > 2, np.complex64(1j), np.complex64(-2j))


def nothing_written(a, b, k):
    """An update of no entries, along an axis that has some."""
    return jax.lax.dynamic_update_slice(a.reshape(5, 5), b[:0].reshape(2, 0), (k, k))


@pytest.mark.parametrize("fn", [known_complex_numbers, nothing_written, memory_let_go, memory_of_rows, loops_in_step])
def test_what_was_written_where_it_should_not(fn):
    array = ("int32", (25,), "edges")
    assert not check.differences([by_name(fn, array, array, ("int32", (), 25))])
