"""A cell: robot, drive train, bus, axes, payloads, filters and the controller that gets the gains."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import Enum
from math import pi
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.config.clearance import Clearance
from daq.config.controller import Controller
from daq.config.policy import DEFAULT_APPLY_POLICY, ApplyPolicy, HistoryPlace
from daq.config.recalibration import Recalibration
from drivers.profiles.profile import DriveProfile, Identity
from ident.data.conditioning import Conditioning
from ident.model.bodies import Payload
from ident.model.model import DriveTrain, Model
from ident.model.robot import JointKind, robot_from_urdf

# In which unit people read a joint: degrees, or mm where it is prismatic. Inside, everything is in SI.


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


FloatArray = NDArray[np.float64]


class Pacing(Enum):
    """When the next SYNC is sent."""

    LOCKSTEP = "lockstep"
    TIMED = "timed"


@dataclass(frozen=True, slots=True)
class Bus:
    """How a bus is reached, as python-can names it; host and port are those of a socketcand hub.

    The name is what people call it; the only bus of a cell has that of its channel.
    """

    name: str
    interface: str
    channel: str
    bitrate_bit_s: int
    host: str
    port: int


RECORDER, KERNEL = "recorder", "kernel"
"""Producers of SYNC that are no axis: the recording program, or this machine's kernel (SocketCAN's BCM)."""


@dataclass(frozen=True, slots=True)
class Sync:
    """The sampling period [µs], what paces it, and who sends it: RECORDER, KERNEL or the name of an axis."""

    period_us: int
    pacing: Pacing
    producer: str = RECORDER


@dataclass(frozen=True, slots=True)
class Limits:
    """Of a joint, in SI: rad, or m where it is prismatic.

    Attributes:
        position: lower and upper end [rad or m].
        velocity: largest speed [rad/s or m/s].
        acceleration: largest acceleration [rad/s² or m/s²].
    """

    position: tuple[float, float]
    velocity: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class Axis:
    """One motor with its amplifier, and the joint of the same number.

    Attributes:
        name: of the axis.
        node_id, drive, profile, identity: of the amplifier; None in a cell that only imports recordings.
        bus: name of the one that its amplifier is on; None in such a cell.
        counts_per_revolution: encoder counts a motor revolution; None where the import chooses its own count.
        unit: in which people read the joint: degrees, or mm where it is prismatic.
        zero_offset_rad: joint position in the URDF's frame when R⁻¹ q_motor is zero [rad; m of a prismatic joint].
        nameplate_gain: a priori joint drive gain g = N·Gt·Kt [gain_unit], signed.
        gain_unit: Nm (N of a prismatic joint) at the joint per unit of the current-loop reference.
        limits: of the joint.
    """

    name: str
    node_id: int | None
    drive: str | None
    profile: DriveProfile | None
    identity: Identity | None
    bus: str | None
    counts_per_revolution: int | None
    unit: JointUnit
    zero_offset_rad: float
    nameplate_gain: float
    gain_unit: str
    limits: Limits


@dataclass(frozen=True, slots=True)
class WeighedPayload:
    """A body that can be mounted.

    Attributes:
        name, mounting: the body, and the one way in which it is mounted.
        mass_kg, mass_tolerance_kg: as weighed [kg].
        known: further inertial parameters, from its drawing, by their names in ident.link.LINK_PARAMETERS.
    """

    name: str
    mounting: str
    mass_kg: float
    mass_tolerance_kg: float
    known: dict[str, float]

    @property
    def payload(self) -> Payload:
        """As a log and, unless told otherwise, the identification take it: of its mass alone (paper, case 4)."""
        return Payload(self.name, self.mounting, {"m": self.mass_kg})

    @property
    def drawn(self) -> Payload:
        """With all that its drawing says."""
        return Payload(self.name, self.mounting, {**self.known, "m": self.mass_kg})


class MotionPolicy(Enum):
    """Whose leave a recording needs to move the axes."""

    ASK = "ask"
    """Somebody's, every time: --enable-motion."""
    ALLOWED = "allowed"
    """The cell's own: a fenced cell whose safety chain does not depend on this program, for scheduled recordings."""


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """Everything that is declared of a cell, in SI units.

    Attributes:
        name: of the cell.
        urdf: text of the URDF.
        gravity_m_s2: in the base frame.
        ratio: drive train R with q_motor = R q_joint (paper eq. 24), shape (n, n); rad/m for a prismatic joint.
        buses: on which the amplifiers are, nearly always one; none in a cell that only imports recordings.
        sync: None in such a cell.
        axes: n of them.
        payloads: bodies that can be mounted.
        conditioning: the filters.
        controller: None where nothing is written back.
        clearance: the room around the arm, None where nothing is said of it.
        motion: whose leave a recording needs.
        apply: what is let through to the controller, and who may let it through.
        history: where what became of its calibrations is kept; None for a cell that was read from a log.
        recalibration: what a scheduled job does; None where there is none, or the cell was read from a log.
        folder: of the cell file; None for a cell that was read from a log.
        digest: sha256 of the cell file and all files it refers to, hex.
        recording_digest: the same of what they say and a recording or its fit depends on: without comments, and without
            what becomes of a calibration later (`policy`, `history`, `recalibration`).
    """

    name: str
    urdf: str
    gravity_m_s2: tuple[float, float, float]
    ratio: FloatArray
    buses: tuple[Bus, ...]
    sync: Sync | None
    axes: tuple[Axis, ...]
    payloads: tuple[WeighedPayload, ...]
    conditioning: Conditioning
    controller: Controller | None
    clearance: Clearance | None
    folder: Path | None
    digest: str
    recording_digest: str
    motion: MotionPolicy = MotionPolicy.ASK
    apply: ApplyPolicy = DEFAULT_APPLY_POLICY
    history: HistoryPlace | None = None
    recalibration: Recalibration | None = None

    @property
    def controller_path(self) -> Path | None:
        """The controller's file as the cell file names it, where it is known.

        Symbolic links in that name are left alone: `daq.writeback.file_access` decides which of them may be followed.
        """
        if self.controller is None or self.controller.file is None or self.folder is None:
            return None
        place, parts = Path(os.path.realpath(self.folder)), Path(self.controller.file).parts
        while parts and parts[0] == "..":  # exact, because the folder's own links are resolved
            place, parts = place.parent, parts[1:]
        return place.joinpath(*parts)

    @property
    def wiring(self) -> tuple[tuple[Bus, tuple[Axis, ...]], ...]:
        """Each bus with the axes on it."""
        return tuple((bus, tuple(axis for axis in self.axes if axis.bus == bus.name)) for bus in self.buses)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """In the order of the axes."""
        return tuple(axis.name for axis in self.axes)


# A cell as ident takes it: its declared model.


def model_of(cell: Cell) -> Model:
    """Geometry of the URDF, gravity and drive train.

    Raises:
        ModelError: the URDF or the drive train describes no robot.
    """
    return Model(robot_from_urdf(cell.urdf, cell.gravity_m_s2), DriveTrain(cell.ratio))
