"""jaxonomy: its BDF for M ẏ = f with a constant, singular M, jitted by its simulator; semi-explicit problems of index 1.

It needs an environment of its own: JAXONOMY_PYTHON names the interpreter of one, with jaxonomy and matplotlib in it.
"""

import os

import numpy as np

from . import apart


name = "jaxonomy"
methods = ()
stiff_methods = ("BDF",)


def available():
    return None if "JAXONOMY_PYTHON" in os.environ else "JAXONOMY_PYTHON names no interpreter that has it"


def stiff(problem, rtol, method):
    if problem.semi_explicit is None:
        raise ValueError("no constant matrix in front of ẏ")
    return apart.stiff("jaxonomy_peer", problem, rtol, method, os.environ["JAXONOMY_PYTHON"])


def stiff_here(problem, rtol, method):
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    import jaxonomy
    from jaxonomy.framework import LeafSystem
    from jaxonomy.simulation import SimulatorOptions

    split = len(problem.y0) - len(problem.algebraic)

    def ode(t, state, *inputs, **parameters):
        y = state.continuous_state
        differential, algebraic = problem.semi_explicit(t, y[:split], y[split:], jnp)
        return jnp.stack([*differential, *algebraic])

    class System(LeafSystem):
        def __init__(self):
            super().__init__()
            mass = np.diag(np.arange(len(problem.y0)) < split).astype(float)
            self.declare_continuous_state(
                default_value=jnp.asarray(problem.y0), ode=ode, mass_matrix=mass, requires_inputs=False
            )

    system = System()
    context = system.create_context()
    options = SimulatorOptions(ode_solver_method="bdf", rtol=rtol, atol=problem.scale * rtol, max_major_steps=1)

    def solve():
        end = np.asarray(
            jaxonomy.simulate(system, context, (0.0, problem.t1), options=options).context.continuous_state
        )
        if not np.isfinite(end).all():
            raise RuntimeError("jaxonomy: the end state is not finite")
        return end

    return solve(), solve
