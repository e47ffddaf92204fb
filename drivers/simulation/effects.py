"""Undeclared effects of a simulated plant: the physics that no configuration declares and `ident` has to discover.

To add one, write a class with an `axis`, its parameters in SI units and an `act(moment)`, and a line in `EFFECTS`.
"""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from drivers.simulation.spec import EffectUnknown, UndeclaredEffect

FloatArray = NDArray[np.float64]


@dataclass(slots=True)
class Moment:
    """State of the plant in one substep: what an effect reads and what it may change.

    There are n joints and motors, N coordinates and m directions of dry friction. The coordinates are the joints,
    then the motors behind a flexible drive. A prismatic joint has N for Nm and m for rad.
    """

    time_s: float  #: since power-on
    step_s: float  #: length of the substep
    position_rad: FloatArray  #: at its start, shape (N,); read only
    velocity_rad_s: FloatArray  #: at its start, shape (N,); read only
    motor_rad: FloatArray  #: rotor angles, shape (n,); read only
    current_a: FloatArray  #: in the motors, shape (n,); read only
    load_torque_nm: FloatArray  #: torque of the links on each joint in the step before, shape (n,); read only
    #: Of dry friction, shape (m,); the first n are the joints'. May be changed; must not become negative.
    bound_nm: FloatArray
    viscous_nm_s_rad: FloatArray  #: of viscous friction, shape (N,); may be changed
    torque_nm: FloatArray  #: other torques on each coordinate, shape (N,); may be changed
    motor_torque_nm: FloatArray  #: of each motor, in joint units, shape (n,); may be changed


@dataclass(frozen=True, slots=True)
class Stribeck:
    """Stribeck friction Fs + rise·exp(−|v|/speed): larger near standstill than sliding (Bo and Pavelescu 1982)."""

    axis: int
    rise_nm: float
    speed_rad_s: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        speed = abs(moment.velocity_rad_s[self.axis])
        moment.bound_nm[self.axis] += self.rise_nm * math.exp(-speed / self.speed_rad_s)


@dataclass(frozen=True, slots=True)
class LoadFriction:
    """Dry friction Fs + coefficient·|τ_L| of a loaded gear; τ_L is the torque of the links on the joint."""

    axis: int
    coefficient: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        moment.bound_nm[self.axis] += self.coefficient * abs(moment.load_torque_nm[self.axis])


@dataclass(frozen=True, slots=True)
class NonlinearViscous:
    """Friction c·|v|^η against the motion, v in rad/s, beside the linear one: lubricants, seals, churning.

    It joins the bound of dry friction, which can only dissipate: as an explicit torque |v|^(1/3) would chatter at zero.
    """

    axis: int
    torque_at_1_rad_s_nm: float
    exponent: float

    def act(self, moment: Moment) -> None:
        """Raise the bound of dry friction."""
        moment.bound_nm[self.axis] += self.torque_at_1_rad_s_nm * abs(moment.velocity_rad_s[self.axis]) ** self.exponent


@dataclass(frozen=True, slots=True)
class AsymmetricViscous:
    """Viscous friction Fv + c forwards and Fv − c backwards: a torque −c·|v| beside −Fv·v."""

    axis: int
    coefficient_nm_s_rad: float

    def act(self, moment: Moment) -> None:
        """Change the joint's viscous coefficient by the sign of its speed; it never becomes negative."""
        change = self.coefficient_nm_s_rad if moment.velocity_rad_s[self.axis] >= 0.0 else -self.coefficient_nm_s_rad
        moment.viscous_nm_s_rad[self.axis] = max(0.0, moment.viscous_nm_s_rad[self.axis] + change)


@dataclass(frozen=True, slots=True)
class PositionFriction:
    """Dry friction Fs + amplitude·cos(q − phase), never below zero: an eccentric gear, a bearing out of line."""

    axis: int
    amplitude_nm: float
    phase_rad: float

    def act(self, moment: Moment) -> None:
        """Change the bound of dry friction."""
        change = self.amplitude_nm * math.cos(moment.position_rad[self.axis] - self.phase_rad)
        moment.bound_nm[self.axis] = max(0.0, moment.bound_nm[self.axis] + change)


@dataclass(slots=True)
class Presliding:
    """Dahl's friction torque·z, dz/dq = (1 − z·sign(v)) / distance (Dahl 1968), in place of as much dry friction.

    Contacts bend before they slide, so friction builds up over a distance after each reversal.
    """

    axis: int  #: joint
    torque_nm: float  #: friction after a long distance in one direction
    distance_rad: float  #: over which 63 % of a change of z happens
    bristle: float = 0.0  #: z, the state

    def act(self, moment: Moment) -> None:
        """Exchange dry friction for Dahl's; z is advanced by the exact solution over the distance of the step."""
        velocity = moment.velocity_rad_s[self.axis]
        if velocity != 0.0:
            end = math.copysign(1.0, velocity)
            self.bristle = end + (self.bristle - end) * math.exp(-abs(velocity) * moment.step_s / self.distance_rad)
        moment.bound_nm[self.axis] = max(0.0, moment.bound_nm[self.axis] - self.torque_nm)
        moment.torque_nm[self.axis] -= self.torque_nm * self.bristle


@dataclass(frozen=True, slots=True)
class WarmUp:
    """Friction of the joint times 1 + cold_fraction·exp(−t/time_constant), t since power-on: grease that warms up."""

    axis: int
    cold_fraction: float
    time_constant_s: float

    def act(self, moment: Moment) -> None:
        """Scale the joint's friction."""
        factor = 1.0 + self.cold_fraction * math.exp(-moment.time_s / self.time_constant_s)
        moment.bound_nm[self.axis] *= factor
        moment.viscous_nm_s_rad[self.axis] *= factor


@dataclass(slots=True)
class Coupling:
    """Friction on the sum of the speeds of two joints, dry and viscous (one shaft runs through the other, eq. 25)."""

    axis: int  #: one joint
    other_axis: float  #: number of the other joint, from 1 as a person counts
    coulomb_nm: float  #: of the shared friction
    viscous_nm_s_rad: float  #: of the shared friction
    direction: int = field(default=-1, init=False)  #: index of its direction of dry friction, filled in by the plant

    @property
    def other(self) -> int:
        """Index of the other joint, from 0."""
        return int(self.other_axis) - 1

    def act(self, moment: Moment) -> None:
        """Set the bound of the shared friction and add its viscous part."""
        moment.bound_nm[self.direction] += self.coulomb_nm
        shared = self.viscous_nm_s_rad * (moment.velocity_rad_s[self.axis] + moment.velocity_rad_s[self.other])
        moment.torque_nm[self.axis] -= shared
        moment.torque_nm[self.other] -= shared


@dataclass(frozen=True, slots=True)
class Spring:
    """Torque −k·(q − rest) on the joint: a gravity compensator, a cable or hose."""

    axis: int
    stiffness_nm_per_rad: float
    rest_rad: float

    def act(self, moment: Moment) -> None:
        """Add the torque."""
        moment.torque_nm[self.axis] -= self.stiffness_nm_per_rad * (moment.position_rad[self.axis] - self.rest_rad)


@dataclass(frozen=True, slots=True)
class Cogging:
    """Cogging torque −amplitude·sin(order·θ + phase) of the motor, θ its rotor angle; the amplitude in joint units."""

    axis: int
    amplitude_nm: float
    order: float
    phase_rad: float = 0.0

    def act(self, moment: Moment) -> None:
        """Subtract the ripple from the motor's torque."""
        ripple = math.sin(self.order * moment.motor_rad[self.axis] + self.phase_rad)
        moment.motor_torque_nm[self.axis] -= self.amplitude_nm * ripple


@dataclass(frozen=True, slots=True)
class Saturation:
    """Magnetic saturation, torque g·i / (1 + (i / half_current)²): half the torque constant is left at half_current.

    To first order the current that a torque needs is v = v₀ + v₀³/half_current², v₀ = τ/g.
    """

    axis: int
    half_current_a: float

    def act(self, moment: Moment) -> None:
        """Lower the motor's torque."""
        moment.motor_torque_nm[self.axis] /= 1.0 + (moment.current_a[self.axis] / self.half_current_a) ** 2


@dataclass(slots=True)
class Lag:
    """First-order lag of the reported current reference; the current itself is not delayed."""

    axis: int  #: motor
    time_constant_s: float  #: of the lag
    value_a: float = 0.0  #: of the filter, the state

    def report(self, reported_a: NDArray[np.float64], step_s: float) -> None:
        """Replace this axis' reference by the filtered one; called once a substep (exact for a held input)."""
        self.value_a += (float(reported_a[self.axis]) - self.value_a) * -np.expm1(-step_s / self.time_constant_s)
        reported_a[self.axis] = self.value_a


@dataclass(slots=True)
class Elasticity:
    """A spring and a damper in the drive of one motor: the motor becomes a coordinate of its own (two masses)."""

    axis: int  #: motor
    stiffness_nm_per_rad: float  #: in joint units
    damping_nm_s_per_rad: float  #: in joint units
    #: The motor's coordinate and its row r of the drive train, filled in by the plant.
    coordinate: int = field(default=-1, init=False)
    row: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), init=False)  #: see `coordinate`

    def act(self, moment: Moment) -> None:
        """Add the drive's torque to the links and subtract it from the motor."""
        _transmit(self, moment, 0.0)


@dataclass(slots=True)
class Backlash:
    """Elasticity with a gap: the drive transmits only where the teeth touch, and there it only pushes."""

    axis: int
    gap_rad: float  #: free play between the flanks, in joint units; the others as in Elasticity
    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float
    coordinate: int = field(default=-1, init=False)
    row: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0), init=False)

    def act(self, moment: Moment) -> None:
        """Add the drive's torque to the links and subtract it from the motor."""
        _transmit(self, moment, self.gap_rad / 2.0)


def _transmit(drive: Elasticity | Backlash, moment: Moment, half_gap_rad: float) -> None:
    n = len(drive.row)
    twist = float(moment.position_rad[drive.coordinate] - drive.row @ moment.position_rad[:n])
    rate = float(moment.velocity_rad_s[drive.coordinate] - drive.row @ moment.velocity_rad_s[:n])
    deflection = twist - min(max(twist, -half_gap_rad), half_gap_rad)
    if half_gap_rad > 0.0 and deflection == 0.0:
        return
    torque = drive.stiffness_nm_per_rad * deflection + drive.damping_nm_s_per_rad * rate
    if half_gap_rad > 0.0:
        # A flank pushes and never pulls, however fast it is left.
        torque = max(torque, 0.0) if deflection > 0.0 else min(torque, 0.0)
    moment.torque_nm[drive.coordinate] -= torque
    moment.torque_nm[:n] += drive.row * torque


Effect = (
    Stribeck
    | LoadFriction
    | NonlinearViscous
    | AsymmetricViscous
    | Spring
    | PositionFriction
    | Cogging
    | Saturation
    | Lag
    | WarmUp
    | Presliding
    | Backlash
    | Elasticity
    | Coupling
)

EFFECTS: tuple[tuple[str, type[Effect]], ...] = (
    ("stribeck", Stribeck),
    ("load-friction", LoadFriction),
    ("nonlinear-viscous", NonlinearViscous),
    ("asymmetric-viscous", AsymmetricViscous),
    ("spring", Spring),
    ("position-friction", PositionFriction),
    ("cogging", Cogging),
    ("saturation", Saturation),
    ("lag", Lag),
    ("warm-up", WarmUp),
    ("presliding", Presliding),
    ("backlash", Backlash),
    ("elasticity", Elasticity),
    ("coupling", Coupling),
)
"""Name in a simulation file, and the physics."""

STATE_FIELDS = frozenset({"axis", "bristle", "value_a"})
"""Fields of an effect that are its place or its state, not its parameters."""


def build_effect(effect: UndeclaredEffect, axes: int) -> Effect:
    """Build the physics of an undeclared effect.

    Args:
        effect: name, joint and parameters.
        axes: number of joints of the cell.

    Raises:
        EffectUnknown: the name, a parameter or the axis does not exist, or a parameter is missing.
    """
    kinds = dict(EFFECTS)
    kind = kinds.get(effect.name)
    if kind is None:
        raise EffectUnknown(f"undeclared effect {effect.name!r} does not exist; there are {', '.join(kinds)}")
    if not 0 <= effect.axis < axes:
        raise EffectUnknown(f"{effect.name}: axis {effect.axis + 1} does not exist; the cell has axes 1 to {axes}")
    known = {f.name: f.default is MISSING for f in fields(kind) if f.init and f.name not in STATE_FIELDS}
    unknown = sorted(set(effect.parameters) - set(known))
    missing = [name for name, needed in known.items() if needed and name not in effect.parameters]
    if unknown or missing:
        raise EffectUnknown(
            f"{effect.name}: "
            + "; ".join(
                text
                for text in (
                    f"unknown parameter {', '.join(unknown)}" if unknown else "",
                    f"missing parameter {', '.join(missing)}" if missing else "",
                )
                if text
            )
            + f"; its parameters are {', '.join(known)}"
        )
    built: Effect = kind(axis=effect.axis, **effect.parameters)
    if isinstance(built, Coupling) and (not 0 <= built.other < axes or built.other == built.axis):
        raise EffectUnknown(f"{effect.name}: other_axis {built.other_axis:g} is not another axis from 1 to {axes}")
    return built
