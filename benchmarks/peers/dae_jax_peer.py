"""This library: one jitted `daesolve`, from constraints as plain JAX functions; the sweep is `jit(vmap(daesolve))`."""

import functools
import os

import numpy as np

from . import large_problems, missing, problems


name = "dae_jax"
methods = (
    "OrthogonalProjection(DOP853)",
    "DOP853",
    "OrthogonalProjection(Tsit5)",
    "TangentSpace(DOP853)",
    "StateSpace",
)


def available():
    return missing("dae_jax")


def double_pendulum(rtol, t1=10.0, method=methods[0]):
    from dae_jax.scenes import double_pendulum

    return _prepare(double_pendulum, problems.chain_start(2), rtol, t1, method)


def pendulum(rtol, t1=10.0, method=methods[0]):
    from dae_jax.scenes import pendulum

    return _prepare(pendulum, problems.chain_start(1), rtol, t1, method)


def chain(n, rtol, t1=1.0, method="DOP853"):
    from dae_jax.scenes import chain

    return _prepare(functools.partial(chain, n), problems.chain_start(n), rtol, t1, method)


def sweep(angles, rtol, t1=10.0, method="OrthogonalProjection(DOP853)", threads=1):
    import jax
    import jax.numpy as jnp

    from dae_jax.scenes import double_pendulum

    # It turns float64 on: the starts come after it.
    end = _compiled(double_pendulum, t1, method)
    starts = jnp.asarray(problems.double_pendulum_starts(angles))
    ends = jax.jit(jax.vmap(end, (0, None)))
    solve = lambda: ends(starts, rtol).block_until_ready()
    # A batch takes the processors that the process may use when it is compiled.
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(processors)[:threads])
    try:
        return np.asarray(solve()), solve
    finally:
        os.sched_setaffinity(0, processors)


def solution(scene, t1, method):
    """A function of the start (flat, as in `problems`) and the tolerance that gives the `DAESolution`."""
    import diffrax
    import jax.numpy as jnp

    import dae_jax

    formulation = dae_jax.StateSpace(scene.chart) if method == "StateSpace" else None

    def solve(start, rtol, **options):
        return dae_jax.daesolve(
            scene.system, _solver(method), 0.0, t1, None, tuple(jnp.split(start, 2)), scene.args, formulation=formulation,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), throw=False,
            **{"max_steps": 100_000, **options},
        )  # fmt: skip

    return solve


def _solver(method):
    import diffrax

    import dae_jax

    return {
        "OrthogonalProjection(DOP853)": dae_jax.OrthogonalProjection(dae_jax.DOP853()),
        "OrthogonalProjection(Tsit5)": dae_jax.OrthogonalProjection(diffrax.Tsit5()),
        "TangentSpace(DOP853)": dae_jax.TangentSpace(dae_jax.DOP853()),
        "DOP853": dae_jax.DOP853(),
        "StateSpace": dae_jax.DOP853(),
        "RadauIIA5": dae_jax.RadauIIA5(),
        "BDF": dae_jax.BDF(),
    }[method]


@functools.cache
def _compiled(make, t1, method):
    """(start, tolerance) → end, of one solve: compiled once for all tolerances."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    solve = solution(make(), t1, method)
    return jax.jit(lambda start, rtol: jnp.concatenate([x[-1] for x in solve(start, rtol).ys]))


def _prepare(make, start, rtol, t1, method):
    import jax.numpy as jnp

    end = _compiled(make, t1, method)
    start, rtol = jnp.asarray(start), jnp.asarray(rtol)
    solve = lambda: end(start, rtol).block_until_ready()
    return np.asarray(solve()), solve


stiff_methods = ("RadauIIA5", "BDF", "OrthogonalProjection(DOP853)")


def stiff(problem, rtol, method):
    import jax
    import jax.numpy as jnp

    import dae_jax

    end = _stiff(problem.scene, method)
    start, rtol = jax.tree.map(jnp.asarray, (problem.scene().y0, rtol))
    solve = lambda: jax.block_until_ready(end(start, rtol))
    found, result = solve()
    if result != dae_jax.RESULTS.successful:
        raise RuntimeError("the solve failed")
    return np.asarray(found), solve


@functools.cache
def _stiff(make, method):
    import diffrax
    import jax
    import jax.numpy as jnp

    import dae_jax

    jax.config.update("jax_enable_x64", True)
    scene = make()
    if scene.stiff and method.startswith("Orthogonal"):
        raise ValueError("an explicit method on a stiff problem")

    def end(start, rtol):
        sol = dae_jax.daesolve(
            scene.system, _solver(method), 0.0, scene.t1, None, start, max_steps=1_000_000, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=scene.scale * rtol),
        )  # fmt: skip
        return jnp.concatenate([x[-1] for x in jax.tree.leaves(sol.ys)]), sol.result

    return jax.jit(end)


def robertson_variations(rates, rtol):
    """`sweep` of one `daesolve` over the rows of rates: (end values of y₃, solve)."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import dae_jax

    jax.config.update("jax_enable_x64", True)
    f = lambda t, x, z, k: jnp.stack(
        [k[1] * x[1] * z[0] - k[0] * x[0], k[0] * x[0] - k[1] * x[1] * z[0] - k[2] * x[1] ** 2]
    )
    system = dae_jax.SemiExplicitDAE(f, lambda t, x, z, k: jnp.stack([x[0] + x[1] + z[0] - 1]))
    start = (np.array([1.0, 0.0]), np.array([0.0]))

    def end(k):
        sol = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 1e11, None, start, k, max_steps=100_000, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-6 * rtol),
        )  # fmt: skip
        return sol.ys[1][-1, 0]

    solve = lambda: np.asarray(dae_jax.sweep(end, jnp.asarray(rates), progress=False))
    return solve(), solve


large_methods = ("RadauIIA5", "BDF")


def large(problem, rtol, method):
    import jax
    import jax.numpy as jnp

    def end(start, args, rtol):
        sol = _large(problem, start, args, rtol, method, problem.times)
        states = [x.reshape(len(x), -1) for x in jax.tree.leaves(sol.ys)]
        return jnp.concatenate(states, 1), sol.stats["num_steps"], sol.result

    return _large_calls(jax.jit(end), problem, rtol)


def large_gradient(problem, rtol, method):
    """By p, of the mean of ω² at SAMPLES times: how far the frequency deviates."""
    import jax
    import jax.numpy as jnp

    times = large_problems.samples(problem)

    def deviation(args, start, rtol):
        sol = _large(problem, start, args, rtol, method, times)
        return jnp.mean(sol.ys[0][:, 1] ** 2), (sol.stats["num_steps"], sol.result)

    def gradient(start, args, rtol):
        found, (steps, result) = jax.grad(deviation, has_aux=True)(args, start, rtol)
        return found, steps, result

    return _large_calls(jax.jit(gradient), problem, rtol)


def large_analyse(problem, rtol, method):
    """The index, for states."""
    import jax

    import dae_jax

    jax.config.update("jax_enable_x64", True)
    scene = problem.scene
    solve = lambda: dae_jax.analyse(scene.system, problem.t0, scene.y0, scene.args)
    return [solve().index], None, solve


def _large(problem, start, args, rtol, method, times):
    import diffrax

    import dae_jax

    scene = problem.scene
    return dae_jax.daesolve(
        scene.system, _solver(method), problem.t0, scene.t1, None, start, args, max_steps=1_000_000, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=scene.scale * rtol), saveat=diffrax.SaveAt(ts=times),
    )  # fmt: skip


def _large_calls(function, problem, rtol):
    """(states, steps, solve) of a jitted function of (start, parameters, tolerance) that gives (states, steps, result)."""
    import jax
    import jax.numpy as jnp

    import dae_jax

    jax.config.update("jax_enable_x64", True)
    values = jax.tree.map(jnp.asarray, (problem.start, problem.scene.args, rtol))
    solve = lambda: jax.block_until_ready(function(*values))
    end, steps, result = solve()
    if result != dae_jax.RESULTS.successful:
        raise RuntimeError("the solve failed")
    return np.asarray(end), int(steps), solve


loop_methods = ("OrthogonalProjection(DOP853)", "OrthogonalProjection(Tsit5)")


def loops(problem, rtol, method):
    from benchmarks.loops import places

    solve = _loops(problem, rtol, method)
    return places(solve().ys[0].values[-1]), solve


def long_loops(problem, rtol, t1, method=loop_methods[0]):
    """(largest gap of a joint at 1,001 times, solve)."""
    import dae_jax
    from benchmarks.loops import example

    times = np.linspace(0, t1, 1001)
    found = dae_jax.drift(example(problem).system, _loops(problem, rtol, method, times)()).position
    return float(np.max(found)), _loops(problem, rtol, method, times[-1:])


def _loops(problem, rtol, method, times=None):
    import diffrax
    import jax

    import dae_jax
    from benchmarks.loops import example

    scene = example(problem)
    times = np.array([scene.t1]) if times is None else times
    solve = jax.jit(
        lambda start, rtol: dae_jax.daesolve(
            scene.system, _solver(method), 0.0, times[-1], None, start, saveat=diffrax.SaveAt(ts=times),
            max_steps=100_000, stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        )
    )  # fmt: skip
    start, rtol = jax.tree.map(jax.numpy.asarray, (scene.y0, rtol))
    return lambda: jax.block_until_ready(solve(start, rtol))
