"""Exudyn: minimal coordinates (ObjectKinematicTree), explicit Runge-Kutta, its own time loop in C++.

DOPRI5 adapts its step to the tolerance. RK67 has a fixed step, 0.1 rtol^(1/7), so that its rows span the same errors.
"""

import numpy as np

from . import missing, problems


name = "Exudyn"
methods = ("DOPRI5", "RK67")


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
    if method == "RK67":
        settings.timeIntegration.numberOfSteps = round(t1 / (0.1 * rtol ** (1 / 7))) + 1
    else:
        settings.timeIntegration.numberOfSteps = 1  # the largest step it may take is t1 / numberOfSteps
        settings.timeIntegration.automaticStepSize = True
        settings.timeIntegration.initialStepSize = 1e-3
        settings.timeIntegration.minimumStepSize = 1e-12
        settings.timeIntegration.relativeTolerance = rtol
        settings.timeIntegration.absoluteTolerance = rtol
    return settings
