"""Machine code that is made in threads of its own, while what comes after it is traced and written: LLVM takes half of the time until
a first answer.
"""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait


# More threads than these need memory for as many modules, and a program seldom has more kernels.
THREADS = 4

_pools: list[ThreadPoolExecutor] = []
_begun: set[Future[bytes]] = set()


def begin(make: Callable[[], bytes]) -> Future[bytes]:
    """What `make` gives, some time later."""
    if not _pools:
        _pools.append(ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1), thread_name_prefix="dae_jax compiles"))
    making = _pools[0].submit(make)
    _begun.add(making)
    making.add_done_callback(_begun.discard)
    return making


def finish() -> None:
    """Waits for all that was begun."""
    wait(list(_begun))


# A child process has no threads but its own.
os.register_at_fork(after_in_child=_pools.clear)
