"""All cells: a process for each family, and a limit for each cell, so that one that hangs is an entry, not the end."""

import contextlib
import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from .judge import Cell


ROOT = Path(__file__).parents[2]
# Seconds of processor time for a cell, compilation included; of time on the clock so many times that, and for the worker to start.
LIMIT, PATIENCE, START = 120, 10, 60


def run(family: str, todo: list[tuple[str, str]], quick: bool, limit: float = LIMIT) -> Iterator[tuple[Cell, dict]]:
    """The cells (stressor, method) of one family, each with what grew over time; in the order given."""
    todo = list(todo)
    while todo:
        with _worker(family, quick, limit) as (process, lines):
            while todo:
                with contextlib.suppress(BrokenPipeError):
                    print(json.dumps(todo[0]), file=process.stdin, flush=True)
                try:
                    line = lines.get(timeout=PATIENCE * limit + START)
                except queue.Empty:
                    line = None
                stressor, method = todo.pop(0)
                if not line:
                    slow = line is None or process.wait() == -signal.SIGPROF
                    how = (
                        f"no answer in {limit:g} s of processor time"
                        if slow
                        else "the process ended (memory, or a crash)"
                    )
                    yield _silent(family, stressor, method, how), {}
                    break
                found = json.loads(line)
                series = found.pop("series")
                yield Cell(**found), series


def _silent(family: str, stressor: str, method: str, words: str) -> Cell:
    nan = float("nan")
    return Cell(family, stressor, method, "failed", "failed", 0.0, nan, nan, nan, nan, 0, nan, words)


@contextlib.contextmanager
def _worker(family: str, quick: bool, limit: float):
    """A process that takes cells and gives lines, "" at its end."""
    command = [sys.executable, "-m", "benchmarks.stress.worker", family, "--limit", str(limit), *["--quick"] * quick]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        lines: queue.Queue[str] = queue.Queue()

        def read():
            for line in process.stdout:
                lines.put(line)
            lines.put("")

        reader = threading.Thread(target=read)
        reader.start()
        try:
            yield process, lines
        finally:
            process.kill()
            reader.join()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
