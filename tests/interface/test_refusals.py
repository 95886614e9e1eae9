"""What a newcomer gets wrong, and the sentence that says so: the argument, what it must be, what it was, what to do."""
# A row of the table is a line.
# ruff: noqa: E501

import dataclasses
import math
import re
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax as D


TSIT5, RADAU, PROJECTED = diffrax.Tsit5(), D.RadauIIA5(), D.OrthogonalProjection(diffrax.Tsit5())
RANDOM = np.random.default_rng(0)
Q0, V0 = jnp.array([1.0, 0.0]), jnp.zeros(2)


def force(t, q, v, args):
    return jnp.array([0.0, -9.81])


def constraint(t, q, args):
    return (q @ q - 1) / 2


PENDULUM = D.ConstrainedSystem(force, constraint)
DECAY = D.ImplicitDAE(lambda t, y, yd, args: yd + y)
PAIR = D.SemiExplicitDAE(lambda t, x, z, args: -x, lambda t, x, z, args: z - x)


def solve(system=PENDULUM, solver=PROJECTED, y0=(Q0, V0), t0=0.0, t1=1.0, dt0=None, args=None, **options):
    return D.daesolve(system, solver, t0, t1, dt0, y0, args, **options)


def mechanism(force=force, constraint=constraint, **more):
    return lambda: solve(D.ConstrainedSystem(force, constraint, **more))


def started(y0, system=PENDULUM, solver=PROJECTED):
    return lambda: solve(system, solver, y0)


def given(**options):
    return lambda: solve(**options)


def by(formulation, solver=TSIT5, **options):
    return lambda: solve(solver=solver, formulation=formulation() if callable(formulation) else formulation, **options)


def implicit(residual, y0=None):
    return lambda: solve(D.ImplicitDAE(residual), RADAU, jnp.ones(2) if y0 is None else y0)


def semi(f, g, y0=None):
    return lambda: solve(D.SemiExplicitDAE(f, g), RADAU, (jnp.ones(2), jnp.ones(2)) if y0 is None else y0)


def event(condition, jump=None, **more):
    return lambda: solve(event=diffrax.Event(condition) if jump is None else D.Reset(condition, jump, **more))


def steps(controller, solver=PROJECTED, dt0=None):
    return lambda: solve(solver=solver, dt0=dt0, stepsize_controller=controller)


def level(t, y, args, **kwargs):
    return y[0][0] - 0.9


def kept(t, y, args):
    return y, args


# (what is wrong, how it is called, what is said of it)
FUNCTIONS = {
    "force of another length": (mechanism(lambda t, q, v, a: jnp.zeros(3)), "`force(t, q, v, args)` must return the structure of q, float64[2], but returns float64[3]."),
    "force of None": (mechanism(lambda t, q, v, a: None), "`force(t, q, v, args)` must return real numbers in the structure of q, but returns None."),
    "force of one number for two": (mechanism(lambda t, q, v, a: -9.81), "`force(t, q, v, args)` must return the structure of q, float64[2], but returns float64[]."),
    "force of words": (mechanism(lambda t, q, v, a: "down"), "`force(t, q, v, args)` must return real numbers in the structure of q, but returns 'down'."),
    "force of complex numbers": (mechanism(lambda t, q, v, a: q * 1j), "must return real numbers in the structure of q, but returns complex128[2]."),
    "force of a transposed matrix": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: q.T, lambda t, q, a: q[0, 0]), y0=(jnp.zeros((2, 3)),) * 2), "must return the structure of q, float64[2,3], but returns float64[3,2]."),
    "force of another structure": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: {"b": q["a"]}, lambda t, q, a: q["a"][0]), y0=({"a": Q0 * 0},) * 2), "must return the structure of q, {'a': float64[2]}, but returns {'b': float64[2]}."),
    "force without args": (mechanism(lambda t, q, v: q), "`force(t, q, v, args)` must take these arguments, but the function given takes (t, q, v): write `def force(t, q, v, args): ...`."),
    "force by math": (mechanism(lambda t, q, v, a: math.sin(q[0]) * q), "use jax.numpy and `jnp.where` in place of numpy, `math`, `float` and `if`."),
    "force with an if": (mechanism(lambda t, q, v, a: q if q[0] > 0 else -q), "`force(t, q, v, args)` must be traceable by JAX"),
    "force by chance": (mechanism(lambda t, q, v, a: q * np.random.rand()), "`force(t, q, v, args)` has other numbers in it each time it is called, such as random ones or the time of day"),
    "force by a generator": (mechanism(lambda t, q, v, a: q + RANDOM.normal(size=2)), "Find them before, and hand them over in `args`."),
    "force by the clock": (mechanism(lambda t, q, v, a: q * time.perf_counter()), "the compiled program would go on with those of one call"),
    "force and constraint swapped": (mechanism(lambda t, q, a: q @ q, lambda t, q, v, a: q), "`force(t, q, v, args)` must take these arguments, but the function given takes (t, q, a)"),
    "force is no function": (mechanism("gravity"), "`force` must be a function, but is 'gravity'."),
    "args in words": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: a * q, constraint), args="9.81"), "`force(t, q, v, args)` fails with q: float64[2], v: float64[2], args: '9.81': TypeError"),
    "args left out": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: a["g"] * q, constraint)), "`force(t, q, v, args)` fails with q: float64[2], v: float64[2], args: None: TypeError: 'NoneType' object is not subscriptable. No `args` were given: pass `args=...`."),
    "args without a key": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: a["g"] * q, constraint), args={"k": 1.0}), "args: {'k': float64[]}: KeyError: 'g'."),
    "constraint of a list": (mechanism(constraint=lambda t, q, a: [q @ q - 1]), "`constraint(t, q, args)` must return a number or a vector, one entry a constraint, but returns [float64[]]: put the constraints together with `jnp.stack([...])`"),
    "constraint of a pair": (mechanism(constraint=lambda t, q, a: (q[0] - 1, q[1])), "one entry a constraint, but returns (float64[], float64[])"),
    "constraint of None": (mechanism(constraint=lambda t, q, a: None), "one entry a constraint, but returns None"),
    "constraint of a boolean": (mechanism(constraint=lambda t, q, a: q @ q == 1), "`constraint(t, q, args)` must return real floating-point numbers, which have a derivative, but returns bool[]."),
    "constraint of an integer": (mechanism(constraint=lambda t, q, a: (q @ q - 1).astype(int)), "which have a derivative, but returns int64[]."),
    "constraint of nothing": (mechanism(constraint=lambda t, q, a: q[:0]), "`constraint(t, q, args)` must return at least one constraint, but returns float64[0]"),
    "constraint of q alone": (mechanism(constraint=lambda q: q @ q - 1), "`constraint(t, q, args)` must take these arguments, but the function given takes (q)"),
    "nonholonomic without args": (mechanism(nonholonomic=lambda t, q, v: v[0]), "`nonholonomic(t, q, v, args)` must take these arguments, but the function given takes (t, q, v)"),
    "nonholonomic of a list": (mechanism(nonholonomic=lambda t, q, v, a: [v[0]]), "`nonholonomic(t, q, v, args)` must return a number or a vector"),
    "mass of another length": (mechanism(mass=jnp.ones(3)), "`mass` must be a vector of 2 masses, a (2, 2) matrix, or have the structure of q, float64[2], but is float64[3]."),
    "mass of length 1": (mechanism(mass=jnp.ones(1)), "`mass` must be a vector of 2 masses, a (2, 2) matrix, or have the structure of q, float64[2], but is float64[1]."),
    "mass not square": (mechanism(mass=jnp.ones((2, 3))), "but is float64[2,3]."),
    "mass in words": (mechanism(mass="heavy"), "but is 'heavy'."),
    "mass as lists in a list": (mechanism(mass=[[1.0, 0.0], [0.0, 1.0]]), "`mass` must be a vector of 2 masses"),
    "mass function of another length": (mechanism(mass=lambda q, a: jnp.ones(3)), "`mass(q, args)` must be a vector of 2 masses"),
    "mass function without args": (mechanism(mass=lambda q: jnp.ones(2)), "`mass(q, args)` must take these arguments, but the function given takes (q)"),
    "rank in words": (mechanism(rank="1"), "`rank` must be how many of the constraints are independent, an integer"),
    "rank negative": (mechanism(rank=-1), "or None for all of them, but is -1."),
    "residual of another length": (implicit(lambda t, y, yd, a: yd[0]), "`residual(t, y, yd, args)` must return as many equations as y has unknowns, 2, but returns 1: float64[]."),
    "residual of None": (implicit(lambda t, y, yd, a: None), "`residual(t, y, yd, args)` must return numbers, but returns None."),
    "residual of booleans": (implicit(lambda t, y, yd, a: yd == y), "must return real floating-point numbers, which have a derivative, but returns bool[2]."),
    "residual without args": (implicit(lambda t, y, yd: yd), "`residual(t, y, yd, args)` must take these arguments, but the function given takes (t, y, yd)"),
    "f of another length": (semi(lambda t, x, z, a: x[0], lambda t, x, z, a: z - x), "`f(t, x, z, args)` must return the structure of x, float64[2], but returns float64[]."),
    "g of another length": (semi(lambda t, x, z, a: x, lambda t, x, z, a: z[0]), "`g(t, x, z, args)` must return as many equations as z has unknowns, 2, but returns 1"),
    "potential of a vector": (lambda: D.energy(D.ConstrainedSystem(force, constraint, potential=lambda q, a: q), solved()), "`potential(q, args)` must return a real number, but returns float64[2]."),
    "saved function of y alone": (given(saveat=diffrax.SaveAt(t1=True, fn=lambda y: y)), "`saveat.fn(t, y, args)` must take these arguments, but the function given takes (y)"),
}  # fmt: skip


def solved(**options):
    return solve(t1=0.1, **options)


STATES = {
    "None": (started(None), "`y0` must be the pair (q, v) of positions and velocities, but is None."),
    "words": (started(("left", "fast")), "`y0` must hold arrays of floating-point numbers, but holds 'left'."),
    "one vector": (started(jnp.zeros(4)), "if v is behind q in it, write `y0=(y[:2], y[2:])`."),
    "three parts": (started((Q0, V0, V0)), "`y0` must be the pair (q, v) of positions and velocities"),
    "lists": (started(([1.0, 0.0], [0.0, 0.0])), "`y0` holds lists, which are no arrays: write jnp.array([1.0, 0.0]) in place of [1.0, 0.0]."),
    "tuples": (started(((1.0, 0.0), (0.0, 0.0))), "`y0` holds tuples of numbers, which are no arrays: write jnp.array([1.0, 0.0]) in place of (1.0, 0.0)."),
    "a solution": (lambda: solve(y0=solved()), "`y0` must be a state, but is a solution: go on from its last state with `y0=sol.final`."),
    "with its time axis": (lambda: solve(y0=solved().ys), "`y0` must be one state, but has a leading axis of length 1: a time axis as in `sol.ys`, or a batch. Go on from the last saved state with `y0=sol.final`, that is `jax.tree.map(lambda x: x[-1], sol.ys)`; solve a batch with `jax.vmap`."),
    "with a time axis of entries": (lambda: solve(D.ConstrainedSystem(lambda t, q, v, a: 0 * q, lambda t, q, a: q[0] ** 2 + q[1] ** 2 - 1), y0=(jnp.array([[1.0, 0.0], [0.6, 0.8]]), jnp.zeros((2, 2)))), "a leading axis of length 2"),
    "a batch": (started((jnp.ones((3, 2)), jnp.zeros((3, 2)))), "a leading axis of length 3"),
    "half precision": (started((Q0.astype(jnp.float16), V0.astype(jnp.float16))), "float32 or float64, but has float16."),
    "integers": (started((jnp.array([1, 0]), V0)), "`y0` must hold floating-point numbers, float32 or float64, but has int64; write 1.0 in place of 1."),
    "a flat (x, z)": (started(jnp.ones(4), PAIR, RADAU), "`y0` must be the pair (x, z) of a SemiExplicitDAE"),
    "nothing": (started({}, DECAY, RADAU), "`y0` must hold numbers, but is empty: {}."),
    "no numbers": (started(jnp.zeros(0), DECAY, RADAU), "`y0` must hold numbers, but its arrays are empty: float64[0]."),
    "no coordinates": (started((jnp.zeros(0), jnp.zeros(0))), "its arrays are empty: (float64[0], float64[0])."),
    "t1 in words": (given(t1="1"), "`t1` must be a real number, but is '1'."),
    "an interval below float32": (
        lambda: D.daesolve(PENDULUM, PROJECTED, 1e8, 1e8 + 3, None, jax.tree.map(jnp.float32, (Q0, V0))),
        "are one number in float32, which `y0` is in",
    ),
    "t1 of None": (given(t1=None), "`t1` must be a real number, but is None."),
    "t1 in a vector": (given(t1=jnp.ones(1)), "`t1` must be a real number, but is Array([1.]"),
    "t1 true": (given(t1=True), "`t1` must be a real number, but is True."),
    "dt0 of 0": (given(dt0=0.0), "`dt0` must be a step, or None for steps that are chosen, but is 0: the order is t0, t1, dt0, y0."),
    "t0 and dt0 swapped": (lambda: D.daesolve(PENDULUM, PROJECTED, 0.01, 1.0, 0.0, (Q0, V0)), "the order is t0, t1, dt0, y0."),
    "y0 first": (lambda: D.daesolve(PENDULUM, PROJECTED, (Q0, V0), 0.0, 1.0, None), "`y0` must be the pair (q, v)"),
}  # fmt: skip


METHODS = {
    "solver a class": (given(solver=diffrax.Tsit5), "`solver` must be one of dae_jax or of diffrax, such as OrthogonalProjection(DOP853()), RadauIIA5() or diffrax.Tsit5(), but is the class Tsit5: write Tsit5(...)."),
    "our solver a class": (given(solver=D.RadauIIA5), "but is the class RadauIIA5: write RadauIIA5(...)."),
    "solver of None": (given(solver=None), "`solver` must be one of dae_jax or of diffrax, such as OrthogonalProjection(DOP853()), RadauIIA5() or diffrax.Tsit5(), but is None."),
    "solver a formulation": (given(solver=D.Baumgarte(1.0, 1.0)), ": give it as `formulation`."),
    "formulation a solver": (by(RADAU), "`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is RadauIIA5(): give it as `solver`."),
    "formulation a class": (lambda: solve(formulation=D.Baumgarte), "but is the class Baumgarte: write Baumgarte(...)."),
    "formulation not called": (lambda: solve(solver=RADAU, formulation=D.GGL), "but is the function GGL."),
    "formulation in words": (by("index-2", RADAU), "`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is 'index-2'."),
    "split equations": (given(solver=diffrax.SemiImplicitEuler(), dt0=0.1), "SemiImplicitEuler needs equations that are split or have noise: use diffrax.Tsit5(), dae_jax.RadauIIA5() for stiff equations, or dae_jax.RATTLE() for a symplectic method."),
    "implicit-explicit": (given(solver=diffrax.KenCarp4()), "KenCarp4 needs equations that are split or have noise"),
    "noise": (given(solver=diffrax.EulerHeun(), dt0=0.1), "EulerHeun needs equations that are split or have noise"),
    "implicit without tolerance": (given(solver=diffrax.ImplicitEuler(), dt0=0.1), "give it `root_finder=diffrax.VeryChord(rtol=1e-10, atol=1e-10)`, or leave out `dt0`."),
    "projection of Radau": (lambda: D.OrthogonalProjection(RADAU), "OrthogonalProjection takes a solver of ODEs such as diffrax.Tsit5(), but got RadauIIA5(), which keeps the constraints by itself: use it without OrthogonalProjection."),
    "projection twice": (lambda: D.OrthogonalProjection(PROJECTED), "which keeps the constraints by itself"),
    "projection of a class": (lambda: D.OrthogonalProjection(diffrax.Tsit5), "but got the class Tsit5: write Tsit5(...)."),
    "projection of None": (lambda: D.OrthogonalProjection(None), "but got None."),
    "tangent space of a class": (lambda: D.TangentSpace(diffrax.Tsit5), "but got the class Tsit5: write Tsit5(...)."),
    "symmetric projection of a class": (lambda: D.SymmetricProjection(D.Trapezoid), "but got the class Trapezoid: write Trapezoid(...)."),
    "Baumgarte in words": (lambda: D.Baumgarte("a", 1.0), "`alpha` of Baumgarte must be a number in 1/s, but is 'a'."),
    "Baumgarte of None": (lambda: D.Baumgarte(1.0, None), "`beta` of Baumgarte must be a number in 1/s, but is None."),
    "Baumgarte of NaN": (lambda: D.Baumgarte(math.nan, 1.0), "`alpha` of Baumgarte must be finite, but is nan."),
    "Baumgarte of vectors": (by(lambda: D.Baumgarte(jnp.ones(2), 1.0)), "`alpha` and `beta` of Baumgarte must be numbers, but have the shapes (2,) and (): batch over them with `jax.vmap`."),
    "chart of None": (lambda: D.StateSpace(None), "`chart` of StateSpace must be a function from coordinates z to q, but is None."),
    "guess in words": (lambda: D.StateSpace(lambda z: z, guess="x"), "`guess` of StateSpace must be a vector of coordinates, but is 'x'."),
    "chart off the constraint": (by(lambda: D.StateSpace(lambda z: jnp.stack([2 * jnp.sin(z[0]), jnp.cos(z[0])]))), "the chart of `StateSpace` does not give the initial positions (it must satisfy the constraints for every z"),
    "chart that leaves the constraint": (by(lambda: D.StateSpace(lambda z: jnp.stack([jnp.cos(z[0]) + 0.3 * z[0], jnp.sin(z[0])]))), "the chart of `StateSpace` leaves them"),
    "controller a class": (steps(diffrax.PIDController), "`stepsize_controller` must be a step-size controller such as diffrax.PIDController(rtol=1e-6, atol=1e-6), but is the class PIDController: write PIDController(...)."),
    "controller a tolerance": (steps(1e-6), "`stepsize_controller` must be a step-size controller such as diffrax.PIDController(rtol=1e-6, atol=1e-6), but is 1e-06."),
    "tolerance negative": (steps(diffrax.PIDController(-1e-6, 1e-6)), "`stepsize_controller` must have positive tolerances, numbers or one for each unknown, but has rtol = -1e-06 and atol = 1e-06"),
    "tolerances in a list": (steps(diffrax.PIDController(1e-6, [1e-6, 1e-7, 1e-8])), "`atol` of the step-size control must be a number or have one for each of (float64[2], float64[2]), in that structure, but is [float64[], float64[], float64[]]."),
    "tolerances of another shape": (steps(diffrax.PIDController(jnp.full(3, 1e-6), 1e-6)), "`rtol` of the step-size control must be a number or have one for each of (float64[2], float64[2]), in that structure, but is float64[3]."),
    "tolerances one of 0": (steps(diffrax.PIDController(0.0, (1e-6, jnp.array([0.0, 1e-6])))), "`stepsize_controller` must have positive tolerances, numbers or one for each unknown"),
    "tolerances in a chart": (given(solver=diffrax.Tsit5(), formulation=D.StateSpace(lambda z: jnp.stack([jnp.sin(z[0]), -jnp.cos(z[0])])), stepsize_controller=diffrax.PIDController(1e-6, (1e-6, 1e-6))), "`atol` of the step-size control has a tolerance for each unknown, but StateSpace integrates coordinates of its own: give a number."),
    "tolerances of 0": (steps(diffrax.PIDController(0.0, 0.0)), "`stepsize_controller` must have positive tolerances"),
    "tolerance in words": (steps(diffrax.PIDController("1e-6", 1e-6)), "but has rtol = '1e-6' and atol = 1e-06"),
    "fixed steps of no size": (steps(diffrax.ConstantStepSize()), "`dt0` must be given: ConstantStepSize takes steps of that size."),
    "control without an estimate": (steps(diffrax.PIDController(1e-6, 1e-6), diffrax.Euler(), 0.1), "`stepsize_controller` must not be PIDController, as Euler estimates no error: leave it out and give `dt0`"),
    "max_steps negative": (given(max_steps=-5), "`max_steps` must be an integer of at least 1, or None for no limit, but is -5."),
    "max_steps of 0": (given(max_steps=0), "`max_steps` must be an integer of at least 1"),
    "max_steps a float": (given(max_steps=1e4), "or None for no limit, but is 10000.0."),
    "max_steps in words": (given(max_steps="100"), "or None for no limit, but is '100'."),
    "saveat the times": (given(saveat=jnp.linspace(0, 1, 5)), "`saveat` must be a diffrax.SaveAt such as diffrax.SaveAt(ts=jnp.linspace(t0, t1, 101)), but is Array("),
    "saveat of None": (given(saveat=None), "`saveat` must be a diffrax.SaveAt such as diffrax.SaveAt(ts=jnp.linspace(t0, t1, 101)), but is None."),
    "saveat with NaN": (given(saveat=diffrax.SaveAt(ts=np.array([0.0, np.nan]))), "`saveat.ts` must be a vector of finite times"),
    "saveat with a matrix": (given(saveat=diffrax.SaveAt(ts=np.zeros((2, 2)))), "`saveat.ts` must be a vector of finite times"),
    "saveat of what is inside": (given(saveat=diffrax.SaveAt(t1=True, solver_state=True, made_jump=True)), "`saveat` must not ask for solver_state and made_jump, which a solution does not keep: go on with `y0=sol.final`."),
    "adjoint a class": (given(adjoint=diffrax.ForwardMode), "`adjoint` must be a diffrax adjoint such as diffrax.ForwardMode(), but is the class ForwardMode"),
    "adjoint in words": (given(adjoint="forward"), "`adjoint` must be a diffrax adjoint such as diffrax.ForwardMode(), but is 'forward'."),
    "backsolve": (given(adjoint=diffrax.BacksolveAdjoint()), "`adjoint` must not be BacksolveAdjoint, which knows nothing of the constraints: use the default, RecursiveCheckpointAdjoint(), for reverse mode, and ForwardMode() for forward mode."),
    "forward derivatives in reverse": (lambda: jax.grad(lambda a: solve(y0=(Q0, V0 * a), adjoint=diffrax.ForwardMode()).final[0][0])(1.0), "With `adjoint=diffrax.ForwardMode()`, which a Lyapunov exponent is found with too, there are forward derivatives only: `jax.jvp`, `jax.jacfwd`. For `jax.grad` leave `adjoint` out."),
    "implicit adjoint": (given(adjoint=diffrax.ImplicitAdjoint()), "`adjoint` must not be ImplicitAdjoint"),
    "progress meter a class": (given(progress_meter=diffrax.TqdmProgressMeter), "`progress_meter` must be a progress meter such as diffrax.TqdmProgressMeter(), but is the class TqdmProgressMeter"),
    "system a class": (given(system=D.ConstrainedSystem), "`system` must be a dae_jax.ConstrainedSystem, SemiExplicitDAE or ImplicitDAE, but is the class ConstrainedSystem."),
    "system a function": (given(system=force), "SemiExplicitDAE or ImplicitDAE, but is a function."),
}  # fmt: skip


EVENTS = {
    "a function": (given(event=level), "`event` must be a diffrax.Event(condition), which ends the solve, or a dae_jax.Reset(condition, reset), after which it goes on, but is the function level."),
    "a class": (given(event=D.Reset), "but is the class Reset: write Reset(...)."),
    "Event without keywords": (event(lambda t, y, a: y[0][0]), "`condition(t, y, args, **kwargs)` must take these arguments, but the function given takes (t, y, a)"),
    "Event with other keywords": (event(lambda t, y, a, *, other, **k: y[0][0]), "`condition(t, y, args, **kwargs)` must take these arguments"),
    "Event of diffrax's terms": (event(diffrax.steady_state_event(1e-3, 1e-3)), "`condition(t, y, args, **kwargs)` fails with"),
    "Event of a vector": (event(lambda t, y, a, **k: y[0]), "`condition(t, y, args, **kwargs)` must return a real number, whose zero is the event, but returns float64[2]."),
    "Event of an integer": (event(lambda t, y, a, **k: 1), "must return a real number, whose zero is the event, but returns int64[]."),
    "root finder in words": (lambda: solve(event=diffrax.Event(level, "newton")), "`root_finder` of diffrax.Event must be a root finder such as optimistix.Newton(1e-8, 1e-8), but is 'newton'."),
    "Reset without keywords": (event(lambda t, y, a: y[0][0], kept), "`condition(t, y, args, **kwargs)` must take these arguments, but the function given takes (t, y, a): write `def condition(t, y, args, **kwargs): ...`."),
    "Reset in steps": (event(lambda t, y, a, **k: jnp.where(y[0][0] < 0, 1.0, 0.0), kept), "has steps and no slope: return what crosses zero"),
    "Reset on None": (event(lambda t, y, a, **k: None, kept), "must return a real number, whose zero is the event, but returns None."),
    "jump to y alone": (event(level, lambda t, y, a: y), "`reset(t, y, args)` must return (y, args), the state and the args to go on with, ((float64[2], float64[2]), None), but returns (float64[2], float64[2])."),
    "jump to None": (event(level, lambda t, y, a: None), "`reset(t, y, args)` must return (y, args)"),
    "jump to other args": (event(level, lambda t, y, a: (y, 1.0)), "but returns ((float64[2], float64[2]), float64[])."),
    "jump to another shape": (event(level, lambda t, y, a: ((y[0], jnp.zeros(3)), a)), "but returns ((float64[2], float64[3]), None)."),
    "jump of y alone": (event(level, lambda y: (y, None)), "`reset(t, y, args)` must take these arguments, but the function given takes (y)"),
    "no condition": (event(0.9, kept), "`condition` of Reset must be a function, but is 0.9."),
    "max_resets of 0": (event(level, kept, max_resets=0), "`max_resets` of Reset must be an integer of at least 1, but is 0."),
    "direction of -1": (event(level, kept, direction=-1), "`direction` of Reset must be True for upcrossings, False for downcrossings or None for both, but is -1."),
    "fixed for all": (event(level, kept, fixed=True), "`fixed` must hold booleans in the structure of the state, (float64[2], float64[2]), but is bool[]."),
}  # fmt: skip


AROUND = {
    "energy without a potential": (lambda: D.energy(PENDULUM, solved()), "The energy needs `ConstrainedSystem(..., potential=lambda q, args: ...)`."),
    "drift swapped": (lambda: D.drift(solved(), PENDULUM), "`system` must be a dae_jax.ConstrainedSystem, SemiExplicitDAE or ImplicitDAE, but is a DAESolution."),
    "drift of states": (lambda: D.drift(PENDULUM, (Q0, V0)), "`sol` must be what `daesolve` returns, but is (Array("),
    "drift of a function": (lambda: D.drift(PENDULUM, solved(saveat=diffrax.SaveAt(t1=True, fn=lambda t, y, a: y[0]))), "`sol.ys` must hold states of `system`: leave out `SaveAt(fn=...)`"),
    "drift of dense output": (lambda: D.drift(PENDULUM, solved(saveat=diffrax.SaveAt(dense=True))), "`sol` must have saved states: `SaveAt(t1=True)` or `SaveAt(ts=...)`"),
    "largest drift of a batch": (lambda: D.reductions.largest_drift(PENDULUM, jax.vmap(lambda a: solve(y0=(Q0, a * V0)))(jnp.ones(2))), "and the one given is a batch: call it within `jax.vmap`."),
    "final of dense output": (lambda: solved(saveat=diffrax.SaveAt(dense=True)).final, "The solution has no saved states; pass `saveat=diffrax.SaveAt(t1=True)`."),
    "multipliers of an ImplicitDAE": (lambda: D.multipliers(DECAY, solved()), "`multipliers` takes a ConstrainedSystem; those of this ImplicitDAE are among its unknowns, in `sol.ys`."),
    "multipliers of y": (lambda: D.multipliers(PENDULUM, 0.0, (Q0, V0)), "`multipliers` takes (system, sol) or (system, t, q, v, args)."),
    "consistent_state of a vector": (lambda: D.consistent_state(PENDULUM, 0.0, jnp.ones(4)), "`y0` must be the pair (q, v)"),
    "consistent_state fixed for all": (lambda: D.consistent_state(PENDULUM, 0.0, (Q0, V0), fixed=True), "`fixed` must hold booleans in the structure of the state"),
    "consistent_state fixed in another shape": (lambda: D.consistent_state(PENDULUM, 0.0, (Q0, V0), fixed=(np.ones(3, bool), False)), "(float64[2], float64[2]), but is (bool[3], bool[])."),
    "consistent_state of NaN": (lambda: D.consistent_state(PENDULUM, 0.0, (Q0, V0 * jnp.nan)), "`y0` must be finite, but has NaN or infinity"),
    "analyse of nothing": (lambda: D.analyse(DECAY, 0.0, jnp.zeros(0)), "`y0` must hold numbers, but its arrays are empty: float64[0]."),
    "grid within jit": (lambda: jax.jit(lambda a: D.grid(a=a * Q0).shape[0] + a)(1.0), "`grid` looks at numbers, which are not known within `jit`"),
    "analyse of a vector": (lambda: D.analyse(PENDULUM, 0.0, jnp.ones(4)), "`y0` must be the pair (q, v)"),
    "analyse of a function": (lambda: D.analyse(force, 0.0, jnp.ones(4)), "ImplicitDAE, but is a function."),
    "analyse within jit": (lambda: jax.jit(lambda a: D.analyse(PENDULUM, 0.0, (a * Q0, V0)).index + a)(1.0), "`analyse` looks at numbers, which are not known within `jit`"),
    "explain within vmap": (lambda: jax.vmap(lambda a: D.explain(D.SemiExplicitDAE(lambda t, x, z, _: z * a, lambda t, x, z, _: x - z * a), D.BDF(), 0.0, (Q0, V0)).index + a)(Q0), "`explain` looks at numbers, which are not known within `jit`"),
    "explain in another order": (lambda: D.explain(PENDULUM, PROJECTED, (Q0, V0), 0.0), "`t0` must be a real number"),
    "explain of a wrong force": (lambda: D.explain(D.ConstrainedSystem(lambda t, q, v, a: None, constraint), PROJECTED, 0.0, (Q0, V0)), "`force(t, q, v, args)` must return real numbers"),
    "sweep of nothing": (lambda: D.sweep(None, jnp.ones(3)), "`fn` must be a function of one element, but is None."),
    "tune of nothing": (lambda: D.tune(3.0, {"a": 1.0}, steps=2), "`loss` must be a function of the parameters, but is 3.0."),
    "tune of words": (lambda: D.tune(lambda p: p["a"], {"a": "x"}, steps=2), "`params` must be positive and finite, but hold x."),
}  # fmt: skip


TABLE = [
    pytest.param(call, said, id=f"{name}: {wrong}")
    for name, table in {
        "function": FUNCTIONS,
        "start": STATES,
        "method": METHODS,
        "event": EVENTS,
        "use": AROUND,
    }.items()
    for wrong, (call, said) in table.items()
]


@pytest.mark.parametrize(("call", "said"), TABLE)
def test_wrong_input_is_refused_in_a_sentence(call, said):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=re.escape(said)):
        call()


@pytest.mark.parametrize("dt0", [None, 0.01])
def test_a_batch_refuses_its_lane_with_a_negative_alpha(dt0):
    """Errors grow there like those of which a number is refused."""
    run = lambda alpha: solve(solver=TSIT5, dt0=dt0, formulation=D.Baumgarte(alpha, 2.0), throw=False).result._value
    codes = jax.vmap(run)(jnp.array([-3.0, 0.0, 3.0]))
    assert codes.tolist() == [int(D.RESULTS.undefined_formulation._value), 0, 0]


def test_also_under_jit():
    """What needs no numbers is refused while the program is traced."""
    bad = D.ConstrainedSystem(lambda t, q, v, a: jnp.zeros(3), constraint)
    with pytest.raises(ValueError, match="must return the structure of q"):
        jax.jit(lambda q: solve(bad, y0=(q, V0)).ys)(Q0)
    with pytest.raises(ValueError, match=r"y0=sol\.final"):
        jax.jit(lambda q: solve(y0=(q, jnp.zeros((1, 2)))).ys)(Q0[None])
    with pytest.raises(ValueError, match=r"must return \(y, args\)"):
        jax.jit(lambda q: event(level, lambda t, y, a: y)())(Q0)


@pytest.mark.parametrize(
    ("system", "args", "said"),
    [
        (D.ConstrainedSystem(lambda t, q, v, a: jnp.nan * q, constraint), None, "`force(t, q, v, args)` is not finite at the start."),
        (D.ConstrainedSystem(lambda t, q, v, a: a * q, constraint), math.nan, "`force(t, q, v, args)` is not finite at the start; `args` holds NaN or infinity."),
    ],
)  # fmt: skip
def test_a_failure_says_what_is_not_finite(system, args, said):
    with pytest.raises(RuntimeError, match=re.escape(said)):
        solve(system, args=args)


def test_what_is_no_mistake_is_taken():
    """A list of numbers for a force, an integer for t1, Baumgarte where there are no constraints."""
    sol = solve(D.ConstrainedSystem(lambda t, q, v, a: [0.0, -9.81], constraint), t1=np.int64(1))
    np.testing.assert_allclose(sol.final[0], solve().final[0], atol=1e-12)
    sol = solve(DECAY, TSIT5, jnp.ones(2), formulation=D.Baumgarte(1.0, 1.0))
    np.testing.assert_allclose(sol.final, np.exp(-1) * np.ones(2), atol=1e-7)


def test_what_diffrax_takes_is_taken():
    """Empty places in a state, the names that a condition is given, steps at times that are given."""
    decay = D.ImplicitDAE(lambda t, y, yd, args: {"x": yd["x"] + y["x"], "none": None})
    start = {"x": jnp.ones(1), "none": None}
    for solver in (TSIT5, RADAU):
        assert solve(decay, solver, start).final["none"] is None
        np.testing.assert_allclose(solve(decay, solver, start).final["x"], np.exp(-1), atol=1e-7)
    mapped = D.ConstrainedSystem(
        lambda t, q, v, args: {"x": jnp.array([0.0, -9.81]), "none": None},
        lambda t, q, args: constraint(t, q["x"], args),
    )
    sol = solve(mapped, y0=({"x": Q0, "none": None}, {"x": V0, "none": None}))
    np.testing.assert_allclose(sol.final[0]["x"], solve().final[0], atol=1e-12)
    half = lambda t, y, args, *, terms, solver, t0, t1, dt0, saveat, stepsize_controller, max_steps: t - (t0 + t1) / 2
    np.testing.assert_allclose(solve(event=diffrax.Event(half, optimistix.Newton(1e-8, 1e-8))).ts[-1], 0.5, atol=1e-6)
    times = diffrax.StepTo(jnp.linspace(0.0, 1.0, 101))
    for solver in (TSIT5, RADAU, D.BDF()):
        sol = solve(DECAY, solver, jnp.ones(2), stepsize_controller=times)
        assert sol.stats["num_steps"] == 100
        np.testing.assert_allclose(sol.final, np.exp(-1), rtol=2e-3)


@pytest.mark.parametrize("solver", [RADAU, D.Radau(), D.BDF(), TSIT5], ids=lambda s: type(s).__name__)
def test_the_smallest_step_is_that_of_the_controller(solver):
    """Else `dtmin` would be of no effect."""
    smallest = diffrax.PIDController(1e-8, 1e-8, dtmin=0.2)
    assert solve(DECAY, solver, jnp.ones(2), stepsize_controller=smallest).stats["num_steps"] < 8
    with pytest.raises(RuntimeError):
        solve(DECAY, solver, jnp.ones(2), stepsize_controller=dataclasses.replace(smallest, force_dtmin=False))


@pytest.mark.parametrize("t0", [2e8, -1e9])
@pytest.mark.parametrize("solver", [RADAU, D.Radau(), D.BDF()], ids=lambda s: type(s).__name__)
def test_time_may_begin_late(solver, t0):
    """The first step is one that time resolves there."""
    sol = D.daesolve(DECAY, solver, t0, t0 + 1.0, None, jnp.ones(2))
    np.testing.assert_allclose(sol.final, np.exp(-1), rtol=1e-6)
