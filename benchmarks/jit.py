"""A plain `diffrax.diffeqsolve` by `compiler.jit` and by `jax.jit`: run times, first calls, and errors of both."""

import functools

import numpy as np

from . import timing
from .peers import plain_diffrax, problems


LANES, QUICK_LANES = 10_000, 100
# (method, end, rtol, atol, least ratio of one solve, and of a batch)
CASES = {
    "double pendulum": ("Dopri8", 10.0, 1e-8, 1e-8, 20, 60),
    "Robertson": ("Kvaerno5", 1e4, 1e-6, 1e-10, 10, 30),
}


def run(peers, repeats, quick):
    """A row for each problem, alone and in a batch; an error is the distance from a solve with a hundredth of the tolerance."""
    rows = []
    for name in CASES:
        for lanes in (1, QUICK_LANES if quick else LANES):
            row = _row(name, lanes, repeats)
            rows.append(row)
            print(_line(row), flush=True)
    return rows


def _row(name, lanes, repeats):
    import jax

    from dae_jax import compiler

    jax.config.update("jax_enable_x64", True)
    starts = _starts(name, lanes)
    solve, fine = _solve(name, 1.0), _solve(name, 0.01)
    makers = {
        "compiler.jit": lambda fn: jax.jit(jax.vmap(compiler.jit(fn))) if lanes > 1 else compiler.jit(fn),
        "jax.jit": lambda fn: jax.jit(jax.vmap(fn)) if lanes > 1 else jax.jit(fn),
    }
    calls = {key: functools.partial(_finished, make(solve), starts) for key, make in makers.items()}
    ends, firsts = {}, {}
    for key, call in calls.items():
        ends[key], firsts[key] = timing.first_call(call)
    exact = _finished(makers["compiler.jit"](fine), starts)
    times = timing.measure_together(calls, 1 if lanes > 1 else repeats, 0.0 if lanes > 1 else 0.1, firsts)
    errors = {key: float(np.median(np.abs(end - exact).max(-1))) for key, end in ends.items()}
    return {"problem": name, "lanes": lanes, "error": errors, **times}


def _finished(compiled, starts):
    return np.asarray(compiled(starts))


def _solve(name, finer):
    method, t1, rtol, atol, *_ = CASES[name]
    field = {"double pendulum": plain_diffrax._double_pendulum_field, "Robertson": _robertson}[name]
    return lambda y0: plain_diffrax.end(field, t1, method, y0, finer * rtol, finer * atol)


def _robertson(t, y, args):
    import jax.numpy as jnp

    first, last = -0.04 * y[0] + 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return jnp.stack([first, -first - last, last])


def _starts(name, lanes):
    if name == "Robertson":
        batch = np.stack([np.linspace(0.5, 1.5, lanes), np.zeros(lanes), np.zeros(lanes)], 1)
        return batch if lanes > 1 else np.array([1.0, 0.0, 0.0])
    if lanes == 1:
        return problems.chain_start(2)
    grid = np.linspace(-3, 3, int(lanes**0.5))
    return np.asarray(problems.double_pendulum_starts(np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)))


def _ratio(row):
    return row["jax.jit"].median / row["compiler.jit"].median


def _line(row):
    parts = [
        f"{key} {1e3 * row[key].median:.4g} ms (first {row[key].first:.2f} s, error {error:.1e})"
        for key, error in row["error"].items()
    ]
    return f"{row['problem']:<16}{row['lanes']:>6}  {', '.join(parts)}: {_ratio(row):.1f} times faster"


def figures(rows):
    """None."""
    return ()


def targets(rows):
    """See `work_precision.targets`."""
    for row in rows:
        limit = CASES[row["problem"]][4 if row["lanes"] == 1 else 5]
        yield f"jit of {row['problem']}, {row['lanes']} at once, times faster ≥ {limit}", _ratio(row), limit
