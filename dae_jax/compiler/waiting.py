"""How long a compilation takes, and a line that says so to somebody who waits for it; garbage is looked for less often meanwhile."""

import gc
import sys
import threading
import time

from .emit import background


# Seconds after which somebody wants to know.
DELAY = 2.0

# Tracing makes millions of objects that are no garbage: a four-bar linkage by dummy derivatives takes 7.9 s in place of 9.1.
RARELY = (100_000, 50, 50)

_of_thread = threading.local()
_lock = threading.Lock()
# The thresholds of the collector for each compilation that goes on, in any thread: those before the first are the user's.
_before: list[tuple[int, int, int]] = []


def begin(always: bool = False) -> bool:
    """A compilation begins in this thread; false inside another one. After `DELAY` a line on stderr says so where that is a
    terminal, or `always`.
    """
    if getattr(_of_thread, "notice", None) is not None:
        return False
    _of_thread.start = time.monotonic()
    _of_thread.notice = threading.Timer(DELAY, _say) if always or sys.stderr.isatty() else _Silent()
    _of_thread.notice.daemon = True
    _of_thread.notice.start()
    with _lock:
        _before.append(gc.get_threshold())
        if 0 < _before[0][0] < RARELY[0]:
            gc.set_threshold(*RARELY)
    return True


def end(all_made: bool = False) -> float:
    """Seconds since `begin`, with those until all machine code is there where it is to be `all_made`; 0 where nothing was begun."""
    notice = getattr(_of_thread, "notice", None)
    if notice is None:
        return 0.0
    if all_made:
        background.finish()
    _of_thread.notice = None
    notice.cancel()
    with _lock:
        users = _before[0]
        _before.pop()
        if not _before:
            gc.set_threshold(*users)
    return time.monotonic() - _of_thread.start


def _say() -> None:
    print("dae_jax: compiling …", file=sys.stderr, flush=True)


class _Silent:
    daemon = True

    def start(self) -> None:
        """Nothing is said."""

    def cancel(self) -> None:
        """Nothing is kept from being said."""
