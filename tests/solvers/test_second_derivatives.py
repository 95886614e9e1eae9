"""Second derivatives of a solve, in each order of modes, are differences of its gradients."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import one_kernel


X = jnp.array([9.81, 1.0])


def loss(x, solver, formulation=None, rtol=1e-9, adjoint=None):
    """Of gravity, and of the angle at the start."""
    system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, -g]), lambda t, q, g: (q @ q - 1) / 2)
    y0 = (jnp.stack([jnp.sin(x[1]), -jnp.cos(x[1])]), jnp.stack([jnp.cos(x[1]), jnp.sin(x[1])]) * 0.3)
    sol = dae_jax.daesolve(
        system, solver, 0.0, 0.3, None, y0, x[0], formulation=formulation, max_steps=200,
        saveat=diffrax.SaveAt(ts=jnp.array([0.1, 0.3])), stepsize_controller=diffrax.PIDController(rtol, rtol),
        **({} if adjoint is None else {"adjoint": adjoint}),
    )  # fmt: skip
    return jnp.sum(jnp.sin(3 * sol.ys[0])) + jnp.sum(sol.ys[1] ** 2)


@pytest.fixture(scope="module")
def expected():
    """Central differences of the gradient of a tight solve, good to 1e-8."""
    projected = dae_jax.OrthogonalProjection(dae_jax.DOP853())
    gradient, h = jax.jit(jax.grad(lambda x: loss(x, projected, rtol=1e-12))), 1e-4
    return jnp.stack([(gradient(X + h * e) - gradient(X - h * e)) / (2 * h) for e in jnp.eye(2)])


ORDERS = {
    "hessian": jax.hessian,
    "gradient of gradient": lambda f: jax.jacrev(jax.grad(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
}
METHODS = {
    "explicit": (diffrax.Tsit5(), None),
    "projection": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
    "tangent space": (dae_jax.TangentSpace(diffrax.Tsit5()), None),
    "Baumgarte": (diffrax.Tsit5(), dae_jax.Baumgarte(5.0, 5.0)),
    "Radau": (dae_jax.RadauIIA5(), None),
    "BDF": (dae_jax.BDF(), None),
    "dummy derivatives": (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
}
CASES = [
    ("projection", "hessian"), ("explicit", "gradient of gradient"), ("explicit", "reverse over forward"), ("Baumgarte", "hessian"),
    ("projection", "forward over forward"), ("tangent space", "gradient of gradient"), ("Radau", "hessian"),
    ("BDF", "gradient of gradient"), ("dummy derivatives", "forward over forward"),
]  # fmt: skip


@pytest.mark.parametrize(("method", "order"), CASES)
def test_are_differences_of_gradients(method, order, expected):
    solver, formulation = METHODS[method]
    found = jax.jit(ORDERS[order](lambda x: loss(x, solver, formulation)))(X)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_forward_mode_twice(expected):
    solver = dae_jax.OrthogonalProjection(diffrax.Tsit5())
    found = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: loss(x, solver, adjoint=diffrax.ForwardMode()))))(X)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


# Of a function whose derivatives are those of a kernel.


def cubic(x, n):
    looped = jax.lax.fori_loop(0, 3, lambda _, y: y + 0.1 * jnp.sin(y) * y, x)
    return {"y": looped @ looped * x, "n": n + 1}


@pytest.mark.parametrize(
    ("order", "pull_back"),
    [*((order, "own") for order in ORDERS), ("hessian", "of JAX"), ("gradient of gradient", "of JAX")],
)
def test_of_a_kernel(order, pull_back):
    order = ORDERS[order]

    def pull(args, cotangent, _):
        x, n = args
        return list(jax.vjp(lambda x: cubic(x, n)["y"], x)[1](cotangent["y"]))

    fused = one_kernel(cubic, "reverse", pull if pull_back == "own" else None)
    of = lambda fn: lambda x: jnp.sum(jnp.sin(fn(x, 3)["y"]))
    np.testing.assert_allclose(order(of(fused))(X), order(of(cubic))(X), rtol=1e-12)
    xs, weight = jnp.stack([X, 0.1 * X, -X]), jnp.array([0.3, 0.7])
    batch = lambda fn: lambda w: jnp.sum(jax.vmap(lambda x: fn(x * w, 3)["y"] @ jnp.cos(w))(xs) ** 2)
    np.testing.assert_allclose(order(batch(fused))(weight), order(batch(cubic))(weight), rtol=1e-12)
    each = lambda fn: jax.vmap(order(of(fn)))(xs)
    np.testing.assert_allclose(each(fused), each(cubic), rtol=1e-12)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("then", [0, 1])
def test_by_two_arguments(first, then):
    """What moves first and what moves then are not the same arrays, and have derivatives of other shapes."""
    plain = lambda x, p, n: jnp.sum(jnp.sin(x * p[0]) * x + p[1] ** n)
    fused = one_kernel(plain, "reverse")
    at = X, jnp.array([0.3, 1.1, 0.7]), 3
    for outer, inner in itertools.product((jax.jacfwd, jax.jacrev), (jax.jacfwd, jax.grad)):
        found, expected = (outer(inner(fn, first), then)(*at) for fn in (fused, plain))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_third_derivatives_are_forward_ones():
    fused = one_kernel(lambda x: jnp.sin(x) * x[0], "reverse")
    plain = lambda x: jnp.sum(jnp.sin(x) * x[0])
    of = lambda x: jnp.sum(fused(x))
    np.testing.assert_allclose(jax.jacfwd(jax.hessian(of))(X), jax.jacfwd(jax.hessian(plain))(X), rtol=1e-12)
    with pytest.raises(NotImplementedError, match="ForwardMode"):
        jax.jacrev(jax.hessian(of))(X)


def test_multipliers_of_redundant_constraints_where_eigenvalues_are_equal():
    """Two pendulums that are alike, each rod written twice: λ = (|v|² + q·f) / (2|q|²). Eigenvectors have no derivative there."""
    force = jnp.array([0.0, 9.81])
    rods = lambda t, q, args: jnp.repeat((jnp.sum(q**2, 1) - 1) / 2, 2)
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.tile(force, (2, 1)), rods, rank=2)
    found = lambda y: dae_jax.multipliers(system, 0.0, *y)
    exact = lambda y: jnp.repeat((jnp.sum(y[1] ** 2, 1) + y[0] @ force) / (2 * jnp.sum(y[0] ** 2, 1)), 2)
    y = jnp.array([[[0.6, 0.8], [0.6, 0.8]], [[0.8, -0.6], [0.8, -0.6]]])
    for derivative in (jax.hessian, lambda f: jax.jacfwd(jax.hessian(f))):
        np.testing.assert_allclose(jax.jit(derivative(found))(y), derivative(exact)(y), rtol=0, atol=1e-10)
