"""A cell in SI units: robot, drive train, buses, axes, payloads,
filters and the destination of the gains.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import pi
from pathlib import Path
from typing import Annotated, Protocol

from pydantic import Field

from daq.config.cell_closures import ClosedChain, robot_with
from daq.config.controller import Controller
from daq.config.policy import (
    DEFAULT_APPLY_POLICY,
    DEFAULT_TARGET_SIGMA_PERCENT,
    ApplyPolicy,
    HistoryPlace,
    Permission,
)
from daq.config.recalibration import Recalibration
from daq.config.workspace import Clearance
from daq.config.yaml_file import FileName, Name
from drivers.canopen.interfaces import BusInterface, interface_of
from drivers.profiles.profile import DriveProfile, Identity
from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.model.bodies import Payload
from ident.model.model import DriveTrain, Model
from ident.model.robot import JointKind, Robot


@dataclass(frozen=True, slots=True)
class JointUnit:
    """Unit in which people read a joint. Inside, everything is in SI."""

    name: str  #: unit of positions; speeds are per second
    si: float  #: one unit, in rad or m
    si_name: str  #: rad or m
    force: str  #: Nm or N; a drive gain is that per unit of the current reference

    def spell(self, value: float) -> str:
        """Format a position (or, with "/s" appended, a speed) given in SI: `12.5 deg`."""
        return f"{value / self.si:.5g} {self.name}"


DEGREE = JointUnit("deg", pi / 180.0, "rad", "Nm")
MILLIMETRE = JointUnit("mm", 1e-3, "m", "N")


def joint_unit(kind: JointKind) -> JointUnit:
    """Return the unit of a kind of joint."""
    return MILLIMETRE if kind is JointKind.PRISMATIC else DEGREE


class PacingMode(Enum):
    """When the next SYNC is sent."""

    LOCKSTEP = "lockstep"
    TIMED = "timed"


@dataclass(frozen=True, slots=True, kw_only=True)
class UnnamedBus:
    """A bus, in the terms of python-can; host and port are those of a socketcand hub."""

    interface: Name  #: of python-can: socketcan, socketcand, virtual, or another
    channel: FileName  #: of the interface, as can0
    bitrate_bit_s: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000  #: of the bus [bit/s]
    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"  #: of a socketcand hub
    port: Annotated[int, Field(ge=1, le=65535)] = 29536  #: of a socketcand hub

    @property
    def kind(self) -> BusInterface:
        """What its interface can do."""
        return interface_of(self.interface)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bus(UnnamedBus):
    """A bus with its name; the only bus of a cell is named after its channel."""

    name: FileName  #: by which axes name their bus


RECORDER = "recorder"
KERNEL = "kernel"
"""SYNC producers other than an axis: the recording program,
or this machine's kernel (SocketCAN's BCM).

On one SocketCAN bus that can do it, the kernel sends SYNC for the recording program too.
"""


@dataclass(frozen=True, slots=True)
class Sync:
    """Sampling period [µs], its pacing, and the producer of SYNC:
    RECORDER, KERNEL or the name of an axis.
    """

    period_us: Annotated[int, Field(ge=250, le=1_000_000)]  #: time between two samples [µs]
    #: lockstep: the next SYNC follows the last answer; timed: by the clock
    pacing: PacingMode = PacingMode.TIMED
    #: recorder, kernel (SocketCAN's broadcast manager), or the name of an axis
    producer: Name = RECORDER


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a joint, in SI: rad, or m for a prismatic joint."""

    position: tuple[float, float]  #: lower and upper end [rad or m]
    velocity: float  #: largest speed [rad/s or m/s]
    acceleration: float  #: largest acceleration [rad/s² or m/s²]


@dataclass(frozen=True, slots=True)
class CellAxis:
    """One motor with its amplifier, and the joint of the same number."""

    name: str
    #: of the amplifier, as the next four; None in a cell that only imports recordings
    node_id: int | None
    drive: str | None
    profile: DriveProfile | None
    identity: Identity | None
    bus: str | None
    #: encoder counts of a motor revolution; None where the import defines its own
    counts_per_revolution: int | None
    unit: JointUnit  #: unit of the joint's positions for people
    #: position in the URDF's frame when R⁻¹ q_motor is zero [rad; m of a prismatic joint]
    zero_offset_rad: float
    nameplate_gain: float  #: drive gain of the data sheet, g = N·Gt·Kt [gain_unit], signed
    #: Nm (N of a prismatic joint) at the joint per unit of the current-loop reference
    gain_unit: str
    limits: Limits


@dataclass(frozen=True, slots=True)
class WeighedPayload:
    """A body that can be mounted."""

    name: str  #: the body
    mounting: str  #: the one way in which it is mounted
    mass_kg: float  #: as weighed [kg]
    mass_tolerance_kg: float  #: its tolerance [kg]
    #: Further inertial parameters, from its drawing, by their names in
    #: ident.model.bodies.LINK_PARAMETERS.
    known: dict[str, float]

    @property
    def payload(self) -> Payload:
        """The payload with its mass alone, as in a log and by default in a fit (paper, case 4)."""
        return Payload(self.name, self.mounting, {"m": self.mass_kg})

    @property
    def drawn(self) -> Payload:
        """The payload with all parameters of its drawing."""
        return Payload(self.name, self.mounting, {**self.known, "m": self.mass_kg})


@dataclass(frozen=True, slots=True)
class DeclaredEffect:
    """An effect beyond rigid links and friction that the robot is known to have,
    such as a counterbalance.
    """

    name: str  #: family, as a calibration names it
    #: index among `Cell.place_names` of the axis, or joint without a motor, that it acts on
    axis: int
    #: Its settings by name, where they are known; a fit of the effect begins with them. Empty: the
    #: fit finds them.
    settings: dict[str, float]


class WiredAxis(Protocol):
    """An amplifier, as far as its bus is concerned."""

    @property
    def name(self) -> str:
        """Name of the axis."""

    @property
    def node_id(self) -> int | None:
        """Node id; None in a cell that only imports recordings."""

    @property
    def bus(self) -> str | None:
        """Name of its bus."""

    @property
    def identity(self) -> Identity | None:
        """Identity that the cell file expects; None where it expects none."""

    @property
    def profile(self) -> DriveProfile | None:
        """Its profile; None where it is not known."""


class Wired(Protocol):
    """What a bus is found with: a `Cell`, or the `Wiring` of a cell file that is wrong
    elsewhere.
    """

    @property
    def name(self) -> str:
        """Name of the cell."""

    @property
    def buses(self) -> tuple[Bus, ...]:
        """Its buses."""

    @property
    def axes(self) -> Sequence[WiredAxis]:
        """Its amplifiers."""


class MotionPolicy(Enum):
    """Permission of a scheduled job to move the axes; `record` needs --enable-motion each time."""

    ASK = "ask"  #: No job may; only a person
    #: A job may, where the interlock releases the robot: a fenced cell with its own safety chain.
    ALLOWED = "allowed"


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """A cell as declared, in SI units."""

    name: str
    urdf: str  #: text of the URDF, its held joints fixed
    gravity_m_s2: tuple[float, float, float]  #: in the base frame
    #: drive train R with q_motor = R q_joint (paper eq. 24), shape (n, n); rad/m, prismatic joints
    ratio: FloatArray
    #: buses of the amplifiers, usually one; empty in a cell that only imports recordings
    buses: tuple[Bus, ...]
    sync: Sync | None  #: sampling; None in such a cell
    axes: tuple[CellAxis, ...]  #: n axes
    payloads: tuple[WeighedPayload, ...]  #: bodies that can be mounted
    conditioning: Conditioning  #: the filters
    controller: Controller | None  #: destination of the gains, None without write-back
    clearance: Clearance | None  #: the room around the arm, None if it is not declared
    effects: tuple[DeclaredEffect, ...]  #: part of every fit, whatever a search finds besides them
    folder: Path | None  #: folder of the cell file; None for a cell from a log
    digest: str  #: sha256 of the cell file and all files it refers to, hex
    #: sha256 of the content that a recording or its fit depends on, hex: without comments, and
    #: without the later use of a calibration (`policy`, `history`, `recalibration`) and the end of
    #: a session (`target_sigma_percent`).
    recording_digest: str
    motion: MotionPolicy = MotionPolicy.ASK  #: permission of a scheduled job to move the axes
    #: Permission of a job to move axes that go on moving when it is killed.
    unguarded: Permission = Permission.REFUSED
    #: to move axes slowly back within their limits before a recording
    recovery_motion: Permission = Permission.REFUSED
    apply: ApplyPolicy = DEFAULT_APPLY_POLICY  #: bounds and permissions of the write-back
    friction_by_payload: bool = False  #: whether friction with a payload has parameters of its own
    #: σ of every gain at which a guided session ends [%]
    target_sigma_percent: float = DEFAULT_TARGET_SIGMA_PERCENT
    history: HistoryPlace | None = None  #: files of the history; None for a cell from a log
    #: the scheduled job; None without one, or for a cell from a log
    recalibration: Recalibration | None = None
    #: how the loops of a closed chain close; None of a serial robot
    chain: ClosedChain | None = None
    platform: str | None = None  #: link that carries the payload; that of the last joint when None

    @property
    def controller_path(self) -> Path | None:
        """The controller's file under the name in the cell file, None if it is unknown.

        Symbolic links in that name are not resolved: `daq.writeback.file_access` decides which of
        them may be followed.
        """
        if self.controller is None or self.controller.file is None or self.folder is None:
            return None
        place = Path(os.path.realpath(self.folder))
        parts = Path(self.controller.file).parts
        while parts and parts[0] == "..":  # exact, because the folder's own links are resolved
            place = place.parent
            parts = parts[1:]
        return place.joinpath(*parts)

    @property
    def wiring(self) -> tuple[tuple[Bus, tuple[CellAxis, ...]], ...]:
        """Each bus with its axes."""
        wiring = []
        for bus in self.buses:
            axes = [axis for axis in self.axes if axis.bus == bus.name]
            wiring.append((bus, tuple(axes)))
        return tuple(wiring)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names in the order of the axes."""
        return tuple(axis.name for axis in self.axes)

    @property
    def place_names(self) -> tuple[str, ...]:
        """Where an effect can act: the axes, a closed chain's joints without a motor,
        its pivots (`Robot.places`).
        """
        undriven = () if self.chain is None else self.chain.undriven_names
        return (*self.axis_names, *undriven)

    @property
    def place_units(self) -> tuple[JointUnit, ...]:
        """Unit of each of `place_names`."""
        axes = [axis.unit for axis in self.axes]
        if self.chain is None:
            return tuple(axes)
        passive = [joint_unit(joint.kind) for joint in self.chain.passive_joints]
        pivots = [joint_unit(JointKind.REVOLUTE)] * len(self.chain.pivots)
        return (*axes, *passive, *pivots)


def robot_of(cell: Cell) -> Robot:
    """Return the robot of a cell, the loops of a closed chain closed.

    Raises:
        ModelError: the URDF describes no robot.
    """
    return robot_with(cell.chain, cell.urdf, cell.gravity_m_s2, cell.platform)


def joint_names(cell: Cell) -> tuple[str, ...]:
    """Return the URDF's name of each axis's joint.

    Raises:
        ModelError: the URDF describes no robot.
    """
    return tuple(joint.name for joint in robot_of(cell).axes)


def model_of(cell: Cell) -> Model:
    """Build the declared model for `ident`: geometry of the URDF, gravity and drive train.

    Raises:
        ModelError: the URDF or the drive train describes no robot.
    """
    return Model(
        robot_of(cell), DriveTrain(cell.ratio), friction_by_payload=cell.friction_by_payload
    )
