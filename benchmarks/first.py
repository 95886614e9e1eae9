"""How long the first answer takes: a solve and its reverse gradient for each scene below 20 unknowns, each in a new process.

`python -m benchmarks.first SCENE METHOD RTOL` is one such process. The gradient is that of the end state's sum by the start and
by a factor on the force, or on the rates of a DAE, as by a parameter of the system.
"""

import dataclasses
import functools
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from . import timing


UNKNOWNS, QUICK = 20, ("pendulum", "robertson")
# What the README recommends first; the others of `dae-jax compare` are for comparison.
METHODS = (
    "projection-dop853", "tangent-space", "dummy-derivatives", "radau-ggl", "radau-variable-ggl", "bdf-ggl", "radau",
    "radau-variable", "bdf",
)  # fmt: skip
RTOL, MAX_STEPS = 1e-8, 16_384
# Seconds for a first result, for the first gradient on top of it, and for a process.
FIRST, GRADIENT, LIMIT = 5.0, 10.0, 300.0
# The part of the horizon of a chaotic scene in which a tolerance says something of the end.
PREDICTABLE = 0.25
# An end state that is farther off than so many tolerances is no answer.
TOLERANCES = 1000.0


def run(peers, repeats, quick):
    """One row for each scene and method. Nothing of peers: they compile something else."""
    rows = []
    print(f"{'':44s}{'first s':>9s}{'run ms':>10s}{'error/rtol':>12s}{'gradient s':>12s}{'run ms':>10s}")
    for scene, method in cells(QUICK if quick else None):
        rows.append(row := {"scene": scene, "method": method} | _apart(scene, method))
        print(f"{scene:24s}{method:20s}{_words(row)}", flush=True)
    return rows


def cells(names=None):
    """(scene, method) of all scenes, or of these, with fewer than `UNKNOWNS` unknowns."""
    import jax

    from dae_jax.app import compare
    from dae_jax.scenes import SCENES

    for name in names or SCENES:
        scene = SCENES[name]()
        if sum(np.size(x) for x in jax.tree.leaves(scene.y0)) < UNKNOWNS:
            yield from ((name, method) for method in compare.methods(scene) if method in METHODS)


def _apart(scene, method):
    command = [sys.executable, "-W", "ignore", "-m", __name__, scene, method, repr(RTOL)]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    root = Path(__file__).parents[1]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return {"refused": f"it does not end within {LIMIT:.0f} s"}
    return json.loads((done.stdout.splitlines() or ['{"refused": "the process ended"}'])[-1])


def _words(row):
    if "first" not in row:
        return f"  {row['refused']}"
    words = f"{row['first']:9.1f}{1e3 * row['run']:10.3f}{row['tolerances']:12.2g}"
    if "gradient_first" not in row:
        return f"{words}  {row['refused']}"
    return f"{words}{row['gradient_first']:12.1f}{1e3 * row['gradient_run']:10.3f}"


def main(name, method, rtol):
    """The process: seconds, and what the processor took of them, until the first results; warm run times; the end's error."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import dae_jax
    from dae_jax.app import compare
    from dae_jax.scenes import SCENES

    jax.config.update("jax_enable_x64", True)
    scene, rtol = SCENES[name](), float(rtol)
    by = compare.methods(scene)[method]
    control = diffrax.PIDController(rtol=rtol, atol=scene.scale * rtol)
    control = diffrax.ClipStepSizeController(control, jump_ts=jnp.array(scene.kinks)) if scene.kinks else control
    y0 = jax.tree.map(jnp.asarray, scene.y0)
    t1 = min(scene.t1, PREDICTABLE * scene.horizon)

    def solved(y0, factor):
        return dae_jax.daesolve(
            _scaled(scene), by.solver, 0.0, t1, None, y0, (factor, scene.args), formulation=by.formulation,
            stepsize_controller=control, max_steps=MAX_STEPS,
        )  # fmt: skip

    end = lambda y0, factor: sum(jnp.sum(x[-1]) for x in jax.tree.leaves(solved(y0, factor).ys))
    gradient = jax.jit(jax.grad(end, (0, 1)))
    found = {}
    try:
        sol = _measured(found, "", lambda: solved(y0, jnp.ones(())))
        found["steps"] = int(sol.stats["num_steps"])
        found["tolerances"] = scene.error(np.array([t1]), sol.ys) / rtol
        _measured(found, "gradient_", lambda: gradient(y0, jnp.ones(())))
    except (RuntimeError, ValueError) as error:
        found["refused"] = str(error).splitlines()[0]
    print(json.dumps(found))


def _measured(found, label, call):
    import jax

    before = time.process_time()
    result, found[f"{label}first"] = timing.first_call(lambda: jax.block_until_ready(call()))
    found[f"{label}processor"] = time.process_time() - before
    found[f"{label}run"] = timing.measure(lambda: jax.block_until_ready(call()), 3).median
    return result


def _scaled(scene):
    """The scene's system with args (factor, args)."""
    import dae_jax

    if isinstance(scene.system, dae_jax.ImplicitDAE):
        rates = lambda t, y, yd, args: scene.system.residual(t, y, args[0] * yd, args[1])
        return dae_jax.ImplicitDAE(rates)
    given = {
        field.name: functools.partial(_of_args, getattr(scene.system, field.name))
        for field in dataclasses.fields(scene.system)
        if callable(getattr(scene.system, field.name))
    }
    name = "f" if isinstance(scene.system, dae_jax.SemiExplicitDAE) else "force"
    law = given[name]
    given[name] = lambda *state: state[-1][0] * law(*state)
    return dataclasses.replace(scene.system, **given)


def _of_args(function, *state):
    return function(*state[:-1], state[-1][1])


def figures(rows):
    """None."""
    return ()


def targets(rows):
    """The slowest first result and gradient of each scene, and how many cells have no answer."""
    for scene in dict.fromkeys(row["scene"] for row in rows):
        of = [row for row in rows if row["scene"] == scene]
        slowest = lambda key, of=of: max((row[key] for row in of if key in row), default=None)
        yield f"{scene}: first result in s ≤ {FIRST:g}", slowest("first"), FIRST
        yield f"{scene}: first gradient in s ≤ {GRADIENT:g}", slowest("gradient_first"), GRADIENT
    wrong = [row for row in rows if row.get("tolerances", 0) > TOLERANCES]
    yield f"ends farther off than {TOLERANCES:g} tolerances ≤ 0", len(wrong), 0
    yield "solves or gradients without an answer ≤ 0", sum("refused" in row for row in rows), 0


if __name__ == "__main__":
    main(*sys.argv[1:])
