"""Slow viscous flow in a box whose lid slides, on a staggered grid; index 2."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import SemiExplicitDAE
from ..types import Args, Time
from .scene import Scene


VISCOSITY = 0.1
# A finer grid has too many velocities for the dense eigenvectors of the reference.
KNOWN = 24


def stokes(n: int = 3) -> Scene[SemiExplicitDAE]:
    """Unsteady Stokes flow in a unit box from rest under a lid that slides along x, on n × n cells; index 2, 3 n² − 2 n unknowns:

        u̇ = ν Δu − ∇p,   0 = ∇ · u,   ν = 0.1,   u = (16 ξ² (1 − ξ)², 0) on the lid and 0 on the walls.

    x holds the velocities on the faces of cells, (n − 1, n) along x, then (n, n − 1) along y; z the pressures in the cells, row
    by row. The divergences add up to zero: in place of the last stands that the last pressure is zero.

    The reference has u in an orthonormal basis Z of the flows without divergence, u = Z w, ẇ = ν Zᵀ (Δ Z w + b) solved by
    eigenvectors, on coarse grids; it is NaN on others.

    Source: F. H. Harlow, J. E. Welch, *Physics of Fluids* 8 (1965), 2182, the grid; E. Hairer, C. Lubich, M. Roche, *The Numerical
    Solution of Differential-Algebraic Systems by Runge–Kutta Methods* (1989), section 1, the index.
    """
    h, split = 1 / n, n * (n - 1)
    lid = _lid(n)

    def acceleration(u: Array, p: Array, wall: np.ndarray) -> Array:
        """Along the first axis; `wall`: how fast the far wall of the second axis slides."""
        along = jnp.pad(u, ((1, 1), (0, 0)))
        across = jnp.concatenate([-u[:, :1], u, 2 * wall[:, None] - u[:, -1:]], 1)
        laplacian = (jnp.diff(along, 2, axis=0) + jnp.diff(across, 2, axis=1)) / h**2
        return VISCOSITY * laplacian - jnp.diff(p, axis=0) / h

    def velocities(x: Array) -> tuple[Array, Array]:
        return x[:split].reshape(n - 1, n), x[split:].reshape(n, n - 1)

    def f(t: Time, x: Array, z: Array, args: Args):
        (u, v), p = velocities(x), z.reshape(n, n)
        up = acceleration(v.T, p.T, np.zeros(n - 1)).T
        return jnp.concatenate([acceleration(u, p, lid).ravel(), up.ravel()])

    def g(t: Time, x: Array, z: Array, args: Args):
        u, v = velocities(x)
        flow = jnp.diff(jnp.pad(u, ((1, 1), (0, 0))), axis=0) + jnp.diff(jnp.pad(v, ((0, 0), (1, 1))), axis=1)
        return jnp.append(flow.ravel()[:-1] / h, z[-1])

    start = np.zeros(2 * split), _pressure(operators(n), np.zeros(2 * split))
    return Scene(f"stokes-{n}", SemiExplicitDAE(f, g), start, 1.0, _reference(n), index=2, stiff=True, first=1e-4)


def _lid(n: int) -> np.ndarray:
    x = np.arange(1, n) / n
    return 16 * x**2 * (1 - x) ** 2


def operators(n: int) -> Any:
    """The sparse matrices of `stokes`: `laplacian` and `divergence` of velocities, `gradient` of pressures, and what the `lid`
    adds to the Laplacian.
    """
    from scipy import sparse

    # Of one line: from its inner faces to its cells; the second derivative on faces, and in cells between walls.
    spread = (np.eye(n, n - 1) - np.eye(n, n - 1, -1)) * n
    faces = -spread.T @ spread
    cells = (np.eye(n, k=1) + np.eye(n, k=-1) - np.diag([3.0, *[2.0] * (n - 2), 3.0])) * n**2
    cell, fewer = sparse.eye_array(n), sparse.eye_array(n - 1)
    along_x = sparse.kron(faces, cell) + sparse.kron(fewer, cells)
    along_y = sparse.kron(cells, fewer) + sparse.kron(cell, faces)
    divergence = sparse.csr_array(sparse.hstack([sparse.kron(spread, cell), sparse.kron(cell, spread)]))
    lid = np.zeros((n - 1, n))
    lid[:, -1] = 2 * n**2 * _lid(n)
    return SimpleNamespace(
        laplacian=sparse.csr_array(sparse.block_diag([along_x, along_y])),
        divergence=divergence,
        gradient=sparse.csr_array(-divergence.T),
        lid=np.concatenate([lid.ravel(), np.zeros(n * (n - 1))]),
    )


def _pressure(of: Any, u: np.ndarray) -> np.ndarray:
    """From the divergence of the momentum equation, 0 = ∇ · (ν Δu − ∇p), the last one zero."""
    from scipy.sparse.linalg import spsolve

    poisson = (of.divergence @ of.gradient).tocsc()[:-1, :-1]
    source = VISCOSITY * (of.divergence @ (of.laplacian @ u + of.lid))
    pressure: Any = spsolve(poisson, source[:-1])
    return np.append(pressure, 0.0)


def _reference(n: int):
    if n > KNOWN:
        return lambda times: (np.full((len(times), 2 * n * (n - 1)), np.nan), np.full((len(times), n * n), np.nan))

    def reference(times: np.ndarray):
        from scipy.linalg import null_space

        of = operators(n)
        basis = null_space(of.divergence.toarray())
        rates, modes = np.linalg.eigh(VISCOSITY * basis.T @ (of.laplacian @ basis))
        shapes = basis @ modes
        grown = np.expm1(rates * np.asarray(times)[:, None]) / rates * (shapes.T @ (VISCOSITY * of.lid))
        u = grown @ shapes.T
        return u, np.stack([_pressure(of, row) for row in u])

    return reference
