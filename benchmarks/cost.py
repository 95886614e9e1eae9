"""What a solve costs beside its steps: gradients, the call, importing, compiling."""

import json
import os
import subprocess
import sys
import tempfile

from . import timing


GRADIENT = {"reverse gradient": 6.0, "one forward direction": 2.2}


def run(peers, repeats, quick):
    """Rows of (what, seconds), and ratios where `per` names what they are multiples of."""
    rows = [*_gradients(repeats), *_calls(repeats), *_compiling(), *_cold(quick)]
    for row in rows:
        ratio = f"{row['ratio']:8.2f} times the plain solve" if "ratio" in row else ""
        print(f"{row['what']:<52} {1e3 * row['seconds']:10.3f} ms {ratio}", flush=True)
    return rows


def _gradients(repeats):
    import diffrax
    import jax
    import jax.numpy as jnp

    from dae_jax.scenes import double_pendulum

    from .peers import dae_jax_peer, problems

    jax.config.update("jax_enable_x64", True)
    solve = dae_jax_peer.solution(double_pendulum(), 10.0, "OrthogonalProjection(DOP853)")
    start = jnp.asarray(problems.chain_start(2))
    end = lambda start, adjoint: jnp.sum(solve(start, 1e-8, adjoint=adjoint, max_steps=4096).ys[0])
    forward = diffrax.ForwardMode()
    functions = {
        "plain solve": lambda s: end(s, diffrax.RecursiveCheckpointAdjoint()),
        "reverse gradient": jax.grad(lambda s: end(s, diffrax.RecursiveCheckpointAdjoint())),
        "one forward direction": lambda s: jax.jvp(lambda s: end(s, forward), (s,), (jnp.ones(8),)),
    }
    compiled = {name: jax.jit(fn) for name, fn in functions.items()}
    times = timing.measure_together(
        {name: lambda fn=fn: jax.block_until_ready(fn(start)) for name, fn in compiled.items()}, repeats
    )
    plain = times["plain solve"].median
    for name, measured in times.items():
        yield {
            "what": f"double pendulum 10 s at 1e-8, {name}",
            "key": name,
            "seconds": measured.median,
            "ratio": measured.median / plain,
        }


def _calls(repeats):
    import jax
    import jax.numpy as jnp

    import dae_jax
    from dae_jax.scenes import pendulum

    scene = pendulum()
    y0 = jax.tree.map(jnp.asarray, scene.y0)
    solve = lambda y0, throw: dae_jax.daesolve(
        scene.system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 0.1, None, y0, throw=throw
    )
    jitted = jax.jit(lambda y0: solve(y0, False).ys)
    times = timing.measure_together(
        {"jit": lambda: jax.block_until_ready(jitted(y0)), "python": lambda: jax.block_until_ready(solve(y0, True).ys)},
        repeats,
    )
    yield {"what": "pendulum, 0.1 s, inside an outer jit", "key": "jit", "seconds": times["jit"].median}
    yield {"what": "pendulum, 0.1 s, called from Python", "key": "python", "seconds": times["python"].median}


def _compiling():
    from .peers import dae_jax_peer

    for problem in ("pendulum", "double_pendulum"):
        for method in dae_jax_peer.methods:
            (_, solve), first = timing.first_call(getattr(dae_jax_peer, problem), 1e-6, method=method)
            yield {
                "what": f"first call, {problem}, {method}",
                "key": None,
                "seconds": first - timing.first_call(solve)[1],
            }


_COLD = """
import json, time
a = time.perf_counter(); import jax
if {cache!r}:
    jax.config.update("jax_compilation_cache_dir", {cache!r})
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_enable_x64", True)
import diffrax; b = time.perf_counter()
import dae_jax; c = time.perf_counter()
from dae_jax.scenes import pendulum
scene = pendulum()
sol = dae_jax.daesolve(scene.system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 10.0, None, scene.y0)
sol.ys[0].block_until_ready(); d = time.perf_counter()
print(json.dumps([b - a, c - b, d - a]))
"""


def _cold(quick):
    repeats = 1 if quick else 3
    with tempfile.TemporaryDirectory() as folder:
        runs = {"": [_process("") for _ in range(repeats)]}
        _process(folder)
        runs[" with the compilation cache"] = [_process(folder) for _ in range(repeats)]
    for label, samples in runs.items():
        median = [sorted(column)[len(column) // 2] for column in zip(*samples, strict=True)]
        if not label:
            yield {"what": "import jax and diffrax", "key": None, "seconds": median[0]}
            yield {"what": "import dae_jax on top", "key": "import", "seconds": median[1]}
            yield {"what": "ours of the cold start", "key": "ours", "seconds": median[2] - median[0]}
        yield {"what": f"cold process to the first solution{label}", "key": f"cold{label}", "seconds": median[2]}


def _process(cache):
    environment = dict(os.environ, JAX_PLATFORMS="cpu")
    done = subprocess.run(
        [sys.executable, "-c", _COLD.format(cache=cache)], capture_output=True, text=True, env=environment, check=True
    )
    return json.loads(done.stdout)


def figures(rows):
    """None."""
    return ()


def targets(rows):
    """See `work_precision.targets`."""
    seconds = {row["key"]: row["seconds"] for row in rows}
    ratios = {row["key"]: row.get("ratio") for row in rows}
    for name, limit in GRADIENT.items():
        yield f"{name} in plain solves ≤ {limit:g}", ratios.get(name), limit
    for text, key, scale, limit in (
        ("call inside jit in µs ≤ 40", "jit", 1e6, 40),
        ("call from Python in µs ≤ 400", "python", 1e6, 400),
        ("cold start in s ≤ 4", "cold", 1, 4),
        ("of it ours in s ≤ 1.5", "ours", 1, 1.5),
        ("with the compilation cache in s ≤ 2.5", "cold with the compilation cache", 1, 2.5),
        ("import in s ≤ 0.15", "import", 1, 0.15),
    ):
        yield text, None if key not in seconds else scale * seconds[key], limit
