"""What users get wrong: forces that are not numbers from some time or place on, and starts that are off the constraints, in
position and in velocity. A force that breaks must be said at its time; a start is taken where it is off by round-off, refused
where it is off by more than 1e-6, and either in between; an answer may then be off by ten times as much.
"""

import numpy as np

from ..cases import Case
from . import pendulum


G = 9.81


def cases(quick):
    """A pendulum released from the horizontal."""
    truth = pendulum.exact(np.pi / 2, 0.0, G)
    q, v = pendulum.start(np.pi / 2, 0.0)
    common = {"size": (1.0, np.sqrt(2 * G)), "rate": np.sqrt(G), "chart": pendulum.chart, "t1": 2.0}

    def case(name, y0=(q, v), args=None, **rest):
        args = {"gravity": np.asarray(G), **pendulum.NEVER, **(args or {})}
        return Case(name, pendulum.SYSTEM, y0, truth=truth, args=args, **common, **rest)

    found = [
        case("force NaN after 1 s", args={"nan after": np.asarray(1.0)}, due="failure", ends=1.0),
        case("force infinite after 1 s", args={"infinite after": np.asarray(1.0)}, due="failure", ends=1.0),
        case("force NaN where it never is", args={"nan above": np.asarray(-0.5)}),
    ]
    for power in (14, 2) if quick else (14, 12, 10, 8, 6, 4, 2):
        off = 10.0**-power
        due = "answer" if power >= 10 else "refusal" if power <= 6 else "any"
        # The start is outside of the circle, and moves outwards.
        found.append(case(f"start off by 1e-{power}", y0=(q * (1 + off), v + off * q), due=due, off=off))
    return found
