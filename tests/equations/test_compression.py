"""Jacobians from few directions, and full rows by themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array

from dae_jax.equations.compression import FULL, Compression


N = 3 * FULL
FULL_ROWS = (0, 70)


def chain_and_sums(x):
    """Each next to its neighbours, and two equations of all."""
    around = jnp.pad(x, 1)
    flow = around[2:] * x - around[:-2] ** 2
    return flow.at[jnp.array(FULL_ROWS)].set(jnp.stack([jnp.sum(jnp.sin(x)), jnp.prod(1 + x / 10)]))


def halved(x):
    """What has no reverse mode."""
    return jax.lax.while_loop(lambda c: c[1] < 3, lambda c: (c[0] * x / 2, c[1] + 1), (chain_and_sums(x), 0))[0]


def compressed(pattern):
    rows, columns = pattern.nonzero()
    return Compression.of(pattern, rows, columns, np.ones(len(rows), bool)), rows, columns


@pytest.mark.parametrize("fn", [chain_and_sums, halved])
def test_full_rows_are_found_by_themselves(fn):
    dense = np.eye(N, k=1) + np.eye(N, k=-1) + np.eye(N)
    dense[list(FULL_ROWS)] = 1
    compression, rows, columns = compressed(csr_array(dense))
    assert compression.full.tolist() == list(FULL_ROWS)
    assert compression.count <= 4
    x = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, N))
    found = jax.jit(lambda x: compression.jacobian(fn, x))(x)
    np.testing.assert_allclose(found, jax.jacfwd(fn)(x)[rows, columns], rtol=1e-12)


def test_what_gains_nothing_is_left_to_directions():
    """A full matrix, and a sparse one."""
    full, *_ = compressed(csr_array(np.ones((N, N))))
    assert (full.count, len(full.full)) == (N, 0)
    sparse, *_ = compressed(csr_array(np.eye(N)))
    assert (sparse.count, len(sparse.full)) == (1, 0)
