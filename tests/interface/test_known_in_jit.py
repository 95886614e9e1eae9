"""Arrays of JAX that are known stay known within `jax.jit`, where all that JAX computes from them is traced."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m


T0, T1, STEP, TIMES, TOLERANCE = map(jnp.asarray, (0.0, 1.0, 0.02, np.linspace(0.0, 1.0, 3), 1e-7))
Y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
SYSTEM = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, -g]), lambda t, q, g: (q @ q - 1) / 2)
ADAPTIVE = {"dt0": None, "stepsize_controller": diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE)}
METHODS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), ADAPTIVE),
    "Baumgarte": (diffrax.Tsit5(), {"dt0": STEP, "formulation": dae_jax.Baumgarte(jnp.asarray(5.0), jnp.asarray(5.0))}),
    "Radau": (dae_jax.RadauIIA5(), ADAPTIVE),
    "RATTLE": (dae_jax.RATTLE(), {"dt0": STEP}),
}


@pytest.mark.parametrize("method", METHODS)
def test_times_steps_and_tolerances(method):
    solver, options = METHODS[method]
    options = dict(options)
    dt0 = options.pop("dt0")

    def solve(g):
        return dae_jax.daesolve(SYSTEM, solver, T0, T1, dt0, Y0, g, saveat=diffrax.SaveAt(ts=TIMES), **options).ys[0]

    np.testing.assert_allclose(jax.jit(solve)(9.81), solve(9.81), atol=1e-12)


def test_wrong_times_are_still_refused():
    for wrong in ({"t1": T0}, {"dt0": -STEP}, {"saveat": diffrax.SaveAt(ts=TIMES + 1)}):
        given = {"t1": T1, "dt0": STEP, **wrong}
        solve = lambda g, given=given: dae_jax.daesolve(SYSTEM, dae_jax.RATTLE(), T0, y0=Y0, args=g, **given).ys[0]
        if "t1" in wrong:  # an interval without a length is one
            np.testing.assert_array_equal(jax.jit(solve)(9.81)[-1], Y0[0])
            continue
        with pytest.raises(ValueError, match=r"points away from|must lie between"):
            jax.jit(solve)(9.81)


def test_a_mechanism_that_is_made_within():
    stiffness, rest, drag, smoothing = map(jnp.asarray, (2.0, 0.1, 0.1, 0.01))
    mass, inertia, axis, ratio = map(jnp.asarray, (1.0, [0.1, 0.1, 0.01], [0.0, 0.0, 1.0], [0.0, 2.0]))

    def angle(start):
        rod = m.Body("rod", mass, inertia, at=(0.5, 0, 0))
        hinge = m.revolute(m.ground, rod, (0, 0, 0), axis=axis, name="hinge")
        loads = [m.spring(hinge, stiffness, rest), m.friction(hinge, drag, smoothing=smoothing)]
        wheel = m.Body("wheel", mass, inertia, at=(0, 5, 0))
        turns = m.revolute(m.ground, wheel, (0, 5, 0), axis=axis, name="turns")
        gears = m.coupling(turns, hinge, ratio)
        mechanism = m.Mechanism([rod, wheel], [hinge, turns, gears], loads)
        y0 = mechanism.assemble(at={"hinge": start})
        sol = dae_jax.daesolve(mechanism.system(), METHODS["projection"][0], T0, 0.1 * T1, None, y0)
        return mechanism.coordinate(sol, "turns")[-1]

    np.testing.assert_allclose(jax.jit(angle)(0.3), angle(jnp.asarray(0.3)), atol=1e-9)
