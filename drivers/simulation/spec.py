"""Description of a simulated cell, its true values and its errors.

The identification never reads it.

The limits in the annotations are checked where a simulation file is read.

For a prismatic joint read N for Nm, m for rad and kg for kg m².
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Interval, MinLen
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.simulation.faults import FaultSpec

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Positive = Annotated[float, Gt(0)]
ToggleBit = Literal[8, 14, 15]
NotNegative = Annotated[float, Ge(0)]
Direction = Literal["x", "y", "z", "rx", "ry", "rz"]
DIRECTIONS: tuple[Direction, ...] = ("x", "y", "z", "rx", "ry", "rz")
U32 = Annotated[int, Interval(ge=0, le=0xFFFFFFFF)]


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body in the frame of the last joint."""

    mass_kg: Positive  #: its mass [kg]
    centre_m: tuple[float, float, float]  #: centre of mass [m], (x, y, z)
    #: About the centre of mass [kg m²], (Ixx, Ixy, Ixz, Iyy, Iyz, Izz).
    inertia_kg_m2: tuple[float, float, float, float, float, float]


class Dialect(Enum):
    """Vendor whose objects and units an amplifier uses for its current (see objects.py)."""

    CIA402 = "cia402"
    EPOS4 = "epos4"
    COPLEY = "copley"
    IPOS = "ipos"
    AX2000 = "ax2000"


@dataclass(frozen=True, slots=True)
class AxisSpec:
    """One motor, its amplifier, and the joint of the same number."""

    node_id: Annotated[int, Interval(ge=1, le=127)]  #: CANopen node id
    vendor_id: U32  #: 1018h:1
    product_code: U32  #: 1018h:2
    revision: U32  #: 1018h:3
    serial: U32  #: 1018h:4
    counts_per_revolution: Annotated[int, Gt(0)]  #: encoder counts a motor revolution
    #: object 6075h (written there in mA); the current reference 6074h is in per mille of it
    rated_current_a: Positive
    #: the amplifier's limit; the reference saturates there and statusword bit 11 is set
    peak_current_a: Positive
    #: the true joint drive gain g = N·Gt·Kt [Nm at the joint per A]; may be negative
    gain_nm_per_a: float
    motor_inertia_kg_m2: NotNegative  #: of the rotor, seen at the joint (Ia = N²·J)
    viscous_nm_s_rad: NotNegative  #: viscous friction on the joint side
    coulomb_nm: NotNegative  #: dry friction on the joint side
    #: viscous friction on the motor side, in joint units (divided by N, eq. 25)
    motor_viscous_nm_s_rad: NotNegative
    motor_coulomb_nm: NotNegative  #: dry friction on the motor side, in joint units (eq. 25)
    offset_nm: float  #: constant torque at the joint
    current_noise_a: NotNegative  #: standard deviation of the noise of the current reference [A]
    noise_correlation_s: NotNegative  #: correlation time of that noise (first-order); 0 is white
    dialect: Dialect = Dialect.CIA402  #: vendor objects that report its current
    #: bit of statusword 6041h that is inverted with every SYNC, or None
    toggle_bit: ToggleBit | None = None
    #: Gain entered in 2003h (:01 in mNm/A, :02 in Nm/A as REAL32); the loops do not use it.
    entered_gain_nm_per_a: float = 0.0
    #: Rated torque of the motor entered at commissioning, in 6076h; the drive's own torque 6077h is
    #: in thousandths.
    entered_torque_nm: NotNegative = 0.0
    #: Root mean square of a random torque on the motor, in percent of its rated torque |gain| ·
    #: rated current; inside the control loops, so that it moves the arm and returns, late, in the
    #: current.
    torque_disturbance_percent: Annotated[float, Interval(ge=0, le=10)] = 0.0
    #: Correlation time of that torque (first-order).
    disturbance_correlation_s: Annotated[float, Interval(ge=0.002, le=0.05)] = 0.01


@dataclass(frozen=True, slots=True)
class UndeclaredEffect:
    """Physical effect of the plant that no configuration declares."""

    name: str  #: key in `effects.EFFECTS`
    axis: int  #: index of the joint, from 0; of a closed chain that of the motor
    parameters: dict[str, float]  #: by name, with units in the names
    #: joint of the URDF in place of the axis, for the passive joints of a closed chain
    joint: str | None = None
    #: closure in place of both, for the friction of the pivot that it is
    closure: str | None = None


@dataclass(frozen=True, slots=True)
class Closure:
    """Two frames of a closed chain that coincide."""

    name: Annotated[str, MinLen(1)]  #: for messages
    first: str  #: link of the URDF
    second: str  #: link of the URDF
    #: closed ones, along and about the axes of the first frame
    directions: Annotated[tuple[Direction, ...], MinLen(1)]


@dataclass(frozen=True, slots=True)
class PassiveFriction:
    """Friction of a joint without a motor."""

    viscous_nm_s_rad: NotNegative = 0.0  #: viscous friction
    coulomb_nm: NotNegative = 0.0  #: dry friction


@dataclass(frozen=True, slots=True)
class CellSpec:
    """A whole simulated cell.

    The fields from `closures` on describe a closed chain, whose URDF is a tree of n joints, m of
    them with motors.
    """

    urdf: str  #: text of the URDF with the true inertial parameters of the links
    gravity_m_s2: tuple[float, float, float]  #: in the base frame, (x, y, z)
    #: drive train R, q_motor = R q_joint (eq. 24), shape (n, n); rad/m for a prismatic joint.
    ratio: FloatArray
    axes: tuple[AxisSpec, ...]  #: one for each motor
    #: Joint positions at power-on [rad or m], shape (n,); encoder counts are zero at joint position
    #: zero.
    start_rad: FloatArray
    payload: Body | None  #: mounted body, or None
    effects: tuple[UndeclaredEffect, ...]  #: effects beyond the declared model
    sync_period_us: int  #: time by which one SYNC advances the plant
    substeps: int  #: control and integration steps in one SYNC period
    seed: int  #: seed of the current noise and the torque disturbance
    faults: tuple[FaultSpec, ...] = ()  #: injected faults
    closures: tuple[Closure, ...] = ()  #: frames that coincide; none for a serial robot
    #: joint of each axis; the ratio, the start and the axes are theirs
    motors: tuple[str, ...] = ()
    platform: str | None = None  #: link that carries the payload, or None for the last joint
    #: rough position of every joint [rad or m]
    assembly_rad: Mapping[str, float] = field(default_factory=dict)
    #: by the names of the other joints
    passive: Mapping[str, PassiveFriction] = field(default_factory=dict)
    #: Body that the loops are tuned to carry, and to do without; None for loops that are tuned with
    #: what is mounted at power-on.
    tuned_with: Body | None = None


class SimulationError(DriverError):
    """Base of the errors of the simulated cell."""


class SpecInvalid(SimulationError):
    """The cell cannot be built from its description,
    or an undeclared effect of it does not exist.
    """


class FrictionUnsolved(SimulationError):
    """The dry-friction problem was not solved to its tolerance."""


class ClosureLost(SimulationError):
    """The closures of a closed chain were not met: it ran into a singular pose."""


class SdoAbort(Exception):
    """SDO access that the node refuses with an abort code of CiA 301:
    answered on the bus, never raised to a user.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:#010x}")
        self.code = code
