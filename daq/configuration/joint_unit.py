"""In which unit people read a joint: degrees, or mm where it is prismatic. Inside, everything is in SI."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from ident.robot import JointKind


@dataclass(frozen=True, slots=True)
class JointUnit:
    """Of the positions of a joint; its speeds are so much a second.

    Attributes:
        name: as people write it.
        si: one of it, in rad or m.
        si_name: rad or m.
        force: what acts along the joint, Nm or N; a drive gain is that per unit of the current reference.
    """

    name: str
    si: float
    si_name: str
    force: str

    def spell(self, value: float) -> str:
        """A position (a speed, when "/s" is added) in SI as people read it: `12.5 deg`."""
        return f"{value / self.si:.5g} {self.name}"


DEGREE = JointUnit("deg", pi / 180.0, "rad", "Nm")
MILLIMETRE = JointUnit("mm", 1e-3, "m", "N")


def joint_unit(kind: JointKind) -> JointUnit:
    """The unit of a kind of joint."""
    return MILLIMETRE if kind is JointKind.PRISMATIC else DEGREE
