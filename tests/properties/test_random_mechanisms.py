"""Mechanisms put together at random: `python -m tests.properties FIRST LAST` solves those of other seeds."""

import os
import secrets

import pytest

from .campaign import FAMILY_CHECKS, FIXED, FOUND
from .checks import Batch


NEW = 30


@pytest.fixture(scope="module")
def new_seed(request):
    seed = int(os.environ.get("DAE_JAX_FUZZ_SEED") or secrets.randbelow(2**31))
    with (
        request.getfixturevalue("pytestconfig").pluginmanager.getplugin("capturemanager").global_and_fixture_disabled()
    ):
        print(f"\nDAE_JAX_FUZZ_SEED={seed}")
    return seed


@pytest.fixture(scope="module", params=FAMILY_CHECKS)
def batch(request, new_seed):
    """Those that are always the same, those that once found something, and new ones."""
    return Batch(request.param, [*range(FIXED), *FOUND.get(request.param, ()), *range(new_seed, new_seed + NEW)])


def test_few_are_near_a_dead_centre(batch):
    """Of the others, all is asked."""
    assert batch.near.mean() < 0.2


def test_what_must_hold(batch):
    lines = [line for check in FAMILY_CHECKS[batch.name] for line in check(batch)]
    assert not lines, "\n".join(lines)
