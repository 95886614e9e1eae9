"""Tests run in float64 on two CPU devices; a test that needs another dtype passes arrays of it."""

import gc
import os


os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import pytest


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
# Tracing makes millions of objects that are no garbage.
gc.set_threshold(100_000, 50, 50)


@pytest.fixture(autouse=True, scope="module")
def _forget_what_was_compiled():
    """A module's programs are of no use to the next, and take gigabytes."""
    yield
    jax.clear_caches()
