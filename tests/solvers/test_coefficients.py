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
from dae_jax.solvers import bdf, dop853, dop853_coefficients as dop, radau, radau_error
from dae_jax.solvers.radau_coefficients import coefficients
from dae_jax.solvers.radau_step import Step, along
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


# Nodes below 1, e, γ and α + iβ of the program RADAU (E. Hairer, G. Wanner), and of RADAU5 with √6.
ROOT = 6**0.5
PUBLISHED = {
    3: (
        [(4 - ROOT) / 10, (4 + ROOT) / 10],
        [-(13 + 7 * ROOT) / 3, (-13 + 7 * ROOT) / 3, -1 / 3],
        3 - 3 ** (1 / 3) + 3 ** (2 / 3),
        [3 + (3 ** (1 / 3) - 3 ** (2 / 3)) / 2 + 1j * (3 ** (1 / 3) + 3 ** (2 / 3)) * 3**0.5 / 2],
    ),
    5: (
        [0.5710419611451768e-1, 0.2768430136381238, 0.5835904323689168, 0.8602401356562194],
        [-27.78093394406463, 3.641478498049213, -1.252547721169119, 0.5920031671845428, -0.2],
        6.286704751729277,
        [3.655694325463572 + 6.543736899360077j, 5.700953298671789 + 3.210265600308550j],
    ),
    7: (
        [
            0.2931642715978489e-1, 0.1480785996684843, 0.3369846902811543,
            0.5586715187715501, 0.7692338620300545, 0.9269456713197411,
        ],
        [
            -54.37443689412861, 7.000024004259187, -2.355661091987557, 1.132289066106134, -0.6468913267673587,
            0.3875333853753524, -1 / 7,
        ],
        8.936832788405216,
        [
            4.378693561506806 + 10.16969328379501j, 7.141055219187640 + 6.623045922639276j,
            8.511834825102946 + 3.281013624325059j,
        ],
    ),
}  # fmt: skip


def last_step(z, h, rate):
    """What a step of that size has left, of one unknown."""
    return radau.RadauState(jnp.asarray(z)[:, None], jnp.asarray(h), jnp.full(1, rate), *[None] * 6)


def next_step(method, h):
    return radau.Step(method, None, 1, jnp.asarray(0.0), jnp.asarray(h), jnp.zeros(1))


@pytest.mark.parametrize(
    "method", [coefficients(stages) for stages in PUBLISHED], ids=lambda method: f"{method.stages} stages"
)
class TestRadau:
    def test_digits_are_those_published(self, method):
        nodes, error, gamma, pairs = PUBLISHED[method.stages]
        np.testing.assert_allclose(method.nodes, [*nodes, 1], rtol=3e-16)
        np.testing.assert_allclose(method.error, error, rtol=2e-15)
        np.testing.assert_allclose([method.gamma, *method.pairs], [gamma, *pairs], rtol=1e-12)

    def test_simplifying_conditions(self, method):
        """B(2s − 1), C(s), D(s − 1) for Σ bᵢ cᵢᵏ⁻¹ = 1/k, Σ aᵢⱼ cⱼᵏ⁻¹ = cᵢᵏ/k, Σ bᵢ cᵢᵏ⁻¹ aᵢⱼ = bⱼ (1 − cⱼᵏ)/k."""
        a, c, s = method.tableau, method.nodes, method.stages
        b = a[-1]
        for k in range(1, 2 * s):
            np.testing.assert_allclose(b @ c ** (k - 1), 1 / k, rtol=1e-14)
        for k in range(1, s + 1):
            np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=1e-12, atol=1e-15)
        for k in range(1, s):
            np.testing.assert_allclose((b * c ** (k - 1)) @ a, b * (1 - c**k) / k, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(a @ method.inverse, np.eye(s), atol=1e-13)

    def test_blocks(self, method):
        block = np.zeros((method.stages, method.stages))
        block[0, 0] = method.gamma
        for k, pair in enumerate(method.pairs):
            block[2 * k + 1 : 2 * k + 3, 2 * k + 1 : 2 * k + 3] = [[pair.real, -pair.imag], [pair.imag, pair.real]]
        # The sign of β is that of the complex vector, which the transformation has.
        found = method.back @ method.inverse @ method.transform
        np.testing.assert_allclose(np.abs(found), np.abs(block), atol=1e-11)

    def test_the_embedded_formula_has_the_order_of_the_stages(self, method):
        """h ẏ₀ + Σ eᵢ zᵢ = 0 for the powers of which it takes the derivative at 0, and not for the next."""
        residues = [(k == 1) + method.error @ method.nodes**k for k in range(1, method.stages + 2)]
        np.testing.assert_allclose(residues[:-1], 0, atol=1e-13)
        np.testing.assert_allclose(np.abs(residues[-1]), np.prod(method.nodes), rtol=1e-9)

    def test_the_way_between_the_nodes(self, method):
        """The polynomial that is 0 at 0, its value there without that condition, and its largest error."""
        s, c = method.stages, method.nodes
        power, places = c**s, np.linspace(0, 1, 7)
        np.testing.assert_allclose([along(jnp.asarray(power[:, None]), x)[0] for x in places], places**s, atol=1e-11)
        np.testing.assert_allclose(method.at_start @ power, np.prod(c), rtol=1e-10)
        fine = np.linspace(0, 1, 2000)
        np.testing.assert_allclose(method.between, np.abs(fine * np.prod(fine[:, None] - c, 1)).max(), rtol=1e-5)

    def test_a_linear_step_takes_one_correction(self, method):
        """Of simplified Newton, by the real and the complex systems, against all stages at once: ẏ = L y + r."""
        rng = np.random.default_rng(6)
        rates, right, h = rng.normal(size=(3, 3)), rng.normal(size=3), 0.4
        system = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd - jnp.asarray(rates) @ y - jnp.asarray(right))
        y0 = jnp.asarray(rng.normal(size=3))
        form = ResidualForm.of(system, 0.0, y0, None)
        step = Step(method, LinearisedResidual.of(form, y0), 1.0, jnp.asarray(0.0), jnp.asarray(h), y0)
        tol = tolerances(1e-8, 1e-8, y0.dtype)
        factors = step.factor(step.jacobians(0.0, y0, y0), tol)
        z = step.correction(factors, step.residuals(jnp.zeros((method.stages, 3))))
        stages = np.linalg.solve(
            np.kron(method.inverse / h, np.eye(3)) - np.kron(np.eye(method.stages), rates),
            np.tile(rates @ y0 + right, method.stages),
        )
        np.testing.assert_allclose(np.ravel(z), stages, rtol=1e-9)

    def test_stages_are_predicted_on_the_last_polynomial(self, method):
        """A cubic goes on as it is in a step of another size."""
        cubic, h, new = np.polynomial.Polynomial([0.0, 1.0, -0.4, 0.3]), 0.5, 0.2
        last = last_step(cubic(h * method.nodes), h, cubic.deriv()(h))
        expected = cubic(h + new * method.nodes) - cubic(h)
        found = radau._predicted(next_step(method, new), last)[:, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)

    def test_a_polynomial_of_high_degree_is_not_continued_far(self, method):
        """By three stages into any step that diffrax makes next; by more where noise stays noise, and farther along the rates."""
        noise = np.where(np.arange(method.stages) % 2, 1e-12, -1e-12)
        for ratio in (0.5, 1.2, 10.0):
            still, moving = (
                radau._predicted(next_step(method, ratio), last_step(noise, 1.0, rate))[:, 0] for rate in (0.0, 0.1)
            )
            assert np.max(np.abs(still)) < 1e-6
            continued = ratio < 10 or method.stages == 3
            assert np.any(np.asarray(still) != 0) == continued
            expected = still if continued else 0.1 * ratio * method.nodes
            np.testing.assert_allclose(moving, expected, rtol=1e-14)

    def test_what_the_start_of_the_step_before_says_of_the_way_between(self, method):
        """All of the error for a power one higher than the polynomial takes."""
        s, h, before = method.stages, 0.5, 0.8
        power = lambda x: (x + before) ** (s + 1) - before ** (s + 1)
        last = np.polynomial.Polynomial([*[0.0] * (s + 1), 1.0])(before * method.nodes)
        state = radau.RadauState(jnp.asarray(last[:, None]), jnp.asarray(before), *[None] * 7)
        found = radau_error._between(method, state, jnp.asarray(h), jnp.asarray(power(h * method.nodes)[:, None]))
        np.testing.assert_allclose(np.abs(found), method.between * h ** (s + 1), rtol=1e-8)


class TestWeights:
    def test_the_errors_of_higher_indices_count_less(self):
        """By h^(k−1); the pendulum's q, v and λ have the indices 1, 2 and 3."""
        system, h = dae_jax.scenes.pendulum().system, 0.1
        y0 = (jnp.array([0.6, 0.8]), jnp.zeros(2))
        form = ResidualForm.of(system, 0.0, y0, None)
        linearised = LinearisedResidual.of(form, form.encode(y0))
        np.testing.assert_allclose(linearised.weights(h), [1, 1, h, h, h**2])


class TestBDF:
    def _formula(self, order, psi, h):
        return bdf._formula(jnp.asarray(order), jnp.asarray(False), jnp.asarray(psi), jnp.asarray(h))

    @pytest.mark.parametrize("k", range(1, 6))
    def test_of_equal_steps(self, k):
        """c = Σ 1/j h⁻¹; the error of order j is y − y* over j + 1."""
        h = 0.3
        found = self._formula(k, h * np.arange(1.0, 7), h)
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
        found = self._formula(3, before[1:], h)
        star = np.array(found.beta[:4]) * phi
        np.testing.assert_allclose(star.sum(), cubic(h), rtol=1e-13)
        np.testing.assert_allclose(np.array(found.gamma[:4]) @ star, cubic.deriv()(h), rtol=1e-13)
        np.testing.assert_allclose(found.psi, np.append(h, before[1:6] + h), rtol=1e-14)
