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
            f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent '
            f'link="{parent}"/><child link="{name}"/><axis xyz="{axis}"/><limit lower="-3" '
            f'upper="3" velocity="3" effort="99"/></joint><link name="{name}"><inertial><origin '
            f'xyz="{along} 0.01 -0.02"/><mass value="{mass}"/><inertia ixx="0.004" ixy="0.0003" '
            'ixz="-0.0002" iyy="0.006" iyz="0.0004" izz="0.005"/></inertial></link>'
        )
        return name

    def frame(self, name: str, parent: str, xyz: str) -> str:
        """Add a link without mass, fixed to another; its name."""
        self.parts.append(
            f'<joint name="to-{name}" type="fixed"><origin xyz="{xyz}"/><parent link="{parent}"/>'
            f'<child link="{name}"/></joint><link name="{name}"/>'
        )
        return name

    @property
    def text(self) -> str:
        return "".join([*self.parts, "</robot>"])


CRANK_M = 0.3
ROD_M = 0.4
BASE_M = 0.25


def _five_bar() -> Mechanism:
    urdf = _Urdf("five-bar")
    for side, at in (("left", -0.5 * BASE_M), ("right", 0.5 * BASE_M)):
        xyz = f"{at} 0 0"
        crank = urdf.joint(f"{side}-crank", "revolute", "base", xyz, "0 0 1")
        rod = urdf.joint(f"{side}-rod", "revolute", crank, f"{CRANK_M} 0 0", "0 0 1")
        urdf.frame(f"{side}-tip", rod, f"{ROD_M} 0 0")
    assembly = {"left-crank": 2.1, "left-rod": -1.28, "right-crank": 1.05, "right-rod": 1.28}
    link_pair = LinkPair("tip", "left-tip", "right-tip", ("x", "y"))
    closures = (link_pair,)
    gains = np.array([20.0, -15.0])
    gravity_m_s2 = (0.0, -9.81, 0.0)
    return Mechanism(
        name="five-bar",
        urdf=urdf.text,
        motors=("left-crank", "right-crank"),
        closures=closures,
        platform="left-rod",
        mobility=2,
        gains=gains,
        assembly_rad=assembly,
        gravity_m_s2=gravity_m_s2,
    )


LEG_M = 0.28
LEGS = ((-0.35, -0.1, -1.0), (-0.35, 0.1, 1.0), (0.35, -0.1, 1.0), (0.35, 0.1, -1.0))
"""Base (x, y) of each leg of the planar platform [m], and the side to which its elbow points."""
HALF_M = 0.1  #: Half the length of the platform: two legs hold each of its ends


def leg_angles(pose: FloatArray, leg: int) -> tuple[FloatArray, FloatArray]:
    """Both joint angles of a leg of the planar platform, each (k,), at poses (x, y, angle),
    shape (k, 3).
    """
    x, y, side = LEGS[leg]
    end = -HALF_M if leg < 2 else HALF_M
    pose_cosine = np.cos(pose[:, 2])
    dx = pose[:, 0] + end * pose_cosine - x
    pose_sine = np.sin(pose[:, 2])
    dy = pose[:, 1] + end * pose_sine - y
    apart = np.hypot(dx, dy)
    first = np.arctan2(dy, dx) + side * np.arccos(0.5 * apart / LEG_M)
    elbow = np.arctan2(dy - LEG_M * np.sin(first), dx - LEG_M * np.cos(first)) - first
    return np.unwrap(first), (elbow + np.pi) % (2.0 * np.pi) - np.pi


def _planar() -> Mechanism:
    urdf = _Urdf("planar")
    home = np.zeros((1, 3))
    assembly: dict[str, float] = {}
    for leg, (x, y, _) in enumerate(LEGS):
        xyz = f"{x} {y} 0"
        crank = urdf.joint(f"motor-{leg}", "revolute", "base", xyz, "0 0 1")
        rod = urdf.joint(f"elbow-{leg}", "revolute", crank, f"{LEG_M} 0 0", "0 0 1")
        first, elbow = (float(angle[0]) for angle in leg_angles(home, leg))
        assembly |= {crank: first, rod: elbow}
        if leg == 0:
            urdf.joint("platform", "revolute", rod, f"{LEG_M} 0 0", "0 0 1")
            assembly["platform"] = -first - elbow
        else:
            urdf.frame(f"tip-{leg}", rod, f"{LEG_M} 0 0")
            urdf.frame(f"corner-{leg}", "platform", f"{0.0 if leg == 1 else 2.0 * HALF_M} 0 0")
    closures = tuple(
        LinkPair(f"corner {n}", f"corner-{n}", f"tip-{n}", ("x", "y")) for n in (1, 2, 3)
    )
    motors = tuple(f"motor-{leg}" for leg in range(4))
    gains = np.array([2.0, -1.5, 1.8, 2.2])
    return Mechanism(
        name="planar",
        urdf=urdf.text,
        motors=motors,
        closures=closures,
        platform="platform",
        mobility=3,
        gains=gains,
        assembly_rad=assembly,
    )


SLIDE_M = 0.31
WIDTH_M = 0.08


def _three_legs() -> Mechanism:
    """A slide along each axis, and a parallelogram from it to a platform that only translates."""
    urdf = _Urdf("three-legs")
    turns = (
        "0 0 0",
        "1.5707963267948966 0 1.5707963267948966",
        "-1.5707963267948966 -1.5707963267948966 0",
    )
    for leg, rpy in enumerate(turns):
        shifted_identity = np.roll(np.eye(3), leg, axis=1)
        axes = shifted_identity[0]
        xyz = " ".join(map(str, -SLIDE_M * axes))
        slide = urdf.joint(
            f"slide-{leg}",
            "prismatic",
            "base",
            xyz,
            "1 0 0",
            rpy=rpy,
        )
        turn = urdf.joint(f"turn-{leg}", "revolute", slide, "0 0 0", "0 1 0")
        bar = urdf.joint(f"bar-{leg}", "revolute", turn, f"0 {0.5 * WIDTH_M} 0", "0 0 1")
        other = urdf.joint(f"other-bar-{leg}", "revolute", turn, f"0 {-0.5 * WIDTH_M} 0", "0 0 1")
        coupler = urdf.joint(f"coupler-{leg}", "revolute", bar, f"{SLIDE_M} 0 0", "0 0 1")
        urdf.frame(f"coupler-end-{leg}", coupler, f"0 {-WIDTH_M} 0")
        urdf.frame(f"bar-end-{leg}", other, f"{SLIDE_M} 0 0")
        hand = urdf.joint(f"hand-{leg}", "revolute", coupler, f"0 {-0.5 * WIDTH_M} 0", "0 1 0")
        urdf.frame(f"centre-{leg}", hand, "0 0 0")
    rigid = ("x", "y", "z", "rx", "ry", "rz")
    # The frames of the legs are turned against each other: a frame of leg 0 in the directions of
    # leg n.
    for leg, rpy in ((1, turns[1]), (2, turns[2])):
        urdf.parts.append(
            f'<joint name="seat-{leg}" type="fixed"><origin rpy="{rpy}"/><parent link="hand-0"/>'
            f'<child link="seat-{leg}"/></joint><link name="seat-{leg}"/>'
        )
    closures = [
        LinkPair(f"parallelogram {n}", f"coupler-end-{n}", f"bar-end-{n}", ("x", "y"))
        for n in range(3)
    ]
    closures += [LinkPair(f"platform {n}", f"seat-{n}", f"centre-{n}", rigid) for n in (1, 2)]
    motors = tuple(f"slide-{leg}" for leg in range(3))
    gravity_m_s2 = (-4.0, -5.0, -7.4)
    gains = np.array([150.0, -140.0, 160.0])
    return Mechanism(
        name="three-legs",
        urdf=urdf.text,
        motors=motors,
        closures=tuple(closures),
        platform="hand-0",
        mobility=3,
        gains=gains,
        gravity_m_s2=gravity_m_s2,
    )


FIVE_BAR = _five_bar()
PLANAR = _planar()
THREE_LEGS = _three_legs()
MECHANISMS = (FIVE_BAR, PLANAR, THREE_LEGS)
