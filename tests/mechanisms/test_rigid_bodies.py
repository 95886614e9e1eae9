"""Single bodies in space against what is known of them: elliptic functions, conserved quantities, Euler's equations."""

import diffrax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.mechanisms.rotations import matrix, product, rates


TIGHT = diffrax.PIDController(rtol=1e-13, atol=1e-13)
SOLVER = dae_jax.OrthogonalProjection(dae_jax.DOP853())


def solved(mechanism: m.Mechanism, y0, t1: float, count: int = 51):
    times = diffrax.SaveAt(ts=jnp.linspace(0, t1, count))
    options = dict(saveat=times, stepsize_controller=TIGHT, max_steps=100_000)
    return dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, t1, None, y0, **options)


def spin(sol, name: str) -> np.ndarray:
    """Angular velocity in body axes."""
    q, v = (np.asarray(x[name])[:, 3:] for x in sol.ys)
    return np.stack([2 * np.asarray(rates(jnp.asarray(e))) @ de for e, de in zip(q, v, strict=True)])


def test_a_torque_free_top_turns_by_elliptic_functions():
    """Landau, Lifshitz, *Mechanics*, §37: I₁ < I₂ < I₃, and M² > 2 E I₂."""
    i1, i2, i3 = 1.0, 2.0, 3.0
    start = np.array([0.4, 0.0, 1.5])
    mechanism = m.Mechanism([m.Body("top", 1.3, (i1, i2, i3), spin=start)])
    sol = solved(mechanism, mechanism.assemble(), 100.0)
    energy, square = (np.array([i1, i2, i3]) * start**2).sum(), ((np.array([i1, i2, i3]) * start) ** 2).sum()
    tau = np.asarray(sol.ts) * np.sqrt((i3 - i2) * (square - energy * i1) / (i1 * i2 * i3))
    modulus = (i2 - i1) * (energy * i3 - square) / ((i3 - i2) * (square - energy * i1))
    sn, cn, dn, _ = ellipj(tau, modulus)
    amplitudes = (
        np.sqrt((energy * i3 - square) / (i1 * (i3 - i1))),
        np.sqrt((energy * i3 - square) / (i2 * (i3 - i2))),
        np.sqrt((square - energy * i1) / (i3 * (i3 - i1))),
    )
    exact = np.stack([amplitudes[0] * cn, amplitudes[1] * sn, amplitudes[2] * dn], 1)
    assert np.abs(spin(sol, "top") - exact).max() < 1e-9
    # The moment of momentum in the world, too: the attitude is right.
    turns = np.stack([np.asarray(matrix(e)) for e in sol.ys[0]["top"][:, 3:]])
    momentum = np.einsum("tij,tj->ti", turns, np.array([i1, i2, i3]) * spin(sol, "top"))
    assert np.abs(momentum - momentum[0]).max() < 1e-9


def test_a_heavy_symmetric_top_keeps_what_it_must():
    """Energy, and the moments of momentum about the vertical and about its own axis."""
    arm = np.array([0.0, 0.0, 0.5])
    tilt = np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0])
    place = np.asarray(matrix(jnp.asarray(tilt))) @ arm
    axis = place / 0.5
    body = m.Body("top", 2.0, (0.3, 0.3, 0.2), at=place, orientation=tilt, spin=20 * axis + np.array([0, 0, 0.5]))
    tip = m.spherical(m.ground, body, (0, 0, 0), name="tip")
    mechanism = m.Mechanism([body], [tip], [m.gravity((0, 0, -9.81))])
    sol = solved(mechanism, mechanism.assemble(), 5.0)
    turns = np.stack([np.asarray(matrix(e)) for e in sol.ys[0]["top"][:, 3:]])
    own = spin(sol, "top")
    velocity = np.asarray(sol.ys[1]["top"][:, :3])
    position = np.asarray(sol.ys[0]["top"][:, :3])
    momentum = np.einsum("tij,tj->ti", turns, np.array([0.3, 0.3, 0.2]) * own) + 2.0 * np.cross(position, velocity)
    energy = np.asarray(mechanism.energy(sol))
    assert np.ptp(own[:, 2]) < 1e-10 * 20
    assert np.ptp(momentum[:, 2]) < 1e-10 * abs(momentum[0, 2])
    assert np.ptp(energy) < 1e-10 * abs(energy[0])
    # The tip carries the weight and what the centre of mass is accelerated by.
    force, moment = mechanism.reaction(sol, "tip")
    speed = np.gradient(velocity[:, 2], np.asarray(sol.ts), edge_order=2)
    assert np.abs(force[5:-5, 2] - 2.0 * (9.81 + speed[5:-5])).max() < 2.0
    assert np.abs(moment).max() < 1e-8
    assert np.asarray(dae_jax.drift(mechanism.system(), sol).position).max() < 1e-12


def test_rotations_are_those_of_scipy():
    rng = np.random.default_rng(0)
    a, b = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 4)))
    of = lambda e: Rotation.from_quat(np.roll(np.asarray(e), -1))
    np.testing.assert_allclose(matrix(jnp.asarray(a)), of(a).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(matrix(product(jnp.asarray(a), jnp.asarray(b))), (of(a) * of(b)).as_matrix(), atol=1e-15)
    # A turn at the angular velocity ω in body axes.
    omega, h = rng.normal(size=3), 1e-6
    ahead, behind = (np.roll((of(a) * Rotation.from_rotvec(x * omega)).as_quat(), 1) for x in (h, -h))
    de = (np.sign(ahead @ a) * ahead - np.sign(behind @ a) * behind) / (2 * h)
    np.testing.assert_allclose(2 * rates(jnp.asarray(a)) @ de, omega, atol=1e-9)
    single = jnp.asarray(a, jnp.float32)
    assert matrix(single).dtype == rates(single).dtype == product(single, single).dtype == jnp.float32
