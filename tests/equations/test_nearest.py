"""`consistent_state` gives the nearest state, however fast the dynamics are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.nearest_step import step_to


@pytest.mark.parametrize("copies", [1, 100], ids=["dense", "sparse"])
@pytest.mark.parametrize("speed", [1.0, 1e4, 1e9])
def test_fast_dynamics_do_not_draw_on_the_values(speed, copies):
    """A supply behind a resistor: g ties x₀ and w alone, x₁ is of the dynamics only."""
    system = dae_jax.SemiExplicitDAE(
        lambda t, x, w, args: speed * jnp.stack([w - x[1], x[0] - x[1] / 5]),
        lambda t, x, w, args: (24 - w) / 0.01 - w / 1e6 - x[0],
    )
    (x, idle), w = dae_jax.consistent_state(system, 0.0, (jnp.zeros((2, copies)), jnp.zeros(copies)))
    slope = 100 + 1e-6
    np.testing.assert_allclose(x, 2400 / (1 + slope**2), rtol=1e-9)
    np.testing.assert_allclose(w, 2400 * slope / (1 + slope**2), rtol=1e-12)
    np.testing.assert_allclose(idle, 0, atol=1e-9)


@pytest.mark.parametrize("fixed", [False, True])
def test_a_step_is_the_shortest_in_the_values(fixed):
    """Against elimination of the derivatives by their null space, in numpy."""
    rng = np.random.default_rng(0)
    of_values, of_rates, off = rng.normal(size=(7, 6)), rng.normal(size=(7, 4)), rng.normal(size=7)
    weights = np.ones(6)
    weights[2] = 0.0 if fixed else 1.0
    # Rates of very different sizes, and one that stands in no equation.
    of_rates = of_rates * [1e6, 1.0, 1e-3, 0.0]
    left = np.linalg.svd(of_rates[:, :3])[0][:, 3:].T
    shortest = -np.linalg.lstsq(left @ of_values * weights, left @ off, rcond=None)[0] * weights
    is_rate = np.arange(10) >= 6
    x = np.asarray(
        step_to(
            jnp.asarray(np.concatenate([of_values, of_rates], 1)),
            jnp.asarray(off),
            jnp.asarray(np.concatenate([weights, np.ones(4)])),
            is_rate,
        )
    )
    np.testing.assert_allclose(x[:6], shortest, atol=1e-10)
    np.testing.assert_allclose(of_values @ x[:6] + of_rates @ x[6:], -off, atol=1e-9)
    assert x[9] == 0


def ellipse(x):
    return x[0] ** 2 / 9 + x[1] ** 2 - 1


def distance_to_ellipse(x):
    """The least over all of it."""
    angles = np.linspace(0, 2 * np.pi, 1_000_001)
    return np.hypot(3 * np.cos(angles) - x[0], np.sin(angles) - x[1]).min()


ON_ELLIPSE = {
    "mechanism": dae_jax.ConstrainedSystem(lambda t, q, v, a: 0 * q, lambda t, q, a: ellipse(q)),
    "residual": dae_jax.ImplicitDAE(lambda t, y, yd, a: jnp.stack([yd[0] - 1, ellipse(y)])),
}


def nearest_on_ellipse(kind, x):
    start = (x, jnp.zeros(2)) if kind == "mechanism" else x
    found = dae_jax.consistent_state(ON_ELLIPSE[kind], 0.0, start)
    return found[0] if kind == "mechanism" else found


@pytest.mark.parametrize("kind", list(ON_ELLIPSE))
@pytest.mark.parametrize("x", [(4.0, 0.3), (2.5, 0.0), (30.0, 3.0), (0.0, 0.1), (100.0, -50.0), (0.01, 0.0)])
def test_far_from_what_is_curved(kind, x):
    """Farther off than the radius of curvature, and where symmetry leads to a farthest point."""
    x = jnp.array(x)
    found = nearest_on_ellipse(kind, x)
    assert abs(ellipse(found)) < 1e-14
    assert np.linalg.norm(found - x) == pytest.approx(distance_to_ellipse(x), rel=1e-10)


@pytest.mark.parametrize("kind", list(ON_ELLIPSE))
def test_a_start_without_a_way_to_go_is_named(kind):
    with pytest.raises(ValueError, match="derivatives vanish at `y0`"):
        nearest_on_ellipse(kind, jnp.zeros(2))


def test_units_of_their_own():
    """A pressure that is off by 50,000 does not push a fraction, whose logarithm is taken, below zero."""
    off = lambda t, x, z, a: jnp.stack([z[0] - 1e5 * (1 + x[0]), jnp.log(z[1]) + 2e-5 * z[0] - x[0], z[2] - z[1] ** 2])
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x, off)
    fraction = np.exp(0.5 - 3)
    for start in ([2e5, 0.1, 0.0], [0.0, 0.5, 0.1], [3e5, 1e-6, 0.0]):
        _, z = dae_jax.consistent_state(system, 0.0, (jnp.array([0.5]), jnp.array(start)), fixed=(True, False))
        np.testing.assert_allclose(z, [1.5e5, fraction, fraction**2], rtol=1e-13)


@pytest.mark.parametrize("kind", list(ON_ELLIPSE))
def test_derivative_far_from_what_is_curved(kind):
    x, step = jnp.array([4.0, 0.3]), 1e-5
    of_x = lambda x: nearest_on_ellipse(kind, x)
    differences = np.stack([(of_x(x + step * e) - of_x(x - step * e)) / (2 * step) for e in np.eye(2)], 1)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(of_x)(x), differences, atol=1e-8)


@pytest.mark.parametrize("form", ["dense", "blocks"])
def test_fixed_coordinates_of_a_coupled_mass(form):
    """Of the coordinates that are free the least kinetic distance; positions and velocities."""
    mass = np.array([[2.0, 0.9, 0.4, 0.0], [0.9, 1.0, 0.3, 0.0], [0.4, 0.3, 3.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    if form == "blocks":
        mass[2, :2] = mass[:2, 2] = 0
    given = jnp.array([mass[:2, :2], mass[2:, 2:]]) if form == "blocks" else jnp.asarray(mass)
    normal = np.array([1.0, 2.0, -1.0, 0.5])
    system = dae_jax.ConstrainedSystem(lambda t, q, v, a: 0 * q, lambda t, q, a: normal @ q - 1, mass=given)
    q0, v0 = np.array([0.3, 0.1, 0.2, 0.4]), np.array([1.0, -1.0, 2.0, 0.5])
    kept = np.array([True, False, False, False])
    q, v = dae_jax.consistent_state(system, 0.0, (q0, v0), fixed=(kept, kept))
    free = np.arange(1, 4)
    inverse = np.linalg.inv(mass[np.ix_(free, free)])
    way = inverse @ normal[free] / (normal[free] @ inverse @ normal[free])
    np.testing.assert_allclose(q[free], q0[free] - way * (normal @ q0 - 1), atol=1e-14)
    np.testing.assert_allclose(v[free], v0[free] - way * (normal @ v0), atol=1e-14)
    assert q[0] == q0[0]
    assert v[0] == v0[0]


@pytest.mark.parametrize(
    ("residual", "y"),
    [
        (lambda t, y, yd, a: yd**3 - y, [8.0]),
        (lambda t, y, yd, a: yd**2 - y, [4.0]),
        (lambda t, y, yd, a: jnp.exp(yd) - y, [1e4]),
        (lambda t, y, yd, a: jnp.stack([yd[0] ** 2 - y[1], y[1] - y[0] ** 2]), [2.0, 4.0]),
        (lambda t, y, yd, a: jnp.stack([jnp.sum(yd**2) - 1, jnp.sum(y**2) - 1]), [0.6, 0.8]),
    ],
    ids=["cubic", "square", "exponential", "hidden", "speed"],
)
def test_consistent_starts_stay_where_rates_are_nonlinear(residual, y):
    np.testing.assert_allclose(
        dae_jax.consistent_state(dae_jax.ImplicitDAE(residual), 0.0, jnp.array(y)), y, rtol=1e-14
    )


def on_a_circle(radius):
    return dae_jax.ConstrainedSystem(lambda t, q, v, args: -q, lambda t, q, args: q @ q - radius * jnp.abs(radius))


def test_within_a_derivative_what_is_wrong_is_said():
    """There numbers are known, as they are not where they are compiled for or batched."""
    y0 = jnp.array([1.0, 0.2]), jnp.array([0.1, 1.0])
    place = lambda radius: dae_jax.consistent_state(on_a_circle(radius), 0.0, y0)[0]
    np.testing.assert_allclose(jax.jacfwd(place)(1.3), place(1.0), rtol=1e-12)
    np.testing.assert_allclose(jax.jacrev(place)(1.3), place(1.0), rtol=1e-12)
    with pytest.raises(
        ValueError, match=r"No consistent state was found near `y0`(.|\n)*constraint\[0\] \(g\) is off by 2"
    ):
        jax.jacfwd(place)(-1.0)
    assert np.isnan(jax.jit(jax.jacfwd(place))(-1.0)).all()
