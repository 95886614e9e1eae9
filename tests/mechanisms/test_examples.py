"""The ready mechanisms: a five-bar against minimal coordinates, a Stewart platform against what it keeps."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.compiler import kernel_call
from dae_jax.equations.constraint_jacobian import SparseNormals
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.linalg import SparseDefinite


SOLVER = dae_jax.OrthogonalProjection(dae_jax.DOP853())


def test_a_five_bar_with_a_motor_moves_as_in_minimal_coordinates():
    scene = m.five_bar()
    times = np.linspace(0, scene.t1, 7)
    sol = dae_jax.daesolve(
        scene.system,
        SOLVER,
        0.0,
        scene.t1,
        None,
        scene.y0,
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11),
    )
    assert scene.error(times, sol.ys) < 1e-8
    drawn = scene.drawing
    assert drawn is not None
    assert drawn.points(0.0, scene.y0[0]).shape == (4 + 2 * 5, 2)
    assert max(max(pair) for pair in drawn.links) < 14


def test_a_stewart_platform_stays_closed_and_keeps_its_energy(monkeypatch):
    mechanism = m.stewart_platform()
    y0 = mechanism.assemble()
    assert mechanism.rank(y0) == (85, 85)
    # One kernel, in which what is evaluated again and again is written once, and no dense system of 85.
    monkeypatch.setattr(kernel_call, "_by_xla", lambda *_: pytest.fail("left to XLA"))
    linear = MechanicalODE.of(mechanism.system(), 0.0, y0, None).linear
    assert isinstance(linear, SparseNormals)
    assert isinstance(linear.gram, SparseDefinite)
    assert linear.gram.symbolic.cost < 85**3 / 100
    sol = dae_jax.daesolve(
        mechanism.system(),
        SOLVER,
        0.0,
        5.0,
        None,
        y0,
        saveat=diffrax.SaveAt(ts=jnp.linspace(0, 5, 51)),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )
    energy = np.asarray(mechanism.energy(sol))
    assert np.ptp(energy) < 1e-6
    assert float(jnp.max(dae_jax.drift(mechanism.system(), sol).position)) < 1e-12
    assert mechanism.drawing().points(0.0, y0[0]).shape == (13 + 2 * 18, 3)
