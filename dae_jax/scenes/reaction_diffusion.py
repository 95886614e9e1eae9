"""Partial differential equations on the unit square by central differences: heat, and a food web; both of index 1."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import ImplicitDAE, SemiExplicitDAE
from ..types import Args, Time
from .scene import Scene, minimal


# Of the food web: how predators thin out prey and live on it, how both spread, and how their growth varies from place to place.
EATEN, FED = 0.5e-6, 1e4
SPREADS = 1.0, 0.05
ALPHA, BETA = 50.0, 1000.0
# A finer grid of the food web is too much for the dense Jacobians of its reference.
KNOWN = 8


def heat(n: int = 5) -> Scene[ImplicitDAE]:
    """Heat spreads over the unit square whose edges are cold: u̇ = u_xx + u_yy, u = 0 on the edges as equations, y = u of
    shape (n, n), index 1.

    u(0) = 16 x (1 − x) y (1 − y). The discrete Laplacian is the sum of two in one dimension: u(t) = 16 w(t) w(t)ᵀ with w in
    sine waves, wₖ(t) = e^(λₖ t) wₖ(0), λₖ = −(2/h)² sin² (k π h/2), h = 1/(n − 1).

    Source: A. C. Hindmarsh et al., *Example Programs for IDA*, problem "idaHeat2D"; it goes on to t = 10.24, when nothing is
    left.
    """
    h = 1 / (n - 1)
    x = np.linspace(0, 1, n)

    def residual(t: Time, u: Array, ud: Array, args: Args):
        inner = u[1:-1, 1:-1]
        neighbours = u[2:, 1:-1] + u[:-2, 1:-1] + u[1:-1, 2:] + u[1:-1, :-2]
        return ud[1:-1, 1:-1] - (neighbours - 4 * inner) / h**2, u[0], u[-1], u[1:-1, 0], u[1:-1, -1]

    k = np.arange(1, n - 1)
    waves = np.sqrt(2 * h) * np.sin(np.pi * h * np.outer(k, k))
    decay = -((2 / h * np.sin(np.pi / 2 * h * k)) ** 2)

    def reference(times: np.ndarray):
        amplitudes = np.exp(decay * np.asarray(times)[:, None]) * (waves @ (x * (1 - x))[1:-1])
        w = np.pad(amplitudes @ waves, ((0, 0), (1, 1)))
        return 16 * w[:, :, None] * w[:, None, :]

    start = 16 * np.multiply.outer(x * (1 - x), x * (1 - x))
    return Scene(f"heat-{n}", ImplicitDAE(residual), start, 0.1, reference, index=1, scale=0.1, stiff=True)


def food_web(n: int = 4) -> Scene[SemiExplicitDAE]:
    """Prey x spreads over the unit square, predators z are at once in balance with it, both of shape (n, n); index 1:

        ẋ = Δx + x (b − x − 0.5·10⁻⁶ z),   0 = 0.05 Δz + z (−b + 10⁴ x − z),   b = 1 + 50 ξη + 1000 sin 4πξ sin 4πη,

    with no flow over the edges. The reference eliminates z by Newton's method, on coarse grids; it is NaN on others.

    Source: A. C. Hindmarsh et al., *Example Programs for IDA*, problem "idaFoodWeb", after P. N. Brown, A. C. Hindmarsh, *Journal of
    Applied Mathematics and Computation* 31 (1989), 40, with one species of each.
    """
    side, b = np.linspace(0, 1, n), growth(n)
    balance = functools.partial(predators, growth=b.ravel(), laplacian=neumann_laplacian(n))

    def diffusion(c: Array) -> Array:
        around = jnp.pad(c, 1, mode="reflect")
        neighbours = around[2:, 1:-1] + around[:-2, 1:-1] + around[1:-1, 2:] + around[1:-1, :-2]
        return (neighbours - 4 * c) * (n - 1) ** 2

    def f(t: Time, x: Array, z: Array, args: Args):
        return SPREADS[0] * diffusion(x) + x * (b - x - EATEN * z)

    def g(t: Time, x: Array, z: Array, args: Args):
        return SPREADS[1] * diffusion(z) + z * (-b + FED * x - z)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        return SPREADS[0] * (neumann_laplacian(n) @ x) + x * (b.ravel() - x - EATEN * balance(x))

    prey = 10 + (16 * np.multiply.outer(side * (1 - side), side * (1 - side))) ** 2
    embed = lambda t, x: (x.reshape(n, n), balance(x).reshape(n, n))
    start = embed(0.0, prey.ravel())
    unknown = lambda times: tuple(np.full((len(times), n, n), np.nan) for _ in range(2))
    reference = minimal(field, prey.ravel(), embed, "LSODA", max_step=np.inf) if n <= KNOWN else unknown
    return Scene(f"food-web-{n}", SemiExplicitDAE(f, g), start, 1.0, reference, index=1, stiff=True, first=1e-5)


def growth(n: int) -> np.ndarray:
    """b of `food_web`."""
    side = np.linspace(0, 1, n)
    wave = np.sin(4 * np.pi * side)
    return 1 + ALPHA * np.multiply.outer(side, side) + BETA * np.multiply.outer(wave, wave)


@functools.cache
def neumann_laplacian(n: int) -> Any:
    """Δ on n × n points of the unit square, row by row, whose values beyond an edge mirror those before it: a sparse matrix."""
    from scipy import sparse

    line = np.eye(n, k=1) + np.eye(n, k=-1) - 2 * np.eye(n)
    line[0, 1] = line[-1, -2] = 2.0
    own = sparse.eye_array(n)
    return sparse.csr_array(sparse.kron(own, line) + sparse.kron(line, own)) * (n - 1) ** 2


def predators(prey: np.ndarray, growth: np.ndarray, laplacian: Any) -> np.ndarray:
    """z of `food_web` in balance with the prey: by Newton's method, whose start z = 10⁴ x − b is the balance without diffusion."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    z = FED * prey - growth
    for _ in range(20):
        off = SPREADS[1] * (laplacian @ z) + z * (-growth + FED * prey - z)
        jacobian = SPREADS[1] * laplacian + sparse.diags_array(-growth + FED * prey - 2 * z)
        change = spsolve(sparse.csc_array(jacobian), off)
        z = z - change
        if np.abs(change).max() < 1e-14 * np.abs(z).max():
            break
    return z
