"""Schema of a cell file, key by key (configs/cells/demo.yaml shows all of it).

Sections whose fields mean the same in the program are its own classes (`Sync`, `ApplyPolicy`, ...).
The classes here differ: degrees and mm instead of SI, and optional keys of which the checks accept
only some combinations.
"""

from __future__ import annotations

from dataclasses import fields
from math import pi
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from daq.config.cell import DEGREE, MILLIMETRE, Bus, JointUnit, MotionPolicy, Sync, UnnamedBus
from daq.config.cell_closures import ChainModel, ClosureModel
from daq.config.controller import Controller
from daq.config.policy import (
    DEFAULT_APPLY_POLICY,
    DEFAULT_TARGET_SIGMA_PERCENT,
    ApplyPolicy,
    HistorySection,
    Permission,
)
from daq.config.recalibration import RecalibrationSection
from daq.config.workspace import ClearanceSection, WorkspaceSection
from daq.config.yaml_file import DocumentKind, FileName, Name, Positive, StrictModel, not_in_file
from drivers.profiles.profile import Identity
from ident.arrays import FloatArray
from ident.data.conditioning import FILTER_ORDER
from ident.plausible import LEAD_MM, SPEED, within

ONE_BUS = not_in_file("one bus")
SEVERAL_BUSES = not_in_file("several buses")


class RobotModel(ChainModel):
    """The arm."""

    #: file of the arm's geometry, relative to the cell file; its inertias are not used by a fit
    urdf: FileName
    #: gravity in the base frame of the URDF; it says how the robot is mounted
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)
    #: by the maker [kg]; a heavier payload is refused as mistyped
    rated_payload_kg: Annotated[float, Field(gt=0, le=1e5)] | None = None


class DriveTrainModel(StrictModel):
    """R, a row a motor."""

    #: turns of each motor per turn of each joint, q_motor = R q_joint; a row a motor, in the order
    #: of `axes`
    ratio: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1, max_length=32)]


def _how_many(value: object) -> str:
    if isinstance(value, list | tuple):
        return SEVERAL_BUSES
    return ONE_BUS


Buses = Annotated[
    Annotated[UnnamedBus, Tag(ONE_BUS)]
    | Annotated[tuple[Bus, ...], Tag(SEVERAL_BUSES), Field(min_length=1, max_length=8)],
    Discriminator(_how_many),
]
"""One bus, or a list of named buses."""


def buses_of(declared: UnnamedBus | tuple[Bus, ...]) -> tuple[Bus, ...]:
    """Return the declared buses, each with a name."""
    if isinstance(declared, tuple):
        return declared
    values = {key.name: getattr(declared, key.name) for key in fields(UnnamedBus)}
    return (Bus(name=declared.channel, **values),)


class LimitsModel(StrictModel):
    """Limits of a joint in degrees, or in mm for a prismatic joint."""

    #: least and largest position of a revolute joint [deg]
    position_deg: tuple[float, float] | None = None
    velocity_deg_s: Positive | None = None  #: largest speed of it [deg/s]
    acceleration_deg_s2: Positive | None = None  #: largest acceleration of it [deg/s²]
    #: least and largest position of a prismatic joint [mm]
    position_mm: tuple[float, float] | None = None
    velocity_mm_s: Positive | None = None  #: largest speed of it [mm/s]
    acceleration_mm_s2: Positive | None = None  #: largest acceleration of it [mm/s²]

    @model_validator(mode="after")
    def _check_unit(self) -> LimitsModel:
        degrees = (self.position_deg, self.velocity_deg_s, self.acceleration_deg_s2)
        millimetres = (self.position_mm, self.velocity_mm_s, self.acceleration_mm_s2)
        if sorted(part.count(None) for part in (degrees, millimetres)) != [0, 3]:
            raise ValueError(
                "position_deg, velocity_deg_s and acceleration_deg_s2, or for a prismatic joint "
                "position_mm, velocity_mm_s and acceleration_mm_s2"
            )
        return self

    @property
    def unit(self) -> JointUnit:
        """Unit of the numbers."""
        return DEGREE if self.position_mm is None else MILLIMETRE

    @property
    def position(self) -> tuple[float, float]:
        """Lower and upper end, in the unit."""
        # The validator guarantees one of the two.
        return self.position_mm or self.position_deg or (0.0, 0.0)

    @property
    def velocity(self) -> float:
        """Largest speed, in the unit a second."""
        return self.velocity_mm_s or self.velocity_deg_s or 0.0

    @property
    def acceleration(self) -> float:
        """Largest acceleration, in the unit a second squared."""
        return self.acceleration_mm_s2 or self.acceleration_deg_s2 or 0.0


_GAIN_KEYS = ("nameplate_gain_nm_per_a", "nameplate_gain_n_per_a", "nameplate_gain")


class AxisModel(StrictModel):
    """One motor and its joint."""

    name: Name  #: of the axis, in messages, plans and the calibration
    node_id: int | None = None  #: CANopen node of its drive
    bus: Name | None = None  #: name of its bus; of several, each axis names one
    drive: Name | None = None  #: drive profile: a shipped one, or a file relative to the cell file
    identity: Identity | None = None  #: of the drive, compared before anything moves
    #: of the motor's encoder
    counts_per_revolution: Annotated[int, Field(gt=0, le=2**31)] | None = None
    zero_offset_deg: float | None = None  #: added to the position of a revolute joint [deg]
    zero_offset_mm: float | None = None  #: added to the position of a prismatic joint [mm]
    #: travel of a prismatic joint per turn of screw or pinion [mm]; negative: left-handed
    lead_mm: float | None = None
    #: gain by the data sheet of a revolute joint [Nm at the joint per A]
    nameplate_gain_nm_per_a: float | None = None
    #: gain by the data sheet of a prismatic joint [N per A]
    nameplate_gain_n_per_a: float | None = None
    nameplate_gain: float | None = None  #: gain by the data sheet in `gain_unit`
    #: unit of `nameplate_gain`, where the current reference is not in A
    gain_unit: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    limits: LimitsModel  #: within which moves are planned

    @model_validator(mode="after")
    def _check_lead(self) -> AxisModel:
        if self.lead_mm is not None and not within(abs(self.lead_mm), LEAD_MM):
            raise ValueError(
                "a lead_mm that is not zero: the travel of one turn, negative for a left-handed "
                f"screw; {LEAD_MM[0]:g} to {LEAD_MM[1]:g} mm in size"
            )
        return self

    @property
    def zero_offsets(self) -> dict[JointUnit, float]:
        """Stated zero offsets, by their units."""
        offsets = {DEGREE: self.zero_offset_deg, MILLIMETRE: self.zero_offset_mm}
        return {unit: offset for unit, offset in offsets.items() if offset is not None}

    @property
    def nameplate_gains(self) -> dict[str, float]:
        """Stated gains by their keys; the schema requires one."""
        gains = {key: getattr(self, key) for key in _GAIN_KEYS}
        return {key: gain for key, gain in gains.items() if gain is not None}

    @model_validator(mode="after")
    def _check_gain(self) -> AxisModel:
        if len(self.nameplate_gains) != 1 or (self.nameplate_gain is None) != (
            self.gain_unit is None
        ):
            raise ValueError(
                "nameplate_gain_nm_per_a, nameplate_gain_n_per_a (prismatic), or nameplate_gain "
                "together with gain_unit"
            )
        return self


class KnownModel(StrictModel):
    """Single inertial parameters of a payload besides its mass,
    about the last joint's frame (paper eq. 5).
    """

    Ixx: float | None = None
    Ixy: float | None = None
    Ixz: float | None = None
    Iyy: float | None = None
    Iyz: float | None = None
    Izz: float | None = None
    mx: float | None = None
    my: float | None = None
    mz: float | None = None


class PayloadModel(StrictModel):
    """A weighed body, and the parameters of its drawing.

    The centre of mass is in the last joint's frame, with a `platform` in that of this link; the
    inertia xx, xy, xz, yy, yz, zz is about the centre of mass, in the directions of that frame, as
    a URDF has it (xy = −∫xy dm).
    """

    name: Name  #: of the body, in plans and logs
    mounting: Name  #: name of the way in which it is mounted
    mass_kg: float  #: as weighed [kg]
    #: tolerance of that mass [kg]; σ of weighed bodies has it
    mass_tolerance_kg: Annotated[float, Field(ge=0)] = 0.0
    centre_m: tuple[float, float, float] | None = None  #: centre of mass by a drawing [m]
    #: inertia by a drawing, about the centre of mass [kg m²]
    inertia_kg_m2: tuple[float, float, float, float, float, float] | None = None
    known: KnownModel | None = None  #: single parameters that are known, in place of a drawing

    @property
    def known_parameters(self) -> dict[str, float]:
        """Stated single parameters, by their names."""
        if self.known is None:
            return {}
        return self.known.model_dump(exclude_none=True)

    @model_validator(mode="after")
    def _check_form(self) -> PayloadModel:
        if self.inertia_kg_m2 is not None and self.centre_m is None:
            raise ValueError("centre_m with inertia_kg_m2: the inertia is about the centre of mass")
        if self.centre_m is not None and self.known is not None:
            raise ValueError(
                "centre_m and inertia_kg_m2, or single parameters under `known`, not both"
            )
        return self


class EffectModel(StrictModel):
    """An effect that the robot is known to have, and its settings where they are known."""

    name: Name  #: of the effect
    axis: Annotated[
        Name,
        Field(
            description="Name of the axis, of a closed chain's joint without a motor, or `pivot` "
            "and a closure's name."
        ),
    ]
    #: values that are known, by their names; the others are searched
    settings: dict[str, float] = Field(default_factory=dict)


#: Least and largest cut-off of a filter; below, its window is minutes long
CUTOFF_HZ = (0.01, 100_000.0)
_CutOff = Annotated[float, Field(ge=CUTOFF_HZ[0], le=CUTOFF_HZ[1])]


class ConditioningModel(StrictModel):
    """The filters."""

    position_cutoff_hz: _CutOff = 40.0  #: cut-off of the zero-phase low-pass of the positions [Hz]
    #: order of that filter
    position_order: Annotated[int, Field(ge=FILTER_ORDER[0], le=FILTER_ORDER[1])] = 4
    #: cut-off of the filter of all columns, after which rows are decimated [Hz]
    decimation_cutoff_hz: _CutOff = 20.0
    #: speed of each revolute joint below which it stands still, and its rows are left out [rad/s];
    #: derived from each run where empty
    standstill_rad_s: tuple[Annotated[float, Field(ge=0, le=1e3)] | None, ...] = ()
    #: the same of prismatic joints [mm/s]
    standstill_mm_s: tuple[Annotated[float, Field(ge=0, le=SPEED[1])] | None, ...] = ()
    #: share of a row's filter window that may be standstill
    standstill_share: Annotated[float, Field(gt=0, le=1)] = 0.1


class PolicyModel(StrictModel):
    """Actions that are permitted in this cell."""

    motion: Annotated[
        MotionPolicy,
        Field(
            description="allowed: the scheduled job `recalibrate` may move the axes where the "
            "interlock releases them. `record` needs --enable-motion all the same."
        ),
    ] = MotionPolicy.ASK
    unguarded: Annotated[
        Permission,
        Field(
            description="allowed: the scheduled job may move axes that do not stop by themselves "
            "when it is killed. `record` needs --unguarded all the same."
        ),
    ] = Permission.REFUSED
    recovery_motion: Annotated[
        Permission,
        Field(
            description="Before a recording, move axes slowly back that are a little "
            "beyond a limit."
        ),
    ] = Permission.REFUSED
    apply: ApplyPolicy = DEFAULT_APPLY_POLICY  #: bounds of a write


class CellModel(StrictModel):
    """A whole cell file."""

    reference: ClassVar[str] = "cell-file.md"
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.CELL

    name: Name  #: of the cell, in logs, calibration and audit log
    robot: RobotModel  #: the arm
    drive_train: DriveTrainModel  #: how motors turn the joints
    hold: Annotated[
        dict[str, float],
        Field(description="Positions of joints that are no axes [deg; m if prismatic]."),
    ] = Field(default_factory=dict)
    bus: Buses | None = None  #: one bus, or several with a name each
    sync: Sync | None = None  #: how samples are timed
    closures: Annotated[
        tuple[ClosureModel, ...],
        Field(description="Where the loops of a closed chain close; none of a serial robot."),
    ] = ()
    #: one for each motor
    axes: Annotated[tuple[AxisModel, ...], Field(min_length=1, max_length=32)]
    payloads: tuple[PayloadModel, ...] = ()  #: weighed bodies
    #: what the robot is known to have besides rigid links and friction
    effects: tuple[EffectModel, ...] = ()
    friction_by_payload: Annotated[
        bool,
        Field(
            description="Whether friction with a payload has parameters of its own, so that "
            "friction that changes between bare and loaded runs does not become gain."
        ),
    ] = False
    conditioning: ConditioningModel = ConditioningModel()  #: filters of the fit
    controller: Controller | None = None  #: where gains are written
    workspace: WorkspaceSection | None = None  #: room that the arm stays in
    clearance: ClearanceSection | None = None  #: distances that moves keep
    target_sigma_percent: Annotated[
        float,
        Field(
            description="σ of every gain at which `calibrate` ends its recording [%].",
            ge=0.05,
            le=10.0,
        ),
    ] = DEFAULT_TARGET_SIGMA_PERCENT
    policy: PolicyModel = PolicyModel()  #: what is allowed
    history: HistorySection = HistorySection()  #: audit log and history
    recalibration: RecalibrationSection | None = None  #: the scheduled job

    @property
    def axis_names(self) -> list[str]:
        """Names in the order of the axes."""
        return [axis.name for axis in self.axes]

    @property
    def buses(self) -> tuple[Bus, ...]:
        """All buses, with names; empty in a cell that only imports recordings."""
        return () if self.bus is None else buses_of(self.bus)

    def bus_of(self, axis: AxisModel) -> str | None:
        """Return the name of an axis's bus; the only bus of a cell need not be named."""
        if axis.bus:
            return axis.bus
        if len(self.buses) == 1:
            return self.buses[0].name
        return None

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drive profiles in use, each once."""
        return tuple(dict.fromkeys(axis.drive for axis in self.axes if axis.drive))


def ratio_of(model: CellModel) -> FloatArray:
    """Return R of q_motor = R q_joint (eq. 24) [rad/rad; rad/m if prismatic], shape (n, n).

    Where a prismatic axis has a `lead_mm`, its column is written in turns: one turn of screw or
    pinion moves the joint by the lead, so R = ratio · 2π / lead.

    Raises:
        ValueError: the rows are not n of n numbers.
    """
    per_turn = []
    for axis in model.axes:
        if axis.lead_mm is None:
            per_turn.append(1.0)
        else:
            per_turn.append(2.0 * pi / (1e-3 * axis.lead_mm))
    ratio = np.array(model.drive_train.ratio, dtype=np.float64)
    return np.asarray(ratio * np.array(per_turn), dtype=np.float64)


def gain_joints(ratio: FloatArray) -> tuple[int, ...]:
    """Return the index of the joint that the gain of each motor refers to:
    that of its reduction N.
    """
    # The rule of ident.model.model.DriveTrain.reduction.
    joints = []
    for motor, row in enumerate(ratio):
        has_reduction = row[motor] != 0.0
        joints.append(motor if has_reduction else int(np.argmax(np.abs(row))))
    return tuple(joints)
