"""Which kernels our compiler gave up and left to XLA, and why: a line in the log for each reason, once."""

import logging
from collections import Counter


_log = logging.getLogger(__name__)
_reasons: Counter[str] = Counter()


def note(reason: str) -> None:
    """Our compiler took a function, and gave it up while it was written."""
    if not _reasons[reason]:
        _log.info("A kernel is left to XLA: %s", reason)
    _reasons[reason] += 1


def left_to_xla() -> dict[str, int]:
    """How often a kernel was left to XLA in this process, by reason."""
    return dict(_reasons)
