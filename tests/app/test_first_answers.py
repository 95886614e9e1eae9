"""The part of the benchmarks that measures how long a first answer takes."""

import json
import subprocess
import sys
from pathlib import Path

from benchmarks import first


def test_small_scenes_by_the_recommended_methods():
    found = list(first.cells(("pendulum", "robertson", "food-web")))
    assert ("pendulum", "projection-dop853") in found
    assert ("robertson", "radau") in found
    assert {scene for scene, _ in found} == {"pendulum", "robertson"}
    assert {method for _, method in found} <= set(first.METHODS)


def test_a_solve_and_its_gradient_in_a_process():
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.first", "pendulum", "projection-dop853", "1e-8"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(first.__file__).parents[1], check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["tolerances"] < first.TOLERANCES
    assert all(found[name] > 0 for name in ("first", "run", "gradient_first", "gradient_run"))
    assert "refused" not in found
