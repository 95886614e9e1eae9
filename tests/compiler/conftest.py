"""The compiler's tests run what users run: machine code after LLVM's passes."""

import pytest

from dae_jax import configure


@pytest.fixture(autouse=True)
def _optimised():
    with configure(optimise=True):
        yield
