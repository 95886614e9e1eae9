"""A solve that fails says so wherever it is asked for: outside and inside `jit`, in batches, and where only its derivative is used."""

import math

import diffrax
import jax
import jax.numpy as jnp
import pytest

import dae_jax


ARMS = dae_jax.ConstrainedSystem(
    lambda t, q, v, args: jnp.array([0.0, -9.81, 0.0, -9.81]),
    lambda t, q, args: jnp.stack([(q[:2] @ q[:2] - 1) / 2, (q[2:] @ q[2:] - 1) / 2]),
)
GOOD = jnp.array([1.0, 0.0, 0.0, 1.0])
BAD = GOOD.at[3].set(1.1)
METHODS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), diffrax.RecursiveCheckpointAdjoint()),
    "forwards": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), diffrax.ForwardMode()),
}
# What is asked for, as a function of the end of the solve as a function of q.
ASKED = {
    "value": lambda end: end,
    "jit": lambda end: jax.jit(end),
    "vmap": lambda end: lambda q: jax.vmap(end)(jnp.stack([GOOD, q])),
    "vmap of vmap": lambda end: lambda q: jax.vmap(jax.vmap(end))(jnp.stack([jnp.stack([GOOD, q])] * 3)),
    "directional derivative": lambda end: lambda q: jax.jvp(end, (q,), (q,)),
    "jit of a directional derivative alone": lambda end: jax.jit(lambda q: jax.jvp(end, (q,), (q,))[1]),
    "gradient": lambda end: jax.grad(end),
    "jit of a gradient": lambda end: jax.jit(jax.grad(end)),
    "vmap of a gradient": lambda end: lambda q: jax.jit(jax.vmap(jax.grad(end)))(jnp.stack([GOOD, q])),
}


def end_of(method, **options):
    solver, adjoint = METHODS[method]
    return lambda q: dae_jax.daesolve(
        ARMS, solver, 0.0, 1.0, None, (q, jnp.zeros(4)), adjoint=adjoint, **options
    ).ys[0].sum()  # fmt: skip


@pytest.mark.parametrize(
    ("method", "asked"),
    [(method, asked) for method in METHODS for asked in ASKED if method == "projection" or "gradient" not in asked],
)
class TestFails:
    def test_at_a_bad_start_in_the_name_of_the_constraint(self, method, asked):
        with pytest.raises(
            (ValueError, RuntimeError), match=r"position level: 0 = constraint\[1\] \(g\) is off by 0\.105"
        ):
            jax.block_until_ready(ASKED[asked](end_of(method))(BAD))

    def test_after_too_many_steps(self, method, asked):
        with pytest.raises(RuntimeError, match="maximum number of"):
            jax.block_until_ready(ASKED[asked](end_of(method, max_steps=3))(GOOD))


def test_a_derivative_of_a_solve_that_goes_well_is_as_without_the_check():
    both = [jax.jit(jax.grad(end_of("projection", throw=throw)))(GOOD) for throw in (True, False)]
    assert jnp.array_equal(*both)


LOST = dae_jax.ConstrainedSystem(
    lambda t, q, v, args: jnp.where(t > 0.5, jnp.nan, jnp.array([0.0, -9.81])), lambda t, q, args: (q @ q - 1) / 2
)
# ẏ = −1 − √y: a tank that is empty at 2 (1 − log 2).
TANK = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd + jnp.sqrt(y) + 1)


@pytest.mark.parametrize(
    ("solver", "dt0"),
    [
        (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
        (dae_jax.RadauIIA5(), None),
        (dae_jax.BDF(), None),
        (dae_jax.RATTLE(), 0.01),
    ],
    ids=["projection", "radau", "bdf", "rattle"],
)
def test_a_function_that_is_not_finite_on_the_way_is_named(solver, dt0):
    with pytest.raises(RuntimeError, match=r"not finite: .*`force\(t, q, v, args\)` is not finite just beyond t = 0.5"):
        dae_jax.daesolve(LOST, solver, 0.0, 1.0, dt0, (jnp.array([1.0, 0.0]), jnp.zeros(2)))


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF(), diffrax.Tsit5()], ids=["radau", "bdf", "tsit"])
def test_a_domain_that_is_left_is_named(solver):
    with pytest.raises(RuntimeError, match=r"`residual\(t, y, yd, args\)` is not finite just beyond t = 0.613706"):
        dae_jax.daesolve(TANK, solver, 0.0, 2.0, None, jnp.ones(1))


def test_where_a_solve_ended_is_known_whatever_is_saved():
    sol = dae_jax.daesolve(
        TANK, diffrax.Tsit5(), 0.0, 2.0, None, jnp.ones(1), throw=False, saveat=diffrax.SaveAt(ts=jnp.array([0.1, 1.9]))
    )
    t, y = sol.end
    assert float(t) == pytest.approx(2 - 2 * math.log(2), abs=1e-5)
    assert 0 <= float(y[0]) < 1e-4


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.RadauIIA5()], ids=["explicit", "radau"])
def test_tolerances_below_roundoff_are_said_to_be_so(solver):
    options = {"stepsize_controller": diffrax.PIDController(rtol=1e-18, atol=1e-18), "max_steps": 50}
    with pytest.raises(RuntimeError, match=r"rtol = 1e-18 and atol = 1e-18, are below round-off, which is 2\.2e-16"):
        dae_jax.daesolve(TANK, solver, 0.0, 0.5, None, jnp.ones(1), **options)
