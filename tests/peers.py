"""How the examples of other libraries are solved here: methods as pairs of a solver and a formulation."""

import diffrax

import dae_jax


PROJECTION = (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None)
TANGENT = (dae_jax.TangentSpace(dae_jax.DOP853()), None)
RADAU, BDF = (dae_jax.RadauIIA5(), None), (dae_jax.BDF(), None)
GGL = (dae_jax.RadauIIA5(), dae_jax.GGL())
DUMMY, DUMMY_BDF = (dae_jax.DOP853(), dae_jax.DummyDerivatives()), (dae_jax.BDF(), dae_jax.DummyDerivatives())


def solve(system, method, t0, t1, y0, args=None, rtol=1e-9, atol=None, **options):
    """`atol` is `rtol` if it is not given."""
    solver, formulation = method
    control = diffrax.PIDController(rtol=rtol, atol=rtol if atol is None else atol)
    return dae_jax.daesolve(
        system, solver, t0, t1, None, y0, args, formulation=formulation, max_steps=100_000,
        **{"stepsize_controller": control, **options},
    )  # fmt: skip
