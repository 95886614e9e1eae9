"""Units are of no account: a system whose rows, columns or numbers are all multiplied by powers of two has the same solution, bit by bit,
as these multiply without round-off. What is small or large beside 1 is not what is small or large.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.linalg import elimination, semidefinite_solve, solve, tearing
from dae_jax.linalg.storage import Banded, Dense
from tests.equations.test_linalg import PATTERNS, definite, right, semidefinite, sparse
from tests.equations.test_sparse import example, with_small_pivots
from tests.equations.test_sparse_definite import DEFINITE, matrix


UNITS = [2.0**40, 2.0**-40]
SIZES = [1, 2, 3, 4, 5, 8, 9, 20, 32, 33, 48, 49]


def powers(n, seed=3):
    return 4.0 ** np.random.default_rng(seed).integers(-20, 20, n)


def in_other_units(a, b, rows, columns):
    """The system of the unknowns x/columns, each equation multiplied."""
    return a * rows[:, None] * columns, b * rows


@pytest.mark.parametrize("m", SIZES)
def test_definite_systems(m):
    s, b, d = definite(m), right(m), powers(m)
    plain = semidefinite_solve(jnp.asarray(s), jnp.asarray(b))
    scaled = semidefinite_solve(*map(jnp.asarray, in_other_units(s, b, d, d)))
    # LAPACK's sums are of another order for other addresses.
    np.testing.assert_allclose(scaled * d, plain, rtol=0 if m < 49 else 1e-12)
    for unit in UNITS:
        np.testing.assert_array_equal(semidefinite_solve(jnp.asarray(s * unit), jnp.asarray(b)) * unit, plain)


@pytest.mark.parametrize("unit", UNITS)
def test_semidefinite_systems(unit):
    s, b = semidefinite(14, 10), right(14)
    plain, scaled = (semidefinite_solve(jnp.asarray(s * u), jnp.asarray(b), 10) * u for u in (1.0, unit))
    np.testing.assert_allclose(scaled, plain, rtol=1e-11)


@pytest.mark.parametrize("n", SIZES)
def test_general_systems(n):
    a, b, d = right(n, n), right(n, seed=2), powers(n)
    plain = solve(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(
        solve(*map(jnp.asarray, in_other_units(a, b, np.ones(n), d))) * d, plain, rtol=0 if n < 33 else 1e-12
    )
    for unit in UNITS:
        np.testing.assert_array_equal(solve(jnp.asarray(a * unit), jnp.asarray(b)) * unit, plain)


@pytest.mark.parametrize("name", PATTERNS)
def test_eliminations(name):
    order, s = elimination(PATTERNS[name]), sparse(PATTERNS[name])
    b, d = right(len(s)), powers(len(s))
    of = lambda s, b: order.solve(jnp.diag(jnp.asarray(s)), jnp.asarray(s[order.rows, order.columns]), jnp.asarray(b))
    np.testing.assert_array_equal(of(*in_other_units(s, b, d, d)) * d, of(s, b))


def test_sparse_definite_systems():
    a = matrix(1)
    b, d = right(len(a)), powers(len(a))
    of = lambda a, b: DEFINITE.solve(jnp.diagonal(a), jnp.asarray(a[DEFINITE.rows, DEFINITE.columns]), jnp.asarray(b))
    np.testing.assert_allclose(of(*in_other_units(a, b, d, d)) * d, of(a, b), rtol=1e-12)


@pytest.mark.parametrize("n", [3, 32, 40])
@pytest.mark.parametrize("kind", ["dense", "banded", "sparse"])
def test_iteration_matrices(kind, n):
    if kind == "sparse":
        storage, entries, _ = example(n)
    else:
        storage = Dense(n) if kind == "dense" else Banded(np.arange(n), np.arange(n), 2, 1)
        rows, columns = storage.positions()
        inside = (columns >= 0) & (columns < n)
        entries = jnp.asarray(np.where(inside, right(*rows.shape, seed=4), 0.0))
    rows, columns = storage.positions()
    b, d, e = right(n), powers(n, 5), 2.0**20
    of = lambda entries, b: storage.solve(storage.factor(entries), jnp.asarray(b))
    plain = of(entries, b)
    np.testing.assert_array_equal(of(entries * d[rows], b * d), plain)
    np.testing.assert_array_equal(of(entries * e, b) * e, plain)


@pytest.mark.parametrize("unit", UNITS)
def test_sparse_matrices_with_small_pivots(unit):
    storage, entries = with_small_pivots(1e-10)[:2]
    b = right(storage.size)
    of = lambda entries: storage.solve(storage.factor(entries), jnp.asarray(b))
    np.testing.assert_array_equal(of(jnp.asarray(entries) * unit) * unit, of(jnp.asarray(entries)))


def test_systems_reduced_to_their_core():
    known = np.where(np.random.default_rng(2).random((9, 9)) < 0.3, np.nan, 0.0)
    np.fill_diagonal(known, 1.0)
    a = np.where(np.isnan(known), right(9, 9), known)
    b, of = right(9), tearing(known)
    plain = of.solve(jnp.asarray(a), jnp.asarray(b))
    for unit in UNITS:
        np.testing.assert_array_equal(of.solve(jnp.asarray(a), jnp.asarray(b * unit)) / unit, plain)


def coupled(n, k):
    """n masses in a dense matrix, k constraints that couple all of them; arguments: the units of mass and force, and of the constraints."""
    rng = np.random.default_rng(n)
    mass, slopes = definite(n, 1) / n, rng.normal(size=(k, n)) / n
    stiffness = definite(n, 2) / n
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, units: units[0] * (jnp.sin(3 * t) - stiffness @ q),
        lambda t, q, units: units[1] * (slopes @ (q + q**3)),
        mass=lambda q, units: units[0] * jnp.asarray(mass),
    )
    return system, (jnp.asarray(rng.normal(size=n) / 10), jnp.zeros(n))


@pytest.mark.parametrize(("n", "k"), [(2, 1), (6, 2), (12, 3), (20, 12), (50, 2)])
def test_motions(n, k):
    system, guess = coupled(n, k)
    ends = []
    for unit, of_constraint in ((1.0, 1.0), (2.0**40, 1.0), (2.0**-40, 1.0), (1.0, 2.0**30), (1.0, 2.0**-30)):
        units = jnp.array([unit, of_constraint])
        y0 = dae_jax.consistent_state(system, 0.0, guess, units)
        sol = dae_jax.daesolve(system, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, 2.0, None, y0, units)
        pulls = np.asarray(dae_jax.multipliers(system, sol))[0] * of_constraint / unit
        ends.append(np.concatenate([*(np.asarray(x)[0] for x in sol.ys), pulls]))
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_definite_system_is_solved_to_the_digits_there_are(dtype):
    """Whatever the size of its numbers: the backward error is of round-off."""
    for m in (3, 9, 20, 48):
        for unit in (1.0, 1e9, 1e-9):
            s, b = (definite(m) * unit).astype(dtype), right(m).astype(dtype)
            x = np.asarray(jax.jit(semidefinite_solve)(s, b), float)
            off = np.abs(s.astype(float) @ x - b) / (np.abs(s.astype(float)) @ np.abs(x) + np.abs(b))
            assert off.max() < 10 * m * np.finfo(dtype).eps
