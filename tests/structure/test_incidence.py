"""Dependence patterns read from jaxprs: those of numeric Jacobians, exact where constants decide."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest
from jax import lax

from dae_jax.compiler import gathered
from dae_jax.structure import dependence, sigma_method, signature
from dae_jax.structure.incidence import CALLS, CONTROL, RULES


N = 6
SPARSE = np.array([[2.0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0], [0, 3, 0, 0, 0, 0], [0, 0, -1, 4, 0, 0]])
TRIDIAGONAL = np.eye(N) * 4 + np.eye(N, k=1) + np.eye(N, k=-1)
BLOCKS = np.kron(np.eye(3), np.array([[3.0, 1], [1, 2]]))


@jax.custom_jvp
def doubled(x):
    return 2 * x


doubled.defjvp(lambda primals, tangents: (doubled(*primals), 2 * tangents[0]))


@jax.custom_vjp
def tripled(x):
    return 3 * x


tripled.defvjp(lambda x: (tripled(x), None), lambda _, ct: (3 * ct,))


@jax.custom_jvp
def rounded(x):
    return jnp.round(2.0**40 * x) / 2.0**40


rounded.defjvp(lambda primals, tangents: (rounded(*primals), tangents[0]))


def rotation(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def counted_loop(y):
    """A while loop whose length is known while tracing."""
    return lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, s[1].at[s[0]].multiply(s[1][s[0] + 1])), (0, y))[1]


def open_loop(y):
    """A while loop whose length depends on its state: each step moves y one place on."""
    return lax.while_loop(lambda s: jnp.sum(s**2) > 0.1, lambda s: 0.5 * jnp.concatenate([s[:1], s[:-1]]), y)


def recurrence(y):
    return lax.scan(lambda carry, x: (jnp.sin(carry) + x, carry * x), 1.0, y)[1]


def chain(q):
    q = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)])
    return jnp.sum(jnp.diff(q, axis=0) ** 2, 1) - 1


# Functions of N numbers whose pattern is that of their Jacobian at general points.
EXACT = {
    "elementwise": lambda y: jnp.sin(y) * jnp.exp(y[::-1]) + y**3 / (1 + y[0] ** 2),
    "literal zero": lambda y: 0.0 * y + y[2],
    "difference of slices": lambda y: y[1:] - y[:-1],
    "strided": lambda y: y[::2] * y[1::2],
    "constant matrix": lambda y: SPARSE @ y,
    "matrix of the left": lambda y: y @ jnp.asarray(SPARSE).T,
    "vmapped matrix": lambda y: jax.vmap(lambda row: jnp.dot(row, y))(SPARSE),
    "einsum": lambda y: jnp.einsum("ij,j,kj->ik", SPARSE, y, SPARSE[:2]),
    "batched product": lambda y: y.reshape(3, 2, 1) @ y.reshape(3, 1, 2),
    "rotation": lambda y: rotation(y[0]) @ y[1:4],
    "matrix with known zeros": lambda y: jnp.zeros((3, 3)).at[0, 1].set(y[0]).at[2, 2].set(y[5]) @ y[:3],
    "jacobian of a function": lambda y: jax.jacfwd(chain)(y),
    "reverse-mode jacobian": lambda y: jax.jacrev(chain)(y),
    "product with a jacobian": lambda y: jax.jacfwd(lambda q: chain(q)[:2])(y) @ jnp.cos(y),
    "reshape transpose": lambda y: y.reshape(2, 3).T.ravel() * 2,
    "stack": lambda y: jnp.stack([y[0], 2 * y[3], jnp.zeros(())]),
    "split": lambda y: jnp.split(y, 3)[1],
    "unstack": lambda y: jnp.unstack(y.reshape(3, 2))[2],
    "tile roll": lambda y: jnp.roll(jnp.tile(y, 2), 1),
    "pad": lambda y: lax.pad(y, 0.0, [(2, -1, 1)]),
    "pad with a variable": lambda y: lax.pad(y[:3], y[5], [(1, 1, 0)]),
    "outer": lambda y: jnp.outer(y[:2], y[4:]),
    "kron": lambda y: jnp.kron(jnp.eye(2), y.reshape(2, 3)),
    "cross": lambda y: jnp.cross(y[:3], y[3:]),
    "sums": lambda y: jnp.concatenate([y.reshape(2, 3).sum(0), y.reshape(2, 3).prod(1)]),
    "product with a known zero": lambda y: jnp.prod(jnp.stack([y, jnp.array([1.0, 0, 1, 1, 0, 1])]), 0),
    "cumsum": lambda y: jnp.cumsum(y),
    "reverse cumprod": lambda y: lax.cumprod(y, reverse=True),
    "cumlogsumexp": lambda y: lax.cumlogsumexp(y),
    "norm": lambda y: jnp.linalg.norm(y.reshape(3, 2), axis=1),
    "constant predicate": lambda y: jnp.where(np.arange(N) < 2, y, y[::-1]),
    "triangle": lambda y: jnp.tril(jnp.outer(y, jnp.ones(N))),
    "constant indices": lambda y: y[np.array([3, 3, 0])],
    "indices out of bounds": lambda y: y.at[jnp.array([1, 9])].get(mode="fill", fill_value=0.0),
    "two-dimensional indices": lambda y: y.reshape(2, 3)[np.array([0, 1]), np.array([2, 0])],
    "set": lambda y: y.at[jnp.array([0, 2])].set(y[4] ** 2),
    "add": lambda y: y.at[jnp.array([0, 0])].add(y[3:5]),
    "multiply row": lambda y: y.reshape(3, 2).at[1].multiply(y[0]),
    "drop": lambda y: y.at[jnp.array([8])].set(y[0], mode="drop"),
    "vmapped dynamic slice": lambda y: jax.vmap(lambda i: lax.dynamic_slice(y, (i,), (2,)))(jnp.arange(3)),
    "dynamic update": lambda y: lax.dynamic_update_slice(y, y[:2] ** 2, (jnp.array(3),)),
    "jit": lambda y: jax.jit(lambda a, b: (a[0] * b, b[1]))(y, y[2:])[0],
    "scan": recurrence,
    "reverse scan": lambda y: lax.scan(lambda c, x: (c + x, c + x), 0.0, y, reverse=True)[1],
    "scan over columns": lambda y: lax.scan(lambda c, x: (c * x, None), jnp.ones(2), y.reshape(3, 2))[0],
    "fori": lambda y: lax.fori_loop(1, N, lambda i, x: x.at[i].set(x[i] * x[i - 1]), y),
    "while": counted_loop,
    "vmapped gather": lambda y: jax.vmap(lambda a, i: a[i])(y.reshape(2, 3), jnp.array([2, 0])),
    "vmapped scatter": lambda y: jax.vmap(lambda a, i: a.at[i].set(a[0] * a[1]))(y.reshape(2, 3), jnp.array([2, 0])),
    "vmapped add": lambda y: jax.vmap(lambda a, i: a.at[i, 0].add(y[5]))(y.reshape(3, 2, 1), jnp.array([1, 0, 1])),
    "convolution in groups": lambda y: lax.conv_general_dilated(
        y.reshape(1, 2, 3), jnp.array([[[1.0, 0.0]], [[0.0, 2.0]]]), (1,), "VALID", feature_group_count=2
    ),
    "known cond": lambda y: lax.cond(np.array(3) > 2, lambda a: a[:3], lambda a: a[3:], y),
    "cond": lambda y: lax.cond(y[0] > 0, lambda a: jnp.sin(a), lambda a: a**2, y),
    "switch": lambda y: lax.switch(jnp.array(1), [lambda a: a[0], lambda a: a[1], lambda a: a[2]], y),
    "map": lambda y: lax.map(lambda x: x**2, y),
    "associative scan": lambda y: lax.associative_scan(jnp.add, y),
    "custom jvp": doubled,
    "custom jvp of what jumps": lambda y: rounded(y[::-1]) + jnp.round(y),
    "vmapped while": lambda y: jax.vmap(
        lambda x, n: lax.while_loop(lambda s: s[1] < n, lambda s: (s[0] * x, s[1] + 1), (1.0, 0))[0]
    )(y, jnp.arange(N)),
    "remat": jax.checkpoint(lambda y: jnp.sin(y[::-1])),
    "relu": jax.nn.softplus,
    "clamp": lambda y: jnp.clip(y, -100 * y[0] ** 2, 100 * y[1] ** 2 + 1) + y[0] * y[1],
    "power": lambda y: y[:3] ** jnp.array([0.0, 2.0, 3.0]),
    "conversion": lambda y: y.astype(jnp.float16).astype(jnp.float32),
    "fft": lambda y: jnp.fft.rfft(y.reshape(2, 3)).real,
    "convolution": lambda y: jnp.convolve(y, np.array([1.0, 0.0, -1.0]), mode="valid"),
    "convolution of variables": lambda y: jnp.convolve(y[:4], y[4:]),
    "constant solve": lambda y: jnp.linalg.solve(BLOCKS, y),
    "diagonal solve": lambda y: jnp.linalg.solve(jnp.diag(1 + y**2), jnp.array([1.0, 0, 0, 1, 1, 1])),
    "batched solve": lambda y: jax.vmap(lambda x: jnp.linalg.solve(jnp.eye(2) * x**2 + 1, jnp.ones(2)))(y),
    "triangular solve": lambda y: jax.scipy.linalg.solve_triangular(BLOCKS, y * y, lower=True),
    "transposed triangular solve": lambda y: jax.scipy.linalg.solve_triangular(BLOCKS, y, lower=True, trans=1),
    "solve from the right": lambda y: lax.linalg.triangular_solve(BLOCKS, y[None], lower=False),
    "determinant": lambda y: jnp.linalg.det(y[:4].reshape(2, 2)),
    "constant Cholesky": lambda y: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(BLOCKS), y),
    "eigenvalues": lambda y: jnp.linalg.eigvalsh(jnp.outer(y[:3], y[:3]) + jnp.diag(y[:3])),
    "tridiagonal": lambda y: lax.linalg.tridiagonal_solve(
        jnp.r_[0, jnp.ones(5)], 4 + y**2, jnp.r_[jnp.ones(5), 0], y[:, None]
    ),
    "nested": lambda y: jax.jit(jax.vmap(lambda x: lax.cond(x > 0, jnp.sin, jnp.cos, x)))(y),
    "chain": chain,
    "random constants": lambda y: y * jax.random.normal(jax.random.key(0), (N,)),
}

# Functions whose pattern is larger than that of their Jacobian at any one point.
CONTAINED = {
    "sort": jnp.sort,
    "sort by key": lambda y: lax.sort([y, 2 * y[::-1]], num_keys=1)[1],
    "maximum": lambda y: jnp.max(y.reshape(2, 3), axis=1),
    "top": lambda y: lax.top_k(y, 2)[0],
    "index": lambda y: y[jnp.argmin(y)],
    "indices": lambda y: y.reshape(2, 3)[:, (10 * y[:2] ** 2).astype(int) % 3],
    "dynamic slice": lambda y: lax.dynamic_slice(y, (jnp.argmax(y),), (3,)),
    "dynamic update": lambda y: lax.dynamic_update_slice(y, y[:2] ** 2, (jnp.argmax(y),)),
    "scatter": lambda y: y.at[jnp.argmax(y)].set(y[0]),
    "interpolation": lambda y: jnp.interp(y, np.linspace(-2, 2, 9), np.linspace(-2, 2, 9) ** 2),
    "while": open_loop,
    "vmapped while": lambda y: jax.vmap(lambda x: lax.while_loop(lambda s: s < 9, lambda s: 2 * s + x**2 + 1, x))(y),
    "branches": lambda y: lax.cond(y[0] > 0, lambda a: a[:3], lambda a: a[3:], y),
    "where": lambda y: jnp.where(y > 0, y, y[::-1]),
    "pseudo-inverse": lambda y: jnp.linalg.pinv(y.reshape(2, 3)),
    "solve": lambda y: jnp.linalg.solve(TRIDIAGONAL + jnp.outer(y, y), y),
    "Cholesky": lambda y: jnp.linalg.cholesky(jnp.outer(y, y) + N * jnp.eye(N)),
    "reduce": lambda y: lax.reduce(y.reshape(2, 3), 1.0, lax.mul, (0,)),
}


def numeric_pattern(fn, seeds=6):
    """The union of the nonzeros of the Jacobian at random points."""
    points = np.random.default_rng(0).normal(size=(seeds, N))
    jacobians = jax.jit(jax.vmap(jax.jacfwd(lambda y: jnp.ravel(fn(y)))))(jnp.asarray(points))
    return np.any(np.asarray(jacobians) != 0, axis=0)


@pytest.mark.parametrize("name", EXACT)
def test_pattern_is_that_of_the_jacobian(name):
    fn, y = EXACT[name], jnp.ones(N)
    (pattern,) = dependence(fn, y, derivative=True)
    np.testing.assert_array_equal(pattern, numeric_pattern(fn))
    (by_value,) = dependence(fn, y)
    assert not (pattern & ~by_value).any()


@pytest.mark.parametrize("name", CONTAINED)
def test_pattern_contains_that_of_the_jacobian(name):
    fn, y = CONTAINED[name], jnp.ones(N)
    (pattern,) = dependence(fn, y, derivative=True)
    assert not (numeric_pattern(fn) & ~pattern).any()
    (by_value,) = dependence(fn, y)
    assert not (pattern & ~by_value).any()


def test_entries_replaced_by_a_function_of_them():
    """They depend on what was there. JAX has no derivative of it."""
    (pattern,) = dependence(lambda y: y[::-1].at[jnp.array([0, 2])].apply(jnp.sin), jnp.ones(N))
    np.testing.assert_array_equal(pattern, np.eye(N)[::-1])


@pytest.mark.parametrize("name", [*EXACT, *CONTAINED])
def test_whatever_moves_depends(name):
    """An output that changes when one input alone is changed is in the pattern of dependence by value."""
    fn = EXACT.get(name) or CONTAINED[name]
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 1, N))
    moved = points + np.eye(N) * rng.normal(size=(20, 1, N))
    flat = jax.jit(jax.vmap(lambda y: jnp.ravel(fn(y))))
    before, after = (np.asarray(flat(jnp.asarray(y.reshape(-1, N)))) for y in (points + 0 * moved, moved))
    changed = (~np.isclose(before, after, rtol=1e-3, atol=1e-3)).reshape(20, N, -1).any(0).T
    assert not (changed & ~dependence(fn, jnp.ones(N))[0]).any()


def test_custom_vjp_is_read_by_its_function():
    np.testing.assert_array_equal(dependence(lambda y: tripled(y)[1:], jnp.ones(3))[0], np.eye(3)[1:])


def test_more_inputs_than_a_machine_word_has_bits():
    """Scalars are the hard case: numpy turns lone Python integers into its own."""
    (pattern,) = dependence(
        lambda y: jnp.stack([jnp.where(y[0] > 0, y[i] * y[64], 0.0) for i in range(130)]), jnp.ones(130)
    )
    expected = np.eye(130, dtype=bool)
    expected[:, [0, 64]] = True
    np.testing.assert_array_equal(pattern, expected)


def rows(*args, **kwargs):
    return [set(np.flatnonzero(row).tolist()) for row in dependence(*args, **kwargs)[0]]


def test_choice_depends_on_what_is_chosen_by():
    """By value, the predicate counts; by derivative, it does not."""
    y = jnp.ones(3)
    for fn in (
        lambda y: jnp.where(y[2] > 0, y[:2], 5.0),
        lambda y: lax.cond(y[2] > 0, lambda a: a[:2], lambda a: 2 * a[:2], y),
    ):
        assert rows(fn, y) == [{0, 2}, {1, 2}]
        assert rows(fn, y, derivative=True) == [{0}, {1}]
    for flat in (jnp.floor, jnp.sign, lax.stop_gradient, lambda y: (y > 0).astype(float), lambda y: y.astype(int)):
        assert rows(flat, y) == [{0}, {1}, {2}]
        assert rows(flat, y, derivative=True) == [set(), set(), set()]


def test_index_that_is_an_argument():
    y, i = jnp.ones(4), jnp.array(1)
    values, index = dependence(lambda y, i: y.at[i].set(0.0), y, i)
    np.testing.assert_array_equal(values, np.eye(4))
    assert index.all()
    values, index = dependence(lambda y, i: lax.dynamic_slice(y, (i,), (3,)), y, i)
    np.testing.assert_array_equal(values, [[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]])
    assert index.all()
    (values, _) = dependence(lambda y, i: y.reshape(2, 2)[jnp.array([0, 1]), jnp.stack([i, 1])], y, i)
    np.testing.assert_array_equal(values, [[1, 1, 0, 0], [0, 0, 0, 1]])


def test_loop_of_unknown_length():
    """What the loop leaves alone does not depend on when it ends; what it moves may have come from any step."""

    def fn(y, n):
        def body(i, state):
            kept, moved = state
            return kept, jnp.roll(moved, 1)

        return lax.fori_loop(0, n, body, (y[:2], y[2:]))

    kept_and_moved, length = dependence(fn, jnp.ones(5), 3)
    np.testing.assert_array_equal(kept_and_moved, np.kron([[1, 0], [0, 1]], np.ones((3, 3)))[1:, 1:] * _left_alone(2))
    np.testing.assert_array_equal(length[:, 0], [0, 0, 1, 1, 1])


def _left_alone(n):
    mask = np.ones((5, 5))
    mask[:n, :n] = np.eye(n)
    return mask


def test_long_scan_is_summarised(monkeypatch):
    monkeypatch.setattr("dae_jax.structure.incidence_control.LONGEST_LOOP", 3)
    pattern = dependence(recurrence, jnp.ones(N))[0]
    assert pattern.shape == (N, N)
    assert not (numeric_pattern(recurrence) & ~pattern).any()


def test_empty_loops():
    y = jnp.ones(3)
    assert rows(lambda y: lax.fori_loop(0, 0, lambda i, x: x[::-1], y), y) == [{0}, {1}, {2}]
    assert rows(lambda y: lax.scan(lambda c, x: (c + x, x), y[0], jnp.zeros(0))[0], y) == [{0}]


def test_whether_an_argument_is_used_at_all():
    def fn(t, state, args):
        q, v = state["q"], state["v"]
        return q * args[0] + 0.0 * t, jax.jit(lambda a, b: a)(q, v)

    t, state, args = dependence(fn, 0.0, {"q": jnp.ones(2), "v": jnp.ones(2)}, (jnp.ones(()), None))
    assert (t.shape, state.shape, args.shape) == ((4, 1), (4, 4), (4, 1))
    assert not t.any()
    np.testing.assert_array_equal(state, [[1, 0, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
    np.testing.assert_array_equal(args, [[1], [1], [0], [0]])


def test_no_arguments_and_no_outputs():
    assert dependence(lambda y: (), jnp.ones(3))[0].shape == (0, 3)
    assert dependence(lambda a, y: y, (), jnp.ones(2))[0].shape == (2, 0)


def test_shapes_alone_are_enough():
    shape = jax.ShapeDtypeStruct((4,), jnp.float32)
    assert rows(lambda y: y[1:] * y[:-1], shape) == [{0, 1}, {1, 2}, {2, 3}]


def test_analysis_while_an_outer_function_is_traced():
    """Constants are evaluated; what the outer function varies is unknown, also where it happens to be 0."""
    found = []

    @jax.jit
    def outer(stiffness, y):
        found.append(rows(lambda y: SPARSE @ y + stiffness * y[0], y))
        found.append(rows(lambda y: y.at[jnp.array([0, 2])].set(jnp.sin(0.0) * y[:2]), y))
        return y

    outer(0.0, jnp.ones(N))
    assert found[0] == [{0, 5}, {0}, {0, 1}, {0, 2, 3}]
    assert found[1] == [set(), {1}, set(), {3}, {4}, {5}]
    assert rows(lambda y: SPARSE @ y + 0.0 * y[0], jnp.ones(N)) == [{0, 5}, set(), {1}, {2, 3}]


def test_unknown_primitives_are_refused():
    def call(y):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(y.shape, y.dtype), y)

    with pytest.raises(NotImplementedError, match="pure_callback"):
        dependence(lambda y: jax.jit(call)(y) + 1, jnp.ones(3))


def test_each_primitive_has_one_rule():
    assert not set(RULES) & set(CALLS)
    assert not set(RULES) & set(CONTROL)


def pendulum(t, y, dy):
    """First order form, y = (x, y, u, v, λ)."""
    q, v, lam = y[:2], y[2:4], y[4]
    return jnp.concatenate([dy[:2] - v, dy[2:4] + lam * q + jnp.array([0.0, 9.81]), (q @ q - 1.0)[None] / 2])


def double_pendulum(t, y, dy):
    """First order form, y = (q, v, λ) with q = (x1, y1, x2, y2), masses 1 and rods 1."""
    q, v, lam = y[:4], y[4:8], y[8:]

    def constraint(q):
        return jnp.array([q[:2] @ q[:2], (q[2:] - q[:2]) @ (q[2:] - q[:2])]) / 2 - 0.5

    force = jnp.array([0.0, -9.81, 0.0, -9.81]) - jax.vjp(constraint, q)[1](lam)[0]
    return dy[:4] - v, dy[4:8] - force, constraint(q)


@pytest.mark.parametrize(
    ("residual", "n", "c", "dof"),
    [(pendulum, 5, (1, 1, 0, 0, 2), 2), (double_pendulum, 10, (1, 1, 1, 1, 0, 0, 0, 0, 2, 2), 4)],
)
def test_structure_of_pendulums(residual, n, c, dof):
    t, *patterns = dependence(residual, 0.0, jnp.ones(n), jnp.ones(n), derivative=True)
    analysis = sigma_method(signature(*patterns))
    assert not t.any()
    assert (analysis.index, analysis.equation_offsets, analysis.degrees_of_freedom) == (3, c, dof)


def test_signature_takes_the_highest_derivative():
    zeroth, first = np.array([[1, 1], [0, 1]], bool), np.array([[1, 0], [0, 0]], bool)
    assert signature(zeroth, first) == [{0: 1, 1: 0}, {1: 0}]


def test_thousand_variables():
    """Sparse work only: a dense pattern of every intermediate array would be 10^9 entries."""

    def fn(y):
        state, _ = lax.scan(lambda c, i: (c.at[i].add(jnp.sin(c[i - 1])), None), y, jnp.arange(1, 2000, 10))
        return jnp.diff(state.reshape(1000, 2), axis=0).sum(1)

    pattern = dependence(fn, jnp.ones(2000))[0]
    assert pattern.shape == (999, 2000)
    assert pattern.sum(1).max() <= 6


def _gather(x, i, **numbers):
    mode = numbers.pop("mode", "fill")
    sizes = numbers.pop("slice_sizes")
    return x, i, jax.lax.GatherDimensionNumbers(**numbers), sizes, mode


GATHERS = {
    "rows": _gather((5, 3), [[4], [0], [2]], offset_dims=(1,), collapsed_slice_dims=(0,), start_index_map=(0,), slice_sizes=(1, 3)),
    "entries, one outside": _gather(
        (4, 3), [[0, 2], [3, 1], [4, 0]], offset_dims=(), collapsed_slice_dims=(0, 1), start_index_map=(0, 1), slice_sizes=(1, 1)
    ),
    "windows, clipped": _gather(
        (5, 4), [[[3, 3]], [[-1, 0]]], offset_dims=(0, 2), collapsed_slice_dims=(), start_index_map=(1, 0),
        slice_sizes=(2, 3), mode="clip",
    ),
    "a batch": _gather(
        (2, 3), [[[1], [0]], [[2], [2]]], offset_dims=(), collapsed_slice_dims=(1,), start_index_map=(1,),
        operand_batching_dims=(0,), start_indices_batching_dims=(0,), slice_sizes=(1, 1),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GATHERS)
def test_a_gather_on_numbers_is_that_of_jax(name):
    shape, indices, numbers, sizes, mode = GATHERS[name]
    places, indices = np.arange(np.prod(shape)).reshape(shape), np.array(indices)
    expected = jax.lax.gather(places, indices, numbers, sizes, mode=mode, fill_value=-1)
    np.testing.assert_array_equal(gathered(places, indices, numbers, sizes, mode), expected)
