"""The Radau IIA methods: their coefficients, from the nodes.

Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, sections IV.5 and IV.8; E. Hairer, G. Wanner,
*Stiff differential equations solved by Radau methods*, J. Comput. Appl. Math. 111 (1999), for more stages than three.
"""

import dataclasses
import functools
import math
from fractions import Fraction

import numpy as np
from jaxtyping import Float


# How much larger errors of the stages may become where a step's polynomial is continued into the next.
AMPLIFIED = 5e5


@dataclasses.dataclass(frozen=True, eq=False)
class Coefficients:
    """Of the method with s stages, whose collocation polynomial z(s) is 0 at 0 and zᵢ at the nodes cᵢ.

    `nodes`, `tableau`: c and A; `inverse`: A⁻¹, with h ẏ at the stages = A⁻¹ z. `polynomial`: z(s) = Σₖ sᵏ⁺¹ (polynomial z)ₖ.
    `at_start`: the value at 0 of the polynomial through the stages alone. T⁻¹ A⁻¹ T has the blocks `gamma` and
    [[αₖ, −βₖ], [βₖ, αₖ]], one of αₖ + iβₖ in `pairs` each; `transform` is T, `back` T⁻¹. `error`: the embedded formula of
    order s, ŷ₁ − y₁ = γ₀ (h ẏ₀ + Σ eᵢ zᵢ) with γ₀ = 1/`gamma`, for which −Σ eᵢ zᵢ is z'(0) (eq. IV.8.19). `between`: the
    largest value of |s (s − c₁) … (s − 1)| in a step. `reach`: how many times as long as the last a step may be for the
    polynomial to be continued into it: to where it multiplies errors of the stages by `AMPLIFIED`.
    """

    nodes: Float[np.ndarray, " s"]
    tableau: Float[np.ndarray, "s s"]
    inverse: Float[np.ndarray, "s s"]
    polynomial: Float[np.ndarray, "s s"]
    at_start: Float[np.ndarray, " s"]
    gamma: float
    pairs: tuple[complex, ...]
    transform: Float[np.ndarray, "s s"]
    back: Float[np.ndarray, "s s"]
    error: Float[np.ndarray, " s"]
    between: float
    reach: float

    @property
    def stages(self) -> int:
        """s."""
        return len(self.nodes)


@functools.lru_cache
def coefficients(stages: int) -> Coefficients:
    """Of the Radau IIA method with an odd number of stages, to round-off."""
    nodes = _nodes(stages)
    points = np.append(0.0, nodes)
    polynomial = _lagrange(points)[1:, 1:]
    inverse = _slopes(points)[1:, 1:]
    values, vectors = np.linalg.eig(inverse)
    real = int(np.argmin(np.abs(np.imag(values))))
    below = [int(k) for k in np.argsort(np.imag(values)) if k != real][: stages // 2]
    parts = [part for k in below for part in (np.real(vectors[:, k]), np.imag(vectors[:, k]))]
    transform = np.stack([np.real(vectors[:, real]), *parts], 1)
    places = np.linspace(0, 1, 1001)
    return Coefficients(
        nodes=nodes,
        tableau=np.linalg.inv(inverse),
        inverse=inverse,
        polynomial=polynomial,
        at_start=_lagrange(nodes)[0],
        gamma=float(values[real].real),
        pairs=tuple(complex(np.conj(values[k])) for k in below),
        transform=transform,
        back=np.linalg.inv(transform),
        error=-polynomial[0],
        between=float(np.abs(places * np.prod(places[:, None] - nodes, 1)).max()),
        reach=_reach(polynomial),
    )


def _reach(polynomial: Float[np.ndarray, "s s"]) -> float:
    ahead = np.linspace(0, 20, 2001)
    powers = (1 + ahead[:, None]) ** np.arange(1, len(polynomial) + 1)
    return float(ahead[np.abs(powers @ polynomial).sum(1) <= AMPLIFIED][-1])


def _nodes(stages: int) -> Float[np.ndarray, " s"]:
    """The roots of the Radau polynomial, dˢ⁻¹/dxˢ⁻¹ [xˢ⁻¹ (x − 1)ˢ], by Newton's method with exact residuals."""
    s = stages
    terms = [math.comb(s, k) * (-1) ** (s - k) * math.perm(s - 1 + k, s - 1) for k in range(s + 1)]
    slopes = [k * a for k, a in enumerate(terms)][1:]
    found = np.sort(np.real(np.roots(terms[::-1])))
    for _ in range(3):
        exact = [Fraction(float(x)) for x in found]
        found = np.array([float(x - _value(terms, x) / _value(slopes, x)) for x in exact])
    return found


def _value(terms: list[int], x: Fraction) -> Fraction:
    return sum((a * x**k for k, a in enumerate(terms)), Fraction(0))


def _distances(points: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
    """xᵢ − xⱼ; 1 on the diagonal."""
    return points[:, None] - points + np.eye(len(points))


def _lagrange(points: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
    """The coefficient of sᵏ in the polynomial that is 1 at point j and 0 at the others, at [k, j]."""
    others = [np.poly(np.delete(points, j))[::-1] for j in range(len(points))]
    return np.stack(others, 1) / np.prod(_distances(points), 1)


def _slopes(points: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
    """The derivative at point i of the polynomial that is 1 at point j and 0 at the others, at [i, j]."""
    distances = _distances(points)
    weights = 1 / np.prod(distances, 1)
    slopes = weights / weights[:, None] / distances
    np.fill_diagonal(slopes, (1 / distances).sum(1) - 1)
    return slopes
