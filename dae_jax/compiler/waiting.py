"""How long a compilation takes, and a line that says so to somebody who waits for it."""

import sys
import threading
import time


# Seconds after which somebody wants to know.
DELAY = 2.0

_of_thread = threading.local()


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
    return True


def end() -> float:
    """Seconds since `begin`; 0 where nothing was begun."""
    notice = getattr(_of_thread, "notice", None)
    if notice is None:
        return 0.0
    _of_thread.notice = None
    notice.cancel()
    return time.monotonic() - _of_thread.start


def _say() -> None:
    print("dae_jax: compiling …", file=sys.stderr, flush=True)


class _Silent:
    daemon = True

    def start(self) -> None:
        """Nothing is said."""

    def cancel(self) -> None:
        """Nothing is kept from being said."""
