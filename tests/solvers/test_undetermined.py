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


# Index 1 up to a fold, where ∂g/∂z = 0 and the solution ends: x' = 1 from z = 2 at t = 4/3, and x' = −z at 3/2 − ln 2.
FOLDS = {
    "fold": (lambda t, x, z, a: jnp.ones(1), lambda t, x, z, a: z - z**3 / 3 - x, (-2 / 3, 2.0), 1.6),
    "van der Pol": (lambda t, x, z, a: -z, lambda t, x, z, a: x - z**3 / 3 + z, (2 / 3, 2.0), 1.2),
}
EXPLICIT = {
    "DOP853": dae_jax.DOP853(),
    "Tsit5": diffrax.Tsit5(),
    "projection of DOP853": dae_jax.OrthogonalProjection(dae_jax.DOP853()),
    "projection of Tsit5": dae_jax.OrthogonalProjection(diffrax.Tsit5()),
    "tangent space": dae_jax.TangentSpace(diffrax.Tsit5()),
}


def over(f, g, start, t1, solver, rtol):
    y0 = tuple(jnp.array([x]) for x in start)
    controller = diffrax.PIDController(rtol=rtol, atol=rtol)
    sol = dae_jax.daesolve(
        dae_jax.SemiExplicitDAE(f, g), solver, 0.0, t1, None, y0, stepsize_controller=controller, throw=False
    )
    return sol.result._value, sol.stats["doubts"]


@pytest.mark.parametrize("method", EXPLICIT)
@pytest.mark.parametrize("case", FOLDS)
def test_a_fold_is_not_passed_without_a_word(case, method):
    """Also at coarse tolerances, at which a step leaps over it, or the answer is off the equation."""
    run = jax.jit(jax.vmap(lambda rtol: over(*FOLDS[case], EXPLICIT[method], rtol)))
    tolerances = [1e-4, 1e-5, 1e-6] if (case, method) == ("van der Pol", "tangent space") else [1e-3, 1e-4, 1e-6]
    codes, doubts = map(np.asarray, run(np.array(tolerances)))
    assert ((codes != RESULTS.successful._value) | (doubts != 0)).all()
    assert codes[-1] != RESULTS.successful._value


def test_two_folds_at_once_are_seen():
    """The determinant of both together keeps its sign."""
    _, g, (x, z), t1 = FOLDS["fold"]
    y0 = jnp.full(2, x), jnp.full(2, z)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: jnp.ones(2), g)
    solver, controller = EXPLICIT["projection of Tsit5"], diffrax.PIDController(rtol=1e-3, atol=1e-3)
    with pytest.warns(dae_jax.AccuracyWarning, match="has passed a configuration"):
        dae_jax.daesolve(system, solver, 0.0, t1, None, y0, stepsize_controller=controller)


@pytest.mark.parametrize("method", EXPLICIT)
def test_what_stays_regular_is_not_doubted(method):
    """A matrix that turns, by more than a right angle in all: rotations have the determinant 1."""

    def g(t, x, z, a):
        c, s = jnp.cos(9 * t), jnp.sin(9 * t)
        return jnp.stack([c * z[0] - s * z[1] + c * x[0], s * z[0] + c * z[1] + s * x[0]])

    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z[:1] + z[1:], g)
    sol = dae_jax.daesolve(system, EXPLICIT[method], 0.0, 1.0, None, (jnp.ones(1), jnp.array([-1.0, 0.0])))
    assert sol.stats["doubts"] == 0
    np.testing.assert_allclose(sol.ys[0][-1], np.exp(-1), rtol=1e-5)
