"""The geometry of a robot: what the regressor needs of a URDF, and nothing of its inertias."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ident.errors import ModelError

FloatArray = NDArray[np.float64]

LARGEST_DISTANCE_M = 50.0
"""Between joints that follow each other: more than any gantry has."""


class JointKind(Enum):
    """One-degree-of-freedom joints."""

    REVOLUTE = "revolute"
    PRISMATIC = "prismatic"


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint and the link behind it.

    Attributes:
        name: as in the URDF.
        kind: revolute or prismatic.
        parent: index of the joint before it, -1 for the base.
        rotation, translation_m: placement of the joint frame in the parent's frame at position zero, (3, 3) and (3,).
        axis: unit vector of the motion in the joint frame, (3,).
    """

    name: str
    kind: JointKind
    parent: int
    rotation: FloatArray
    translation_m: FloatArray
    axis: FloatArray


@dataclass(frozen=True, slots=True)
class Robot:
    """A tree of n joints on a fixed base.

    Attributes:
        joints: in the order of the axes.
        gravity_m_s2: in the base frame, shape (3,); any mounting of the base is a direction of gravity.
    """

    joints: tuple[Joint, ...]
    gravity_m_s2: FloatArray

    @property
    def joint_count(self) -> int:
        """n."""
        return len(self.joints)


def robot_from_urdf(urdf: str, gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)) -> Robot:
    """Read the kinematic tree of a URDF.

    Args:
        urdf: text of the URDF; fixed joints are merged into their parents, inertias are not used.
        gravity_m_s2: gravity in the base frame.

    Raises:
        ModelError: the text is no URDF, has no moving joint, or a joint of more than one degree of freedom.
    """
    try:
        model = pin.buildModelFromXML(urdf)
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"the URDF cannot be read: {error}; is every parent and child named in it?") from error
    if model.njoints < 2:
        raise ModelError("the URDF has no moving joint; expected at least one revolute or prismatic joint")
    joints = []
    for index in range(1, model.njoints):
        joint = model.joints[index]
        kind = joint.shortname()
        if joint.nv != 1 or not any(word in kind for word in ("Revolute", "Prismatic", "JointModelR", "JointModelP")):
            raise ModelError(f"joint {model.names[index]!r} is a {kind}; expected revolute or prismatic joints")
        prismatic = "Prismatic" in kind or kind.startswith("JointModelP")
        motion = joint.createData()
        joint.calc(motion, pin.neutral(model)[joint.idx_q : joint.idx_q + joint.nq])
        screw = np.asarray(motion.S, dtype=np.float64).reshape(6)
        placement = model.jointPlacements[index]
        axis = screw[:3] if prismatic else screw[3:]
        _check_geometry(model.names[index], np.asarray(placement.translation), axis)
        joints.append(
            Joint(
                name=model.names[index],
                kind=JointKind.PRISMATIC if prismatic else JointKind.REVOLUTE,
                parent=model.parents[index] - 1,
                rotation=np.array(placement.rotation, dtype=np.float64),
                translation_m=np.array(placement.translation, dtype=np.float64),
                axis=axis,
            )
        )
    return Robot(tuple(joints), np.asarray(gravity_m_s2, dtype=np.float64))


def _check_geometry(name: str, translation_m: FloatArray, axis: FloatArray) -> None:
    if not np.isclose(float(np.linalg.norm(axis)), 1.0, atol=1e-6):
        raise ModelError(f"joint {name!r} has the axis {axis.tolist()}; expected a direction of length one")
    distance = float(np.max(np.abs(translation_m)))
    if not distance <= LARGEST_DISTANCE_M:
        raise ModelError(
            f"joint {name!r} lies {distance:.3g} m from the one before it; expected at most {LARGEST_DISTANCE_M:g} m: "
            "is the URDF in mm?"
        )
