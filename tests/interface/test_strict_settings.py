"""JAX's strict rules are for the code of who sets them: what the package does inside is not forbidden by them."""

import contextlib

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


SYSTEM = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0.0 * g, -g]), lambda t, q, g: (q @ q - 1.0) / 2.0)


@contextlib.contextmanager
def no_promotion():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


SETTINGS = {"promotion": no_promotion, "transfers": lambda: jax.transfer_guard("disallow")}
METHODS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
    "Radau": (dae_jax.RadauIIA5(), None),
    "dummy derivatives": (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
}


@pytest.mark.parametrize(
    ("method", "setting"), [*((method, "promotion") for method in METHODS), ("projection", "transfers")]
)
def test_solves_and_derivatives(method, setting):
    solver, formulation = METHODS[method]
    t0, t1, y0 = jnp.asarray(0.0), jnp.asarray(0.5), (jnp.array([1.0, 0.0]), jnp.zeros(2))
    field, fields, one = jnp.asarray(9.81), jnp.array([9.0, 10.0]), jnp.asarray(1.0)
    solve = lambda g, **options: dae_jax.daesolve(
        SYSTEM, solver, t0, t1, None, y0, g, formulation=formulation, **options
    )
    end = lambda g, **options: jnp.sum(solve(g, **options).ys[0])
    forward = {"adjoint": diffrax.ForwardMode()}
    ask = {
        "batch of gradients": lambda: jax.jit(jax.vmap(jax.grad(end)))(fields),
        "forward": lambda: jax.jit(lambda g, d: jax.jvp(lambda g: end(g, **forward), (g,), (d,))[1])(field, one),
        "value": lambda: end(field),
    }
    # The same program by the same rules, whoever asks first.
    with SETTINGS[setting]():
        found = {name: fn() for name, fn in ask.items()}
    for name, fn in ask.items():
        np.testing.assert_allclose(found[name], fn(), rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("setting", SETTINGS)
def test_what_is_asked_of_a_system_and_a_solution(setting):
    t0, t1, guess = jnp.asarray(0.0), jnp.asarray(0.5), (jnp.array([1.1, 0.0]), jnp.zeros(2))
    field, half = jnp.asarray(9.81), jnp.asarray(0.25)
    solver, dense = METHODS["projection"][0], diffrax.SaveAt(t1=True, dense=True)
    with SETTINGS[setting]():
        y0 = dae_jax.consistent_state(SYSTEM, t0, guess, field)
        sol = dae_jax.daesolve(SYSTEM, solver, t0, t1, None, y0, field, saveat=dense)
        sol.evaluate(half)
        levels = dae_jax.drift(SYSTEM, sol).levels
        dae_jax.multipliers(SYSTEM, sol)
        assert dae_jax.explain(SYSTEM, solver, t0, y0, field).one_kernel
        assert dae_jax.analyse(SYSTEM, t0, y0, field).index == 3
    assert max(float(level.max()) for level in levels) < 1e-12
