"""Systems of hundreds of unknowns: sparse factors, whose pivots may vanish on the way, consistency, derivatives, batches.

A chain of reservoirs, ẋᵢ = k (xᵢ₋₁ − 2 xᵢ + xᵢ₊₁) + zᵢ, with zᵢ and wᵢ given by equations without derivatives whose pivots, by
structure, are (1 − t):

    0 = (1 − t) zᵢ + wᵢ − (2 − t) cos xᵢ₊₁…,   0 = zᵢ + (1 − t) wᵢ − …

so that z = w = −xᵢ, whatever t ≠ 0, 2 is. It is linear, and its solution an exponential.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import dae_jax
from dae_jax.compiler import equations
from dae_jax.equations.linearised import LinearisedResidual
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.linalg.sparse import Sparse


N = 100
START = 0.1


def residual(t, y, yd, k):
    x, z, w = y["x"], y["z"], y["w"]
    around = jnp.pad(x, 1)
    return {
        "flow": yd["x"] - k * (around[2:] - 2 * x + around[:-2]) - z,
        "first": (1 - t) * z + w + (2 - t) * x,
        "second": z + (1 - t) * w + (2 - t) * x,
    }


SYSTEM = dae_jax.ImplicitDAE(residual)


def start(x=None):
    x = jnp.sin(jnp.arange(1.0, N + 1)) if x is None else x
    return {"x": x, "z": -x, "w": -x}


def exact(t, x, k):
    return expm((t - START) * (k * (np.eye(N, k=1) + np.eye(N, k=-1) - 2 * np.eye(N)) - np.eye(N))) @ np.asarray(x)


def solve(solver, y0, k, rtol=1e-7, **options):
    return dae_jax.daesolve(
        SYSTEM,
        solver,
        START,
        1.5,
        None,
        y0,
        k,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        **options,
    )


SOLVERS = {"Radau": dae_jax.RadauIIA5(), "BDF": dae_jax.BDF()}


@pytest.mark.parametrize("name", SOLVERS)
def test_pivots_that_vanish_on_the_way(name):
    sol = solve(SOLVERS[name], start(), 1.0, saveat=diffrax.SaveAt(ts=[0.5, 1.0, 1.5]))
    for t, x, z in zip(sol.ts, sol.ys["x"], sol.ys["z"], strict=True):
        truth = exact(t, start()["x"], 1.0)
        np.testing.assert_allclose(x, truth, atol=1e-5)
        np.testing.assert_allclose(z, -truth, atol=1e-5)
    assert 0 < sol.stats["num_jacobians"] <= sol.stats["num_factorisations"] < sol.stats["num_corrections"]
    assert sol.stats["num_factorisations"] < sol.stats["num_steps"]


@pytest.mark.parametrize("name", SOLVERS)
def test_gradients_in_both_modes(name):
    def loss(k, **options):
        return jnp.sum(solve(SOLVERS[name], start(), k, max_steps=500, **options).ys["z"] ** 2)

    k, step = jnp.asarray(0.7), 1e-4
    difference = (loss(k + step) - loss(k - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(loss)(k), difference, rtol=1e-5)
    forward = jax.jvp(lambda k: loss(k, adjoint=diffrax.ForwardMode()), (k,), (jnp.ones(()),))[1]
    np.testing.assert_allclose(forward, difference, rtol=1e-5)


def test_a_batch_is_one_at_a_time():
    ks = jnp.asarray([0.5, 2.0])
    ends = jax.vmap(lambda k: solve(SOLVERS["Radau"], start(), k).ys["x"][0])(ks)
    for k, end in zip(ks, ends, strict=True):
        np.testing.assert_allclose(end, solve(SOLVERS["Radau"], start(), k).ys["x"][0], atol=1e-9)
        np.testing.assert_allclose(end, exact(1.5, start()["x"], float(k)), atol=1e-5)


def traced(n):
    """How many equations the program of a chain of n has, and how its matrices are stored."""
    y0 = start(jnp.ones(n))
    form = ResidualForm.of(SYSTEM, 0.1, y0, 1.0)
    linearised = LinearisedResidual.of(form, form.encode(y0))
    jaxpr = jax.make_jaxpr(lambda y0: solve(SOLVERS["BDF"], y0, 1.0, throw=False).ys)(y0)
    return sum(1 for _ in equations(jaxpr)), linearised.storage


def test_the_program_does_not_grow_with_the_system():
    (short, storage), (as_long, larger) = traced(150), traced(300)
    assert short == as_long
    assert isinstance(storage, Sparse)
    assert len(larger.symbolic.at) < 2.1 * len(storage.symbolic.at)


def test_a_bad_start_names_a_few_equations():
    y0 = start()
    with pytest.raises(ValueError, match=r"0 = residual\['(first|second)'\]\[\d+\] is off by") as raised:
        solve(SOLVERS["BDF"], {**y0, "w": y0["w"].at[3:].add(0.1)}, 1.0)
    assert "and 182 more" in str(raised.value)
    assert len(str(raised.value)) < 2000


# Index 2: p keeps the sum of neighbouring velocities at 0


def pushed(t, y, yd, force):
    v, p = y["v"], y["p"]
    return {"push": yd["v"] + jnp.pad(p, (1, 0)) + jnp.pad(p, (0, 1)) - force, "sum": v[1:] + v[:-1]}


PUSHED = dae_jax.ImplicitDAE(pushed)


def pushed_start(n=161):
    return {"v": jnp.where(jnp.arange(n) % 2, -1.0, 1.0), "p": jnp.zeros(n - 1)}


FORCE = jnp.linspace(0, 1, 161) ** 2


def test_hidden_equations_of_a_large_system():
    with pytest.raises(ValueError, match=r"violates the equations(.|\n)* and \d+ more"):
        dae_jax.daesolve(PUSHED, dae_jax.RadauIIA5(), 0.0, 1.0, None, pushed_start(), FORCE)
    keep = {"v": True, "p": False}
    y0 = dae_jax.consistent_state(PUSHED, 0.0, pushed_start(), FORCE, fixed=keep)
    # p from A (F − Aᵀ p) = 0, with A v = 0.
    a = np.eye(161)[:-1] + np.eye(161, k=1)[:-1]
    p = np.linalg.solve(a @ a.T, a @ FORCE)
    np.testing.assert_allclose(y0["p"], p, atol=1e-9)
    sol = dae_jax.daesolve(PUSHED, dae_jax.RadauIIA5(), 0.0, 1.0, None, y0, FORCE)
    np.testing.assert_allclose(sol.ys["v"][0], y0["v"] + FORCE - a.T @ p, atol=1e-7)
    np.testing.assert_allclose(sol.ys["p"][0], p, atol=1e-6)
    assert all(level.max() < 1e-9 for level in dae_jax.drift(PUSHED, sol).levels)


def test_the_nearest_consistent_state_of_a_large_system():
    y0 = pushed_start()
    rng = np.random.default_rng(0)
    off = {"v": y0["v"] + rng.normal(size=161), "p": y0["p"]}
    found = dae_jax.consistent_state(PUSHED, 0.0, off, FORCE)
    a = np.eye(161)[:-1] + np.eye(161, k=1)[:-1]
    nearest = off["v"] - np.linalg.pinv(a) @ (a @ off["v"])
    np.testing.assert_allclose(found["v"], nearest, atol=1e-8)
    weights = rng.normal(size=161)
    found = lambda v: dae_jax.consistent_state(PUSHED, 0.0, {"v": v, "p": y0["p"]}, FORCE)["v"] @ weights
    np.testing.assert_allclose(jax.grad(found)(off["v"]), weights - np.linalg.pinv(a) @ (a @ weights), atol=1e-8)


def test_derivatives_of_the_nearest_consistent_state_of_a_large_system():
    """On the curved z = a x² + shift(x)/10, with the derivatives of its conditions of Lagrange by a dense solve."""
    n, z0 = 150, jnp.zeros(150)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x, lambda t, x, z, a: z - a * x**2 - 0.1 * jnp.roll(x, 1))
    x0, a = jnp.linspace(0.1, 1, n), 0.3
    found = lambda a, **options: jnp.concatenate(dae_jax.consistent_state(system, 0.0, (x0, z0), a, **options))

    def conditions(w, a):
        x, z, multiplier = jnp.split(w, 3)
        g, pull = jax.vjp(lambda x, z: z - a * x**2 - 0.1 * jnp.roll(x, 1), x, z)
        along_x, along_z = pull(multiplier)
        return jnp.concatenate([x - x0 + along_x, z - z0 + along_z, g])

    w = np.concatenate([x0, z0, z0])
    slope = jax.jit(jax.jacfwd(conditions))
    for _ in range(20):
        w = w - np.linalg.solve(slope(w, a), conditions(w, a))
    exact = -np.linalg.solve(slope(w, a), jax.jacfwd(conditions, 1)(w, a))[: 2 * n]
    value, change = jax.jvp(found, (a,), (1.0,))
    np.testing.assert_allclose(value, w[: 2 * n], atol=1e-12)
    np.testing.assert_allclose(change, exact, atol=1e-11)
    gradient = jax.grad(lambda a: jnp.sum(found(a) ** 2))(a)
    np.testing.assert_allclose(gradient, 2 * w[: 2 * n] @ exact, rtol=1e-11)
    fixed = jax.grad(lambda a: jnp.sum(found(a, fixed=(True, False))))(a)
    np.testing.assert_allclose(fixed, jnp.sum(x0**2), rtol=1e-11)


def test_a_reset_of_a_large_system():
    """From a condition that is 0 at the start: on which side it then is the rate says, of an algebraic variable here."""
    n, rates = 150, jnp.linspace(1.0, 2.0, 150)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z + rates * x)
    condition = lambda t, y, a, **_: (y[1][0] + 1) * (y[1][0] + 0.5)
    kicked = dae_jax.Reset(condition, lambda t, y, a: ((y[0].at[1].add(1.0), y[1]), a), fixed=(True, False))
    start = (jnp.ones(n), -rates)
    sol = dae_jax.daesolve(system, dae_jax.BDF(), 0.0, 1.0, None, start, event=kicked)
    assert sol.stats["jumps"] == 1
    assert sol.stats["jump_times"][0] == pytest.approx(np.log(2), abs=1e-5)
    x, z = sol.final
    exact = np.exp(-np.asarray(rates))
    exact[1] += np.exp(-rates[1] * (1 - np.log(2)))
    np.testing.assert_allclose(x, exact, atol=1e-5)
    np.testing.assert_allclose(z, -rates * exact, atol=2e-5)

    def kick(size, adjoint):
        kicked = dae_jax.Reset(condition, lambda t, y, a: ((y[0].at[1].add(a), y[1]), a), fixed=(True, False))
        sol = dae_jax.daesolve(system, dae_jax.BDF(), 0.0, 1.0, None, start, size, event=kicked, adjoint=adjoint)
        return sol.final[0][1]

    slope = np.exp(-rates[1] * (1 - np.log(2)))
    forward = jax.jvp(lambda size: kick(size, diffrax.ForwardMode()), (1.0,), (1.0,))[1]
    reverse = jax.grad(lambda size: kick(size, diffrax.RecursiveCheckpointAdjoint()))(1.0)
    np.testing.assert_allclose([forward, reverse], slope, atol=1e-5)
