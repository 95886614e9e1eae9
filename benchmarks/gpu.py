"""Ensembles on a GPU, a thread a trajectory: beside `jit(vmap(diffeqsolve))` as a user of diffrax has it, our own program by XLA on
the same card, and our lanes on the CPU."""

import functools

import numpy as np

from . import timing
from .peers import plain_diffrax, problems


SIZES, QUICK_SIZES = (1_000, 100_000, 1_000_000, 8_400_000), (100, 1_000)
# XLA and the CPU are given no more trajectories than these.
FOR_XLA, FOR_CPU = 1_000_000, 100_000
# To t = 10; to t = 1 by at most 64 steps, and the gradient of that.
LARGEST = {"Lorenz": 8_400_000, "double pendulum": 1_000_000, "its solve": 100_000, "its gradient": 100_000}
# rtol and atol, or the step.
LORENZ = {"adaptive": (1e-5, 1e-6), "fixed": 1e-3}
LORENZ_CASES = (("float32", "adaptive"), ("float64", "adaptive"), ("float32", "fixed"))
PENDULUMS = 1e-6, 1e-6
# What an H200 does in a second, without its matrix units.
PEAK = {"float32": 67e12, "float64": 34e12}


def run(peers, repeats, quick):
    """A row for each problem, precision and number of trajectories."""
    import jax

    jax.config.update("jax_enable_x64", True)
    sizes = QUICK_SIZES if quick else SIZES
    cases = [("Lorenz", *case) for case in LORENZ_CASES]
    cases += [(name, "float64", "adaptive") for name in ("double pendulum", "its solve", "its gradient")]
    rows = []
    for case in cases:
        for size in sizes:
            if size > LARGEST[case[0]]:
                continue
            rows.append(_row(*case, size, repeats))
            print(_line(rows[-1]), flush=True)
    return rows


def _row(problem, precision, steps, size, repeats):
    import jax

    fn, starts = _case(problem, precision, steps, size)
    row = {
        "problem": problem,
        "precision": precision,
        "steps": steps,
        "trajectories": size,
        "device": str(jax.devices()[0]),
    }
    calls = {"ours": (fn, starts, "llvm", None)}
    if size <= FOR_XLA and problem == "Lorenz":
        calls["diffrax"] = (fn, starts, "off", None)
    if size <= FOR_XLA and problem == "double pendulum":
        calls |= {"diffrax": (_pendulums_by_diffrax, starts, "off", None), "xla": (fn, starts, "off", None)}
    if size <= FOR_CPU:
        calls["cpu"] = (fn, starts, "llvm", jax.devices("cpu")[0])
    ends = {}
    for name, call in calls.items():
        run = _compiled(*call)
        (ends[name], taken), first = timing.first_call(run)
        if name == "ours":
            row["steps_taken"] = float(np.sum(np.asarray(taken, float)))
        row[name] = timing.measure(run, repeats if name == "ours" else 1, 0.0, first)
    ours = np.asarray(ends.pop("ours"))
    # Of chaotic trajectories by two methods the most part is compared.
    row["difference"] = {name: float(np.median(_apart(ours, np.asarray(end)))) for name, end in ends.items()}
    return row


def _apart(a, b):
    """The largest difference of each trajectory."""
    return np.max(np.abs(a - b).reshape(len(a), -1), 1)


def _compiled(fn, starts, compiler, device):
    import jax

    import dae_jax

    starts = jax.device_put(starts, device)
    # A function of its own, so that nothing is known of it that another compiler has made.
    compiled = jax.jit(jax.vmap(lambda *xs: fn(*xs)))

    def call():
        with dae_jax.configure(compiler=compiler):
            return jax.block_until_ready(compiled(*starts))

    return call


def _case(problem, precision, steps, size):
    if problem == "Lorenz":
        return functools.partial(_lorenz, precision, steps), (np.linspace(0, 21, size).astype(precision),)
    rng = np.random.default_rng(0)
    few = problems.double_pendulum_starts(rng.uniform(-1.5, 1.5, (min(size, 10_000), 2)))
    starts = np.resize(few, (size, 8))
    # No two are the same.
    starts[:, [4, 6]] += 1e-9 * rng.normal(size=(size, 1))
    solve = {"its gradient": _gradient, "its solve": functools.partial(_pendulums, 1.0, max_steps=64)}
    return solve.get(problem, functools.partial(_pendulums, 10.0)), (starts,)


def _lorenz(precision, steps, rho):
    """To t = 1 from (1, 0, 0): its end, and how many steps it took."""
    import diffrax
    import jax.numpy as jnp

    from dae_jax import compiler

    def field(t, y, rho):
        return jnp.stack([10 * (y[1] - y[0]), y[0] * (rho - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]]).astype(precision)

    adaptive = steps == "adaptive"
    rtol, atol = LORENZ["adaptive"]
    control = diffrax.PIDController(rtol=rtol, atol=atol) if adaptive else diffrax.ConstantStepSize()
    number = functools.partial(jnp.asarray, dtype=precision)

    def solve(rho):
        sol = diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Tsit5(), number(0), number(1), number(0.01 if adaptive else LORENZ["fixed"]),
            number([1, 0, 0]), rho, stepsize_controller=control, saveat=diffrax.SaveAt(t1=True), max_steps=None, throw=False,
        )  # fmt: skip
        return sol.ys[0], sol.stats["num_steps"]

    return compiler.jit(solve)(rho)


def _pendulums(t1, start, max_steps=None):
    """Two pendulums in Cartesian coordinates, by DOP853 and orthogonal projection; the end, and how many steps it took."""
    import diffrax

    import dae_jax

    scene = dae_jax.scenes.double_pendulum()
    sol = dae_jax.daesolve(
        scene.system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, t1, None, (start[:4], start[4:]), scene.args,
        stepsize_controller=diffrax.PIDController(*PENDULUMS), max_steps=max_steps, throw=False,
    )  # fmt: skip
    return sol.ys[0], sol.stats["num_steps"]


def _pendulums_by_diffrax(start):
    """The same reduced to index 1 by hand, by Dopri8; its end alone."""
    end = plain_diffrax.end(plain_diffrax._double_pendulum_field, 10.0, "Dopri8", start, *PENDULUMS)
    return end[None, :4], 0


def _gradient(start):
    """Of the sum of the positions at t = 1, by at most 64 steps."""
    import jax

    def total(start):
        end, taken = _pendulums(1.0, start, 64)
        return jax.numpy.sum(end), taken

    return jax.grad(total, has_aux=True)(start)


def _operations(row):
    """Floating-point operations of a second, counted in the double pendulum's and Lorenz' equations alone; a lower bound."""
    each = {"Lorenz": 6 * 9 + 7 * 6 * 3, "double pendulum": 12 * 60 + 12 * 8 * 12}[row["problem"]]
    return row["steps_taken"] * each / row["ours"].median


def _line(row):
    parts = [
        f"{name} {1e3 * row[name].median:.4g} ms (first {row[name].first:.2f} s)"
        for name in ("ours", "diffrax", "xla", "cpu")
        if name in row
    ]
    parts += [f"{row[name].median / row['ours'].median:.1f} times {name}" for name in ("diffrax", "xla") if name in row]
    parts += [f"off {max(row['difference'].values()):.1g}"] if row["difference"] else []
    if not row["problem"].startswith("its"):
        share = _operations(row) / PEAK[row["precision"]]
        parts.append(f"{100 * share:.2g} % of an H200's operations at least")
    return f"{row['problem']:<16}{row['precision']:>8} {row['steps']:<9}{row['trajectories']:>9}  {', '.join(parts)}"


def figures(rows):
    """None."""
    return ()


def targets(rows):
    """See `work_precision.targets`."""

    def of(problem, precision, steps, size):
        key = problem, precision, steps, size
        return next((r for r in rows if (r["problem"], r["precision"], r["steps"], r["trajectories"]) == key), None)

    lorenz, pendulums = (
        of("Lorenz", "float32", "adaptive", 8_400_000),
        of("double pendulum", "float64", "adaptive", 10**6),
    )
    yield "Lorenz, 8.4 million, adaptive, float32, ms ≤ 15", lorenz and 1e3 * lorenz["ours"].median, 15
    yield "10⁶ double pendulums to 10 s, float64, ms ≤ 100", pendulums and 1e3 * pendulums["ours"].median, 100
    solve, gradient = (of(f"its {what}", "float64", "adaptive", 100_000) for what in ("solve", "gradient"))
    cost = solve and gradient and gradient["ours"].median / solve["ours"].median
    yield "gradients of 10⁵ trajectories, times the solve ≤ 6", cost, 6
    for problem, precision, steps in (
        ("double pendulum", "float64", "adaptive"),
        *(("Lorenz", *c) for c in LORENZ_CASES),
    ):
        row = of(problem, precision, steps, 10**6)
        ratio = row and "diffrax" in row and row["diffrax"].median / row["ours"].median
        yield f"10⁶ × {problem}, {precision}, {steps}, times vmap(diffeqsolve) ≥ 50", ratio or None, 50
