"""Warm run times, peers interleaved so that a busy moment of the machine strikes all of them, and records on disk."""

import json
import platform
import statistics
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path


RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Timing:
    """Seconds per warm call over `repeats` samples; `first` is one cold call: building, compiling, solving."""

    median: float
    minimum: float
    maximum: float
    repeats: int
    first: float | None = None


def first_call(function, *args, **kwargs):
    """(result, seconds) of one call."""
    begin = time.perf_counter()
    result = function(*args, **kwargs)
    return result, time.perf_counter() - begin


def measure(solve, repeats=7, min_time=0.1, first=None):
    """Time `solve()`, which must return only when it is done, for at least `repeats` samples and `min_time` seconds."""
    return measure_together({"": solve}, repeats, min_time, {"": first})[""]


def measure_together(solves, repeats=7, min_time=0.1, firsts=None):
    """As `measure`, for several at once: {key: solve} → {key: Timing}, one sample of each in turn.

    A sample is the mean over as many calls as fill `min_time / repeats`, so that the clock does not matter.
    """
    calls = {}
    for key, solve in solves.items():
        seconds = min(first_call(solve)[1] for _ in range(2))
        calls[key] = max(1, int(min_time / repeats / max(seconds, 1e-7)))
    samples = {key: [] for key in solves}
    for _ in range(repeats):
        for key, solve in solves.items():
            begin = time.perf_counter()
            for _ in range(calls[key]):
                solve()
            samples[key].append((time.perf_counter() - begin) / calls[key])
    firsts = firsts or {}
    return {
        key: Timing(statistics.median(taken), min(taken), max(taken), repeats * calls[key], firsts.get(key))
        for key, taken in samples.items()
    }


def save(name, rows, folder, packages=()):
    """Write `rows` (dicts; a Timing in them becomes a dict) to <folder>/<name>.json with machine, versions and date."""
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "name": name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "versions": versions(packages),
        "rows": [{k: asdict(v) if isinstance(v, Timing) else v for k, v in row.items()} for row in rows],
    }
    path = folder / f"{name}.json"
    path.write_text(json.dumps(record, indent=1) + "\n")
    return path


def machine():
    """Processor, cores and system, in words."""
    import os

    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)
    return {"processor": model or platform.processor(), "cores": os.cpu_count(), "system": platform.platform()}


def versions(packages=()):
    """{"python": ..., and each of `packages` that is installed}."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found
