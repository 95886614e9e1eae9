"""The coefficients of methods against the conditions that define them; error estimates and orders chosen by wrong ones would still
give right solutions, in too many steps or too few.
"""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.linearised import LinearisedResidual
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.solvers import bdf, dop853, dop853_coefficients as dop, radau as radau_solver, radau_coefficients as radau
from dae_jax.solvers.residual_steps import tolerances


def _step_of_dop853(field, h):
    """From 0, y₀ = 0."""
    term, y0 = diffrax.ODETerm(field), jnp.zeros(1)
    solver = dae_jax.DOP853()
    return solver.step(term, 0.0, h, y0, None, solver.init(term, 0.0, h, y0, None), False)


class TestDOP853:
    def test_order_conditions(self):
        """Of quadrature, Σ bᵢ cᵢᵏ = 1/(k + 1), and Σ bᵢ aᵢⱼ cⱼᵏ = 1/((k + 1)(k + 2)); the estimates vanish to their orders."""
        a, b, c = dop.A[:12, :12], dop.B, dop.C[:12]
        np.testing.assert_allclose(a.sum(1), c, atol=1e-14)
        for k in range(8):
            np.testing.assert_allclose(b @ c**k, 1 / (k + 1), rtol=1e-13)
        for k in range(7):
            np.testing.assert_allclose(b @ a @ c**k, 1 / ((k + 1) * (k + 2)), rtol=1e-12)
        for estimate, order in ((dop.E5[:12], 5), (dop.E3[:12], 3)):
            vanishing = [estimate @ c**k for k in range(order)]
            np.testing.assert_allclose(vanishing, 0, atol=1e-14)
            assert abs(estimate @ c**order) > 1e-4

    @pytest.mark.parametrize("degree", range(1, 8))
    def test_the_interpolant_has_order_seven(self, degree):
        h = 0.7
        y1, _, dense, *_ = _step_of_dop853(lambda t, y, args: jnp.full(1, degree * t ** (degree - 1)), h)
        between = dae_jax.DOP853.interpolation_cls(t0=0.0, t1=h, **dense)
        for t in (0.1, 0.35, 0.6):
            np.testing.assert_allclose(between.evaluate(t)[0], t**degree, atol=1e-14)
        np.testing.assert_allclose(y1[0], h**degree, rtol=1e-13)

    def test_the_estimates_are_combined(self):
        """|e₅|²/√(|e₅|² + 0.01 |e₃|²)."""
        e5, e3, y = np.array([3e-3]), np.array([-0.2]), np.zeros(1)
        expected = e5**2 / np.sqrt(e5**2 + 0.01 * e3**2)
        np.testing.assert_allclose(dop853._error(jnp.asarray(e5), jnp.asarray(e3), y, y), expected, rtol=1e-14)


class TestRadau:
    def test_simplifying_conditions(self):
        """B(5), C(3): Σ bᵢ cᵢᵏ⁻¹ = 1/k for k ≤ 5, Σ aᵢⱼ cⱼᵏ⁻¹ = cᵢᵏ/k for k ≤ 3."""
        a, c = radau.TABLEAU, radau.NODES
        for k in range(1, 6):
            np.testing.assert_allclose(a[2] @ c ** (k - 1), 1 / k, rtol=1e-14)
        for k in range(1, 4):
            np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=1e-14)

    def test_blocks(self):
        block = np.array([[radau.GAMMA, 0, 0], [0, radau.ALPHA, -radau.BETA], [0, radau.BETA, radau.ALPHA]])
        # The sign of β is that of the complex vector, which the transformation has.
        found = radau.BACK @ radau.INVERSE @ radau.TRANSFORM
        np.testing.assert_allclose(np.abs(found), np.abs(block), atol=1e-13)

    def test_the_embedded_formula_has_order_three(self):
        """h ẏ₀ + Σ eᵢ zᵢ = 0 for the powers of which it takes the derivative at 0, and not for the next."""
        residues = [(k == 1) + radau.ERROR @ radau.NODES**k for k in range(1, 5)]
        np.testing.assert_allclose(residues[:3], 0, atol=1e-13)
        assert abs(residues[3]) > 1e-2

    def test_a_linear_step_takes_one_correction(self):
        """Of simplified Newton, by the real and the complex system, against all stages at once: ẏ = L y + r."""
        rng = np.random.default_rng(6)
        rates, right, h = rng.normal(size=(3, 3)), rng.normal(size=3), 0.4
        system = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd - jnp.asarray(rates) @ y - jnp.asarray(right))
        y0 = jnp.asarray(rng.normal(size=3))
        form = ResidualForm.of(system, 0.0, y0, None)
        step = radau_solver._Step(LinearisedResidual.of(form, y0), 1.0, jnp.asarray(0.0), jnp.asarray(h), y0)
        tol = tolerances(1e-8, 1e-8, y0.dtype)
        factors, _ = step.factor(step.jacobians(0.0, y0, y0), tol)
        z = step.correction(factors, step.residuals(jnp.zeros((3, 3))))
        stages = np.linalg.solve(
            np.kron(radau.INVERSE / h, np.eye(3)) - np.kron(np.eye(3), rates), np.tile(rates @ y0 + right, 3)
        )
        np.testing.assert_allclose(np.ravel(z), stages, rtol=1e-10)

    def test_stages_are_predicted_on_the_last_polynomial(self):
        """A cubic goes on as it is in a step of another size."""
        cubic, h, new = np.polynomial.Polynomial([0.0, 1.0, -0.4, 0.3]), 0.5, 0.2
        last = radau_solver._State(jnp.asarray(cubic(h * radau.NODES)[:, None]), jnp.asarray(h), *[None] * 6)
        expected = cubic(h + new * radau.NODES) - cubic(h)
        np.testing.assert_allclose(radau_solver._predicted(last, new)[:, 0], expected, rtol=1e-13)

    def test_the_errors_of_higher_indices_count_less(self):
        """By h^(k−1); the pendulum's q, v and λ have the indices 1, 2 and 3."""
        system, h = dae_jax.scenes.pendulum().system, 0.1
        y0 = (jnp.array([0.6, 0.8]), jnp.zeros(2))
        form = ResidualForm.of(system, 0.0, y0, None)
        linearised = LinearisedResidual.of(form, form.encode(y0))
        np.testing.assert_allclose(linearised.weights(h), [1, 1, h, h, h**2])


class TestBDF:
    def _state(self, order, psi, phi):
        filled = np.zeros((5, 1))
        filled[: len(phi), 0] = phi
        start = bdf._start(jnp.zeros(1), None)
        return start._replace(
            phi=jnp.asarray(filled), psi=jnp.asarray(psi), steps=jnp.asarray(9), order=jnp.asarray(order)
        )

    @pytest.mark.parametrize("k", range(1, 6))
    def test_of_equal_steps(self, k):
        """c = Σ 1/j h⁻¹; the error of order j is y − y* over j + 1."""
        h = 0.3
        found = bdf._formula(self._state(k, h * np.arange(1.0, 7), []), jnp.asarray(h))
        harmonic = np.cumsum(1 / np.arange(1, 6))
        np.testing.assert_allclose(found.beta, 1, rtol=1e-14)
        np.testing.assert_allclose(found.gamma, np.append(0, harmonic) / h, rtol=1e-14)
        np.testing.assert_allclose(found.c, harmonic[k - 1] / h, rtol=1e-14)
        np.testing.assert_allclose(found.sigma, 1 / np.arange(1, 7), rtol=1e-14)
        np.testing.assert_allclose(found.tail, 1 / (k + 1), rtol=1e-14)

    def test_of_unequal_steps_a_polynomial_is_predicted(self):
        """y* and ẏ* of a cubic through its points at unequal distances."""
        cubic = np.polynomial.Polynomial([0.3, -1.0, 0.7, 0.4])
        before, h = np.array([0.0, 0.3, 0.4, 0.9, 1.1, 1.6, 1.7]), 0.25
        differences, phi = cubic(-before), [cubic(0)]
        for j in range(1, 4):
            differences = np.diff(differences) / -(before[j:] - before[:-j])
            phi.append(differences[0] * np.prod(before[1 : j + 1]))
        found = bdf._formula(self._state(3, before[1:], phi[1:]), jnp.asarray(h))
        star = np.array(found.beta[:4]) * phi
        np.testing.assert_allclose(star.sum(), cubic(h), rtol=1e-13)
        np.testing.assert_allclose(np.array(found.gamma[:4]) @ star, cubic.deriv()(h), rtol=1e-13)
        np.testing.assert_allclose(found.psi, np.append(h, before[1:6] + h), rtol=1e-14)
