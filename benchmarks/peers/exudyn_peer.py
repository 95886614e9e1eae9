"""Exudyn: minimal coordinates (ObjectKinematicTree), explicit Runge-Kutta, its own time loop in C++.

DOPRI5 adapts its step to the tolerance. RK67 has a fixed step, 0.1 rtol^(1/7), so that its rows span the same errors. Closed loops:
bodies in redundant coordinates and joints, its implicit integrators with steps of 0.1 rtol^(1/2).
"""

import importlib

import numpy as np

from . import missing, problems


name = "Exudyn"
methods = ("DOPRI5", "RK67")
loop_methods = ("TrapezoidalIndex2", "GeneralizedAlpha")
# Of the methods with fixed steps, of 0.1 rtol^(1/order).
ORDERS = {"RK67": 7, "TrapezoidalIndex2": 2, "GeneralizedAlpha": 2}


def available():
    return missing("exudyn")


def double_pendulum(rtol, t1=10.0, method="DOPRI5"):
    return chain(2, rtol, t1, method)


def pendulum(rtol, t1=10.0, method="DOPRI5"):
    return chain(1, rtol, t1, method)


def chain(n, rtol, t1=1.0, method="DOPRI5"):
    import exudyn

    system = exudyn.SystemContainer()
    mbs = system.AddSystem()
    _add_tree(mbs, n)
    mbs.Assemble()
    settings = _settings(rtol, t1, method)
    solver = getattr(exudyn.DynamicSolverType, method)

    def solve():
        if not mbs.SolveDynamic(settings, solverType=solver, showHints=False, showCausingItems=False):
            raise RuntimeError("exudyn's solver failed")

    solve()
    return problems.from_joints(mbs.systemData.GetODE2Coordinates(), mbs.systemData.GetODE2Coordinates_t()), solve


def _add_tree(mbs, n):
    import exudyn
    from exudyn.itemInterface import NodeGenericODE2, ObjectKinematicTree

    angles, rates = problems.joint_start(n)
    node = mbs.AddNode(
        NodeGenericODE2(
            referenceCoordinates=np.zeros(n),
            initialCoordinates=angles,
            initialCoordinates_t=rates,
            numberOfODE2Coordinates=n,
        )
    )
    eye, massless, offsets = exudyn.Matrix3DList(), exudyn.Matrix3DList(), exudyn.Vector3DList()
    ends = exudyn.Vector3DList()
    for i in range(n):
        eye.Append(np.eye(3))
        massless.Append(np.zeros((3, 3)))
        offsets.Append([0.0, -1.0 if i else 0.0, 0.0])
        ends.Append([0.0, -1.0, 0.0])
    mbs.AddObject(
        ObjectKinematicTree(
            nodeNumber=node,
            jointTypes=[exudyn.JointType.RevoluteZ] * n,
            linkParents=np.arange(n) - 1,
            jointTransformations=eye,
            jointOffsets=offsets,
            linkInertiasCOM=massless,
            linkCOMs=ends,
            linkMasses=np.ones(n),
            gravity=[0.0, -problems.GRAVITY, 0.0],
        )
    )


def _settings(rtol, t1, method):
    import exudyn

    settings = exudyn.SimulationSettings()
    settings.solutionSettings.writeSolutionToFile = False
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.endTime = t1
    if method in ORDERS:
        settings.timeIntegration.numberOfSteps = round(t1 / (0.1 * rtol ** (1 / ORDERS[method]))) + 1
    else:
        settings.timeIntegration.numberOfSteps = 1  # the largest step it may take is t1 / numberOfSteps
        settings.timeIntegration.automaticStepSize = True
        settings.timeIntegration.initialStepSize = 1e-3
        settings.timeIntegration.minimumStepSize = 1e-12
        settings.timeIntegration.relativeTolerance = rtol
        settings.timeIntegration.absoluteTolerance = rtol
    return settings


def loops(problem, rtol, method):
    import exudyn

    from benchmarks.loops import example

    scene = example(problem)
    settings = _settings(rtol, scene.t1, method)
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.linearSolverType = exudyn.LinearSolverType.EigenSparse
    container = exudyn.SystemContainer()
    system = container.AddSystem()
    bodies = _LOOPS[problem](system, scene)
    system.Assemble()

    def solve():
        kind = getattr(exudyn.DynamicSolverType, method)
        if not system.SolveDynamic(settings, solverType=kind, showHints=False, showCausingItems=False):
            raise RuntimeError("exudyn's solver failed")

    solve()
    current, place = exudyn.ConfigurationType.Current, exudyn.OutputVariableType.Position
    return np.stack([system.GetObjectOutputBody(body, place, [0, 0, 0], current) for body in bodies]), solve


def _five_bar(system, scene):
    import exudyn.itemInterface as items

    m = importlib.import_module("dae_jax.mechanisms.examples.five_bar")
    ground = system.AddObject(items.ObjectGround())
    bodies = []
    for body, place in zip(m.five_bar_linkage().bodies, scene.y0[0].values, strict=True):
        mass, inertia = float(body.mass), float(body.inertia)
        node = system.AddNode(items.NodeRigidBody2D(referenceCoordinates=list(place)))
        rigid = items.ObjectRigidBody2D(nodeNumber=node, physicsMass=mass, physicsInertia=inertia)
        bodies.append(system.AddObject(rigid))
        centre = system.AddMarker(items.MarkerBodyPosition(bodyNumber=bodies[-1]))
        system.AddLoad(items.LoadForceVector(markerNumber=centre, loadVector=[mass * g for g in (*m.GRAVITY, 0)]))
    at = lambda body, x: system.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[x, 0, 0]))
    left, first, second, right = bodies
    crank, coupler = m.CRANK / 2, m.COUPLER / 2
    for one, other in (
        (at(ground, 0), at(left, -crank)),
        (at(left, crank), at(first, -coupler)),
        (at(first, coupler), at(second, coupler)),
        (at(right, crank), at(second, -coupler)),
        (at(ground, m.BASE), at(right, -crank)),
    ):
        system.AddObject(items.ObjectJointRevolute2D(markerNumbers=[one, other]))
    turning = system.AddMarker(items.MarkerBodyRigid(bodyNumber=left))
    system.AddLoad(items.LoadTorqueVector(markerNumber=turning, loadVector=[0, 0, m.TORQUE]))
    return bodies


def _stewart(system, scene):
    from exudyn.utilities import RigidBodyInertia

    m = importlib.import_module("dae_jax.mechanisms.examples.stewart")
    ground = system.CreateGround()
    found = {}
    for body, place, velocity in zip(m.stewart_platform().bodies, *(x.values for x in scene.y0), strict=True):
        found[body.name] = system.CreateRigidBody(
            inertia=RigidBodyInertia(float(body.mass), np.asarray(body.inertia)), referencePosition=list(place[:3]),
            gravity=list(m.GRAVITY),
            initialVelocity=list(velocity[:3]),
            # Of a unit quaternion (1, 0, 0, 0).
            initialAngularVelocity=list(2 * velocity[4:]),
        )  # fmt: skip
    for k, (foot, head, span, side) in enumerate(zip(m.FEET, m.HEADS, m.SPANS, m.SIDES, strict=True)):
        along = span / np.linalg.norm(span)
        across = np.cross(side, along)
        cylinder, rod, platform = found[f"cylinder {k}"], found[f"rod {k}"], found["platform"]
        system.CreateGenericJoint(
            bodyNumbers=[ground, cylinder], position=list(foot), constrainedAxes=[1, 1, 1, 0, 0, 1], useGlobalFrame=True,
            rotationMatrixAxes=np.stack([side, across, np.cross(side, across)], 1),
        )  # fmt: skip
        place = list(foot + 0.75 * span)
        system.CreatePrismaticJoint(bodyNumbers=[cylinder, rod], position=place, axis=list(along), useGlobalFrame=True)
        system.CreateSphericalJoint(bodyNumbers=[rod, platform], position=list(head))
        system.CreateSpringDamper(
            bodyNumbers=[ground, platform], localPosition0=list(foot), localPosition1=list(head - m.CENTRE),
            stiffness=m.STIFFNESS, damping=0,
        )  # fmt: skip
    return list(found.values())


_LOOPS = {"five-bar": _five_bar, "stewart": _stewart}
