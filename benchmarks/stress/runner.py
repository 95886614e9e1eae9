"""All cells: a process for each family, and limits for each cell, so that one that hangs or grows is an entry, not the end."""

import contextlib
import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from .judge import Cell
from .worker import FULL


ROOT = Path(__file__).parents[2]
# Seconds of processor time for a cell, compilation included; of time on the clock so many times that, and for the worker to start.
LIMIT, PATIENCE, START = 60, 10, 60
# GiB for a worker.
MEMORY = 4


def run(
    family: str, todo: list[tuple[str, str]], quick: bool, limit: float = LIMIT, memory: float = MEMORY
) -> Iterator[tuple[Cell, dict]]:
    """The cells (stressor, method) of one family, each with what grew over time; in the order given.

    Programs stay in a worker's memory; a cell that fills it up is tried once more, in a worker of its own.
    """
    todo, again = list(todo), False
    while todo:
        with _worker(family, quick, limit, memory) as (process, lines, errors):
            fresh = True
            while todo:
                begin = time.perf_counter()
                with contextlib.suppress(BrokenPipeError):
                    print(json.dumps(todo[0]), file=process.stdin, flush=True)
                try:
                    line = lines.get(timeout=PATIENCE * limit + START)
                except queue.Empty:
                    line = None
                if line:
                    found = json.loads(line)
                    series = found.pop("series")
                    yield Cell(**found), series
                    todo.pop(0)
                    fresh = again = False
                    continue
                if line is None or process.wait() == -signal.SIGPROF:
                    words = f"no answer in {limit:g} s of processor time"
                else:
                    words = _last_words(process.returncode, errors, memory)
                    if words.startswith(FULL) and not (fresh or again):
                        again = True
                        break
                again = False
                yield _silent(family, *todo.pop(0), time.perf_counter() - begin, words), {}
                break


def _last_words(code: int, errors: Path, memory: float) -> str:
    said = errors.read_text(errors="replace")
    # Of C++, LLVM, Python, XLA, and its threads, which need stacks.
    if any(
        words in said for words in ("bad_alloc", FULL, "MemoryError", "RESOURCE_EXHAUSTED", "pthread_create() failed")
    ):
        return f"{FULL}: {memory:g} GiB were not enough"
    return f"the process ended with status {code}: {(said.split(chr(10))[-2:] or [''])[0]}"


def _silent(family: str, stressor: str, method: str, seconds: float, words: str) -> Cell:
    nan = float("nan")
    return Cell(family, stressor, method, "failed", "failed", 0.0, nan, nan, nan, nan, 0, seconds, words)


@contextlib.contextmanager
def _worker(family: str, quick: bool, limit: float, memory: float):
    """A process that takes cells and gives lines, "" at its end; what it says on stderr is in a file."""
    command = [sys.executable, "-m", "benchmarks.stress.worker", family, "--limit", str(limit), "--memory", str(memory)]
    with (
        tempfile.NamedTemporaryFile("w") as errors,
        subprocess.Popen(
            [*command, *["--quick"] * quick], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
            start_new_session=True,
        ) as process,
    ):  # fmt: skip
        lines: queue.Queue[str] = queue.Queue()

        def read():
            for line in process.stdout:
                lines.put(line)
            lines.put("")

        reader = threading.Thread(target=read)
        reader.start()
        try:
            yield process, lines, Path(errors.name)
        finally:
            process.kill()
            reader.join()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
