"""Of several roots of an algebraic equation, the one that the motion leads to."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax as D


TS = jnp.linspace(0, 3, 201)
SOLVERS = {"tsit5": diffrax.Tsit5(), "dopri8": diffrax.Dopri8(), "dop853": D.DOP853(), "bosh3": diffrax.Bosh3()}


def cubic(t: Any, y: Any, yd: Any, a: Any) -> Any:
    """z³ − 3z = s has three roots for |s| < 2, 2 cos of a third of an angle; here the largest of them."""
    return [yd[0] - 8 * jnp.cos(8 * t), y[1] ** 3 - 3 * y[1] - 1.9 * y[0]]


def turning(t: Any, y: Any, yd: Any, a: Any) -> Any:
    """A shaft that follows another one through 40 rad: sin(z − x) = 0 also half a turn off."""
    return [yd[0] - 100 / jnp.cosh(5 * (t - 1.5)) ** 2, jnp.sin(y[1] - y[0])]


def joint(t: Any, y: Any, yd: Any, a: Any) -> Any:
    """A universal joint at 60°: tan z = cos 60° tan x, also half a turn off."""
    return [yd[0] - 20 - 10 * jnp.sin(3 * t), jnp.sin(y[1]) * jnp.cos(y[0]) - 0.5 * jnp.sin(y[0]) * jnp.cos(y[1])]


def largest(t: Any) -> Any:
    return 2 * np.cos(np.arccos(0.95 * np.sin(8 * t)) / 3)


def turned(t: Any) -> Any:
    return 20 * (np.tanh(5 * (t - 1.5)) + np.tanh(7.5))


def unwrapped(t: Any) -> Any:
    x = 20 * t + 10 / 3 * (1 - np.cos(3 * t))
    return x - np.arctan2(np.sin(2 * x), 3 + np.cos(2 * x))


# The equations, the start, and what the algebraic variable is.
PROBLEMS = {
    "cubic": (cubic, jnp.array([0.0, np.sqrt(3)]), largest),
    "turning": (turning, jnp.zeros(2), turned),
    "joint": (joint, jnp.zeros(2), unwrapped),
}


def solved(name: str, solver: diffrax.AbstractSolver, tolerance: float, **options: Any) -> D.DAESolution:
    equations, start, _ = PROBLEMS[name]
    return D.daesolve(
        D.ImplicitDAE(equations), solver, 0.0, 3.0, None, start, formulation=D.DummyDerivatives(),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=100_000, **options,
    )  # fmt: skip


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_every_saved_value_is_on_the_root_of_the_start(name: str, solver: str) -> None:
    exact = PROBLEMS[name][2](np.asarray(TS))
    for tolerance in (1e-4, 1e-6, 1e-9):
        sol = solved(name, SOLVERS[solver], tolerance, saveat=diffrax.SaveAt(ts=TS))
        assert np.abs(np.asarray(sol.ys)[:, 1] - exact).max() < 1000 * tolerance


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_end_is_on_the_root_of_the_start(name: str, solver: str) -> None:
    sol = solved(name, SOLVERS[solver], 1e-5)
    assert abs(sol.ys[-1, 1] - PROBLEMS[name][2](3.0)) < 1e-2


@pytest.mark.parametrize("solver", SOLVERS)
def test_where_roots_meet_the_solve_ends(solver: str) -> None:
    """z² = cos²t is cos t and |cos t|, and nothing in the equation says which, from π/2 on."""
    system = D.ImplicitDAE(lambda t, y, yd, a: [yd[0] - 1, y[1] ** 2 - jnp.cos(y[0]) ** 2])
    with pytest.raises(Exception, match=r"ended at t = 1\.57"):
        D.daesolve(system, SOLVERS[solver], 0.0, 3.0, None, jnp.array([0.0, 1.0]), formulation=D.DummyDerivatives())


def test_a_pendulum_keeps_its_side_at_loose_tolerances() -> None:
    system = D.ConstrainedSystem(lambda t, q, v, a: jnp.array([0.0, -9.81]), lambda t, q, a: (q @ q - 1) / 2)
    position = lambda t, y, a: y[0]
    sol = D.daesolve(
        system, diffrax.Tsit5(), 0.0, 3.0, None, (jnp.array([0.0, -1.0]), jnp.array([1.0, 0.0])),
        formulation=D.DummyDerivatives(), saveat=diffrax.SaveAt(ts=TS, fn=position),
        stepsize_controller=diffrax.PIDController(rtol=1e-2, atol=1e-2),
    )  # fmt: skip
    assert (np.asarray(sol.ys)[:, 1] < -0.9).all()


def test_derivatives_and_lanes() -> None:
    """In both modes against the exact ones, and a batch equal to one at a time."""

    def end(a: Any) -> Any:
        """Of z³ − 3z = a x."""
        equations = lambda t, y, yd, a: [yd[0] - 8 * jnp.cos(8 * t), y[1] ** 3 - 3 * y[1] - a * y[0]]
        sol = D.daesolve(
            D.ImplicitDAE(equations), D.DOP853(), 0.0, 1.0, None, PROBLEMS["cubic"][1], a, formulation=D.DummyDerivatives(),
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        )  # fmt: skip
        return sol.ys[-1, 1]

    x = np.sin(8.0)
    z = 2 * np.cos(np.arccos(0.95 * x) / 3)
    assert abs(jax.grad(end)(1.9) - x / (3 * z**2 - 3)) < 1e-6
    assert abs(jax.jvp(end, (1.9,), (1.0,))[1] - x / (3 * z**2 - 3)) < 1e-6
    factors = jnp.array([1.9, -1.5, 0.3])
    assert np.abs(jax.vmap(end)(factors) - np.array([end(a) for a in factors])).max() < 1e-12
