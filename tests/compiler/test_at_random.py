"""Programs put together at random: what our compiler makes of them gives what XLA makes of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler.emit.target import vector_size
from dae_jax.compiler.lower import compiled


def pairs(a, b):
    """Rows of two numbers, and as many of `a` as there are rows."""
    rows = b[: b.size // 2 * 2].reshape(-1, 2) if b.size > 1 else jnp.stack([b, b], 1)
    return a[:9], rows


def scanned(a, b):
    first, rows = pairs(a, b)
    last, (sums, ends) = jax.lax.scan(lambda c, u: (c * 0.5 + u[0], (c[0] + u, c[-1:])), first, rows)
    return jnp.concatenate([last, sums.reshape(-1), ends.reshape(-1)])


def looped(a, k, which):
    body = lambda c: (c[0] + 1, c[1].at[c[0] % a.size].add(0.1)[::-1], c[1])
    return jax.lax.while_loop(lambda c: c[0] < 4 + k, body, (0, a, a))[1 + which]


# Of two vectors, a place k that is found at run time, and a known number s.
OPERATIONS = (
    lambda a, b, k, s: jnp.sin(a) + 0.3,
    lambda a, b, k, s: a[: b.size] * b[: a.size],
    lambda a, b, k, s: a[: b.size] - b[::-1][: a.size],
    lambda a, b, k, s: a[::-1],
    lambda a, b, k, s: jnp.concatenate([a[: a.size // 2], b[: b.size // 3] * 0.5, a[:1]]),
    lambda a, b, k, s: a.at[1:].set(a[:-1]),
    lambda a, b, k, s: a.at[s % a.size].set(b[0]),
    lambda a, b, k, s: jax.lax.dynamic_update_slice(a, b[: max(1, a.size // 2)][: a.size], (k,)),
    lambda a, b, k, s: jax.lax.dynamic_slice(a, (k,), (max(1, a.size // 2),)),
    lambda a, b, k, s: jnp.where(a[: b.size] > b[: a.size], a[: b.size], jnp.tanh(b[: a.size])),
    lambda a, b, k, s: jnp.cumsum(a[:8]),
    lambda a, b, k, s: jnp.take(a, np.arange(1 + s % 40) * s % a.size),
    lambda a, b, k, s: jnp.pad(a[::2], (s % 3, s % 4), constant_values=0.25),
    lambda a, b, k, s: a * jnp.sum(b) / (1 + jnp.max(jnp.abs(b))),
    lambda a, b, k, s: (pairs(b, a)[1].T * 0.5 + 1).reshape(-1),
    lambda a, b, k, s: jax.lax.fori_loop(0, 3 + s % 4, lambda i, c: jnp.roll(c, 1) * 0.9 + i, a),
    lambda a, b, k, s: jax.lax.cond(k > 1, lambda u, v: u.at[0].set(v[0]), lambda u, v: jnp.cos(u), a, b),
    lambda a, b, k, s: looped(a, k, s % 2),
    lambda a, b, k, s: jnp.sum(jnp.outer(a[:20], b[:30]), s % 2),
    lambda a, b, k, s: jnp.stack([a[: b.size], b[: a.size]], s % 2).reshape(-1),
    lambda a, b, k, s: a.at[np.array([0, a.size - 1])].set(jnp.stack([b[-1], a[0]])),
    lambda a, b, k, s: scanned(a, b),
)


def program(seed):
    """A function of three numbers, of 4 to 13 operations on vectors of 1 to 600."""
    rng = np.random.default_rng(seed)
    size = int(rng.choice([6, 20, 30, 64, 100, 600]))
    steps = [(OPERATIONS[rng.integers(len(OPERATIONS))], *rng.integers(0, 1000, 3)) for _ in range(rng.integers(4, 14))]

    def fn(x):
        found = [jnp.linspace(0.1, 1, size) * x[0], jnp.cos(jnp.arange(max(3, size // 2)) * x[1]), x * 1.0]
        for operation, i, j, s in steps:
            a, b = found[i % len(found)], found[j % len(found)]
            found.append(jnp.clip(operation(a, b, jnp.int32(jnp.abs(x[0]) * 3), int(s)), -50, 50)[:600])
        return found[-4:]

    return fn


@pytest.mark.parametrize("seed", range(12))
def test_random_programs(seed):
    fn = program(seed)
    rng = np.random.default_rng(seed)
    one, many = rng.uniform(-1.5, 1.5, 3), rng.uniform(-1.5, 1.5, (11, 3))
    jaxpr = jax.make_jaxpr(fn)(one)
    for found, wanted in (
        (jax.jit(compiled(jaxpr))(one), jax.jit(fn)(one)),
        (jax.jit(compiled(jaxpr, (True,)))(many), jax.jit(jax.vmap(fn))(many)),
    ):
        for a, b in zip(found, wanted, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8)

# Numbers of every type, in the order of their edges, and what may be done to them. XLA's compiler is asked once, for the
# largest batch: the elements of a smaller one are the same.
INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
BATCHES = (1, vector_size(), vector_size() + 1, 2 * vector_size() + 3)


def edges(dtype, rng, shape):
    """Numbers of a type, with its edges among them."""
    dtype = np.dtype(dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    if dtype.kind == "f":
        info = np.finfo(dtype)
        special = [0.0, -0.0, np.inf, -np.inf, np.nan, info.max, info.min, info.tiny, 1.0, -0.5, 2.5, 300.0]
    else:
        info, bits = np.iinfo(dtype), 8 * dtype.itemsize
        special = [info.min, info.min + 1, info.max, info.max - 1, info.max // 2 + 1, 0, 1, 2, 7, bits - 1, bits, bits + 1]
    ordinary = rng.integers(0, 100, shape).astype(dtype)
    return np.where(rng.random(shape) < 0.7, rng.choice(np.array(special, dtype), shape), ordinary)


def equal(fn, args, copied=False):
    """A function of batched arrays is the same by our compiler, alone and in batches, and by XLA; `copied`: and without
    any update in place.
    """
    wanted = jax.jit(jax.vmap(fn))(*args)
    jaxpr = jax.make_jaxpr(fn)(*(x[0] for x in args))
    for always_copies in (False, True) if copied else (False,):
        single = jax.jit(compiled(jaxpr, (), always_copies))
        lanes = jax.jit(compiled(jaxpr, (True,) * len(args), always_copies))
        for found, part in [
            ([x[None] for x in single(*(x[0] for x in args))], 1),
            *((lanes(*(x[:n] for x in args)), n) for n in BATCHES),
        ]:
            for k, (a, b) in enumerate(zip(found, wanted, strict=True)):
                assert a.dtype == b.dtype, k
                np.testing.assert_array_equal(a, b[:part], f"result {k}")


def of_integers(a, b):
    lax = jax.lax
    least = jnp.full_like(a, np.iinfo(a.dtype).max if a.dtype.kind == "u" else -1)
    return [
        lax.max(a, b), lax.min(a, b), lax.div(a, b), lax.rem(a, b), lax.div(a, least), a // b, a % b, a * b, a & b, ~a, -a,
        lax.sign(a), abs(a), a**3, a < b, a <= b, a > b, a >= b, lax.clamp(a[0], b, a[1]), lax.select_n(a > b, a, b),
        lax.shift_left(a, b), lax.shift_right_logical(a, b), lax.shift_right_arithmetic(a, b), a << 3, a >> 1, a @ b,
        lax.select_n(b.astype("int32"), a, b, a + b), lax.cummax(a), lax.cummin(a, reverse=True), jnp.cumsum(a), jnp.prod(a),
    ]  # fmt: skip


def of_floats(a, b):
    lax = jax.lax
    return [
        lax.max(a, b), lax.min(a, b), lax.sign(a), lax.floor(a), lax.round(a), lax.is_finite(a), -a, abs(a), a <= b, a != b,
        lax.nextafter(a, b), lax.rem(a, b), a + b, a * b, a / b, lax.sqrt(a), lax.clamp(a[0], b, a[1]), lax.cummax(a),
    ]  # fmt: skip


def of_all(a, b):
    pairs = a.reshape(-1, 2)
    return [
        jnp.max(a), jnp.min(b), jnp.argmax(a), jnp.argmin(b), jnp.max(pairs, 0), jnp.min(pairs, 1), jnp.argmin(pairs, 0),
        jnp.all(a), jnp.any(b), jnp.where(a == b, a, b),
    ]  # fmt: skip


def of_places(a, b, k):
    """Out of range: indices of any type, and windows that stick out."""
    return [
        a[k], jnp.take(a, k, mode="clip"), a.at[k].set(b[0]), a.at[k].set(b[1], mode="clip"),
        jax.lax.dynamic_slice(a, (k,), (2,)), jax.lax.dynamic_update_slice(a, b[:3], (k,)),
    ]  # fmt: skip


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint32", "int64", "uint64", "bool", "float32", "float64"])
def test_every_type(dtype):
    """A few numbers as values, and 60 in memory."""
    rng = np.random.default_rng(0)

    def fn(a, b, c, d, k):
        specific = of_integers if dtype in INTEGERS else of_floats if dtype != "bool" else lambda a, b: [a & b, ~a, a < b]
        converted = [jax.lax.convert_element_type(a, to) for to in (*INTEGERS, "bool", "float32", "float64")]
        places = [*of_places(a, b, k), *of_places(c, d, k)]
        return [*specific(a, b), *of_all(a, b), *of_all(c, d), *converted, *places]

    arrays = [edges(dtype, rng, (BATCHES[-1], size)) for size in (4, 4, 60, 60)]
    equal(fn, [*arrays, edges(dtype if dtype in INTEGERS else "int32", rng, BATCHES[-1])])


def updated(a, b, k, rng):
    """An array `a` changed: at places, by pieces of itself, by the other."""
    n = a.shape[0]
    i = (k + jnp.arange(3, dtype=k.dtype)) * int(rng.integers(1, 4)) - 1
    mode = str(rng.choice(["drop", "clip"]))
    m = int(rng.integers(1, n + 1))
    match rng.integers(10):
        case 0:
            return a.at[k].add(b[k - 1], mode=mode)
        case 1:
            return a.at[i].add(b[i], mode=mode)
        case 2:
            return a.at[k % n].set(b[0])
        case 3:
            return a.at[1:].set(a[:-1])
        case 4:
            return jax.lax.dynamic_update_slice(a, b[::-1][:m], (k,))
        case 5:
            return jnp.where(a > b, a, b)
        case 6:
            return a[::-1]
        case 7:
            return jnp.concatenate([b[m:], a[:m]])
        case 8:
            return jnp.minimum(a, b) + jnp.max(b[:m])
        case _:
            return a.at[:m].set(jax.lax.dynamic_slice(b, (k,), (m,)))


def block(rng, depth):
    """A function of two arrays and a number that gives such again, of updates and control flow."""
    steps = [step(rng, depth) for _ in range(rng.integers(2, 4))]

    def run(a, b, k):
        for each in steps:
            a, b, k = each(a, b, k)
            if a.dtype.kind == "f":  # what can be told apart exactly
                a, b = jnp.clip(a, -64, 64), jnp.clip(b, -64, 64)
        return a, b, k % 40

    return run


def step(rng, depth):
    seed, turns = int(rng.integers(1 << 30)), int(rng.integers(2, 6))
    inner = [block(rng, depth - 1) for _ in range(3)] if depth else []

    def update(a, b, k):
        rng = np.random.default_rng(seed)
        return (updated(a, b, k, rng), b, k + 1) if rng.random() < 0.7 else (b, updated(a, b, k, rng), k * 3 - 1)

    def kept(a, b, k):
        """Something reads the arrays again after they were changed."""
        c, d, j = inner[0](a, b, k)
        return c, jnp.where(a == d, b, d), j

    def rows(a, b, k):
        table = jnp.concatenate([a, b])[: a.size // 3 * 3].reshape(-1, a.size // 3)
        go = lambda c, row: (inner[0](c[0].at[: row.size].set(row), c[1], c[2]), c[0][:2])
        (a, b, k), ends = jax.lax.scan(go, (a, b, k), table, unroll=1 + seed % 2)
        return a, b.at[:2].set(ends[-1]), k

    def until(a, b, k):
        go_on = lambda c: (c[1] < turns) & (c[0][2] < 35)
        return jax.lax.while_loop(go_on, lambda c: (inner[0](*c[0]), c[1] + 1), ((a, b, k), 0))[0]

    choices = [
        lambda a, b, k: jax.lax.cond((k % 3 > 0) & (a[0] < b[-1]), *inner[:2], a, b, k),
        lambda a, b, k: jax.lax.switch(k % 4 - 1, inner, a, b, k),
        lambda a, b, k: jax.lax.cond(k % 2 == 0, inner[0], lambda a, b, k: (b, a, k), a, b, k),
        lambda a, b, k: jax.lax.fori_loop(0, 1 + k % turns, lambda i, c: inner[0](*c), (a, b, k)),
        until, rows, kept,
    ]  # fmt: skip
    return choices[rng.integers(len(choices))] if depth and rng.random() < 0.7 else update


@pytest.mark.parametrize("seed", [1, 3, 5, 12])
def test_who_writes_into_whose_memory(seed):
    """Scatters in branches and loops, in arrays on both sides of what is kept in memory: as XLA has it, and to the bit as
    with a copy at each step.
    """
    rng = np.random.default_rng([1, seed])
    size, dtype = int(rng.choice([3, 24, 25, 60])), str(rng.choice(["int32", "uint8", "int64", "float64", "uint32"]))
    run = block(rng, 2)
    first = rng.integers(0, 60, (2, BATCHES[-1], size)).astype(dtype)
    equal(lambda a, b, k: [*run(a, b, k)], [*first, rng.integers(-3, 30, BATCHES[-1]).astype("int32")], copied=True)


def memory_let_go(a, b, k):
    """The branch that comes last lets memory go, which what the first gives may not be in."""

    def last(a, b):
        c = (a + b).at[k].add(1)
        return (c[::-1] * 3 + c).at[k].add(2)

    return jax.lax.cond(k % 2 == 0, last, lambda a, b: (a[::-1] * 2).at[k].add(1), a, b)


def memory_of_rows(a, b, k):
    """What a loop reads at each turn is not let go by the first."""
    rows = jnp.stack([x[k % 3] * (i + 1) for x in (a, b) for i in range(50)]).reshape(4, 25)

    def turn(c, row):
        c = c.at[:25].add(row)
        for i in range(30):
            c = (c[::-1] + i).at[k].add(1)
        return c, c[0]

    # As large as what the rows are in.
    return jax.lax.scan(turn, jnp.concatenate([a, b, a, b]), rows)


def loops_in_step(a, b, k):
    """Of a loop with a condition for each of several elements those that are done stay as they are."""
    each = lambda x, n: jax.lax.while_loop(lambda c: c[1] < n, lambda c: (c[0] * 2 + c[1], c[1] + 1), (x, 0))[0]
    return jax.vmap(each)(jnp.stack([a, b, a - b]), jnp.stack([k % 5, k % 7, k % 3]))


@pytest.mark.parametrize("fn", [memory_let_go, memory_of_rows, loops_in_step])
def test_what_was_written_where_it_should_not(fn):
    rng = np.random.default_rng(0)
    first = rng.integers(0, 60, (2, BATCHES[-1], 25)).astype("int32")
    ks = rng.integers(-3, 30, BATCHES[-1]).astype("int32")
    equal(lambda a, b, k: jax.tree.leaves(fn(a, b, k)), [*first, ks], copied=True)
