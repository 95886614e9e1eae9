"""Equations that come to say the same on the way: what they leave open is no number, also where their residual stays 0."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import RESULTS, ImplicitDAE
from dae_jax.scenes import amplifier


SUM = lambda x, u, v: u + 0.3 * v - x

# x' = −x, and two equations in u and v that are one from t = 1 on.
CASES = {
    "twice": lambda t, y, yd, args: jnp.stack(
        [yd[0] + y[0], SUM(*y), jnp.where(t < 1, y[1] - y[2], 0.7 * SUM(*y))],
    ),
    "fades": lambda t, y, yd, args: jnp.stack(
        [yd[0] + y[0], SUM(*y), jnp.maximum(1 - t, 0) ** 2 * (y[1] - y[2])],
    ),
    "feeds back": lambda t, y, yd, args: jnp.stack(
        [yd[0] + y[0] - y[1], SUM(*y), jnp.where(t < 1, y[1] - y[2], 0.7 * SUM(*y))],
    ),
}  # fmt: skip
START = jnp.array([1.0, 1 / 1.3, 1 / 1.3])
METHODS = {
    "radau": (dae_jax.RadauIIA5(), None),
    "radau9": (dae_jax.RadauIIA9(), None),
    "bdf": (dae_jax.BDF(), None),
    "radau-dummy": (dae_jax.RadauIIA5(), dae_jax.DummyDerivatives()),
    "bdf-dummy": (dae_jax.BDF(), dae_jax.DummyDerivatives()),
    "dop853-dummy": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    "projection": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
}


def solve(residual, method, t1=3.0, rtol=1e-6, **options):
    solver, formulation = METHODS[method]
    return dae_jax.daesolve(
        ImplicitDAE(residual), solver, 0.0, t1, None, START, formulation=formulation, throw=False, max_steps=2000,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), **options,
    )  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", CASES)
def test_is_no_success(case, method):
    run = jax.jit(jax.vmap(lambda rtol: (lambda sol: (sol.result._value, sol.stats["end_time"]))(
        solve(CASES[case], method, rtol=rtol)
    )))  # fmt: skip
    codes, ends = run(np.array([1e-3, 1e-4, 1e-6, 1e-8]))
    assert RESULTS.successful._value not in codes.tolist()
    # A solver of residuals ends where it happens, but for one step.
    if not isinstance(METHODS[method][0], dae_jax.RadauIIA5 | dae_jax.BDF):
        return
    assert (np.asarray(ends) < 3).all()
    assert ends[-1] < 1.3


@pytest.mark.parametrize("method", METHODS)
def test_before_that_it_is_one(method):
    sol = solve(CASES["twice"], method, t1=0.9)
    assert sol.result == RESULTS.successful
    np.testing.assert_allclose(sol.ys[-1], np.exp(-0.9) * START, atol=1e-5)


def test_says_which_and_what():
    with pytest.raises(RuntimeError, match="singular") as error:
        dae_jax.daesolve(ImplicitDAE(CASES["twice"]), dae_jax.RadauIIA5(), 0.0, 3.0, None, START)
    assert "residual[1], residual[2] do not determine y[1], y[2]" in str(error.value)
    with pytest.raises(RuntimeError, match="do not determine all unknowns"):
        dae_jax.daesolve(
            ImplicitDAE(CASES["twice"]), dae_jax.DOP853(), 0.0, 3.0, None, START, formulation=dae_jax.DummyDerivatives()
        )


def test_a_matrix_that_turns_over_is_none_of_these():
    """u = x, then −u = x: the sign of the determinant changes, and every state is determined."""
    switched = lambda t, y, yd, args: jnp.stack([yd[0] + y[0], jnp.where(t < 1, y[1], -y[1]) - y[0]])
    for method in METHODS:
        solver, formulation = METHODS[method]
        sol = dae_jax.daesolve(
            ImplicitDAE(switched), solver, 0.0, 2.0, None, jnp.ones(2), formulation=formulation,
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        )  # fmt: skip
        np.testing.assert_allclose(sol.ys[-1], np.exp(-2.0) * np.array([1, -1]), atol=1e-4)


def test_newton_leaves_no_equation_unsolved_in_which_derivatives_cancel():
    """BDF got stuck at one in ten of these tolerances: an equation that follows from two in which the same current is large was
    off by more than the tolerance, which no smaller step mends.
    """
    scene = amplifier()

    def run(tolerance):
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        sol = dae_jax.daesolve(
            scene.system, dae_jax.BDF(), 0.0, 0.1, None, scene.y0, stepsize_controller=control, throw=False
        )
        return sol.result._value

    codes = jax.jit(jax.vmap(run))(1e-4 * np.exp(np.linspace(-1, 1, 200)))
    np.testing.assert_array_equal(codes, RESULTS.successful._value)
