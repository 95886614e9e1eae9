"""Derivatives about an equilibrium and a steady motion, where the solution itself allows any step."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import dae_jax as D
from dae_jax.scenes import SCENES
from dae_jax.studies import reductions


GRAVITY = 9.81
PENDULUM = D.ConstrainedSystem(lambda t, q, v, a: jnp.array([0.0, -a]), lambda t, q, a: (q @ q - 1) / 2)
SOLVERS = {
    "Dopri8": diffrax.Dopri8(),
    "projection": D.OrthogonalProjection(D.DOP853()),
    "tangent": D.TangentSpace(diffrax.Tsit5()),
    "RadauIIA5": D.RadauIIA5(),
    "RadauIIA9": D.RadauIIA9(),
    "selected states": D.DOP853(),
    "selected residuals": D.RadauIIA5(),
    "BDF": D.BDF(),
    "Radau": D.Radau(),
    "selected residuals, by BDF": D.BDF(),
}
# About what is left of the tolerance of 1e-8.
ALLOWED = dict.fromkeys(SOLVERS, 3e-5) | {"BDF": 1e-4}
# Of the end, 5 s after the start, by the speed of the start.
FREQUENCY = GRAVITY**0.5
EXACT = np.sin(5 * FREQUENCY) / FREQUENCY


def moved(v: Any, solver: str, gravity: float = GRAVITY, **options: Any) -> Any:
    """How far from the lowest point a pendulum that starts there is after 5 s."""
    form = D.DummyDerivatives() if solver.startswith("selected") else None
    start = jnp.array([0.0, -1.0]), jnp.stack([v, 0 * v])
    sol = D.daesolve(PENDULUM, SOLVERS[solver], 0.0, 5.0, None, start, gravity, formulation=form, **options)
    return sol.ys[0][-1, 0]


@pytest.mark.parametrize("solver", ["projection", "RadauIIA5", "selected states", "BDF"])
def test_in_forward_mode_only(solver: str) -> None:
    """The same steps, whichever adjoint is asked for; with several directions at once, too."""
    forward = lambda v: moved(v, solver, adjoint=diffrax.ForwardMode())
    assert abs(jax.jacfwd(forward)(0.0) - EXACT) < ALLOWED[solver] * abs(EXACT)
    both = jax.jacfwd(lambda x: moved(x[0], solver, GRAVITY + x[1], adjoint=diffrax.ForwardMode()))(jnp.zeros(2))
    np.testing.assert_allclose(both, [EXACT, 0], atol=ALLOWED[solver] * abs(EXACT))


def never(t: Any, y: Any, args: Any, **_: Any) -> Any:
    return y[0][0] - 5.0


@pytest.mark.parametrize("by", [jax.jacfwd, jax.grad], ids=["forwards", "reverse"])
@pytest.mark.parametrize(
    "event", [diffrax.Event(never), D.Reset(never, lambda t, y, a: (y, a))], ids=["event", "reset"]
)
@pytest.mark.parametrize("solver", ["projection", "RadauIIA5"])
def test_with_an_event(solver: str, event: Any, by: Any) -> None:
    assert abs(by(lambda v: moved(v, solver, event=event))(0.0) - EXACT) < ALLOWED[solver] * abs(EXACT)


def test_an_error_of_zero_has_a_derivative() -> None:
    """At rest both of DOP853's estimates are 0, and so is what they are divided by."""
    fixed = diffrax.ConstantStepSize()
    found = jax.grad(
        lambda v: D.daesolve(
            PENDULUM, SOLVERS["projection"], 0.0, 5.0, 0.01, (jnp.array([0.0, -1.0]), jnp.stack([v, 0 * v])), GRAVITY,
            stepsize_controller=fixed, event=diffrax.Event(never),
        ).final[0][0]
    )(0.0)  # fmt: skip
    assert abs(found - EXACT) < 1e-9 * abs(EXACT)


@pytest.mark.parametrize("by", [jax.jacfwd, jax.grad], ids=["forwards", "reverse"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_about_an_equilibrium(solver: str, by: Any) -> None:
    assert abs(by(lambda v: moved(v, solver))(0.0) - EXACT) < ALLOWED[solver] * abs(EXACT)


@pytest.mark.parametrize("solver", ["RadauIIA5", "BDF"])
def test_with_a_coordinate_without_mass(solver: str) -> None:
    """No inverse of the mass matrix says how a change is to stay consistent."""
    system = D.ConstrainedSystem(
        lambda t, q, v, a: jnp.array([0.0, -GRAVITY, 0.0]),
        lambda t, q, a: jnp.stack([(q[:2] @ q[:2] - 1) / 2, q[2] - q[0]]),
        np.array([1.0, 1.0, 0.0]),
    )

    def end(v: Any) -> Any:
        start = jnp.array([0.0, -1.0, 0.0]), jnp.stack([v, 0 * v, v])
        return D.daesolve(system, SOLVERS[solver], 0.0, 5.0, None, start, formulation=D.GGL()).ys[0][-1, 0]

    assert abs(jax.jacfwd(end)(0.0) - EXACT) < ALLOWED[solver] * abs(EXACT)


@pytest.mark.parametrize("by", [jax.jacfwd, jax.grad], ids=["forwards", "reverse"])
@pytest.mark.parametrize("rate", [50.0, 1e5])
@pytest.mark.parametrize("solver", ["RadauIIA5", "BDF", "Radau"])
def test_by_a_parameter_where_changes_of_the_start_die_down(solver: str, rate: float, by: Any) -> None:
    """At rest, and pushed by p sin 10 t for p = 0: the solution and a change of its start allow any step."""
    frequency, end = 10.0, 10.0
    system = D.SemiExplicitDAE(
        lambda t, x, z, p: jnp.stack([p * rate * jnp.sin(frequency * t) - z[0], x[0]]),
        lambda t, x, z, p: z - rate * x[:1],
    )
    found = by(
        lambda p: D.daesolve(system, SOLVERS[solver], 0.0, end, None, (jnp.zeros(2), jnp.zeros(1)), p).ys[0][-1, 1]
    )
    turned = frequency * end
    exact = rate * (1 - np.cos(turned)) / frequency - np.sin(turned) - frequency * np.expm1(-rate * end) / rate
    exact *= rate / (rate**2 + frequency**2)
    assert abs(found(0.0) / exact - 1) < 3e-4


@pytest.mark.parametrize("solver", ["RadauIIA5", "BDF"])
def test_small_variables_have_an_absolute_tolerance_of_their_own(solver: str) -> None:
    """Robertson's to 1e11: with an absolute tolerance of 1e-14 a derivative takes no more steps than it may."""
    scene, end = SCENES["robertson"](), 1e11
    tolerances = diffrax.PIDController(rtol=1e-8, atol=1e-14)

    def states(start: Any) -> Any:
        y0 = jnp.stack([start, 0 * start]), 1 - jnp.stack([start])
        return D.daesolve(scene.system, SOLVERS[solver], 0.0, end, None, y0, stepsize_controller=tolerances).final[0]

    found = jax.jvp(states, (jnp.ones(()),), (jnp.ones(()),))[1]
    assert np.allclose(found, _robertson_by_start(end), rtol=1e-4, atol=0)


def _robertson_by_start(end: float) -> Any:
    """The derivative of (y₁, y₂) by y₁(0) along which the sum of all is 1, by scipy's Radau of the linearised ODE beside it."""
    slope = lambda y: np.array(
        [
            [-0.04 - 1e4 * y[1], 1e4 * (1 - y[0] - 2 * y[1])],
            [0.04 + 1e4 * y[1], -1e4 * (1 - y[0] - 2 * y[1]) - 6e7 * y[1]],
        ]
    )

    def field(_: float, both: Any) -> Any:
        y, change = both[:2], both[2:]
        z = 1 - y[0] - y[1]
        slow, fast = 0.04 * y[0] - 1e4 * y[1] * z, 3e7 * y[1] ** 2
        return np.concatenate([[-slow, slow - fast], slope(y) @ change])

    solved = scipy.integrate.solve_ivp(field, (0, end), [1, 0, 1, 0], "Radau", rtol=1e-9, atol=1e-30)
    return solved.y[2:, -1]


@pytest.mark.filterwarnings("ignore:Complex dtype support")
def test_parameters_of_any_kind() -> None:
    """What can change is of several types of numbers, and what cannot is beside it."""
    given = {
        "c": jnp.array(1.0 + 1.0j),
        "single": jnp.float32(1.0),
        "count": 3,
        "which": jnp.arange(3),
        "name": "decay",
    }
    system = D.SemiExplicitDAE(
        lambda t, x, z, a: -z * a["rate"],
        lambda t, x, z, a: z - x * jnp.real(a["c"] * jnp.conj(a["c"])) * a["single"].astype(float),
    )

    def end(rate: Any) -> Any:
        start = jnp.ones(1), 2 * jnp.ones(1)
        return D.daesolve(system, D.RadauIIA5(), 0.0, 1.0, None, start, {"rate": rate, **given}).ys[0][-1, 0]

    np.testing.assert_allclose([jax.grad(end)(1.0), jax.jacfwd(end)(1.0)], -2 * np.exp(-2), rtol=1e-6)


def test_looser_tolerances_give_as_much() -> None:
    steps = diffrax.PIDController(1e-5, 1e-5)
    found = jax.grad(lambda v: moved(v, "projection", stepsize_controller=steps))(0.0)
    assert abs(found - EXACT) < 1e-2 * abs(EXACT)


@pytest.mark.parametrize("by", [jax.jacfwd, jax.grad], ids=["forwards", "reverse"])
def test_about_a_steady_motion(by: Any) -> None:
    """Two bodies around each other, ẍ = −x / |x|³: δẍ along the orbit, against one by steps of a hundredth of a turn."""
    system = D.ImplicitDAE(lambda t, y, yd, a: [*(yd[:2] - y[2:]), *(yd[2:] + y[:2] / (y[:2] @ y[:2]) ** 1.5)])
    start = jnp.array([1.0, 0.0, 0.0, 1.0])

    def end(v: Any, **options: Any) -> Any:
        return D.daesolve(system, D.DOP853(), 0.0, 6.0, None, start.at[3].add(v), **options).ys[-1, 0]

    steps = diffrax.PIDController(1e-12, 1e-12, dtmax=0.06)
    assert abs(by(end)(0.0) - by(lambda v: end(v, stepsize_controller=steps, max_steps=10_000))(0.0)) < 1e-5


@pytest.mark.parametrize(("solver", "off"), [("projection", 1e-12), ("BDF", 1e-9)])
def test_a_batch_of_them_is_one_at_a_time(solver: str, off: float) -> None:
    speeds = jnp.array([0.0, 0.5, 2.0])
    found = jax.vmap(jax.grad(lambda v: moved(v, solver)))(speeds)
    one = np.array([jax.grad(lambda v: moved(v, solver))(v) for v in speeds])
    assert np.abs(found - one).max() < off


def test_a_state_that_does_not_depend_on_it() -> None:
    """No derivative is no reason for smaller steps, nor a division by 0."""
    assert jax.jacfwd(lambda g: moved(jnp.zeros(()), "projection", g))(GRAVITY) == 0


@pytest.mark.parametrize("solver", [D.OrthogonalProjection(diffrax.Tsit5()), D.BDF()], ids=["projection", "BDF"])
def test_a_lyapunov_exponent_at_the_highest_point(solver: Any) -> None:
    """sinh and cosh: (log cosh ωt) / t along δy = (δx, ω δx), which grows as e^ωt."""
    start = jnp.array([0.0, 1.0]), jnp.zeros(2)
    along = jnp.array([1.0, 0.0]), jnp.array([FREQUENCY, 0.0])
    found = reductions.lyapunov(PENDULUM, solver, 0.0, 3.0, start, GRAVITY, direction=along)
    assert abs(found - FREQUENCY) < 1e-5


@pytest.mark.parametrize("by", [jax.jacfwd, jax.grad], ids=["forwards", "reverse"])
@pytest.mark.parametrize("solver", ["projection", "BDF"])
def test_too_few_steps_for_a_derivative(solver: str, by: Any) -> None:
    """As many as the solution needs do not lead a derivative to the end: what it was on the way is not handed out."""
    of = lambda v, throw: moved(v, solver, max_steps=20, throw=throw)
    assert of(jnp.zeros(()), True) == 0
    assert jnp.isnan(by(lambda v: of(v, False))(0.0))
    with pytest.raises(
        jax.errors.JaxRuntimeError, match=r"SolveFailed: The derivative .* Raise `max_steps`, which is 20."
    ):
        jax.block_until_ready(by(lambda v: of(v, True))(0.0))


@pytest.mark.parametrize("solver", ["Dopri8", "RadauIIA5", "BDF"])
def test_a_parameter_of_0_hides_no_other(solver: str) -> None:
    """x' = k (p₀ sin ωt + p₁ unit − x) about x = 0, p = 0: what p₁ leads to may be anything, beside what p₀ leads to."""
    k, w, t = 50.0, 10.0, 2.0
    system = D.SemiExplicitDAE(
        lambda t, x, z, args: k * (args[0][0] * jnp.sin(w * t) + args[0][1] * args[1] - x), lambda t, x, z, _: z - x
    )
    start = jnp.zeros(1), jnp.zeros(1)
    end = lambda p, unit: D.daesolve(system, SOLVERS[solver], 0.0, t, None, start, (p, unit)).ys[0][-1, 0]
    exact = k * (k * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-k * t)) / (k**2 + w**2)
    slopes = jax.jit(jax.jacfwd(end))
    for unit in (1e6, 1e12, 1e-12):
        np.testing.assert_allclose(slopes(jnp.zeros(2), unit), [exact, unit], rtol=1e-7)


def test_a_state_that_is_refused_is_not_asked_for() -> None:
    """The units of parameters are looked for beside the way, too: within the circle that a pendulum is on."""

    def force(t: Any, q: Any, v: Any, args: Any) -> Any:
        q = eqx.error_if(q, q @ q < 0.5, "within the circle")
        return jnp.array([args[1], -args[0]]) * (q @ q)

    system = D.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2)
    start = jnp.array([1.0, 0.0]), jnp.zeros(2)
    end = lambda args: D.daesolve(system, SOLVERS["projection"], 0.0, 1.2, None, start, args).ys[0][-1, 0]
    slopes, h = jax.grad(end)(jnp.array([9.81, 0.0])), 1e-4
    differences = [
        (end(jnp.array([9.81, 0.0]) + d) - end(jnp.array([9.81, 0.0]) - d)) / (2 * h) for d in h * jnp.eye(2)
    ]
    np.testing.assert_allclose(slopes, differences, rtol=1e-5)
