"""The findings of Pöll, Hafner and Heinzl, and the accuracy that the library claims."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import SCENES, double_pendulum, pendulum


def speeds(solver, h, t1, times):
    scene = pendulum()
    sol = dae_jax.daesolve(
        scene.system, solver, 0.0, t1, h, scene.y0, saveat=diffrax.SaveAt(ts=times), max_steps=1_000_000
    )
    return np.asarray(dae_jax.energy(scene.system, sol))


def test_differentiation_drifts_off_quadratically():
    scene = pendulum()
    times = np.array([25.0, 50.0, 100.0])
    sol = dae_jax.daesolve(
        scene.system, diffrax.Tsit5(), 0.0, 100.0, 0.02, scene.y0, saveat=diffrax.SaveAt(ts=times), max_steps=100_000
    )
    position = dae_jax.drift(scene.system, sol).position
    slopes = np.diff(np.log(position)) / np.log(2)
    assert np.all((slopes > 1.7) & (slopes < 2.3))
    assert position[-1] > 100 * 1e-9


def test_energy_grows_under_projected_euler_only():
    times = np.linspace(0, 100, 1001)
    euler = speeds(dae_jax.OrthogonalProjection(diffrax.Euler()), 0.005, 10.0, np.linspace(0, 10, 501))
    symmetric = speeds(dae_jax.SymmetricProjection(dae_jax.Trapezoid()), 0.02, 100.0, times)
    assert euler[-1] > euler[0] + 1
    first, last = symmetric[:250], symmetric[-250:]
    # No secular trend: the mean of the last quarter is that of the first, to a tenth of the oscillation.
    assert abs(first.mean() - last.mean()) < 0.1 * np.ptp(symmetric)


@pytest.mark.parametrize(("alpha", "beta"), [(5.0, 5.0), (10.0, 5.0), (3.0, 8.0)])
def test_baumgartes_drift_follows_its_characteristic_polynomial(alpha, beta):
    """From a start with g = δ the constraint obeys g̈ + 2αġ + β²g = 0."""
    scene = pendulum()
    system = dae_jax.ConstrainedSystem(scene.system.force, scene.system.constraint)
    delta = 1e-9
    q0 = scene.y0[0] * (1 + delta)
    times = np.linspace(0, 1, 11)
    sol = dae_jax.daesolve(
        system, dae_jax.DOP853(), 0.0, 1.0, None, (q0, scene.y0[1]), formulation=dae_jax.Baumgarte(alpha, beta),
        saveat=diffrax.SaveAt(ts=times), stepsize_controller=diffrax.PIDController(1e-13, 1e-13),
    )  # fmt: skip
    roots = np.roots([1, 2 * alpha, beta**2]).astype(complex)
    if roots[0] == roots[1]:
        expected = delta * (1 - roots[0] * times) * np.exp(roots[0] * times)
    else:
        a, b = roots
        expected = delta * (b * np.exp(a * times) - a * np.exp(b * times)) / (b - a)
    np.testing.assert_allclose(dae_jax.drift(system, sol).position, np.abs(expected.real), atol=2e-3 * delta)


def test_a_stiff_choice_of_baumgartes_parameters_still_solves():
    scene = double_pendulum()
    sol = dae_jax.daesolve(
        scene.system,
        diffrax.Tsit5(),
        0.0,
        2.0,
        None,
        scene.y0,
        formulation=dae_jax.Baumgarte(100.0, 1000.0),
        max_steps=100_000,
    )
    exact = scene.reference(np.array([2.0]))
    np.testing.assert_allclose(sol.ys[0], exact[0], atol=1e-5)


CHARTLESS = [dae_jax.OrthogonalProjection(diffrax.Dopri8()), dae_jax.TangentSpace(diffrax.Dopri8())]


@pytest.mark.parametrize("solver", [*CHARTLESS, diffrax.Dopri8()], ids=["projection", "tangent", "state-space"])
@pytest.mark.parametrize(("name", "t1", "tolerance"), [("pendulum", 10.0, 1e-8), ("double-pendulum", 5.0, 1e-7)])
def test_accuracy_at_1e_10(name, t1, tolerance, solver):
    scene = SCENES[name]()
    formulation = dae_jax.StateSpace(scene.chart) if type(solver) is diffrax.Dopri8 else None
    sol = dae_jax.daesolve(
        scene.system, solver, 0.0, t1, None, scene.y0, formulation=formulation, saveat=diffrax.SaveAt(steps=True),
        stepsize_controller=diffrax.PIDController(1e-10, 1e-10),
    )  # fmt: skip
    taken = np.isfinite(sol.ts)
    for found, exact in zip(sol.ys, scene.reference(np.asarray(sol.ts)[taken]), strict=True):
        assert np.abs(np.asarray(found)[taken] - exact).max() < tolerance
    off = dae_jax.drift(scene.system, sol)
    assert max(off.position[taken].max(), off.velocity[taken].max()) <= 1e-13


MECHANISMS = [
    name
    for name in SCENES
    if isinstance(SCENES[name]().system, dae_jax.ConstrainedSystem) and name not in ("andrews", "car-axis")
]


@pytest.mark.parametrize("name", MECHANISMS)
@pytest.mark.parametrize("solver", [dae_jax.OrthogonalProjection(dae_jax.DOP853())], ids=["projection"])
def test_every_scene_follows_its_reference(name, solver):
    scene = SCENES[name]()
    t1 = min(scene.t1, 3.0)
    times = np.linspace(0, t1, 31)
    sol = dae_jax.daesolve(scene.system, solver, 0.0, t1, None, scene.y0, saveat=diffrax.SaveAt(ts=times))
    assert scene.error(times, sol.ys) < 2e-6
    off = dae_jax.drift(scene.system, sol)
    assert max(off.position.max(), off.velocity.max()) <= 1e-13


def test_the_double_pendulums_reference_has_the_published_digits():
    q, v = double_pendulum().reference(np.array([10.0]))
    published = [-0.53834724, 0.84272312, -1.04076578, 1.70734766, 5.12239545, 3.27228172, -3.24834664, -1.59181341]
    np.testing.assert_allclose(np.concatenate([q[0], v[0]]), published, atol=2e-8)


def test_redundant_constraints_give_multipliers_of_least_norm():
    plain, redundant = SCENES["four-bar"](), SCENES["four-bar-redundant"]()
    a, b = (
        dae_jax.daesolve(s.system, diffrax.Tsit5(), 0.0, 0.1, None, s.y0, saveat=diffrax.SaveAt(t0=True))
        for s in (plain, redundant)
    )
    assert b.rank == 3
    few, many = (np.asarray(dae_jax.multipliers(s.system, x))[0] for s, x in ((plain, a), (redundant, b)))
    assert np.linalg.norm(many) < np.linalg.norm(few)
    # In the range of G, that is G G⁺λ = λ, at masses that are not equal.
    constraint = redundant.system.constraint
    assert constraint is not None
    g = np.asarray(jax.jacfwd(lambda q: constraint(0.0, q, redundant.args))(jnp.asarray(redundant.y0[0])))
    np.testing.assert_allclose(g @ np.linalg.pinv(g) @ many, many, atol=1e-12 * np.linalg.norm(many))


def test_a_chart_has_a_coordinate_for_each_independent_constraint_less():
    scene = pendulum()
    twice = dataclasses.replace(scene.system, constraint=lambda t, q, args: jnp.array([1.0, 2.0]) * (q @ q - 1) / 2)
    chart = dae_jax.StateSpace(lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])]))
    plain, redundant = (
        dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1.0, None, scene.y0, scene.args, formulation=chart).final
        for system in (scene.system, twice)
    )
    np.testing.assert_allclose(redundant, plain, rtol=0, atol=1e-12)


@pytest.mark.parametrize("rate", [0.5, 7.0, -7.0])
def test_the_pendulums_reference_satisfies_its_equation(rate):
    scene = pendulum(angle=0.4, angular_velocity=rate)
    h, times = 1e-4, np.linspace(0.1, 4, 20)
    q = scene.reference(times)[0]
    before, after = scene.reference(times - h)[1], scene.reference(times + h)[1]
    tangent = np.stack([q[:, 1], -q[:, 0]], 1)
    acceleration = np.sum((after - before) / (2 * h) * tangent, 1)
    np.testing.assert_allclose(acceleration, 9.81 * tangent[:, 1], atol=1e-5)
    np.testing.assert_allclose([scene.reference(np.zeros(1))[i][0] for i in (0, 1)], scene.y0, atol=1e-12)


@pytest.mark.parametrize("rounding", [0.0, 1e-16, -2e-16])
def test_the_coordinates_of_a_chart_are_the_smallest_ones(rounding):
    """Whole turns more are the same start, at a tolerance that grows with them: rounding must not choose between them."""
    angles = np.linspace(-3.0, 3.0, 61) * (1 + rounding)
    scene = dae_jax.scenes.pendulum()
    chart = dae_jax.StateSpace(lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])]))
    start = lambda a: (jnp.stack([jnp.sin(a), jnp.cos(a)]), jnp.zeros(2))
    found = jax.vmap(lambda a: chart.encode(scene.system, 0.0, start(a), scene.args)[0][0][0])(angles)
    np.testing.assert_allclose(found, angles, atol=1e-12)
