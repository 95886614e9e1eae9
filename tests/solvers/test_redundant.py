"""Redundant constraints by methods that need independent ones: they get as many as are, and the others follow."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.independent import independent, rows_of
from dae_jax.scenes import SCENES


TIMES = np.linspace(0.0, 1.0, 11)
TIGHT = diffrax.PIDController(rtol=1e-9, atol=1e-9)
METHODS = {
    "radau-ggl": (dae_jax.RadauIIA5(), None),
    "radau-index-3": (dae_jax.RadauIIA5(), dae_jax.Residual("index-3")),
    "bdf-ggl": (dae_jax.BDF(), None),
    "dummy-dop853": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    "dummy-radau": (dae_jax.RadauIIA5(), dae_jax.DummyDerivatives()),
    "symmetric-gauss4": (dae_jax.SymmetricProjection(dae_jax.Gauss4()), None),
}
BARS = SCENES["four-bar-redundant"]()


def solve(system, name, y0, args=None, times=TIMES, **rest):
    solver, formulation = METHODS[name]
    steps = {"dt0": 0.01} if name.startswith("symmetric") else {"dt0": None, "stepsize_controller": TIGHT}
    dt0 = steps.pop("dt0")
    saveat = diffrax.SaveAt(ts=jnp.asarray(times))
    return dae_jax.daesolve(
        system, solver, 0.0, times[-1], dt0, y0, args, formulation=formulation, saveat=saveat, **steps, **rest
    )


@pytest.mark.parametrize("name", METHODS)
def test_follows_the_reference(name):
    sol = solve(BARS.system, name, BARS.y0, BARS.args)
    assert BARS.error(TIMES, sol.ys) < 2e-6
    assert sol.rank == 3
    # Also in what the method does not see.
    drift = dae_jax.drift(BARS.system, sol)
    assert float(drift.position.max()) < (1e-13 if name[0] in "ds" else 1e-8)


@pytest.mark.parametrize("name", ["radau-ggl", "dummy-dop853"])
def test_derivatives_and_batches(name):
    """Under `vmap` the start is traced, `rank` tells how many there are, and which ones is found in each lane."""
    constraint = BARS.system.constraint
    assert constraint is not None
    of = lambda rank: dae_jax.ConstrainedSystem(
        lambda t, q, v, args: args[1] * BARS.system.force(t, q, v, args[0]),
        lambda t, q, args: constraint(t, q, args[0]),
        BARS.system.mass,
        rank=rank,
    )

    def end_of(system, g):
        return solve(system, name, BARS.y0, (BARS.args, g), times=TIMES[:3]).ys[0][-1, 0]

    end, traced = (functools.partial(end_of, of(rank)) for rank in (None, 3))
    gs, h = jnp.array([0.9, 1.0, 1.1]), 1e-3
    one_by_one = jnp.stack([end(g) for g in gs])
    np.testing.assert_allclose(jax.vmap(traced)(gs), one_by_one, atol=1e-8)
    difference = (end(1 + h) - end(1 - h)) / (2 * h)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(traced)(1.0), difference, rtol=1e-5)


def circle(q):
    return q @ q - 1


def hanging(first):
    """The pendulum's circle in two forms, one of which says nothing where q₁ = 0."""
    pair = lambda q: (q[0] * circle(q), circle(q)) if first else (circle(q), q[0] * circle(q))
    return dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, -9.81]), lambda t, q, args: jnp.stack(pair(q))
    )


def test_other_starts_take_other_constraints():
    """A program is kept for the constraints that were independent at its first start."""
    system = hanging(first=True)
    level, lowest = (jnp.array([1.0, 0.0]), jnp.zeros(2)), (jnp.array([0.0, -1.0]), jnp.array([1.0, 0.0]))
    assert [rows_of(system, 0.0, y0, None, (1, 1)) for y0 in (level, lowest)] == [(0,), (1,)]
    plain = dae_jax.ConstrainedSystem(system.force, lambda t, q, args: circle(q))
    for y0 in (level, lowest):
        sol, expected = (solve(s, "radau-ggl", y0, times=TIMES[:5]) for s in (system, plain))
        np.testing.assert_allclose(sol.ys[0], expected.ys[0], atol=1e-7)


def bead():
    """On a rod that turns, d × u(t) = 0: three equations, two of them independent, of which the first says nothing at t = 0 and the
    second nothing at t = π/2. From rest on the rod it flies out as cosh t.
    """
    u = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), jnp.zeros(())])
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.zeros(3), lambda t, q, args: jnp.cross(q, u(t)))
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])
    return system, y0, lambda t: np.cosh(t)[:, None] * np.stack([np.cos(t), np.sin(t), 0 * t], 1)


@pytest.mark.parametrize("solver", [dae_jax.DOP853(), diffrax.Tsit5()], ids=["dop853", "tsit5"])
@pytest.mark.parametrize("wrap", [dae_jax.OrthogonalProjection, dae_jax.TangentSpace])
def test_a_projection_takes_others_on_the_way(wrap, solver):
    system, y0, exact = bead()
    times = np.linspace(0, 2, 21)
    sol = dae_jax.daesolve(
        system, wrap(solver), 0.0, 2.0, None, y0, saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=TIGHT,
    )  # fmt: skip
    assert sol.rank == 2
    np.testing.assert_allclose(sol.ys[0], exact(times), atol=1e-7)


@pytest.mark.filterwarnings("ignore::dae_jax.AccuracyWarning")
@pytest.mark.parametrize("name", ["radau-ggl", "dummy-dop853", "symmetric-gauss4"])
def test_beyond_where_those_it_has_become_dependent_it_is_right_or_says_so(name):
    system, y0, exact = bead()
    times = np.linspace(0, 1.5, 16)
    np.testing.assert_allclose(solve(system, name, y0, times=times).ys[0], exact(times), atol=1e-6)
    beyond = np.linspace(0, 2, 21)
    sol = solve(system, name, y0, times=beyond, throw=False)
    if sol.result == dae_jax.RESULTS.successful and not sol.stats["doubts"]:
        np.testing.assert_allclose(sol.ys[0], exact(beyond), atol=1e-5)


def test_holonomic_constraints_are_taken_first():
    """A rolling condition that is the derivative of one is left out, not the constraint."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, -9.81]),
        lambda t, q, args: circle(q)[None] * 1e-3,
        nonholonomic=lambda t, q, v, args: (1e3 * q @ v)[None],
    )
    y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
    assert rows_of(system, 0.0, y0, None, (1, 1)) == (0,)
    some = independent(system, 0.0, y0, None, (1, 1), (0,))
    assert some.nonholonomic is None
    assert some.rank is None
    exact = SCENES["pendulum"]().reference(TIMES)[0] * [1, -1]
    np.testing.assert_allclose(solve(system, "bdf-ggl", y0).ys[0], exact, atol=1e-6)


def test_a_contradiction_is_found_at_the_end():
    """A constraint that the method does not see and that ceases to agree."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, -9.81]), lambda t, q, args: jnp.stack([circle(q), circle(q) - t**3])
    )
    for name in ("radau-ggl", "dummy-dop853", "symmetric-gauss4"):
        sol = solve(system, name, (jnp.array([1.0, 0.0]), jnp.zeros(2)), throw=False)
        assert sol.result != dae_jax.RESULTS.successful
