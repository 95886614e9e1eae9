"""Steps over a point at which the equations do not determine the highest derivatives, by methods that solve them as they are written."""

import itertools
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax as D
from dae_jax.driver.passages import _Slope
from dae_jax.equations import leading, residual_form


PASSED = 8
SOLVERS = {"RadauIIA5": D.RadauIIA5(), "RadauIIA9": D.RadauIIA9(), "Radau": D.Radau(), "BDF": D.BDF()}


def doubted(residual: Any, solver: Any, t1: float, y0: Any, rtol: float = 1e-3, **options: Any) -> bool:
    """Whether a solve passes with a word, or does not pass."""
    sol = D.daesolve(
        D.ImplicitDAE(residual), solver, 0.0, t1, None, jnp.asarray(y0), throw=False,
        stepsize_controller=diffrax.PIDController(rtol, rtol), **options,
    )  # fmt: skip
    return bool(sol.stats["doubts"] & PASSED) or sol.result != D.RESULTS.successful


# Each with the formulation in which it solves.
METHODS = {
    **{name: (solver, None) for name, solver in SOLVERS.items()},
    **{f"dummy derivatives by {name}": (solver, D.DummyDerivatives()) for name, solver in SOLVERS.items()},
    **{name: (getattr(diffrax, name)(), D.DummyDerivatives()) for name in ("Tsit5", "Dopri8", "Bosh3")},
}


def tangled(t: Any, y: Any, yd: Any, a: Any) -> Any:
    """(t − ½) (ẏ + y) = y − sin t: all solutions meet at t = ½, and any goes on from there."""
    return [y[1] + y[0], (t - 0.5) * (yd[0] - y[1]) - (y[0] - jnp.sin(t))]


@pytest.mark.filterwarnings("ignore::dae_jax.AccuracyWarning")
@pytest.mark.parametrize("method", METHODS)
def test_where_all_solutions_meet(method: str) -> None:
    solver, formulation = METHODS[method]
    for start, rtol in itertools.product((0.0, 0.5, -1.0), (1e-2, 1e-4, 1e-6)):
        assert doubted(tangled, solver, 1.0, [start, -start], rtol, formulation=formulation)
    assert not doubted(tangled, solver, 0.45, [0.5, -0.5], formulation=formulation)


@pytest.mark.filterwarnings("ignore::dae_jax.AccuracyWarning")
@pytest.mark.parametrize("solver", SOLVERS)
def test_where_a_root_of_rates_is_lost(solver: str) -> None:
    """ẏ² + y² = 1, from ẏ = 1: at π/2, where ẏ = 0, the sine may rest. What a step takes ẏ for is that of the parabola of two."""
    circle = lambda t, y, yd, a: [yd[0] ** 2 + y[0] ** 2 - 1]
    assert doubted(circle, SOLVERS[solver], 3.0, [0.0], yd0=jnp.ones(1))
    assert not doubted(circle, SOLVERS[solver], 1.4, [0.0], yd0=jnp.ones(1))


@pytest.mark.parametrize("solver", SOLVERS)
def test_matrices_that_jump_or_vary_are_no_reason(solver: str) -> None:
    """A capacitor that becomes a negative one, and one that depends on its voltage."""
    switched = lambda t, y, yd, a: [jnp.where(t < 0.5, 1.0, -2.0) * (yd[0] - y[1]), y[1] + y[0]]
    varactor = lambda t, y, yd, a: [(2 + jnp.sin(5 * y[0])) * yd[0] - y[1], y[1] * (1 + y[0] ** 2) - jnp.cos(3 * t)]
    for rtol in (1e-2, 1e-6):
        assert not doubted(switched, SOLVERS[solver], 1.0, [1.0, -1.0], rtol)
        assert not doubted(varactor, SOLVERS[solver], 3.0, [0.0, 1.0], rtol)


def test_only_blocks_that_vary_are_looked_at() -> None:
    """x₀' = x₁, sin t x₁ x₂' + x₁ = 1, x₂ + x₁ x₃ = 0, and one constant equation: the blocks of x₂ and x₃."""
    system = D.ImplicitDAE(
        lambda t, y, yd, a: [
            yd[0] - y[1], jnp.sin(t) * y[1] * yd[2] + y[0], y[2] + y[1] * y[3], y[1] + 2 * y[0] - jnp.cos(t)
        ]
    )  # fmt: skip
    form = residual_form.ResidualForm.of(system, 0.0, jnp.ones(4), None)
    found = leading.LeadingMatrix.of(form, jnp.float64)
    assert [(x.block, x.orders) for x in found.blocks] == [(((1,), (2,)), ((1,),)), (((2,), (3,)), ((0,),))]
    y = jnp.array([0.1, 0.2, 0.3, 0.4])
    signs, logs = found.determinants(form, 2.0, y, -y)
    np.testing.assert_allclose(signs * jnp.exp(logs), [np.sin(2.0) * 0.2, 0.2], rtol=1e-14)


def test_rates_along_two_steps_are_those_of_a_parabola() -> None:
    y = lambda t: 3 - 2 * t + 5 * t**2
    first = _Slope(jnp.asarray(-2.0), jnp.asarray(0.0))
    np.testing.assert_allclose(first.at_ends(0.5, y(0.5) - y(0.0)), (-2.0, 3.0))
    after = first.after(0.5, y(0.5) - y(0.0))
    np.testing.assert_allclose(after.at_ends(0.25, y(0.75) - y(0.5)), (3.0, 5.5))
