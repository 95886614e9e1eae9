"""Drake: MultibodyPlant in joint coordinates, continuous time, RK5 with error control inside its Simulator (C++)."""

from . import missing, problems


name = "Drake"
methods = ("runge_kutta5",)


def available():
    return missing("pydrake.all")


def double_pendulum(rtol, t1=10.0, method="runge_kutta5"):
    return chain(2, rtol, t1, method)


def pendulum(rtol, t1=10.0, method="runge_kutta5"):
    return chain(1, rtol, t1, method)


def chain(n, rtol, t1=1.0, method="runge_kutta5"):
    from pydrake.all import ResetIntegratorFromFlags, Simulator

    plant = _plant(n)
    simulator = Simulator(plant)
    integrator = ResetIntegratorFromFlags(simulator, method, 0.1)
    integrator.set_target_accuracy(rtol)
    context = simulator.get_mutable_context()
    angles, rates = problems.joint_start(n)

    def solve():
        context.SetTime(0.0)
        plant.SetPositions(context, angles)
        plant.SetVelocities(context, rates)
        simulator.Initialize()
        simulator.AdvanceTo(t1)

    solve()
    return problems.from_joints(plant.GetPositions(context), plant.GetVelocities(context)), solve


def _plant(n):
    from pydrake.all import FixedOffsetFrame, MultibodyPlant, RevoluteJoint, RigidTransform, SpatialInertia, UnitInertia

    plant = MultibodyPlant(time_step=0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -problems.GRAVITY])
    parent = plant.world_body()
    end = [0.0, 0.0, -1.0]
    mass = SpatialInertia(1.0, end, UnitInertia.PointMass(end))
    for i in range(n):
        body = plant.AddRigidBody(f"link{i}", mass)
        hinge = RigidTransform([0.0, 0.0, -1.0 if i else 0.0])
        parent_frame = plant.AddFrame(FixedOffsetFrame(f"hinge{i}", parent.body_frame(), hinge))
        plant.AddJoint(RevoluteJoint(f"joint{i}", parent_frame, body.body_frame(), [0.0, -1.0, 0.0]))
        parent = body
    plant.Finalize()
    return plant
