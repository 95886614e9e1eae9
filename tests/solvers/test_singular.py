"""Mechanisms whose constraints are redundant, degenerate or singular, whose masses are none: right, or refused in words."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import RESULTS, ConstrainedSystem
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.equations.regularity import is_near_constraints
from dae_jax.scenes import SCENES


GRAVITY = jnp.array([0.0, -9.81])
LEVEL = (jnp.array([1.0, 0.0]), jnp.zeros(2))
PROJECTED = dae_jax.OrthogonalProjection(diffrax.Tsit5())


def circle(q):
    return (q @ q - 1) / 2


def pendulum(constraint=lambda t, q, args: circle(q), **more):
    return ConstrainedSystem(lambda t, q, v, args: jnp.zeros_like(q).at[1].set(-9.81), constraint, **more)


def solve(system, solver=PROJECTED, y0=LEVEL, args=None, dt0=None, t1=1.0, **options):
    return dae_jax.daesolve(system, solver, 0.0, t1, dt0, y0, args, **options)


def traced(system, solver=PROJECTED, y0=LEVEL, batched=False, **options):
    """The result code of a solve whose start is traced."""
    run = lambda y0: solve(system, solver, y0, throw=False, **options).result._value
    if batched:
        return int(jax.vmap(run)(jax.tree.map(lambda x: jnp.stack([x, x]), y0))[1])
    return int(jax.jit(run)(y0))


def code(result):
    return int(result._value)


SQUARED = pendulum(lambda t, q, args: (q @ q - 1) ** 2)
STILL = (jnp.zeros(2), jnp.zeros(2))
VANISHING = ConstrainedSystem(lambda t, q, v, args: GRAVITY, nonholonomic=lambda t, q, v, args: q[0] * v[1])
SPACE = (jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3))
TWO = lambda t, q, args: jnp.stack([circle(q), q[2]])


class TestDegenerateStart:
    @pytest.mark.parametrize(
        ("system", "y0", "words"),
        [
            (SQUARED, LEVEL, r"rank 0 of 1 at the start: the gradient of constraint\[0\]"),
            (VANISHING, STILL, r"rank 0 of 1 at the start: the gradient of nonholonomic\[0\]"),
            (pendulum(TWO, rank=1), SPACE, "1 of the 2 constraints are independent, but .* rank 2 of 2"),
            (pendulum(rank=0), LEVEL, "0 of the 1 constraints are independent, but .* rank 1 of 1"),
            (
                pendulum(lambda t, q, args: jnp.stack([circle(q), (q[0] - 1) ** 2 + q[1] ** 2 - 4]) / 1.0),
                (jnp.array([-1.0, 0.0]), jnp.zeros(2)),
                "rank 1 of 2 at the start, and more beside it: a singular configuration",
            ),
        ],
        ids=["squared", "vanishing", "rank-too-small", "rank-0", "stretched"],
    )
    def test_is_refused(self, system, y0, words):
        with pytest.raises(ValueError, match=words):
            solve(system, diffrax.Euler(), y0, dt0=0.1)

    @pytest.mark.parametrize(("system", "batched"), [(SQUARED, True), (pendulum(rank=0), False)])
    def test_is_a_result_code(self, system, batched):
        assert traced(system, diffrax.Euler(), batched=batched, dt0=0.1) == code(RESULTS.dependent_constraints)


class TestRedundantConstraints:
    """What is redundant is found, and changes nothing; what contradicts itself later is not solved."""

    @pytest.mark.parametrize("name", ["mixed scales", "rolling"])
    def test_as_without(self, name):
        system, y0 = {
            # A multiple, and an independent constraint of a scale at which the dependent ones are round-off.
            "mixed scales": (
                pendulum(lambda t, q, args: jnp.stack([circle(q[:2]), 2 * circle(q[:2]), 1e-9 * q[2]])),
                SPACE,
            ),
            "rolling": (pendulum(nonholonomic=lambda t, q, v, args: q @ v), LEVEL),
        }[name]
        exact = SCENES["pendulum"]().reference(np.array([1.0]))[0][0] * [1, -1]
        sol = solve(system, dae_jax.OrthogonalProjection(diffrax.Bosh3()), y0, dt0=0.002)
        assert sol.rank == len(y0[0]) - 1
        np.testing.assert_allclose(sol.ys[0][0, :2], exact, atol=1e-6)
        assert dae_jax.drift(system, sol).position[0] < 1e-13

    def test_a_contradiction_that_comes_and_goes(self):
        system = pendulum(lambda t, q, args: jnp.stack([circle(q), circle(q) - (t * (1 - t)) ** 4]))
        ode = MechanicalODE.of(system, 0.0, LEVEL, None, rank=1)
        for t, agree in ((0.0, True), (0.01, False), (1.0, True)):
            assert bool(jnp.all(jnp.isfinite(ode.field(t, LEVEL)[1]))) == agree
            assert bool(ode.project(t, LEVEL)[1]) == agree

    def test_a_contradiction_at_the_end_of_a_method_that_drifts(self):
        system = pendulum(lambda t, q, args: jnp.stack([circle(q), circle(q) - t**3]))
        ode = MechanicalODE.of(system, 0.0, LEVEL, None, rank=1)
        near = lambda t, q: bool(
            is_near_constraints(ode, t, LEVEL, (q, LEVEL[1]), (False, False), ((1e-8, 1e-8),) * 2, False)[0]
        )
        assert near(0.0, LEVEL[0])
        assert near(0.0, 1.001 * LEVEL[0])
        assert not near(0.3, LEVEL[0])

    def test_a_rank_that_falls_on_the_way_is_no_number(self):
        system = pendulum(lambda t, q, args: jnp.stack([q[1], 2 * q[1], circle(q - jnp.array([2.0, 0.0]))]))
        ode = MechanicalODE.of(system, 0.0, LEVEL, None, rank=2)
        stretched = (jnp.array([2.0, 0.0]), jnp.zeros(2))
        assert jnp.isnan(ode.field(0.0, stretched)[1]).any()


class TestMasses:
    @pytest.mark.parametrize(
        ("mass", "words"),
        [
            ([[2.0, 1.0], [0.0, 2.0]], r"not symmetric: mass\[0, 1\] is 1, mass\[1, 0\] is 0"),
            ([[1.0, 2.0], [2.0, 1.0]], "smallest eigenvalue is -1"),
            ([[1.0, 1.0], [1.0, 1.0]], r"smallest eigenvalue is .*GGL\(\)"),
            ([1.0, -1.0], r"mass\[1\] is -1\.$"),
            ([1.0, 0.0], r"mass\[1\] is 0\. A massless coordinate .* GGL\(\)"),
        ],
    )
    def test_at_the_start(self, mass, words):
        with pytest.raises(ValueError, match=words):
            solve(pendulum(mass=jnp.array(mass)), diffrax.Euler(), dt0=0.1)

    def test_round_off_is_symmetric(self):
        solve(pendulum(mass=jnp.array([[2.0, 1.0 + 1e-15], [1.0, 2.0]])), diffrax.Euler(), dt0=0.01)

    @pytest.mark.parametrize(
        "mass",
        [
            lambda q, args: jnp.stack([1.0 + 0 * q[0], 1 + 1.5 * q[1]]),
            lambda q, args: jnp.array([[2.0, 0.0], [0.0, 2.0]]) + q[1] * jnp.array([[0.0, 1.0], [0.0, 0.0]]),
        ],
        ids=["negative", "asymmetric"],
    )
    def test_on_the_way(self, mass):
        assert traced(pendulum(mass=mass), diffrax.Tsit5()) == code(RESULTS.irregular_mass)

    def test_a_massless_coordinate_that_the_constraints_determine(self):
        system = pendulum(
            lambda t, q, args: jnp.stack([circle(q[:2]), q[2] - q[0] * q[1]]), mass=jnp.array([1.0, 1.0, 0.0])
        )
        sol = solve(system, dae_jax.RadauIIA5(), SPACE)
        x, y = SCENES["pendulum"]().reference(np.array([1.0]))[0][0] * [1, -1]
        np.testing.assert_allclose(sol.ys[0][0], [x, y, x * y], atol=1e-6)


class TestLeavesAllBounds:
    def test_negative_feedback_is_refused(self):
        with pytest.raises(ValueError, match="must not be negative"):
            dae_jax.Baumgarte(-100.0, 1.0)
        dae_jax.Baumgarte(0.0, 0.0)

    def test_negative_feedback_that_is_traced_is_no_success(self):
        result = jax.jit(
            lambda a: (
                solve(pendulum(), diffrax.Tsit5(), formulation=dae_jax.Baumgarte(a, 1.0), throw=False).result._value
            )
        )
        assert int(result(-100.0)) == code(RESULTS.undefined_formulation)
        assert int(result(5.0)) == code(RESULTS.successful)


class TestUnits:
    """A factor of the masses, of the constraint or of all lengths is none of the method's business."""

    @pytest.mark.parametrize(
        ("solver", "form"),
        [
            *((dae_jax.RadauIIA5(), form) for form in ("GGL", "index-2", "index-3")),
            *((dae_jax.BDF(), form) for form in ("GGL", "index-2")),
        ],
    )
    def test_make_no_difference(self, solver, form):
        system = ConstrainedSystem(
            lambda t, q, v, args: args[0] * args[2] * GRAVITY,
            lambda t, q, args: args[1] * circle(q / args[2]),
            mass=lambda q, args: args[0] * jnp.ones(2),
        )
        angle = jnp.array([np.sin(1.0), -np.cos(1.0)])
        ends, steps = [], []
        for scales in np.concatenate([np.zeros((1, 3)), np.diag([8, 8, 6]), -np.diag([8, 8, 6])]):
            mass, factor, length = map(jnp.asarray, 10.0**scales)
            sol = solve(
                system, solver, (length * angle, jnp.zeros(2)), (mass, factor, length), t1=3.0,
                formulation=dae_jax.Residual(form),
                stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9 * length),
            )  # fmt: skip
            ends.append(sol.ys[0][0] / length)
            steps.append(int(sol.stats["num_steps"]))
        np.testing.assert_allclose(ends, np.broadcast_to(ends[0], (7, 2)), atol=1e-9)
        assert max(steps) - min(steps) <= 2


def driven_linkage():
    """A rod on a crank that turns out of its reach at t = 0.686, and its state at 0."""
    pivot = jnp.array([2.0, 0.0])

    def constraint(t, q, args):
        crank, pin = q[:2], q[2:]
        turned = crank - 1.5 * jnp.stack([jnp.cos(t + 0.5), jnp.sin(t + 0.5)])
        return jnp.concatenate(
            [turned, jnp.stack([(pin - crank) @ (pin - crank) - 1, (pin - pivot) @ (pin - pivot) - 1])]
        )

    system = ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, -9.81, 0.0, -9.81]), constraint)
    guess = (jnp.array([1.316, 0.719, 2.3, 0.95]), jnp.zeros(4))
    return system, dae_jax.consistent_state(system, 0.0, guess)


def crank_of_equal_lengths():
    """A slider-crank whose crank and rod are as long, on its way to where the slider is above the pivot."""

    def constraint(t, q, args):
        return jnp.stack([circle(q[:2]), ((q[2] - q[0]) ** 2 + q[1] ** 2 - 1) / 2])

    system = ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, -9.81, 0.0]), constraint, potential=lambda q, args: 9.81 * q[1]
    )
    c, s = np.cos(0.5), np.sin(0.5)
    return system, (jnp.array([c, s, 2 * c]), jnp.array([-s, c, -2 * s]))


class TestSingularConfiguration:
    @pytest.mark.parametrize(
        ("solver", "formulation"),
        [
            (dae_jax.TangentSpace(dae_jax.DOP853()), None),
            (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
            (dae_jax.RadauIIA5(), None),
        ],
    )
    def test_beyond_its_reach_a_linkage_ends_soon_and_in_words(self, solver, formulation):
        system, y0 = driven_linkage()
        sol = solve(system, solver, y0, t1=3.0, formulation=formulation, max_steps=1000, throw=False)
        assert sol.result == RESULTS.singular_configuration
        # The crank's pin is as far from the pivot as both rods are long.
        np.testing.assert_allclose(1.5**2 + 2**2 - 6 * jnp.cos(sol.end[0] + 0.5), 4.0, atol=1e-6)

    def test_dummy_derivatives_do_not_leap_over_a_dead_centre_that_is_nearly_one(self):
        """The rod is longer than the crank by 1e-12: where the crank is level the slider stops short of the other side."""
        excess = 2e-12
        system = ConstrainedSystem(
            lambda t, q, v, args: 0 * q, lambda t, q, args: (q[1] ** 2 - 2 * q[1] * jnp.sin(q[0]) - excess) / 2
        )
        sine, cosine = np.sin(0.8), np.cos(0.8)
        root = np.sqrt(sine**2 + excess)
        y0 = jnp.array([0.8, sine + root]), -2.0 * jnp.array([1.0, cosine * (1 + sine / root)])
        sol = solve(system, dae_jax.DOP853(), y0, t1=0.6, formulation=dae_jax.DummyDerivatives())
        (angle,), (slider,) = sol.ys[0].T
        assert angle < -0.4
        # η/(√(sin² θ + η) − sin θ) in place of s = sin θ + √(sin² θ + η), which has no digits left here.
        np.testing.assert_allclose(slider, excess / (np.hypot(np.sin(angle), excess**0.5) - np.sin(angle)), atol=1e-12)

    @pytest.mark.parametrize("solver", [dae_jax.TangentSpace(diffrax.Dopri8()), dae_jax.RadauIIA5()], ids=str)
    def test_a_slider_crank_of_equal_lengths_passes_its_dead_centre(self, solver):
        system, y0 = crank_of_equal_lengths()
        # Rounding decides whether a step ends where there is no way on.
        with dae_jax.configure(optimise=True), pytest.warns(dae_jax.AccuracyWarning, match="dead centre"):
            sol = solve(system, solver, y0, t1=3.0, saveat=diffrax.SaveAt(t0=True, t1=True))
        energy = dae_jax.energy(system, sol)
        assert abs(energy[1] - energy[0]) < 1e-5
        np.testing.assert_allclose(sol.ys[0][1, 2], 2 * sol.ys[0][1, 0], atol=1e-6)

    def test_that_it_ends_at_its_dead_centre_is_said_also_where_the_steps_run_out(self):
        system, y0 = crank_of_equal_lengths()
        sol = solve(
            system, diffrax.Tsit5(), y0, t1=3.0, formulation=dae_jax.DummyDerivatives(), max_steps=500, throw=False
        )
        assert sol.result == RESULTS.singular_configuration
        np.testing.assert_allclose(sol.end[1][0][0], 0.0, atol=1e-4)
