"""An effect's columns where its torque acts: at its joint, or at its motor and so at all joints that it turns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Effect, Side
from ident.effects.friction import PositionFriction
from ident.effects.position import Compensator
from ident.effects.unnamed import Smooth
from ident.equations.rows import decimate_rows
from ident.errors import EffectRefused
from ident.model.model import DriveTrain, Model
from ident.model.robot import JointKind, Robot

FloatArray = NDArray[np.float64]


def at_joints(effect: Effect, axis: int, columns: FloatArray, drive_train: DriveTrain) -> FloatArray:
    """An effect's columns at its axis, shape (p, k) or (joints, p, k), as torque of all joints, shape (n, p, k)."""
    if effect.side is Side.MOTOR:
        return np.asarray(drive_train.direction[axis][:, None, None] * columns[None])
    if effect.side is Side.ALL_JOINTS:
        return columns
    if effect.side is Side.ALL_MOTORS:
        return np.asarray(np.einsum("ij,ipk->jpk", drive_train.direction, columns))
    joints = [axis, int(effect.settings["other_axis"]) - 1] if effect.side is Side.TWO_JOINTS else [axis]
    torque = np.zeros((len(drive_train.ratio), *columns.shape[-2:]))
    torque[joints] = columns
    return torque


def is_placeable(effect: Effect, axis: int, robot: Robot) -> bool:
    """Whether an effect can act on an axis; a pair of joints is named by the lower one, and only angles have a sine."""
    axes = robot.joint_count
    if isinstance(effect, PositionFriction | Compensator) and robot.joints[axis].kind is JointKind.PRISMATIC:
        return False
    if effect.side is Side.ALL_MOTORS:
        return axis == 0
    return effect.side is not Side.TWO_JOINTS or axis + 1 < int(effect.settings["other_axis"]) <= axes


def acts_on(effect: Effect, axis: int, drive_train: DriveTrain) -> frozenset[int]:
    """The joints that an effect at an axis gives a torque of its own to."""
    everywhere = frozenset(range(len(drive_train.ratio)))
    if effect.side in (Side.ALL_JOINTS, Side.JOINT):
        return frozenset({axis})  # elasticity and backlash are felt everywhere, and are one joint's
    if effect.side is Side.TWO_JOINTS:
        return frozenset({axis, int(effect.settings["other_axis"]) - 1})
    if effect.side is Side.MOTOR:
        return frozenset(np.flatnonzero(drive_train.direction[axis]).tolist())
    return everywhere


def effect_torque(
    effect: Effect,
    axis: int,
    runs: Sequence[Signals],
    datasets: Sequence[Dataset],
    conditioning: Conditioning,
    model: Model,
) -> FloatArray:
    """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (n, p, r)."""
    parts = [
        decimate_rows(data, conditioning, effect.columns(run, axis)) for run, data in zip(runs, datasets, strict=True)
    ]
    return at_joints(effect, axis, np.concatenate(parts, axis=-1), model.drive_train)


# What the searched parameters of an effect can be at all: a calibration made by hand may say anything.


RANGES: tuple[tuple[str, float, float], ...] = (
    ("speed_rad_s", 1e-4, 1e2),
    ("exponent", 0.05, 10.0),
    ("speed_exponent", 0, 1),
    ("order", 1, 1000),
    ("time_constant_s", 1e-2, 1e6),
    ("whole_session", 0, 1),
    ("distance_rad", 1e-6, 1e2),
    ("share", 1e-6, 1.0),
    ("start_rad", -1e3, 1e3),
    ("lower", -1e12, 1e12),
    ("upper", -1e12, 1e12),
    ("signed", 0, 1),
    ("sense", -1, 1),
)
"""Name, least and largest: far beyond what a search tries, and short of what makes a power or a quotient overflow."""
_OTHER = "other_axis"
_NO_OTHER = tuple(Smooth(variable).name for variable in Abscissa if variable is not Abscissa.OTHER_VELOCITY)
"""Effects that have the setting and speak of no other axis."""


def check_settings(name: str, settings: Mapping[str, float], axis: int, axes: int) -> None:
    """Refuse settings that no effect on this axis can have.

    Args:
        name: of the effect.
        settings: by name.
        axis: that it acts on, from 0.
        axes: that the robot has.

    Raises:
        EffectRefused: one of them is not finite, outside its range, or names an axis that is no other one.
    """
    for setting, value in settings.items():
        if not math.isfinite(value):
            raise EffectRefused(f"effect {name!r} is given {setting} = {value}; it must be a finite number")
    for setting, least, largest in RANGES:
        if setting in settings and not least <= settings[setting] <= largest:
            raise EffectRefused(
                f"effect {name!r} is given {setting} = {settings[setting]:g}; it lies between {least:g} and {largest:g}"
            )
    if settings.get("sense") == 0:
        raise EffectRefused(f"effect {name!r} is given sense = 0; it is 1 or -1")
    if "lower" in settings and not settings["lower"] < settings["upper"]:
        raise EffectRefused(
            f"effect {name!r} is given the range {settings['lower']:g} to {settings['upper']:g}; it must not be empty"
        )
    if _OTHER in settings:
        _check_other(name, settings[_OTHER], axis, axes)


def _check_other(name: str, other: float, axis: int, axes: int) -> None:
    if name in _NO_OTHER:
        if other != 0:
            raise EffectRefused(f"effect {name!r} is given {_OTHER} = {other:g}; it speaks of no other axis: 0")
    elif other not in range(1, axes + 1) or other == axis + 1:
        raise EffectRefused(
            f"effect {name!r} on axis {axis + 1} is given {_OTHER} = {other:g}; it is the number of another of the "
            f"{axes} axes"
        )
