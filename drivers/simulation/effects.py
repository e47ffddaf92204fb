"""Undeclared effects of a simulated plant:
the physics that no configuration declares and `ident` has to discover.

To add one, write a function of the moment, the axis and its parameters in SI units, and a line in
`UNDECLARED_EFFECTS`. An effect with a state, or one that adds to the plant, is a class that is
called with the moment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from inspect import Parameter, signature

import numpy as np

from drivers.simulation.spec import FloatArray, SpecInvalid, UndeclaredEffect

AMBIENT_C = 25.0  #: Temperature of the cell and of everything in it at power-on


@dataclass(slots=True)
class Moment:
    """State of the plant in one substep: what an effect reads and what it may change.

    There are n joints and motors, N coordinates and m directions of dry friction. The coordinates
    are the joints, then the motors behind a flexible drive; a closed chain has passive joints
    between them. A prismatic joint has N for Nm and m for rad.
    """

    time_s: float  #: since power-on
    step_s: float  #: length of the substep
    position_rad: FloatArray  #: position at the start of the step, shape (N,); read only
    velocity_rad_s: FloatArray  #: velocity at the start of the step, shape (N,); read only
    motor_rad: FloatArray  #: rotor angles, shape (n,); read only
    current_a: FloatArray  #: in the motors, shape (n,); read only
    #: torque of the links on each joint in the step before, shape (n,); read only
    load_torque_nm: FloatArray
    #: Of dry friction, shape (m,); the first n are the joints'. May be changed; must not become
    #: negative.
    bound_nm: FloatArray
    viscous_nm_s_rad: FloatArray  #: of viscous friction, shape (N,); may be changed
    torque_nm: FloatArray  #: other torques on each coordinate, shape (N,); may be changed
    motor_torque_nm: FloatArray  #: of each motor, in joint units, shape (n,); may be changed
    #: of each motor with its gear, shape (n,); may be changed, and is kept
    temperature_c: FloatArray


Effect = Callable[[Moment], None]  #: Changes the moment; called once a substep


def stribeck(moment: Moment, axis: int, rise_nm: float, speed_rad_s: float) -> None:
    """Stribeck friction Fs + rise·exp(−|v|/speed):
    larger near standstill than sliding (Bo and Pavelescu 1982).
    """
    speed = abs(moment.velocity_rad_s[axis])
    moment.bound_nm[axis] += rise_nm * math.exp(-speed / speed_rad_s)


def load_friction(moment: Moment, axis: int, coefficient: float) -> None:
    """Dry friction Fs + coefficient·|τ_L| of a loaded gear;
    τ_L is the torque of the links on the joint.
    """
    moment.bound_nm[axis] += coefficient * abs(moment.load_torque_nm[axis])


def efficiency(moment: Moment, axis: int, efficiency: float) -> None:
    """A gear that gives on a part of the power:
    τ_g/η where the motor drives the load, η τ_g where the load drives it.

    τ_g is the torque of the links and of the joint's friction. The loss can only dissipate: it
    joins the bound.
    """
    velocity = moment.velocity_rad_s[axis]
    rubbing = moment.bound_nm[axis] + moment.viscous_nm_s_rad[axis] * abs(velocity)
    along = moment.load_torque_nm[axis] * math.copysign(1.0, velocity) + rubbing
    loss_nm = -along * (1.0 - efficiency)
    if along > 0.0:
        loss_nm = along * (1.0 / efficiency - 1.0)
    moment.bound_nm[axis] += loss_nm


def nonlinear_viscous(
    moment: Moment, axis: int, torque_at_1_rad_s_nm: float, exponent: float
) -> None:
    """Friction c·|v|^η against the motion, v in rad/s, besides the linear one:
    lubricants, seals, churning.

    It joins the bound of dry friction, which can only dissipate: as an explicit torque |v|^(1/3)
    would chatter at zero.
    """
    moment.bound_nm[axis] += torque_at_1_rad_s_nm * abs(moment.velocity_rad_s[axis]) ** exponent


def asymmetric_viscous(moment: Moment, axis: int, coefficient_nm_s_rad: float) -> None:
    """Viscous friction Fv + c forwards and Fv − c backwards, never below zero:
    a torque −c·|v| besides −Fv·v.
    """
    change = -coefficient_nm_s_rad
    if moment.velocity_rad_s[axis] >= 0.0:
        change = coefficient_nm_s_rad
    moment.viscous_nm_s_rad[axis] = max(0.0, moment.viscous_nm_s_rad[axis] + change)


def spring(moment: Moment, axis: int, stiffness_nm_per_rad: float, rest_rad: float) -> None:
    """Torque −k·(q − rest) on the joint: a gravity compensator, a cable or hose."""
    moment.torque_nm[axis] -= stiffness_nm_per_rad * (moment.position_rad[axis] - rest_rad)


def counterbalance(
    moment: Moment,
    axis: int,
    base_m: float,
    lever_m: float,
    phase_rad: float,
    stiffness_n_per_m: float,
    preload_n: float,
) -> None:
    """A balancer between the link before the joint and a lever on the link behind it,
    which pulls both ends together.

    With x = q − phase, 0 where the lever points at the balancer's foot, its length is s = √(a² + L²
    − 2 a L cos x); the force preload + k (s − |a − L|) gives the torque −F ds/dq. Foot and lever
    are a = base_m and L = lever_m from the joint's axis. (A hydropneumatic one differs by its gas
    law.)
    """
    x = moment.position_rad[axis] - phase_rad
    squared_m2 = base_m**2 + lever_m**2 - 2.0 * base_m * lever_m * math.cos(x)
    length_m = math.sqrt(squared_m2)
    force_n = preload_n + stiffness_n_per_m * (length_m - abs(base_m - lever_m))
    moment.torque_nm[axis] -= force_n * base_m * lever_m * math.sin(x) / length_m


def position_friction(moment: Moment, axis: int, amplitude_nm: float, phase_rad: float) -> None:
    """Dry friction Fs + amplitude·cos(q − phase), never below zero:
    an eccentric gear, a bearing out of line.
    """
    change = amplitude_nm * math.cos(moment.position_rad[axis] - phase_rad)
    moment.bound_nm[axis] = max(0.0, moment.bound_nm[axis] + change)


def cogging(
    moment: Moment, axis: int, amplitude_nm: float, order: float, phase_rad: float = 0.0
) -> None:
    """Cogging torque −amplitude·sin(order·θ + phase) of the motor, θ its rotor angle;
    the amplitude in joint units.
    """
    angle_rad = order * moment.motor_rad[axis] + phase_rad
    moment.motor_torque_nm[axis] -= amplitude_nm * math.sin(angle_rad)


def saturation(moment: Moment, axis: int, half_current_a: float) -> None:
    """Magnetic saturation, torque g·i / (1 + (i / half_current)²):
    half the torque constant is left at half_current.

    To first order the current that a torque needs is v = v₀ + v₀³/half_current², v₀ = τ/g.
    """
    share = moment.current_a[axis] / half_current_a
    moment.motor_torque_nm[axis] /= 1.0 + share**2


def clipped_current(moment: Moment, axis: int, limit_a: float) -> None:
    """A drive that gives its motor less current than its reference asks for, without a word of it:
    ±limit at most.
    """
    asked_a = abs(moment.current_a[axis])
    if asked_a > limit_a:
        moment.motor_torque_nm[axis] *= limit_a / asked_a


def offset_drift(moment: Moment, axis: int, offset_nm: float, time_constant_s: float) -> None:
    """An offset that goes away after power-on, offset·exp(−t/time_constant):
    a current sensor that warms up.

    The motor gives so much less than its reference says, in joint units.
    """
    moment.motor_torque_nm[axis] -= offset_nm * math.exp(-moment.time_s / time_constant_s)


def warm_up(moment: Moment, axis: int, cold_fraction: float, time_constant_s: float) -> None:
    """Friction of the joint times 1 + cold_fraction·exp(−t/time_constant), t since power-on:
    grease that warms up.
    """
    factor = 1.0 + cold_fraction * math.exp(-moment.time_s / time_constant_s)
    moment.bound_nm[axis] *= factor
    moment.viscous_nm_s_rad[axis] *= factor


@dataclass(slots=True)
class TemperatureFriction:
    """Friction that changes with the temperature of a drive, which its own losses heat:
    one thermal mass.

        time_constant · dΔ/dt = resistance · P − Δ,    P = winding · i² + (Fs + Fv |v|) |v|,

    with Δ over AMBIENT_C. Dry and viscous friction of the joint are multiplied by 1 + change · Δ /
    100, never below 0.
    """

    axis: int  #: joint and motor
    viscous_percent_per_k: float  #: change of the viscous friction
    coulomb_percent_per_k: float  #: change of the dry friction
    time_constant_s: float  #: of the drive's temperature
    resistance_k_per_w: float  #: thermal resistance to the surroundings
    winding_ohm: float = 0.0  #: of the motor: copper losses i² · winding

    def __call__(self, moment: Moment) -> None:
        """Heat the drive over the step by the exact solution for constant losses,
        and change its friction.
        """
        axis = self.axis
        speed = abs(moment.velocity_rad_s[self.axis])
        above_k = moment.temperature_c[axis] - AMBIENT_C
        for friction, percent in (
            (moment.bound_nm, self.coulomb_percent_per_k),
            (moment.viscous_nm_s_rad, self.viscous_percent_per_k),
        ):
            friction[axis] *= max(0.0, 1.0 + 0.01 * percent * above_k)
        losses_w = self.winding_ohm * moment.current_a[axis] ** 2
        friction_nm = moment.bound_nm[axis] + moment.viscous_nm_s_rad[axis] * speed
        losses_w += friction_nm * speed
        end_k = self.resistance_k_per_w * losses_w
        left = math.exp(-moment.step_s / self.time_constant_s)
        above_k = end_k + (above_k - end_k) * left
        moment.temperature_c[axis] = AMBIENT_C + above_k


@dataclass(slots=True)
class Presliding:
    """Dahl's friction torque·z, dz/dq = (1 − z·sign(v)) / distance (Dahl 1968),
    in place of as much dry friction.

    Contacts bend before they slide, so friction builds up over a distance after each reversal.
    """

    axis: int  #: joint
    torque_nm: float  #: friction after a long distance in one direction
    distance_rad: float  #: over which 63 % of a change of z happens
    bristle: float = field(default=0.0, init=False)  #: z, the state

    def __call__(self, moment: Moment) -> None:
        """Exchange dry friction for Dahl's; z is advanced by the exact solution over the distance
        of the step.
        """
        velocity = moment.velocity_rad_s[self.axis]
        if velocity != 0.0:
            end = math.copysign(1.0, velocity)
            way_rad = abs(velocity) * moment.step_s
            left = math.exp(-way_rad / self.distance_rad)
            self.bristle = end + (self.bristle - end) * left
        moment.bound_nm[self.axis] = max(0.0, moment.bound_nm[self.axis] - self.torque_nm)
        moment.torque_nm[self.axis] -= self.torque_nm * self.bristle


@dataclass(slots=True)
class Coupling:
    """Dry and viscous friction of two concentric shafts, on the sum of their speeds (eq. 25)."""

    axis: int  #: one joint
    other_axis: float  #: number of the other joint, from 1 as a person counts
    coulomb_nm: float  #: dry part of the shared friction
    viscous_nm_s_rad: float  #: viscous part of the shared friction
    #: index of its direction of dry friction, filled in by the plant
    direction: int = field(default=-1, init=False)

    @property
    def other(self) -> int:
        """Index of the other joint, from 0."""
        return int(self.other_axis) - 1

    def __call__(self, moment: Moment) -> None:
        """Set the bound of the shared friction and add its viscous part."""
        moment.bound_nm[self.direction] += self.coulomb_nm
        velocity_rad_s = moment.velocity_rad_s[self.axis] + moment.velocity_rad_s[self.other]
        shared = self.viscous_nm_s_rad * velocity_rad_s
        moment.torque_nm[self.axis] -= shared
        moment.torque_nm[self.other] -= shared


@dataclass(slots=True)
class PivotFriction:
    """Friction in the joint that a closed chain is cut at, dry and viscous:
    on the relative turn of two links.
    """

    closure: str  #: name of the closure
    coulomb_nm: float = 0.0  #: dry part
    viscous_nm_s_rad: float = 0.0  #: viscous part
    #: Index of its direction of dry friction, and how it turns with each coordinate, filled in by
    #: the plant.
    direction: int = field(default=-1, init=False)
    row: FloatArray = field(default_factory=lambda: np.zeros(0), init=False)  #: shape (N,)

    def __call__(self, moment: Moment) -> None:
        """Set the bound of its dry friction and add its viscous part."""
        moment.bound_nm[self.direction] += self.coulomb_nm
        turning_rad_s = float(self.row @ moment.velocity_rad_s)
        moment.torque_nm -= self.row * (self.viscous_nm_s_rad * turning_rad_s)


@dataclass(slots=True)
class Cable:
    """A stiff hose along two joints, led around each of them at a radius:
    it pulls where stretched, and pushes else.

    Its way is r_i q_i + r_j q_j, and its force the stiffness times what the way is beyond `rest_m`.
    A negative radius is the other side of a joint.
    """

    axis: int  #: one joint
    other_axis: float  #: number of the other joint, from 1 as a person counts
    radius_m: float  #: around the one joint
    other_radius_m: float  #: around the other joint
    stiffness_n_per_m: float  #: of the cable
    rest_m: float  #: way at which it has no force

    def __call__(self, moment: Moment) -> None:
        """Take the cable's force from both joints."""
        other = int(self.other_axis) - 1
        own_way_m = self.radius_m * moment.position_rad[self.axis]
        way_m = own_way_m + self.other_radius_m * moment.position_rad[other]
        force_n = self.stiffness_n_per_m * self.stretch_m(way_m)
        moment.torque_nm[self.axis] -= self.radius_m * force_n
        moment.torque_nm[other] -= self.other_radius_m * force_n

    def stretch_m(self, way_m: float) -> float:
        """By how much a way stretches it; negative where it is pressed."""
        return way_m - self.rest_m


@dataclass(slots=True)
class SlackCable(Cable):
    """A cable that only pulls: before `rest_m` it hangs slack."""

    def stretch_m(self, way_m: float) -> float:
        """By how much a way stretches it."""
        return max(0.0, way_m - self.rest_m)


@dataclass(slots=True)
class Elasticity:
    """A spring and a damper in the drive of one motor:
    the motor becomes a coordinate of its own (two masses).
    """

    axis: int  #: motor
    stiffness_nm_per_rad: float  #: stiffness in joint units
    damping_nm_s_per_rad: float  #: damping in joint units
    gap_rad: float = field(default=0.0, init=False)  #: free play between the flanks, in joint units
    #: The motor's coordinate and its row r of the drive train, filled in by the plant.
    coordinate: int = field(default=-1, init=False)
    #: its row of the drive train
    row: FloatArray = field(default_factory=lambda: np.zeros(0), init=False)

    def __call__(self, moment: Moment) -> None:
        """Add the drive's torque to the links and subtract it from the motor."""
        n = len(self.row)
        half_gap_rad = self.gap_rad / 2.0
        twist = float(moment.position_rad[self.coordinate] - self.row @ moment.position_rad[:n])
        rate = float(moment.velocity_rad_s[self.coordinate] - self.row @ moment.velocity_rad_s[:n])
        deflection = twist - min(max(twist, -half_gap_rad), half_gap_rad)
        if half_gap_rad > 0.0 and deflection == 0.0:
            return
        torque = self.stiffness_nm_per_rad * deflection + self.damping_nm_s_per_rad * rate
        if half_gap_rad > 0.0:
            # A flank pushes and never pulls, however fast it is left.
            if deflection > 0.0:
                torque = max(torque, 0.0)
            else:
                torque = min(torque, 0.0)
        moment.torque_nm[self.coordinate] -= torque
        moment.torque_nm[:n] += self.row * torque


@dataclass(slots=True)
class Backlash(Elasticity):
    """Elasticity with a gap: the drive transmits only where the teeth touch,
    and there it only pushes.
    """

    gap_rad: float


@dataclass(slots=True)
class Lag:
    """First-order lag of the reported current reference; the current itself is not delayed."""

    axis: int  #: motor
    time_constant_s: float  #: of the lag
    value_a: float = field(default=0.0, init=False)  #: of the filter, the state

    def report(self, reported_a: FloatArray, step_s: float) -> None:
        """Replace this axis' reference by the filtered one;
        called once a substep (exact for a held input).
        """
        difference_a = float(reported_a[self.axis]) - self.value_a
        share = -np.expm1(-step_s / self.time_constant_s)
        self.value_a += difference_a * share
        reported_a[self.axis] = self.value_a


WithState = TemperatureFriction | Presliding | Coupling | Cable | Elasticity

UNDECLARED_EFFECTS: dict[str, Callable[..., None] | type[WithState | Lag]] = {
    "stribeck": stribeck,
    "load-friction": load_friction,
    "efficiency": efficiency,
    "nonlinear-viscous": nonlinear_viscous,
    "asymmetric-viscous": asymmetric_viscous,
    "spring": spring,
    "cable": Cable,
    "slack-cable": SlackCable,
    "counterbalance": counterbalance,
    "position-friction": position_friction,
    "cogging": cogging,
    "saturation": saturation,
    "lag": Lag,
    "clipped-current": clipped_current,
    "offset-drift": offset_drift,
    "warm-up": warm_up,
    "temperature-friction": TemperatureFriction,
    "presliding": Presliding,
    "backlash": Backlash,
    "elasticity": Elasticity,
    "coupling": Coupling,
}
"""Physics by its name in a simulation file;
their arguments besides the moment and the axis are the parameters.
"""


OF_MOTORS = (
    "cogging",
    "saturation",
    "lag",
    "clipped-current",
    "offset-drift",
    "temperature-friction",
    "backlash",
    "elasticity",
    "coupling",
    "cable",
    "slack-cable",
)
"""Effects that need a motor."""


PIVOT_FRICTION = "pivot-friction"
"""Friction of a closure, which is on no axis and no joint of the tree."""
#: Arguments of an effect's physics that are no parameters of its own
PLACES = ("moment", "axis", "closure")


def _pivot_friction(effect: UndeclaredEffect) -> PivotFriction:
    """Build the friction of a closure.

    Raises:
        SpecInvalid: it names no closure, or another parameter than those of friction.
    """
    if effect.closure is None:
        raise SpecInvalid(f"{PIVOT_FRICTION}: no closure; name the one that the pivot closes")
    _require_parameters(effect, PivotFriction)
    return PivotFriction(effect.closure, **effect.parameters)


def _require_parameters(effect: UndeclaredEffect, physics: Callable[..., object]) -> None:
    """Refuse parameters that the physics of an effect does not have, and missing ones.

    Raises:
        SpecInvalid: with all of them, and those that there are.
    """
    parameters = signature(physics).parameters.values()
    known = {
        parameter.name: parameter.default
        for parameter in parameters
        if parameter.name not in PLACES
    }
    unknown = sorted(set(effect.parameters) - set(known))
    required = [name for name, default in known.items() if default is Parameter.empty]
    missing = [name for name in required if name not in effect.parameters]
    wrong = []
    if unknown:
        wrong.append(f"unknown parameter {', '.join(unknown)}")
    if missing:
        wrong.append(f"missing parameter {', '.join(missing)}")
    if wrong:
        raise SpecInvalid(
            f"{effect.name}: {'; '.join(wrong)}; its parameters are {', '.join(known)}"
        )


def build_effect(
    effect: UndeclaredEffect, axes: int, passive: tuple[str, ...] = ()
) -> Effect | Lag:
    """Build the physics of an undeclared effect for a cell with a number of axes.

    Args:
        effect: on an axis or on a passive joint.
        axes: of the cell.
        passive: joints without a motor, whose coordinates follow those of the axes.

    Raises:
        SpecInvalid: the name, a parameter or the joint does not exist, or a parameter is missing.
    """
    if effect.name == PIVOT_FRICTION:
        return _pivot_friction(effect)
    if effect.closure is not None:
        raise SpecInvalid(f"{effect.name}: acts on no closure; only {PIVOT_FRICTION} does")
    physics = UNDECLARED_EFFECTS.get(effect.name)
    if physics is None:
        names = ", ".join((*UNDECLARED_EFFECTS, PIVOT_FRICTION))
        raise SpecInvalid(f"undeclared effect {effect.name!r} does not exist; there are {names}")
    joint = effect.axis
    if effect.joint is not None:
        if effect.joint not in passive:
            joints = ", ".join(passive) or "none: each has a motor"
            raise SpecInvalid(
                f"{effect.name}: no passive joint {effect.joint!r}; there are {joints}"
            )
        if effect.name in OF_MOTORS:
            raise SpecInvalid(
                f"{effect.name}: joint {effect.joint} has no motor; name an axis, J1 to J{axes}"
            )
        joint = axes + passive.index(effect.joint)
    _require_parameters(effect, physics)
    other_axis = effect.parameters.get("other_axis")
    others = set(range(1, axes + 1)) - {joint + 1}
    if other_axis is not None and other_axis not in others:
        raise SpecInvalid(
            f"{effect.name}: other_axis {other_axis:g} is not another axis from 1 to {axes}"
        )
    if not isinstance(physics, type):
        return partial(physics, axis=joint, **effect.parameters)
    built: WithState | Lag = physics(axis=joint, **effect.parameters)
    return built
