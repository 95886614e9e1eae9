"""Primitives one by one, as our compiler and as XLA has them: a few numbers in registers, many in memory, and lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src.lax import lax as lax_total
from jax.extend.random import threefry2x32_p

from dae_jax.compiler import unsupported
from dae_jax.compiler.lower import annotate, compiled


LAX = jax.lax
LANES = 11


def edges(dtype, shape):
    """Numbers of a type, with its edges among them."""
    rng, dtype = np.random.default_rng(0), np.dtype(dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    if dtype.kind == "f":
        info = np.finfo(dtype)
        special = [0.0, -0.0, np.inf, -np.inf, np.nan, info.max, info.tiny, 1.0, -0.5, 2.5, 300.0]
    else:
        info, bits = np.iinfo(dtype), 8 * dtype.itemsize
        special = [info.min, info.min + 1, info.max, info.max - 1, info.max // 2 + 1, 0, 1, 2, 7, bits - 1, bits]
    ordinary = rng.normal(0, 3, shape) if dtype.kind == "f" else rng.integers(0, 100, shape)
    return np.where(rng.random(shape) < 0.4, rng.choice(np.array(special, dtype), shape), ordinary.astype(dtype))


def same(fn, *args, ulps=0, atol=0.0):
    """A function of batched arrays is the same by our compiler, alone and in lanes, and by XLA."""
    wanted = jax.tree.leaves(jax.jit(jax.vmap(fn))(*args))
    jaxpr = jax.make_jaxpr(lambda *xs: jax.tree.leaves(fn(*xs)))(*(x[0] for x in args))
    alone = jax.jit(compiled(jaxpr))(*(x[0] for x in args))
    lanes = jax.jit(compiled(jaxpr, (True,) * len(args)))(*args)
    for a, b, c in zip(alone, lanes, wanted, strict=True):
        assert a.dtype == b.dtype == c.dtype
        for found, expected in ((a, c[0]), (b, c)):
            if ulps and np.issubdtype(c.dtype, np.floating):
                np.testing.assert_allclose(found, expected, rtol=ulps * np.finfo(c.dtype).eps, atol=atol)
            else:
                np.testing.assert_array_equal(found, expected)
            if np.issubdtype(c.dtype, np.floating):
                signs = [np.signbit(y) & ~np.isnan(y) for y in (found, expected)]
                np.testing.assert_array_equal(*signs)


INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]


@pytest.mark.parametrize("dtype", [*INTEGERS, "bool"])
def test_bits(dtype):
    def fn(x, y):
        counts = [f(z) for z in (x, y) for f in (LAX.population_count, LAX.clz) if dtype != "bool"]
        return [*counts, *(jnp.bitwise_xor.reduce(z) for z in (x, y)), jnp.bitwise_xor.reduce(y.reshape(2, 20), 0)]

    same(fn, edges(dtype, (LANES, 5)), edges(dtype, (LANES, 40)))


@pytest.mark.parametrize(
    ("dtype", "to"), [("float64", "int64"), ("uint32", "float32"), ("uint16", "int16"), ("int8", "int8")]
)
def test_bits_as_another_type(dtype, to):
    cast = lambda x: LAX.bitcast_convert_type(LAX.bitcast_convert_type(x, to), dtype)
    fn = lambda x, y: [LAX.bitcast_convert_type(x, to), LAX.bitcast_convert_type(y, to), cast(x), cast(y[::-1])]
    # A number is read as what it is, also where XLA makes one of a signalling NaN.
    same(fn, *(np.nan_to_num(edges(dtype, (LANES, n)), nan=1.0) for n in (5, 40)))
    widened = jax.make_jaxpr(lambda x: LAX.bitcast_convert_type(x, "uint8"))(np.ones(3))
    assert "different widths" in str(annotate(widened))


@pytest.mark.parametrize("dtype", ["float32", "float64", "int32"])
def test_total_order(dtype):
    def fn(x, y):
        tables = [jnp.searchsorted(np.float64([*range(30)]) ** 2, z[:2].astype(float)) for z in (x, y)]
        compared = [
            f.bind(z, z[::-1]) for z in (x, y) for f in (lax_total.eq_to_p, lax_total.le_to_p, lax_total.lt_to_p)
        ]
        return [*compared, *tables]

    same(fn, edges(dtype, (LANES, 5)), edges(dtype, (LANES, 40)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_fewer_bits(dtype):
    def fn(x, y):
        return [LAX.reduce_precision(z, *bits) for z in (x, y) for bits in ((8, 7), (5, 10), (5, 23), (11, 52), (8, 3))]

    same(fn, edges(dtype, (LANES, 5)), edges(dtype, (LANES, 40)))


@pytest.mark.parametrize("dtype", ["float64", "int32", "uint8"])
def test_updates(dtype):
    def fn(x, y, k):
        i = jnp.stack([k, k - 1, k])
        places = [np.array([0, 2, 2]), i]
        return [
            f(z.at[at], z[:3])
            for z in (x, y)
            for at in places
            for f in (
                lambda r, u: r.multiply(u), lambda r, u: r.min(u), lambda r, u: r.max(u), lambda r, u: r.subtract(u),
                lambda r, u: r.add(u, mode="clip"),
            )
        ]  # fmt: skip

    same(fn, edges(dtype, (LANES, 5)), edges(dtype, (LANES, 40)), np.arange(LANES) * 5 - 9)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("reverse", [False, True])
def test_running_totals(axis, reverse):
    """Of many numbers as of a few."""

    def fn(x, y):
        found = []
        for z in (x.reshape(2, 3), y.reshape(5, 20)):
            whole = jnp.round(10 * z).astype(int)
            found += [LAX.cumsum(whole, axis, reverse), LAX.cumprod(whole, axis, reverse), LAX.cummin(z, axis, reverse)]
            found += [LAX.cummax(whole.astype("uint8"), axis, reverse)]
        return found

    def of_logarithms(x, y):
        return [LAX.cumlogsumexp(z, axis, reverse) for z in (x.reshape(2, 3), y.reshape(5, 20))]

    numbers = [np.random.default_rng(0).normal(0, 3, (LANES, n)) for n in (6, 100)]
    same(fn, *numbers)
    numbers[0][:, 0], numbers[1][:, 7] = -np.inf, np.inf
    same(of_logarithms, *numbers, ulps=30, atol=1e-15)


def test_what_is_a_primitive_in_some_versions_only():
    """As `einsum` and `searchsorted` are from JAX 0.12 on, and made of others before."""
    a = np.random.default_rng(1).normal(size=(3, 3))

    def fn(x):
        fraction, power = jnp.frexp(x)
        places = jnp.nonzero(x > 0, size=3, fill_value=0)[0]
        products = jnp.einsum("ij,j,k->ik", a, x, x), jnp.einsum("i,i->", x, x), jnp.einsum("ij,jk,k->i", a, a, x)
        return [*products, fraction, power, jnp.ldexp(fraction, power + 1), x[places]]

    x = np.random.default_rng(0).normal(size=(LANES, 3))
    same(fn, x, ulps=64)
    jaxpr = jax.make_jaxpr(jax.vmap(jax.grad(lambda x: sum(jnp.sum(y) for y in fn(x) if y.dtype == float))))(x)
    assert not unsupported(jaxpr)


def test_tables_of_any_size():
    """Searched in as many turns as its length has bits."""
    table = np.linspace(0, 1, 10_000) ** 2

    def fn(x):
        return [
            jnp.searchsorted(table, x),
            jnp.interp(x, table, np.sin(table)),
            jnp.searchsorted(table, x, side="right"),
        ]

    same(fn, np.random.default_rng(0).uniform(-0.1, 1.1, (LANES, 3)), ulps=8)


def test_negative_widths():
    """Padding by a negative width leaves entries out; the derivative of a product has some."""

    def fn(x, y):
        cut = [LAX.pad(z, 7.0, [(-2, 1, 1)]) for z in (x, y)]
        return [
            *cut,
            LAX.pad(y.reshape(4, 10), 7.0, [(1, -2, 0), (-3, -1, 2)]),
            jax.grad(jnp.prod)(x),
            jax.grad(jnp.prod)(y),
        ]

    same(fn, np.ones((LANES, 5)) * 2.0, np.full((LANES, 40), 0.5))


def test_many_complex_numbers():
    def fn(x):
        z = (x + 0.03j * x[::-1]).reshape(10, 6)
        return [
            f(w)
            for w in (jnp.prod(z), jnp.prod(z, 1), jnp.cumprod(z, 0), z**-2, jnp.square(z))
            for f in (jnp.real, jnp.imag)
        ]

    def equal(x, y):
        z = x + 1j * y
        return [f(w, w[::-1]) for w in (z, z[:4]) for f in (jnp.equal, jnp.not_equal)]

    same(fn, np.random.default_rng(0).uniform(0.5, 0.8, (LANES, 60)), ulps=10_000)
    same(equal, *np.random.default_rng(0).integers(0, 2, (2, LANES, 60)).astype(float))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_complex_numbers_by_zero(dtype):
    def quotient(a, b, c, d):
        z = LAX.complex(a, b) / LAX.complex(c, d)
        return [jnp.real(z), jnp.imag(z)]

    sizes = np.meshgrid([1.0, -2.0, 0.0], [3.0, -1.0, 0.0], [0.0, -0.0], [0.0, -0.0])
    numbers = np.stack([x.reshape(9, 4) for x in sizes]).astype(dtype)
    same(quotient, *numbers)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_special_functions(dtype):
    def fn(x, y):
        inside = [z / 4 for z in (x, y)]
        return [
            f(z) for z in (*inside, *(jnp.floor(z) for z in (x, y))) for f in (LAX.erf_inv, LAX.digamma, LAX.lgamma)
        ]

    rng = np.random.default_rng(0)
    numbers = [rng.uniform(-5, 5, (LANES, n)).astype(dtype) for n in (5, 40)]
    numbers[0][0] = [4, -4, 0, np.nan, np.inf]
    same(fn, *numbers, ulps=300, atol=20 * np.finfo(dtype).eps)


def test_random_bits():
    key = np.arange(2 * LANES, dtype=np.uint32).reshape(LANES, 2)
    hashed = lambda k, x, y: [z for c in (x, y) for z in threefry2x32_p.bind(k[0], k[1], c, c[::-1])]
    same(hashed, key, edges("uint32", (LANES, 4)), edges("uint32", (LANES, 40)))


def test_random_numbers():
    """Keys that are made, split and folded in, in loops and branches, of one type and as numbers."""

    def fn(seed, x):
        key = jax.random.key(seed)
        old, keys = jax.random.PRNGKey(seed), jax.random.split(key, 3)

        def turn(i, carry):
            key, total = carry
            key, now = jax.random.split(jax.random.fold_in(key, i))
            more = jax.lax.cond(
                total[0] > 0, lambda k: jax.random.uniform(k, (2,)), lambda k: -jax.random.uniform(k, (2,)), now
            )
            return key, total + more

        end, total = jax.lax.fori_loop(0, 4, turn, (key, x))
        each = jax.vmap(lambda k: jax.random.bits(k, (2, 2)))(keys)
        ends = [
            jax.random.key_data(end),
            jax.random.randint(keys[1], (3,), 0, 100),
            jax.random.bernoulli(keys[2], 0.3, (40,)),
        ]
        return [total, each, jax.random.normal(old, (3,)), *ends]

    same(fn, np.arange(LANES), np.random.default_rng(0).normal(size=(LANES, 2)), ulps=4)


@pytest.mark.parametrize("n", [1, 2, 6, 100])
@pytest.mark.parametrize("reverse", [False, True])
def test_running_sums_of_negative_zeros(n, reverse):
    """XLA begins those of several numbers at 0."""
    same(lambda x: [LAX.cumsum(x, 0, reverse), LAX.cumsum(x.astype("float32"), 0, reverse)], np.full((LANES, n), -0.0))
