# pyright: strict
"""Every public name as a user would write it: pyright has nothing to say of this file, in strict mode. It is not run.

Arrays come from numpy and from arguments: strict mode takes no function of `jax.numpy`, whose types it knows in part only.
"""

import warnings
from typing import Any

import diffrax
import numpy as np
from jax import Array

import dae_jax
from dae_jax import compiler, mechanisms, plotting, reductions, scenes


State = tuple[Array, Array]


def force(t: Array, q: Array, v: Array, args: None) -> Array:
    return 0 * v + 9.81


def constraint(t: Array, q: Array, args: None) -> Array:
    return (q @ q - 1) / 2


def potential(q: Array, args: None) -> Array:
    return -9.81 * q[1]


def chart(z: Array) -> Array:
    return z / (z @ z)


def residual(t: Array, y: Array, yd: Array, args: float) -> Array:
    return yd + args * y


def f(t: Array, x: Array, z: Array, args: float) -> Array:
    return -args * x + z


def g(t: Array, x: Array, z: Array, args: float) -> Array:
    return x + z


def condition(t: Array, y: State, args: None, **kwargs: object) -> Array:
    return y[0][1]


def bounced(t: Array, y: State, args: None) -> tuple[State, None]:
    return (y[0], -y[1]), args


pendulum = dae_jax.ConstrainedSystem(force, constraint, mass=np.ones(2), potential=potential)
circuit = dae_jax.SemiExplicitDAE(f, g)
decay = dae_jax.ImplicitDAE(residual)
start = (np.array([1.0, 0.0]), np.zeros(2))


def solved() -> dae_jax.DAESolution:
    sol = dae_jax.daesolve(
        pendulum,
        dae_jax.OrthogonalProjection(dae_jax.DOP853()),
        t0=0.0,
        t1=np.float64(10.0),
        dt0=None,
        y0=start,
        saveat=diffrax.SaveAt(ts=[0.0, 5.0, 10.0]),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        event=dae_jax.Reset(condition, bounced, max_resets=3),
    )
    if sol.result != dae_jax.RESULTS.successful:
        raise RuntimeError(str(sol.result))
    if sol.stats["doubts"]:
        warnings.warn("doubtful", dae_jax.AccuracyWarning, stacklevel=2)
    return sol


def methods() -> list[diffrax.AbstractSolver[Any]]:
    keeping: list[dae_jax.AbstractManifoldSolver] = [
        dae_jax.OrthogonalProjection(diffrax.Tsit5()),
        dae_jax.TangentSpace(diffrax.Dopri8()),
        dae_jax.SymmetricProjection(dae_jax.Trapezoid()),
        dae_jax.SymmetricProjection(dae_jax.Midpoint()),
        dae_jax.SymmetricProjection(dae_jax.Gauss4()),
        dae_jax.RATTLE(),
    ]
    of_residuals: list[dae_jax.AbstractResidualSolver] = [
        dae_jax.RadauIIA5(),
        dae_jax.Radau(),
        dae_jax.RadauIIA9(),
        dae_jax.RadauIIA13(),
        dae_jax.BDF(linear_solver=dae_jax.GMRES(restart=20)),
    ]
    return [*keeping, *of_residuals]


def formulations() -> list[dae_jax.AbstractFormulation]:
    fields: list[dae_jax.AbstractFieldFormulation] = [
        dae_jax.Differentiation(),
        dae_jax.Baumgarte(alpha=20.0, beta=np.array(20.0)),
        dae_jax.StateSpace(chart),
        dae_jax.DummyDerivatives(),
    ]
    residuals: list[dae_jax.AbstractResidualFormulation] = [dae_jax.GGL(), dae_jax.Residual("index-2")]
    return [*fields, *residuals]


def looked_at(sol: dae_jax.DAESolution) -> tuple[Array, ...]:
    off: dae_jax.Drift = dae_jax.drift(pendulum, sol)
    other: dae_jax.EquationDrift = dae_jax.drift(decay, sol)
    at_a_point = dae_jax.multipliers(pendulum, 0.0, *start)
    return off.position, off.velocity, *other.levels, dae_jax.energy(pendulum, sol), at_a_point


def analysed() -> dae_jax.Structure:
    structure = dae_jax.analyse(circuit, 0.0, (np.ones(1), np.ones(1)), 2.0)
    print(structure.index, structure.degrees_of_freedom, structure.hidden_constraints())
    return structure


def explained() -> str:
    plan: dae_jax.Plan = dae_jax.explain(pendulum, diffrax.Tsit5(), 0.0, start)
    if isinstance(plan, dae_jax.MechanicalPlan):
        return plan.mass
    if isinstance(plan, dae_jax.StructuralPlan):
        return str(plan.differentiated)
    if isinstance(plan, dae_jax.ResidualPlan):
        return str(plan.indices)
    return plan.method


def consistent() -> State:
    return dae_jax.consistent_state(pendulum, 0.0, start, fixed=(np.array([True, False]), np.zeros(2, bool)))


def swept() -> Array:
    def drift_of(p: dict[str, Array]) -> Array:
        sol = dae_jax.daesolve(
            pendulum, diffrax.Tsit5(), 0.0, 1.0, 0.01, start, formulation=dae_jax.Baumgarte(p["alpha"], p["beta"])
        )
        return reductions.largest_drift(pendulum, sol)

    points: dae_jax.Grid = dae_jax.grid(alpha=np.logspace(-1, 4, 100), beta=[1.0, 10.0])
    return dae_jax.sweep(drift_of, points, chunk_size=128, progress=False)


def tuned() -> dae_jax.Tuned:
    loss: dae_jax.BaumgarteLoss = dae_jax.baumgarte_loss(pendulum, start, 5.0, dt0=0.01)
    # Its types are to come.
    return dae_jax.tune(  # pyright: ignore[reportUnknownMemberType]
        loss, {"alpha": 1.0, "beta": 1.0}, steps=200, starts=4
    )


def identified() -> dae_jax.Identified:
    def model(p: dict[str, Array]) -> Array:
        return p["size"] * np.ones(5)

    # Its types are to come.
    found = dae_jax.identify(model, {"size": 1.0}, np.ones(5), 0.1)  # pyright: ignore[reportUnknownMemberType]
    if found.doubts or found.condition > 30:
        print(found.names, found.correlation, found.deviation)
    return found


def with_settings() -> None:
    with dae_jax.configure(threads=2):
        solved()


def as_one_kernel() -> Array:
    return compiler.jit(potential)(start[0], None)


def of_a_scene() -> float:
    scene = scenes.pendulum()
    times = np.linspace(0, 1, 11)
    sol = dae_jax.daesolve(scene.system, dae_jax.RATTLE(), 0.0, 1.0, 0.01, scene.y0)
    plotting.drift({"RATTLE": (times, dae_jax.drift(scene.system, sol).position)}).savefig("drift.png")
    return scene.error(times, sol.ys)


def points(t: Array, q: Array) -> Array:
    return q[None]


def moving(sol: dae_jax.DAESolution) -> str:
    drawing = scenes.Drawing(points, {"mass": 0}, down=True)
    film: plotting.Animation = plotting.animate(drawing, sol, system=pendulum, speed=0.5, title="pendulum")
    film.save("pendulum.gif", dpi=72)
    sol.animate(drawing, system=pendulum).save("pendulum.html")
    return film.html()


def of_a_mechanism() -> tuple[Array, ...]:
    rod = mechanisms.Body("rod", mass=1.0, inertia=0.1, at=(0.5, 0.0))
    hinge = mechanisms.revolute(mechanisms.ground, rod, at=(0, 0), name="hinge")
    drive = mechanisms.motor(hinge, torque=1.0, name="motor")
    mechanism = mechanisms.Mechanism([rod], [hinge], [mechanisms.gravity((0.0, -9.81)), drive])
    y0 = mechanism.assemble(at={"hinge": 0.3})
    sol = dae_jax.daesolve(mechanism.system(), dae_jax.RATTLE(), 0.0, 1.0, 0.01, y0)
    force, moment = mechanism.reaction(sol, "hinge", axes="body")
    return y0[0]["rod"], mechanism.coordinate(sol, "hinge"), mechanism.effort(sol, "motor"), force, moment


def old_name() -> dae_jax.Reset:
    return dae_jax.Jump(condition, bounced)


version: str = dae_jax.__version__
