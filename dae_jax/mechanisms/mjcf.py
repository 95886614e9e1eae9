"""Mechanisms from MJCF and URDF files, by MuJoCo's own reader (the extra `[mjcf]`)."""

import importlib
import os
import warnings
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from ..validate.states import brief
from . import couplings, joints, loads
from .bodies import Body, Ground, ground
from .configuration import Coordinate
from .interface import AbstractJoint
from .loads import AbstractLoad
from .mechanism import Mechanism


# MuJoCo's compiled model and its state; it has no types of its own that a checker without it could know.
Model: TypeAlias = Any

FREE, BALL, SLIDE, HINGE = range(4)
CONNECT, WELD, JOINT = range(3)
# Axes count as parallel or perpendicular, and points as one, up to this.
NEAR = 1e-6
# Fields of the model that are read, follow from others, or have no part in a motion without contacts, limits and actuators. What
# MuJoCo has besides, and has in later versions, is refused by its name where it is set.
KNOWN = {
    "jnt": "actfrclimited actfrcrange actgravcomp actuatorid axis bodyid dofadr group limited margin pos qposadr range solimp solref "
    "stiffness type user",
    "dof": "M0 Madr bodyid damping invweight0 jntid length parentid simplenum solimp solref treeid",
    "eq": "active0 data obj1id obj2id objtype solimp solref type",
    "body": "bvhadr bvhnum conaffinity contype dofadr dofnum geomadr geomnum inertia invweight0 ipos iquat jntadr jntnum margin "
    "mass mocapid parentid pos quat rootid sameframe simple subtreemass treeid user weldid",
}
OWNERS = {"jnt": "joint", "eq": "equality", "body": "body"}


def read_mjcf(source: str | os.PathLike[str]) -> Mechanism:
    """The mechanism of an MJCF or URDF file, in space; its reference configuration is the model's `qpos0`.

    Bodies that are welded to each other are one. Hinge, slide, ball and free joints, a hinge and a slide along one axis (`cylindrical`),
    two perpendicular hinges through one point (`universal`), springs and dampers of joints, equality constraints `connect`,
    `weld` and `joint`, and gravity are taken over; loops are closed exactly, where MuJoCo's are soft. Names are those of
    the file; what has none is "body 3", "joint 0" or "equality 1", and of two that have the same, a joint and an equality,
    the second is "equality pin".

    **Arguments**

    - `source`: the path of a file, or the text of one.

    Errors: `ImportError` without MuJoCo; `ValueError` that lists all that is not supported. Limits, contacts, actuators and
    keyframes are left out, with one warning that names them.
    """
    try:
        mujoco: Model = importlib.import_module("mujoco")
    except ImportError as missing:
        raise ImportError('`read_mjcf` reads files by MuJoCo: pip install "dae_jax[mjcf]".') from missing
    if not isinstance(source, str | os.PathLike):
        raise TypeError(f"`source` must be the path of a file or the text of one, but is {brief(source)}.")
    text = os.fspath(source)
    model = (mujoco.MjModel.from_xml_string if text.lstrip().startswith("<") else mujoco.MjModel.from_xml_path)(text)
    reader = _Reader(model, mujoco.MjData(model), mujoco)
    if reader.unsupported:
        raise ValueError("The file has what is not supported here:\n" + "\n".join(f"  {x}" for x in reader.unsupported))
    left_out = list(reader.left_out())
    if left_out:
        warnings.warn("Left out of the mechanism: " + "; ".join(left_out) + ".", stacklevel=2)
    return Mechanism(list(reader.bodies.values()), reader.joints, reader.loads)


class _Reader:
    """What is found in a model, part by part, and what in it is not supported."""

    def __init__(self, model: Model, data: Model, mujoco: Model) -> None:
        self.model, self.data, self.mujoco = model, data, mujoco
        self.unsupported: list[str] = []
        self.joints: list[AbstractJoint] = []
        self.loads: list[AbstractLoad | AbstractJoint] = []
        self.coordinates: dict[int, Coordinate] = {}
        self.names = self._unique_names()
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        self._refuse_other_physics()
        if not model.njnt:
            self.unsupported.append("a model in which nothing moves: it has no joints")
        welded = [int(i) for i in np.unique(model.body_weldid) if model.body_jntnum[i]]
        self.bodies = {i: body for i in welded if (body := self._body(i))}
        for i in self.bodies:
            self._joints_of(i)
        for k in range(0 if self._disabled("EQUALITY", "CONSTRAINT") else model.neq):
            self._equality(k)
        if not self._disabled("GRAVITY") and np.any(model.opt.gravity):
            self.loads.append(loads.gravity(model.opt.gravity))

    def _disabled(self, *flags: str) -> bool:
        """Whether one of these kinds of physics is switched off."""
        bits = [getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0) for flag in flags]
        return any(self.model.opt.disableflags & int(bit) for bit in bits)

    def _unique_names(self) -> dict[tuple[str, int], str]:
        """Of bodies, and of joints and equalities together; MuJoCo has names of their own for each."""
        found: dict[tuple[str, int], str] = {}
        for kinds, taken in ((("body",), {ground.name}), (("joint", "equality"), set())):
            counts = {"body": self.model.nbody, "joint": self.model.njnt, "equality": self.model.neq}
            known = [(kind, k) for kind in kinds for k in range(counts[kind])]
            # Names that the file gives come first.
            for kind, k in sorted(known, key=lambda part: not self._given(*part)):
                name = self._given(kind, k) or f"{kind} {k}"
                while name in taken:
                    name = f"{kind} {name}"
                taken.add(name)
                found[kind, k] = name
        return found

    def _given(self, kind: str, k: int) -> str:
        return self.mujoco.mj_id2name(self.model, getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), k) or ""

    def _name(self, kind: str, k: int) -> str:
        return self.names.get((kind, k)) or self._given(kind, k) or f"{kind} {k}"

    def _refuse_other_physics(self) -> None:
        model = self.model
        counts = {"tendons": model.ntendon, "flexible bodies": model.nflex, "mocap bodies": model.nmocap}
        for what, count in (counts | {"plugins": getattr(model, "nplugin", 0)}).items():
            if count:
                self.unsupported.append(f"{count} {what}")
        for kind, known in KNOWN.items():
            for field in sorted(x for x in dir(model) if x.startswith(f"{kind}_")):
                if field.removeprefix(f"{kind}_") not in known.split():
                    self._refuse_field(kind, field)
        if model.opt.density or model.opt.viscosity:
            self.unsupported.append("a fluid around the bodies (density, viscosity)")

    def _refuse_field(self, kind: str, field: str) -> None:
        """What is set of a field that is not known: 0 is nothing, and of whole numbers, which are ids, −1."""
        rows = np.asarray(getattr(self.model, field))
        if rows.ndim == 0 or (field == "dof_frictionloss" and self._disabled("FRICTIONLOSS", "CONSTRAINT")):
            return
        nothing = (0, -1) if np.issubdtype(rows.dtype, np.integer) else (0,)
        owners = np.flatnonzero((~np.isin(rows, nothing)).any(tuple(range(1, rows.ndim))))
        if kind == "dof":
            owners = np.unique(self.model.dof_jntid[owners])
        for k in owners:
            owner = OWNERS.get(kind, "joint")
            self.unsupported.append(f"{field.removeprefix(kind + '_')} of {owner} {self._name(owner, int(k))!r}")

    def _body(self, i: int) -> Body | None:
        """All that is welded to body i, about their common centre of mass, in axes that are the world's at `qpos0`."""
        model, data = self.model, self.data
        parts = np.flatnonzero(model.body_weldid == i)
        masses, places = model.body_mass[parts], data.xipos[parts]
        total = masses.sum()
        if not total > 0:
            self.unsupported.append(f"body {self._name('body', i)!r}, which moves and has no mass")
            return None
        centre = masses @ places / total
        inertia = np.zeros((3, 3))
        for mass, place, turn, moments in zip(
            masses, places, data.ximat[parts].reshape(-1, 3, 3), model.body_inertia[parts], strict=True
        ):
            arm = place - centre
            inertia += turn @ np.diag(moments) @ turn.T + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        return Body(self._name("body", i), total, inertia, at=centre)

    def _part(self, i: int) -> Body | Ground | None:
        """The body that body i of the file is a part of."""
        welded = int(self.model.body_weldid[i])
        return self.bodies.get(welded) if welded else ground

    def _joints_of(self, i: int) -> None:
        model, data = self.model, self.data
        parent, body = self._part(int(model.body_parentid[i])), self.bodies[i]
        ids = list(range(model.body_jntadr[i], model.body_jntadr[i] + model.body_jntnum[i]))
        if parent is None:
            return
        kinds = [int(model.jnt_type[j]) for j in ids]
        at, axes, name = data.xanchor[ids[0]], data.xaxis[ids], self._name("joint", ids[0])
        if kinds == [HINGE]:
            self._add(joints.revolute(parent, body, at, axis=axes[0], name=name), {ids[0]: "angle"})
        elif kinds == [SLIDE]:
            self._add(joints.prismatic(parent, body, at, axis=axes[0], name=name), {ids[0]: "displacement"})
        elif kinds == [BALL]:
            self._add(joints.spherical(parent, body, at, name=name), {})
        elif sorted(kinds) == [SLIDE, HINGE] and np.linalg.norm(axes[0] - axes[1]) < NEAR:
            hinge, slide = ids if kinds[0] == HINGE else ids[::-1]
            joint = joints.cylindrical(parent, body, data.xanchor[hinge], axis=axes[0], name=name)
            self._add(joint, {hinge: "angle", slide: "displacement"})
        elif kinds == [HINGE, HINGE] and abs(axes[0] @ axes[1]) < NEAR and self._meet(ids):
            self._add(joints.universal(parent, body, at, axes=(axes[0], axes[1]), name=name), {})
        elif kinds != [FREE]:
            listed = ", ".join(repr(self._name("joint", j)) for j in ids)
            self.unsupported.append(f"the joints {listed} of body {body.name!r} together")
            return
        for j in ids:
            self._forces_of(j)

    def _add(self, joint: AbstractJoint, kinds: dict[int, Any]) -> None:
        self.joints.append(joint)
        self.coordinates |= {j: joint.coordinates[kind] for j, kind in kinds.items()}

    def _meet(self, ids: list[int]) -> bool:
        return bool(np.linalg.norm(self.data.xanchor[ids[0]] - self.data.xanchor[ids[1]]) < NEAR)

    def _forces_of(self, j: int) -> None:
        """Springs and dampers of a joint."""
        model, name = self.model, self._name("joint", j)
        start = int(model.jnt_dofadr[j])
        dofs = slice(start, start + {FREE: 6, BALL: 3}.get(int(model.jnt_type[j]), 1))
        stiffness = 0.0 if self._disabled("SPRING", "PASSIVE") else float(model.jnt_stiffness[j])
        damping = 0.0 if self._disabled("DAMPER", "PASSIVE") else float(model.dof_damping[start])
        if j not in self.coordinates:
            if stiffness or (not self._disabled("DAMPER", "PASSIVE") and np.any(model.dof_damping[dofs])):
                self.unsupported.append(f"spring or damper of joint {name!r}, which is not along one coordinate")
            return
        if stiffness:
            k = int(model.jnt_qposadr[j])
            rest = model.qpos_spring[k] - model.qpos0[k]
            self._take(self.loads, loads.spring, self.coordinates[j], stiffness, rest, name=f"spring of {name}")
        if damping:
            self.loads.append(loads.damper(self.coordinates[j], damping, name=f"damper of {name}"))

    def _equality(self, k: int) -> None:
        model, data = self.model, self.data
        name, kind, numbers = self._name("equality", k), int(model.eq_type[k]), model.eq_data[k]
        if not model.eq_active0[k]:
            return
        one, two = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if kind == JOINT:
            self._joint_equality(name, one, two, numbers)
            return
        of_bodies = int(model.eq_objtype[k]) == self.mujoco.mjtObj.mjOBJ_BODY
        if kind not in (CONNECT, WELD) or not of_bodies:
            self.unsupported.append(
                f"equality {name!r}, which is no connect or weld of bodies and no equality of joints"
            )
            return
        a, b = self._part(one), self._part(two)
        if a is None or b is None:
            return
        if a is b:
            self.unsupported.append(f"equality {name!r}, which is between two parts of {a.name!r}")
            return
        turns, on_two = data.xmat.reshape(-1, 3, 3), numbers[3:6] if kind == CONNECT else numbers[:3]
        # Of a weld without a torque only the points are one.
        if kind == CONNECT or numbers[10] == 0:
            on_one = numbers[:3] if kind == CONNECT else numbers[3:6]
            points = [data.xpos[i] + turns[i] @ p for i, p in ((one, on_one), (two, on_two))]
            local = tuple(p - (x.at if isinstance(x, Body) else 0) for p, x in zip(points, (a, b), strict=True))
            self.joints.append(joints.spherical(a, b, anchors=(local[0], local[1]), name=name))
            return
        at, turn = data.xpos[two] + turns[two] @ on_two, np.zeros(9)
        place = turns[one].T @ (at - data.xpos[one])
        self.mujoco.mju_quat2Mat(turn, numbers[6:10])
        as_it_is = np.allclose(place, numbers[3:6], atol=NEAR) and np.allclose(
            turns[one].T @ turns[two], turn.reshape(3, 3), atol=NEAR
        )
        if not as_it_is:
            self.unsupported.append(f"weld {name!r}, whose relative pose is not that of `qpos0`")
            return
        self.joints.append(joints.fixed(a, b, at, name=name))

    def _joint_equality(self, name: str, one: int, two: int, numbers: Float[np.ndarray, " k"]) -> None:
        if one not in self.coordinates or (two >= 0 and two not in self.coordinates):
            self.unsupported.append(f"equality {name!r} of a joint that has not one coordinate")
        else:
            other = self.coordinates[two] if two >= 0 else None
            # MuJoCo reads the first alone where there is no second joint.
            powers = numbers[: 1 if other is None else 5]
            self._take(self.joints, couplings.coupling, self.coordinates[one], other, powers, name=name)

    def _take(self, parts: list[Any], make: Callable[..., Any], *arguments: object, **options: object) -> None:
        """Adds what is made, or why it cannot be made to what is not supported."""
        try:
            parts.append(make(*arguments, **options))
        except ValueError as refusal:
            self.unsupported.append(str(refusal))

    def left_out(self) -> Iterator[str]:
        """What is no part of a mechanism, by name."""
        model = self.model
        limited = [self._name("joint", int(j)) for j in np.flatnonzero(model.jnt_limited)]
        touching = np.logical_or(model.geom_contype, model.geom_conaffinity)
        touching[[*model.pair_geom1, *model.pair_geom2]] = True
        in_contact = [self._name("geom", int(k)) for k in np.flatnonzero(touching)]
        driven = [self._name("actuator", k) for k in range(model.nu)]
        idle = [self._name("equality", int(k)) for k in np.flatnonzero(~model.eq_active0.astype(bool))]
        # Where a solve is to start is said by `assemble`, not by a mechanism.
        poses = [self._name("key", k) for k in range(model.nkey)]
        for what, names in (
            ("limits of", limited * (not self._disabled("LIMIT", "CONSTRAINT"))),
            ("contacts of", in_contact * (not self._disabled("CONTACT", "CONSTRAINT"))),
            ("actuators", driven * (not self._disabled("ACTUATION"))),
            ("inactive equalities", idle),
            ("keyframes", poses),
        ):
            if names:
                yield f"{what} {', '.join(map(repr, names))}"
