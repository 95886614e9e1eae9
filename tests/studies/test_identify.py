"""`identify`: estimates and standard errors against closed forms, certified values, and the scatter of many experiments."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import dae_jax


RNG = np.random.default_rng(0)
DESIGN = RNG.normal(size=(30, 3)) * [1.0, 10.0, 0.1]
TRUTH = np.array([1.0, -2.0, 3.0])
NOISE = RNG.normal(size=30)


def linear(p):
    return jnp.asarray(DESIGN) @ p


def decay(p):
    return p["size"] * jnp.exp(-p["rate"] * jnp.linspace(0, 3, 40)) + p["offset"]


DECAY = {"size": 2.0, "rate": 1.0, "offset": 0.3}
GUESS = {"size": 1.0, "rate": 3.0, "offset": 1.0}


# Against closed forms


@pytest.mark.parametrize("positive", [True, False])
@pytest.mark.parametrize("unit", [1e-30, 1e-23, 1e23, 1e30])
def test_a_parameter_whose_square_is_no_number_has_its_standard_error(unit, positive):
    """In float32 a molecule's mass was 1.5e-23 ± 0, or not determined, and 1e23 of them ± inf: squares were 0 or infinite."""
    times, unit = jnp.linspace(0, 2, 30, dtype=jnp.float32), jnp.float32(unit)

    def found(unit):
        model = lambda p: p["mass"] / unit * jnp.exp(-p["rate"] * times)
        data = np.float32(1.5 * np.exp(-0.7 * np.asarray(times)) + 0.01 * NOISE)
        start = {"mass": 1.3 * unit, "rate": jnp.float32(1.0)}
        return dae_jax.identify(model, start, data, np.float32(0.01), positive=positive)

    expected, given = found(jnp.float32(1)), found(unit)
    np.testing.assert_allclose(given.params["mass"] / unit, expected.params["mass"], rtol=1e-4)
    np.testing.assert_allclose(given.standard_errors["mass"] / unit, expected.standard_errors["mass"], rtol=1e-4)
    np.testing.assert_allclose(given.correlation, expected.correlation, atol=1e-4)


@pytest.mark.parametrize("sigma", [None, 0.1, np.geomspace(0.01, 1, 30)], ids=["estimated", "one", "many"])
def test_of_a_linear_model_all_is_that_of_the_normal_equations(sigma):
    given = 0.1 if sigma is None else sigma
    data = DESIGN @ TRUTH + given * NOISE
    found = dae_jax.identify(linear, jnp.zeros(3), data, sigma, positive=False, tolerance=1e-6)
    weights = np.ones(30) if sigma is None else 1 / (0 * NOISE + sigma)
    weighted = weights[:, None] * DESIGN
    exact = np.linalg.solve(weighted.T @ weighted, weighted.T @ (weights * data))
    residual = data - DESIGN @ exact
    deviation = np.linalg.norm(weights * residual) / np.sqrt(27)
    variance = deviation**2 if sigma is None else 1.0
    covariance = variance * np.linalg.inv(weighted.T @ weighted)
    errors = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(found.params - exact) < 1e-5 * errors)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    np.testing.assert_allclose(found.standard_errors, errors, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, covariance / np.outer(errors, errors), rtol=1e-9)
    np.testing.assert_allclose(found.information, np.linalg.inv(covariance), rtol=1e-9)
    np.testing.assert_allclose(found.deviation, deviation, rtol=1e-9)
    np.testing.assert_allclose(found.residuals, residual, atol=1e-6)
    np.testing.assert_allclose(found.cost, 27 * deviation**2 / 2, rtol=1e-9)
    if sigma is None:
        assert np.isnan(found.probability)
    else:
        np.testing.assert_allclose(found.probability, stats.chi2.sf(27 * deviation**2, 27), rtol=1e-8)


def test_certified_values_of_a_nonlinear_regression():
    """Misra1a of the Statistical Reference Datasets, National Institute of Standards and Technology."""
    x = jnp.array([77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0])
    y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]
    model = lambda p: p[0] * -jnp.expm1(-p[1] * x)
    for start in ([500.0, 1e-4], [250.0, 5e-4]):
        for positive in (True, False):
            found = dae_jax.identify(model, np.array(start), np.array(y), positive=positive, tolerance=1e-6)
            np.testing.assert_allclose(found.params, [2.3894212918e2, 5.5015643181e-4], rtol=1e-7)
            np.testing.assert_allclose(found.standard_errors, [2.7070075241, 7.2668688436e-6], rtol=1e-6)
            np.testing.assert_allclose(found.deviation, 1.0187876330e-1, rtol=1e-9)
            np.testing.assert_allclose(2 * found.cost, 1.2455138894e-1, rtol=1e-9)


@pytest.mark.parametrize("sigma", [None, 0.05], ids=["estimated", "given"])
def test_estimates_scatter_by_their_standard_errors(sigma):
    """2,000 experiments: spread, coverage, and the distribution of χ², each within five of its own standard errors."""
    count, noise = 2000, 0.05
    draws = decay(DECAY) + noise * jax.random.normal(jax.random.key(1), (count, 40))
    found = jax.vmap(lambda data: dae_jax.identify(decay, GUESS, data, sigma))(draws)
    within = stats.norm.ppf(0.975) if sigma else stats.t.ppf(0.975, 37)
    for name, true in DECAY.items():
        estimates, errors = np.asarray(found.params[name]), np.asarray(found.standard_errors[name])
        stated = np.sqrt(np.mean(errors**2))
        assert abs(estimates.std() / stated - 1) < 5 / np.sqrt(2 * count)
        # The bias of a nonlinear model is of the second order.
        assert abs(estimates.mean() - true) < 5 * stated / np.sqrt(count) + stated**2
        covered = np.mean(np.abs(estimates - true) < within * errors)
        assert abs(covered - 0.95) < 5 * np.sqrt(0.95 * 0.05 / count)
    pairs = np.corrcoef(np.stack([found.params[name] for name in sorted(DECAY)]))
    assert np.abs(pairs - np.mean(found.correlation, 0)).max() < 5 / np.sqrt(count)
    if sigma:
        assert stats.kstest(np.asarray(found.probability), "uniform").pvalue > 1e-4
    else:
        assert abs(np.mean(found.deviation**2) / noise**2 - 1) < 5 * np.sqrt(2 / 37 / count)


def test_data_without_noise_are_met():
    found = dae_jax.identify(decay, GUESS, decay(DECAY))
    for name, true in DECAY.items():
        np.testing.assert_allclose(found.params[name], true, rtol=1e-9)
    assert found.offset == 0


@pytest.mark.parametrize(
    ("dtype", "size", "noise"),
    [
        (np.float32, 1e4, 0.1),
        (np.float32, 300, 0.01),
        (np.float64, 1.7e9, 1e-3),
        (np.float64, 1e7, 1e-5),
        (np.float64, 1.0, 1e-13),
    ],
)
@pytest.mark.parametrize("in_log", [False, True])
def test_noise_that_is_small_beside_the_data_is_no_round_off(dtype, size, noise, in_log):
    """A slope on a large constant: temperatures in K, times since 1970."""
    t = np.linspace(0, 4, 60)
    data = np.asarray(3 * t + size + noise * RNG.normal(size=60), dtype)
    found = dae_jax.identify(
        lambda p: p[0] * jnp.asarray(t, dtype) + p[1], jnp.asarray([1.0, 0.9 * size], dtype), data, positive=in_log
    )
    design = np.stack([t, np.ones(60)], 1)
    exact, square, *_ = np.linalg.lstsq(design, data.astype(float) - size, rcond=None)
    error = np.sqrt(square[0] / 58 * np.linalg.inv(design.T @ design)[0, 0])
    # A logarithm of a number loses as many of its digits as the number is large.
    assert abs(float(found.params[0]) - exact[0]) < (0.4 if in_log and dtype == np.float32 else 0.1) * error
    np.testing.assert_allclose(found.standard_errors[0], error, rtol=0.05)
    np.testing.assert_allclose(found.deviation, np.sqrt(square[0] / 58), rtol=0.05)


@pytest.mark.parametrize("unit", [1e-35, 1.6e-19, 1e-18, 1e18, 1e30])
def test_units_of_the_data_do_not_count(unit):
    """Squares of these are 0 or infinite in float32."""
    t, noise = np.linspace(0, 4, 30).astype(np.float32), 1 + 0.01 * RNG.normal(size=30)
    model = lambda unit: lambda p: p["a"] * jnp.float32(unit) * t
    given = {"a": jnp.float32(1)}
    plain, found = (dae_jax.identify(model(u), given, (2 * u * t * noise).astype(np.float32)) for u in (1.0, unit))
    np.testing.assert_allclose(found.params["a"], plain.params["a"], rtol=1e-5)
    np.testing.assert_allclose(found.standard_errors["a"], plain.standard_errors["a"], rtol=1e-3)
    for name in ("deviation", "sensitivities"):
        np.testing.assert_allclose(getattr(found, name), getattr(plain, name) * unit, rtol=1e-3)


def test_units_of_the_parameters_do_not_count():
    data = decay(DECAY) + 0.05 * np.random.default_rng(2).normal(size=40)
    units = {"size": 1e6, "rate": 1e-6, "offset": 1e3}
    scaled = lambda p: decay({name: p[name] * units[name] for name in p})
    plain = dae_jax.identify(decay, GUESS, data, positive=False)
    other = dae_jax.identify(scaled, {name: GUESS[name] / units[name] for name in GUESS}, data, positive=False)
    assert int(plain.iterations) == int(other.iterations)
    for name in DECAY:
        np.testing.assert_allclose(other.standard_errors[name] * units[name], plain.standard_errors[name], rtol=1e-6)


def test_in_log_and_not_the_estimate_is_the_same():
    data = decay(DECAY) + 0.05 * np.random.default_rng(3).normal(size=40)
    of = lambda positive: dae_jax.identify(decay, GUESS, data, positive=positive, tolerance=1e-6)
    logs, mixed, plain = of(True), of({"size": True, "rate": False, "offset": True}), of(False)
    assert mixed.in_log.tolist() == [True, False, True]
    for other in (mixed, plain):
        np.testing.assert_allclose(other.covariance, logs.covariance, rtol=1e-4)
        np.testing.assert_allclose(other.information, logs.information, rtol=1e-4)
        for name in DECAY:
            np.testing.assert_allclose(other.params[name], logs.params[name], rtol=1e-5)


def test_float32():
    data = np.asarray(decay(DECAY) + 0.05 * np.random.default_rng(3).normal(size=40), np.float32)
    guess = {name: np.float32(value) for name, value in GUESS.items()}
    found = dae_jax.identify(decay, guess, data)
    assert found.params["rate"].dtype == np.float32
    assert abs(found.params["rate"] - 1.0) < 5 * found.standard_errors["rate"]


def test_what_does_not_show_in_float32_is_told_by_its_digits():
    """Of a b^1.3 only the product shows; beside float64 the round-off of its slopes is no number of its own."""
    model = lambda p: p["a"] * p["b"] ** 1.3 * jnp.exp(-p["c"] * jnp.linspace(0, 3, 40, dtype=jnp.float32))
    start = {name: np.float32(value) for name, value in (("a", 1.0), ("b", 1.5), ("c", 0.7))}
    data = np.exp(-np.linspace(0, 3, 40)) + 0.01 * np.random.default_rng(1).normal(size=40)
    with pytest.warns(dae_jax.AccuracyWarning, match="The data do not determine changes of a, b"):
        found = dae_jax.identify(model, start, data.astype(np.float32), positive=False)
    assert np.isinf(found.standard_errors["a"])


def test_noise_below_the_digits_of_the_model_is_named():
    """In the 15th digit: the descent ends at round-off, many of what would be standard errors from the minimum."""
    data = 1e5 * decay(DECAY) + 1e-11 * np.random.default_rng(0).normal(size=40)
    with pytest.warns(dae_jax.AccuracyWarning):
        found = dae_jax.identify(lambda p: 1e5 * decay(p), GUESS, data, 1e-11)
    assert found.offset > 1
    assert "standard errors from the minimum: the noise is too small" in found.doubts[-1]


# A solve


TIMES = jnp.linspace(0, 2, 41)
PENDULUM = {"gravity": 9.81, "friction": 0.4}


def swing(p, times=TIMES, tolerance=1e-8, saveat=None, **options):
    """Places of a pendulum of length 1 that is let go level."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: p["gravity"] * jnp.array([0.0, 1.0]) - p["friction"] * v,
        lambda t, q, args: (q @ q - 1) / 2,
    )
    return dae_jax.daesolve(
        system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 2.0, None, (jnp.array([1.0, 0.0]), jnp.zeros(2)),
        saveat=diffrax.SaveAt(ts=times) if saveat is None else saveat, adjoint=diffrax.ForwardMode(), throw=False,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), **({"max_steps": 500} | options),
    ).ys[0]  # fmt: skip


def test_gravity_and_friction_of_a_pendulum_from_a_noisy_path():
    """From 50 experiments in a batch: each estimate is within 4.5 standard errors, and their spread is the stated one."""
    exact, count = swing({name: jnp.asarray(value) for name, value in PENDULUM.items()}), 50
    data = exact + 0.01 * jax.random.normal(jax.random.key(4), (count, *exact.shape))
    found = jax.vmap(lambda data: dae_jax.identify(swing, {"gravity": 5.0, "friction": 1.0}, data, 0.01))(data)
    off = np.stack([(found.params[name] - PENDULUM[name]) / found.standard_errors[name] for name in PENDULUM])
    assert np.abs(off).max() < 4.5
    assert np.abs(np.mean(off**2, 1) - 1).max() < 5 * np.sqrt(2 / count)
    assert stats.kstest(np.asarray(found.probability), "uniform").pvalue > 1e-4


def test_a_solve_that_fails_is_refused():
    """At the start, with 5 steps; where it fails with `throw=True`, by the solve's own words."""
    data = np.zeros((41, 2))
    with pytest.raises(ValueError, match=r"`model` at \[\d+\]\[0\] must be finite, but is inf. .* a solve that failed"):
        dae_jax.identify(lambda p: swing(p, max_steps=5), PENDULUM, data)


@pytest.mark.parametrize(
    ("times", "at"),
    [(np.linspace(-0.5, 2, 41), 0), (np.linspace(0, 2.5, 41), 33), (np.r_[np.linspace(0, 1, 40), 0.97], 40)],
    ids=["before", "after", "unsorted"],
)
def test_times_of_data_outside_the_solve_or_not_in_order_are_refused(times, at):
    with pytest.raises(ValueError, match=rf"`model` at \[{at}\]\[0\] must be finite, .* a time that it did not reach"):
        dae_jax.identify(lambda p: swing(p, times), PENDULUM, np.zeros((41, 2)))


# What the data do not determine


def test_a_combination_that_does_not_show_is_named():
    model = lambda p: p["a"] * p["b"] ** 2 * decay(DECAY) + p["c"] + 0 * p["unseen"]
    start = {"a": 1.0, "b": 1.5, "c": 0.2, "unseen": 7.0}
    data = model({"a": 1.0, "b": 1.0, "c": 0.1, "unseen": 1.0})
    with pytest.warns(dae_jax.AccuracyWarning) as warned:
        found = dae_jax.identify(model, start, data + 1e-3 * np.random.default_rng(5).normal(size=40))
    said = [str(w.message) for w in warned]
    assert said == found.doubts
    assert said[0].startswith("The data do not determine unseen:")
    # Of a b² only the product shows: log a falls by twice what log b grows by.
    assert said[1].startswith("The data do not determine changes of log a, log b as 1 : -0.5:")
    assert len(said) == 2
    assert found.params["unseen"] == pytest.approx(7.0)
    assert all(np.isinf(found.standard_errors[name]) for name in ("a", "b", "unseen"))
    assert np.isfinite(found.standard_errors["c"])
    assert np.isnan(found.covariance[0, 2])
    assert np.isinf(found.condition)
    np.testing.assert_allclose(found.params["a"] * found.params["b"] ** 2, 1.0, rtol=1e-2)


def test_what_is_identified_is_as_if_the_rest_were_fixed():
    data = decay(DECAY) + 0.05 * np.random.default_rng(6).normal(size=40)
    alone = dae_jax.identify(decay, GUESS, data, tolerance=1e-6)
    with pytest.warns(dae_jax.AccuracyWarning, match="do not determine unseen"):
        beside = dae_jax.identify(lambda p: decay(p) + 0 * p["unseen"], GUESS | {"unseen": 1.0}, data, tolerance=1e-6)
    np.testing.assert_allclose(beside.deviation, alone.deviation, rtol=1e-9)
    for name in DECAY:
        np.testing.assert_allclose(beside.standard_errors[name], alone.standard_errors[name], rtol=1e-5)


def test_fewer_data_than_parameters():
    with pytest.warns(
        dae_jax.AccuracyWarning, match=r"do not determine changes of params\[0\], params\[1\] as -0\.5 : 1"
    ):
        found = dae_jax.identify(lambda p: 2 * p[:1] + p[1:], jnp.ones(2), np.array([5.0]), 0.1, positive=False)
    assert 2 * found.params[0] + found.params[1] == pytest.approx(5.0, abs=1e-3)


def test_a_parameter_that_hardly_shows_is_named():
    model = lambda p: decay(DECAY) + 1e-3 * p["faint"] * jnp.linspace(0, 1, 40)
    with pytest.warns(dae_jax.AccuracyWarning, match="hardly determine faint"):
        found = dae_jax.identify(
            model, {"faint": 1.0}, model({"faint": 5.0}) + 0.05 * np.random.default_rng(1).normal(size=40)
        )
    assert found.standard_errors["faint"] > found.params["faint"]


def test_a_parameter_that_would_be_negative_is_named():
    model = lambda p: p["a"] + p["b"] * jnp.linspace(0, 1, 40)
    data = model({"a": 1.0, "b": -0.5}) + 0.01 * np.random.default_rng(1).normal(size=40)
    start = {"a": 1.0, "b": 1.0}
    with pytest.raises(
        RuntimeError, match="b has gone to 0, as where the data are met best by one that is not positive"
    ):
        dae_jax.identify(model, start, data)
    found = dae_jax.identify(model, start, data, positive={"a": True, "b": False})
    assert abs(found.params["b"] + 0.5) < 5 * found.standard_errors["b"]


def test_a_wrong_model_is_named():
    wrong = lambda p: p["size"] * jnp.exp(-p["rate"] * jnp.linspace(0, 3, 40))
    data = decay(DECAY) + 0.01 * np.random.default_rng(7).normal(size=40)
    with pytest.warns(dae_jax.AccuracyWarning, match="times as large as `sigma` says"):
        found = dae_jax.identify(wrong, {"size": 1.0, "rate": 1.0}, data, 0.01)
    assert found.deviation > 2


# How


def test_the_model_is_traced_once_for_any_number_of_steps():
    traced = []

    def counted(p):
        traced.append(1)
        return decay(p)

    data = decay(DECAY) + 0.05 * np.random.default_rng(9).normal(size=40)
    for tolerance in (1e-1, 1e-6):
        traced.clear()
        dae_jax.identify(counted, GUESS, data, tolerance=tolerance)
        assert len(traced) == 1


def test_holes_on_the_way_are_turned_down():
    """A model that is NaN below 0.5, which the first steps run into."""
    model = lambda p: jnp.where(p > 0.5, jnp.sqrt(p - 0.5), jnp.nan) * jnp.arange(1.0, 5.0)
    found = dae_jax.identify(model, 20.0, model(0.51), 1e-3)
    assert float(found.params) == pytest.approx(0.51, abs=1e-4)


def test_what_is_wrong_in_one_lane_of_a_batch_is_nan_there():
    data = np.asarray(decay(DECAY)) + 0.05 * np.random.default_rng(9).normal(size=(4, 40))
    data[1, 7] = np.nan
    sigma = np.array([0.05, 0.05, -0.05, 0.05])
    found = jax.vmap(lambda data, sigma: dae_jax.identify(decay, GUESS, data, sigma))(data, sigma)
    for x in (found.params["rate"], found.standard_errors["rate"], found.cost):
        np.testing.assert_array_equal(np.isnan(x), [False, True, True, False])


def test_no_minimum_is_an_error_and_nan_in_a_batch():
    data = decay(DECAY) + 0.05 * np.random.default_rng(9).normal(size=40)
    with pytest.raises(RuntimeError, match=r"has not come to the minimum in 3 of 3 steps: .* standard errors away"):
        dae_jax.identify(decay, GUESS, data, steps=3)
    batch = jax.vmap(lambda data: dae_jax.identify(decay, GUESS, data, steps=3))(data[None])
    assert np.isnan(batch.params["rate"]).all()
    assert np.isnan(batch.standard_errors["rate"]).all()
    assert np.isnan(batch.covariance).all()


def test_under_vmap_as_one_by_one():
    data = decay(DECAY) + 0.05 * np.random.default_rng(10).normal(size=(3, 40))
    together = jax.jit(jax.vmap(lambda data: dae_jax.identify(decay, GUESS, data)))(data)
    for k in range(3):
        alone = dae_jax.identify(decay, GUESS, data[k])
        np.testing.assert_allclose(together.params["rate"][k], alone.params["rate"], rtol=1e-9)
        np.testing.assert_allclose(together.covariance[k], alone.covariance, rtol=1e-6)


def test_what_is_printed():
    data = {"<y>": decay(DECAY) + 0.05 * np.random.default_rng(9).normal(size=40)}
    found = dae_jax.identify(lambda p: {"<y>": decay(p)}, GUESS, data)
    assert found.names == ["offset", "rate", "size"]
    assert repr(found).startswith("Identified(offset=0.254 ± 0.034, rate=")
    assert len(repr(found)) < 300
    assert "offset and rate" in found._repr_html_()
    assert "40 data" in found._repr_html_()
    many = dae_jax.identify(lambda p: p, jnp.ones(20), np.ones(20), 0.1)
    assert len(repr(many)) < 300


# What is refused


def broken(p):
    return decay(p).at[3].set(jnp.nan)


def fit(model=decay, params=GUESS, data=None, sigma=None, **options):
    return lambda: dae_jax.identify(model, params, decay(DECAY) if data is None else data, sigma, **options)


CASES = {
    "no function": (fit(1.0), "`model` must be a function"),
    "no parameters": (fit(params={}), "`params` must hold numbers, but is empty"),
    "words": (fit(params=GUESS | {"rate": "x"}), "`params` at rate must be real numbers, but holds 'x'"),
    "not positive": (fit(params=GUESS | {"rate": -1.0}), "`params` at rate must be positive, but holds -1"),
    "NaN at the start": (fit(params=GUESS | {"rate": np.nan}), "`params` at rate must be finite, but is nan"),
    "NaN in the data": (fit(data=np.append(np.ones(39), np.nan)), "`data` at [39] must be finite, but is nan"),
    "NaN in sigma": (fit(sigma=np.nan), "`sigma` must be finite, but is nan"),
    "NaN of the model": (fit(broken), "`model` at [3] must be finite, but is nan. So it is at the start"),
    "complex model": (fit(lambda p: decay(p) * (1 + 1j)), "`model` must return real numbers, but returns complex128[40]"),
    "model of fewer digits": (fit(lambda p: decay(p).astype(jnp.float32)), "`model` must have the digits of `params`, float64"),
    "a mask": (fit(data=np.ma.masked_less(np.linspace(-1, 1, 40), 0)), "`data` has a mask: leave what is masked out"),
    "no slope": (fit(lambda p: jnp.sqrt(p - 1) * jnp.ones(4), 1.0, np.ones(4)), "The derivative of `model` is not finite"),
    "another shape": (fit(data=np.ones(39)), "`model` must return what `data` is, float64[39], but returns float64[40]"),
    "another structure": (fit(data={"y": np.ones(40)}), "`model` must return what `data` is"),
    "sigma of 0": (fit(sigma=0.0), "`sigma` must be positive, but holds 0"),
    "sigma of another shape": (fit(sigma=np.ones(7)), "`sigma` must go with data of the shape (40,), but has (7,)"),
    "sigma of another structure": (fit(sigma={"y": 1.0}), "`sigma` must hold numbers in the structure of"),
    "positive of another structure": (fit(positive={"y": True}), "`positive` must hold booleans in the structure of"),
    "no booleans": (fit(positive="no"), "`positive` must hold booleans, one for each array of parameters, but holds 'no'"),
    "too few data": (fit(lambda p: p[:2], jnp.ones(2), np.ones(2)), "more data than parameters"),
    "no steps": (fit(steps=0), "`steps` and `tolerance` must be positive"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_wrong_input_is_refused(name):
    call, said = CASES[name]
    with pytest.raises((ValueError, TypeError), match=re.escape(said)):
        call()


def test_a_model_without_forward_derivatives_is_refused():
    @jax.custom_vjp
    def reverse(x):
        return x

    reverse.defvjp(lambda x: (x, None), lambda _, y: (y,))
    with pytest.raises(TypeError, match=r"has no forward derivative: .* `adjoint=diffrax.ForwardMode\(\)`"):
        dae_jax.identify(lambda p: reverse(p) * jnp.ones(4), 1.0, np.ones(4), 1.0)


def test_a_maximum_is_no_end():
    """A direction and a length against a point: opposite to it the squares have a saddle, at which all derivatives are 0, too."""
    model = lambda p: p["length"] * jnp.stack([jnp.cos(p["angle"]), jnp.sin(p["angle"])])
    data = jnp.array([0.6, 0.8])
    opposite = np.arctan2(0.8, 0.6) + np.pi
    at = lambda angle: {"length": jnp.asarray(1.0), "angle": jnp.asarray(angle)}
    for off in (0.0, 1e-7, -1e-5):
        with pytest.raises(RuntimeError, match="maximum of the squares"):
            dae_jax.identify(
                lambda p: model(p | {"length": 1.0}), {"angle": jnp.asarray(opposite + off)}, data, positive=False
            )
    found = dae_jax.identify(model, at(opposite - 0.5), data, 0.1)
    assert found.offset < 1e-3
    np.testing.assert_allclose(model(found.params), data, atol=2e-4)
    fixed = lambda angle: (
        dae_jax.identify(lambda a: model({"length": 1.0, "angle": a}), angle, data, positive=False).params
    )
    ends = jax.vmap(fixed)(jnp.array([opposite, opposite - 0.5, opposite - 2]))
    assert np.isnan(ends[0])
    np.testing.assert_allclose(ends[1:], opposite - np.pi, atol=1e-9)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_has_no_derivative(mode):
    """It would be that of a linear model, some per cent off without a word."""
    model = lambda p: p[0] * jnp.cos(jnp.arange(6.0)) + jnp.sin(p[1]) * jnp.sin(jnp.arange(6.0))
    found = lambda data: dae_jax.identify(model, jnp.array([1.0, 0.5]), data, positive=False).params
    with pytest.raises(RuntimeError, match="no derivative by the data"):
        mode(found)(model(jnp.array([1.2, 0.7])) + 0.1)
