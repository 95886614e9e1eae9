"""Ctrl-C that is not lost."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Inside, a `KeyboardInterrupt` that nobody can catch is raised again a moment later.

    Python prints what a callback of the garbage collector or of a weak reference raises, and goes on. JAX has such
    callbacks, and after a long compilation an interruption often finds itself in one.
    """
    before = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            main = threading.main_thread().ident
            again = threading.Timer(0.01, signal.pthread_kill, (main, signal.SIGINT))
            again.daemon = True
            try:
                again.start()
            except KeyboardInterrupt:
                # On a busy machine a moment may pass before it is known to have started; from here it would be lost.
                hook(unraisable)
        else:
            before(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
