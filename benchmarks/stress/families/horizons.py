"""A pendulum released from the horizontal for a long time, against elliptic functions: how errors, drift and energy grow.
A tolerance is for a step, and errors add up: here an answer is degraded until it is as far off as the motion is large. No method can
see its phase go.
"""

import numpy as np

from ..cases import METHODS, Case
from . import pendulum


G = 9.81
# Those that take seconds for 10,000 s.
LONGEST = ("projection-tsit5", "projection-dop853", "state-space", "baumgarte", "differentiation", "bdf-ggl", "rattle")


def cases(quick):
    """Times at which it is everywhere, not a multiple of its period."""
    truth = pendulum.exact(np.pi / 2, 0.0, G)
    args = {"gravity": np.asarray(G), **pendulum.NEVER}
    energy = lambda q, v: np.sum(v * v, -1) / 2 - G * q[:, 1]

    def swing(t1, steps, **rest):
        return Case(
            f"pendulum {t1:,.0f} s", pendulum.SYSTEM, pendulum.start(np.pi / 2, 0.0), t1, truth, args, (1.0, np.sqrt(2 * G)),
            rate=np.sqrt(G), steps=steps, chart=pendulum.chart, times=2001, energy=energy, max_steps=40_000_000, lasting=True, **rest,
        )  # fmt: skip

    if quick:
        return [swing(100.0, 20_000)]
    return [
        swing(1e3, 500_000, only=_of(None, 2)),
        swing(1e3, 100_000, only=_of(4)),
        swing(1e4, 5_000_000, only=LONGEST),
    ]


def _of(*orders):
    return tuple(name for name, method in METHODS.items() if method.order in orders)
