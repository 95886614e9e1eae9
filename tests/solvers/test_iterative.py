"""Solves whose linear equations GMRES solves, beside exact solutions and solves by factors.

u̇ = k Δu − p, 0 = Δp + u in a cube of N³ points with u = p = 0 outside: one sine wave, of which λ is what −Δ makes of it, is

    u = e^(−(k λ + 1/λ) t) sin x sin y sin z,   p = u/λ.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import BDF, GMRES, DummyDerivatives, ImplicitDAE, Radau, RadauIIA5


N = 4
HALF_AN_ANGLE = np.pi / 2 / (N + 1)
LAMBDA = 12 * (N + 1) ** 2 * np.sin(HALF_AN_ANGLE) ** 2
K, END = 0.1, 0.3


def residual(t, y, yd, k):
    u, p = y["u"], y["p"]
    return {"u": yd["u"] - k * laplacian(u) + p, "p": laplacian(p) + u}


def laplacian(u):
    x = jnp.pad(u, 1)
    inner = slice(1, -1)
    beside = [jnp.roll(x, way, axis)[inner, inner, inner] for axis in range(3) for way in (-1, 1)]
    return (sum(beside) - 6 * u) * (N + 1) ** 2


SYSTEM = ImplicitDAE(residual)


def start():
    wave = jnp.sin(2 * HALF_AN_ANGLE * jnp.arange(1, N + 1))
    u = jnp.einsum("i,j,k->ijk", wave, wave, wave)
    return {"u": u, "p": u / LAMBDA}


def exact(k, t=END):
    return jnp.exp(-(k * LAMBDA + 1 / LAMBDA) * t) * start()["u"]


def solve(solver, k=K, y0=None, rtol=1e-7, system=SYSTEM, **options):
    return dae_jax.daesolve(
        system, solver, 0.0, END, None, start() if y0 is None else y0, k,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), **options,
    )  # fmt: skip


def of_waves(c, b):
    """A⁻¹ b for A = [[−λ, 1], [1, c + k λ]] in each wave, p before u, at a c with which `c` = c + 6 k/h²."""
    sines = np.sqrt(2 / (N + 1)) * np.sin(2 * HALF_AN_ANGLE * np.outer(np.arange(1, N + 1), np.arange(1, N + 1)))
    waves = lambda x: jnp.einsum("ia,jb,kc,abc->ijk", sines, sines, sines, x.reshape(N, N, N))
    line = 4 * (N + 1) ** 2 * np.sin(HALF_AN_ANGLE * np.arange(1, N + 1)) ** 2
    size = line[:, None, None] + line[:, None] + line
    on_p, on_u = waves(b[: N**3]), waves(b[N**3 :])
    on_diagonal = c + K * (size - 6 * (N + 1) ** 2)
    u = (on_p + size * on_u) / (1 + size * on_diagonal)
    return jnp.concatenate([waves((u - on_p) / size).reshape(-1), waves(u).reshape(-1)])


def by_waves(matrix):
    rows, columns = matrix.indices.T
    c = jnp.sum(jnp.where((rows == columns) & (rows >= N**3), matrix.data, 0)) / N**3
    return jax.tree_util.Partial(of_waves, c)


WAYS = {
    "BDF, incomplete factors": BDF(linear_solver=GMRES()),
    "BDF, the user's": BDF(linear_solver=GMRES(by_waves)),
    "Radau, incomplete factors": RadauIIA5(linear_solver=GMRES()),
    "Radau, the user's": RadauIIA5(linear_solver=GMRES(by_waves)),
    "Radau of variable order": Radau(linear_solver=GMRES(by_waves)),
}


@pytest.mark.parametrize("way", WAYS)
def test_is_as_accurate_as_by_factors(way):
    sol = solve(WAYS[way])
    np.testing.assert_allclose(sol.ys["u"][0], exact(K), atol=2e-6)
    np.testing.assert_allclose(sol.ys["p"][0], exact(K) / LAMBDA, atol=2e-6)
    by_factors = solve(type(WAYS[way])())
    assert abs(sol.stats["num_steps"] - by_factors.stats["num_steps"]) <= 2
    assert sol.stats["num_factorisations"] < sol.stats["num_steps"]


@pytest.mark.parametrize("way", ["BDF, the user's", "Radau, incomplete factors"])
def test_derivatives_are_exact(way):
    loss = lambda k, **options: jnp.sum(solve(WAYS[way], k, rtol=1e-8, max_steps=500, **options).ys["u"])
    expected = -LAMBDA * END * jnp.sum(exact(K))
    np.testing.assert_allclose(jax.grad(loss)(K), expected, rtol=1e-5)
    forward = jax.jvp(lambda k: loss(k, adjoint=diffrax.ForwardMode()), (K,), (1.0,))[1]
    np.testing.assert_allclose(forward, expected, rtol=1e-5)


def test_a_batch_is_one_at_a_time():
    solver = BDF(linear_solver=GMRES())
    ks = jnp.asarray([0.05, 0.2])
    ends = jax.vmap(lambda k: solve(solver, k).ys["u"][0])(ks)
    for k, end in zip(ks, ends, strict=True):
        np.testing.assert_allclose(end, solve(solver, k).ys["u"][0], atol=1e-9)


def test_float32():
    y0 = jax.tree.map(lambda x: x.astype(jnp.float32), start())
    sol = solve(BDF(linear_solver=GMRES()), jnp.float32(K), y0, 1e-4)
    assert sol.ys["u"].dtype == jnp.float32
    np.testing.assert_allclose(sol.ys["u"][0], exact(K), atol=1e-3)


def test_equations_of_index_2():
    """A Stokes flow: velocities that pressures keep free of divergence, with no entry on the diagonal."""
    scene = dae_jax.scenes.stokes(4)
    sol = solve(BDF(linear_solver=GMRES()), None, scene.y0, system=scene.system)
    expected = scene.reference(np.array([END]))
    for x, y in zip(jax.tree.leaves(sol.ys), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5, equal_nan=False)


def test_dummy_derivatives_hand_it_on():
    solver = RadauIIA5(linear_solver=GMRES())
    sol = solve(solver, formulation=DummyDerivatives())
    np.testing.assert_allclose(sol.ys["u"][0], exact(K), atol=2e-6)
    plan = dae_jax.explain(SYSTEM, solver, 0.0, start(), K, formulation=DummyDerivatives())
    assert "GMRES with incomplete factors" in plan.linear_solver


def test_explain_says_it():
    plan = dae_jax.explain(SYSTEM, BDF(linear_solver=GMRES(by_waves)), 0.0, start(), K)
    assert plan.linear_solver == "GMRES with the preconditioner that is given, 128 unknowns, 832 entries"


def test_what_does_not_converge_fails():
    """Without a preconditioner worth the name, by one product."""
    poor = GMRES(lambda a: jax.tree_util.Partial(jnp.multiply, 1.0), most=1)
    with pytest.raises(RuntimeError, match="where that does not converge"):
        solve(BDF(linear_solver=poor))


WRONG = {
    "no function": (lambda a: a, "must return a pytree that can be called"),
    "made anew": (lambda a: jax.tree_util.Partial(lambda b: b), "must return a pytree that can be called"),
    "of another size": (lambda a: jax.tree_util.Partial(jnp.repeat, repeats=2), "must be a vector of 128 numbers"),
}


@pytest.mark.parametrize("name", WRONG)
def test_no_preconditioner(name):
    made, sentence = WRONG[name]
    with pytest.raises(ValueError, match=sentence):
        solve(BDF(linear_solver=GMRES(made)))
