"""The ready mechanisms, against minimal coordinates, and by what they keep."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import simpson

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.compiler import kernel_call
from dae_jax.equations.mechanical import MechanicalODE
from dae_jax.equations.sparse_constraint_jacobian import SparseConstraintJacobian
from dae_jax.linalg import SparseDefinite


SOLVER = dae_jax.OrthogonalProjection(dae_jax.DOP853())
MECHANISMS = {
    "delta": m.delta_robot,
    "engine": m.engine_with_four_cylinders,
    "five-bar": m.five_bar_linkage,
    "rolling-disc": m.rolling_disc,
    "stewart": m.stewart_platform,
}


@pytest.mark.parametrize("name", m.EXAMPLES)
def test_a_mechanism_moves_as_in_minimal_coordinates_and_its_energy_is_what_is_put_in(name: str):
    scene, mechanism = m.EXAMPLES[name](), MECHANISMS[name]()
    times = np.linspace(0, scene.t1, 4001)
    sol = dae_jax.daesolve(
        scene.system,
        SOLVER,
        0.0,
        scene.t1,
        None,
        scene.y0,
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    some = slice(None, None, 800)
    assert scene.error(times[some], tuple(m.Coordinates(x.values[some], x.names) for x in sol.ys)) < 1e-8
    assert float(jnp.max(dae_jax.drift(scene.system, sol).position)) < 1e-13
    energy = np.asarray(mechanism.energy(sol))
    put_in = np.sum([np.asarray(x) for x in mechanism.power(sol).values()] + [0 * times], axis=0)
    size = np.abs(energy).max() + simpson(np.abs(put_in), x=times)
    for end in (2000, 4000):
        assert abs(energy[end] - energy[0] - simpson(put_in[: end + 1], x=times[: end + 1])) < 1e-7 * size


@pytest.mark.parametrize("name", m.EXAMPLES)
def test_a_reference_starts_where_the_mechanism_is_assembled(name: str):
    """The reference configuration, of bodies and joints, is that of the closed forms, whose state is consistent."""
    (q, v), mechanism = m.EXAMPLES[name]().y0, MECHANISMS[name]()
    assert np.allclose(mechanism.assemble()[0].values, q.values, rtol=0, atol=1e-12)
    at, moving = mechanism.assemble(({body: q[body] for body in q.names}, {body: v[body] for body in v.names}))
    assert np.allclose(at.values, q.values, rtol=0, atol=1e-12)
    assert np.allclose(moving.values, v.values, rtol=0, atol=1e-12 * np.abs(v.values).max())


@pytest.mark.parametrize("name", ["delta", "rolling-disc", "stewart"])
def test_a_start_is_exact_whatever_floats_jax_is_set_to(name: str):
    with jax.enable_x64(False):
        q, _ = m.EXAMPLES[name]().y0
    assert np.allclose(np.linalg.norm(q.values[:, 3:], axis=1), 1, rtol=0, atol=1e-15)


def test_a_wheel_is_drawn_as_its_rim():
    scene = m.disc()
    drawn = scene.drawing
    assert drawn is not None
    points = np.asarray(drawn.points(0.0, scene.y0[0]))
    rim = sorted({end for pair in drawn.links for end in pair if pair[0] > 2})
    assert np.allclose(np.linalg.norm(points[rim] - points[0], axis=1), 0.3)
    # It touches the ground, and does not go below it.
    assert -1e-12 < points[rim, 2].min() < 0.01


def test_a_five_bar_is_drawn_with_its_joints():
    drawn = m.five_bar().drawing
    assert drawn is not None
    assert drawn.points(0.0, m.five_bar().y0[0]).shape == (4 + 2 * 5, 2)
    assert max(max(pair) for pair in drawn.links) < 14


def test_a_stewart_platform_stays_closed_and_keeps_its_energy(monkeypatch):
    mechanism = m.stewart_platform()
    y0 = mechanism.assemble()
    assert mechanism.rank(y0) == (85, 85)
    # One kernel, in which what is evaluated again and again is written once, and no dense system of 85.
    monkeypatch.setattr(kernel_call, "_by_xla", lambda *_: pytest.fail("left to XLA"))
    linear = MechanicalODE.of(mechanism.system(), 0.0, y0, None).linear
    assert isinstance(linear, SparseConstraintJacobian)
    assert isinstance(linear.schur, SparseDefinite)
    assert linear.schur.symbolic.cost < 85**3 / 100
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
