"""Truths: angles by scipy at 1e-13, elliptic functions, closed forms. Nothing of the library."""

import numpy as np
from scipy.integrate import solve_ivp


def by_angles(field, z0, embed, rtol=1e-13):
    """times → (q, v), from ż = field(t, z) in minimal coordinates and `embed(t, z)` = (q, v)."""

    def truth(times):
        times = np.asarray(times, float)
        found = solve_ivp(field, (0.0, times[-1]), z0, "DOP853", times, rtol=rtol, atol=1e-14, max_step=times[-1] / 40)
        return tuple(np.stack(x) for x in zip(*map(embed, times, found.y.T), strict=True))

    return truth
