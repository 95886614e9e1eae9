"""Tests run in float64 on two CPU devices; a test that needs another dtype passes arrays of it."""

import functools
import gc
import os
import subprocess
import zlib
from pathlib import Path


os.environ.setdefault("MPLBACKEND", "Agg")
# A third of the time of all tests would be LLVM's, for programs that run a few times. Those of the compiler and the notebooks run what
# users run.
os.environ.setdefault("DAE_JAX_OPTIMISE", "0")

import jax
import pytest


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
# Tracing makes millions of objects that are no garbage.
gc.set_threshold(100_000, 50, 50)


SLOW = Path(__file__).with_name("slow.txt")
# Tests that it names and that are not there, where all were looked for.
GONE = pytest.StashKey[set[str]]()


def pytest_addoption(parser):
    parser.addoption(
        "--slow", type=int, default=1, metavar="N", help="of the slow tests one in N, drawn by the commit; 1: all"
    )


def pytest_report_header(config):
    share = config.getoption("--slow")
    return f"slow tests: {'all' if share == 1 else f'one in {share}, drawn by commit {_commit()}'}"


def pytest_collection_modifyitems(config, items):
    slow, share = set(SLOW.read_text().splitlines()), config.getoption("--slow")
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        config.stash[GONE] = slow - {item.nodeid for item in items}
    for item in items:
        if item.nodeid in slow:
            item.add_marker("slow")
    drawn = lambda item: zlib.crc32(f"{_commit()} {item.nodeid}".encode()) % share == 0
    left = [item for item in items if item.get_closest_marker("slow") and not drawn(item)]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in set(left)]


@functools.cache
def _commit():
    """The commit that is tested; where there is none every draw is the same."""
    asked = ["git", "-C", os.path.dirname(__file__), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "none"


@pytest.fixture(autouse=True, scope="module")
def _forget_what_was_compiled():
    """A module's programs are of no use to the next, and take gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture
def nothing_forgotten(monkeypatch):
    """For tests that count what is traced: the limit of what is kept counts all tests' problems, and may be reached within one."""
    monkeypatch.setattr("dae_jax.driver.program.KEPT", float("inf"))
