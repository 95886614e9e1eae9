"""A solver and a formulation written outside of the package, by its interfaces alone."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import scenes


class ProjectedMidpoint(dae_jax.AbstractManifoldSolver):
    """The explicit midpoint rule, then the nearest point of the manifold; fixed steps, order 2."""

    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        return 2

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        k0 = terms.vf_prod(t0, y0, args, terms.contr(t0, t1))
        middle = jax.tree.map(lambda y, k: y + k / 2, y0, k0)
        k = terms.vf_prod(t0 + (t1 - t0) / 2, middle, args, terms.contr(t0, t1))
        y1 = self.retract(t1, jax.tree.map(jnp.add, y0, k), args)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    def retract(self, t: Any, y: Any, ode: Any) -> Any:
        return ode.project(t, y)[0]


class CubicBaumgarte(dae_jax.AbstractFieldFormulation):
    """g̈ + 2α ġ + β² g + γ g³ = 0."""

    alpha: Any
    beta: Any
    gamma: Any

    def encode(self, system: Any, t: Any, state: Any, args: Any = None, rank: Any = None) -> Any:
        return dae_jax.Differentiation().encode(system, t, state, args, rank)

    def field(self, t: Any, y: Any, ode: Any) -> Any:
        return ode.field(t, y, lambda g, dg: 2 * self.alpha * dg + self.beta**2 * g + self.gamma * g**3)


SCENE = scenes.SCENES["pendulum"]()


def end(angle, solver, formulation=None, steps=200, t1=1.0):
    y0 = (jnp.stack([jnp.cos(angle), jnp.sin(angle)]), jnp.zeros(2))
    sol = dae_jax.daesolve(
        SCENE.system, solver, 0.0, t1, t1 / steps, y0, SCENE.args, formulation=formulation, max_steps=2 * steps
    )
    return sol.ys[0][0]


METHODS = {
    "solver": (ProjectedMidpoint(), None),
    "formulation": (diffrax.Bosh3(), CubicBaumgarte(5.0, 5.0, 3.0)),
    "both": (diffrax.Heun(), CubicBaumgarte(5.0, 5.0, 3.0)),
}


def reference():
    """By Jacobi elliptic functions."""
    return scenes.SCENES["pendulum"](angle=np.pi / 2 - 0.3).reference(np.array([1.0]))[0][0]


@pytest.mark.parametrize("name", METHODS)
def test_converges_in_its_order(name):
    solver, formulation = METHODS[name]
    errors = [float(np.max(np.abs(end(0.3, solver, formulation, n) - reference()))) for n in (20, 40, 80)]
    order = {"solver": 2, "formulation": 3, "both": 2}[name]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(slopes - order) < 0.4), (errors, slopes)


def test_stays_on_the_constraints():
    q = end(0.3, ProjectedMidpoint(), t1=10.0, steps=500)
    assert abs(float(q @ q) - 1) < 1e-13


@pytest.mark.parametrize("name", METHODS)
def test_derivatives_and_batches(name):
    solver, formulation = METHODS[name]
    of = lambda angle: end(angle, solver, formulation)[1]
    difference = (of(0.3 + 1e-5) - of(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose([jax.grad(of)(0.3), jax.jacrev(of)(0.3)], difference, rtol=1e-8)
    angles = jnp.linspace(0.1, 1.0, 5)
    np.testing.assert_allclose(jax.vmap(of)(angles), [of(a) for a in angles], rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", METHODS)
def test_is_one_kernel(name):
    solver, formulation = METHODS[name]
    assert "@dae_jax_" in jax.jit(lambda a: end(a, solver, formulation)).lower(0.3).as_text()


def test_what_it_cannot_do_is_asked_of_it():
    class Picky(ProjectedMidpoint):
        locates_events = False

        def refuse(self, system: Any, formulation: Any, t0: Any, y0: Any, args: Any) -> None:
            if formulation.changes_field:
                raise ValueError("Picky takes the underlying ODE only.")

    with pytest.raises(ValueError, match="underlying ODE only"):
        end(0.3, Picky(), CubicBaumgarte(1.0, 1.0, 0.0))
    event = diffrax.Event(lambda t, y, args, **_: y[0][0])
    with pytest.raises(ValueError, match="Events need"):
        dae_jax.daesolve(SCENE.system, Picky(), 0.0, 1.0, 0.01, SCENE.y0, SCENE.args, event=event)
