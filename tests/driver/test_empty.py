"""Arrays of no entries, as slices give them for the smallest of a family of systems, have no special case."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import polynomials, scalarise
from dae_jax.compiler.lower import compiled, unsupported
from dae_jax.structure import dependence


X = jnp.array([0.5, -2.0, 3.0])


def reductions(x, none):
    wide = jnp.outer(none, x)
    return [
        jnp.sum(none), jnp.prod(none), jnp.sum(wide, 0), jnp.sum(wide, 1), jnp.sum(wide), jnp.max(none, initial=-1.0),
        jnp.all(wide > 0), jnp.any(none > 0), jnp.max(wide, 1), jnp.argmax(wide, 1), jnp.cumsum(none), jnp.mean(x),
    ]  # fmt: skip


def movement(x, none):
    wide = none.reshape(0, 3)
    return [
        jnp.concatenate([none, x, none]), jnp.concatenate([wide, x[None]]), wide.T, wide[::-1], wide[:, 1:], none * 2.0,
        jnp.pad(none, (1, 2)), jnp.stack([none, none], 1), jnp.broadcast_to(none[None], (4, 0)), none[None] + x[:, None],
        *jnp.split(x, [0, 1]), jnp.where(none > 0, none, 1.0), jnp.tile(none, 3), jnp.repeat(x, 0), none.astype(int),
    ]  # fmt: skip


def contractions(x, none):
    wide = jnp.outer(none, x)
    return [none @ none, wide @ x, wide.T @ none, wide.T @ wide, wide @ wide.T, jnp.outer(x, none) @ wide]


def places(x, none):
    nowhere = jnp.zeros(0, int)
    return [
        x[nowhere], none[nowhere], x.at[nowhere].set(none), x.at[nowhere].add(1.0), none.at[nowhere].set(2.0),
        jnp.take(jnp.outer(x, x), nowhere, 1), jax.lax.dynamic_slice(x, (1,), (0,)), x.at[1:1].set(none),
        jax.lax.dynamic_update_slice(x, none, (2,)),
    ]  # fmt: skip


def loops(x, none):
    i = (x[0] * 4).astype(int)
    return [
        jax.lax.scan(lambda c, u: (c + u, (c, none)), x, none),
        jax.lax.scan(lambda c, u: (c + 1, u), x, jnp.zeros((4, 0)) + x[0]),
        jax.lax.fori_loop(0, i, lambda _, c: (c[0] * 2, c[1]), (none, x)),
        jax.lax.while_loop(lambda c: c[1] < 3, lambda c: (c[0] + 1, c[1] + 1), (none, i)),
        jax.lax.cond(x[0] > 0, lambda: (none, x), lambda: (none + 1, -x)),
        jax.lax.switch(i, [lambda: none, lambda: none * 2, lambda: -none]),
        jax.vmap(lambda y: y * x)(none),
    ]  # fmt: skip


FUNCTIONS = [reductions, movement, contractions, places, loops]


def flat(fn):
    """Of three numbers, of which an array of none is made."""
    return lambda x: jax.tree.leaves(fn(x, x[1:1] * 2.0))


def joined(fn):
    return lambda x: jnp.concatenate([jnp.ravel(y) * 1.0 for y in flat(fn)(x)])


@pytest.mark.parametrize("fn", FUNCTIONS)
class TestEmpty:
    def test_native(self, fn):
        jaxpr = jax.make_jaxpr(flat(fn))(X)
        assert unsupported(jaxpr) == ()
        xs = jnp.stack([X, 2 * X, -X])
        for found, expected in (
            (jax.jit(compiled(jaxpr))(X), flat(fn)(X)),
            (jax.jit(compiled(jaxpr, (True,)))(xs), jax.vmap(flat(fn))(xs)),
        ):
            for a, b in zip(found, expected, strict=True):
                assert (a.shape, a.dtype) == (b.shape, b.dtype)
                np.testing.assert_allclose(a, b, rtol=1e-14)

    def test_scalarise(self, fn):
        for a, b in zip(scalarise(flat(fn))(X), flat(fn)(X), strict=True):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            np.testing.assert_allclose(a, b, rtol=1e-14)
        np.testing.assert_allclose(jax.jacfwd(scalarise(joined(fn)))(X), jax.jacfwd(joined(fn))(X), rtol=1e-14)

    def test_structure(self, fn):
        jacobian = jax.jacfwd(joined(fn))(X)
        (pattern,) = dependence(joined(fn), X)
        assert pattern.shape == jacobian.shape
        # JAX's derivative of the largest of no numbers is undefined.
        assert not (np.nan_to_num(jacobian) != 0)[~pattern].any()
        found = polynomials(joined(fn), X)
        assert found is None or found.shape == jacobian.shape[:1]


def chain(n):
    """Written with slices, as of n links."""

    def constraint(t, q, args):
        p = q.reshape(n, 2)
        return jnp.concatenate([(p[:1] ** 2).sum(1) - 1, ((p[1:] - p[:-1]) ** 2).sum(1) - 1])

    return dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.tile(jnp.array([0.0, -9.81]), n), constraint)


@pytest.mark.parametrize(
    ("solver", "formulation"),
    [
        (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
        (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
        (dae_jax.RadauIIA5(), None),
    ],
)
def test_a_chain_of_one_link(solver, formulation):
    y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
    plain = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.array([0.0, -9.81]), lambda t, q, args: (q @ q - 1)[None]
    )
    found, expected = (
        dae_jax.daesolve(system, solver, 0.0, 0.5, None, y0, formulation=formulation).ys[0]
        for system in (chain(1), plain)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)
