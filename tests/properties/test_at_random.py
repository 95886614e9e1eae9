"""Mechanisms and DAEs put together at random: `python -m tests.properties FIRST LAST` solves those of other seeds."""

import os
import secrets

import pytest

from . import manufactured
from .campaign import FAMILY_CHECKS, FIXED, FOUND, broken
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
    lines = broken(batch, FAMILY_CHECKS[batch.name])
    assert not lines, "\n".join(lines)


def test_daes_have_the_solution_that_was_chosen(new_seed):
    """And its derivatives."""
    lines = manufactured.broken(2, [*range(40), *range(new_seed, new_seed + NEW)], derivatives=True)
    assert not lines, "\n".join(lines)
