"""RadauIIA5: published problems, the orders of theory, derivatives, large systems, and what it says when it fails."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dae_jax
from dae_jax.scenes import SCENES


def solve(scene, rtol, times=None, y0=None, args=None, formulation=None, **options):
    saveat = diffrax.SaveAt(t1=True) if times is None else diffrax.SaveAt(ts=times)
    return dae_jax.daesolve(
        scene.system, dae_jax.RadauIIA5(), 0.0, scene.t1, None, scene.y0 if y0 is None else y0, args,
        formulation=formulation, saveat=saveat, max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol * scene.scale), **options,
    )  # fmt: skip


PUBLISHED = {
    "robertson": 1e-9,
    "akzo-nobel": 1e-9,
    "amplifier": 1e-9,
    "car-axis": 1e-9,
    "andrews": 1e-9,
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_end_values_to_six_digits(name):
    scene = SCENES[name]()
    end = solve(scene, PUBLISHED[name]).ys
    exact = jax.tree.map(lambda x: x[0], scene.reference(np.array([scene.t1])))
    for found, known in zip(jax.tree.leaves(end), jax.tree.leaves(exact), strict=True):
        known, found = known[~np.isnan(known)], np.asarray(found)[0][~np.isnan(known)]
        assert (np.abs(found - known) <= 1e-6 * np.abs(known)).all()


@pytest.mark.parametrize("form", ["index-2", "index-3"])
def test_car_axis_in_other_forms(form):
    scene = SCENES["car-axis"]()
    sol = solve(scene, 1e-9, formulation=dae_jax.Residual(form))
    assert scene.error(np.asarray(sol.ts), sol.ys) < {"index-2": 1e-7, "index-3": 1e-5}[form]


@pytest.mark.parametrize(
    "solver", [dae_jax.OrthogonalProjection(dae_jax.DOP853()), dae_jax.TangentSpace(dae_jax.DOP853())]
)
@pytest.mark.parametrize("name", ["car-axis", "andrews"])
def test_stiff_mechanisms_by_projection_and_in_the_tangent_space(name, solver):
    scene = SCENES[name]()
    sol = dae_jax.daesolve(
        scene.system, solver, 0.0, scene.t1, None, scene.y0, max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )  # fmt: skip
    assert scene.error(np.asarray(sol.ts), sol.ys) < 1e-6


def errors(scene, steps):
    """Of each variable at the end, with fixed steps."""
    sol = dae_jax.daesolve(
        scene.system, dae_jax.RadauIIA5(), 0.0, scene.t1, scene.t1 / steps, scene.y0, max_steps=10_000,
        stepsize_controller=diffrax.ConstantStepSize(),
    )  # fmt: skip
    exact = scene.reference(np.array([scene.t1]))
    found = [np.abs(np.asarray(a) - b)[0] for a, b in zip(jax.tree.leaves(sol.ys), jax.tree.leaves(exact), strict=True)]
    return np.concatenate(found)


# E. Hairer, C. Lubich, M. Roche, table 2.3, and L. O. Jay (1995), theorem 6.1: with s = 3 stages, 2s − 1 for the variables
# of index 1, s for those of index 2, s − 1 for those of index 3. At the first index of a system, all have the order 5.
ORDERS = {
    "hessenberg-2": ((8, 16), [5, 5, 3]),
    "capacitor-loop": ((80, 160), [5, 5, 3]),
    "jay": ((10, 20), [5, 5, 3, 3, 2]),
}


@pytest.mark.parametrize("name", ORDERS)
def test_orders_are_those_of_theory(name):
    (coarse, fine), orders = ORDERS[name]
    scene = SCENES[name]()
    far, near = errors(scene, coarse), errors(scene, fine)
    resolved = near > 1e-13
    slopes = np.log2(far[resolved] / near[resolved])
    assert (slopes > np.array(orders)[resolved] - 0.35).all(), slopes


def test_order_five_on_an_ode_and_on_index_one():
    def residual(t, y, yd, args):
        """y₁ = e^sin t, y₂ = y₁²."""
        return jnp.stack([yd[0] - jnp.cos(t) * jnp.sqrt(y[1]), y[1] - y[0] ** 2])

    def error(system, y0, h):
        end = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 2.0, h, y0, stepsize_controller=diffrax.ConstantStepSize()
        ).ys[-1]
        exact = np.exp(np.sin(2.0))
        return np.abs(np.asarray(end) - np.array([exact, exact**2])[: len(end)])

    ode = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd - jnp.cos(t) * y)
    for system, y0 in ((ode, jnp.ones(1)), (dae_jax.ImplicitDAE(residual), jnp.ones(2))):
        slopes = np.log2(error(system, y0, 0.2) / error(system, y0, 0.1))
        assert (slopes > 4.75).all(), slopes


def test_stabilised_form_keeps_both_levels_for_a_long_time():
    scene = SCENES["pendulum"]()
    sol = dae_jax.daesolve(
        scene.system, dae_jax.RadauIIA5(), 0.0, 100.0, None, scene.y0, max_steps=100_000,
        saveat=diffrax.SaveAt(steps=True), stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
    )  # fmt: skip
    taken = np.isfinite(sol.ts)
    off = dae_jax.drift(scene.system, sol)
    assert max(off.position[taken].max(), off.velocity[taken].max()) < 1e-9


def test_between_steps_the_solution_is_the_collocation_polynomial():
    scene = SCENES["akzo-nobel"]()
    times = np.linspace(0, 180, 37)
    tight = np.asarray(solve(scene, 1e-11, times).ys)
    loose = np.asarray(solve(scene, 1e-6, times).ys)
    assert np.abs(loose - tight).max() < 3e-6


# Derivatives

RATES = jnp.array([0.04, 1e4, 3e7])


def of_rates(rates, y0, adjoint, rtol):
    """Robertson's y₃ at t = 40."""
    k1, k2, k3 = rates
    f = lambda t, x, z, k: jnp.stack(
        [-k[0] * x[0] + k[1] * x[1] * z[0], k[0] * x[0] - k[1] * x[1] * z[0] - k[2] * x[1] ** 2]
    )
    g = lambda t, x, z, k: jnp.stack([x[0] + x[1] + z[0] - 1])
    start = (jnp.stack([y0, 0 * y0]), jnp.stack([1 - y0]))
    sol = dae_jax.daesolve(
        dae_jax.SemiExplicitDAE(f, g), dae_jax.RadauIIA5(), 0.0, 40.0, None, start, jnp.stack([k1, k2, k3]),
        adjoint=adjoint, stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-4 * rtol), max_steps=2000,
    )  # fmt: skip
    return sol.ys[1][-1, 0]


def test_gradient_on_robertson():
    value = jax.jit(lambda p: of_rates(RATES * p[:3], p[3], diffrax.RecursiveCheckpointAdjoint(), 1e-10))
    loose = lambda adjoint: lambda p: of_rates(RATES * p[:3], p[3], adjoint, 1e-8)
    p, h = jnp.array([1.0, 1.0, 1.0, 0.9]), 1e-4
    central = jnp.stack([(value(p + h * e) - value(p - h * e)) / (2 * h) for e in jnp.eye(4)])
    reverse = jax.grad(loose(diffrax.RecursiveCheckpointAdjoint()))(p)
    forward = jax.jacfwd(loose(diffrax.ForwardMode()))(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    np.testing.assert_allclose(forward, central, rtol=1e-5)
    batch = jnp.stack([p, 1.1 * p - 0.09 * jnp.eye(4)[3]])
    together = jax.vmap(jax.grad(loose(diffrax.RecursiveCheckpointAdjoint())))(batch)
    np.testing.assert_allclose(together[0], reverse, rtol=1e-8)


def test_gradient_on_car_axis():
    """Of q and v at t = 0.1, with respect to a vertical force (`args`) and the axis' vertical velocity at the start."""
    scene = SCENES["car-axis"]()

    def end(p, adjoint, rtol):
        lift, shift = p
        # Vertical velocities keep the constraints at t = 0.
        force = lambda t, q, v, extra: scene.system.force(t, q, v, None) + extra * jnp.array([0.0, 1.0, 0.0, 1.0])
        system = dae_jax.ConstrainedSystem(force, scene.system.constraint, mass=scene.system.mass)
        v = jnp.asarray(scene.y0[1]) + shift * jnp.array([0.0, 1.0, 0.0, 1.0])
        sol = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 0.1, None, (jnp.asarray(scene.y0[0]), v), lift, adjoint=adjoint,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), max_steps=2000,
        )  # fmt: skip
        return jnp.sum(sol.ys[0]) + 0.1 * jnp.sum(sol.ys[1])

    p, h = jnp.array([1e-3, 0.01]), 1e-5
    value = jax.jit(lambda p: end(p, diffrax.RecursiveCheckpointAdjoint(), 1e-11))
    central = jnp.stack([(value(p + h * e) - value(p - h * e)) / (2 * h) for e in jnp.eye(2)])
    reverse = jax.grad(lambda p: end(p, diffrax.RecursiveCheckpointAdjoint(), 1e-9))(p)
    forward = jax.jacfwd(lambda p: end(p, diffrax.ForwardMode(), 1e-9))(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-7)
    np.testing.assert_allclose(forward, central, rtol=1e-4)


# Large systems

N = 500


def test_a_thousand_unknowns():
    """Diffusion with its fluxes as unknowns, u̇ᵢ = −n (fᵢ₊₁ − fᵢ), fᵢ = −n (uᵢ − uᵢ₋₁): the lowest mode decays as it must."""
    modes = np.sin(np.pi * np.arange(1, N + 1) / (N + 1))
    rate = 4 * N**2 * np.sin(np.pi / (2 * (N + 1))) ** 2

    def f(t, x, z, args):
        return -N * (z[1:] - z[:-1])

    def g(t, x, z, args):
        zero = jnp.zeros(1, x.dtype)
        return z + N * (jnp.concatenate([x, zero]) - jnp.concatenate([zero, x]))

    system = dae_jax.SemiExplicitDAE(f, g)
    fluxes = -N * np.diff(np.concatenate([[0], modes, [0]]))
    plan = dae_jax.explain(system, dae_jax.RadauIIA5(), 0.0, (modes, fluxes))
    assert plan.linear_solver.startswith("sparse")
    sol = dae_jax.daesolve(system, dae_jax.RadauIIA5(), 0.0, 0.1, None, (modes, fluxes))
    decay = np.exp(-0.1 * rate)
    np.testing.assert_allclose(sol.ys[0][-1], modes * decay, atol=1e-8)
    np.testing.assert_allclose(sol.ys[1][-1], fluxes * decay, atol=1e-6)


def test_a_batch_is_one_at_a_time():
    scene = SCENES["akzo-nobel"]()
    end = lambda t1: dae_jax.daesolve(scene.system, dae_jax.RadauIIA5(), 0.0, t1, None, scene.y0).ys[-1]
    ends = jnp.array([1.0, 20.0, 180.0])
    np.testing.assert_allclose(jax.vmap(end)(ends), jnp.stack([end(t) for t in ends]), rtol=1e-12)


def test_backwards_in_time():
    scene = SCENES["capacitor-loop"]()
    times = np.array([2.0, 1.2, 0.0])
    start = scene.reference(np.array([2.0]))[0]
    sol = dae_jax.daesolve(
        scene.system, dae_jax.RadauIIA5(), 2.0, 0.0, None, start, saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )  # fmt: skip
    np.testing.assert_allclose(sol.ys, scene.reference(times), atol=1e-5)


def test_a_kink_in_time_is_passed():
    """ẏ = z, z = |t − 1|: y(2) = 1."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z - jnp.abs(t - 1))
    sol = dae_jax.daesolve(
        system, dae_jax.RadauIIA5(), 0.0, 2.0, None, (jnp.zeros(1), jnp.ones(1)),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
    )  # fmt: skip
    np.testing.assert_allclose(sol.ys[0][-1], 1.0, atol=1e-7)


# Failures


def failing(residual, y0, t1=2.0, **options):
    return dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual), dae_jax.RadauIIA5(), 0.0, t1, None, jnp.asarray(y0), throw=False, **options
    )


def test_a_singular_iteration_matrix_is_named():
    """One equation is twice the other: nothing determines z."""
    sol = failing(lambda t, y, yd, a: jnp.stack([yd[0] - y[1], 2 * yd[0] - 2 * y[1]]), [0.0, 1.0])
    assert sol.result == dae_jax.RESULTS.singular_iteration_matrix


def test_a_newton_that_does_not_converge_is_named():
    """0 = z² − (1 − t) has no real solution beyond t = 1."""
    sol = failing(lambda t, y, yd, a: jnp.stack([yd[0] - y[1], y[1] ** 2 - (1 - t)]), [0.0, 1.0])
    assert sol.result in (dae_jax.RESULTS.no_convergence, dae_jax.RESULTS.singular_iteration_matrix)


def test_a_solution_that_blows_up_is_named():
    sol = failing(lambda t, y, yd, a: yd - y**2, [1.0])
    assert sol.result == dae_jax.RESULTS.error_too_large


def test_nan_is_an_error():
    sol = failing(lambda t, y, yd, a: yd - jnp.where(t > 0.5, jnp.nan, 1.0), [0.0])
    assert sol.result == dae_jax.RESULTS.no_convergence


def test_an_inconsistent_start_names_the_equation():
    scene = SCENES["robertson"]()
    with pytest.raises(ValueError, match=r"0 = g\[0\] is off by 0.5"):
        solve(scene, 1e-6, y0=(scene.y0[0], np.array([0.5])))


def test_an_index_that_is_too_high_is_refused():
    with pytest.raises(ValueError, match=r"index of .* is 4"):
        solve(SCENES["integrators-4"](), 1e-6, formulation=dae_jax.Residual())


def test_float32():
    scene = SCENES["akzo-nobel"]()
    start = jnp.asarray(scene.y0, jnp.float32)
    sol = dae_jax.daesolve(
        scene.system, dae_jax.RadauIIA5(), 0.0, scene.t1, None, start,
        stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-6),
    )  # fmt: skip
    assert sol.ys.dtype == jnp.float32
    assert scene.error(np.asarray([scene.t1]), sol.ys) < 1e-2


def swinging_dae(t, y, yd, args):
    q, v, rod = y[:2], y[2:4], y[4]
    return jnp.concatenate([yd[:2] - v, yd[2:4] + rod * q - jnp.array([0.0, 9.81], y.dtype), (q @ q - 1)[None] / 2])


@pytest.mark.parametrize(("angle", "speed"), [(1.0, 8.0), (0.5, 6.0)])
@pytest.mark.parametrize("kind", ["mechanism", "dae"])
def test_velocities_of_index_3_in_float32(kind, angle, speed):
    """The first steps are so short that the error of a velocity hardly counts, along the way too."""
    way = lambda t, y: [y[1], 9.81 * np.cos(y[0])]
    truth = solve_ivp(way, (0, 2), [angle, speed], rtol=1e-12, atol=1e-12).y[:, -1]
    velocity = lambda a, w: w * np.array([-np.sin(a), np.cos(a)])
    q, v = (np.array(x, np.float32) for x in ([np.cos(angle), np.sin(angle)], velocity(angle, speed)))
    if kind == "mechanism":
        force = lambda t, q, v, args: jnp.array([0.0, 9.81], q.dtype)
        system, start = dae_jax.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2), (q, v)
    else:
        system = dae_jax.ImplicitDAE(swinging_dae)
        start = dae_jax.consistent_state(system, 0.0, np.array([*q, *v, v @ v + 9.81 * q[1]], np.float32))
    sol = dae_jax.daesolve(
        system, dae_jax.RadauIIA5(), 0.0, 2.0, None, start, formulation=dae_jax.Residual("index-3"),
    )  # fmt: skip
    found = np.concatenate([np.asarray(x)[-1] for x in jax.tree.leaves(sol.ys)])[2:4]
    np.testing.assert_allclose(found, velocity(*truth), atol=200 * 1e-5 * (1 + speed))


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(rtol=1e-8, atol=1e-8), dae_jax.BDF(rtol=1e-8, atol=1e-8)])
def test_with_diffrax_itself(solver):
    scene, formulation = SCENES["hessenberg-2"](), dae_jax.Residual()
    y0, ode = formulation.encode(scene.system, 0.0, scene.y0)
    sol = diffrax.diffeqsolve(
        formulation.term(), solver, 0.0, scene.t1, 1e-4, y0, args=ode,
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
    )  # fmt: skip
    assert sol.ys is not None
    end = jax.tree.map(lambda x: x[None], formulation.decode(scene.t1, sol.ys[-1], ode))
    assert scene.error(np.array([scene.t1]), end) < 1e-6


def test_a_singular_iteration_matrix_names_equations_and_unknowns():
    """From t = 1 on, two of the equations are one, and nothing tells u from v; x is determined, and w."""

    def residual(t, y, yd, args):
        x, u, v, w = y["x"], y["u"], y["v"], y["w"]
        return [yd["x"] + x, u + v - x, 2 * (u + v - x) + jnp.maximum(1 - t, 0.0) * (u - v), w - x]

    start = {name: jnp.asarray(value) for name, value in (("x", 1.0), ("u", 0.5), ("v", 0.5), ("w", 1.0))}
    with pytest.raises(
        RuntimeError, match=r"equations residual\[1\], residual\[2\] do not determine y\['u'\], y\['v'\]\."
    ):
        dae_jax.daesolve(
            dae_jax.ImplicitDAE(residual), dae_jax.RadauIIA5(), 1.5, 2.0, None, start, saveat=diffrax.SaveAt(steps=True)
        )
