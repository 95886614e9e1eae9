"""Scenes of any size, small here: consistent starts, references against published or other numbers, and solves against them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.scenes import amplifier, circuit_chain, food_web, heat, power_grid, robertson, robertson_copies, stokes
from dae_jax.scenes.flow import VISCOSITY, operators
from dae_jax.scenes.power_grid import STEP


# Made once, so that both methods are compared with one reference.
SMALL = {
    "robertson-copies": robertson_copies(3, spread=0.3),
    "heat": heat(4),
    "food-web": food_web(3),
    "stokes": stokes(2),
    "circuit-chain": circuit_chain(),
    "power-grid": power_grid(6),
}
LARGER = {
    "robertson-copies": robertson_copies(100),
    "heat": heat(12),
    "food-web": food_web(12),
    "stokes": stokes(12),
    "circuit-chain": circuit_chain(40),
    "power-grid": power_grid(100),
}


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()], ids=["radau", "bdf"])
@pytest.mark.parametrize("name", SMALL)
def test_scenes_follow_their_references(name, solver):
    scene = SMALL[name]
    times = scene.times(scene.t1, 9)
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6 * scene.scale)
    if scene.kinks:
        controller = diffrax.ClipStepSizeController(controller, jump_ts=np.array(scene.kinks))
    sol = dae_jax.daesolve(
        scene.system, solver, 0.0, scene.t1, None, scene.y0, scene.args, saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=controller, max_steps=100_000,
    )  # fmt: skip
    # What is worst is BDF where machines swing, at 70 times the tolerance.
    assert scene.error(times, sol.ys) < 2e-4


@pytest.mark.parametrize("name", LARGER)
def test_starts_are_consistent(name):
    scene = LARGER[name]
    equations = scene.system
    if isinstance(equations, dae_jax.SemiExplicitDAE):
        off, terms = equations.g(0.0, *scene.y0, scene.args), jax.jacfwd(equations.g, 2)(0.0, *scene.y0, scene.args)
        # To the round-off of the terms that are added up.
        assert np.abs(off).max() <= 1e-14 * max(1.0, np.abs(terms).max() * np.abs(scene.y0[1]).max())
    else:
        flat = lambda parts: np.concatenate([np.ravel(part) for part in parts])
        residual = lambda yd: equations.residual(0.0, scene.y0, yd, scene.args)
        slope = jax.jacfwd(lambda yd: jnp.concatenate([x.ravel() for x in residual(yd)]))(np.zeros_like(scene.y0))
        slope, off = np.asarray(slope).reshape(-1, scene.y0.size), flat(residual(np.zeros_like(scene.y0)))
        # Some ẏ solves it.
        left = off - slope @ np.linalg.lstsq(slope, off)[0]
        assert np.abs(left).max() < 1e-12


def test_flow_starts_without_hidden_divergence():
    scene, of = LARGER["stokes"], operators(12)
    x, z = scene.y0
    assert np.abs(of.divergence @ x).max() == 0
    assert np.abs(of.divergence @ np.asarray(scene.system.f(0.0, x, z, None))).max() < 1e-12


def test_stokes_operators_are_those_of_the_grid():
    random, of = np.random.default_rng(0), operators(4)
    x, z = random.normal(size=24), random.normal(size=16)
    system = stokes(4).system
    force = VISCOSITY * (of.laplacian @ x + of.lid) - of.gradient @ z
    np.testing.assert_allclose(system.f(0.0, x, z, None), force, atol=1e-12)
    np.testing.assert_allclose(system.g(0.0, x, z, None)[:-1], (of.divergence @ x)[:-1], atol=1e-12)


def test_copies_end_where_robertson_does():
    (exact, of_z), (found, found_z) = (
        scene.reference(np.array([1e11])) for scene in (robertson(), robertson_copies(2))
    )
    np.testing.assert_allclose(found[0], np.stack([exact[0]] * 2, 1), atol=1e-13)
    np.testing.assert_allclose(found_z[0], np.repeat(of_z[0], 2), rtol=1e-12)


def test_two_stages_are_the_published_amplifier():
    end = np.array([0.2])
    np.testing.assert_allclose(circuit_chain(2).reference(end), amplifier().reference(end), rtol=1e-9)


def test_heat_begins_as_it_is_given():
    scene = LARGER["heat"]
    np.testing.assert_allclose(scene.reference(np.zeros(1))[0], scene.y0, atol=1e-14)


def test_a_grid_rests_until_its_load_steps():
    scene = SMALL["power-grid"]
    (x, _), (before, _) = scene.y0, scene.reference(np.array([STEP]))
    np.testing.assert_allclose(before[0], x, atol=1e-12)
    (_, swing), (_, voltages) = (part[-1] for part in scene.reference(scene.times(scene.t1, 9)))
    # What machines damp makes up for the load.
    assert (swing < -0.5).all()
    assert ((voltages > 0.95) & (voltages < 1.05)).all()


def test_references_beyond_their_size_are_unknown():
    for make, size in ((food_web, 12), (stokes, 30), (circuit_chain, 40), (power_grid, 100)):
        scene = make(size)
        for start, known in zip(*map(jax.tree.leaves, (scene.y0, scene.reference(np.ones(2)))), strict=True):
            assert known.shape == (2, *start.shape)
            assert np.isnan(known).all()
