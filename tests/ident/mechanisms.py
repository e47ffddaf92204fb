"""Closed chains of our own for the tests of the science:
five-bar, redundant planar platform, three parallel legs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.model.model import DriveTrain, Model
from ident.model.robot import Robot
from ident.model.urdf import LinkPair, robot_from_urdf

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A URDF with its closures, and where its motors may go.

    Attributes:
        urdf: text of the tree.
        motors: joint of each axis.
        closures: pairs of links.
        platform: link that carries the payload.
        mobility: degrees of freedom d.
        gains: of the motors [Nm/A or N/A].
        assembly_rad: of the joints that are not at zero.
    """

    name: str
    urdf: str
    motors: tuple[str, ...]
    closures: tuple[LinkPair, ...]
    platform: str
    mobility: int
    gains: FloatArray
    assembly_rad: Mapping[str, float] = field(default_factory=dict)
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)

    @property
    def robot(self) -> Robot:
        """With its loops closed."""
        return robot_from_urdf(
            self.urdf,
            self.gravity_m_s2,
            closures=self.closures,
            motors=self.motors,
            assembly_rad=self.assembly_rad,
            platform=self.platform,
        )

    @property
    def model(self) -> Model:
        """With a reduction of its own for each motor."""
        ratio = np.diag(10.0 + 5.0 * np.arange(len(self.motors)))
        return Model(self.robot, DriveTrain(ratio))


class _Urdf:
    """A URDF as it grows."""

    def __init__(self, name: str) -> None:
        self.parts = [f'<robot name="{name}"><link name="base"/>']
        self.count = 0

    def joint(
        self, name: str, kind: str, parent: str, xyz: str, axis: str, rpy: str = "0 0 0"
    ) -> str:
        """Add a joint and the link behind it, which has the joint's name and a mass unlike any
        other; its name.
        """
        self.count += 1
        mass = 0.4 + 0.17 * self.count
        along = 0.03 + 0.01 * (self.count % 5)
        self.parts.append(
            f'''
            <joint name="{name}" type="{kind}">
              <origin xyz="{xyz}" rpy="{rpy}"/>
              <parent link="{parent}"/>
              <child link="{name}"/>
              <axis xyz="{axis}"/>
              <limit lower="-3" upper="3" velocity="3" effort="99"/>
            </joint>
            <link name="{name}">
              <inertial>
                <origin xyz="{along} 0.01 -0.02"/>
                <mass value="{mass}"/>
                <inertia ixx="0.004" ixy="0.0003" ixz="-0.0002"
                         iyy="0.006" iyz="0.0004" izz="0.005"/>
              </inertial>
            </link>'''
        )
        return name

    def frame(self, name: str, parent: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> None:
        """Add a link without mass, fixed to another."""
        self.parts.append(
            f'''
            <joint name="to-{name}" type="fixed">
              <origin xyz="{xyz}" rpy="{rpy}"/>
              <parent link="{parent}"/>
              <child link="{name}"/>
            </joint>
            <link name="{name}"/>'''
        )

    @property
    def text(self) -> str:
        return "".join([*self.parts, "</robot>"])


CRANK_M = 0.3
ROD_M = 0.4
BASE_M = 0.25


def _five_bar() -> Mechanism:
    urdf = _Urdf("five-bar")
    for side, x_m in (("left", -0.5 * BASE_M), ("right", 0.5 * BASE_M)):
        crank = urdf.joint(f"{side}-crank", "revolute", "base", f"{x_m} 0 0", "0 0 1")
        rod = urdf.joint(f"{side}-rod", "revolute", crank, f"{CRANK_M} 0 0", "0 0 1")
        urdf.frame(f"{side}-tip", rod, f"{ROD_M} 0 0")
    tips = LinkPair("tip", "left-tip", "right-tip", ("x", "y"))
    assembly_rad = {"left-crank": 2.1, "left-rod": -1.28, "right-crank": 1.05, "right-rod": 1.28}
    return Mechanism(
        name="five-bar",
        urdf=urdf.text,
        motors=("left-crank", "right-crank"),
        closures=(tips,),
        platform="left-rod",
        mobility=2,
        gains=np.array([20.0, -15.0]),
        assembly_rad=assembly_rad,
        gravity_m_s2=(0.0, -9.81, 0.0),
    )


LEG_M = 0.28
LEGS = ((-0.35, -0.1, -1.0), (-0.35, 0.1, 1.0), (0.35, -0.1, 1.0), (0.35, 0.1, -1.0))
"""Base (x, y) of each leg of the planar platform [m], and the side to which its elbow points."""
HALF_M = 0.1  #: Half the length of the platform: two legs hold each of its ends


def leg_angles(pose: FloatArray, leg: int) -> tuple[FloatArray, FloatArray]:
    """Both joint angles of a leg of the planar platform, each (k,), at poses (x, y, angle),
    shape (k, 3).
    """
    base_x, base_y, side = LEGS[leg]
    x, y, angle = pose.T
    end = -HALF_M if leg < 2 else HALF_M
    # From the base of the leg to its end at the platform.
    dx = x + end * np.cos(angle) - base_x
    dy = y + end * np.sin(angle) - base_y
    distance = np.hypot(dx, dy)
    crank = np.arctan2(dy, dx) + side * np.arccos(0.5 * distance / LEG_M)
    rod = np.arctan2(dy - LEG_M * np.sin(crank), dx - LEG_M * np.cos(crank))
    elbow = rod - crank
    return np.unwrap(crank), _within_half_turn(elbow)


def _within_half_turn(angle: FloatArray) -> FloatArray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _planar() -> Mechanism:
    urdf = _Urdf("planar")
    home = np.zeros((1, 3))
    assembly_rad: dict[str, float] = {}
    for leg, (x_m, y_m, _) in enumerate(LEGS):
        crank = urdf.joint(f"motor-{leg}", "revolute", "base", f"{x_m} {y_m} 0", "0 0 1")
        elbow = urdf.joint(f"elbow-{leg}", "revolute", crank, f"{LEG_M} 0 0", "0 0 1")
        crank_angles, elbow_angles = leg_angles(home, leg)
        assembly_rad[crank] = float(crank_angles[0])
        assembly_rad[elbow] = float(elbow_angles[0])
        if leg == 0:
            urdf.joint("platform", "revolute", elbow, f"{LEG_M} 0 0", "0 0 1")
            assembly_rad["platform"] = -assembly_rad[crank] - assembly_rad[elbow]
        else:
            urdf.frame(f"tip-{leg}", elbow, f"{LEG_M} 0 0")
    # Leg 0 carries the platform; leg 1 is at the same end of it, legs 2 and 3 at the other.
    urdf.frame("corner-1", "platform")
    urdf.frame("corner-2", "platform", f"{2.0 * HALF_M} 0 0")
    urdf.frame("corner-3", "platform", f"{2.0 * HALF_M} 0 0")
    closures = tuple(
        LinkPair(f"corner {leg}", f"corner-{leg}", f"tip-{leg}", ("x", "y")) for leg in (1, 2, 3)
    )
    motors = tuple(f"motor-{leg}" for leg in range(4))
    return Mechanism(
        name="planar",
        urdf=urdf.text,
        motors=motors,
        closures=closures,
        platform="platform",
        mobility=3,
        gains=np.array([2.0, -1.5, 1.8, 2.2]),
        assembly_rad=assembly_rad,
    )


SLIDE_M = 0.31
WIDTH_M = 0.08


def _three_legs() -> Mechanism:
    """A slide along each axis, and a parallelogram from it to a platform that only translates."""
    urdf = _Urdf("three-legs")
    # These turn the x axis of leg n onto the x, y or z axis of the base.
    directions = (
        "0 0 0",
        "1.5707963267948966 0 1.5707963267948966",
        "-1.5707963267948966 -1.5707963267948966 0",
    )
    for leg, rpy in enumerate(directions):
        xyz = ["0.0", "0.0", "0.0"]
        xyz[leg] = str(-SLIDE_M)
        slide = urdf.joint(f"slide-{leg}", "prismatic", "base", " ".join(xyz), "1 0 0", rpy)
        turn = urdf.joint(f"turn-{leg}", "revolute", slide, "0 0 0", "0 1 0")
        bar = urdf.joint(f"bar-{leg}", "revolute", turn, f"0 {0.5 * WIDTH_M} 0", "0 0 1")
        other = urdf.joint(f"other-bar-{leg}", "revolute", turn, f"0 {-0.5 * WIDTH_M} 0", "0 0 1")
        coupler = urdf.joint(f"coupler-{leg}", "revolute", bar, f"{SLIDE_M} 0 0", "0 0 1")
        urdf.frame(f"coupler-end-{leg}", coupler, f"0 {-WIDTH_M} 0")
        urdf.frame(f"bar-end-{leg}", other, f"{SLIDE_M} 0 0")
        hand = urdf.joint(f"hand-{leg}", "revolute", coupler, f"0 {-0.5 * WIDTH_M} 0", "0 1 0")
        urdf.frame(f"centre-{leg}", hand, "0 0 0")
    # The frames of the legs are turned against each other: a frame of leg 0 in the directions of
    # leg n.
    urdf.frame("seat-1", "hand-0", rpy=directions[1])
    urdf.frame("seat-2", "hand-0", rpy=directions[2])
    plane = ("x", "y")
    rigid = ("x", "y", "z", "rx", "ry", "rz")
    closures = (
        LinkPair("parallelogram 0", "coupler-end-0", "bar-end-0", plane),
        LinkPair("parallelogram 1", "coupler-end-1", "bar-end-1", plane),
        LinkPair("parallelogram 2", "coupler-end-2", "bar-end-2", plane),
        LinkPair("platform 1", "seat-1", "centre-1", rigid),
        LinkPair("platform 2", "seat-2", "centre-2", rigid),
    )
    return Mechanism(
        name="three-legs",
        urdf=urdf.text,
        motors=("slide-0", "slide-1", "slide-2"),
        closures=closures,
        platform="hand-0",
        mobility=3,
        gains=np.array([150.0, -140.0, 160.0]),
        gravity_m_s2=(-4.0, -5.0, -7.4),
    )


FIVE_BAR = _five_bar()
PLANAR = _planar()
THREE_LEGS = _three_legs()
MECHANISMS = (FIVE_BAR, PLANAR, THREE_LEGS)
