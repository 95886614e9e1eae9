"""`tune` and the loss for Baumgarte's parameters."""

import operator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import dae_jax
from dae_jax import plotting
from dae_jax.scenes import SCENES


BAD_START = {"alpha": 1.0, "beta": 1.0}


@pytest.fixture(scope="module", params=[("pendulum", 0.05), ("double-pendulum", 0.02)], ids=lambda p: p[0])
def case(request):
    name, h = request.param
    scene = SCENES[name]()
    # The scene's reference is independent of the library.
    loss = dae_jax.baumgarte_loss(scene.system, scene.y0, 5.0, dt0=h, reference=scene.reference)
    return loss, jax.jit(loss)


@pytest.fixture(scope="module")
def tuned(case):
    return dae_jax.tune(case[0], BAD_START, steps=60, progress=False)


def grid(loss, side):
    """The loss on a square grid, α and β from 0.1 to 1e4; infinite where it is not finite."""
    axis = jnp.logspace(-1, 4, side)
    alpha, beta = map(jnp.ravel, jnp.meshgrid(axis, axis, indexing="ij"))
    return np.asarray(jax.jit(lambda p: jax.lax.map(loss, p))({"alpha": alpha, "beta": beta}))


def test_bowl():
    """A minimum that is known, from one start and from many, with the cost counted."""
    target = jnp.array([20.0, 0.05])
    loss = lambda p: jnp.sum(jnp.log(p["x"] / target) ** 2) + jnp.log(p["y"] / 3.0) ** 2
    start = {"x": jnp.ones(2), "y": 1.0}
    tuned = dae_jax.tune(loss, start, steps=80, tolerance=1e-6, progress=False)
    np.testing.assert_allclose(tuned.params["x"], target, rtol=2e-2)
    np.testing.assert_allclose(tuned.params["y"], 3.0, rtol=2e-2)
    assert tuned.evaluations == tuned.history.loss.size * 4
    many = dae_jax.tune(loss, start, steps=80, starts=5, progress=False)
    assert many.history.params["x"].shape == (5, many.history.loss.shape[1], 2)
    assert float(many.loss) == np.min(many.history.best[:, -1]) == np.min(many.history.loss)
    np.testing.assert_array_equal(many.history.params["x"][0, 0], [1.0, 1.0])


def test_the_first_of_many_starts_is_the_only_one_of_one():
    loss = lambda p: jnp.log(p / 7.0) ** 2
    one = dae_jax.tune(loss, 1.0, steps=10, progress=False)
    many = dae_jax.tune(loss, 1.0, steps=10, starts=3, progress=False)
    np.testing.assert_allclose(one.history.loss[0], many.history.loss[0], rtol=1e-12)


@pytest.mark.parametrize(("unit", "constant"), [(1e-12, 0.0), (1e8, 0.0), (1.0, 1e6), (1e-12, -1e-6)])
def test_a_loss_in_another_unit_is_the_same_loss(unit, constant):
    """In the squares of micrometres the descent ended at 99.2, where it had hardly begun: settled by a tolerance of 1e-3."""
    tuned = dae_jax.tune(lambda p: unit * jnp.log(p / 3.0) ** 2 + constant, 100.0, steps=200, progress=False)
    np.testing.assert_allclose(tuned.params, 3.0, rtol=2e-2)


def test_many_small_gains_are_a_gain():
    """Of 5e-4 a step, half a tolerance: 0.015 in 30 steps."""
    tuned = dae_jax.tune(lambda p: -jnp.log(p), 1.0, optax.scale(-5e-4), steps=200, progress=False)
    np.testing.assert_allclose(tuned.loss, -0.0995, rtol=1e-9)


def test_a_loss_that_falls_by_decades_goes_on():
    """What is left is little beside what was gained in the first steps, and much beside what is to be had."""
    loss = lambda p: 1e6 * jax.nn.relu(jnp.log(p) - 5) + jnp.abs(jnp.log(p))
    tuned = dae_jax.tune(loss, jnp.exp(5.5), optax.sign_sgd(0.1), steps=70, progress=False)
    assert tuned.loss < 0.1


def test_what_is_no_positive_number_any_more_is_never_the_best():
    """exp(710) is infinite, but log(exp(z)) is compiled to z: the best was at infinity."""
    for sign in (1, -1):
        tuned = dae_jax.tune(lambda p, sign=sign: -sign * jnp.log(p), 1.0, optax.sgd(30.0), steps=60, progress=False)
        assert 0 < tuned.params < np.inf


def test_plateau_ends_the_descent():
    tuned = dae_jax.tune(lambda p: 0 * p + 1.0, 2.0, steps=1000, progress=False)
    assert tuned.history.loss.shape[1] <= 40


@pytest.mark.parametrize("steps", [100, 300, 3000])
def test_steps_to_and_fro_across_a_valley_are_no_end(steps):
    """Of 200 steps and more the first are long, and led to and fro: 0.001 and settled, where 100 had led to 1e-32."""
    tuned = dae_jax.tune(lambda p: (p["a"] * p["b"] - 2) ** 2, {"a": 1.0, "b": 5.0}, steps=steps, progress=False)
    assert tuned.loss < 1e-20
    assert tuned.history.loss.shape[1] <= 220


@pytest.mark.parametrize("optimiser", [optax.lbfgs(), optax.polyak_sgd()], ids=["lbfgs", "polyak"])
def test_optimisers_that_take_the_value_too(optimiser):
    """They ended in optax with missing keyword arguments."""
    loss = lambda p: (p["a"] * p["b"] - 2) ** 2
    assert dae_jax.tune(loss, {"a": 1.0, "b": 5.0}, optimiser, steps=60, progress=False).loss < 1e-6


def test_steps_that_are_no_multiple_of_a_block():
    assert dae_jax.tune(lambda p: p, 2.0, steps=13, progress=False).history.loss.shape == (1, 13)


def test_holes_are_left_and_never_the_best():
    """A loss that is NaN above 5: the descent with steps of a factor e comes back out."""
    loss = lambda p: jnp.where(p > 5, jnp.nan, -p)
    tuned = dae_jax.tune(loss, 1.0, optax.sgd(1.0), steps=40, progress=False)
    assert np.isnan(tuned.history.loss).any()
    assert 4.0 < float(tuned.params) <= 5.0


def test_another_optimiser_and_reverse_mode():
    """Sixteen parameters: reverse mode, through a solve with its default adjoint."""
    pendulum = SCENES["pendulum"]()

    def loss(p):
        sol = dae_jax.daesolve(
            pendulum.system, diffrax.Tsit5(), 0.0, 0.1, 0.05, pendulum.y0,
            formulation=dae_jax.Baumgarte(jnp.mean(p), jnp.mean(p)), throw=False,
        )  # fmt: skip
        return jnp.sum(jnp.log(p / 2) ** 2) + 0 * jnp.sum(sol.ys[0])

    tuned = dae_jax.tune(loss, jnp.ones(16), optax.sgd(0.3), steps=20, progress=False)
    np.testing.assert_allclose(tuned.params, 2.0, rtol=1e-2)
    assert tuned.evaluations == tuned.history.loss.size * 4
    # Two parameters ask for forward mode first, which this solve refuses.
    few = dae_jax.tune(loss, jnp.ones(2), optax.sgd(0.3), steps=20, progress=False)
    np.testing.assert_allclose(few.params, 2.0, rtol=1e-2)


@pytest.mark.parametrize("params", [0.0, {"a": -1.0}, np.nan, jnp.array([1.0, jnp.inf])], ids=str)
def test_parameters_must_be_positive(params):
    with pytest.raises(ValueError, match="must be positive and finite"):
        dae_jax.tune(lambda p: 1.0, params, steps=1)


def test_a_loss_that_is_finite_nowhere_is_refused():
    with pytest.raises(ValueError, match="not finite"):
        dae_jax.tune(lambda p: p * jnp.nan, 1.0, steps=50, progress=False)


def test_a_loss_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match="must return a real number"):
        dae_jax.tune(lambda p: p, jnp.ones(2), steps=1)


@pytest.mark.parametrize("kind", [int, complex, bool])
def test_a_loss_of_another_type_is_refused(kind):
    with pytest.raises(ValueError, match=r"must return a real number, but returns .*\[\]"):
        dae_jax.tune(lambda p: p.astype(kind), 2.0, steps=5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 2.5}, "`steps` must be a whole number of at least 1, but is 2.5"),
        ({"starts": 0}, "`starts` must be a whole number of at least 1, but is 0"),
        ({"patience": -1}, "`patience` must be a whole number"),
        ({"spread": 0.0}, "`spread` must be a factor of at least 1"),
        ({"spread": np.nan}, "`spread` must be a factor of at least 1"),
        ({"tolerance": np.nan}, "`tolerance` must be a part of the loss"),
        ({"optimiser": 0.1}, "`optimiser` must be one of optax"),
        ({"optimiser": optax.adam}, "`optimiser` must be one of optax"),
        ({"key": 3}, "`key` must be one of"),
        ({"params": {}}, "`params` must hold numbers"),
        ({"params": 1j}, "must be positive and finite"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        dae_jax.tune(**{"loss": lambda p: p, "params": 1.0, "steps": 5, **options})


def test_what_is_traced_or_cannot_be_is_refused():
    with pytest.raises(ValueError, match="`tune` looks at numbers"):
        jax.jit(lambda p: dae_jax.tune(lambda x: x, p, steps=5, progress=False).params)(1.0)
    with pytest.raises(ValueError, match="`tune` looks at numbers"):
        jax.jit(lambda k: dae_jax.tune(lambda x: k * x, 1.0, steps=5, progress=False).params)(1.0)
    with pytest.raises(ValueError, match="`loss` must be traceable by JAX, but makes numbers"):
        dae_jax.tune(lambda p: float(p), 1.0, steps=5, progress=False)


def test_progress_is_shown(capsys):
    dae_jax.tune(lambda p: jnp.log(p) ** 2, 2.0, steps=10)
    assert "10/10" in capsys.readouterr().err


# The loss


def test_gradient_of_the_loss_is_that_of_central_differences(case):
    loss = case[1]
    slope = jax.jit(jax.jacfwd(loss))
    for alpha, beta in ((1.0, 1.0), (3.0, 7.0), (10.0, 10.0)):
        p = {"alpha": jnp.asarray(alpha), "beta": jnp.asarray(beta)}
        for name in p:
            # Of fourth order, with a step that balances truncation and the round-off of a drift of about 1e-9.
            step = 1e-2 * p[name]
            values = [loss({**p, name: p[name] + k * step}) for k in (-2, -1, 1, 2)]
            central = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
            np.testing.assert_allclose(slope(p)[name], central, rtol=1e-4)


def test_gradient_under_vmap(case):
    _, loss = case
    p = {"alpha": jnp.array([1.0, 30.0, 1e4]), "beta": jnp.array([5.0, 2.0, 1e4])}
    slope = jax.jacfwd(loss)
    together = jax.jit(jax.vmap(slope))(p)
    for i in range(3):
        alone = jax.jit(slope)(jax.tree.map(operator.itemgetter(i), p))
        for name in p:
            np.testing.assert_allclose(together[name][i], alone[name], rtol=1e-6)


def test_a_solve_that_fails_is_no_win_and_its_slope_leads_back(case):
    loss, compiled = case
    stiff = {"alpha": 1e4, "beta": 1e4}
    assert loss.parts(stiff).result != dae_jax.RESULTS.successful
    assert np.isfinite(compiled(stiff))
    assert compiled(stiff) > compiled(BAD_START) + 10
    slope = jax.jit(jax.jacfwd(loss))(jax.tree.map(jnp.asarray, stiff))
    assert all(s > 0 and np.isfinite(s) for s in slope.values())


def test_tuning_is_as_good_as_a_grid_at_a_fraction_of_its_cost(case, tuned):
    found = grid(case[0], 30)
    assert np.isfinite(found).all()
    assert float(tuned.loss) <= found.min()
    # 2 % of the 100 × 100 grid that `benchmarks/tuning.py` compares with.
    assert tuned.evaluations <= 200


def test_a_tuned_result_holds_in_solves_that_the_loss_did_not_use(case, tuned):
    loss, _ = case
    before, after = loss.verify(BAD_START), loss.verify(tuned.params)
    # 1e-11 times the growth of errors over 5 s, and the reference's own error: the formulation has the right solution.
    assert after.tight.error < 1e-8
    assert after.tight.drift < 1e-8
    # What the loss promises, decades of drift and of error together, is there in one solve from start to end.
    assert after.at_dt0.error * after.at_dt0.drift < before.at_dt0.error * before.at_dt0.drift
    # An error that vanished by accident at one step size would not fall with the order (Tsit5: 32).
    assert after.at_half_dt0.error < after.at_dt0.error / 10


def test_a_failing_solve_verifies_as_infinite(case):
    loss, _ = case
    assert loss.verify({"alpha": 1e4, "beta": 1e4}).at_dt0.error == np.inf


def test_nonholonomic_system_and_own_reference():
    scene = SCENES["knife-edge"]()
    loss = dae_jax.baumgarte_loss(scene.system, scene.y0, 2.0, dt0=0.05)
    given = dae_jax.baumgarte_loss(scene.system, scene.y0, 2.0, dt0=0.05, reference=scene.reference)
    np.testing.assert_allclose(loss(BAD_START), given(BAD_START), rtol=1e-5)


def test_what_the_loss_is_not_for_is_refused(case):
    with pytest.raises(ValueError, match="takes a ConstrainedSystem, but `system` is a SemiExplicitDAE"):
        dae_jax.baumgarte_loss(SCENES["robertson"]().system, jnp.ones(2), 1.0, dt0=0.1)
    for params in ({"alpha": 1.0}, {"alpha": 1.0, "beta": 1.0, "gamma": 1.0}):
        with pytest.raises(ValueError, match="The parameters must be"):
            case[0](params)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt0": -0.1}, "0 < dt0"),
        ({"dt0": 20.0}, "0 < dt0"),
        ({"dt0": 0.1, "times": 3}, "`times` must be at least"),
        ({"dt0": 0.1, "times": 20.5}, "`times` must be at least"),
        ({"dt0": "0.1"}, "`dt0` must be a real number"),
        ({"dt0": 0.1, "weights": (1.0, 2.0)}, "`weights` must be three finite numbers"),
        ({"dt0": 0.1, "weights": (1.0, 2.0, np.nan)}, "`weights` must be three finite numbers"),
        ({"dt0": 0.1, "reference": lambda t: (np.ones((2, 2)), np.ones((2, 2)))}, "`reference` must give"),
    ],
)
def test_wrong_input_is_refused(options, message):
    scene = SCENES["pendulum"]()
    with pytest.raises(ValueError, match=message):
        dae_jax.baumgarte_loss(scene.system, scene.y0, 10.0, **options)


def test_history_can_be_drawn(tmp_path):
    tuned = dae_jax.tune(lambda p: jnp.log(p["a"]) ** 2, {"a": 3.0}, steps=10, starts=3, progress=False)
    plotting.tuning(tuned.history).savefig(tmp_path / "history.png")
    assert (tmp_path / "history.png").stat().st_size > 10_000


def test_the_loss_has_derivatives_of_both_modes():
    """For an optimiser of the user's own."""
    scene = SCENES["pendulum"]()
    loss = jax.jit(dae_jax.baumgarte_loss(scene.system, scene.y0, 2.0, dt0=0.02))
    at, h = {"alpha": 20.0, "beta": 20.0}, 1e-2
    moved = lambda name, by: float(loss({**at, name: at[name] + by}))
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(loss)(at)
        for name in at:
            np.testing.assert_allclose(found[name], (moved(name, h) - moved(name, -h)) / (2 * h), rtol=1e-5)
    rows = {k: jnp.array([x, 2 * x]) for k, x in at.items()}
    np.testing.assert_allclose(jax.vmap(jax.grad(loss))(rows)["beta"][0], jax.grad(loss)(at)["beta"], rtol=1e-12)
