"""Robots of our own for the tests of the science: no two of them alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

CONFIGS = Path(__file__).parents[2] / "configs"
GRAVITIES = ((0.0, 0.0, -9.81), (4.0, -3.0, 8.0))


@dataclass(frozen=True)
class Arm:
    """A URDF by name."""

    name: str
    urdf: str


def _chain(name: str, joints: tuple[tuple[str, str, str, str], ...]) -> Arm:
    text = [f'<robot name="{name}"><link name="base"/>']
    for index, (kind, xyz, rpy, axis) in enumerate(joints):
        parent = "base" if index == 0 else f"link{index - 1}"
        text.append(
            f'<joint name="q{index}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent '
            f'link="{parent}"/><child link="link{index}"/><axis xyz="{axis}"/><limit lower="-3" '
            'upper="3" velocity="3" effort="99"/></joint><link '
            f'name="link{index}"><inertial><origin xyz="0.0{index + 1} -0.02 0.1"/><mass '
            f'value="{4.0 - 0.4 * index}"/><inertia ixx="0.03" ixy="0.001" ixz="-0.002" iyy="0.04" '
            'iyz="0.003" izz="0.02"/></inertial></link>'
        )
    urdf = "".join([*text, "</robot>"])
    return Arm(name, urdf)


SEVEN_AXES = _chain(
    "seven",
    tuple(("revolute", "0 0.01 0.2", rpy, axis) for rpy, axis in zip(
        ("0 0 0", "1.57 0 0", "-1.57 0 0", "1.57 0 0.3", "-1.57 0 0", "1.57 0 0", "-1.2 0.1 0"),
        ("0 0 1", "0 0 1", "0 0 1", "0 1 0", "0 0 1", "0.6 0 0.8", "0 0 1"), strict=True)),
)  # fmt: skip
GANTRY = _chain(
    "gantry",
    (
        ("prismatic", "0 0 1", "0 0 0", "1 0 0"),
        ("prismatic", "0 0.1 0", "0 0.2 0", "0 1 0"),
        ("prismatic", "0 0 0.1", "0 0 0", "0 0 1"),
        ("revolute", "0 0 -0.3", "0 0 0", "0 0 1"),
        ("revolute", "0 0 -0.1", "1.57 0 0", "0 0 1"),
    ),
)
THREE_AXES = _chain(
    "three",
    (
        ("revolute", "0 0 0.2", "0 0 0", "0 0 1"),
        ("revolute", "0.05 0 0.2", "0 0 0", "0 1 0"),
        ("revolute", "0 0 0.35", "0 0 0", "0 1 0"),
    ),
)
"""Two links in a vertical plane on a turntable: all that a search needs, at a third of the time."""
POLAR = _chain(
    "polar",
    (
        ("revolute", "0 0 0.4", "0 0 0", "0 0 1"),
        ("revolute", "0 0 0.2", "0 0 0", "0 1 0"),
        ("prismatic", "0 0 0.4", "0 0 0", "0 0 1"),
        ("revolute", "0 0 0.3", "0 0 0", "0 1 0"),
    ),
)
"""A slide along the arm, between the joints that carry it and a wrist."""
TX40 = Arm("tx40", (CONFIGS / "robots" / "tx40.urdf").read_text())
ARMS = (TX40, SEVEN_AXES, GANTRY)
