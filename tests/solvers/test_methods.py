"""What every method promises: its order, its drift, its derivatives, and the same under vmap."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import pendulum
from tests.methods import METHODS


SCENE = pendulum()
# Coarse enough to stay above round-off, fine enough to be in the asymptotic regime.
STEPS = {1: (400, 1600), 2: (50, 100), 4: (25, 50), 5: (20, 40), 8: (12, 24)}


def solve(method, t1, h, y0=SCENE.y0, system=SCENE.system, args=None, adjoint=None, **options):
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    return dae_jax.daesolve(
        system, method.solver, 0.0, t1, h, y0, args, formulation=method.formulation, adjoint=adjoint, max_steps=10_000, **options
    )  # fmt: skip


def error(method, steps, t1=1.0):
    sol = solve(method, t1, t1 / steps, stepsize_controller=diffrax.ConstantStepSize())
    exact = SCENE.reference(np.array([t1]))
    return max(float(np.abs(np.asarray(a) - b).max()) for a, b in zip(sol.ys, exact, strict=True))


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_order_is_measured(method):
    coarse, fine = STEPS[method.order]
    slope = np.log(error(method, coarse) / error(method, fine)) / np.log(fine / coarse)
    # Superconvergence is no failure; order 8 is measured over one halving close to round-off.
    assert slope > method.order - (0.5 if method.order == 8 else 0.25)


@pytest.mark.parametrize("method", [m for m in METHODS if m.keeps], ids=lambda m: m.name)
def test_methods_that_keep_the_constraints_keep_them_between_steps_too(method):
    times = np.linspace(0, 2, 41)
    sol = solve(method, 2.0, 0.02, saveat=diffrax.SaveAt(ts=times))
    off = dae_jax.drift(SCENE.system, sol)
    assert off.position.max() <= 1e-13
    assert off.velocity.max() <= 1e-13


@pytest.mark.parametrize("method", [m for m in METHODS if not m.twin], ids=lambda m: m.name)
def test_gradients_agree_in_both_modes_and_with_central_differences(method):
    """Of the end state with respect to the angle of the start and gravity (`args`); a batch is one at a time."""
    system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), SCENE.system.constraint)
    weights = jnp.array([0.3, -0.7])

    def end(x, adjoint):
        angle, gravity = x
        y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.stack([jnp.cos(angle), -jnp.sin(angle)]))
        # For fixed steps the derivative of the discrete map is that of the numbers that central differences see.
        sol = solve(method, 0.5, 0.05, y0, system, gravity, adjoint, stepsize_controller=diffrax.ConstantStepSize())
        return jnp.dot(weights, sol.ys[0][-1]) + jnp.dot(weights, sol.ys[1][-1])

    x = jnp.array([1.2, 9.81])
    reverse = jax.grad(lambda x: end(x, diffrax.RecursiveCheckpointAdjoint()))(x)
    forward = jax.jacfwd(lambda x: end(x, diffrax.ForwardMode()))(x)
    plain = jax.jit(jax.vmap(lambda x: end(x, diffrax.RecursiveCheckpointAdjoint())))
    h = 1e-5
    values = plain(jnp.concatenate([x + h * jnp.eye(2), x - h * jnp.eye(2)]))
    central = (values[:2] - values[2:]) / (2 * h)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(reverse, central, rtol=1e-6, atol=1e-8)
    alone = [end(x + h * e, diffrax.RecursiveCheckpointAdjoint()) for e in jnp.eye(2)]
    np.testing.assert_allclose(values[:2], jnp.stack(alone), rtol=1e-12, atol=1e-12)


def test_gradient_with_respect_to_baumgartes_parameters():
    def end(x, adjoint):
        sol = dae_jax.daesolve(
            SCENE.system,
            diffrax.Tsit5(),
            0.0,
            0.5,
            0.05,
            SCENE.y0,
            formulation=dae_jax.Baumgarte(x[0], x[1]),
            adjoint=adjoint,
        )
        return jnp.sum(sol.ys[0])

    x = jnp.array([3.0, 5.0])
    reverse = jax.grad(lambda x: end(x, diffrax.RecursiveCheckpointAdjoint()))(x)
    forward = jax.jacfwd(lambda x: end(x, diffrax.ForwardMode()))(x)
    h = 1e-3
    value = lambda x: end(x, diffrax.RecursiveCheckpointAdjoint())
    central = jnp.stack([(value(x + h * e) - value(x - h * e)) / (2 * h) for e in jnp.eye(2)])
    # The derivatives are 1e-7 of a state of size 1: its round-off is what is left.
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(reverse, central, rtol=1e-5, atol=1e-12)


COMPOSED = {
    "jit(vmap(grad))": lambda f, a: jax.jit(jax.vmap(jax.grad(lambda x: f(x, diffrax.RecursiveCheckpointAdjoint()))))(
        a
    ),
    "grad(vmap)": lambda f, a: jax.grad(
        lambda a: jax.vmap(lambda x: f(x, diffrax.RecursiveCheckpointAdjoint()))(a).sum()
    )(a),
    "vmap(jit(grad))": lambda f, a: jax.vmap(jax.jit(jax.grad(lambda x: f(x, diffrax.RecursiveCheckpointAdjoint()))))(
        a
    ),
    "vmap(jacfwd)": lambda f, a: jax.vmap(jax.jacfwd(lambda x: f(x, diffrax.ForwardMode())))(a),
    "jvp(vmap)": lambda f, a: jax.jvp(
        lambda a: jax.vmap(lambda x: f(x, diffrax.ForwardMode()))(a), (a,), (jnp.ones_like(a),)
    )[1],
    "vmap(grad) direct": lambda f, a: jax.vmap(jax.grad(lambda x: f(x, diffrax.DirectAdjoint())))(a),
}


@pytest.mark.parametrize("name", COMPOSED)
def test_transformations_compose_in_any_order(name):
    def end(angle, adjoint):
        y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.zeros(2))
        solver = dae_jax.OrthogonalProjection(diffrax.Tsit5())
        return dae_jax.daesolve(SCENE.system, solver, 0.0, 0.5, 0.05, y0, adjoint=adjoint).ys[0][-1, 0]

    angles, h = jnp.array([0.5, 1.0]), 1e-5
    value = lambda a: end(a, diffrax.RecursiveCheckpointAdjoint())
    central = [(value(a + h) - value(a - h)) / (2 * h) for a in angles]
    np.testing.assert_allclose(COMPOSED[name](end, angles), central, rtol=1e-7)


@pytest.mark.parametrize(("mass", "factor"), [(1e8, 1.0), (1.0, 1e-8)])
def test_symmetric_projection_does_not_depend_on_the_units_of_mass_and_constraint(mass, factor):
    """μ is large where masses are, or where the constraint is small; what it moves is not."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: mass * jnp.array([0.0, 9.81]),
        lambda t, q, args: factor * (q @ q - 1) / 2,
        mass * np.ones(2),
    )
    solver = dae_jax.SymmetricProjection(dae_jax.Trapezoid())
    found, plain = (dae_jax.daesolve(x, solver, 0.0, 1.0, 0.01, SCENE.y0).final for x in (system, SCENE.system))
    np.testing.assert_allclose(found, plain, rtol=0, atol=1e-12)


SMALL = dae_jax.ConstrainedSystem(
    lambda t, q, v, r: jnp.stack([0 * r, r, 0 * r]), lambda t, q, r: (q[:2] @ q[:2] - r**2) / 2
)


def swung(solver, length, beside, h, dtype=jnp.float64, **options):
    """A pendulum beside an unknown of another size, in parts of these."""
    units = jnp.array([length, length, beside], dtype)
    start = (units * jnp.array([1.0, 0.0, 1.0], dtype), jnp.zeros(3, dtype))
    (q,), (v,) = dae_jax.daesolve(SMALL, solver, 0.0, 2.0, h, start, jnp.asarray(length, dtype), **options).ys
    return q / units, v / units


@pytest.mark.parametrize(("length", "beside"), [(1.0, 2.0**27), (2.0**-27, 2.0**-27), (2.0**-14, 2.0**14)])
@pytest.mark.parametrize("solver", [dae_jax.TangentSpace(diffrax.Tsit5()), dae_jax.RATTLE()])
def test_what_is_small_beside_1_or_another_unknown_stays_on_its_constraints(solver, length, beside):
    q, v = swung(solver, length, beside, 0.1)
    assert abs(q[:2] @ q[:2] - 1) < 1e-14
    assert abs(q[:2] @ v[:2]) < 1e-14
    np.testing.assert_allclose(jnp.stack([q, v]), jnp.stack(swung(solver, 1.0, 1.0, 0.1)), atol=1e-12)


def test_millimetres_in_float32():
    solver, steps = dae_jax.TangentSpace(dae_jax.DOP853()), diffrax.PIDController(rtol=1e-5, atol=1e-8)
    found = swung(solver, 1e-3, 1e-3, None, jnp.float32, stepsize_controller=steps)
    np.testing.assert_allclose(found, swung(solver, 1.0, 1.0, None), atol=1e-3)


def test_a_chart_in_lengths_that_are_small_beside_1_starts_where_the_state_does():
    arc = dae_jax.StateSpace(lambda t, z, r: r * jnp.stack([jnp.cos(z[0] / r), jnp.sin(z[0] / r), 1 + 0 * r]))
    system = dae_jax.ConstrainedSystem(SMALL.force, lambda t, q, r: jnp.stack([(q[:2] @ q[:2] - r**2) / 2, q[2] - r]))
    for r in (1e-5, 1e-8):
        q = jnp.array([0.6 * r, 0.8 * r, r], jnp.float32)
        start, r = (q, jnp.zeros_like(q)), jnp.asarray(r, jnp.float32)
        sol = dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1e-3, 1e-3, start, r, formulation=arc)
        np.testing.assert_allclose(sol.ys[0][0] / r, q / r, atol=1e-5)


@pytest.mark.parametrize("method", [m for m in METHODS if not m.twin], ids=lambda m: m.name)
def test_a_state_in_float32_stays_one(method):
    """Beside float64, in which times and parameters are."""
    y0 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), SCENE.y0)
    sol = solve(method, 1.0, 0.01, y0, saveat=diffrax.SaveAt(ts=np.array([0.5, 1.0])))
    assert {x.dtype for x in sol.ys} == {jnp.dtype(jnp.float32)}
    for found, exact in zip(sol.ys, SCENE.reference(np.array([0.5, 1.0])), strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=5e-3)


def test_symmetric_projection_goes_back_to_where_it_came_from():
    method = dae_jax.SymmetricProjection(dae_jax.Trapezoid())
    there = dae_jax.daesolve(SCENE.system, method, 0.0, 1.0, 0.02, SCENE.y0)
    back = dae_jax.daesolve(SCENE.system, method, 1.0, 0.0, -0.02, jax.tree.map(lambda x: x[-1], there.ys))
    for a, b in zip(back.ys, SCENE.y0, strict=True):
        np.testing.assert_allclose(a[-1], b, atol=1e-12)


@pytest.mark.parametrize(
    "solver", [dae_jax.OrthogonalProjection(dae_jax.DOP853()), dae_jax.TangentSpace(diffrax.Tsit5())]
)
def test_backwards_in_time_with_a_constraint_that_depends_on_time(solver):
    scene = dae_jax.scenes.moving_pivot_pendulum()
    q, v = (x[0] for x in scene.reference(np.array([2.0])))
    times = np.array([2.0, 1.3, 0.6, 0.0])
    sol = dae_jax.daesolve(scene.system, solver, 2.0, 0.0, None, (q, v), saveat=diffrax.SaveAt(ts=times))
    exact = scene.reference(times)
    np.testing.assert_allclose(sol.ys[0], exact[0], atol=1e-6)
    assert dae_jax.drift(scene.system, sol).position.max() < 1e-13


# Of any gravity (`args`).
SYSTEM = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), SCENE.system.constraint)
IMPLICIT = {"alone": diffrax.Kvaerno5(), "projected": dae_jax.OrthogonalProjection(diffrax.Kvaerno5())}


@pytest.mark.parametrize("solver", IMPLICIT.values(), ids=IMPLICIT)
def test_an_implicit_method_of_diffrax_has_the_controllers_tolerances(solver):
    """Which diffrax hands to a solver that stands alone only."""
    times = np.linspace(0, 1, 11)
    for tolerance, error in ((1e-5, 1e-3), (1e-8, 1e-6)):
        sol = solve_to(solver, 9.81, tolerance, saveat=diffrax.SaveAt(ts=times))
        assert SCENE.error(times, sol.ys) < error
        if solver is IMPLICIT["projected"]:
            assert float(dae_jax.drift(SYSTEM, sol).position.max()) < 1e-14


@pytest.mark.parametrize(
    ("solver", "adjoint"), [("alone", diffrax.ForwardMode()), ("projected", diffrax.DirectAdjoint())]
)
def test_an_implicit_method_of_diffrax_has_forward_derivatives(solver, adjoint):
    """Its loops within a step have them if diffrax is told so."""
    end = lambda gravity, adjoint: solve_to(IMPLICIT[solver], gravity, 1e-9, adjoint=adjoint).final[0]
    found = jax.jacfwd(lambda gravity: end(gravity, adjoint))(9.81)
    plain, h = diffrax.RecursiveCheckpointAdjoint(), 1e-4
    central = (end(9.81 + h, plain) - end(9.81 - h, plain)) / (2 * h)
    np.testing.assert_allclose(found, central, rtol=1e-5, atol=1e-7)


def solve_to(solver, gravity, tolerance, **options):
    controller = diffrax.PIDController(tolerance, tolerance)
    return dae_jax.daesolve(
        SYSTEM, solver, 0.0, 1.0, None, SCENE.y0, gravity, stepsize_controller=controller, **options
    )
