"""Configurations in which the constraints depend on each other: who comes near one turns a corner, and who leaps over it says so.

A crank and a rod that is longer by δ, in angle and slider, 0 = s² − 2 s sin θ − η with η = 2δ + δ², without forces: at θ = 0 the slider
turns within √η rad. The truth is that of `benchmarks.stress`, by quadrature.
"""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from benchmarks.stress.families.singular import dead_centre
from dae_jax import AccuracyWarning, ConstrainedSystem, OrthogonalProjection
from dae_jax.linalg import least_sign
from dae_jax.scenes import SCENES


PASSED = 8
METHODS = {
    "projection": (OrthogonalProjection(diffrax.Tsit5()), None),
    "tangent space": (dae_jax.TangentSpace(dae_jax.DOP853()), None),
    "GGL by BDF": (dae_jax.BDF(), dae_jax.GGL()),
    "GGL by Radau": (dae_jax.RadauIIA5(), dae_jax.GGL()),
    "differentiation": (diffrax.Tsit5(), dae_jax.Differentiation()),
    "Baumgarte": (diffrax.Tsit5(), dae_jax.Baumgarte(10.0, 10.0)),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    "index 2 by Radau": (dae_jax.RadauIIA5(), dae_jax.Residual("index-2")),
}


CONTROLLER = diffrax.PIDController(rtol=1e-6, atol=1e-6)


def passing(case, name, rtol, t1=0.6, **options):
    solver, formulation = METHODS[name]
    return dae_jax.daesolve(
        case.system, solver, 0.0, t1, None, case.y0, case.args, formulation=formulation, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), **options,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore::dae_jax.AccuracyWarning")
@pytest.mark.parametrize("name", METHODS)
def test_near_a_dead_centre_an_answer_is_right_or_doubted(name):
    for excess, rtol in itertools.product((1e-5, 1e-7, 1e-9, 1e-12), (1e-3, 1e-4, 1e-5, 1e-7)):
        case = dead_centre(excess)
        truth, _ = case.truth([0.6])
        sol = passing(case, name, rtol)
        error = np.max(np.abs(sol.ys[0] - truth))
        doubted = bool(sol.stats["doubts"] & PASSED) or sol.result != dae_jax.RESULTS.successful
        assert doubted or error < 100 * rtol**0.8, (excess, rtol, error)


def test_backwards_in_time_and_in_a_batch():
    case = dead_centre(1e-9)
    ends = jax.vmap(lambda x: dae_jax.daesolve(
        case.system, METHODS["projection"][0], 0.0, 0.6, None, (case.y0[0], x * case.y0[1]), case.args, throw=False
    ).ys)(jnp.array([1.0, 0.5]))  # fmt: skip
    truth, _ = case.truth([0.6])
    np.testing.assert_allclose(ends[0][0, 0], truth[0], atol=1e-6)
    back = dae_jax.daesolve(
        case.system, METHODS["projection"][0], 0.6, 0.0, None, tuple(x[0, 0] for x in ends), case.args
    )
    np.testing.assert_allclose(back.ys[0][0], case.y0[0], atol=1e-4)


def test_fixed_steps_leap_over_it_and_say_so():
    case = dead_centre(1e-9)
    with pytest.warns(AccuracyWarning, match="dead centre"):
        dae_jax.daesolve(case.system, METHODS["projection"][0], 0.0, 0.6, 0.01, case.y0, case.args)


@pytest.mark.parametrize("redundant", [False, True])
def test_a_change_point_is_passed_with_a_word(redundant):
    """A parallelogram: at the change point all links are on one line, and it may go on as an antiparallelogram."""
    scene = dae_jax.scenes.four_bar(redundant, gravity=0.0)
    q = jnp.asarray(scene.y0[0])
    speed = 3.0 * jnp.array([q[1], -q[0], q[1], -q[0]])
    with pytest.warns(AccuracyWarning, match="dead centre"):
        sol = dae_jax.daesolve(scene.system, METHODS["projection"][0], 0.0, 1.0, None, (q, speed))
    angle = np.arctan2(q[0], q[1]) + 3.0
    np.testing.assert_allclose(sol.ys[0][0, :2], [np.sin(angle), np.cos(angle)], atol=1e-5)


@pytest.mark.parametrize(
    "name", ["pendulum", "double-pendulum", "four-bar-redundant", "car-axis", "spherical-pendulum"]
)
def test_an_ordinary_motion_is_not_doubted(name):
    scene = SCENES[name]()
    for rtol in (1e-2, 1e-5):
        controller = diffrax.PIDController(rtol=rtol, atol=rtol)
        sol = dae_jax.daesolve(
            scene.system, OrthogonalProjection(dae_jax.DOP853()), 0.0, min(scene.t1, 5.0), None, scene.y0, scene.args,
            stepsize_controller=controller,
        )  # fmt: skip
        assert not sol.stats["doubts"] & PASSED


def test_the_answer_does_not_depend_on_units():
    """The metric is that of the masses: a slider in µm turns as one in m."""
    case = dead_centre(1e-7)
    unit = jnp.array([1.0, 1e6])
    scaled = ConstrainedSystem(
        case.system.force, lambda t, q, args: case.system.constraint(t, q / unit, args), mass=1 / unit**2
    )
    y0 = tuple(unit * x for x in case.y0)
    ends = [
        dae_jax.daesolve(
            system, METHODS["projection"][0], 0.0, 0.6, None, start, case.args, stepsize_controller=CONTROLLER
        )
        for system, start in ((case.system, case.y0), (scaled, y0))
    ]
    assert [int(sol.stats["doubts"]) for sol in ends] == [0, 0]
    np.testing.assert_allclose(ends[1].ys[0][0] / unit, ends[0].ys[0][0], atol=1e-4)


@pytest.mark.parametrize("copies", [2, 4])
def test_dead_centres_that_are_passed_at_once(copies):
    """An even number of them in one step."""
    case = dead_centre(1e-9)
    system = ConstrainedSystem(
        lambda t, q, v, a: jnp.zeros_like(q),
        lambda t, q, a: jax.vmap(lambda q: case.system.constraint(t, q, a))(q.reshape(copies, -1)).ravel(),
    )
    y0 = tuple(jnp.tile(x, copies) for x in case.y0)
    with pytest.warns(AccuracyWarning, match="dead centre"):
        dae_jax.daesolve(system, METHODS["projection"][0], 0.0, 0.6, 0.01, y0, case.args)


@pytest.mark.parametrize("rank", [1, 2, 3, 6])
def test_least_sign_of_pivots(rank):
    rng = np.random.default_rng(rank)
    for _ in range(20):
        rows = rng.normal(size=(6, rank)) if rank < 6 else np.eye(6)
        signs = np.sign(rng.normal(size=rank))
        turned = np.diag(signs) + 0.1 * rng.normal(size=(rank, rank))
        assert least_sign(jnp.asarray(rows @ turned @ rows.T), rank) == signs.min()
    assert least_sign(jnp.array([[2.0, 5.0], [1.0, 2.0]]), 2) == -1
    assert least_sign(jnp.array([[-3.0]]), 1) == -1
    assert least_sign(-jnp.eye(2), 2) == -1


@pytest.mark.parametrize(
    "solver",
    [OrthogonalProjection(dae_jax.DOP853()), dae_jax.DOP853(), dae_jax.RadauIIA5()],
    ids=["projection", "field", "radau"],
)
def test_a_nonholonomic_constraint_that_vanishes_on_the_way(solver):
    """(x − 1) z' = 2 z x' with x' = 1: beyond x = 1 any z = c (x − 1)² will do."""
    system = ConstrainedSystem(
        lambda t, q, v, a: jnp.zeros(2),
        nonholonomic=lambda t, q, v, a: jnp.stack([v[0] - 1, (q[0] - 1) * v[1] - 2 * q[1] * v[0]]),
    )
    solve = lambda t1: dae_jax.daesolve(system, solver, 0.0, t1, None, (jnp.array([0.0, 1.0]), jnp.array([1.0, -2.0])))
    assert int(solve(0.9).stats["doubts"]) == 0
    with pytest.warns(AccuracyWarning, match="constraints depend on each other"):
        assert int(solve(2.0).stats["doubts"]) == 8
