"""python -m tests.break_formulas [NAME ...]: breaks one formula after the other, each in a copy of the tree, and says whether the
tests that are named with it fail.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path


ROOT = Path(__file__).parents[1]
# Of pytest: all passed, some failed.
PASSED, FAILED = 0, 1


@dataclasses.dataclass(frozen=True)
class Break:
    """A file of dae_jax, one piece of its text, what stands there instead, and the tests that should fail then, as pytest takes
    them.
    """

    path: str
    old: str
    new: str
    tests: str

    def missed(self) -> str | None:
        """What pytest says where no test fails."""
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder)
            for name in ("dae_jax", "tests"):
                shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
            shutil.copy(ROOT / "pyproject.toml", tree)
            broken = tree / "dae_jax" / self.path
            text = broken.read_text()
            assert text.count(self.old) == 1, f"{self.path} has {self.old!r} {text.count(self.old)} times"
            broken.write_text(text.replace(self.old, self.new))
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-x",
                "--no-header",
                "-p",
                "no:cacheprovider",
                *self.tests.split(),
            ]
            done = subprocess.run(
                command, cwd=tree, env={**os.environ, "PYTHONPATH": folder}, capture_output=True, text=True
            )
        assert done.returncode in (PASSED, FAILED), done.stdout + done.stderr
        return done.stdout if done.returncode == PASSED else None


def _order(method: str) -> str:
    return f"tests/solvers/test_methods.py::test_order_is_measured[{method}]"


_BACKWARDS = "tests/solvers/test_methods.py::test_backwards_in_time_with_a_constraint_that_depends_on_time"
_FORMULAS = "tests/equations/test_formulas.py"
_COEFFICIENTS = "tests/solvers/test_coefficients.py"

BREAKS = {
    # Formulations
    "Baumgarte: 2α": Break(
        "formulations/baumgarte.py", "2 * alpha, beta**2", "alpha, beta**2",
        f"{_FORMULAS}::test_baumgartes_polynomials",
    ),
    "Baumgarte: nonholonomic": Break(
        "formulations/baumgarte.py", "_product(polynomial, [1.0, alpha])", "_product(polynomial, [1.0, 2 * alpha])",
        f"{_FORMULAS}::test_baumgartes_polynomials",
    ),
    "Baumgarte: backwards in time": Break(
        "formulations/baumgarte.py", "self.alpha * jnp.asarray(sign", "self.alpha + 0 * jnp.asarray(sign",
        "tests/solvers/test_symmetries.py::test_time_may_be_shifted_and_reversed[baumgarte]",
    ),
    "state space: sign of the bias": Break(
        "formulations/state_space.py", "- apply(bias)", "+ apply(bias)",
        "tests/solvers/test_paper.py::test_accuracy_at_1e_10[double-pendulum-5.0-1e-07-state-space]",
    ),
    # Solvers
    "RATTLE: whole step": Break("solvers/rattle.py", "half = v0 + h / 2", "half = v0 + h", _order("rattle")),
    "RATTLE: the Jacobian at the start": Break(
        "solvers/rattle.py", "(q1, free), args.jacobian(t1_, (q1, free)))", "(q1, free), chart)", _order("rattle")
    ),
    "symmetric projection: −μ": Break(
        "solvers/symmetric_projection.py", "args.displace(end, args.jacobian(sign * t1, y1), mu)",
        "args.displace(end, args.jacobian(sign * t1, y1), -mu)",
        "tests/solvers/test_methods.py::test_symmetric_projection_goes_back_to_where_it_came_from",
    ),
    "chart: time of the stages backwards": Break(
        "solvers/chart_steps.py", "self.lift(sign * t, u, chart, ode)", "self.lift(t, u, chart, ode)",
        f"{_BACKWARDS}[solver1]",
    ),
    "roots: any that Newton's method finds": Break(
        "equations/structural_ode.py", "<= bend * length(mu) + amplified", "<= 1e9 * length(mu) + amplified",
        "tests/solvers/test_roots.py::test_the_end_is_on_the_root_of_the_start[joint-dop853]",
    ),
    "selection: the largest entry, however short it lasts": Break(
        "equations/state_selection.py", "STEPS * jnp.abs(end - start)", "0 * jnp.abs(end - start)",
        "tests/driver/test_mixed_units.py::test_states_and_charts_are_chosen_in_any_unit[bdf]",
    ),
    "Nearest points by the tolerances": Break(
        "equations/structural_ode.py", "is None else jacobian * self.metric", "is None else jacobian",
        "tests/driver/test_mixed_units.py::test_with_a_tolerance_for_each_unknown_units_do_not_count",
    ),
    "charts: rows of the Jacobian that turn": Break(
        "equations/structural_ode.py", "jnp.any(along > TURNS)", "jnp.any(along > 1e9)",
        "tests/driver/test_mixed_units.py::test_states_and_charts_are_chosen_in_any_unit[tangent]",
    ),
    "dense output: half a rate": Break(
        "driver/between_steps.py", "jnp.array([1, 2, 2, 1], h.dtype) / 6", "jnp.array([1, 2, 2, 1], h.dtype) / 12",
        "tests/solvers/test_derivatives_by_time.py::test_dense_output_moves_as_the_equations_say[tangent-1.0]",
    ),
    "resets: a state as good as exact": Break(
        "driver/reset_levels.py", "& (jnp.abs(t - self.t0) <= self.near)", "& (t == self.t0)",
        "tests/driver/test_jumps.py::test_one_crossing_is_one_reset[RadauIIA5-given-False]",
    ),
    "resets: at rest on the side that pulls": Break(
        "driver/reset_levels.py", "rests & (changed > 0)", "rests & (changed > 2)",
        "tests/driver/test_resets_from_rest.py::test_a_ball_that_a_reset_brings_to_rest_does_not_fall_through[projection-None]",
    ),
    "resets: from rest by the rate": Break(
        "equations/flow.py", "lax.fori_loop(0, ORDERS,", "lax.fori_loop(0, 0,",
        "tests/driver/test_resets_from_rest.py::test_a_condition_that_leaves_zero_from_rest[projection-2-None]",
    ),
    "projection: time backwards": Break(
        "solvers/orthogonal_projection.py", "args.project(sign * t, y)", "args.project(t, y)", f"{_BACKWARDS}[solver0]"
    ),
    "Gauss: node": Break("solvers/gauss.py", "3**0.5 / 6", "3**0.5 / 5", _order("gauss4")),
    "implicit stages: all at the end": Break(
        "solvers/implicit.py", "t0 + float(c) * (t1 - t0)", "t1", f"{_FORMULAS}::test_implicit_stages_have_their_own_times[gauss4]"
    ),
    "explicit stages: off by one": Break(
        "solvers/explicit.py", "ti = t1 if ci == 1 else t0 + float(ci) * (t1 - t0)", "ti = t0",
        f"{_FORMULAS}::test_explicit_stages_have_their_own_times",
    ),
    "trapezoidal rule: weights": Break(
        "solvers/trapezoid.py", "[1 / 2, 1 / 2]], [1 / 2, 1 / 2]", "[1 / 3, 2 / 3]], [1 / 3, 2 / 3]", _order("trapezoid")
    ),
    "midpoint rule: node": Break("solvers/midpoint.py", "[[1 / 2]]", "[[1 / 3]]", _order("midpoint")),
    "DOP853: the two estimates": Break(
        "solvers/dop853.py", "0.01 * three", "three", f"{_COEFFICIENTS}::TestDOP853::test_the_estimates_are_combined"
    ),
    "DOP853: interpolant": Break(
        "solvers/dop853.py", "2 * change - (first + last)", "2 * change - first",
        f"{_COEFFICIENTS}::TestDOP853::test_the_interpolant_has_order_seven",
    ),
    "DOP853: sign of a coefficient of E5": Break(
        "solvers/dop853_coefficients.py", "    -0.4957589496572502,", "    0.4957589496572502,",
        f"{_COEFFICIENTS}::TestDOP853::test_order_conditions",
    ),
    "Radau: embedded formula": Break(
        "solvers/radau_coefficients.py", "error=-polynomial[0]", "error=-polynomial[1]",
        f"{_COEFFICIENTS}::TestRadau::test_the_embedded_formula_has_the_order_of_the_stages",
    ),
    "Radau: complex matrix": Break(
        "solvers/radau_step.py", "pair.imag / self.h", "-pair.imag / self.h",
        f"{_COEFFICIENTS}::TestRadau::test_a_linear_step_takes_one_correction",
    ),
    "Radau: way between the steps": Break(
        "solvers/radau_step.py", "value = c + x * value", "value = c - x * value",
        "tests/solvers/test_radau.py::test_between_steps_the_solution_is_the_collocation_polynomial",
    ),
    "Radau: prediction of the stages": Break(
        "solvers/radau.py", "1 + float(c) * ratio", "float(c) * ratio",
        f"{_COEFFICIENTS}::TestRadau::test_stages_are_predicted_on_the_last_polynomial",
    ),
    "Radau: way between, by the step before": Break(
        "solvers/radau_error.py", "reach * (before - float(c))", "reach * (before + float(c))",
        f"{_COEFFICIENTS}::TestRadau::test_what_the_start_of_the_step_before_says_of_the_way_between",
    ),
    "Radau: nodes": Break(
        "solvers/radau_coefficients.py", "math.perm(s - 1 + k, s - 1)", "math.perm(s + k, s)",
        f"{_COEFFICIENTS}::TestRadau::test_digits_are_those_published",
    ),
    "weights of higher indices": Break(
        "equations/linearised.py", "np.maximum(indices - 1, 0)", "np.maximum(indices - 2, 0)",
        f"{_COEFFICIENTS}::TestWeights::test_the_errors_of_higher_indices_count_less",
    ),
    "BDF: leading coefficient": Break(
        "solvers/bdf.py", "jnp.where(j <= k, 1 / j, 0)", "jnp.where(j < k, 1 / j, 0)", f"{_COEFFICIENTS}::TestBDF"
    ),
    "BDF: error constants": Break(
        "solvers/bdf.py", "sigma[-1] * j * alpha[j]", "sigma[-1] * alpha[j]", f"{_COEFFICIENTS}::TestBDF"
    ),
    "BDF: prediction of the rate": Break(
        "solvers/bdf.py", "gamma[-1] + 1 / new[j - 1]", "gamma[-1] + 1 / old[j - 1]", f"{_COEFFICIENTS}::TestBDF"
    ),
    "BDF: way between the steps": Break(
        "solvers/bdf.py", "(self.psi[j - 1] if j else 0)", "self.psi[j]",
        "tests/solvers/test_bdf.py::test_between_steps_the_solution_is_as_accurate",
    ),
    # Equations
    "dummy derivatives: what is integrated": Break(
        "equations/index1_form.py", "integrated * ydot + jnp", "ydot + jnp",
        "tests/solvers/test_dummy_residuals.py::test_order_five",
    ),
    "nonholonomic rows: ∂h/∂v": Break(
        "equations/mechanical.py", "jax.jacfwd(self._nonholonomic, 2)", "jax.jacfwd(self._nonholonomic, 1)",
        f"{_FORMULAS}::test_rolling_is_a_constraint_of_velocities",
    ),
    "consistent state: fixed velocities": Break(
        "consistent.py", "shortest(a, mass, of_v, h", "shortest(a, mass, of_q, h",
        f"{_FORMULAS}::test_consistent_velocities_keep_what_is_fixed",
    ),
    "accelerations: sign of the bias": Break(
        "equations/mechanical.py", "self.linear.along(self, jacobian, free) + self.bias(t, q, v)",
        "self.linear.along(self, jacobian, free) - self.bias(t, q, v)", _order("differentiation"),
    ),
    "∂g/∂t dropped": Break(
        "equations/mechanical.py", "(jnp.ones_like(t), *direction)", "(jnp.zeros_like(t), *direction)", f"{_BACKWARDS}[solver0]"
    ),
    "displacement: velocities by μ of the positions": Break(
        "equations/mechanical.py", "v + self.linear.lift(self, jacobian, mu[m:])", "v + self.linear.lift(self, jacobian, mu[:m])",
        _order("projection-euler"),
    ),
    "M for M⁻¹": Break(
        "equations/constraint_jacobian.py", "return x / (mass[:, None]", "return x * (mass[:, None]",
        f"{_FORMULAS}::test_multipliers_of_unequal_masses",
    ),
    "M for M⁻¹, sparse": Break(
        "equations/sparse_constraint_jacobian.py", "return 1 / (jnp.broadcast_to", "return 1 * (jnp.broadcast_to",
        f"{_FORMULAS}::test_multipliers_of_unequal_masses",
    ),
    "residual: sign of λ": Break(
        "equations/residual_form.py", "ode.force(t, q, v) + pull(", "ode.force(t, q, v) - pull(",
        f"{_FORMULAS}::test_residual_forms_of_unequal_masses",
    ),
    "Taylor: no factorial": Break(
        "equations/taylor.py", "y[k - 1] + s / k * value", "y[k - 1] + s * value",
        f"{_FORMULAS}::test_nested_derivatives_are_taylors",
    ),
    # Linear algebra
    "substitution: off by one": Break(
        "linalg/dense.py", "for k in range(i + 1, n))) / rows[i][i]", "for k in range(i + 2, n))) / rows[i][i]",
        "tests/equations/test_linalg.py::TestSolve::test_equals_numpy",
    ),
    "implicit function: sign": Break(
        "linalg/newton.py", "dx = -linear_solve(", "dx = linear_solve(",
        "tests/equations/test_linalg.py -k first_and_second_derivatives",
    ),
    "elimination: sign": Break(
        "linalg/elimination.py", "eliminated = eliminated - f * take(x, neighbour)",
        "eliminated = eliminated + f * take(x, neighbour)",
        "tests/equations/test_linalg.py::TestElimination::test_equals_numpy[tree]",
    ),
    # Structure
    "index: algebraic variables": Break(
        "structure/sigma.py", "(1 if 0 in d else 0)", "0", "tests/structure/test_structure.py::test_published_offsets"
    ),
    "Pantelides: highest derivatives": Break(
        "structure/pantelides.py", "for variable in variables:\n            orders[variable] += 1",
        "for variable in variables:\n            orders[variable] += 2",
        "tests/structure/test_structure.py::test_sigma_method_and_pantelides_agree",
    ),
    "index of a variable": Break(
        "structure/sigma.py", "max(1 + top - variable_offsets[variable], 0)", "max(top - variable_offsets[variable], 0)",
        f"{_FORMULAS}::test_indices_of_a_mechanisms_variables",
    ),
    # Driver
    "adjoint: share of the start": Break(
        "driver/trajectory_adjoint.py", "return (1 - fraction) * cotangent", "return cotangent",
        "tests/driver/test_trajectory_adjoint.py::test_equals_diffrax_with_respect_to_everything",
    ),
    "jump: the wrong way from zero": Break(
        "driver/reset_levels.py", "sign * jnp.sign(then)), -before)", "-sign * jnp.sign(then)), -before)",
        "tests/driver/test_jumps.py::test_a_crossing_of_an_algebraic_variable_is_one_jump",
    ),
    "inverse dynamics: near a singular configuration": Break(
        "mechanisms/inverse_dynamics.py", "jnp.where(independent, tau, jnp.nan)", "tau",
        "tests/mechanisms/test_inverse_dynamics.py::test_a_singular_configuration_is_refused",
    ),
    "inverse dynamics: states off the path": Break(
        "mechanisms/inverse_dynamics.py", "if np.any(off):", "if False:",
        "tests/mechanisms/test_inverse_dynamics.py::test_states_that_are_off_the_path_are_refused",
    ),
    "times out of order have no state": Break(
        "driver/outcome.py", "return ~((ts >= low) & (ts <= high)) | back", "return ~((ts >= low) & (ts <= high))",
        "tests/driver/test_padding.py::test_a_time_that_is_out_of_order_or_before_the_start_has_no_state",
    ),
    "inverse dynamics: sign of what leads": Break(
        "mechanisms/inverse_dynamics.py", "-free @ (given[taken].T @ lam)", "free @ (given[taken].T @ lam)",
        "tests/mechanisms/test_inverse_dynamics.py::test_torques_are_those_of_lagrange_s_equations",
    ),
    # Studies and diagnostics
    "energy: ½": Break(
        "diagnostics.py", "jnp.dot(flat_v, momentum) / 2", "jnp.dot(flat_v, momentum)",
        f"{_FORMULAS}::test_energy_of_a_full_mass_matrix",
    ),
    "Lyapunov: per time": Break(
        "studies/reductions.py", "/ _norm(start)) / time", "/ _norm(start)) * time",
        "tests/studies/test_sweep.py -k lyapunov",
    ),
    "stiffness of α and β": Break(
        "studies/baumgarte_loss.py", '4 * params["alpha"] ** 2 + 2 *', '2 * params["alpha"] ** 2 + 2 *',
        f"{_FORMULAS}::test_stiffness_of_baumgartes_feedback",
    ),
    "descent: way back": Break(
        "studies/tune.py", "(point.z + best_z) / 2", "point.z + best_z / 2",
        "tests/studies/test_tune.py::test_holes_are_left_and_never_the_best",
    ),
    "regression: degrees of freedom": Break(
        "studies/identify.py", "free = r.size - jnp.sum(found.seen)", "free = r.size",
        "tests/studies/test_identify.py::test_of_a_linear_model_all_is_that_of_the_normal_equations",
    ),
    "regression: variance of a logarithm": Break(
        "studies/identify.py", "jnp.where(in_log, values, 1) / found.scale", "jnp.where(in_log, 1 / values, 1) / found.scale",
        "tests/studies/test_identify.py::test_certified_values_of_a_nonlinear_regression",
    ),
}  # fmt: skip


def main(names: list[str]) -> int:
    missed = 0
    for name in names or BREAKS:
        start = time.monotonic()
        said = BREAKS[name].missed()
        missed += said is not None
        print(f"{name}: {'found' if said is None else 'NOT FOUND'} ({time.monotonic() - start:.0f} s)", flush=True)
        print(said or "", end="", flush=True)
    print(f"{len(names or BREAKS) - missed} of {len(names or BREAKS)} found")
    return missed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
