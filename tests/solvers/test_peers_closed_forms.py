"""Examples of other libraries with a closed form: implicit in ẏ, stabilised by multipliers that are integrated, index 2."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.numpy import cos, exp, log, sin, sqrt

import dae_jax
from tests.peers import BDF, DUMMY, RADAU, solve


METHODS = {"radau": RADAU, "bdf": BDF, "dummy": DUMMY}
OMEGA = 2 * np.pi


def kvaerno(t, y, yd, args):
    slopes = (sin(yd[0]) ** 2 + cos(y[1]) ** 2) * yd[1] ** 2
    return jnp.stack(
        [
            slopes - (t - 6) ** 2 * (t - 2) ** 2 * y[0] * exp(-t),
            (4 - t) * (y[1] + y[0]) ** 3 - 64 * t**2 * exp(-t) * y[0] * y[1],
        ]
    )


def kvaerno_of_three(t, y, yd, args):
    return jnp.stack(
        [
            yd[0] + y[2] * yd[1] - (y[1] + 1) * yd[2] + y[0] - 1 - sin(t),
            (y[2] + 1) * yd[0] + y[0] * yd[1] + exp(-t),
            y[0] * y[1] * y[2] - exp(-t) * sin(2 * t) / 2,
        ]
    )


def on_a_circle(force):
    """Of a particle, with the multipliers of both constraints integrated: y = (x, v, ∫λ, ∫μ)."""

    def residual(t, y, yd, args):
        x, v, turned = y[:2], y[2:4], jnp.stack([-y[1], y[0]])
        return jnp.concatenate(
            [yd[:2] - v - x * yd[5], yd[2:4] - force(t) * turned - x * yd[4], jnp.stack([x @ v, x @ x - 1])]
        )

    return residual


def circling(phase, pull):
    """Its motion, at an angle with the integral of −λ."""

    def exact(t):
        angle, rate = jax.jvp(phase, (t,), (jnp.ones_like(t),))
        c, s = cos(angle), sin(angle)
        return jnp.stack([c, s, -s * rate, c * rate, -pull(t), 0 * t])

    return exact


# By name: 0 = F(t, y, ẏ), y(t), first and last time.
EXAMPLES = {
    "arevalo": (
        on_a_circle(lambda t: -2.0),
        circling(lambda t: np.pi / 2 - t**2, lambda t: 4 / 3 * t**3),
        1.0,
        5.0,
    ),
    "brenan": (
        lambda t, y, yd, args: jnp.stack([yd[0] - t * yd[1] + y[0] - (1 + t) * y[1], y[1] - sin(t)]),
        lambda t: jnp.stack([exp(-t) + t * sin(t), sin(t)]),
        0.0,
        100.0,
    ),
    "jackiewicz": (
        lambda t, y, yd, args: yd - sin(t**2 * yd) / 16 + sin(exp(y)) / 16 - 1 / t,
        lambda t: jnp.stack([log(t)]),
        1.0,
        4.0,
    ),
    "kamke": (
        lambda t, y, yd, args: 16 * y**2 * yd**3 + 2 * t * yd - y,
        lambda t: jnp.stack([sqrt(t + 2)]),
        0.0,
        1000.0,
    ),
    "ides/kvaerno": (kvaerno, lambda t: jnp.stack([t**4, (4 - t) * t**3]) * exp(-t), 0.1, 1.2),
    "daes/kvaerno": (kvaerno_of_three, lambda t: jnp.stack([exp(-t), sin(t), cos(t)]), -1.0, 1.0),
    "particle": (
        on_a_circle(lambda t: -OMEGA * sin(t)),
        circling(lambda t: OMEGA * sin(t), lambda t: OMEGA**2 * (t / 2 + sin(2 * t) / 4)),
        1.0,
        5.0,
    ),
    "weissinger": (
        lambda t, y, yd, args: t * y**2 * yd**3 - y**3 * yd**2 + t * (t**2 + 1) * yd - t**2 * y,
        lambda t: jnp.stack([sqrt(t**2 + 0.5)]),
        0.5**0.5,
        10.0,
    ),
}


def error(residual, exact, t0, t1, method, tolerance):
    """Relative to the largest value of each unknown, or to 1."""
    times = jnp.linspace(t0, t1, 11)
    sol = solve(
        dae_jax.ImplicitDAE(residual), METHODS[method], t0, t1, exact(t0), rtol=tolerance,
        yd0=jax.jacfwd(exact)(t0), saveat=diffrax.SaveAt(ts=times),
    )  # fmt: skip
    truth = jax.vmap(exact)(times)
    return jnp.max(jnp.abs(sol.ys - truth) / jnp.maximum(1, jnp.abs(truth).max(0)))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_solve_dae(name, method):
    """solve_dae `examples/daes/` and `examples/ides/`, of the names here; that by Weissinger is also the example of Matlab's ode15i."""
    # A BDF method takes many small steps, whose errors add up.
    assert error(*EXAMPLES[name], method, 1e-10) < (1e-6 if method == "bdf" else 1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_an_example_of_ida_of_index_2(method):
    """SUNDIALS `idaAnalytic_mels.c`, after Ascher and Petzold (1998), example 10.2; its .out prints x₂(1) = −2.718640 for −e."""

    def residual(t, y, yd, args):
        x1, x2 = y
        return jnp.stack([-9 / (t - 2) * x1 - x1 + 9 * x2 + 2 * exp(t) - yd[0], (t + 2) * (x1 - exp(t))])

    assert error(residual, lambda t: exp(t) * jnp.stack([1.0, 1 / (t - 2)]), 0.0, 1.0, method, 1e-9) < 1e-7
