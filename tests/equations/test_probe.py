"""A matrix that is singular to round-off is told from one whose rows and unknowns are of different sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.equations.probe import Probe
from dae_jax.linalg.sparse import Sparse
from dae_jax.linalg.storage import Banded, Dense


N = 12


def storages(n=N):
    rows, columns = map(np.ravel, np.indices((n, n)))
    inside = abs(rows - columns) <= 2
    return {
        "dense": Dense(n),
        "by LAPACK": Dense(40),
        "banded": Banded(np.arange(n), np.arange(n), 2, 2),
        "sparse": Sparse(rows[inside], columns[inside], np.arange(n), np.ones(inside.sum(), bool)),
    }


STORAGES = pytest.mark.parametrize("storage", storages().values(), ids=storages().keys())


def probe(storage, matrix, dtype=np.float64):
    """That of a dense matrix."""
    rows, columns = storage.positions()
    kept = jnp.asarray(np.where(columns >= 0, matrix[rows, columns], 0), dtype)
    factors = storage.factor(kept)
    solve = lambda b: storage.solve(factors, b)
    return Probe.of(lambda x: storage.apply(kept, x), solve, jnp.ones(storage.size, dtype)), solve


def banded(seed, n):
    rng = np.random.default_rng(seed)
    near = abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 2
    return np.where(near, rng.normal(size=(n, n)), 0) + 3 * np.eye(n), rng


def singular(matrix):
    """With a row that follows from its neighbours, of which it has no entry that they have not."""
    matrix = matrix.copy()
    # Rows 4, 5 and 6 within columns 4 to 6, which all of them have.
    matrix[4:7] = 0
    matrix[4:6, 4:7] = [[1.1, 0.3, 0.7], [0.2, 1.7, 0.4]]
    matrix[6, 4:7] = 0.7 * matrix[4, 4:7] - 0.3 * matrix[5, 4:7]
    return matrix


@STORAGES
@pytest.mark.parametrize("seed", range(4))
def test_the_sizes_of_rows_and_unknowns_are_none_of_its_business(storage, seed):
    matrix, rng = banded(seed, storage.size)
    rows, columns = 10.0 ** rng.uniform(-12, 12, (2, storage.size))
    scaled = rows[:, None] * matrix * columns
    assert probe(storage, scaled)[0].determined
    assert not probe(storage, rows[:, None] * singular(matrix) * columns)[0].determined


@STORAGES
@pytest.mark.parametrize("wrong", [0.0, np.nan])
def test_rows_of_nothing(storage, wrong):
    matrix, _ = banded(0, storage.size)
    matrix[3] *= wrong
    assert not probe(storage, matrix)[0].determined


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_up_to_which_condition(dtype):
    """Hilbert's matrices, whose conditions grow by a factor of 33: those that have no digits left in these numbers are not."""
    epsilon = np.finfo(dtype).eps
    for n in range(2, 14):
        hilbert = 1 / (1.0 + np.add.outer(np.arange(n), np.arange(n)))
        condition = np.linalg.norm(np.abs(np.linalg.inv(hilbert)) @ hilbert, np.inf)
        if condition * epsilon < 1e-3:
            assert probe(Dense(n), hilbert, dtype)[0].determined, n
        if condition * epsilon > 1e3:
            assert not probe(Dense(n), hilbert, dtype)[0].determined, n


@STORAGES
def test_factors_that_serve_for_other_equations(storage):
    """They do where the equations have changed by a tenth, not where a row has come to follow from others."""
    matrix, rng = banded(1, storage.size)
    found, solve = probe(storage, matrix)
    near = matrix * (1 + 0.1 * rng.uniform(-1, 1, matrix.shape))
    derivative = lambda a: lambda x: jnp.asarray(a) @ jnp.tanh(x)
    at = jnp.zeros(storage.size)
    assert found.determines(solve, derivative(near), at)
    assert not found.determines(solve, derivative(singular(matrix)), at)
    assert not jax.jit(lambda x: found.determines(solve, derivative(singular(matrix)), x))(at)
