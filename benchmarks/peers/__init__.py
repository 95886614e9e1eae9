"""Other solvers, called as their own documentation recommends, each in its best natural formulation.

A peer is a module with
    name                                     shown in tables
    methods                                  its variants, best first
    available()                              None, or the reason why it cannot run here
    double_pendulum(rtol, t1=10.0, method)   → (end state, solve)
    pendulum(rtol, t1=10.0, method)          → (end state, solve)
    chain(n, rtol, t1=1.0, method)           → (end state, solve)       where it takes part in the chain
    sweep(angles, rtol, t1=10.0, method)     → (end states, solve)      where it takes part in the sweep
    stiff(problem, rtol, method)             → (end state, solve)       where it has `stiff_methods`, see `stiff_problems`
    large(problem, rtol, method)             → (states, steps, solve)       where it has `large_methods`, see `large_problems`
    loops(problem, rtol, method)             → (places of bodies, solve)    where it has `loop_methods`
The call builds and solves once; `solve()` then integrates again from the start, warm, and returns when it is done.
The absolute tolerance equals the relative one throughout. States are as in `problems`.
"""

import importlib


NAMES = (
    "dae_jax_peer",
    "c_limit",
    "heyoka_peer",
    "plain_diffrax",
    "casadi_peer",
    "exudyn_peer",
    "mujoco_peer",
    "pinocchio_peer",
    "sundae_peer",
    "solve_dae_peer",
    "drake_peer",
    "jaxonomy_peer",
)
PACKAGES = (
    *("numpy", "scipy", "jax", "jaxlib", "diffrax", "heyoka", "casadi", "exudyn"),
    *("mujoco", "pin", "scikit-sundae", "solve_dae", "drake"),
)


def load(name):
    """Return the peer's module, which imports the library behind it only when it is asked to solve something."""
    return importlib.import_module(f"{__name__}.{name}")


def missing(*modules):
    """Return None if all `modules` can be imported, else the reason why not."""
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            return f"{module} cannot be imported: {error}"
    return None
