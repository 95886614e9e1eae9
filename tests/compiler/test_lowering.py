"""What our compiler makes of a function gives what JAX gives: one element, and lanes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import compiler
from dae_jax.compiler import kernel_call, one_kernel
from dae_jax.compiler.emit.target import vector_size
from dae_jax.compiler.jaxprs.inline import Inlining
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import annotate, compiled, unsupported, written
from dae_jax.compiler.lower.lane_queue import main_loop
from dae_jax.compiler.thresholds import THRESHOLDS
from dae_jax.linalg.dense import solve


X = np.array([1.0, 2.0, -3.0])
LANES = 2 * vector_size() + 3


def elementary(x):
    y = jnp.abs(x) / 4
    return [
        jnp.sin(x), jnp.cos(x), jnp.tan(x), jnp.arcsin(y), jnp.arccos(y), jnp.arctan(x), jnp.sinh(x), jnp.cosh(x),
        jnp.tanh(x), jnp.arcsinh(x), jnp.arccosh(1 + y), jnp.arctanh(y), jnp.exp(x), jnp.exp2(x), jnp.expm1(x),
        jnp.log(y), jnp.log1p(y), jnp.power(y, x), jnp.cbrt(x), jax.lax.erf(x), jax.lax.erfc(x), jnp.arctan2(x, y),
        jnp.sqrt(y), jax.lax.rsqrt(y), jax.nn.sigmoid(x), x**3, x**-2, x**0, jnp.square(x),
    ]  # fmt: skip


def rounding(x):
    y = jnp.concatenate([x, x + 0.5, jnp.array([0.0, -0.0, jnp.inf, jnp.nan])])
    return [
        jnp.floor(y), jnp.ceil(y), jnp.round(y), jax.lax.round(y), jnp.sign(y), jnp.abs(y), jnp.isfinite(y), -y,
        jnp.maximum(y, x[0]), jnp.minimum(y, jnp.nan), jnp.clip(y, -1, 1), jnp.nextafter(y, 0.0), jnp.nextafter(y, 9.0),
        jnp.fmod(y, 0.7), jax.lax.rem(y, jnp.full_like(y, 0.7)),
    ]  # fmt: skip


def integers(x):
    i = (100 * x).astype(jnp.int32)
    zero = i - i
    return [
        i // 7, i % 7, jax.lax.div(i, zero), jax.lax.rem(i, zero), jax.lax.div(i, zero - 1), i << 2, i >> 1, i & 12,
        i | 3, i ^ 5, ~i, jnp.abs(i), jnp.sign(i), i.astype(jnp.uint8), i.astype(bool), (x > 0).astype(float),
        x.astype(jnp.float32), jnp.float32(x) * 3, (1e30 * x).astype(jnp.int32), jnp.argmax(x), jnp.argmin(x),
        jnp.maximum(i, 3), jnp.minimum(i, 3), i < 5, i != 3, x <= 2,
    ]  # fmt: skip


def complex_numbers(x):
    z = x[0] + 1j * x[1]
    w = z * z / (x[2] + 2j) - jnp.conj(z) + 3
    return [w.real, w.imag, jnp.abs(w), (w**3).real, jnp.where(x[0] > 1.1, w, z).imag, (1 / w).real, (-w).imag]


def reductions(x):
    a = jnp.outer(x, x) + jnp.arange(3.0)
    wide = jnp.linspace(0, x[0], 600).reshape(20, 30)
    return [
        jnp.sum(a, 0), jnp.max(a, 1), jnp.min(a), jnp.prod(a, 1), jnp.all(a > 0), jnp.any(a > 8, 0), jnp.cumsum(a, 1),
        jnp.cumprod(a, 0), jax.lax.cummax(a, 0, reverse=True), a @ x, a @ a.T, jnp.einsum("ij,kj->ik", a, a),
        jnp.sum(wide, 1), jnp.max(wide), wide.T[3:, ::2][::-1] @ wide[:10, :4], jnp.argmax(jnp.array([1.0, jnp.nan, 2.0]) * x),
        jnp.sum(jnp.concatenate([wide, 2 * wide], 1), 0), jnp.pad(wide, ((1, 2), (0, 1)))[:3],
    ]  # fmt: skip


def places(x):
    i = jnp.int32(x[1])
    table = jnp.arange(300.0) * x[0]
    return [
        x[i], x[i - 7], x.at[i].set(9.0), x.at[i].add(2.0), x.at[jnp.array([0, 2])].set(x[0]), x.at[99].set(1.0),
        jnp.take(table, 10 * i), jnp.take(table, jnp.array([3, 400]) * i), table[jnp.arange(100) * i % 300],
        jax.lax.dynamic_slice(table, (i,), (4,)), jax.lax.dynamic_update_slice(table, x, (297 + i,)),
        table.at[jnp.arange(5) * i].add(1.0), jnp.split(table, 3)[1][i],
    ]  # fmt: skip


def loops(x):
    def counted(c):
        return c[0] + 1, c[1] * 1.1 + x, (c[2] + c[0]) % 7

    def newton(y):
        return jax.lax.while_loop(lambda z: jnp.abs(z**2 - y) > 1e-9, lambda z: (z + y / z) / 2, y)

    def scanned(c, u):
        return c * 0.9 + u, (c[0], c * u)

    return [
        jax.lax.while_loop(lambda c: c[0] < 10 * x[0], counted, (0, x, 3)),
        jax.lax.fori_loop(0, 100, lambda i, y: y + 0.01 * jnp.sin(y + i), x),
        [newton(jnp.abs(y)) for y in x],
        jax.lax.scan(scanned, x, jnp.linspace(0, 1, 5)),
        jax.lax.scan(scanned, x, jnp.linspace(0, 1, 140), reverse=True),
        jax.lax.fori_loop(0, jnp.int32(3 * x[0]), lambda i, y: jax.lax.fori_loop(0, i, lambda _, z: z * 0.9, y), x),
    ]


def buffers(x):
    """What is written to must be a copy wherever something else still reads it."""
    start = jnp.zeros((300, 3)) + x

    def body(carry):
        i, a, b, y = carry
        old = a
        a = a.at[i].set(y)
        b = jax.lax.cond(y[0] > 0.7, lambda b: b.at[i].set(old[i] - y), lambda b: b, b)
        return i + 1, b, a, y * 0.99 + jnp.array([0, 1.0, 0]) * i

    i, a, b, y = jax.lax.while_loop(lambda c: (c[0] < 250) & (c[3][0] > x[0] * 0.3), body, (0, start, start, x))
    c = a.at[3].set(7.0)
    swapped = jax.lax.fori_loop(0, 3, lambda k, ab: (ab[1], ab[0] * 2), (a[:100], b[:100]))
    return [i, a, b, y, c, a[3], start, a[i - 5], jnp.sum(b, 0), b.T[1:, ::3] * 2, swapped, a[::-1][:2]]


def pieces(x):
    """What is updated by a piece of itself, or read after it was."""
    y = jnp.arange(60.0) * x[0]
    z = y.reshape(20, 3)
    return [
        y.at[1:].set(y[:-1]), y.at[:-1].set(y[1:]), jax.lax.dynamic_update_slice(y, y[::-1], (0,)),
        z.at[jnp.int32(x[0])].set(z[3]), y.at[jnp.arange(59)].set(y[1:] * x[1]), y.at[jnp.arange(59) + 1].add(y[:-1]),
    ]  # fmt: skip


def joined_loops(x):
    """What is used once is computed where it is used; what is used more often is there once."""
    a = jnp.linspace(0, x[0], 90)
    b = jnp.concatenate([jnp.zeros(1), a[:-1]]) - a
    c = jnp.stack([b[:45], b[45:]], 1)
    d = (c.T.reshape(2, 5, 9)[:, ::-1] * x[1] + 1)[:, 1:, None, ::2]
    e = jnp.sum(jnp.square(c), 1)[:, None] * c
    f, g = jnp.split(jnp.exp(-a) + b, 2)
    odd = jnp.pad(f[1::2], (1, 2)) - jnp.pad(g[:8], (3, 0), constant_values=2.0).sum()
    one = jnp.max(jnp.where(a > x[0] / 2, b, c[3, 1]))
    table = jnp.take(a, np.array([5, 3, 80, 81, 82, 2] * 5))
    return [
        b,
        c,
        d,
        e,
        f * g - jnp.cumsum(g[:1]),
        odd,
        one,
        jnp.argmin(jnp.square(a - x[1] / 3)),
        jnp.argmax(jnp.where(a > 1, jnp.nan, a)),
        table,
        jnp.argmin(jnp.sin(9 * a).reshape(45, 2), 0),
        jnp.argmax(jnp.sin(9 * a).reshape(30, 3), 1),
        a[2:88:3] + table[1:30],
        jnp.unstack(c, axis=1)[1] * 2,
        jnp.all(a < 7),
        jnp.take(a, 5),
        x[0] * jnp.where(jnp.arange(120)[:, None] > jnp.arange(7), 1.0, 2.0)[3],
        x[0] * (jnp.linspace(0, 1, 840).reshape(120, 7) * jnp.arange(120.0)[:, None])[3],
        jnp.take(a, np.zeros(0, int)),
        x[0] * jnp.sin(jnp.linspace(0, 1, 3000))[7::40],
        jnp.sum(jnp.outer(a, a[:30]) * b[:, None], 0),
        jnp.outer(a, a) @ b,
        jnp.power(a, jnp.arange(90) % 4),
    ]


def complex_arrays(x):
    z = (jnp.linspace(0, 1, 36) + 1j * x[0] * jnp.arange(36.0)).reshape(6, 6)
    i = jnp.int32(x[1])

    def eliminate(j, z):
        row = jax.lax.dynamic_index_in_dim(z, (j + i) % 6, 0, keepdims=False)
        return z.at[j].set(row * (1 / (z[j, j] + 3))) * 0.9

    w = jax.lax.fori_loop(0, 20, eliminate, z)
    short = jax.lax.dynamic_slice(z[0, :3], (i,), (1,))
    total = jnp.sum(w * jnp.conj(z)), jnp.sum(w[:2, :2]), jnp.prod(z[:2, 1])
    return [p(y) for y in (w, w @ z, w[i], short, jnp.where(w.real > 0, w, z), *total) for p in (jnp.real, jnp.imag)]


def choices(x):
    k = jnp.int32(x[0] * 2)
    return [
        jax.lax.cond(x[0] > 1.1, jnp.sin, lambda y: y / 3, x),
        jax.lax.switch(k, [lambda y: y, lambda y: 2 * y, lambda y: (y**2).at[0].set(5.0)], x),
        jax.lax.switch(k, [lambda y: jnp.zeros(200), lambda y: jnp.arange(200) * y[0]], x),
        jax.lax.cond(
            x[1] > 100, lambda y: (y, 1), lambda y: (jax.lax.cond(y[2] < -3, lambda z: -z, lambda z: z, y), 2), x
        ),
        jax.lax.select_n(k % 3, x, 2 * x, 3 * x),
    ]


FUNCTIONS = [
    elementary, rounding, integers, complex_numbers, reductions, places, loops, buffers, pieces, joined_loops,
    complex_arrays, choices,
]  # fmt: skip
# XLA's, the C library's and the C library's vector functions differ in the last places; what is iterated amplifies it.
CLOSE = {"rtol": 2e-13, "atol": 1e-14}


def flat(fn):
    return lambda *xs: jax.tree.leaves(fn(*xs))


@pytest.mark.parametrize("fn", FUNCTIONS)
def test_one_element(fn):
    jaxpr = jax.make_jaxpr(flat(fn))(X)
    assert unsupported(jaxpr) == ()
    found = jax.jit(compiled(jaxpr))(X)
    for a, b in zip(found, jax.jit(flat(fn))(X), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, **CLOSE)


@pytest.mark.parametrize("fn", FUNCTIONS)
@pytest.mark.parametrize("count", [1, LANES])
def test_lanes(fn, count):
    """Lanes go their own ways, also where the last vector is not full."""
    xs = X * np.random.default_rng(0).uniform(0.8, 1.4, (count, 1))
    found = jax.jit(compiled(jax.make_jaxpr(flat(fn))(X), (True,)))(xs)
    for a, b in zip(found, jax.jit(jax.vmap(flat(fn)))(xs), strict=True):
        np.testing.assert_allclose(a, b, **CLOSE)


def test_lanes_share_what_is_not_batched():
    def fn(x, y):
        shared = jax.lax.while_loop(lambda c: c[0] < 50, lambda c: (c[0] + 1, jnp.sin(c[1]) + 1), (0, y))[1]
        return shared, x * shared, jax.lax.cond(y[0] > 0, lambda: 2 * shared, lambda: shared) + x

    xs = np.stack([X + k for k in range(LANES)])
    jaxpr = jax.make_jaxpr(fn)(X, X)
    found = jax.jit(compiled(jaxpr, (True, False)))(xs, X)
    expected = jax.vmap(fn, (0, None), out_axes=0)(xs, X)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, **CLOSE)
    # The loop that all lanes share is a loop over single numbers.
    assert f"phi <{vector_size()} x double>" not in written(jaxpr, (True, False))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_precision_is_that_of_the_numbers(dtype):
    jaxpr = jax.make_jaxpr(lambda x: jnp.exp(jnp.sin(x)) / 3)(X.astype(dtype))
    (found,) = jax.jit(compiled(jaxpr))(X.astype(dtype))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, np.exp(np.sin(X)) / 3, rtol=4 * np.finfo(dtype).eps)


def test_what_is_written_once_is_not_kept_beyond_a_branch():
    def fn(x):
        y = jax.lax.cond(x[0] > 0, lambda: jnp.sum(jnp.sin(x)), lambda: 0.0)
        return y + jnp.sum(jnp.sin(x))

    for x in (X, -X):
        np.testing.assert_allclose(jax.jit(compiled(jax.make_jaxpr(lambda x: [fn(x)])(x)))(x)[0], fn(x), **CLOSE)


@pytest.mark.parametrize(
    ("fn", "name", "sentence"),
    [
        (jnp.fft.fft, "fft", "`fft` has no rule: c128[3] = fft c128[3]"),
        (
            lambda x: x.astype(jnp.float16), "convert_element_type",
            "float16 is no type of number that is compiled: f16[3] = convert_element_type f64[3]",
        ),
        (jax.lax.bessel_i1e, "bessel_i1e", "`bessel_i1e` has no rule: f64[3] = bessel_i1e f64[3]"),
        (
            lambda x: jax.lax.while_loop(lambda c: jnp.abs(c[0]) < 3, lambda c: jnp.exp(c), x[:1] + 0j).real, "exp",
            "`exp` of complex128 is not written: c128[1] = exp c128[1]",
        ),
        (lambda x: jax.debug.callback(print, x), "debug_callback", "`debug_callback` has side effects: = debug_callback f64[3]"),
    ],
)  # fmt: skip
def test_what_is_not_compiled_is_said(fn, name, sentence):
    jaxpr = jax.make_jaxpr(fn)(X)
    assert name in [found.primitive for found in unsupported(jaxpr)]
    assert sentence in list(map(str, unsupported(jaxpr)))
    assert str(annotate(jaxpr)) == str(unsupported(jaxpr)[0])
    with pytest.raises(Unsupported):
        written(jaxpr, ())


def test_too_large(monkeypatch):
    def fn(x):
        for _ in range(200):
            x = jnp.sin(x) + x[::-1]
        return x

    monkeypatch.setattr("dae_jax.compiler.lower.judge.THRESHOLDS", dataclasses.replace(THRESHOLDS, instructions=1000))
    assert [found.primitive for found in unsupported(jax.make_jaxpr(fn)(jnp.arange(100.0)))] == ["size"]


def stepping(x, times):
    """A loop as a solve is: most of the work, with something before and after it, a buffer, and its own number of turns."""
    scale = jnp.sum(jnp.sin(x)) + 2

    def step(carry):
        i, y, saved = carry
        saved = saved.at[i % 40].set(y * times[i % times.size])
        for _ in range(6):
            y = 0.99 * y + 0.01 * jnp.cos(scale * x[::-1])
        return i + 1, jax.lax.cond(y[0] > 0.7, lambda z: 0.9 * z, lambda z: z, y), saved

    count, y, saved = jax.lax.while_loop(
        lambda c: c[0] < 10 * jnp.abs(x[0]) ** 3, step, (0, x / scale, jnp.zeros((40, 3)))
    )
    return [count, y * scale, saved, jnp.max(saved, 0) + times[0]]


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("count", [1, 5, 100])
def test_lanes_are_refilled(shared, count):
    """Of lanes with 0 to 3,000 turns none holds up the others, and each gets what it gets alone."""
    random = np.random.default_rng(1)
    xs = X * random.permutation(np.linspace(0.1, 7, count))[:, None]
    times = np.linspace(1, 2, 30) if shared else random.uniform(1, 2, (count, 30))
    batched = (True, not shared)
    jaxpr = jax.make_jaxpr(stepping)(X, np.ones(30))
    assert main_loop(Inlining()(jaxpr)) is not None
    assert "ctpop" in written(jaxpr, batched)
    found = jax.jit(compiled(jaxpr, batched))(xs, times)
    expected = jax.jit(jax.vmap(stepping, (0, None if shared else 0)))(xs, times)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_a_loop_as_long_for_all_lanes_is_shared():
    def fn(x, y):
        return jax.lax.while_loop(
            lambda c: c[0][0] < 9, lambda c: (c[0] + 1 + 0.5 * jnp.sin(c[0]), jnp.cos(c[0]) * c[1]), (y, x)
        )

    jaxpr = jax.make_jaxpr(fn)(X, np.abs(X))
    assert main_loop(Inlining()(jaxpr)) is not None
    assert "ctpop" not in written(jaxpr, (True, False))
    assert "ctpop" in written(jaxpr, (False, True))
    xs = X * np.arange(1, LANES + 1)[:, None]
    found = jax.jit(compiled(jaxpr, (True, False)))(xs, np.abs(X))
    for a, b in zip(found, jax.vmap(fn, (0, None), out_axes=0)(xs, np.abs(X)), strict=True):
        np.testing.assert_allclose(a, b, **CLOSE)


def test_a_loop_that_is_little_of_the_work_is_not_taken_apart():
    assert main_loop(Inlining()(jax.make_jaxpr(flat(elementary))(X))) is None
    assert main_loop(Inlining()(jax.make_jaxpr(flat(loops))(X))) is None


def test_equal_equations_are_written_once():
    def fn(x):
        call = jax.jit(lambda y: jnp.sin(y) * 2.0)
        return call(x) + call(x), jnp.sin(x) * -0.0, jnp.sin(x) * 0.0, jnp.cos(x)[:0]

    names = [eqn.primitive.name for eqn in Inlining()(jax.make_jaxpr(fn)(X)).jaxpr.eqns]
    assert names.count("sin") == 1
    assert names.count("mul") == 3
    assert "jit" not in names


def test_what_is_used_once_takes_no_memory():
    def memory(fn):
        calls = [line for line in written(jax.make_jaxpr(fn)(X)).splitlines() if "call ptr @malloc" in line]
        return sum(int(line.rstrip(")").split()[-1]) for line in calls)

    line = lambda x: jnp.linspace(0, 1, 2000) * x[0]
    assert memory(lambda x: jnp.sum(jnp.exp(line(x)) * 3 + 1)) == 0
    assert 16_000 < memory(lambda x: jnp.sum(jnp.exp(line(x)) * line(x)[::-1] + 1)) < 17_000


def stores(fn, *args):
    return written(jax.make_jaxpr(fn)(*args)).count("\nstore ")


def test_a_loop_reads_few_numbers_of_many_entries_through_strides():
    """Masks of rows and a product of a column and a row, which an elimination has at each of its turns."""
    for n in (8, 16):
        assert stores(solve, np.eye(n), np.ones(n)) < 8 * n


def test_entries_that_are_read_at_several_computed_places_are_stored_once():
    def fn(x, i):
        table = jnp.sin(x)[:, None] * jnp.cos(x)[None, :] + jnp.arange(36.0).reshape(6, 6)
        picked = [table[i[0], i[1]], 2 * table[i[1], i[2]], jax.lax.cond(i[0] > 0, lambda: table[i[2], 0], lambda: 1.0)]
        return table[0, 1], sum(picked)

    x, i = np.arange(6.0), np.array([1, 3, 5])
    assert stores(fn, x, i) < 36 + 6
    for got, expected in zip(compiled(jax.make_jaxpr(fn)(x, i))(x, i), fn(x, i), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-14)


def test_long_chains_of_operations_are_cut():
    def fn(x):
        y = jnp.linspace(0, 1, 600) * x[0]
        for k in range(200):
            y = jnp.sin(y)[::-1] + k * 1e-3 if k % 3 else (y * 1.01).reshape(4, 150)[:, ::-1].reshape(-1)
        return y

    np.testing.assert_allclose(compiled(jax.make_jaxpr(fn)(X))(X)[0], fn(X), rtol=1e-12)


def test_what_our_compiler_stumbles_over_is_done_by_xla(monkeypatch):
    def fails(*_, **__):
        raise ValueError("unforeseen")

    monkeypatch.setattr(kernel_call.lower, "compiled", fails)
    with pytest.warns(RuntimeWarning, match="unforeseen"):
        np.testing.assert_allclose(jax.jit(one_kernel(lambda x: x * 2, "forward"))(X), 2 * X)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_next_number_is_that_of_numpy(dtype):
    """Also from and to the smallest numbers, which are zeros to the threads of XLA."""
    tiny = np.finfo(dtype)
    ends = [0.0, tiny.smallest_subnormal, 3 * tiny.smallest_subnormal, tiny.tiny, 1.0, tiny.max, np.inf]
    values = np.array([sign * x for x in ends for sign in (1, -1)] + [np.nan], dtype)
    x, y = map(np.ravel, np.meshgrid(values, values))
    found = np.asarray(compiler.jit(lambda x, y: jax.lax.fori_loop(0, 1, lambda i, z: jnp.nextafter(z, y), x))(x, y))
    with np.errstate(over="ignore", under="ignore"):
        expected = np.nextafter(x, y)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    number, bits = ~np.isnan(expected), f"i{dtype().nbytes}"
    np.testing.assert_array_equal(found[number].view(bits), expected[number].view(bits))


def of_rows(x, table):
    """What is read in order, along columns, from the end, at computed places, through a table, across a seam; sums over each axis."""
    rows, n = jnp.sin(x) * x[:, ::-1], x.shape[1]
    places = (jnp.abs(x[0]) * 7).astype(int) % n
    return [
        rows, rows.T * 2, rows @ rows.T, rows.T @ rows, rows[:, places] + table, jnp.cumsum(rows, 1), jnp.sum(rows, 0), jnp.sum(rows, 1),
        jnp.concatenate([rows + 1, table[:, :2] * x[:, :2]], 1) * 3, jnp.pad(rows - 1, ((0, 1), (2, 1))) / 2, rows > table,
        jnp.arange(n) * x[1], (10 * rows).astype(jnp.int32) // 3, jnp.where(rows > 0, table, rows), jnp.max(rows, 1), jnp.argmax(rows, 1),
        rows.at[1].add(table[0]), rows.at[:, places].set(table), jnp.float32(rows) * 3,
        jax.lax.fori_loop(0, 3, lambda i, y: y * 0.5 + rows, table),
    ]  # fmt: skip


@pytest.mark.parametrize("shape", [(9, 4), (9, 5), (6, 7), (3, 9), (3, 12), (3, 15), (3, 16), (3, 23)], ids=str)
def test_loops_over_arrays_are_of_vectors(shape):
    """Also of lengths that vectors do not divide: the last one is done again in part."""
    rng = np.random.default_rng(0)
    x, table = rng.normal(size=(2, *shape))
    expected = jax.jit(of_rows)(x, table)
    for found in (one_kernel(of_rows, "forward")(x, table), jax.tree.map(lambda y: y[1], jax.vmap(
        one_kernel(of_rows, "forward"), in_axes=(0, None))(np.stack([0 * x, x]), table))):  # fmt: skip
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6 if a.dtype == np.float32 else 1e-13, atol=1e-14)
    text = written(jax.make_jaxpr(lambda x, table: jnp.sin(table) * x + 1)(x, table))
    assert "load <8 x double>" in text
    assert "store <8 x double>" in text
    assert "gather" not in text
