"""Fixed steps below, at and over the limit of stability: a spring along a straight line, 5,000 steps of h with hω at 0.95, 1.05 and 2
of the largest for which |R(ihω)|^5000 ≤ 2, R the method's stability function; without such a limit hω = 1, 10 and 1,000.
Below the answer must be bounded, above it must not pass for one. Fixed steps have no error control: what overflows, or leaves the
manifold, is found. Tsit5 grows slowly over its limit, by 2.7 % a step at twice of it, which no single step shows.
"""

import diffrax
import jax.numpy as jnp
import numpy as np
from scipy.integrate._ivp import dop853_coefficients

import dae_jax as dj

from ..cases import Case


STEPS = 5000
H = 1e-3


def stability(a, b):
    """R(z) = 1 + z bᵀ (1 − z A)⁻¹ 1 of a Runge–Kutta method."""
    return lambda z: 1 + z * b @ np.linalg.solve(np.eye(len(b)) - z * a, np.ones(len(b)))


def tsit5():
    """From diffrax, which is not this library."""
    tableau = diffrax.Tsit5.tableau
    rows = [np.zeros(0), *tableau.a_lower]
    a = np.array([np.pad(np.asarray(row, float), (0, len(rows) - len(row))) for row in rows])
    return stability(a, np.asarray(tableau.b_sol, float))


def dop853():
    """From scipy."""
    n = len(dop853_coefficients.B)
    return stability(dop853_coefficients.A[:n, :n], dop853_coefficients.B)


def largest(growth):
    """The largest y up to which growth(i y) ^ 5000 stays below 2; infinite where it does up to 1e3."""
    y = np.concatenate([np.linspace(0, 20, 20_001), np.geomspace(20, 1e3, 100)])
    over = np.array([abs(growth(1j * x)) for x in y]) > 2 ** (1 / STEPS)
    return float(y[np.argmax(over)]) if over.any() else np.inf


def cases(quick):
    """ω for each method, so that h is the same: one program each. BDF chooses its steps, always."""
    methods = {
        "projection-tsit5": tsit5(),
        "projection-dop853": dop853(),
        "tangent-space": tsit5(),
        "state-space": dop853(),
        "baumgarte": dop853(),
        "differentiation": dop853(),
        "dummy-dop853": dop853(),
    }
    limits = {name: largest(growth) for name, growth in methods.items()}
    # Störmer and Verlet's method: hω < 2.
    limits["rattle"] = 2.0
    endless = (
        "dummy-radau",
        "radau-ggl",
        "radau-variable-ggl",
        "radau-index-2",
        "radau-index-3",
        "symmetric-trapezoid",
        "symmetric-gauss4",
    )
    found = []
    for name, limit in limits.items():
        for part in (0.95, 1.05, 2.0):
            bounded = {"bound": 2.1} if part < 1 else {"due": "words"}
            found.append(spring(f"step {part:g} of the limit", part * limit / H, name, **bounded))
    for name in endless:
        found += [spring(f"step {times:g} / ω", times / H, name, bound=2.1) for times in (1, 10, 1000)]
    return found


def along(t, q, v, args):
    """−ω² q."""
    return -(args["omega"] ** 2) * q


def line(t, q, args):
    """q₂ = q₁ / 2."""
    return q[1] - q[0] / 2


SYSTEM = dj.ConstrainedSystem(along, line)


def spring(name, omega, method, **rest):
    """q = (2, 1) cos ωt."""
    direction = np.array([2.0, 1.0])

    def truth(times):
        t = omega * np.asarray(times)[:, None]
        return np.cos(t) * direction, -omega * np.sin(t) * direction

    chart = lambda z: jnp.stack([2 * z[0], z[0]])
    return Case(
        name, SYSTEM, (direction, np.zeros(2)), STEPS * H, truth, {"omega": np.asarray(omega)}, (2.0, 2.0 * omega), steps=STEPS,
        fixed=True, chart=chart, only=(method,), **rest,
    )  # fmt: skip
