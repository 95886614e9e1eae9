"""Functions and programs that the compiler's tests share."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np


X = np.array([1.0, 2.0, -3.0])


def numbered(seed):
    """A function of its own for each number, and what it gives."""
    return (lambda x: jax.lax.fori_loop(0, 9, lambda i, y: y * 0.5 + seed + jnp.sin(y), x)), seed


def is_native(fn, *args):
    return "@dae_jax_" in jax.jit(fn).lower(*args).as_text()


def slow(x):
    return jax.lax.fori_loop(0, 2000, lambda i, y: y + 0.01 * jnp.sin(y + i), x)


def in_a_program(text, **environment):
    """What a program of its own prints."""
    head = (
        "import os, sys, jax, jax.numpy as jnp, numpy as np\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "from dae_jax.compiler import one_kernel, configure\n"
        "from dae_jax.compiler.emit import programs, available\n"
        "loop = lambda x: jax.lax.fori_loop(0, 500, lambda i, y: y + 0.01 * jnp.sin(y + i), x)\n"
    )
    given = {"JAX_PLATFORMS": "cpu", "PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    done = subprocess.run(
        [sys.executable, "-c", head + text], capture_output=True, text=True, env=given, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()
