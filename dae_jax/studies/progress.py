"""A progress bar on stderr: what is done, how fast, and how long it still takes."""

import sys
import time
from types import TracebackType


class Progress:
    """`with Progress("sweep", 10_000, enabled) as progress: progress.show(120, "3 failed")`.

    `already`: how much was done before this run; it counts as done, not as speed.
    """

    def __init__(self, label: str, total: int, enabled: bool, already: int = 0) -> None:
        self.label, self.total, self.enabled, self.already = label, total, enabled, already
        self.start = self.shown = time.monotonic()
        self.width = 0
        self.pending: tuple[int, str] | None = None

    def __enter__(self) -> "Progress":
        return self

    def show(self, done: int, note: str = "") -> None:
        """Draws the bar, at most ten times a second; the last state is drawn in any case, at the end."""
        self.pending = done, note
        if self.enabled and time.monotonic() - self.shown >= 0.1:
            self._draw(done, note)

    def _draw(self, done: int, note: str) -> None:
        now = time.monotonic()
        self.shown, self.pending = now, None
        rate = (done - self.already) / max(now - self.start, 1e-9)
        left = f"{_clock((self.total - done) / rate)} left" if rate > 0 else "? left"
        filled = 20 * done // max(self.total, 1)
        bar = "█" * filled + "·" * (20 - filled)
        line = f"{self.label} {bar} {done:,}/{self.total:,}  {rate:,.4g}/s  {left}  {note}".rstrip()
        print("\r" + line.ljust(self.width), end="", file=sys.stderr, flush=True)
        self.width = len(line)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.enabled and self.pending is not None:
            self._draw(*self.pending)
        if self.width:
            print(file=sys.stderr, flush=True)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
