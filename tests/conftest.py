"""Tests run in float64 on two CPU devices; a test that needs another dtype passes arrays of it."""

import os


os.environ.setdefault("MPLBACKEND", "Agg")

import jax


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
