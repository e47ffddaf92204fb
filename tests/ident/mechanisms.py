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


DOWNWARD = (0.0, 0.0, -9.81)
"""Gravity along −z [m/s²]."""


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
    gravity_m_s2: tuple[float, float, float] = DOWNWARD

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
        numbers = np.arange(len(self.motors))
        reductions = 10.0 + 5.0 * numbers
        drive_train = DriveTrain(np.diag(reductions))
        return Model(self.robot, drive_train)


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
        place_of_mass = self.count % 5
        along = 0.03 + 0.01 * place_of_mass
        origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
        inertial = f'<origin xyz="{along} 0.01 -0.02"/><mass value="{mass}"/>'
        self.parts.append(
            f'''
            <joint name="{name}" type="{kind}">
              {origin}
              <parent link="{parent}"/>
              <child link="{name}"/>
              <axis xyz="{axis}"/>
              <limit lower="-3" upper="3" velocity="3" effort="99"/>
            </joint>'''
        )
        self.parts.append(
            f'''
            <link name="{name}">
              <inertial>
                {inertial}
                <inertia ixx="0.004" ixy="0.0003" ixz="-0.0002"
                         iyy="0.006" iyz="0.0004" izz="0.005"/>
              </inertial>
            </link>'''
        )
        return name

    def hinge(self, name: str, parent: str, xyz: str) -> str:
        """Add a joint that turns about z, and the link behind it; its name."""
        return self.joint(name, "revolute", parent, xyz, "0 0 1")

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


def place(x_m: float, y_m: float = 0) -> str:
    """A place in the plane z = 0, as a URDF writes it."""
    return f"{x_m} {y_m} 0"


PLANE = ("x", "y")
"""Directions that a closure in a plane closes."""

CRANK_M = 0.3
ROD_M = 0.4
BASE_M = 0.25


def _five_bar() -> Mechanism:
    urdf = _Urdf("five-bar")
    half_m = 0.5 * BASE_M
    motor_m = {"left": -half_m, "right": half_m}
    crank_end = place(CRANK_M)
    rod_end = place(ROD_M)
    for side, x_m in motor_m.items():
        motor = place(x_m)
        crank = urdf.hinge(f"{side}-crank", "base", motor)
        rod = urdf.hinge(f"{side}-rod", crank, crank_end)
        urdf.frame(f"{side}-tip", rod, rod_end)
    tips = LinkPair("tip", "left-tip", "right-tip", PLANE)
    assembly_rad = {
        "left-crank": 2.1,
        "left-rod": -1.28,
        "right-crank": 1.05,
        "right-rod": 1.28,
    }
    gains = np.array([20.0, -15.0])
    gravity_m_s2 = (0.0, -9.81, 0.0)
    return Mechanism(
        name="five-bar",
        urdf=urdf.text,
        motors=("left-crank", "right-crank"),
        closures=(tips,),
        platform="left-rod",
        mobility=2,
        gains=gains,
        assembly_rad=assembly_rad,
        gravity_m_s2=gravity_m_s2,
    )


def pin_on_a_parallel_link() -> Mechanism:
    """A parallelogram, and a pin on the link that stays parallel to its base, which pushes two
    slides: the pin does not turn in them.
    """
    base_m = 0.5
    angle = 0.7
    pin_m = np.array([0.23, 0.11])
    urdf = _Urdf("pin-on-a-parallel-link")
    crank = urdf.hinge("crank", "base", place(0.0))
    link = urdf.hinge("link", crank, place(CRANK_M))
    follower = urdf.hinge("follower", "base", place(base_m))
    urdf.frame("link-end", link, place(base_m))
    urdf.frame("follower-end", follower, place(CRANK_M))
    urdf.frame("pin", link, place(pin_m[0], pin_m[1]))
    across = urdf.joint("across", "prismatic", "base", place(0.0), "1 0 0")
    urdf.joint("along", "prismatic", across, place(0.0), "0 1 0")
    at_pin_m = CRANK_M * np.array([np.cos(angle), np.sin(angle)]) + pin_m
    assembly_rad = {
        "crank": angle,
        "link": -angle,
        "follower": angle,
        "across": float(at_pin_m[0]),
        "along": float(at_pin_m[1]),
    }
    return Mechanism(
        name="pin-on-a-parallel-link",
        urdf=urdf.text,
        motors=("crank",),
        closures=(
            LinkPair("parallelogram", "link-end", "follower-end", PLANE),
            LinkPair("slot", "pin", "along", PLANE),
        ),
        platform="along",
        mobility=1,
        gains=np.array([20.0]),
        assembly_rad=assembly_rad,
    )


LEG_M = 0.28
LEFT_FRONT = (-0.35, -0.1, -1.0)
LEFT_BACK = (-0.35, 0.1, 1.0)
RIGHT_FRONT = (0.35, -0.1, 1.0)
RIGHT_BACK = (0.35, 0.1, -1.0)
LEGS = (LEFT_FRONT, LEFT_BACK, RIGHT_FRONT, RIGHT_BACK)
"""Base (x, y) of each leg of the planar platform [m], and the side to which its elbow points."""
HALF_M = 0.1  #: Half the length of the platform: two legs hold each of its ends


def leg_angles(pose: FloatArray, leg: int) -> tuple[FloatArray, FloatArray]:
    """Both joint angles of a leg of the planar platform, each (k,), at poses (x, y, angle),
    shape (k, 3).
    """
    base_x, base_y, side = LEGS[leg]
    x, y, angle = pose.T
    end = HALF_M
    if leg < 2:
        end = -HALF_M
    # From the base of the leg to its end at the platform.
    cosine = np.cos(angle)
    sine = np.sin(angle)
    end_x = x + end * cosine
    end_y = y + end * sine
    dx = end_x - base_x
    dy = end_y - base_y
    distance = np.hypot(dx, dy)
    half_share = 0.5 * distance / LEG_M
    bend = np.arccos(half_share)
    direction = np.arctan2(dy, dx)
    crank = direction + side * bend
    elbow_x = LEG_M * np.cos(crank)
    elbow_y = LEG_M * np.sin(crank)
    rod = np.arctan2(dy - elbow_y, dx - elbow_x)
    elbow = rod - crank
    return np.unwrap(crank), _within_half_turn(elbow)


def _within_half_turn(angle: FloatArray) -> FloatArray:
    turn = 2.0 * np.pi
    from_below = (angle + np.pi) % turn
    return from_below - np.pi


def _planar() -> Mechanism:
    urdf = _Urdf("planar")
    home = np.zeros((1, 3))
    assembly_rad: dict[str, float] = {}
    link_end = place(LEG_M)
    for leg, (x_m, y_m, _) in enumerate(LEGS):
        motor = place(x_m, y_m)
        crank = urdf.hinge(f"motor-{leg}", "base", motor)
        elbow = urdf.hinge(f"elbow-{leg}", crank, link_end)
        crank_angles, elbow_angles = leg_angles(home, leg)
        assembly_rad[crank] = float(crank_angles[0])
        assembly_rad[elbow] = float(elbow_angles[0])
        if leg == 0:
            urdf.hinge("platform", elbow, link_end)
            crank_rad = assembly_rad[crank]
            elbow_rad = assembly_rad[elbow]
            assembly_rad["platform"] = -crank_rad - elbow_rad
        else:
            urdf.frame(f"tip-{leg}", elbow, link_end)
    # Leg 0 carries the platform; leg 1 is at the same end of it, legs 2 and 3 at the other.
    other_end = place(2.0 * HALF_M)
    urdf.frame("corner-1", "platform")
    urdf.frame("corner-2", "platform", other_end)
    urdf.frame("corner-3", "platform", other_end)
    corner_1 = LinkPair("corner 1", "corner-1", "tip-1", PLANE)
    corner_2 = LinkPair("corner 2", "corner-2", "tip-2", PLANE)
    corner_3 = LinkPair("corner 3", "corner-3", "tip-3", PLANE)
    closures = (corner_1, corner_2, corner_3)
    motors = ("motor-0", "motor-1", "motor-2", "motor-3")
    gains = np.array([2.0, -1.5, 1.8, 2.2])
    return Mechanism(
        name="planar",
        urdf=urdf.text,
        motors=motors,
        closures=closures,
        platform="platform",
        mobility=3,
        gains=gains,
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
    half_m = 0.5 * WIDTH_M
    bar_end = place(SLIDE_M)
    one_side = place(0, half_m)
    other_side = place(0, -half_m)
    across = place(0, -WIDTH_M)
    for leg, rpy in enumerate(directions):
        start = ["0.0", "0.0", "0.0"]
        start[leg] = str(-SLIDE_M)
        xyz = " ".join(start)
        slide = urdf.joint(f"slide-{leg}", "prismatic", "base", xyz, "1 0 0", rpy)
        turn = urdf.joint(f"turn-{leg}", "revolute", slide, "0 0 0", "0 1 0")
        bar = urdf.hinge(f"bar-{leg}", turn, one_side)
        other = urdf.hinge(f"other-bar-{leg}", turn, other_side)
        coupler = urdf.hinge(f"coupler-{leg}", bar, bar_end)
        urdf.frame(f"coupler-end-{leg}", coupler, across)
        urdf.frame(f"bar-end-{leg}", other, bar_end)
        hand = urdf.joint(f"hand-{leg}", "revolute", coupler, other_side, "0 1 0")
        urdf.frame(f"centre-{leg}", hand, "0 0 0")
    # The frames of the legs are turned against each other: a frame of leg 0 in the directions of
    # leg n.
    _, second, third = directions
    urdf.frame("seat-1", "hand-0", rpy=second)
    urdf.frame("seat-2", "hand-0", rpy=third)
    rigid = ("x", "y", "z", "rx", "ry", "rz")
    parallelogram_0 = LinkPair("parallelogram 0", "coupler-end-0", "bar-end-0", PLANE)
    parallelogram_1 = LinkPair("parallelogram 1", "coupler-end-1", "bar-end-1", PLANE)
    parallelogram_2 = LinkPair("parallelogram 2", "coupler-end-2", "bar-end-2", PLANE)
    platform_1 = LinkPair("platform 1", "seat-1", "centre-1", rigid)
    platform_2 = LinkPair("platform 2", "seat-2", "centre-2", rigid)
    parallelograms = (parallelogram_0, parallelogram_1, parallelogram_2)
    closures = (*parallelograms, platform_1, platform_2)
    motors = ("slide-0", "slide-1", "slide-2")
    gains = np.array([150.0, -140.0, 160.0])
    gravity_m_s2 = (-4.0, -5.0, -7.4)
    return Mechanism(
        name="three-legs",
        urdf=urdf.text,
        motors=motors,
        closures=closures,
        platform="hand-0",
        mobility=3,
        gains=gains,
        gravity_m_s2=gravity_m_s2,
    )


FIVE_BAR = _five_bar()
PLANAR = _planar()
THREE_LEGS = _three_legs()
MECHANISMS = (FIVE_BAR, PLANAR, THREE_LEGS)
