"""The compiler's tests run what users run, in all threads: machine code after LLVM's passes."""

import pytest

from dae_jax.compiler import settings


@pytest.fixture(autouse=True)
def _optimised(monkeypatch):
    monkeypatch.setattr(settings, "_from_environment", settings.Settings)
