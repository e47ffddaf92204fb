"""What the searched parameters of an effect can be at all: a calibration made by hand may say anything."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ident.effects.abscissa import Abscissa
from ident.effects.smooth import Smooth
from ident.errors import EffectRefused

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
