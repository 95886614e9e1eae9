"""Sources that jump: solvers of residuals pass, with the algebraic variables; those that differentiate the jump say so."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


CONTROL = diffrax.PIDController(rtol=1e-8, atol=1e-8)
SWITCHED, LEVEL = 1 / 3, 3.0


def residual(t, y, yd, level):
    """A capacitor behind a nonlinear resistor on a source that is switched on: z + w = level, z = 2 w³ + w."""
    x, z, w = y
    source = jnp.where(t < SWITCHED, 0.0, level)
    return jnp.stack([yd[0] + x - z, z + w - source, z - 2 * w**3 - w])


def exact(t):
    w = next(root.real for root in np.roots([2, 0, 2, -LEVEL]) if abs(root.imag) < 1e-12)
    z = LEVEL - w
    return np.array([z * (1 - np.exp(SWITCHED - t)), z, w])


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()], ids=["radau", "bdf"])
def test_algebraic_variables_jump_with_their_source(solver):
    sol = dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual), solver, 0.0, 2.0, None, np.zeros(3), LEVEL, stepsize_controller=CONTROL,
        saveat=diffrax.SaveAt(ts=[0.2, SWITCHED + 1e-6, 1.0, 2.0]),
    )  # fmt: skip
    np.testing.assert_allclose(sol.ys[0], 0, atol=1e-12)
    for t, y in zip(sol.ts[1:], sol.ys[1:], strict=True):
        np.testing.assert_allclose(y, exact(float(t)), atol=2e-7)


@pytest.mark.parametrize(
    "solver",
    [dae_jax.OrthogonalProjection(diffrax.Tsit5()), dae_jax.TangentSpace(dae_jax.DOP853())],
    ids=["projection", "tangent"],
)
def test_a_manifold_that_jumps_is_an_error(solver):
    with pytest.raises(RuntimeError, match=r"become dependent .* or jump.*t = 0\.333"):
        dae_jax.daesolve(
            dae_jax.ImplicitDAE(residual), solver, 0.0, 2.0, None, np.zeros(3), LEVEL, stepsize_controller=CONTROL
        )


def test_a_differential_variable_does_not_jump():
    """x' = 1/(1 − t): the step is smallest where x is infinite, and nothing is passed over."""
    system = dae_jax.ImplicitDAE(lambda t, y, yd, a: jnp.stack([yd[0] * (1 - t) - 1, y[1] - y[0]]))
    for solver in (dae_jax.RadauIIA5(), dae_jax.BDF()):
        with pytest.raises(RuntimeError):
            dae_jax.daesolve(system, solver, 0.0, 2.0, None, np.zeros(2), stepsize_controller=CONTROL, max_steps=10_000)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF(), dae_jax.OrthogonalProjection(dae_jax.DOP853())])
def test_jumps_that_are_announced_are_stepped_to(solver):
    """x' = u − x + z, z = x/10: u has a kink at 1 and jumps at 2."""
    u = lambda t: jnp.where(t < 1, 0.0, jnp.where(t < 2, t - 1, 3.0))
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: u(t) - x + z, lambda t, x, z, args: z - x / 10)
    control = diffrax.PIDController(rtol=1e-7, atol=1e-7)

    def solve(control):
        start = (np.array([1.0]), np.array([0.1]))
        sol = dae_jax.daesolve(system, solver, 0.0, 3.0, None, start, stepsize_controller=control)
        return float(sol.ys[0][-1, 0]), int(sol.stats["num_steps"])

    k = 0.9
    at_2 = (np.exp(-k) + 1 / k**2) * np.exp(-k) + 1 / k - 1 / k**2
    exact = (at_2 - 3 / k) * np.exp(-k) + 3 / k
    (found, steps), (_, unannounced) = (
        solve(diffrax.ClipStepSizeController(control, jump_ts=jnp.array([1.0, 2.0]))), solve(control)
    )  # fmt: skip
    assert abs(found - exact) < 3e-7
    assert steps < 0.6 * unannounced


@pytest.mark.parametrize("announced", [True, False], ids=["announced", "found"])
@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()], ids=["radau", "bdf"])
def test_a_voltage_jumps_from_one_side_of_a_diode_to_the_other(solver, announced):
    """A buck converter: the coil's current leaves the switch for the diode, where a whole Newton correction overflows."""
    coil, capacitor, load, supply, on, off, period = 1e-3, 1e-4, 10.0, 24.0, 0.01, 1e6, 1e-4

    def residual(t, y, yd, args):
        current, voltage, node = y
        switch = jnp.where(t % period < 0.4 * period, on, off)
        diode = 1e-9 * jnp.expm1(jnp.minimum(-node / 0.05, 80.0))
        return jnp.stack(
            [
                coil * yd[0] - (node - voltage),
                capacitor * yd[1] - (current - voltage / load),
                (supply - node) / switch + diode - current,
            ]
        )

    system = dae_jax.ImplicitDAE(residual)
    start = dae_jax.consistent_state(system, 0.0, jnp.array([0, 0, supply]), fixed=jnp.array([True, True, False]))
    switched = jnp.array([0.4, 1.0, 1.4, 2.0, 2.4]) * period

    @jax.jit
    def solve(tolerance):
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        control = diffrax.ClipStepSizeController(control, jump_ts=switched) if announced else control
        sol = dae_jax.daesolve(
            system, solver, 0.0, 2.7 * period, None, start, stepsize_controller=control, max_steps=20_000
        )
        return sol.ys[-1]

    # The same with the node eliminated by hand, by the midpoint rule with steps of 10 ns.
    y = np.zeros(2)
    n = 27_000
    h = 2.7 * period / n
    for i in range(n):
        conducting = (i + 0.5) * h % period < 0.4 * period
        driven = lambda y, conducting=conducting: supply - on * y[0] if conducting else -0.05 * np.log1p(y[0] / 1e-9)
        slope = lambda y, driven=driven: np.array([(driven(y) - y[1]) / coil, (y[0] - y[1] / load) / capacitor])
        y = y + h * slope(y + h / 2 * slope(y))
    # At 1e-4 a step may pass from one period to the next without a look at the pulse between, where none is announced.
    for tolerance in (1e-4, 1e-5, 1e-8)[not announced :]:
        current, voltage, node = solve(tolerance)
        np.testing.assert_allclose([current, voltage], y, atol=(30 if announced else 50) * tolerance + 2e-6)
        assert -1.2 < node < -0.9


@pytest.mark.parametrize("solver", [dae_jax.DOP853(), diffrax.Tsit5()], ids=["dop853", "tsit5"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_force_that_becomes_infinite_ends_the_solve_at_its_time(solver, bad):
    """In few steps: an infinite error over an infinite state is no number, of which a next step was made, again and again."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.stack([0 * t, 9.81 + jnp.where(t > 1, args, 0)]), lambda t, q, args: (q @ q - 1) / 2
    )
    angle = dae_jax.StateSpace(lambda z: jnp.stack([jnp.sin(z[0]), jnp.cos(z[0])]))
    sol = dae_jax.daesolve(
        system, solver, 0.0, 2.0, None, (np.array([0.6, 0.8]), np.zeros(2)), bad, formulation=angle, throw=False,
        stepsize_controller=CONTROL, max_steps=10_000,
    )  # fmt: skip
    assert sol.stats["end_time"] == pytest.approx(1, abs=1e-12)
    assert sol.stats["num_steps"] < 200
