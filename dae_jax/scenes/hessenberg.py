"""Problems in Hessenberg form with closed-form solutions, of index 2 to 5."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..systems import SemiExplicitDAE
from ..types import Args, Time
from .scene import Scene


def hessenberg_2() -> Scene[SemiExplicitDAE]:
    """Index 2, with an unstable underlying ODE that the constraint tames:

        ẋ₁ = (ν − 1/(2 − t)) x₁ + (2 − t) ν z + (3 − t)/(2 − t) eᵗ,   ν = 5,
        ẋ₂ = (1 − ν)/(t − 2) x₁ − x₂ + (ν − 1) z + 2 eᵗ,
        0 = (t + 2) x₁ + (t² − 4) x₂ − (t² + t − 2) eᵗ,

    x₁ = x₂ = eᵗ, z = −eᵗ/(2 − t).

    Source: U. M. Ascher, L. R. Petzold, SIAM J. Numer. Anal. 28 (1991), 1097–1120, the example of section 5.
    """
    nu = 5.0

    def f(t: Time, x: Array, z: Array, args: Args):
        e = jnp.exp(t)
        first = (nu - 1 / (2 - t)) * x[0] + (2 - t) * nu * z[0] + (3 - t) / (2 - t) * e
        second = (1 - nu) / (t - 2) * x[0] - x[1] + (nu - 1) * z[0] + 2 * e
        return jnp.stack([first, second])

    def g(t: Time, x: Array, z: Array, args: Args):
        return jnp.stack([(t + 2) * x[0] + (t**2 - 4) * x[1] - (t**2 + t - 2) * jnp.exp(t)])

    def reference(times: np.ndarray):
        e = np.exp(np.asarray(times, float))
        return np.stack([e, e], 1), (-e / (2 - np.asarray(times)))[:, None]

    start = (np.ones(2), np.array([-0.5]))
    return Scene("hessenberg-2", SemiExplicitDAE(f, g), start, 1.0, reference, index=2)


def jay() -> Scene[SemiExplicitDAE]:
    """Index 3, nonlinear in everything, z enters its own equation only through u; x = (y₁, y₂, z₁, z₂), z = u:

        ẏ₁ = 2 y₁ y₂ z₁ z₂,   ẏ₂ = −y₁ y₂ z₂²,   ż₁ = (y₁ y₂ + z₁ z₂) u,   ż₂ = −y₁ y₂² z₂² u,   0 = y₁ y₂² − 1,

    y₁ = z₁ = e²ᵗ, y₂ = z₂ = e⁻ᵗ, u = eᵗ.

    Source: L. O. Jay, Numer. Math. 71 (1995) [*Convergence of Runge–Kutta methods for DAEs of index 3*], example 7.1.
    """

    def f(t: Time, x: Array, z: Array, args: Args):
        y1, y2, z1, z2 = x
        return jnp.stack(
            [2 * y1 * y2 * z1 * z2, -y1 * y2 * z2**2, (y1 * y2 + z1 * z2) * z[0], -y1 * y2**2 * z2**2 * z[0]]
        )

    def reference(times: np.ndarray):
        t = np.asarray(times, float)
        rise, fall = np.exp(2 * t), np.exp(-t)
        return np.stack([rise, fall, rise, fall], 1), np.exp(t)[:, None]

    system = SemiExplicitDAE(f, lambda t, x, z, args: jnp.stack([x[0] * x[1] ** 2 - 1]))
    return Scene("jay", system, (np.ones(4), np.ones(1)), 1.0, reference, index=3)


def integrators(index: int) -> Scene[SemiExplicitDAE]:
    """A chain of index − 1 integrators whose output is prescribed, the input sought:

        ẋ₁ = x₂,  ẋ₂ = x₃,  …,  ẋₖ = z + x₁,   0 = x₁ − sin t,   k = index − 1,

    xⱼ is the (j − 1)-th derivative of sin t, z its k-th minus sin t.
    """
    k = index - 1
    derivative = lambda j, t: np.sin(t + j * np.pi / 2)

    def f(t: Time, x: Array, z: Array, args: Args):
        return jnp.concatenate([x[1:], z + x[:1]])

    def reference(times: np.ndarray):
        t = np.asarray(times, float)
        return np.stack([derivative(j, t) for j in range(k)], 1), (derivative(k, t) - np.sin(t))[:, None]

    system = SemiExplicitDAE(f, lambda t, x, z, args: x[:1] - jnp.sin(t))
    start = tuple(x[0] for x in reference(np.zeros(1)))
    return Scene(f"integrators-{index}", system, start, 5.0, reference, index=index)
