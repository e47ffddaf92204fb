"""The form of an effect: columns of joint torque that the declared model lacks.

An effect adds Σ c_k φ_k to the torque of the declared model, which the motors must supply; it is
given at the joint [Nm; N]. A positive coefficient c with a positive column φ therefore needs more
current in the positive direction of the joint.

Shapes: m axes, p coefficients, k samples of a run, r rows of all runs. Columns go two steps from
the effect to the equations: where the effect is placed (`columns_at`), and then as torques of all
axes (`at_joints`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from typing import Annotated, Self, get_args, get_type_hints

import numpy as np

from ident.arrays import FloatArray, require_real
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.effects.signals import Abscissa, Signals, watched_s
from ident.equations.rows import torques_at_rows
from ident.errors import EffectRefused
from ident.model.model import Column, DriveTrain, Model
from ident.model.robot import JointKind, Robot


class GearSide(Enum):
    """Where the torque acts.

    JOINT: on the joint. MOTOR: on the motor of that number, and through R on all joints that it
    turns. TWO_JOINTS: on the joint and on a second one, whose number is the setting `other_axis`.
    ALL_JOINTS: on every joint, through the links. ALL_MOTORS: on every motor alike; such an effect
    has no axis of its own and is placed on the first.
    """

    JOINT = "joint"
    MOTOR = "motor"
    TWO_JOINTS = "two joints"
    ALL_JOINTS = "all joints"
    ALL_MOTORS = "all motors"


class Property(Enum):
    """Property that an effect declares of its columns; a test tries to refute it for each."""

    ODD_IN_VELOCITY = "turns its sign when the motion is reversed in place"
    EVEN_IN_VELOCITY = "keeps its value when the motion is reversed in place"
    INDEPENDENT_OF_VELOCITY = "does not change when the velocity does"
    PERIODIC_IN_MOTOR_ANGLE = "repeats after one motor revolution"
    ODD_IN_CURRENT = "turns its sign with the current"
    ODD_IN_LOAD = "turns its sign with the load"
    RATE_OF_TORQUE = "is zero where the torque has not changed for a while"
    SMOOTH = "changes little where its variable does"
    RATE_OF_LOAD = "is zero where the load does not change"
    TURNS_THE_ARM = "is the change of the whole arm's torque by another geometry"


class Reported(Enum):
    """How reports give the size of an effect."""

    COEFFICIENTS = "each coefficient with its name and unit"
    AMPLITUDE = "one amplitude of its two coefficients, of the cosine and the sine of one angle"
    SHARE_OF_LOAD = "the first coefficient as a share of the load torque, in percent"
    DELAY = "the coefficient as a time, in milliseconds"
    ANGLES = "angles in degrees"


@dataclass(frozen=True, slots=True)
class Range:
    """Values that a searched parameter can have: far beyond what a search tries."""

    least: float
    largest: float


Switch = Annotated[int, Range(0, 1)]
Sense = Annotated[int, Range(-1, 1)]  #: 1 or −1 (`sense_fault`)
#: Number of another axis, from 1; 0 where an effect has none
AxisNumber = Annotated[int, Range(0, math.inf)]


@dataclass(frozen=True, slots=True)
class Effect(ABC):
    """A torque Σ c_k φ_k [Nm; N] that the declared model lacks; derive from it to add your own.

    A subclass is a frozen dataclass. It sets `name`, `declares`, `abscissa` and `coefficients`, and
    defines `columns`, the φ_k. The torque is what the motors must supply, at the joint: a positive
    coefficient with a positive column needs more current in the positive direction. Its fields,
    each with a `Range`, are its searched parameters, with units in their names. Its docstring
    states equation, sign, source and signature: how the residual shows it.

    The other properties say where and when it is tried, and what its settings mean; their defaults
    are those of a torque on one driven joint. Settings and coefficients may have any names: only
    these properties give them a meaning. A search tries it where a package registers it by the
    entry point group `drivegain.effects`, or where it is in `own_effects` of `find_effects`.

    Example::

        @dataclass(frozen=True, slots=True)
        class SquareDrag(ident.Effect):
            name = "square-drag"
            declares = ident.Property.ODD_IN_VELOCITY
            abscissa = ident.Abscissa.VELOCITY
            coefficients = (ident.Column("drag", "Nm/(rad/s)^2", least=0.0),)

            def columns(self, signals, axis):
                velocity_rad_s = signals.velocity_rad_s[axis]
                return (velocity_rad_s * np.abs(velocity_rad_s))[None]
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the family, as reports and calibrations write it."""

    @property
    @abstractmethod
    def declares(self) -> Property:
        """Property of the columns."""

    @property
    @abstractmethod
    def abscissa(self) -> Abscissa:
        """Variable that shows the effect in a plot."""

    @property
    @abstractmethod
    def coefficients(self) -> tuple[Column, ...]:
        """Name, unit and possible values of each linear parameter."""

    @property
    def phrase(self) -> str:
        """Words for reports after "J3 has": `friction that grows with the load`; else the name."""
        return ""

    @property
    def side(self) -> GearSide:
        """Where the torque acts."""
        return GearSide.JOINT

    @property
    def has_axis(self) -> bool:
        """Whether it acts on one axis; False of what acts on all, which is placed on the first."""
        return self.side is not GearSide.ALL_MOTORS

    @property
    def needs_inertia(self) -> bool:
        """Whether it needs the mass matrix."""
        return self.side is GearSide.ALL_JOINTS

    @property
    def needs_revolute(self) -> bool:
        """Whether the effect exists only where the joint's position is an angle."""
        return False

    @property
    def needs_tree(self) -> bool:
        """Whether it exists only where no loop is closed."""
        return False

    @property
    def with_motor(self) -> bool:
        """Whether it acts on driven joints; else on joints without a motor."""
        return True

    @property
    def reported(self) -> Reported:
        """How reports give its size."""
        return Reported.COEFFICIENTS

    @property
    def axis_setting(self) -> str:
        """Name of the setting that is the number of another axis, from 1; empty without one.

        Of a torque on two joints it is `other_axis`, unless it says otherwise.
        """
        if self.side is GearSide.TWO_JOINTS:
            return "other_axis"
        return ""

    @property
    def second_axis(self) -> int | None:
        """Number of the other axis, from 1; None where it has none."""
        if not self.axis_setting:
            return None
        number = int(self.settings[self.axis_setting])
        if number == 0:  # see `AxisNumber`
            return None
        return number

    @property
    def form_settings(self) -> tuple[str, ...]:
        """Settings that choose between forms of one effect, such as a switch.

        A search counts two forms as one effect; such a setting is no parameter.
        """
        return ()

    @property
    def key_settings(self) -> tuple[str, ...]:
        """Settings in which two effects of one name on one axis must differ to be in one model.

        All whole numbers that choose no form: cogging of two orders is two effects.
        """
        integers = [name for name, value in self.settings.items() if isinstance(value, int)]
        return tuple(name for name in integers if name not in self.form_settings)

    @property
    def added_settings(self) -> tuple[str, ...]:
        """Settings that a later version of the effect added.

        Where a calibration does not have them they are 0, and names of columns leave a 0 out.
        """
        return ()

    @property
    def nearly_declared(self) -> Mapping[str, Range]:
        """Values of a setting, by its name, with which the effect is nearly a term of the model.

        A refinement of the setting stays outside of this range, and on the side of it where it
        begins.
        """
        return {}

    @property
    def settings_fault(self) -> str:
        """What is wrong with its settings together, after "effect 'x' is given"; else empty."""
        return ""

    @property
    def has_rotor_form(self) -> bool:
        """Whether it is a loss at a gear that can leave the rotor out of the load (`rotor`).

        It then has the settings `rotor_inertia_kg_m2`, the known part J of the rotor's inertia Ia,
        and `with_rotor`, 1 where a coefficient for the rest Ia − J is fitted, else 0.
        """
        return False

    @property
    def fits_rotor(self) -> bool:
        """Whether its last coefficient is the rest of the rotor's inertia, a loss times Ia − J."""
        return self.has_rotor_form and bool(self.settings["with_rotor"])

    @property
    def known_rotor_kg_m2(self) -> float:
        """Inertia of the axis' rotor that it takes off the load [kg m²]; 0 where it knows none."""
        if self.has_rotor_form:
            return self.settings["rotor_inertia_kg_m2"]
        return 0.0

    @property
    def refined(self) -> tuple[str, ...]:
        """Settings that are fitted together with all linear parameters of the model.

        A search does so once it has chosen the effect, and again in each joint fit; it begins at
        the best member of the family. By default these are all real settings, where there are two
        or more: fixed at values that somebody chose, they would leave a residual that other effects
        explain, and σ would not contain it.
        """
        real = tuple(name for name, value in self.settings.items() if isinstance(value, float))
        if len(real) < 2:
            return ()
        return real

    @property
    def refined_once_chosen(self) -> tuple[str, ...]:
        """Settings that are fitted in this way once the effect was chosen.

        Those that are not in `refined` stay as they are in joint fits. Where this is empty, one
        setting alone is refined, the first positive real one that has a smaller and a larger value
        in the family: between these two.
        """
        return self.refined

    @property
    def is_rate(self) -> bool:
        """Whether the torque is a derivative in time, which a filter makes much smaller."""
        if self.side is GearSide.ALL_JOINTS:
            return True
        return self.declares in {Property.RATE_OF_TORQUE, Property.RATE_OF_LOAD}

    @property
    def reach(self) -> int | None:
        """Largest distance of the second axis of a pair, in axes along the robot; None for any."""
        return None

    @property
    def least_moves(self) -> int:
        """Fewest moves of the data among which a search tries it."""
        return 0

    @property
    def forms(self) -> tuple[Self, ...]:
        """Simpler forms, then the effect itself; each has the first columns of the next one."""
        return (self,)

    @abstractmethod
    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit coefficient [Nm], (p, k); (2, p, k) on two joints, (m, p, k) on all."""

    def fits_in(self, runs: Sequence[Signals], axis: int) -> bool:
        """Whether the data can show it on an axis: they are long enough, and have its variable."""
        del runs, axis
        return True

    @property
    def settings(self) -> dict[str, float]:
        """Searched (non-linear) parameters by name, units in the names."""
        return {name: getattr(self, name) for name in _ranges(type(self))}

    def with_settings(self, settings: Mapping[str, float]) -> Self:
        """Return the same effect with some of its searched parameters changed."""
        return replace(self, **settings)


@dataclass(frozen=True, slots=True)
class FadingEffect(Effect):
    """An effect that fades with time, or settles."""

    time_constant_s: Annotated[float, Range(1e-2, 1e6)]  #: η
    #: 1: t counts from the first run of the session. 0: from the beginning of each run, as after a
    #: power-on.
    whole_session: Switch

    def fits_in(self, runs: Sequence[Signals], axis: int) -> bool:
        """Whether it fades while it is watched: over the session, or over the longest run."""
        del axis
        return self.time_constant_s <= watched_s(runs, whole_session=bool(self.whole_session))

    def left(self, signals: Signals) -> FloatArray:
        """Share that is left of the effect, e^(−t/η), shape (k,)."""
        if self.whole_session:
            time_s = signals.session_s
        else:
            time_s = signals.time_s
        return np.asarray(np.exp(-time_s / self.time_constant_s))


def sense_fault(sense: int) -> str:
    """What is wrong with a sense, for `Effect.settings_fault`; empty of 1 and −1."""
    if sense:
        return ""
    return "sense = 0; it is 1 or -1"


def setting_range(effect: Effect, setting: str) -> Range:
    """Return the values that a setting of an effect can have."""
    return _ranges(type(effect))[setting]


def setting_kind(effect: Effect, setting: str) -> type:
    """Return the type of a setting, as annotated: int, or float for one that can be refined."""
    hint = get_type_hints(type(effect), include_extras=True)[setting]
    kind: type = get_args(hint)[0]  # of Annotated[kind, Range(…)]
    return kind


@cache
def _ranges(kind: type[Effect]) -> dict[str, Range]:
    """Range of each setting, by its name: annotated as ``Annotated[float, Range(…)]``."""
    ranges: dict[str, Range] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for annotation in get_args(hint)[1:]:
            if isinstance(annotation, Range):
                ranges[name] = annotation
    return ranges


def check_settings(effect: Effect, settings: Mapping[str, float], axis: int, axes: int) -> None:
    """Refuse settings that an effect cannot have on this axis.

    A calibration written by hand may hold anything.

    Args:
        effect: any member of the family.
        settings: by name.
        axis: index of the axis that it acts on.
        axes: number of axes of the robot.

    Raises:
        EffectRefused: a setting is not finite, outside its range, or names an axis that is no other
            one.
    """
    name = effect.name
    for setting, value in settings.items():
        if not math.isfinite(value):
            raise EffectRefused(
                f"effect {name!r} is given {setting} = {value}; it must be a finite number"
            )
    for setting, allowed in _ranges(type(effect)).items():
        value = settings[setting]
        if setting == effect.axis_setting:
            number = axis + 1
            is_axis = value in range(1, axes + 1)
            if not is_axis or value == number:
                raise EffectRefused(
                    f"effect {name!r} on axis {number} is given {setting} = {value:g}; it is the "
                    f"number of another of the {axes} axes"
                )
        elif not allowed.least <= value <= allowed.largest:
            raise EffectRefused(
                f"effect {name!r} is given {setting} = {value:g}; it lies between "
                f"{allowed.least:g} and {allowed.largest:g}"
            )
    fault = effect.with_settings(settings).settings_fault
    if fault:
        raise EffectRefused(f"effect {name!r} is given {fault}")


ALL_AXES = "all axes"  #: Where an effect is that acts on every motor alike


#: Family, axis, and the settings in which effects of one family on one axis differ
EffectKey = tuple[str, int, tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class PlacedEffect:
    """An effect on an axis, or on a joint without a motor."""

    effect: Effect
    axis: int  #: index; joints without a motor follow the axes (`Robot.places`)

    def axis_name(self, axes: Sequence[str]) -> str:
        """Name of its axis; ALL_AXES of an effect on every axis, which is placed on the first."""
        if not self.effect.has_axis:
            return ALL_AXES
        return axes[self.axis]

    def name_among(self, axes: Sequence[str]) -> str:
        """Name of effect and place: `load-friction on J3`, `coupling on J4 with J5`."""
        name = f"{self.effect.name} on {self.axis_name(axes)}"
        other = self.effect.second_axis
        if other:
            name += f" with {axes[other - 1]}"
        return name

    @property
    def columns(self) -> tuple[Column, ...]:
        """Linear parameters named after effect, axis and settings.

        An axis may have cogging of two orders.
        """
        settings: list[str] = []
        for setting, value in self.effect.settings.items():
            is_left_out = value == 0 and setting in self.effect.added_settings
            if not is_left_out:
                settings.append(f"{setting} {value:.6g}")
        suffix = f"{self.axis + 1}"
        if settings:
            suffix = f"{suffix} ({', '.join(settings)})"
        columns: list[Column] = []
        for coefficient in self.effect.coefficients:
            name = f"{self.effect.name} {coefficient.name} {suffix}"
            columns.append(replace(coefficient, name=name))
        return tuple(columns)


def effect_key(effect: Effect, axis: int) -> EffectKey:
    """Key of an effect on an axis: two effects with one key cannot be in one model.

    It has the family, the axis and the `Effect.key_settings`: ripples of two orders are two.
    """
    settings = effect.settings
    key_settings = tuple(settings[name] for name in effect.key_settings)
    return effect.name, axis, key_settings


def effect_torque(
    effect: Effect,
    axis: int,
    runs: Sequence[Signals],
    datasets: Sequence[Dataset],
    conditioning: Conditioning,
    model: Model,
) -> FloatArray:
    """An effect's columns as torques of all axes on the observation's rows, shape (m, p, r).

    They are in Nm (or N) per unit of each coefficient.
    """
    columns = effect_columns(effect, axis, runs, datasets, conditioning)
    return at_joints(effect, axis, columns, model.drive_train)


def effect_columns(
    effect: Effect,
    axis: int,
    runs: Sequence[Signals],
    datasets: Sequence[Dataset],
    conditioning: Conditioning,
) -> FloatArray:
    """An effect's columns where it is placed, filtered and decimated to the observation's rows.

    Returns:
        shape (p, r) on one joint or motor; (2, p, r) on two joints; (m, p, r) on all.
    """
    parts: list[FloatArray] = []
    for run, data in zip(runs, datasets, strict=True):
        columns = columns_at(effect, run, axis)
        parts.append(torques_at_rows(data, conditioning, columns))
    return np.concatenate(parts, axis=-1)


def is_shipped(effect: Effect) -> bool:
    """Whether an effect is one of this package, and not one's own."""
    return type(effect).__module__.startswith(f"{__package__}.")


def columns_at(effect: Effect, signals: Signals, axis: int) -> FloatArray:
    """Columns of an effect where it is placed, along a run.

    Args:
        effect: in Nm (or N) per unit of each coefficient.
        signals: of the run.
        axis: index; places without a motor follow the m axes (`Robot.places`).

    Returns:
        shape (p, k), (2, p, k) or (m, p, k), see `Effect.columns`; of a place without a motor the
        torques of all axes that the same power needs, shape (m, p, k).

    Raises:
        EffectRefused: an effect of one's own fails, or returns columns of another shape or a number
            that is not finite.
    """
    axis_count = len(signals.current_a)
    if is_shipped(effect):
        columns = effect.columns(signals, axis)
    else:
        columns = _own_columns(effect, signals, axis, axis_count)
    if axis < axis_count:
        return columns
    leverage = signals.leverage[axis - axis_count]  # torque of each axis per unit there, (m, k)
    return np.asarray(leverage[:, None] * columns)


def fits_data(effect: Effect, runs: Sequence[Signals], axis: int) -> bool:
    """Whether the data can show an effect on an axis (`Effect.fits_in`).

    Raises:
        EffectRefused: an effect of one's own fails.
    """
    if is_shipped(effect):
        return effect.fits_in(runs, axis)
    try:
        return bool(effect.fits_in(runs, axis))
    except (Exception, SystemExit) as error:  # code of others
        raise EffectRefused(
            f"effect {effect.name!r}: found {type(error).__name__} ({error}) in its method "
            "`fits_in`; expected True or False; correct it"
        ) from error


_LEADING_SHAPE = {GearSide.JOINT: (), GearSide.MOTOR: (), GearSide.TWO_JOINTS: (2,)}
"""Leading axes of the columns, before (p, k), by where the torque acts; (m,) where on all."""


def _own_columns(effect: Effect, signals: Signals, axis: int, axis_count: int) -> FloatArray:
    """Columns of an effect of one's own; refused where it fails, or they have no use.

    Their shape must be right and their numbers finite.
    """
    try:
        returned = np.asarray(effect.columns(signals, axis))
    # Code of others: it may fail in any way, and even end the program.
    except (Exception, SystemExit) as error:
        raise EffectRefused(
            f"effect {effect.name!r}: found {type(error).__name__} ({error}) in its method "
            "`columns`; expected a torque for every sample; correct it, and copy what it changes: "
            "the arrays of `signals` are read-only"
        ) from error
    label = f"what the method `columns` of effect {effect.name!r} returns"
    require_real(label, returned, EffectRefused, "a torque for every sample")
    try:
        found = np.asarray(returned, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise EffectRefused(f"{label}: found no numbers ({error})") from error
    leading = _LEADING_SHAPE.get(effect.side, (axis_count,))
    expected = (*leading, len(effect.coefficients), len(signals.time_s))
    if found.shape != expected:
        raise EffectRefused(
            f"effect {effect.name!r}: found columns of shape {found.shape}; expected {expected}, "
            "the last two for coefficients and samples; correct its method `columns`"
        )
    if not np.isfinite(found).all():
        raise EffectRefused(
            f"effect {effect.name!r}: found columns with numbers that are not finite; expected a "
            "torque for every sample; correct its method `columns`, or return False from `fits_in` "
            "where it lacks a signal"
        )
    return found


def at_joints(
    effect: Effect, axis: int, columns: FloatArray, drive_train: DriveTrain
) -> FloatArray:
    """Convert an effect's columns where it is placed to torques of all axes.

    Args:
        effect: the effect.
        axis: index of its place.
        columns: as of `columns_at`, shape (p, k), (2, p, k) or (m, p, k).
        drive_train: R.

    Returns:
        shape (m, p, k).
    """
    if axis >= len(drive_train.ratio):  # a place without a motor: `columns_at` has converted them
        return columns
    if effect.side is GearSide.MOTOR:
        direction = drive_train.direction[axis]
        return np.asarray(direction[:, None, None] * columns[None])
    if effect.side is GearSide.ALL_JOINTS:
        return columns
    if effect.side is GearSide.ALL_MOTORS:
        # τ_j = Σ_i r_ij τ_i of motor i and joint j
        return np.asarray(np.einsum("ij,ipk->jpk", drive_train.direction, columns))
    joints = [axis]
    if effect.side is GearSide.TWO_JOINTS and effect.second_axis is not None:
        joints.append(effect.second_axis - 1)
    torque = np.zeros((len(drive_train.ratio), *columns.shape[-2:]))
    torque[joints] = columns
    return torque


def is_placeable(effect: Effect, axis: int, robot: Robot) -> bool:
    """Whether an effect can act on an axis; one of two joints is placed on the lower number."""
    is_driven = axis < robot.axis_count
    if effect.with_motor != is_driven:
        return False
    if effect.needs_revolute and robot.places[axis].kind is JointKind.PRISMATIC:
        return False
    if effect.needs_tree and robot.is_constrained:
        return False
    if not effect.has_axis:
        return axis == 0
    if effect.side is GearSide.TWO_JOINTS:
        return _is_pair(effect, axis, robot)
    return True


def _is_pair(effect: Effect, axis: int, robot: Robot) -> bool:
    """Whether the other axis of an effect of two joints comes behind this one, within its reach."""
    number = axis + 1
    other = effect.second_axis
    if other is None:
        return False
    if effect.reach is not None and other > number + effect.reach:
        return False
    return number < other <= robot.axis_count
