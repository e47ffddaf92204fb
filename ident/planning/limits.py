"""Limits of the joints that a plan keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, as_array, require_size
from ident.errors import ModelError
from ident.model.robot import Joint, Robot

POSITION_MARGIN = 0.03  #: Share of a joint's range that targets keep from its limits


#: Share of a follower's travel by which it may go beyond its limits: the rounding of a URDF
ROUNDING = 1e-4


@dataclass(frozen=True, slots=True)
class FollowerBeyond:
    """A joint that follows an axis, and goes beyond its own limits where the axis keeps its."""

    axis: int  #: index of the axis that it follows
    joint: Joint  #: the follower
    allowed: tuple[float, float]  #: its least and largest position in the URDF [rad or m]
    reached: tuple[float, float]  #: those that it reaches [rad or m]
    #: positions of the axis at which it keeps its limits, the least and the largest [rad or m]
    axis_range: tuple[float, float]


def followers_beyond(
    robot: Robot, lower: FloatArray, upper: FloatArray
) -> tuple[FollowerBeyond, ...]:
    """Name the joints that follow an axis and go beyond their own limits.

    Args:
        robot: of m axes, whose followers are its couplings.
        lower, upper: positions between which the axes stay [rad or m], shape (m,).
    """
    found: list[FollowerBeyond] = []
    for coupling in robot.couplings:
        joint = robot.joints[coupling.follower]
        if joint.range is None or coupling.multiplier == 0.0:
            continue
        if coupling.leader not in robot.axis_joints:
            # A loop moves it: where it goes is not known by the limits of an axis.
            continue
        least, largest = joint.range
        axis = robot.axis_joints.index(coupling.leader)
        ends = (lower[axis], upper[axis])
        reached = [coupling.multiplier * end + coupling.offset for end in ends]
        rounding = ROUNDING * (largest - least)
        if min(reached) >= least - rounding and max(reached) <= largest + rounding:
            continue
        of_axis = [(end - coupling.offset) / coupling.multiplier for end in joint.range]
        beyond = FollowerBeyond(
            axis=axis,
            joint=joint,
            allowed=joint.range,
            reached=(float(min(reached)), float(max(reached))),
            axis_range=(min(of_axis), max(of_axis)),
        )
        found.append(beyond)
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class JointLimits:
    """Limits of n joints [rad; m of a prismatic joint], shape (n,) each.

    Raises:
        ModelError: a limit is no array of finite numbers.
    """

    lower: FloatArray  #: least positions
    upper: FloatArray  #: largest positions
    velocity: FloatArray  #: per second
    acceleration: FloatArray  #: per second squared

    if TYPE_CHECKING:  # whatever becomes an array

        def __init__(
            self, lower: ArrayLike, upper: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike
        ) -> None: ...

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "velocity", "acceleration"):
            object.__setattr__(self, name, as_array(f"limits.{name}", getattr(self, name)))

    def targets(self) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest targets of a plan, shape (n,) each,
        which keep a margin from the limits.
        """
        margin = POSITION_MARGIN * (self.upper - self.lower)
        return self.lower + margin, self.upper - margin

    def require_size(self, count: int) -> None:
        """Refuse limits that are not those of so many joints.

        Raises:
            ModelError: a limit has another shape, is no finite number or one that no robot has, or
                leaves no room.
        """
        lower = as_array("limits.lower", self.lower, (count,), "one per joint")
        upper = as_array("limits.upper", self.upper, (count,), "one per joint")
        remedy = "give what the data sheet of the robot states, in SI units"
        require_size("limits.lower", lower, ModelError, remedy)
        require_size("limits.upper", upper, ModelError, remedy)
        if not np.all(lower < upper):
            found = f"positions from {lower.tolist()} to {upper.tolist()}"
            raise ModelError(f"limits: found {found}; expected each `lower` below its `upper`")
        for name in ("velocity", "acceleration"):
            values = as_array(f"limits.{name}", getattr(self, name), (count,), "one per joint")
            if not np.all(values > 0.0):
                raise ModelError(
                    f"limits.{name}: found {values.tolist()}; expected numbers above zero"
                )
            require_size(f"limits.{name}", values, ModelError, remedy)
