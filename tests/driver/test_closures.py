"""Numbers that functions of the user close over are numbers like those in `args`, whatever traces them."""

import functools
import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax
from dae_jax.driver import program


GRAVITY = jnp.array([0.0, -9.81])
START = (jnp.array([1.0, 0.0]), jnp.zeros(2))


def circle(t, q, args):
    return (q @ q - 1) / 2


def last_angle(force, args=None, solver=None, **options):
    system = dae_jax.ConstrainedSystem(force, circle)
    solver = solver or dae_jax.OrthogonalProjection(diffrax.Tsit5())
    x, y = dae_jax.daesolve(system, solver, 0.0, 0.5, 0.05, START, args, **options).final[0]
    return jnp.atan2(y, x)


def by_args(k):
    return last_angle(lambda t, q, v, k: k * GRAVITY - 0.1 * k**2 * v, k)


def drag(k):
    return lambda v: 0.1 * k**2 * v


def by_default(k):
    return last_angle(lambda t, q, v, args, k=k: k * GRAVITY - drag(k)(v))


def by_keyword(k):
    def force(t, q, v, args, *, k=k):
        return k * GRAVITY - 0.1 * k**2 * v

    return last_angle(force)


def by_functions_within(k):
    of_v, parts = drag(k), {"k": k, 3: "not to be sorted"}
    return last_angle(lambda t, q, v, args: (k if parts else parts["k"]) * GRAVITY - of_v(v))


def by_partial(k):
    return last_angle(functools.partial(lambda scale, t, q, v, args, of_v: scale * GRAVITY - of_v(v), k, of_v=drag(k)))


CAPTURED = {
    "closure": lambda k: last_angle(lambda t, q, v, args: k * GRAVITY - 0.1 * k**2 * v),
    "dictionary": lambda k: (lambda p: last_angle(lambda t, q, v, args: p["k"] * GRAVITY - 0.1 * p["k"] ** 2 * v))({"k": k}),
    "jitted": lambda k: last_angle(jax.jit(lambda t, q, v, args: k * GRAVITY - 0.1 * k**2 * v)),
    "default": by_default,
    "keyword": by_keyword,
    "functions within": by_functions_within,
    "partial": by_partial,
}  # fmt: skip


@pytest.mark.parametrize("way", CAPTURED)
def test_however_a_function_has_captured_a_number(way):
    assert "kernel[" in str(jax.make_jaxpr(CAPTURED[way])(1.1))
    np.testing.assert_allclose(jax.jit(CAPTURED[way])(1.1), by_args(1.1), rtol=1e-14)


def test_a_function_that_is_made_anew_for_each_number_is_compiled_once(nothing_forgotten):
    fn = jax.value_and_grad(CAPTURED["closure"])
    fn(1.1)
    before = len(program._traced)
    np.testing.assert_allclose(fn(1.2), jax.value_and_grad(by_args)(1.2), rtol=1e-13)
    assert len(program._traced) - before <= 1  # of `by_args`


TRANSFORMATIONS = {
    "jit": jax.jit,
    "vmap": lambda f: lambda k: jax.vmap(f)(jnp.stack([k, 2 * k]))[0],
    "grad": jax.grad,
    "jacfwd": jax.jacfwd,
}
NESTED = [*itertools.permutations(("jit", "vmap", "grad")), ("jacfwd", "vmap", "jit"), ("vmap", "jacfwd", "jit")]


@functools.cache
def slope():
    return jax.grad(by_args)(1.1)


@pytest.mark.parametrize("names", NESTED, ids=" of ".join)
def test_transformations_in_any_order(names):
    fn = CAPTURED["closure"]
    for name in reversed(names):
        fn = TRANSFORMATIONS[name](fn)
    np.testing.assert_allclose(fn(1.1), slope(), rtol=1e-13)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), diffrax.Tsit5()], ids=["residuals", "selected states"])
def test_other_forms_of_the_equations(solver):
    def swing(k, closes):
        force = (lambda t, q, v, args: k * GRAVITY) if closes else (lambda t, q, v, k: k * GRAVITY)
        formulation = None if isinstance(solver, dae_jax.RadauIIA5) else dae_jax.DummyDerivatives()
        return last_angle(force, k, solver, formulation=formulation)

    one, other = (jax.jit(functools.partial(swing, closes=closes))(1.1) for closes in (True, False))
    np.testing.assert_allclose(one, other, rtol=1e-14)


def test_conditions_of_events():
    def passes(k, closes):
        condition = lambda t, y, args, **_: y[0][0] - (0.9 * k if closes else 0.9 * args)
        event = diffrax.Event(condition, optimistix.Newton(1e-10, 1e-10))
        return last_angle(lambda t, q, v, args: GRAVITY, k, event=event)

    one, other = (jax.jit(functools.partial(passes, closes=closes))(1.1) for closes in (True, False))
    np.testing.assert_allclose([one, other], -np.arccos(0.99), rtol=1e-6)


def test_a_number_out_of_sight_is_named():
    class Weight:
        def __init__(self, k):
            self.k = k

        def force(self, t, q, v, args):
            return self.k * GRAVITY

    with pytest.raises(TypeError, match=r"Hand it over through `args`"):
        jax.grad(lambda k: last_angle(Weight(k).force))(1.1)
    assert np.isfinite(jax.jit(lambda k: last_angle(Weight(k).force))(1.1))


@pytest.mark.parametrize(
    "of", [jax.jit, lambda f: lambda k: jax.vmap(f)(jnp.stack([k, 2 * k]))[0]], ids=["jit", "vmap"]
)
def test_a_mass_in_a_derivative_that_is_compiled(of):
    """The start is looked at again where a solve fails, masses and all."""

    def height(mass, throw=True):
        system = dae_jax.ConstrainedSystem(
            lambda t, q, v, args: jnp.array([0.0, -9.0]),
            lambda t, q, args: (q @ q - 1) / 2,
            lambda q, args: jnp.stack([mass, 2 * mass]),
        )
        start = (jnp.array([1.0, 0.0]), jnp.array([0.0, 0.2]))
        solver = dae_jax.OrthogonalProjection(diffrax.Tsit5())
        steps = diffrax.PIDController(1e-11, 1e-11)
        return dae_jax.daesolve(system, solver, 0.0, 1.0, None, start, stepsize_controller=steps, throw=throw).ys[0][
            0, 1
        ]

    np.testing.assert_allclose(of(jax.grad(height))(jnp.array(1.3)), jax.grad(height)(1.3), rtol=1e-12)
    forward = of(lambda m: jax.jvp(height, (m,), (1.0,))[1])
    np.testing.assert_allclose(forward(jnp.array(1.3)), jax.grad(height)(1.3), rtol=1e-9)


# Of consistent states


def on_a_circle(radius):
    """The point nearest to (0.8, 0.7) has q₁ = 0.8 r/√1.13."""
    system = dae_jax.ConstrainedSystem(lambda t, q, v, a: -q, lambda t, q, a: q @ q - radius**2)
    return dae_jax.consistent_state(system, 0.0, (jnp.array([0.8, 0.7]), jnp.zeros(2)))[0][0]


def of_a_circuit(k):
    system = dae_jax.ImplicitDAE(lambda t, y, yd, a: jnp.stack([yd[0] + y[0], y[1] - k * y[0] ** 2]))
    return dae_jax.consistent_state(system, 0.0, jnp.array([0.8, 0.7]), fixed=jnp.array([True, False]))[1]


@pytest.mark.parametrize(("state", "slope"), [(on_a_circle, 0.8 / np.sqrt(1.13)), (of_a_circuit, 0.64)])
def test_a_consistent_state_knows_what_its_equations_close_over(state, slope):
    """Compiled, the derivative was 0; else it was an error."""
    found = [
        jax.grad(state)(1.0),
        jax.jit(jax.grad(state))(1.0),
        jax.jvp(state, (1.0,), (1.0,))[1],
        jax.vmap(jax.grad(state))(jnp.ones(2))[1],
        jax.jit(jax.jacfwd(state))(1.0),
    ]
    np.testing.assert_allclose(found, slope, rtol=1e-8)


@pytest.mark.parametrize("place", ["closure", "args"])
def test_a_key_of_the_new_kind(place):
    """ẏ = −k y with a k that is drawn."""
    key = jax.random.key(3)
    draw = lambda args: jax.random.uniform(key if place == "closure" else args)
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: jnp.stack([yd[0] + draw(args) * y[0], y[1] - y[0]]))
    sol = dae_jax.daesolve(system, dae_jax.BDF(), 0.0, 1.0, None, jnp.ones(2), None if place == "closure" else key)
    np.testing.assert_allclose(sol.ys[0], np.exp(-jax.random.uniform(key)), rtol=1e-5)
