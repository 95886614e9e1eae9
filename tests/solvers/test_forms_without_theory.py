"""Equations on which a solver of residuals need not converge are reformulated, or refused: no success without digits."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import SCENES


IMPLICIT = {"radau": dae_jax.RadauIIA5(), "bdf": dae_jax.BDF()}


def gear_petzold(eta):
    """Index 2; the null space of ∂F/∂ẏ turns with t. Every multistep formula and Radau IIA are unstable for some η (C. W. Gear,
    L. R. Petzold, SIAM J. Numer. Anal. 21 (1984), eq. 2.3). x₂ = e⁻ᵗ, x₁ = (1 − η t) e⁻ᵗ.
    """
    return dae_jax.ImplicitDAE(
        lambda t, y, yd, args: [
            yd[0] + eta * t * yd[1] + (1 + eta) * y[1],
            y[0] + eta * t * y[1] - jnp.exp(-t),
        ]
    )


def squared_multiplier():
    """Index 3, quadratic in the multiplier: ẏ = z, ż = u², 0 = y − eᵗ; u = e^(t/2)."""
    return dae_jax.SemiExplicitDAE(
        lambda t, x, u, args: jnp.stack([x[1], u[0] ** 2]), lambda t, x, u, args: x[:1] - jnp.exp(t)
    )


def solved(system, solver, y0, **options):
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    return dae_jax.daesolve(system, solver, 0.0, 2.0, None, y0, stepsize_controller=control, **options)


@pytest.mark.parametrize("solver", IMPLICIT)
@pytest.mark.parametrize("eta", [-2.0, -0.3, 1.0])
def test_a_null_space_that_turns(eta, solver):
    sol = solved(gear_petzold(eta), IMPLICIT[solver], jnp.ones(2))
    end = np.exp(-2.0)
    np.testing.assert_allclose(sol.ys[-1], [(1 - 2 * eta) * end, end], rtol=1e-7)
    with pytest.raises(ValueError, match=r"in combinations that change.*DummyDerivatives"):
        solved(gear_petzold(eta), IMPLICIT[solver], jnp.ones(2), formulation=dae_jax.Residual())


@pytest.mark.parametrize("solver", IMPLICIT)
def test_a_multiplier_that_enters_squared(solver):
    sol = solved(squared_multiplier(), IMPLICIT[solver], (jnp.ones(2), jnp.ones(1)))
    np.testing.assert_allclose(sol.ys[0][-1], np.exp([2.0, 2.0]), rtol=1e-7)
    np.testing.assert_allclose(sol.ys[1][-1], np.exp([1.0]), rtol=1e-6)


def test_an_index_beyond_the_method_is_refused_where_it_was_asked_for():
    scene = SCENES["jay"]()
    with pytest.raises(ValueError, match="converges for an index up to 2"):
        solved(scene.system, dae_jax.BDF(), scene.y0, formulation=dae_jax.Residual())
    pendulum = SCENES["pendulum"]()
    with pytest.raises(ValueError, match="converges for an index up to 2"):
        solved(pendulum.system, dae_jax.BDF(), pendulum.y0, formulation=dae_jax.Residual("index-3"))


def test_constant_coefficients_and_hessenberg_form_are_taken_as_they_are():
    """A capacitor between two nodes: fewer equations with derivatives than derivatives, in one combination."""
    for name in ("capacitor-loop", "hessenberg-2", "amplifier"):
        scene = SCENES[name]()
        plan = dae_jax.explain(scene.system, dae_jax.RadauIIA5(), 0.0, scene.y0, scene.args)
        assert plan.method == "Residual, RadauIIA5"
        plan = dae_jax.explain(scene.system, dae_jax.BDF(), 0.0, scene.y0, scene.args, formulation=dae_jax.Residual())
        assert plan.method == "Residual, BDF"
