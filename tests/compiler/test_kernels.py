"""Scalarised and one-kernel functions are the functions they were made of."""

import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import configure, one_kernel, polynomials, scalarise, subroutine, unsupported, xla_kernel
from dae_jax.compiler.emit import programs
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import judge


def length(x):
    return jnp.sqrt(jnp.sum(x**2))


def jacobian_times(x):
    """G M⁻¹ Gᵀ of a two-body chain: a Jacobian, products with structural zeros, indexing."""

    def g(q):
        p = jnp.reshape(q[:4], (2, 2))
        return jnp.stack([p[0] @ p[0] - 1, (p[1] - p[0]) @ (p[1] - p[0]) - 1])

    G = jax.jacfwd(g)(x)
    return G @ jnp.diag(jnp.array([1.0, 1.0, 0.5, 0.5])) @ G.T


def nested(x):
    """The second derivative of `length` along x + 1, twice forward."""
    return jax.jvp(lambda y: jax.jvp(length, (y,), (jnp.ones_like(y),))[1], (x,), (x + 1,))[1]


def pieces(x):
    return jnp.concatenate([jnp.stack([x[1], x[0] * x[2]]), x[::-1][1:3], jnp.pad(x, (1, 1))])


def branches(x):
    return jnp.where(x > 0.8, jnp.sin(x), jnp.maximum(x, 0.5) ** 3) + jnp.where(jnp.arange(4) < 2, x, 0.0)


@jax.jit
def jitted(x):
    return {"sum": jnp.sum(jnp.exp(-x)), "outer": jnp.outer(x, x)}


def with_jit(x):
    return jitted(x)["outer"] @ x + jitted(x)["sum"]


@jax.custom_jvp
def square_root(x):
    """Its derivative at 0 is 0 by the rule, infinite by the arithmetic."""
    return jnp.sqrt(x)


@square_root.defjvp
def _(primals, tangents):
    (x,), (dx,) = primals, tangents
    safe = jnp.where(x > 0, x, 1.0)
    return square_root(x), jnp.where(x > 0, dx / (2 * jnp.sqrt(safe)), 0.0)


def custom(x):
    return square_root(x) * x[0]


def hessian_in_parts(x):
    return jnp.einsum("ij,jk,k->i", jax.hessian(lambda y: jnp.prod(y[:1]) * jnp.cos(y @ y))(x), jnp.eye(4), x)


def table(x):
    return jnp.array([[0.0, 1.0, 2.0, 0.0]]).T * x[jnp.array([2, 0, 3, 3])] - 2.0 / x


def stamped(x):
    """Entries put and added at fixed places, some twice, as circuits are written."""
    put = jnp.zeros(4).at[1].add(x[0]).at[jnp.array([1, 2, 2])].add(-x[0] * x[1:]).at[3].set(jnp.sin(x[0]))
    return jax.jacfwd(lambda x: put.at[1:3].set(x[:2] * x[2]))(x) @ put


FUNCTIONS = [length, jacobian_times, nested, pieces, branches, with_jit, custom, hessian_in_parts, table, stamped]
X = jnp.array([0.3, 0.7, 1.1, 0.9])
V = jnp.array([1.0, -0.5, 0.25, 2.0])


def close(actual, expected):
    jax.tree.map(lambda a, e: np.testing.assert_allclose(a, e, rtol=1e-13, atol=1e-13), actual, expected)


def primitives(fn, *args):
    return [eqn.primitive.name for eqn in jax.make_jaxpr(fn)(*args).eqns]


def test_a_large_array_that_a_function_holds_is_not_taken_apart():
    def of_large(large):
        return jax.make_jaxpr(scalarise(lambda x: x * jnp.sum(large[0])))(jnp.ones(2)).jaxpr.eqns

    found = []
    jax.eval_shape(lambda large: found.extend(of_large(large)), jnp.ones((100, 100)))
    assert len(found) < 100


@pytest.mark.parametrize("fn", FUNCTIONS)
class TestScalarise:
    def test_is_scalar(self, fn):
        assert not {"dot_general", "gather", "scatter", "scatter-add"} & {*primitives(scalarise(fn), X)}

    def test_values(self, fn):
        result, expected = scalarise(fn)(X), fn(X)
        close(result, expected)
        assert (result.shape, result.dtype) == (expected.shape, expected.dtype)

    def test_single_precision(self, fn):
        x = X.astype(jnp.float32)
        assert scalarise(fn)(x).dtype == fn(x).dtype
        np.testing.assert_allclose(scalarise(fn)(x), fn(x), rtol=1e-5, atol=1e-5)

    def test_jvp(self, fn):
        close(jax.jvp(scalarise(fn), (X,), (V,)), jax.jvp(fn, (X,), (V,)))

    def test_grad(self, fn):
        close(jax.grad(lambda x: jnp.sum(jnp.sin(scalarise(fn)(x))))(X), jax.grad(lambda x: jnp.sum(jnp.sin(fn(x))))(X))

    def test_vmap(self, fn):
        xs = jnp.stack([X, X + 0.1, X * 2])
        close(jax.vmap(scalarise(fn))(xs), jax.vmap(fn)(xs))

    def test_jit(self, fn):
        close(jax.jit(scalarise(fn))(X), fn(X))


class TestPolynomials:
    """What cancels is found, and nothing else: x = (0, 1, 2, 3), first unknowns 0 to 3."""

    @pytest.mark.parametrize(
        "zero",
        [
            lambda x: (x[0] + x[1]) ** 2 - x[0] ** 2 - 2 * x[0] * x[1] - x[1] * x[1],
            lambda x: jnp.exp(x[0] * x[1]) * x[2] - x[2] * jnp.exp(x[1] * x[0]),
            lambda x: x[0] / (2 * x[1]) - 0.5 * x[0] / x[1],
            lambda x: (
                jax.jvp(lambda y: jnp.sin(y[0]) * y[1], (x,), (x,))[1] - x[1] * (x[0] * jnp.cos(x[0]) + jnp.sin(x[0]))
            ),
            lambda x: jnp.zeros(2).at[0].add(x[3]).at[0].add(-x[3])[0],
            lambda x: 0.3 * x[0] - 0.1 * x[0] - 0.2 * x[0],
            lambda x: jnp.where(x[0] > 0, x[1], x[1]) - x[1],
        ],
    )
    def test_zeros(self, zero):
        found = polynomials(lambda x: jnp.stack([zero(x), zero(x) + x[0]]), X)
        assert found is not None
        assert list(found) == [{}, {(0,): 1.0}]

    def test_no_zeros(self):
        function = lambda x: jnp.stack(
            [jnp.exp(x[0]) - jnp.exp(x[1]), x[0] ** 2 - x[0], 1e-9 * x[0], jnp.abs(x[0]) - x[0]]
        )
        assert all(polynomials(function, X))

    def test_what_is_traced_outside_is_an_unknown(self):
        seen = []

        def outer(c):
            seen.extend(polynomials(lambda x: jnp.stack([c * x[0] - x[0] * c, c * x[0]]), X))
            return c

        jax.jit(outer)(2.0)
        assert seen[0] == {}
        assert len(seen[1]) == 1

    def test_loops_and_large_functions_have_none(self):
        assert polynomials(lambda x: jax.lax.fori_loop(0, x[0].astype(int), lambda i, y: y + x, x), X) is None
        assert polynomials(lambda x: jnp.outer(x, x), jnp.ones(200)) is None


class TestScalariseStructure:
    def test_pytrees(self):
        result = scalarise(lambda p, k: {"a": (p["x"] * k, p["y"]), "n": None})({"x": X, "y": 2.0}, 3.0)
        close(result["a"][0], 3 * X)
        assert result["a"][1] == 2.0
        assert result["n"] is None

    def test_structural_zeros_are_not_multiplied(self):
        A = jnp.diag(jnp.array([2.0, 3.0, 4.0, 5.0]))
        assert primitives(scalarise(lambda x: A @ x), X).count("mul") == 4
        assert primitives(scalarise(lambda x: jnp.eye(4) @ x), X).count("mul") == 0
        assert "add" not in primitives(scalarise(lambda x: jnp.eye(4) @ x), X)

    def test_structural_zeros_of_a_jacobian(self):
        def products(x):
            return jax.jacfwd(lambda y: jnp.stack([y[0] * y[1], y[2] * y[3]]))(x) @ jnp.ones(4)

        # The two that are left are those of the value, which `jacfwd` computes and nobody asks for.
        assert primitives(scalarise(products), X).count("mul") == 2
        close(scalarise(products)(X), jnp.array([1.0, 2.0]))

    def test_a_traced_constant(self):
        close(jax.jit(lambda k: scalarise(lambda x: k * x)(X))(2.0), 2 * X)

    def test_a_custom_derivative_is_kept(self):
        at_zero = jnp.zeros(4)
        close(jax.jacfwd(scalarise(square_root))(at_zero), jnp.zeros((4, 4)))
        close(jax.jacrev(scalarise(square_root))(at_zero), jnp.zeros((4, 4)))

    @pytest.mark.parametrize(
        "fn",
        [
            jnp.sort,
            jnp.cumsum,
            lambda x: jnp.linalg.cholesky(jnp.eye(4) + jnp.outer(x, x)),
            lambda x: x.at[x[0].astype(int)].set(1),
        ],
    )
    def test_falls_back_to_the_plain_function(self, fn):
        plain = primitives(fn, X)
        assert primitives(scalarise(fn), X)[-len(plain) :] == plain
        close(scalarise(fn)(X), fn(X))

    def test_falls_back_at_a_traced_index(self):
        close(scalarise(lambda x, i: x[i])(X, jnp.array(2)), X[2])

    def test_falls_back_above_the_limit(self):
        def fn(x):
            return jnp.outer(x, x) @ x

        assert "dot_general" in primitives(scalarise(fn, limit=10), X)
        assert not {"dot_general", "gather", "scatter", "scatter-add"} & {*primitives(scalarise(fn), X)}


def loop(x):
    return jax.lax.fori_loop(0, 10, lambda _, y: y + 0.1 * jnp.sin(y), x)


def spd(x):
    return jnp.eye(4) + jnp.outer(x, x)


class TestUnsupported:
    def test_plain_arithmetic_has_none(self):
        assert unsupported(jax.make_jaxpr(loop)(X)) == ()

    @pytest.mark.parametrize(
        ("fn", "name"),
        [
            (lambda x: jnp.linalg.svd(spd(x))[1], "svd"),
            (lambda x: jax.pure_callback(np.asarray, jax.ShapeDtypeStruct((4,), x.dtype), x), "pure_callback"),
            (lambda x: jnp.fft.fft(x).real, "fft"),
        ],
    )
    def test_named_at_any_depth(self, fn, name):
        def deep(x):
            return jax.lax.fori_loop(0, 3, lambda _, y: jax.lax.cond(y[0] > 0, jax.jit(fn), lambda z: 2 * z, y * 1), x)

        if name == "svd":
            assert unsupported(jax.make_jaxpr(fn)(X)) == (name,)
        else:
            assert unsupported(jax.make_jaxpr(deep)(X)) == (name,)

    def test_the_former_name_says_so(self):
        with pytest.warns(DeprecationWarning, match="is called `compiler.unsupported`"):
            assert dae_jax.compiler.hindrances(jax.make_jaxpr(loop)(X)) == ()

    def test_one_scatter_window_does_not_hinder(self):
        assert unsupported(jax.make_jaxpr(lambda x: x.at[1].set(0))(X)) == ()

    def test_several_scatter_windows_hinder_xla(self):
        several = jax.make_jaxpr(lambda x: x.at[jnp.array([0, 2])].set(0))(X)
        assert unsupported(several) == ()
        assert xla_kernel.unsupported(several) == ("scatter",)


def is_marked(fn, *args):
    return "xla_cpu_small_call" in jax.jit(fn).lower(*args).as_text()


def is_native(fn, *args):
    return "@dae_jax_" in jax.jit(fn).lower(*args).as_text()


@pytest.fixture(params=["native", "xla"])
def is_one_kernel(request, monkeypatch):
    """Whether a function is one kernel, with our own compiler or without."""
    if request.param == "xla":
        monkeypatch.setattr(judge, "available", lambda: False)
        return is_marked
    return is_native


def two_results(p):
    return {"y": loop(p["x"]), "n": p["n"] + 1}


@pytest.mark.usefixtures("is_one_kernel")
class TestOneKernel:
    def test_is_one_kernel(self, is_one_kernel):
        assert is_one_kernel(one_kernel(loop, "forward"), X)
        assert not is_one_kernel(one_kernel(loop), X)
        assert not is_one_kernel(one_kernel(lambda x: jnp.fft.fft(loop(x)).real, "forward"), X)

    def test_configure(self):
        with configure(one_kernel=False):
            assert one_kernel(loop, "forward") is loop
        assert one_kernel(loop, "forward") is not loop

    @pytest.mark.parametrize("derivative", ["forward", "reverse", "any"])
    @pytest.mark.parametrize("fn", [loop, jacobian_times, lambda x: jnp.sort(loop(x))])
    def test_values(self, fn, derivative):
        close(jax.jit(one_kernel(fn, derivative))(X), fn(X))

    @pytest.mark.parametrize("derivative", ["forward", "reverse"])
    def test_vmap(self, derivative):
        xs = jnp.stack([X, 2 * X])
        close(jax.jit(jax.vmap(one_kernel(loop, derivative)))(xs), jax.vmap(loop)(xs))

    @pytest.mark.parametrize("derivative", ["forward", "reverse"])
    def test_vmap_of_what_would_scatter_is_one_kernel_too(self, derivative, is_one_kernel):
        """Lanes that write at places of their own cannot run in step in a kernel, but one after another."""

        def writes(x):
            i = jnp.argmax(x > 0.5)
            return jax.lax.fori_loop(0, 3, lambda k, y: y.at[(i + k) % 4].set(x[k] + y[0]), jnp.zeros(4))

        xs = jnp.stack([X, 2 * X, 0.1 * X])
        fused = jax.vmap(one_kernel(writes, derivative))
        close(jax.jit(fused)(xs), jax.vmap(writes)(xs))
        assert is_one_kernel(fused, xs)
        nested = jax.vmap(jax.vmap(one_kernel(writes, derivative)))
        twice = jnp.stack([xs, 3 * xs])
        close(jax.jit(nested)(twice), jax.vmap(jax.vmap(writes))(twice))

    def test_unused_arguments_do_no_harm(self):
        close(jax.jit(one_kernel(lambda x, y, z: loop(y), "forward"))(X, 2 * X, V), loop(2 * X))

    def test_forward_derivatives(self, is_one_kernel):
        fused = one_kernel(loop, "forward")
        close(jax.jit(jax.jacfwd(fused))(X), jax.jacfwd(loop)(X))
        close(jax.jit(jax.jacfwd(jax.jacfwd(fused)))(X), jax.jacfwd(jax.jacfwd(loop))(X))
        assert is_one_kernel(lambda x: jax.jvp(fused, (x,), (V,))[1], X)

    def test_reverse_derivatives(self):
        fused = one_kernel(loop, "reverse")
        close(jax.jit(jax.jacrev(fused))(X), jax.jacrev(loop)(X))

    @pytest.mark.parametrize("derivative", ["forward", "reverse", "any"])
    def test_pytrees_with_integers(self, derivative):
        result = jax.jit(one_kernel(two_results, derivative))({"x": X, "n": jnp.array(3)})
        close(result["y"], loop(X))
        assert result["n"] == 4

    def test_gradient_beside_integers(self):
        fused = one_kernel(two_results, "reverse")
        grad = jax.grad(lambda x: jnp.sum(fused({"x": x, "n": jnp.array(3)})["y"]))(X)
        close(grad, jax.grad(lambda x: jnp.sum(loop(x)))(X))


def test_what_our_compiler_gives_up_is_left_to_xla(monkeypatch):
    def gives_up(*_):
        raise Unsupported("LLVM: broken")

    monkeypatch.setattr(programs, "compiled", gives_up)
    fused = one_kernel(lambda x: loop(x) + 0.125, "forward")
    assert is_marked(fused, X)
    close(jax.jit(fused)(X), loop(X) + 0.125)
    xs = jnp.stack([X, 2 * X])
    close(jax.jit(jax.vmap(fused))(xs), jax.vmap(loop)(xs) + 0.125)


class TestProcessWide:
    def test_too_late(self):
        jnp.zeros(1).block_until_ready()
        with pytest.raises(RuntimeError, match="comes too late"):
            configure(process_wide=True)

    def test_in_a_program_of_its_own(self):
        program = (
            "import dae_jax; dae_jax.configure(process_wide=True); import jax; from dae_jax.scenes import pendulum; "
            "scene = pendulum(); "
            "sol = dae_jax.daesolve(scene.system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.0, None, scene.y0); "
            "assert abs(sol.ys[0] - scene.reference([1.0])[0]).max() < 1e-4; "
            "import os; assert 'small_while_loop' in os.environ['XLA_FLAGS']"
        )
        environment = {"JAX_PLATFORMS": "cpu", "PATH": "/usr/bin:/bin"}
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr


def test_printing_from_a_users_function_prevents_one_kernel(capfd):
    def force(t, q, v, args):
        jax.debug.print("t = {t}", t=t)
        return jnp.array([0.0, 9.81])

    system = dae_jax.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2)
    sol = dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 0.1, 0.05, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    assert np.isfinite(sol.ys[0]).all()
    assert "t = " in capfd.readouterr().out


@pytest.mark.usefixtures("is_one_kernel")
@pytest.mark.parametrize("function", [jnp.sin, lambda x: jnp.where(x > 1, 0.5 * x, x)])
def test_what_xla_would_share_among_threads_is_in_a_kernel_all_the_same(function):
    """A function of half a megabyte, in a loop of a length that is not known."""
    halved = subroutine(function)
    loop = lambda x, n: jax.lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, halved(c[1])), (0, x))[1]
    x = jnp.linspace(0.0, 3.0, 100_000)
    close(jax.jit(one_kernel(loop, "reverse"))(x, 3), loop(x, 3))
