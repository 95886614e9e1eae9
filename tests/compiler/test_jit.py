"""`compiler.jit` gives what `jax.jit` gives, by one kernel, with its derivatives, batches and errors."""

import functools
import importlib
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax
from dae_jax.compiler import jit, kernel_call, one_kernel


X = jnp.array([0.3, 0.5, 0.7])


@pytest.fixture
def only_ours(monkeypatch):
    """Fails where anything is left to XLA."""
    module = importlib.import_module("dae_jax.compiler.jit")
    called = module.called
    monkeypatch.setattr(kernel_call, "_by_xla", lambda *_: pytest.fail("left to XLA"))
    monkeypatch.setattr(module, "called", lambda *args: called(*args) or pytest.fail("left to XLA"))


def assert_same(found, expected, rtol=1e-12, atol=1e-14):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert jnp.result_type(x) == jnp.result_type(y)
        if jnp.result_type(x) != jax.dtypes.float0:
            np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


def loop(x):
    return jax.lax.fori_loop(0, 10, lambda i, x: x + 0.1 * jnp.sin(x[::-1]) * x, x)


def open_loop(x):
    return jax.lax.while_loop(lambda c: c[0] < 5, lambda c: (c[0] + jnp.abs(c[1][0]), 1.1 * c[1]), (0.0, x))[1]


def solved(x):
    return jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), x)


def total(fn):
    return lambda x: jnp.sum(jnp.sin(fn(x)))


BATCH = functools.partial(jnp.multiply, jnp.arange(1.0, 12.0)[:, None])
FORWARD = {
    "value": lambda f: f,
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (x,)),
    "jacfwd": jax.jacfwd,
    "third": lambda f: jax.jacfwd(jax.jacfwd(jax.jacfwd(total(f)))),
    "vmap": lambda f: lambda x: jax.vmap(f)(BATCH(x)),
    "in a scan": lambda f: lambda x: jax.lax.scan(lambda c, _: (f(c), None), x, None, length=3)[0],
}
REVERSE = {
    "grad": lambda f: jax.grad(total(f)),
    "hessian": lambda f: jax.hessian(total(f)),
    "jacrev of jacfwd": lambda f: jax.jacrev(jax.jacfwd(f)),
    "jacrev of jacrev": lambda f: jax.jacrev(jax.jacrev(f)),
    "grad of grad of grad": lambda f: jax.grad(
        lambda x: jnp.sum(jax.grad(lambda x: jnp.sum(jax.grad(total(f))(x) ** 2))(x) ** 2)
    ),
    "vmap of grad": lambda f: lambda x: jax.vmap(jax.grad(total(f)))(BATCH(x)),
    "grad of vmap": lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(BATCH(x)) ** 2)),
    "grad of a checkpoint": lambda f: jax.grad(jax.checkpoint(total(f))),
    "jit of vmap of vmap": lambda f: jax.jit(
        lambda x: jax.vmap(jax.vmap(jax.grad(total(f))))(jnp.stack([BATCH(x)] * 2))
    ),
}


class TestTransformations:
    @pytest.mark.parametrize("name", FORWARD)
    @pytest.mark.parametrize("fn", [loop, open_loop, solved])
    def test_forward(self, fn, name, only_ours):
        assert_same(jax.jit(FORWARD[name](jit(fn)))(X), jax.jit(FORWARD[name](fn))(X), rtol=1e-10)

    @pytest.mark.parametrize("name", REVERSE)
    @pytest.mark.parametrize("fn", [loop, solved])
    def test_reverse(self, fn, name, only_ours):
        assert_same(jax.jit(REVERSE[name](jit(fn)))(X), jax.jit(REVERSE[name](fn))(X), rtol=1e-10)

    def test_reverse_of_an_open_loop_is_refused_as_jax_refuses_it(self):
        with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
            jax.grad(total(jit(open_loop)))(X)

    def test_outside_of_a_jit(self, only_ours):
        assert_same(jax.hessian(total(jit(loop)))(X), jax.jit(jax.hessian(total(loop)))(X), rtol=1e-10)

    def test_integers_beside_numbers(self, only_ours):
        fn = lambda x, n: (x * n, n + 1, x > 0.4)
        assert_same(jit(fn)(X, 3), jax.jit(fn)(X, 3))
        found = jax.jvp(lambda x: jit(fn)(x, 3), (X,), (X,))[1]
        assert_same(found, jax.jvp(lambda x: fn(x, 3), (X,), (X,))[1])


class TestCalls:
    def test_arguments_as_jax_takes_them(self, only_ours):
        def fn(tree, power, *, scale=1.0, name="sum"):
            return {"out": getattr(jnp, name)(tree["a"]) ** power * scale + tree["b"][0]}

        options = {"static_argnums": 1, "static_argnames": "name"}
        ours, theirs = jit(fn, **options), jax.jit(fn, **options)
        tree = {"a": X, "b": (2, jnp.float32(3))}
        assert_same(ours(tree, 2), theirs(tree, 2))
        assert_same(ours(tree, 3, scale=2.0, name="max"), theirs(tree, 3, scale=2.0, name="max"))

    def test_weak_types_stay_weak(self):
        fn = lambda x, a: x * a
        assert jit(fn)(X.astype(jnp.float32), 2.0).dtype == jnp.float32
        assert jit(lambda a: a + 1)(2.0).weak_type

    def test_closures_over_arrays_and_over_what_is_traced(self, only_ours):
        fn = lambda wrap: lambda a: jnp.sum(jax.vmap(wrap(lambda x: loop(x * a)))(BATCH(X)))
        assert_same(jax.grad(fn(jit))(2.0), jax.grad(fn(lambda f: f))(2.0), rtol=1e-11)
        assert_same(jax.vmap(fn(jit))(X), jax.vmap(fn(lambda f: f))(X), rtol=1e-11)

    def test_a_method(self):
        class Scaled:
            factor = 3.0

            @functools.partial(jit, static_argnums=0)
            def of(self, x):
                return self.factor * x

        assert_same(Scaled().of(X), 3 * X)

    def test_named_and_documented_as_the_function(self):
        def something(x):
            """Some words."""
            return x

        assert (jit(something).__name__, jit(something).__doc__) == ("something", "Some words.")

    def test_what_has_no_kernel_is_left_to_xla(self):
        fn = lambda x: jnp.abs(jnp.fft.fft(x)) + loop(x)
        assert_same(jit(fn)(X), jax.jit(fn)(X))
        assert_same(jax.grad(total(jit(fn)))(X), jax.grad(total(fn))(X))
        assert_same(jax.vmap(jit(fn))(BATCH(X)), jax.vmap(fn)(BATCH(X)))

    @pytest.mark.parametrize("compiler", ["xla", "off"])
    def test_switched_off(self, compiler):
        with dae_jax.configure(compiler=compiler):
            assert_same(jit(loop)(X), loop(X))
            assert jit(loop).lower(X).compiler != "llvm"


class TestLowered:
    def test_shows_every_form(self):
        found = jit(loop).lower(X)
        assert (found.compiler, found.unsupported) == ("llvm", ())
        assert "sin" in str(found.jaxpr)
        assert "sin" in found.annotated()
        assert "define" in found.ir()
        assert "\tret" in found.assembly()
        assert repr(found).startswith("one kernel by our compiler (LLVM)")
        assert "varying" in found.batch().annotated()

    def test_says_what_is_not_supported(self):
        found = jit(lambda x: jnp.fft.fft(x).real).lower(X)
        assert found.compiler == "xla"
        assert [reason.primitive for reason in found.unsupported] == ["fft"]
        assert "fft c128[3]" in str(found)

    def test_entries_replaced_by_a_function_of_them(self):
        # JAX calls it a scatter, whose updates are zeros that mean nothing.
        fn = lambda x: jax.lax.fori_loop(0, 3, lambda k, y: y.at[jnp.array([0, 2])].apply(jnp.cos) + x, x)
        assert_same(jit(fn)(X), fn(X))
        assert [reason.primitive for reason in jit(fn).lower(X).unsupported] == ["scatter"]

    def test_prediction_is_what_happens(self, monkeypatch):
        functions = [loop, solved, open_loop, jnp.fft.fft, lambda x: jnp.linalg.svd(jnp.outer(x, x))[1], jnp.sort]
        for fn in functions:
            text = jax.jit(lambda x, fn=fn: jit(fn)(x)).lower(X).as_text()
            assert ("@dae_jax_" in text) == (jit(fn).lower(X).compiler == "llvm")

    def test_what_is_too_large_for_lanes_only(self):
        fn = jit(lambda x: jnp.sum(jnp.cumsum(jnp.sin(x + jnp.arange(2.0**26)))))
        alone = fn.lower(1.0)
        assert (alone.compiler, alone.batch().compiler == "llvm") == ("llvm", False)
        assert [reason.primitive for reason in alone.batch().unsupported] == ["size"]
        lower = lambda fn, x: jax.jit(fn).lower(x).as_text()
        assert "@dae_jax_" in lower(fn, 1.0)
        assert "@dae_jax_" not in lower(jax.vmap(fn), jnp.ones(9))


def oscillator(t, y, args):
    return jnp.stack([y[1], -args * jnp.sin(y[0])])


def robertson(t, y, args):
    first, last = -0.04 * y[0] + 1e4 * y[1] * y[2], args * y[1] ** 2
    return jnp.stack([first, -first - last, last])


PENDULUM = (oscillator, jnp.array([1.0, 0.3]), 9.81)
ROBERTSON = (robertson, jnp.array([1.0, 0.0, 0.0]), 3e7)


def solution(y0, k, field, solver, **options) -> Any:
    settings = {
        "dt0": None,
        "stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-9),
        "max_steps": 256,
        **options,
    }
    return diffrax.diffeqsolve(diffrax.ODETerm(field), solver, 0.0, 2.0, y0=y0, args=k, **settings)


FALLS = diffrax.Event(lambda t, y, args, **_: y[0])
SOLVES = {
    "Dopri8, at times": (PENDULUM, diffrax.Dopri8(), {"saveat": diffrax.SaveAt(ts=jnp.linspace(0, 2, 5))}),
    "Tsit5, steps": (PENDULUM, diffrax.Tsit5(), {"saveat": diffrax.SaveAt(t0=True, steps=True)}),
    "Dopri5, dense": (PENDULUM, diffrax.Dopri5(), {"saveat": diffrax.SaveAt(dense=True)}),
    "constant steps": (
        PENDULUM, diffrax.Tsit5(), {"dt0": 0.01, "stepsize_controller": diffrax.ConstantStepSize()},
    ),
    "event": (
        PENDULUM, diffrax.Tsit5(), {"event": diffrax.Event(lambda t, y, args, **_: y[0], optimistix.Newton(1e-9, 1e-9))},
    ),
    "Kvaerno5": (ROBERTSON, diffrax.Kvaerno5(), {}),
    "Kvaerno3, forward": (ROBERTSON, diffrax.Kvaerno3(), {"adjoint": diffrax.ForwardMode()}),
}  # fmt: skip


class TestDiffrax:
    """A plain `diffeqsolve`, as it is."""

    @pytest.mark.parametrize("name", SOLVES)
    def test_a_solve(self, name, only_ours):
        (field, y0, k), solver, options = SOLVES[name]
        solve = lambda y0, k: solution(y0, k, field, solver, **options)
        assert_same(jit(solve)(y0, k), jax.jit(solve)(y0, k), rtol=1e-9, atol=1e-12)

    def test_a_batch(self, only_ours):
        solve = lambda y0: solution(y0, 9.81, oscillator, diffrax.Dopri8()).ys[-1]
        starts = jnp.stack([jnp.linspace(0.1, 3, 21), jnp.zeros(21)], 1)
        assert_same(jax.vmap(jit(solve))(starts), jax.vmap(solve)(starts), rtol=1e-9)

    def test_gradients_in_both_modes(self, only_ours):
        (field, y0, k), solver, _ = SOLVES["Kvaerno3, forward"]
        end = lambda adjoint: jit(lambda k: jnp.sum(solution(y0, k, field, solver, adjoint=adjoint).ys ** 2))
        forward = end(diffrax.ForwardMode())
        backwards = jax.jit(jax.grad(end(diffrax.RecursiveCheckpointAdjoint())))(k)
        forwards = jax.jit(jax.jacfwd(forward))(k)
        np.testing.assert_allclose(backwards, forwards, rtol=1e-9)
        np.testing.assert_allclose(forwards, (forward(1.001 * k) - forward(0.999 * k)) / (0.002 * k), rtol=1e-2)


def positive(x):
    return eqx.error_if(x, x < 0, "x must be positive")


class TestErrors:
    """A check raises when the kernel is done, with its own message."""

    def fails(self, fn, *args, match="x must be positive"):
        with pytest.raises((RuntimeError, ValueError), match=match):
            jax.block_until_ready(fn(*args))

    def test_at_the_top(self, only_ours):
        fn = jit(lambda x: jnp.sqrt(positive(x)))
        assert fn(4.0) == 2
        self.fails(fn, -4.0)

    def test_of_one_element_of_a_batch(self, only_ours):
        fn = jax.vmap(jit(lambda x: jnp.sqrt(positive(x))))
        assert_same(fn(jnp.ones(9)), jnp.ones(9))
        self.fails(fn, jnp.ones(9).at[7].set(-1.0))

    @pytest.mark.parametrize(
        "fn",
        [
            lambda x: jax.lax.fori_loop(0, 5, lambda i, x: positive(x) - 1.0, x),
            lambda x: jax.lax.scan(lambda x, _: (positive(x) - 1.0, x), x, None, length=5)[1],
            lambda x: jax.lax.cond(x < 100, lambda x: positive(x - 4.0), lambda x: x, x),
            # It goes on for ever where nothing stops it.
            lambda x: jax.lax.while_loop(lambda x: x < 10, lambda x: positive(x) + jnp.where(x > 4, 1.0, -1.0), x),
        ],
    )
    def test_in_control_flow(self, fn, only_ours):
        assert_same(jit(fn)(9.0), jax.jit(fn)(9.0))
        self.fails(jit(fn), 2.0)

    def test_the_first_that_fails_is_named(self, only_ours):
        def fn(x):
            return eqx.error_if(positive(x), x < 1, "x must be larger than 1")

        self.fails(jit(fn), -1.0)
        self.fails(jit(fn), 0.5, match="larger than 1")

    def test_of_a_gradient(self, only_ours):
        fn = jax.grad(jit(lambda x: jnp.sum(solved(x) ** 2) * positive(x[0])))
        assert jnp.isfinite(fn(X)).all()

    def test_of_a_solve(self, only_ours):
        solve = lambda throw: jit(lambda y0: solution(y0, 9.81, oscillator, diffrax.Tsit5(), max_steps=4, throw=throw))
        self.fails(solve(True), PENDULUM[1], match="maximum number of solver steps")
        assert solve(False)(PENDULUM[1]).result == diffrax.RESULTS.max_steps_reached


class TestWhatJaxIsToldForDebugging:
    @pytest.mark.parametrize(
        "fn", [jnp.log, jax.grad(jnp.sqrt), lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jnp.log(x), x)]
    )
    def test_what_is_not_a_number_raises(self, fn):
        with jax.debug_nans(True), pytest.raises(FloatingPointError, match="nan"):
            jit(fn)(-1.0)

    def test_nothing_is_compiled(self):
        def fn(x):
            # What is known while it runs may decide.
            return jax.lax.fori_loop(0, 5, lambda i, x: x * 2 if x > 1 else x + 1, x)

        with jax.disable_jit():
            assert jit(fn)(0.5) == fn(0.5) == 24.0


ALIKE = (np.array(0.1234567890123), np.array(0.1234567891))


@pytest.mark.parametrize(
    ("a", "b"), [ALIKE, np.float32(ALIKE), (np.array(0.0), np.array(-0.0)), (np.array(7), np.array(7.0))]
)
def test_numbers_that_look_alike_are_told_apart(only_ours, a, b):
    def both(x):
        return jnp.stack([jnp.copysign(x, a * x), jnp.copysign(x, b * x), x * a, x * b, x + a, x + b])

    for fn in (both, lambda x: jax.lax.fori_loop(0, 3, lambda i, y: both(x) + y, 0 * both(x))):
        np.testing.assert_array_equal(jit(fn)(X), jax.jit(fn)(X))


def test_a_value_that_is_the_same_for_a_batch_has_its_shape_within_derivatives():
    def both(k, one):
        return jax.lax.fori_loop(0, 3, lambda i, x: x * k, k), 2 * one

    for fn in (jit(both), one_kernel(both, "reverse")):

        def value(k, fn=fn):
            x, same = fn(k, jnp.ones(()))
            return jax.lax.cond(k > 0, lambda: x * same, lambda: same)

        for slope in (jax.grad, jax.jacfwd):
            found = slope(lambda k: jax.vmap(jax.jit(value))(jnp.stack([k, 2 * k])).sum())(1.5)
            np.testing.assert_allclose(found, 17 * 8 * 1.5**3, rtol=1e-14)


def test_a_kernel_within_a_kernel_is_a_part_of_it():
    """A solve of this library in a function that is compiled, with its derivatives and its batch."""
    circle = lambda t, q, args: (q @ q - 1) / 2
    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: args * jnp.array([0.0, 1.0]), circle)
    solver, y0 = dae_jax.OrthogonalProjection(diffrax.Tsit5()), (jnp.array([1.0, 0.0]), jnp.zeros(2))
    end = lambda g: dae_jax.daesolve(system, solver, 0.0, 2.0, None, y0, g, throw=False).ys[0][-1, 0]
    ours, gs = jit(end), jnp.array([9.81, 5.0, 1.0])
    assert ours.lower(9.81).compiler == "llvm"
    for of in (lambda f: f, jax.grad, jax.hessian):
        np.testing.assert_allclose(of(ours)(9.81), of(end)(9.81), rtol=1e-8)
        np.testing.assert_allclose(jax.vmap(of(ours))(gs), [of(end)(g) for g in gs], rtol=1e-8)
    total = lambda f: lambda a: jnp.sum(jax.vmap(f)(a * gs))
    np.testing.assert_allclose(jax.grad(total(ours))(1.0), jax.grad(total(end))(1.0), rtol=1e-8)


@pytest.mark.parametrize("lanes", [False, True])
def test_the_derivative_of_what_is_read_beyond_the_end(only_ours, lanes):
    """JAX reads the last entry there, and its derivative leaves it out."""
    read = lambda x: jnp.sum((jnp.arange(5.0) * x[0])[(10 * x).astype(int)])
    batch = jax.vmap if lanes else lambda fn: fn
    x = jnp.stack([X, 2 * X]) if lanes else X
    assert_same(batch(jit(jax.grad(read)))(x), batch(jax.grad(read))(x))
