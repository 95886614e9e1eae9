"""What a solution does with hidden constraints, multipliers at a point, and how a failure gets out of a compiled program."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax
from dae_jax import reductions
from dae_jax.scenes import pendulum


GRAVITY = 9.81
PROJECTED = dae_jax.OrthogonalProjection(dae_jax.DOP853())
CIRCLE = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, -GRAVITY]), lambda t, q, args: (q @ q - 1) / 2)


def started_at(angle):
    """At rest on a circle of radius 1, at an angle from its top."""
    return jnp.array([np.sin(angle), np.cos(angle)]), jnp.zeros(2)


class TestDriftOfEquations:
    """Index 3: q̇ = v, v̇ = f − λ q, 0 = (q·q − 1)/2; the hidden constraints are q·v and v·v + q·(f − λ q)."""

    system = dae_jax.ImplicitDAE(
        lambda t, y, yd, args: [
            yd["q"] - y["v"],
            yd["v"] + y["l"] * y["q"] - jnp.array([0.0, -GRAVITY]),
            (y["q"] @ y["q"] - 1) / 2,
        ]
    )

    def test_of_a_solution_is_round_off(self):
        y0 = {"q": jnp.array([1.0, 0.0]), "v": jnp.zeros(2), "l": jnp.zeros(())}
        sol = dae_jax.daesolve(self.system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 0.5, None, y0)
        found = dae_jax.drift(self.system, sol)
        assert isinstance(found, dae_jax.EquationDrift)
        assert [level.shape for level in found.levels] == [(1,)] * 3
        assert reductions.largest_drift(self.system, sol) < 1e-13

    def test_each_level_is_its_violation(self):
        q = jnp.array([[1.0, 0.0], [0.6, 0.9], [0.6, 0.8]])
        v = jnp.array([[0.0, 0.0], [0.9, -0.6], [0.1, 0.2]])
        rod = jnp.array([0.0, 1.3, 2.0])
        found = dae_jax.drift(self.system, solution(jnp.arange(3.0), {"q": q, "v": v, "l": rod}))
        acceleration = jnp.array([0.0, -GRAVITY]) - rod[:, None] * q
        dot = lambda a, b: jnp.sum(a * b, 1)
        exact = (dot(q, q) - 1) / 2, dot(q, v), dot(v, v) + dot(q, acceleration)
        for level, violation in zip(found.levels, exact, strict=True):
            np.testing.assert_allclose(level, jnp.abs(violation), atol=1e-13)

    def test_algebraic_equations_of_index_1(self):
        system = dae_jax.SemiExplicitDAE(lambda t, x, z, k: -k * z, lambda t, x, z, k: z - x**2)
        x, z = jnp.array([[1.0], [2.0]]), jnp.array([[1.0], [4.5]])
        (level,) = dae_jax.drift(system, solution(jnp.arange(2.0), (x, z), jnp.array(3.0))).levels
        np.testing.assert_allclose(level, [0.0, 0.5], atol=1e-14)

    def test_a_freedom_of_the_derivatives_is_no_violation(self):
        """ẏ₁ + ẏ₂ = 1 leaves ẏ₁ − ẏ₂ open, which dF/dt = 0 then gives: there is no hidden constraint on y."""
        system = dae_jax.ImplicitDAE(lambda t, y, yd, a: [yd[0] + yd[1] - 1, y[0] - y[1] * y[2], y[2] - 2 - jnp.sin(t)])
        y = jnp.array([[2.0, 1.0, 2.0]])
        for level in dae_jax.drift(system, solution(jnp.zeros(1), y)).levels:
            np.testing.assert_allclose(level, 0, atol=1e-13)

    def test_index_2_with_a_nonlinear_derivative(self):
        """(1 + ẏ₁²) ẏ₁ = y₂ + 2 and y₁ = t: hidden is ẏ₁ = 1, so y₂ = 0."""
        system = dae_jax.ImplicitDAE(lambda t, y, yd, a: [(1 + yd[0] ** 2) * yd[0] - y[1] - 2, y[0] - t])
        times = jnp.array([0.5, 0.5])
        found = dae_jax.drift(system, solution(times, jnp.array([[0.5, 0.0], [0.5, 8.0]])))
        np.testing.assert_allclose(found.levels[0], 0, atol=1e-12)
        np.testing.assert_allclose(found.levels[1], [0.0, 1.0], atol=1e-9)  # with y₂ = 8, ẏ₁ = 2


def solution(ts, ys, args=None):
    """What `daesolve` might have returned."""
    return dae_jax.DAESolution(ts[0], ts[-1], ts, ys, None, {}, dae_jax.RESULTS.successful, None, args)


class TestMultipliersAtAPoint:
    def test_is_that_of_the_solution(self):
        scene = pendulum()
        sol = dae_jax.daesolve(scene.system, PROJECTED, 0.0, 1.0, None, scene.y0, scene.args)
        q, v = sol.final
        at_point = jax.jit(lambda q, v: dae_jax.multipliers(scene.system, 1.0, q, v, scene.args))(q, v)
        np.testing.assert_allclose(at_point, dae_jax.multipliers(scene.system, sol)[-1], rtol=1e-12)
        np.testing.assert_allclose(at_point, v @ v + q @ jnp.array([0.0, GRAVITY]), rtol=1e-6)

    @pytest.mark.parametrize("solver", [PROJECTED, dae_jax.RadauIIA5()], ids=["projection", "radau"])
    def test_a_mass_leaves_the_circle(self, solver):
        """λ = v² − g cos φ = g (2 cos φ₀ − 3 cos φ) for a mass that slides from rest at φ₀: it lets go at 2/3 of the height."""
        start = started_at(0.3)
        lets_go = lambda t, y, args, **_: dae_jax.multipliers(CIRCLE, t, *y, args)[0]
        event = diffrax.Event(lets_go, optimistix.Newton(1e-12, 1e-12))
        sol = dae_jax.daesolve(CIRCLE, solver, 0.0, 5.0, None, start, event=event)
        assert sol.result == dae_jax.RESULTS.event_occurred
        (_, y), v = sol.final
        np.testing.assert_allclose(y, 2 / 3 * np.cos(0.3), atol=1e-7)
        np.testing.assert_allclose(v @ v, GRAVITY * y, atol=1e-6)

    def test_a_jump_where_the_force_of_the_rod_changes_its_sign(self):
        """A rod turns from pushing to pulling where λ goes up through zero; the count of it is in args."""
        rises = dae_jax.Reset(
            lambda t, y, count, **_: dae_jax.multipliers(CIRCLE, t, *y, count)[0],
            lambda t, y, count: (y, count + 1),
            direction=True,
        )
        # From 0.3 to the first passage through the lowest point and on to about the same height.
        sol = dae_jax.daesolve(CIRCLE, PROJECTED, 0.0, 1.5, None, started_at(0.3), jnp.zeros(()), event=rises)
        assert sol.stats["jumps"] == 1
        when = float(sol.stats["jump_times"][0])
        at = dae_jax.daesolve(CIRCLE, PROJECTED, 0.0, when, None, started_at(0.3)).final[0]
        np.testing.assert_allclose(at[1], 2 / 3 * np.cos(0.3), atol=1e-7)


class TestFailures:
    """The sentence of a failed solve: which time, how many steps, the same in a compiled program."""

    start = pendulum().y0
    ENDED = r"maximum number of solver steps .* The solve from t = 0 to 1 ended at t = 0\.\d+ after 7 steps\."

    def solve(self, y0, system=CIRCLE, **options):
        return dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1.0, None, y0, **options)

    @pytest.mark.parametrize("saveat", [diffrax.SaveAt(ts=[0.9]), diffrax.SaveAt(dense=True)])
    def test_time_and_steps(self, saveat):
        with pytest.raises(RuntimeError, match=self.ENDED):
            self.solve(self.start, saveat=saveat, max_steps=7)

    def test_time_and_steps_under_jit(self, caplog):
        with pytest.raises(jax.errors.JaxRuntimeError, match=f"SolveFailed: .*{self.ENDED}\n"):
            jax.jit(lambda y0: self.solve(y0, max_steps=7).ys)(self.start)
        assert "failed" not in caplog.text

    def test_a_success_under_jit_has_a_derivative(self):
        end = lambda a: self.solve((jnp.stack([jnp.sin(a), jnp.cos(a)]), jnp.zeros(2))).ys[0][-1, 0]
        h = 1e-5
        slope = (end(1 + h) - end(1 - h)) / (2 * h)
        np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), slope, rtol=1e-5)

    def test_under_vmap_the_first_that_failed_is_named(self):
        starts = jax.tree.map(lambda x: jnp.stack([x, x, x]), self.start)
        starts = (starts[0] * jnp.array([[1.0], [1.1], [1.2]]), starts[1])
        with pytest.raises(
            jax.errors.JaxRuntimeError, match="2 of a batch of 3 solves failed, the first of them number 1: The initial"
        ):
            jax.jit(jax.vmap(lambda y0: self.solve(y0).ys))(starts)

    def test_a_bad_start_in_a_sweep(self):
        with pytest.raises(RuntimeError, match=r"^The initial state `y0` violates") as caught:
            dae_jax.sweep(
                lambda a: self.solve((a * self.start[0], self.start[1])).ys, np.array([1.0, 1.1]), progress=False
            )
        assert "Traceback" not in str(caught.value)

    def test_redundant_constraints_under_jit_name_the_rank(self):
        twice = dae_jax.ConstrainedSystem(CIRCLE.force, lambda t, q, args: jnp.stack([q @ q - 1, 2 * (q @ q - 1)]))
        run = jax.jit(lambda y0: self.solve(y0, twice, throw=False))
        assert run(self.start).result == dae_jax.RESULTS.dependent_constraints
        with pytest.raises(jax.errors.JaxRuntimeError, match="rank="):
            jax.jit(lambda y0: self.solve(y0, twice).ys)(self.start)
        said = dataclasses.replace(twice, rank=1)
        end = jax.jit(lambda y0: self.solve(y0, said).final)(self.start)
        np.testing.assert_allclose(end[0], self.solve(self.start).final[0], atol=1e-7)

    def test_float32_is_named(self):
        y0 = tuple(x.astype(np.float32) for x in self.start)
        with pytest.raises(RuntimeError, match=r"It ran in float32, .*jax_enable_x64"):
            self.solve(y0, max_steps=3)


def test_precision_is_said_once():
    scene = pendulum()
    y0 = tuple(x.astype(np.float32) for x in scene.y0)
    sol = dae_jax.daesolve(scene.system, PROJECTED, 0.0, 0.1, None, y0, scene.args)
    assert sol.precision == "float32, rtol 1e-05, atol 1e-05"
    assert "float32, rtol 1e-05" in repr(sol)
    assert "RESULTS<successful>" in repr(sol)
    assert "float32, rtol 1e-05, atol 1e-05" in str(dae_jax.explain(scene.system, PROJECTED, 0.0, y0, scene.args))
    fixed = dae_jax.daesolve(scene.system, PROJECTED, 0.0, 0.1, 0.05, scene.y0, scene.args)
    assert fixed.precision == "float64, fixed steps"


def test_counts_agree_with_their_nouns():
    scene = pendulum()
    structure = str(dae_jax.analyse(scene.system, 0.0, scene.y0, scene.args))
    assert "1 degree of freedom of the mechanism (2 initial values to choose)" in structure
    assert "2 coordinates, 1 constraint\n" in str(dae_jax.explain(scene.system, PROJECTED, 0.0, scene.y0, scene.args))
    rolling = dae_jax.scenes.knife_edge()
    found = dae_jax.analyse(rolling.system, 0.0, rolling.y0, rolling.args)
    assert (found.degrees_of_freedom, found.mechanical_degrees_of_freedom) == (5, 2)


def test_modules_and_version_are_there_when_they_are_used():
    program = (
        "import sys, dae_jax; assert not {'dae_jax.scenes', 'dae_jax.app.plotting', 'dae_jax.studies.reductions'} & set(sys.modules); "
        "dae_jax.scenes.pendulum; dae_jax.plotting.drift; dae_jax.reductions.final_state; print(dae_jax.__version__); "
        "assert {'scenes', '__version__'} <= set(dir(dae_jax))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout[0].isdigit()
    with pytest.raises(AttributeError, match="no attribute 'scene'"):
        _ = dae_jax.scene


class TestMassesAndRanks:
    """What a solve refuses is refused at a point too."""

    FALL = staticmethod(lambda t, q, v, args: jnp.array([0.0, -9.81]))
    CIRCLE = staticmethod(lambda t, q, args: (q @ q - 1) / 2)
    LEVEL = (jnp.array([1.0, 0.0]), jnp.zeros(2))

    @pytest.mark.parametrize(
        ("mass", "words"),
        [
            (jnp.array([[2.0, 0.5], [0.0, 1.0]]), r"not symmetric: mass\[0, 1\] is 0.5"),
            (lambda q, args: jnp.array([[2.0, 0.5], [0.0, 1.0]]), "not symmetric"),
            (jnp.array([[1.0, 2.0], [2.0, 1.0]]), "smallest eigenvalue is -1"),
            (-jnp.ones(2), r"mass\[0\] is -1"),
        ],
    )
    def test_masses(self, mass, words):
        system = dae_jax.ConstrainedSystem(self.FALL, self.CIRCLE, mass)
        with pytest.raises(ValueError, match=f"at this point, but.*{words}"):
            dae_jax.multipliers(system, 0.0, *self.LEVEL)
        with pytest.raises(ValueError, match=f"at `y0`, but.*{words}"):
            dae_jax.consistent_state(system, 0.0, (jnp.array([1.1, 0.2]), jnp.zeros(2)))

    @pytest.mark.parametrize("rank", [0, 1])
    def test_a_rank_that_is_too_small(self, rank):
        both = lambda t, q, args: jnp.stack([(q[:2] @ q[:2] - 1) / 2, q[2] - q[0] ** 2])
        system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, -9.81, 0.0]), both, rank=rank)
        with pytest.raises(ValueError, match="have rank 2 of 2 at this point"):
            dae_jax.multipliers(system, 0.0, jnp.array([1.0, 0.0, 1.0]), jnp.zeros(3))

    def test_a_massless_coordinate(self):
        """It hangs on the constraint q₂ = q₀q₁, whose force is therefore none; that of the rod is the pendulum's."""
        both = lambda t, q, args: jnp.stack([(q[:2] @ q[:2] - 1) / 2, q[2] - q[0] * q[1]])
        system = dae_jax.ConstrainedSystem(
            lambda t, q, v, args: jnp.array([0.0, -9.81, 0.0]), both, jnp.array([1.0, 1.0, 0.0])
        )
        sol = dae_jax.daesolve(system, dae_jax.RadauIIA5(), 0.0, 1.0, None, (jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3)))
        # λ = |v|² + g·q of a pendulum that starts level: three times the weight's part along the rod.
        height = float(sol.final[0][1])
        for found in (
            dae_jax.multipliers(system, sol)[-1],
            dae_jax.multipliers(system, 1.0, *sol.final),
        ):
            np.testing.assert_allclose(found, [-3 * 9.81 * height, 0.0], atol=1e-6)

    def test_a_mass_that_is_negative_on_the_way(self):
        swinging = dae_jax.ConstrainedSystem(
            self.FALL, self.CIRCLE, lambda q, args: jnp.diag(jnp.stack([1 + 0 * q[0], 1 + 1.5 * q[1]]))
        )
        with pytest.warns(dae_jax.AccuracyWarning, match="a mass is negative"):
            dae_jax.daesolve(swinging, dae_jax.RadauIIA5(), 0.0, 1.0, None, self.LEVEL)


class TestAdvice:
    """What is said beside an error is about that error."""

    def test_vectors_are_no_time_axis(self):
        system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -x, lambda t, x, z, args: z - x)
        with pytest.raises(ValueError, match="is off by") as refused:
            dae_jax.daesolve(system, dae_jax.BDF(), 0.0, 1.0, None, (jnp.ones(4), jnp.zeros(4)))
        assert "axis" not in str(refused.value)

    def test_a_function_that_needs_an_array_of_jax(self):
        """numpy's have no `at`; the singular equations are named all the same."""
        twice = lambda t, x, z, args: (z - x).at[0].set(z[0] + z[1] - 2 * x[0]).at[1].set(2 * (z[0] + z[1] - 2 * x[0]))
        system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: -x + z, twice)
        with pytest.raises(RuntimeError, match="singular"):
            dae_jax.daesolve(system, dae_jax.BDF(), 0.0, 1.0, None, (np.ones(3), np.ones(3)))


def test_multipliers_at_a_point_of_redundant_constraints_need_the_rank():
    doubled = lambda rank: dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, 9.81]),
        lambda t, q, args: jnp.stack([(q @ q - 1) / 2, q @ q - 1]),
        rank=rank,
    )
    at = 0.0, jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0])
    with pytest.raises(ValueError, match="say how many are independent"):
        dae_jax.multipliers(doubled(None), *at)
    # The force on q, λ₁ q + 2 λ₂ q, is the centripetal one, 4; of least norm are multiples of (1, 2), however long a gradient is.
    np.testing.assert_allclose(dae_jax.multipliers(doubled(1), *at), [0.8, 1.6], atol=1e-12)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_drift_of_a_dae_has_its_derivative(mode):
    """Off g = (|q|² − ℓ²)/2 and the hidden q·v, by ℓ and by v; singular values of the equations for ẏ are equal."""

    def residual(t, y, yd, length):
        q, v, tension = y[:2], y[2:4], y[4]
        return jnp.concatenate([yd[:2] - v, yd[2:4] + tension * q, (q @ q - length**2)[None] / 2])

    def found(x):
        y = jnp.stack([0.6, 0.8, x[1], 0.3, 0.5])[None]
        zero = jnp.zeros(())
        sol = dae_jax.DAESolution(zero, zero + 1, zero[None], y, None, {}, dae_jax.RESULTS.successful, None, x[0], None)
        return jnp.concatenate(dae_jax.drift(dae_jax.ImplicitDAE(residual), sol).levels[:2])

    x = jnp.array([0.9, 0.2])
    np.testing.assert_allclose(found(x), [(1 - 0.81) / 2, 0.36], rtol=1e-12)
    np.testing.assert_allclose(mode(found)(x), [[-0.9, 0.0], [0.0, 0.6]], atol=1e-12)
