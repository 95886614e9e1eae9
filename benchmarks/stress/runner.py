"""All cells: a process for each family, and a limit for each cell, so that one that hangs is an entry, not the end."""

import contextlib
import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from .judge import Cell


ROOT = Path(__file__).parents[2]
# Seconds for a cell, compilation included, and for the worker to start.
LIMIT, START = 120, 60


def run(
    family: str, todo: list[tuple[str, str]], quick: bool, limit: float = LIMIT, start: float = START
) -> Iterator[tuple[Cell, dict]]:
    """The cells (stressor, method) of one family, each with what grew over time; in the order given."""
    todo = list(todo)
    while todo:
        with _worker(family, quick) as (say, lines):
            first = True
            while todo:
                say(json.dumps(todo[0]))
                try:
                    line = lines.get(timeout=limit + start * first)
                except queue.Empty:
                    line = None
                first = False
                stressor, method = todo.pop(0)
                if not line:
                    how = "no answer in {limit:g} s" if line is None else "the process ended (memory, or a crash)"
                    yield _silent(family, stressor, method, how.format(limit=limit)), {}
                    break
                found = json.loads(line)
                series = found.pop("series")
                yield Cell(**found), series


def _silent(family: str, stressor: str, method: str, words: str) -> Cell:
    nan = float("nan")
    return Cell(family, stressor, method, "failed", "failed", 0.0, nan, nan, nan, nan, 0, nan, words)


@contextlib.contextmanager
def _worker(family: str, quick: bool):
    """A process that takes cells and gives lines, "" at its end."""
    command = [sys.executable, "-m", "benchmarks.stress.worker", family, *["--quick"] * quick]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        lines: queue.Queue[str] = queue.Queue()

        def read():
            for line in process.stdout:
                lines.put(line)
            lines.put("")

        def say(line):
            with contextlib.suppress(BrokenPipeError):
                print(line, file=process.stdin, flush=True)

        reader = threading.Thread(target=read)
        reader.start()
        try:
            yield say, lines
        finally:
            process.kill()
            reader.join()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
