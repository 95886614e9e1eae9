"""The Radau IIA method with three stages: its coefficients, from the nodes.

Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, table IV.5.6 and section IV.8.
"""

import numpy as np


ROOT = 6**0.5
NODES = np.array([(4 - ROOT) / 10, (4 + ROOT) / 10, 1.0])
_POWERS = NODES[:, None] ** np.arange(1, 4)

# z(s) = Σₖ s^(k+1) (POLYNOMIAL z)ₖ takes the values zᵢ at the nodes and 0 at 0.
POLYNOMIAL = np.linalg.inv(_POWERS)

# A: ∫₀^cᵢ of the Lagrange polynomials of the nodes.
_LAGRANGE = np.linalg.inv(NODES[:, None] ** np.arange(3))
# The value at the start of the polynomial through the stages alone.
AT_START = _LAGRANGE[0]
TABLEAU = (_POWERS / np.arange(1, 4)) @ _LAGRANGE
INVERSE = np.linalg.inv(TABLEAU)

# T⁻¹ A⁻¹ T has the blocks γ and [[α, −β], [β, α]].
_VALUES, _VECTORS = np.linalg.eig(INVERSE)
_REAL = int(np.argmin(np.abs(np.imag(_VALUES))))
_COMPLEX = int(np.argmin(np.imag(_VALUES)))
GAMMA = float(_VALUES[_REAL].real)
ALPHA, BETA = float(_VALUES[_COMPLEX].real), float(-_VALUES[_COMPLEX].imag)
TRANSFORM = np.stack([np.real(_VECTORS[:, _REAL]), np.real(_VECTORS[:, _COMPLEX]), np.imag(_VECTORS[:, _COMPLEX])], 1)
BACK = np.linalg.inv(TRANSFORM)

# The embedded formula of order 3, ŷ₁ − y₁ = γ₀ (h ẏ₀ + Σ eᵢ zᵢ) with γ₀ = 1/γ (eq. IV.8.19).
ERROR = np.array([-(13 + 7 * ROOT), -13 + 7 * ROOT, -1.0]) / 3

# The largest value of |s (s − c₁)(s − c₂)(s − 1)| in a step.
_PLACES = np.linspace(0, 1, 1001)
BETWEEN = float(np.abs(_PLACES * np.prod(_PLACES[:, None] - NODES, 1)).max())
