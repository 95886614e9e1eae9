"""What an outcome is worth."""

import dataclasses

import numpy as np

from .cases import METHODS, Case
from .solve import Outcome


# An answer with fewer than two digits, where more were asked for, is wrong without a word; over long times one as large as the motion.
WRONG = 1e-2
# A failure is at the right time within this part of the interval.
AT_THE_TIME = 2e-3
BOTH = ("refused", "failed")


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of the table; `verdict` is "ok", "degraded", "warned", "refused", "failed" or "WRONG", `lost` the digits lost beyond what is
    allowed, `due` whether the words that a solve ended in are what must happen.
    """

    family: str
    stressor: str
    method: str
    verdict: str
    ended: str
    lost: float
    error: float
    allowed: float
    drift: float
    end: float
    steps: int
    seconds: float
    words: str


def judged(family: str, case: Case, method: str, outcome: Outcome) -> Cell:
    """By the rules above, and `Case.allowed`."""
    allowed = case.allowed(METHODS[method])
    lost = float(max(np.log10(outcome.error / allowed), 0.0)) if outcome.error > 0 else 0.0
    if outcome.ended == "answer":
        least = 1.0 if case.lasting else max(WRONG, 10 * allowed)
        due = case.due in ("failure", "refusal") or (case.due == "words" and not outcome.words)
        bad = case.due == "words" or not outcome.error <= least
        silent = due or (bad and not outcome.words)
        verdict = "WRONG" if silent else "warned" if bad else "degraded" if lost > 0 else "ok"
    else:
        late = case.due == "failure" and outcome.end > case.ends + AT_THE_TIME * case.t1
        early = case.due == "failure" and outcome.end < case.ends - AT_THE_TIME * case.t1
        wanted = {"failure": BOTH, "refusal": ("refused",), "words": BOTH, "any": BOTH}
        due = outcome.ended in wanted.get(case.due, ()) and not early
        verdict = "WRONG" if late else "ok" if due else outcome.ended
    kept = {name: getattr(outcome, name) for name in ("ended", "error", "drift", "end", "steps", "seconds", "words")}
    return Cell(family, case.name, method, verdict, lost=lost, allowed=allowed, **kept)
