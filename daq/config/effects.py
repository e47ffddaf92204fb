"""Place the effects that a cell file declares:
names, settings and places as the dictionary of effects has them.
"""

from __future__ import annotations

from collections.abc import Mapping

from daq.config.yaml_file import Fault
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import (
    Effect,
    GearSide,
    PlacedEffect,
    check_settings,
    is_placeable,
    setting_kind,
)
from ident.effects.own import installed_families
from ident.errors import EffectRefused
from ident.model.robot import Robot


def place_effect(
    name: str, place: int, settings: Mapping[str, float], robot: Robot
) -> PlacedEffect | Fault:
    """Return a declared effect, or what is wrong with it;
    the path of a fault is relative to the effect.

    Args:
        name: of its family.
        place: index of its joint among `Robot.places`.
        settings: those that are given; the others are those of the dictionary's first member, or 0
            if a later version added them.
        robot: that has it.
    """
    known = _family_member(name)
    if isinstance(known, Fault):
        return known
    unknown = sorted(set(settings) - set(known.settings))
    if unknown:
        listed = ", ".join(unknown)
        expected = ", ".join(known.settings) or "no settings"
        return Fault(("settings",), f"settings {listed}", expected)
    # A file of an earlier version does not have them
    added = dict.fromkeys(known.added_settings, 0)
    full = {**known.settings, **added, **settings}
    for setting, value in full.items():
        # A file has one kind of number; an order is whole.
        if isinstance(known.settings[setting], int) and value != int(value):
            return Fault(("settings", setting), f"{value:g}", "a whole number")
    try:
        check_settings(known, full, place, robot.axis_count)
    except EffectRefused as error:
        return Fault(("settings",), str(error), "settings in their range")
    typed = {}
    for setting, value in full.items():
        kind = setting_kind(known, setting)
        typed[setting] = kind(value)
    effect = known.with_settings(typed)
    if not is_placeable(effect, place, robot):
        return Fault(
            ("axis",), "a place that this effect cannot have", _places(effect, place, robot)
        )
    return PlacedEffect(effect, place)


def _family_member(name: str) -> Effect | Fault:
    """A member of the family of this name, of the dictionary or of an installed package."""
    shipped = {family[0].name: family[0] for family in EFFECTS}
    if name in shipped:
        return shipped[name]
    try:
        installed = {own: one.family[0] for own, one in installed_families().items()}
    except EffectRefused as error:
        return Fault(("name",), str(error), "packages with effects that can be used")
    if name in installed:
        return installed[name]
    names = ", ".join((*shipped, *installed))
    return Fault(("name",), f"{name!r}, and there is no such effect", f"one of {names}")


def _places(effect: Effect, place: int, robot: Robot) -> str:
    """Describe where an effect that is elsewhere can be."""
    if effect.with_motor != (place < robot.axis_count):
        if effect.with_motor:
            return "an axis: it acts on a motor"
        return "a joint of a closed chain without a motor"
    if not effect.has_axis:
        return "the first axis: it acts on all motors alike"
    if effect.side is GearSide.TWO_JOINTS:
        return (
            "the pair the other way: on the axis of the lower number, with `other_axis` the higher"
        )
    return "an axis that is revolute"
