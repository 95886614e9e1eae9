"""Loops whose number of turns is known but for one: written out where that is certain, and right."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import compiler
from dae_jax.compiler.jaxprs.inline import Inlining
from dae_jax.compiler.jaxprs.walk import equations


def loop(goes_on, moves=1, start=(1, 0), dtype=int):
    """(flag, x) → the counter at the end, how many turns there were, and what they made of x."""

    def fn(flag, x):
        def turn(carry):
            k, turns, x, rows = carry
            x = jnp.sin(x) + k.astype(float) / 3
            return k + jnp.asarray(moves, dtype), turns + 1, x, rows.at[k].add(x)

        first = jnp.where(flag, *(jnp.asarray(s, dtype) for s in start))
        return jax.lax.while_loop(goes_on, turn, (first, 0, x, jnp.zeros(9)))

    return fn


def whiles(fn, *args):
    closed = Inlining()(jax.make_jaxpr(fn)(*args))
    return [eqn.primitive.name for eqn in equations(closed)].count("while")


def loops_in(annotated):
    return [line for line in annotated.splitlines() if "= while" in line]


def as_by_jax(fn):
    flags, xs = np.array([True, False, True, True, False, False, True, False, True]), np.linspace(-1, 2, 9)
    for flag in (True, False):
        for a, b in zip(compiler.jit(fn)(flag, 0.3), jax.jit(fn)(flag, 0.3), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)
    for a, b in zip(jax.vmap(compiler.jit(fn))(flags, xs), jax.vmap(fn)(flags, xs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)


FEW = {
    "one of two starts": (lambda c: c[0] < 7, {}),
    "at most": (lambda c: c[0] <= 6, {}),
    "the other way round": (lambda c: jnp.greater(7, c[0]) & jnp.greater_equal(6, c[0]), {}),
    "with another counter that never ends it": (lambda c: (c[0] < 7) & (c[1] < 7), {}),
    "from below zero": (lambda c: c[0] < 3, {"start": (-1, -2)}),
    "a known start": (lambda c: c[0] < 7, {"start": (2, 2)}),
    "no turn": (lambda c: c[0] < 3, {"start": (3, 4)}),
    "a turn or none": (lambda c: c[0] < 3, {"start": (2, 3)}),
    "of 32 bits": (lambda c: c[0] < 7, {"dtype": np.int32}),
}
NOT_KNOWN = {
    "another counter that may end it": (lambda c: (c[0] < 7) & (c[1] < 6), {"start": (0, 2)}),
    "what the turns compute": (lambda c: (c[0] < 7) & (c[2] < 2), {}),
    "steps of two": (lambda c: c[0] < 7, {"moves": 2}),
    "starts far apart": (lambda c: c[0] < 7, {"start": (0, 5)}),
    "many turns": (lambda c: c[0] < 4000, {}),
    "no end by counting": (lambda c: c[2] < 1.5, {}),
    "a counter that wraps": (lambda c: (c[0] < 7) & (c[0] > 0), {"start": (1, 2), "dtype": np.int8}),
}


@pytest.mark.parametrize("name", [*FEW, *NOT_KNOWN])
def test_few_turns_are_written_out_and_others_stay_loops(name):
    goes_on, options = (FEW | NOT_KNOWN)[name]
    fn = loop(goes_on, **options)
    assert whiles(fn, True, 0.3) == (name in NOT_KNOWN)
    as_by_jax(fn)


@pytest.mark.parametrize("start", [lambda flag, k: k, lambda flag, k: jnp.where(flag, 0, k)])
def test_a_start_that_is_not_known_stays_a_loop(start):
    fn = lambda flag, k: jax.lax.while_loop(lambda c: c[0] < 7, lambda c: (c[0] + 1, c[1] * 2), (start(flag, k), 1.0))
    assert whiles(fn, True, 1) == 1


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Dopri8(), diffrax.Heun()], ids=lambda s: type(s).__name__)
def test_the_stages_of_diffrax(solver):
    """Of a solve by diffrax one loop is left, that over the steps: lanes read no stage at places of their own."""

    def solve(rho):
        field = lambda t, y, rho: jnp.stack(
            [10 * (y[1] - y[0]), y[0] * (rho - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]]
        )
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(field), solver, 0.0, 1.0, 0.01, jnp.ones(3), rho, max_steps=None,
            saveat=diffrax.SaveAt(t1=True), stepsize_controller=diffrax.PIDController(1e-5, 1e-5),
        )  # fmt: skip
        return jax.tree.leaves(sol.ys)[0][0]

    lowered = compiler.jit(solve).lower(28.0)
    assert lowered.compiler == "llvm"
    assert len(loops_in(lowered.annotated())) == 1
    rhos = np.linspace(20, 28, 11)
    np.testing.assert_allclose(jax.vmap(compiler.jit(solve))(rhos), jax.vmap(solve)(rhos), rtol=1e-9)
