"""Formulas that no solve of an ordinary scene shows, each against numpy or a closed form; `tests/break_formulas.py` breaks them."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.linearised import LinearisedResidual
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.equations.taylor import _nested, total_derivatives
from dae_jax.scenes import moving_pivot_pendulum
from dae_jax.studies.baumgarte_loss import baumgarte_loss


def test_baumgartes_polynomials():
    """2α ġ + β² g; α h; and (d² + 2α d + β²)(d + α) less its highest derivative."""
    feedback = dae_jax.Baumgarte(3.0, 5.0)
    g, dg, ddg = 7.0, 11.0, 13.0
    assert feedback(jnp.array([g])) == 3 * g
    assert feedback(jnp.array([g]), jnp.array([dg])) == 25 * g + 6 * dg
    assert feedback(jnp.array([g]), jnp.array([dg]), jnp.array([ddg])) == 75 * g + (25 + 18) * dg + 9 * ddg


@pytest.mark.parametrize(("solver", "order"), [(dae_jax.Gauss4(), 4), (dae_jax.RATTLE(), 2)], ids=["gauss4", "rattle"])
def test_implicit_stages_have_their_own_times(solver, order):
    """The constraint depends on time."""
    scene, errors = moving_pivot_pendulum(), []
    for steps in (20, 40):
        sol = dae_jax.daesolve(scene.system, solver, 0.0, 1.0, 1.0 / steps, scene.y0)
        errors.append(scene.error(np.array([1.0]), sol.ys))
    assert np.log2(errors[0] / errors[1]) > order - 0.3


def test_explicit_stages_have_their_own_times():
    scene, errors = moving_pivot_pendulum(), []
    for steps in (20, 40):
        sol = dae_jax.daesolve(scene.system, diffrax.Tsit5(), 0.0, 1.0, 1.0 / steps, scene.y0)
        errors.append(scene.error(np.array([1.0]), sol.ys))
    assert np.log2(errors[0] / errors[1]) > 4.5


@pytest.mark.parametrize("links", [2, 4, 9])
@pytest.mark.parametrize("shape", ["vector", "shape of q", "matrix"])
def test_multipliers_of_unequal_masses(links, shape):
    """Of a chain, dense and sparse, against (A M⁻¹Aᵀ) λ = A M⁻¹f + γ in numpy."""
    rng = np.random.default_rng(links)
    q = np.cumsum(rng.normal(size=(links, 2)), 0)
    v, masses, f = rng.normal(size=(links, 2)), rng.uniform(0.5, 5, links).repeat(2), rng.normal(size=(links, 2))
    spans, rates = np.diff(q, axis=0, prepend=0), np.diff(v, axis=0, prepend=0)
    lengths = np.sum(spans**2, 1)
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.asarray(f),
        lambda t, q, args: (jnp.sum(jnp.diff(q, axis=0, prepend=0) ** 2, 1) - lengths) / 2,
        {"vector": masses, "shape of q": masses.reshape(q.shape), "matrix": np.diag(masses)}[shape],
    )
    difference = np.eye(links) - np.eye(links, k=-1)
    jacobian = np.einsum("mn,md->mnd", difference, spans).reshape(links, -1)
    gram = jacobian / masses @ jacobian.T
    # One velocity has no need to satisfy the constraints for the formula to hold.
    expected = np.linalg.solve(gram, jacobian @ (f.ravel() / masses) + np.sum(rates**2, 1))
    np.testing.assert_allclose(dae_jax.multipliers(system, 0.0, q, v), expected, rtol=1e-9)


@pytest.mark.parametrize("form", ["index-3", "index-2", "GGL"])
def test_residual_forms_of_unequal_masses(form):
    """At any q, v, λ, η and rates, against numpy: a force, a constraint and its rate that depend on time, a full mass matrix."""
    rng = np.random.default_rng(5)
    root, t, (q, v, qd, vd) = rng.normal(size=(3, 3)), 0.3, rng.normal(size=(4, 3))
    mass, f, normal = root @ root.T + np.eye(3), rng.normal(size=3), q + np.array([0, 0, 2])
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: t * jnp.asarray(f) - v,
        lambda t, q, args: (jnp.sum(q**2) + 4 * q[2] - 1 - t**3) / 2,
        mass,
    )
    y, yd = np.concatenate([q, v, [0.7]]), np.concatenate([qd, vd, [0.0]])
    if form == "GGL":
        y, yd = np.append(y, 0.9), np.append(yd, 0.0)
    g, rate = (q @ q + 4 * q[2] - 1 - t**3) / 2, normal @ v - 3 * t**2 / 2
    momentum = mass @ vd - (t * f - v) + 0.7 * normal
    expected = {
        "index-3": [qd - v, momentum, [g]],
        "index-2": [qd - v, momentum, [rate]],
        "GGL": [mass @ (qd - v) + 0.9 * normal, momentum, [rate], [g]],
    }[form]
    found = ResidualForm.of(system, t, (q, v), None, form)
    np.testing.assert_allclose(found.residual(t, y, yd), np.concatenate(expected), rtol=1e-13)
    # The multiplier that a solve starts with balances the momentum: n·v̇ + v·v − 3 t = 0 and M v̇ + n λ = t f − v.
    bordered = np.block([[mass, normal[:, None]], [normal, np.zeros(1)]])
    acceleration = np.linalg.solve(bordered, [*(t * f - v), 3 * t - v @ v])[:3]
    start, at = found.at_start(t, (q, v))
    rates = np.concatenate([qd, acceleration, np.zeros(len(at) - 6)])
    np.testing.assert_allclose(start.residual(t, at, rates)[3:6], 0, atol=1e-12)


def test_rolling_is_a_constraint_of_velocities():
    """h = v₀ q₁ − v₁ (1 + q₀²), M v̇ = f − hᵥᵀμ, hᵥ v̇ = −(hᵩ v): μ against numpy."""
    masses, f = np.array([2.0, 5.0]), np.array([1.0, -3.0])
    q, v = np.array([0.4, 0.7]), np.array([1.16, 0.7])
    rolling = lambda t, q, v, args: v[0] * q[1] - v[1] * (1 + q[0] ** 2)
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.asarray(f), None, masses, nonholonomic=rolling)
    row = np.array([q[1], -(1 + q[0] ** 2)])
    bias = -v[1] * 2 * q[0] * v[0] + v[0] * v[1]
    expected = (row @ (f / masses) + bias) / (row @ (row / masses))
    np.testing.assert_allclose(dae_jax.multipliers(system, 0.0, q, v), [expected], rtol=1e-13)


def test_consistent_velocities_keep_what_is_fixed():
    """On the circle with v₀ kept, v₁ follows from q·v = 0; with none kept, v is moved by M⁻¹q."""
    q, v, masses = np.array([0.6, 0.8]), np.array([1.0, 2.0]), np.array([1.0, 4.0])
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: 0 * q, lambda t, q, args: (jnp.sum(q**2) - 1) / 2, masses)
    kept = np.array([True, False])
    _, found = dae_jax.consistent_state(system, 0.0, (q, v), fixed=(np.zeros(2, bool), kept))
    np.testing.assert_allclose(found, [1.0, -0.75], rtol=1e-12)
    _, nearest = dae_jax.consistent_state(system, 0.0, (q, v))
    normal = q / masses
    np.testing.assert_allclose(nearest, v - normal * (q @ v) / (q @ normal), rtol=1e-12)


def test_nested_derivatives_are_taylors():
    """Along y = y₀ + s ẏ + s²/2 ÿ + s³/6 y⃛: what takes the place of Taylor arithmetic gives the same."""
    residual = lambda t, y, yd: jnp.stack([y[0] * yd[1] + t * y[1] ** 2, jnp.exp(y[0]) - yd[0] ** 2])
    t, y = jnp.asarray(0.7), [jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(4, 2))]
    for by_taylor, nested in zip(total_derivatives(residual, t, y, 3), _nested(residual, t, y, 3), strict=True):
        np.testing.assert_allclose(nested, by_taylor, rtol=1e-12)


def test_indices_of_a_mechanisms_variables():
    """The pendulum's q, v and λ have the indices 1, 2 and 3."""
    pendulum = lambda t, y, yd, args: jnp.stack(
        [yd[0] - y[2], yd[1] - y[3], yd[2] + y[4] * y[0], yd[3] + y[4] * y[1] - 9.81, y[0] ** 2 + y[1] ** 2 - 1]
    )
    y = jnp.array([1.0, 0.0, 0.0, 0.0, 0.0])
    found = LinearisedResidual.of(ResidualForm.of(dae_jax.ImplicitDAE(pendulum), 0.0, y, None), y)
    assert found.structure.indices == (1, 1, 2, 2, 3)


def test_energy_of_a_full_mass_matrix():
    """½ vᵀM v + V of what is saved, in numpy."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(2, 2))
    mass = root @ root.T + np.eye(2)
    force = lambda t, q, v, args: jnp.array([0.0, 9.81])
    constraint = lambda t, q, args: (jnp.sum(q**2) - 1) / 2
    system = dae_jax.ConstrainedSystem(force, constraint, mass, potential=lambda q, args: -9.81 * q[1])
    y0 = np.array([0.6, 0.8]), np.array([0.8, -0.6])
    sol = dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 0.2, 0.05, y0, saveat=diffrax.SaveAt(ts=np.array([0.0, 0.2])))
    q, v = map(np.asarray, sol.ys)
    np.testing.assert_allclose(
        dae_jax.energy(system, sol), np.einsum("ti,ij,tj->t", v, mass, v) / 2 - 9.81 * q[:, 1], rtol=1e-13
    )


def test_stiffness_of_baumgartes_feedback():
    """dt0 times the Frobenius norm of [[0, β], [−β, −2α]]."""
    scene = dae_jax.scenes.pendulum()
    parts = baumgarte_loss(scene.system, scene.y0, 0.5, dt0=0.05, times=8).parts({"alpha": 3.0, "beta": 5.0})
    np.testing.assert_allclose(parts.stiffness, 0.05 * np.linalg.norm([[0, 5], [-5, -6]]), rtol=1e-14)
