"""The underlying ODE of any system: equal to a mechanism's own, right at every index, and with dummy derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array

import dae_jax
from dae_jax.equations.derivative_orders import Combination, find_offsets
from dae_jax.equations.orders import Orders
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.equations.sparse_invariants import SparseInvariants
from dae_jax.equations.structural_ode import StructuralODE
from dae_jax.linalg import Tearing
from dae_jax.scenes import SCENES, pendulum


PENDULUM = SCENES["pendulum"]()
PROJECTED = dae_jax.OrthogonalProjection(dae_jax.DOP853())
TIGHT = diffrax.PIDController(rtol=1e-10, atol=1e-10)


def residual(t, y, yd, gravity):
    """The pendulum with y = (x, y, u, v, λ)."""
    x, v, multiplier = y[:2], y[2:4], y[4]
    g = 9.81 if gravity is None else gravity
    force = jnp.stack([0 * multiplier, g + 0 * multiplier])
    return jnp.concatenate([yd[:2] - v, yd[2:4] - force + multiplier * x, (jnp.sum(x**2, keepdims=True) - 1) / 2])


def semi_explicit():
    f = lambda t, x, z, a: jnp.concatenate([x[2:], jnp.stack([0 * z[0], 9.81 + 0 * z[0]]) - z[0] * x[:2]])
    return dae_jax.SemiExplicitDAE(f, lambda t, x, z, a: (jnp.sum(x[:2] ** 2, keepdims=True) - 1) / 2)


IMPLICIT = dae_jax.ImplicitDAE(residual)
START = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
FORMS = {
    "implicit": (IMPLICIT, START, lambda ys: ys[:, :4]),
    "semi-explicit": (semi_explicit(), (START[:4], START[4:]), lambda ys: ys[0]),
}
SOLVERS = {
    "projection": (PROJECTED, None, None),
    "tangent": (dae_jax.TangentSpace(dae_jax.DOP853()), None, None),
    "symmetric": (dae_jax.SymmetricProjection(dae_jax.Gauss4()), None, 0.01),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives(), None),
    "baumgarte": (dae_jax.DOP853(), dae_jax.Baumgarte(5.0, 5.0), None),
    "differentiation": (dae_jax.DOP853(), None, None),
}


@pytest.mark.parametrize(
    ("form", "name"),
    [*(("implicit", name) for name in SOLVERS), ("semi-explicit", "projection")],
)
def test_a_mechanism_in_any_form_has_the_same_solution(form, name):
    system, start, state = FORMS[form]
    solver, formulation, step = SOLVERS[name]
    times = np.linspace(0, 3, 31)
    sol = dae_jax.daesolve(
        system, solver, 0.0, 3.0, step, start, formulation=formulation, saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=None if step else TIGHT,
    )  # fmt: skip
    found = np.asarray(state(sol.ys))
    exact = np.concatenate(PENDULUM.reference(times), 1)
    assert np.abs(found - exact).max() < (2e-6 if step else 2e-8)
    if name not in ("baumgarte", "differentiation"):
        assert np.abs(np.sum(found[:, :2] ** 2, 1) - 1).max() < 1e-13
        assert np.abs(np.sum(found[:, :2] * found[:, 2:], 1)).max() < 1e-13


HIGH = ["akzo-nobel", "hessenberg-2", "capacitor-loop", "jay", "integrators-4", "integrators-5"]


@pytest.mark.parametrize("name", HIGH)
def test_index_one_to_five(name):
    scene = SCENES[name]()
    assert dae_jax.analyse(scene.system, 0.0, scene.y0).index == scene.index
    times = np.linspace(0, scene.t1, 21)
    sol = dae_jax.daesolve(
        scene.system, PROJECTED, 0.0, scene.t1, None, scene.y0, saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10 * scene.scale),
    )  # fmt: skip
    assert scene.error(times, sol.ys) < 1e-8


def crane(t, y, yd, args):
    """A load (x, z) on a rope of length r at the angle θ from a trolley at d, all masses 1: the forces u on the trolley and w
    on the winch are sought that lead the load along a given path. y = (x, ẋ, z, ż, d, ḋ, r, ṙ, θ, τ, u, w).

    Source: S. L. Campbell, *High-index differential algebraic equations*, Mech. Struct. Mach. 23 (1995), 199–222.
    """
    x, dx, z, dz, d, dd, r, dr, angle, tension, u, w = y
    s, c = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack(
        [
            yd[0] - dx,
            yd[1] + tension * s,
            yd[2] - dz,
            yd[3] + tension * c - 9.81,
            yd[4] - dd,
            yd[5] - u - tension * s,
            yd[6] - dr,
            yd[7] - w - tension,
            d + r * s - x,
            r * c - z,
            x - 0.6 * t**5,
            z - 2.0,
        ]
    )


def test_inverse_dynamics_of_an_overhead_crane():
    """The load at depth 2, 3 t⁵/5 along its path: tan θ = −ẍ/g, and the tension, the rope and the trolley follow."""
    system = dae_jax.ImplicitDAE(crane)
    start = np.array([0, 0, 2, 0, 0, 0, 2, 0, 0, 9.81, 0, -9.81])
    structure = dae_jax.analyse(system, 0.0, jnp.asarray(start))
    assert structure.index == 5
    assert structure.degrees_of_freedom == 0
    times = np.linspace(0, 1, 11)
    sol = dae_jax.daesolve(system, PROJECTED, 0.0, 1.0, None, start, saveat=diffrax.SaveAt(ts=times))
    angle = -np.arctan2(12 * times**3, 9.81)
    np.testing.assert_allclose(sol.ys[:, 8], angle, atol=1e-8)
    np.testing.assert_allclose(sol.ys[:, 4], 0.6 * times**5 - 2 * np.tan(angle), atol=1e-8)
    np.testing.assert_allclose(sol.ys[:, 9], 9.81 / np.cos(angle), atol=1e-8)
    np.testing.assert_allclose(sol.ys[:, 6], 2 / np.cos(angle), atol=1e-8)


def test_reactor_whose_temperature_is_prescribed():
    """C. C. Pantelides (1988): concentration, temperature, reaction rate and coolant; the coolant has its own dynamics, whose
    inflow is sought. Index 3: the prescribed temperature is differentiated twice.
    """

    def reactor(t, y, yd, args):
        c, temperature, rate, coolant, inflow = y
        return jnp.stack(
            [
                yd[0] - (1 - c) + rate,
                yd[1] - (1 - temperature) - 2 * rate + (temperature - coolant),
                rate - jnp.exp(-1 / temperature) * c,
                yd[3] - (temperature - coolant) - inflow,
                temperature - 1 - 0.1 * jnp.sin(t),
            ]
        )

    system = dae_jax.ImplicitDAE(reactor)
    guess = jnp.array([0.5, 1.0, 0.2, 1.0, 0.0])
    structure = dae_jax.analyse(system, 0.0, guess)
    assert structure.index == 3
    assert structure.degrees_of_freedom == 1
    start = dae_jax.consistent_state(system, 0.0, guess, fixed=jnp.array([True, False, False, False, False]))
    assert float(start[0]) == 0.5
    projected, radau = (
        dae_jax.daesolve(system, solver, 0.0, 3.0, None, start, stepsize_controller=TIGHT).ys[-1]
        for solver in (PROJECTED, dae_jax.RadauIIA5())
    )
    np.testing.assert_allclose(projected[1], 1 + 0.1 * np.sin(3.0), atol=1e-12)
    np.testing.assert_allclose(projected[:4], radau[:4], atol=1e-7)


def test_an_amplifier_whose_capacitor_currents_cancel():
    """Published: index 1, and the voltages after 0.2 s."""
    scene = SCENES["amplifier"]()
    off = np.array([0, 3, 3, 6, 3.1, 3, 6, 0.1])
    start = dae_jax.consistent_state(scene.system, 0.0, off)
    left = np.asarray(scene.system.residual(0.0, start, np.zeros(8), None))
    np.testing.assert_allclose([left[0] + left[1], left[3] + left[4], left[6] + left[7]], 0, atol=1e-12)
    assert np.abs(start - off).max() < 0.1
    with pytest.raises(ValueError, match=r"residual\[3\] is off.*\n.*residual\[4\] is off"):
        dae_jax.daesolve(scene.system, PROJECTED, 0.0, 0.2, None, off)
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    sol = dae_jax.daesolve(scene.system, PROJECTED, 0.0, 0.2, None, scene.y0, stepsize_controller=control)
    np.testing.assert_allclose(sol.ys[-1], scene.reference(np.array([0.2]))[0], atol=1e-7)


@pytest.mark.parametrize("name", ["projection", "dummy derivatives", "baumgarte"])
def test_an_equation_combined_with_the_derivative_of_another(name):
    """y₃ = e^(−t) is hidden in y₁' + y₂' + y₃ = cos t + e^(−t) and y₁ + y₂ = sin t; y₁' + y₁ = sin t + e^(−t)."""
    residual = lambda t, y, yd, a: jnp.stack(
        [yd[0] + yd[1] + y[2] - jnp.cos(t) - jnp.exp(-t), y[0] + y[1] - jnp.sin(t), yd[2] + yd[0] - y[1]]
    )
    solver, formulation, _ = SOLVERS[name]
    sol = dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual), solver, 0.0, 3.0, None, np.array([1.0, -1.0, 1.0]), formulation=formulation,
        stepsize_controller=TIGHT,
    )  # fmt: skip
    first = 1.5 * np.exp(-3) + (np.sin(3) - np.cos(3)) / 2 + 3 * np.exp(-3)
    np.testing.assert_allclose(sol.ys[-1], [first, np.sin(3) - first, np.exp(-3)], atol=1e-9)


def test_order_five_with_fixed_steps():
    scene = SCENES["jay"]()

    def error(steps):
        sol = dae_jax.daesolve(
            scene.system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 1.0, 1.0 / steps, scene.y0,
            stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
        return scene.error(np.array([1.0]), sol.ys)

    assert np.log2(error(32) / error(64)) > 4.7


def test_gradients_in_both_modes_and_batches():
    def end(p, adjoint):
        angle, gravity = p
        y0 = jnp.stack([jnp.sin(angle), jnp.cos(angle), 0 * angle, 0 * angle, gravity * jnp.cos(angle)])
        solver = dae_jax.OrthogonalProjection(diffrax.Tsit5())
        sol = dae_jax.daesolve(
            IMPLICIT, solver, 0.0, 0.5, 0.05, y0, gravity, adjoint=adjoint,
            stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
        return jnp.sum(sol.ys[-1, :4] * jnp.array([0.3, -0.7, 0.2, 0.5]))

    p, h = jnp.array([1.2, 9.81]), 1e-5
    values = jax.jit(jax.vmap(lambda p: end(p, diffrax.RecursiveCheckpointAdjoint())))(
        jnp.concatenate([p + h * jnp.eye(2), p - h * jnp.eye(2), p[None]])
    )
    value, reverse = jax.jit(jax.value_and_grad(lambda p: end(p, diffrax.RecursiveCheckpointAdjoint())))(p)
    forward = jax.jit(jax.jacfwd(lambda p: end(p, diffrax.ForwardMode())))(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(forward, (values[:2] - values[2:4]) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(values[4], value, rtol=1e-12)


# Dummy derivatives


@pytest.mark.parametrize("name", ["over the top", "double-pendulum"])
def test_dummy_derivatives_for_a_hundred_seconds(name):
    scene = pendulum(angle=0.0, angular_velocity=7.0) if name == "over the top" else SCENES[name]()
    times = np.linspace(0, 100, 2001)
    sol = dae_jax.daesolve(
        scene.system, dae_jax.DOP853(), 0.0, 100.0, None, scene.y0, formulation=dae_jax.DummyDerivatives(),
        saveat=diffrax.SaveAt(ts=times), stepsize_controller=TIGHT, max_steps=100_000,
    )  # fmt: skip
    assert int(sol.stats["switches"]) > 100
    off = dae_jax.drift(scene.system, sol)
    assert max(off.position.max(), off.velocity.max()) < 1e-13
    total = np.asarray(dae_jax.energy(scene.system, sol))
    # Relative to the energy between the lowest and the highest place of the masses.
    depth = 9.81 * (2 if name == "over the top" else 6)
    assert np.abs(total - total[0]).max() < 1e-7 * depth
    early = times <= min(scene.horizon, 10.0)
    assert scene.error(times[early], jax.tree.map(lambda y: y[early], sol.ys)) < 2e-6


def test_derivatives_through_a_switch():
    """At 1e-6 a step is rejected because a stage is not found on the manifold, which makes a NaN on the way."""

    def end(angle, tolerance, adjoint):
        y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.zeros(2))
        sol = dae_jax.daesolve(
            PENDULUM.system, dae_jax.DOP853(), 0.0, 1.0, None, y0, formulation=dae_jax.DummyDerivatives(), adjoint=adjoint,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=100,
        )  # fmt: skip
        return sol.ys[0][-1, 0], (sol.ys[0][-1, 0], sol.stats["switches"])

    reverse = jax.jit(jax.jacrev(lambda a, tol: end(a, tol, diffrax.RecursiveCheckpointAdjoint())[0]))
    forward = jax.jit(jax.jacfwd(lambda a, tol: end(a, tol, diffrax.ForwardMode()), has_aux=True))
    h = 1e-4
    _, (above, _), _, (below, _) = (*forward(1.2 + h, 1e-11), *forward(1.2 - h, 1e-11))
    for tolerance in (1e-6, 1e-9):
        slope, (_, switches) = forward(1.2, tolerance)
        assert int(switches) >= 1
        # The steps that the reverse derivative repeats have the sizes they had up to round-off.
        np.testing.assert_allclose(reverse(1.2, tolerance), slope, rtol=1e-11)
        np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=max(1e-6, 100 * tolerance))


def test_dummy_derivatives_take_no_implicit_solver_of_odes():
    with pytest.raises(ValueError, match="explicit Runge"):
        dae_jax.daesolve(
            PENDULUM.system, dae_jax.Trapezoid(), 0.0, 1.0, 0.1, PENDULUM.y0, formulation=dae_jax.DummyDerivatives()
        )


# Starts


def test_an_inconsistent_start_names_the_hidden_equation():
    bad = START + np.array([0, 0, 0.5, 0, 0])
    with pytest.raises(ValueError, match=r"d/dt residual\[4\] is off by"):
        dae_jax.daesolve(IMPLICIT, PROJECTED, 0.0, 1.0, None, bad)
    with pytest.raises(ValueError, match=r"d\^2/dt\^2 residual\[4\] is off by"):
        dae_jax.daesolve(IMPLICIT, dae_jax.RadauIIA5(), 0.0, 1.0, None, START + np.array([0, 0, 0, 0, 3.0]))


def test_consistent_states_are_near_and_differentiable():
    off = START + np.array([0.1, 0.05, 0.3, -0.2, 7.0])
    found = dae_jax.consistent_state(IMPLICIT, 0.0, off)
    x, v, multiplier = found[:2], found[2:4], found[4]
    np.testing.assert_allclose([x @ x - 1, x @ v], 0, atol=1e-12)
    np.testing.assert_allclose(multiplier, v @ v + 9.81 * x[1], rtol=1e-10)
    np.testing.assert_allclose(dae_jax.consistent_state(IMPLICIT, 0.0, found), found, atol=1e-10)
    jacobian = jax.jacfwd(lambda y: dae_jax.consistent_state(IMPLICIT, 0.0, y))(jnp.asarray(off))
    h = 1e-3
    for j, e in enumerate(np.eye(5)):
        up, down = (dae_jax.consistent_state(IMPLICIT, 0.0, off + s * h * e) for s in (1, -1))
        np.testing.assert_allclose(jacobian[:, j], (up - down) / (2 * h), atol=1e-6)


def test_what_is_fixed_stays():
    fixed = np.array([True, False, True, False, False])
    found = dae_jax.consistent_state(IMPLICIT, 0.0, np.array([0.6, 0.7, 0.4, 0.0, 0.0]), fixed=fixed)
    np.testing.assert_allclose(found[:4], [0.6, 0.8, 0.4, -0.3], atol=1e-10)
    with pytest.raises(ValueError, match="No consistent state"):
        dae_jax.consistent_state(IMPLICIT, 0.0, np.array([2.0, 0, 0, 0, 0]), fixed=fixed)


def test_a_state_of_given_derivatives():
    """At rest a double pendulum hangs, a capacitor is charged; charging at a given rate, it takes what flows."""
    scene = SCENES["double-pendulum"]()
    near = (jnp.array([0.3, 0.9, 0.5, 1.8]), jnp.zeros(4))
    q, v = dae_jax.consistent_state(scene.system, 0.0, near, scene.args, rates=(jnp.zeros(4), jnp.zeros(4)))
    np.testing.assert_allclose(q, [0, 1, 0, 2], atol=1e-12)
    np.testing.assert_allclose(v, 0, atol=1e-30)

    charging = dae_jax.SemiExplicitDAE(lambda t, u, i, e: i - u / 5, lambda t, u, i, e: e - u - i / 10)
    zero = (jnp.zeros(1), jnp.zeros(1))
    state = lambda e, rate: dae_jax.consistent_state(charging, 0.0, zero, e, rates=(rate, zero[1]))
    np.testing.assert_allclose(state(2.0, zero[0])[0], 2 / 1.02, rtol=1e-12)
    u, i = state(2.0, jnp.ones(1))
    np.testing.assert_allclose([i - u / 5, 2 - u - i / 10], [[1], [0]], atol=1e-12)
    np.testing.assert_allclose(jax.grad(lambda e: state(e, zero[0])[0][0])(2.0), 1 / 1.02, rtol=1e-10)

    growing = dae_jax.SemiExplicitDAE(lambda t, u, i, e: 1 + u**2 + 0 * i, charging.g)
    with pytest.raises(ValueError, match="No consistent state"):
        dae_jax.consistent_state(growing, 0.0, zero, 2.0, rates=zero)


@pytest.mark.parametrize(
    "name", ["akzo-nobel", "amplifier", "capacitor-loop", "hessenberg-2", "integrators-4", "jay", "robertson"]
)
def test_sparse_invariants_are_the_dense_ones(name):
    """Also where equations stand for combinations of derivatives of others, as in the loop of capacitors."""
    scene = SCENES[name]()
    form = ResidualForm.of(scene.system, 0.0, scene.y0, scene.args)
    ode = StructuralODE.of(form, jnp.float64, complete=1)
    sparse = SparseInvariants.of(ode, find_offsets(form, jnp.float64).occurrence)
    y = jnp.asarray(np.random.default_rng(0).uniform(0.1, 1, ode.orders.size))
    dense = ode.jacobian(0.3, y)
    found = np.zeros(dense.shape)
    np.add.at(found, (sparse.rows, sparse.columns), sparse.entries(ode, 0.3, y))
    np.testing.assert_allclose(found, dense, rtol=1e-12, atol=1e-12 * np.abs(dense).max())


def test_sparse_invariants_of_equations_that_are_made_of_derivatives():
    """F̄₀ = F₀ + 2 dF₁/dt has ÿ₁, as F₁ has ẏ₁."""
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: jnp.stack([yd[0] + y[1], yd[1] * y[0] - t]))
    form = ResidualForm.of(system, 0.0, jnp.ones(2), None)
    combination = Combination(((0, ((0, 0, 1.0), (1, 1, 2.0))),))
    ode = StructuralODE(form, combination, Orders((2, 2), (4, 4)), Tearing())
    sparse = SparseInvariants.of(ode, csr_array(np.ones((2, 2), bool)))
    y = jnp.asarray(np.random.default_rng(0).uniform(0.1, 1, ode.orders.size))
    found = np.zeros((sparse.m, y.size))
    np.add.at(found, (sparse.rows, sparse.columns), sparse.entries(ode, 0.3, y))
    np.testing.assert_allclose(found, ode.jacobian(0.3, y), atol=1e-12)
