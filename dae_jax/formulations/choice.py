"""Whether a solver of residuals keeps its order on the equations as they are written."""

import jax
import jax.numpy as jnp
import numpy as np

from ..equations.derivative_orders import find_offsets
from ..equations.residual_form import Form, ResidualForm
from ..structure import dependence_patterns, in_short, maximum_matching, variables_of
from ..systems import System, is_mechanism
from ..types import Args, State, Time


def why_not_as_written(system: System, t: Time, state: State, args: Args, form: Form, highest: int) -> str:
    """Why a method that converges for an index up to `highest` need not on the equations as they are written; empty where it
    does. Found while tracing.

    From index 2 on, the null space of ∂F/∂ẏ must be constant, or the method may be unstable, however small the step. It
    counts as constant where ∂F/∂ẏ is, and where as many rows of it are independent as there are variables whose derivative
    occurs, as in Hessenberg form.

    Source: C. W. Gear, L. R. Petzold, SIAM J. Numer. Anal. 21 (1984), 716–728, for what happens otherwise; E. Hairer, C.
    Lubich, M. Roche, *The Numerical Solution of Differential-Algebraic Systems by Runge–Kutta Methods*, ch. 4 to 6.
    """
    residual = ResidualForm.of(system, t, state, args, form)
    dtype = jnp.result_type(*jax.tree.leaves(state))
    try:
        found = find_offsets(residual, dtype)
    except ValueError:
        if not is_mechanism(system):
            raise
        # Structurally singular with all constraints: some are redundant. With as many as are independent the index is known.
        index = 3 if form == "index-3" else 2
        return f"the index of the multipliers is {index}, and {_up_to(highest)}" if index > highest else ""
    except NotImplementedError:
        # A primitive that structural analysis does not know: nothing is known of the index.
        return ""
    if found.index > highest:
        beyond = [name for name, k in zip(residual.variables, found.indices, strict=True) if k > highest]
        return f"the index of {in_short(beyond)} is {found.index}, and {_up_to(highest)}"
    independent = [j for j in maximum_matching(variables_of(found.by_rate), residual.size) if j is not None]
    if found.index < 2 or len(independent) == len(np.unique(found.by_rate.indices)):
        return ""
    y, time = jax.ShapeDtypeStruct((residual.size,), dtype), jax.ShapeDtypeStruct((), dtype)
    slope = lambda t, y, yd, v: jax.jvp(lambda yd: residual.residual(t, y, yd), (yd,), (v,))[1]
    *varies, _ = dependence_patterns(slope, time, y, y, y, derivative=True)
    if not any(pattern.nnz for pattern in varies):
        return ""
    return (
        f"the index is {found.index}, and there are fewer equations with derivatives than variables whose derivative occurs, "
        "in combinations that change, for which it may be unstable"
    )


def _up_to(highest: int) -> str:
    return f"it converges for an index up to {highest}"
