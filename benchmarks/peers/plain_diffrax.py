"""What a diffrax user writes today: the index reduced to 1 by hand, λ by `jnp.linalg.solve`, jitted `diffeqsolve`.

Default settings otherwise; the sweep is `jit(vmap(diffeqsolve))`. Stiff problems by Kvaerno5, the algebraic variables
eliminated by hand.
"""

import functools
import types

import numpy as np

from . import missing, problems


name = "diffrax, hand-reduced"
methods = ("Dopri8", "Tsit5")


def available():
    return missing("diffrax")


def double_pendulum(rtol, t1=10.0, method="Dopri8"):
    return _prepare(_double_pendulum_field, problems.chain_start(2), rtol, t1, method)


def pendulum(rtol, t1=10.0, method="Dopri8"):
    return _prepare(_pendulum_field, problems.chain_start(1), rtol, t1, method)


def chain(n, rtol, t1=1.0, method="Dopri8"):
    return _prepare(_chain_field, problems.chain_start(n), rtol, t1, method)


def sweep(angles, rtol, t1=10.0, method="Dopri8"):
    return _prepare(_double_pendulum_field, problems.double_pendulum_starts(angles), rtol, t1, method, batch=True)


stiff_methods = ("Kvaerno5",)


def stiff(problem, rtol, method):
    import jax.numpy as jnp

    if problem.eliminated is not None:
        split = len(problem.y0) - len(problem.algebraic)
        field = lambda t, x, args: jnp.stack(problem.semi_explicit(t, x, problem.eliminated(x), jnp)[0])
        end, solve = _prepare(field, problem.y0[:split], rtol, problem.t1, method, atol=problem.scale * rtol)
        return np.append(end, problem.eliminated(end)), solve
    scene = problem.scene()
    if not hasattr(scene.system, "constraint"):
        raise ValueError("the algebraic variables cannot be eliminated by hand")
    return _prepare(_mechanism_field(scene.system), np.concatenate(scene.y0), rtol, problem.t1, method)


large_methods = ("Kvaerno5",)
# Copies; the Jacobian is dense.
large_limits = {"robertson": 100, "heat": 0, "food web": 0, "stokes": 0, "power grid": 0}


def large(problem, rtol, method):
    """Robertson's reaction, y₃ eliminated."""
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    others = lambda x: 1 - x[: problem.n] - x[problem.n :]
    field = lambda t, x, args: problem.ode(t, x, others(x), None, jnp_operations())

    @jax.jit
    def end(start, rtol):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field), getattr(diffrax, method)(), 0.0, problem.scene.t1, None, start, max_steps=100_000,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=problem.scene.scale * rtol),
            saveat=diffrax.SaveAt(ts=problem.times),
        )  # fmt: skip

    values = jnp.asarray(problem.x0), jnp.asarray(rtol)
    solve = lambda: jax.block_until_ready(end(*values))
    sol = solve()
    x = np.asarray(sol.ys)
    return problem.in_order(x, others(x.T).T), int(sol.stats["num_steps"]), solve


def jnp_operations():
    """As `large_problems.Numpy`, of what this problem needs."""
    import jax.numpy as jnp

    return types.SimpleNamespace(join=jnp.concatenate)


def _mechanism_field(system):
    import jax
    import jax.numpy as jnp

    def field(t, y, args):
        q, v = jnp.split(y, 2)
        mass = system.mass_matrix(q, args)
        mass = jnp.diag(mass) if mass.ndim < 2 else mass
        constraint = lambda t, q: system.constraint(t, q, args)
        along = lambda t, q: jax.jvp(constraint, (t, q), (jnp.ones_like(t), v))[1]
        jacobian = jax.jacfwd(constraint, 1)(t, q)
        bias = jax.jvp(along, (t, q), (jnp.ones_like(t), v))[1]
        m = len(jacobian)
        matrix = jnp.block([[mass, jacobian.T], [jacobian, jnp.zeros((m, m))]])
        return jnp.concatenate([v, jnp.linalg.solve(matrix, jnp.append(system.force(t, q, v, args), -bias))[: len(q)]])

    return field


def _prepare(field, start, rtol, t1, method, batch=False, atol=None):
    import jax.numpy as jnp

    compiled = _compiled(field, t1, method, batch)
    y0, rtol, atol = jnp.asarray(start), jnp.asarray(rtol), jnp.asarray(atol or rtol)
    solve = lambda: compiled(y0, rtol, atol).block_until_ready()
    return np.asarray(solve()), solve


def end(field, t1, method, y0, rtol, atol):
    """The state at `t1`, by a call of diffrax as a user writes it."""
    import diffrax

    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        getattr(diffrax, method)(),
        t0=0.0,
        t1=t1,
        dt0=None,
        y0=y0,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        max_steps=100_000,
    ).ys[-1]


@functools.cache
def _compiled(field, t1, method, batch):
    """(start, tolerances) → end: compiled once for all tolerances."""
    import jax

    jax.config.update("jax_enable_x64", True)
    one = functools.partial(end, field, t1, method)
    return jax.jit(jax.vmap(one, (0, None, None)) if batch else one)


def _pendulum_field(t, y, args):
    import jax.numpy as jnp

    r, v = y[:2], y[2:]
    gravity = jnp.array([0.0, problems.GRAVITY])
    tension = (v @ v + gravity @ r) / (r @ r)
    return jnp.concatenate([v, gravity - tension * r])


def _double_pendulum_field(t, y, args):
    import jax.numpy as jnp

    r1, r2, v1, v2 = y[:2], y[2:4], y[4:6], y[6:]
    gravity = jnp.array([0.0, problems.GRAVITY])
    d, w = r2 - r1, v2 - v1
    matrix = jnp.array([[r1 @ r1, -r1 @ d], [-r1 @ d, 2 * d @ d]])
    tension = jnp.linalg.solve(matrix, jnp.array([v1 @ v1 + gravity @ r1, w @ w]))
    return jnp.concatenate([v1, v2, gravity - tension[0] * r1 + tension[1] * d, gravity - tension[1] * d])


def _chain_field(t, y, args):
    import jax.numpy as jnp

    r, v = y.reshape(2, -1, 2)
    gravity = jnp.array([0.0, problems.GRAVITY])
    d, w = jnp.diff(r, axis=0, prepend=jnp.zeros((1, 2))), jnp.diff(v, axis=0, prepend=jnp.zeros((1, 2)))
    lengths, couplings = 2 * (d * d).sum(1), -(d[:-1] * d[1:]).sum(1)
    matrix = jnp.diag(lengths.at[0].divide(2)) + jnp.diag(couplings, 1) + jnp.diag(couplings, -1)
    tension = jnp.linalg.solve(matrix, (w * w).sum(1).at[0].add(gravity @ d[0]))
    pull = tension[:, None] * d
    return jnp.concatenate([v.ravel(), (gravity - pull + jnp.pad(pull[1:], ((0, 1), (0, 0)))).ravel()])
