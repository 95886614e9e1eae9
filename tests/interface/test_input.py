"""Wrong input is refused in a sentence; failures have a code; what is not needed is not traced."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.scenes import double_pendulum, knife_edge, moving_pivot_pendulum, pendulum


SCENE = pendulum()


def solve(solver=diffrax.Tsit5(), y0=SCENE.y0, dt0=None, system=SCENE.system, t1=1.0, **options):  # noqa: B008
    return dae_jax.daesolve(system, solver, 0.0, t1, dt0, y0, **options)


@pytest.mark.parametrize(
    ("y0", "words"),
    [
        ((np.array([1.0, 0.0]), np.zeros(3)), "same shape"),
        ((np.array([1, 0]), np.zeros(2)), "floating-point"),
        ((np.array([1.0 + 0j, 0.0]), np.zeros(2)), "floating-point"),
        ((np.array([np.nan, 0.0]), np.zeros(2)), "must be finite"),
        (np.zeros(4), "pair"),
        ((np.array([2.0, 0.0]), np.zeros(2)), "position level.*off by 1.5"),
        ((np.array([1.0, 0.0]), np.array([0.5, 0.0])), "velocity level.*off by 0.5"),
    ],
)
def test_bad_initial_states(y0, words):
    with pytest.raises(ValueError, match=words):
        solve(y0=y0)


def test_an_inconsistent_start_names_the_remedy_and_the_remedy_works():
    bad = (np.array([2.0, 0.1]), np.array([0.5, 1.0]))
    with pytest.raises(ValueError, match="consistent_state"):
        solve(y0=bad)
    good = dae_jax.consistent_state(SCENE.system, 0.0, bad)
    np.testing.assert_allclose(good[0], bad[0] / np.linalg.norm(bad[0]), atol=1e-12)
    solve(y0=good)


def test_a_tiny_mechanism_that_is_off_by_a_hundredth_of_itself_is_refused():
    """Of a micrometre 1 % is less than what counts as round-off of a metre."""
    length = 1e-6
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, 9.81]), lambda t, q, args: (q @ q - length**2) / 2
    )
    q, v = np.array([0.6, 0.8]) * length, np.zeros(2)
    solve = lambda q: dae_jax.daesolve(system, dae_jax.RATTLE(), 0.0, 1e-5, 1e-6, (q, v))
    assert np.isfinite(solve(q).final[0]).all()
    with pytest.raises(ValueError, match=r"constraint\[0\] \(g\) is off by"):
        solve(q * 1.01)


def test_consistent_state_keeps_what_is_fixed_and_is_differentiable():
    fixed = (np.array([True, False]), np.array([False, False]))
    q, v = dae_jax.consistent_state(SCENE.system, 0.0, (np.array([0.6, 0.7]), np.array([1.0, 0.0])), fixed=fixed)
    np.testing.assert_allclose(q, [0.6, 0.8], atol=1e-12)
    assert abs(float(q @ v)) < 1e-12
    derivative = jax.grad(
        lambda a: dae_jax.consistent_state(SCENE.system, 0.0, (jnp.stack([a, 0.7]), jnp.zeros(2)))[0][0]
    )
    h = 1e-6
    value = lambda a: dae_jax.consistent_state(SCENE.system, 0.0, (jnp.stack([a, 0.7]), jnp.zeros(2)))[0][0]
    central = (value(0.6 + h) - value(0.6 - h)) / (2 * h)
    np.testing.assert_allclose(derivative(0.6), central, rtol=1e-6)


def test_no_consistent_state_names_the_equation():
    system = dae_jax.ConstrainedSystem(SCENE.system.force, lambda t, q, args: jnp.stack([q @ q - 1, q @ q - 4]))
    with pytest.raises(ValueError, match="contradict"):
        dae_jax.consistent_state(system, 0.0, (np.array([1.0, 0.0]), np.zeros(2)))


def test_an_inconsistent_traced_start_is_a_result_code():
    bad = (jnp.array([2.0, 0.0]), jnp.zeros(2))
    result = jax.jit(lambda y0: solve(y0=y0, throw=False).result)(bad)
    assert result == dae_jax.RESULTS.inconsistent_start


def test_under_vmap_the_healthy_elements_survive():
    angles = jnp.array([0.5, 1.0])
    lengths = jnp.array([1.0, 2.0])

    def run(angle, length):
        return solve(y0=(length * jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.zeros(2)), throw=False)

    sols = jax.vmap(run)(angles, lengths)
    assert np.asarray(sols.result == dae_jax.RESULTS.successful).tolist() == [True, False]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"dt0": -0.1}, "sign of t1"),
        ({"t1": float("inf")}, "finite"),
        ({"solver": "tsit5"}, "one of dae_jax or of diffrax"),
        ({"formulation": "baumgarte"}, "formulation"),
        ({"solver": dae_jax.RATTLE()}, "`dt0` must be given"),
        (
            {"solver": dae_jax.TangentSpace(diffrax.Tsit5()), "formulation": dae_jax.StateSpace(SCENE.chart)},
            "StateSpace",
        ),
        ({"formulation": dae_jax.StateSpace(lambda z: z)}, "must return 2 numbers"),
        ({"formulation": dae_jax.StateSpace(lambda z, w: z)}, "takes 2 arguments"),
        ({"system": "pendulum"}, "ConstrainedSystem"),
        ({"saveat": diffrax.SaveAt(ts=np.array([0.0, 2.0]))}, "between t0"),
        ({"saveat": diffrax.SaveAt(ts=np.array([0.5, 0.2]))}, "order"),
    ],
)
def test_bad_arguments(options, words):
    with pytest.raises((ValueError, TypeError), match=words):
        solve(**options)


def test_solvers_refuse_what_they_cannot_do():
    with pytest.raises(ValueError, match="explicit"):
        dae_jax.TangentSpace(diffrax.Kvaerno5())
    with pytest.raises(ValueError, match="symmetric method"):
        dae_jax.SymmetricProjection(diffrax.Tsit5())
    edge = knife_edge()
    with pytest.raises(ValueError, match="holonomic"):
        solve(dae_jax.RATTLE(), edge.y0, 0.1, edge.system)
    damped = dae_jax.ConstrainedSystem(lambda t, q, v, args: -v, SCENE.system.constraint)
    with pytest.raises(ValueError, match="depend on v"):
        solve(dae_jax.RATTLE(), dt0=0.1, system=damped)


def test_nan_in_error_out():
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.where(t > 0.5, jnp.nan, 1.0) * jnp.array([0.0, 9.81]), SCENE.system.constraint
    )
    with pytest.raises(RuntimeError, match="not finite"):
        solve(system=system, dt0=0.1)
    result = solve(system=system, throw=False).result
    assert result == dae_jax.RESULTS.step_rejected


def test_contradictory_dependent_constraints_are_refused():
    system = dae_jax.ConstrainedSystem(
        SCENE.system.force, lambda t, q, args: jnp.stack([q @ q - 1, q @ q - 1 - t**2]) / 2
    )
    with pytest.raises(ValueError, match="contradict"):
        solve(system=system)


def test_states_of_any_structure_and_fields_of_diffrax():
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: {"x": jnp.zeros(()), "y": jnp.array(9.81)},
        lambda t, q, args: q["x"] ** 2 + q["y"] ** 2 - 1,
    )
    y0 = ({"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0})
    saveat = diffrax.SaveAt(t0=True, ts=np.array([0.5]), t1=True, dense=True)
    sol = solve(dae_jax.TangentSpace(diffrax.Tsit5()), y0, system=system, saveat=saveat)
    exact = SCENE.reference(np.array([0.0, 0.5, 1.0]))[0]
    np.testing.assert_allclose(sol.ys[0]["x"], exact[:, 0], atol=1e-7)
    q, _ = sol.evaluate(0.3)
    np.testing.assert_allclose(q["x"], SCENE.reference(np.array([0.3]))[0][0, 0], atol=1e-7)
    assert abs(float(q["x"] ** 2 + q["y"] ** 2 - 1)) < 1e-13


def test_events_steps_and_functions_see_the_users_state():
    event = diffrax.Event(lambda t, y, args, **kwargs: y[0][0], _root_finder())
    sol = solve(dae_jax.OrthogonalProjection(dae_jax.DOP853()), t1=3.0, event=event, saveat=diffrax.SaveAt(t1=True))
    # A quarter of the period, by the complete elliptic integral.
    np.testing.assert_allclose(sol.ts[-1], 1.8540746773013719 / np.sqrt(9.81), atol=1e-7)
    saveat = diffrax.SaveAt(steps=True, fn=lambda t, y, args: jnp.sum(y[0] ** 2))
    sol = solve(dae_jax.OrthogonalProjection(diffrax.Tsit5()), saveat=saveat)
    np.testing.assert_allclose(sol.ys[np.isfinite(sol.ts)], 1.0, atol=1e-13)


def _root_finder():
    import optimistix

    return optimistix.Newton(1e-10, 1e-10)


def test_float32_works_to_its_own_tolerance():
    y0 = tuple(x.astype(np.float32) for x in SCENE.y0)
    sol = solve(dae_jax.OrthogonalProjection(diffrax.Tsit5()), y0)
    assert sol.ys[0].dtype == jnp.float32
    np.testing.assert_allclose(sol.ys[0], SCENE.reference(np.array([1.0]))[0], atol=1e-3)
    assert dae_jax.drift(SCENE.system, sol).position.max() < 1e-6


def primitives(fn, *args):
    names = []

    def walk(jaxpr):
        for eqn in jaxpr.eqns:
            names.append(eqn.primitive.name)
            for param in jax.tree.leaves(
                tuple(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
            ):
                if hasattr(param, "eqns") or hasattr(param, "jaxpr"):
                    walk(getattr(param, "jaxpr", param))

    walk(jax.make_jaxpr(fn)(*args).jaxpr)
    return names


def test_the_field_does_only_what_the_scene_needs():
    scene = double_pendulum()
    ode = MechanicalODE.of(scene.system, 0.0, scene.y0, None)
    y = ode.encode(jax.tree.map(jnp.asarray, scene.y0))
    names = primitives(lambda t, y: ode.field(t, y), 0.0, y)
    assert not {"cholesky", "lu", "triangular_solve", "custom_linear_solve", "dot_general", "while"} & set(names)
    unit = dae_jax.ConstrainedSystem(scene.system.force, scene.system.constraint, mass=jnp.ones(4))
    massive = MechanicalODE.of(unit, 0.0, scene.y0, None)
    assert len(names) < len(primitives(lambda t, y: massive.field(t, y), 0.0, y))
    assert ode.depends_on_time == (False, False)
    moving = moving_pivot_pendulum()
    assert MechanicalODE.of(moving.system, 0.0, moving.y0, None).depends_on_time == (True, False)


def test_a_solve_is_one_kernel_and_the_same_without():
    scene = double_pendulum()
    run = lambda: solve(dae_jax.OrthogonalProjection(dae_jax.DOP853()), scene.y0, system=scene.system).ys
    on = run()
    with dae_jax.configure(one_kernel=False):
        jax.clear_caches()
        off = run()
    jax.clear_caches()
    np.testing.assert_allclose(on[0], off[0], rtol=1e-9)


def test_one_trace_for_a_sweep():
    count = 0

    def force(t, q, v, args):
        nonlocal count
        count += 1
        return jnp.array([0.0, 9.81])

    system = dae_jax.ConstrainedSystem(force, SCENE.system.constraint)
    for alpha in (1.0, 2.0):
        solve(system=system, formulation=dae_jax.Baumgarte(alpha, 1.0))
        if alpha == 1.0:
            first = count
    assert count == first


def test_an_inconsistent_start_is_refused_in_words_also_inside_jit_and_after_a_good_one():
    scene = dae_jax.scenes.pendulum()
    solve = lambda y0: dae_jax.daesolve(scene.system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 0.1, None, y0)
    off = (1.1 * scene.y0[0], scene.y0[1])
    solve(scene.y0)
    with pytest.raises(ValueError, match=r"constraint\[0\] \(g\) is off by 0.105"):
        solve(off)
    assert jax.jit(lambda: solve(scene.y0).ys[0])().shape == (1, 2)
    with pytest.raises(ValueError, match=r"constraint\[0\] \(g\) is off by 0.105"):
        jax.jit(lambda: solve(off).ys[0])()


def test_a_force_in_float64_does_not_disturb_a_state_in_float32():
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, 9.81]), lambda t, q, args: (q @ q - 1.0) / 2, mass=np.ones(2)
    )
    y0 = (jnp.array([1, 0], jnp.float32), jnp.zeros(2, jnp.float32))
    sol = dae_jax.daesolve(system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.0, None, y0)
    assert sol.ys[0].dtype == jnp.float32
    exact = dae_jax.scenes.pendulum().reference(np.array([1.0]))
    np.testing.assert_allclose(sol.ys[0], exact[0], atol=1e-4)


def test_tolerances_take_the_precision_of_the_state():
    """Traced numbers of float64 beside a state of float32."""
    y0 = (jnp.array([1.0, 0.0], jnp.float32), jnp.zeros(2, jnp.float32))
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.zeros_like(q), lambda t, q, args: (q @ q - 1) / 2)

    def end(rtol):
        control = diffrax.PIDController(rtol=rtol, atol=np.float64(1e-5))
        return dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1.0, None, y0, stepsize_controller=control).ys[0]

    assert jax.jit(end)(jnp.float64(1e-5)).dtype == jnp.float32
