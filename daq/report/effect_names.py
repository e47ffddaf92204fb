"""Effects in a technician's words."""

from __future__ import annotations

from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import is_unnamed

WORDS = {
    "stribeck": "dry friction that changes at low speed",
    "nonlinear-viscous": "friction that does not grow in proportion to the speed",
    "asymmetric-viscous": "viscous friction that differs between the two directions",
    "load-friction": "friction that grows with the load",
    "spring": "a spring",
    "position-friction": "friction that changes with the position",
    "cogging": "torque ripple that repeats with the motor's turn",
    "ripple": "torque ripple that does not repeat with the motor's turn",
    "saturation": "a motor that gives less torque per ampere at large current",
    "lag": "a current that lags behind the position",
    "time-skew": "positions and currents that were not sampled at the same time",
    "warm-up": "friction that changes while the robot warms up",
    "temperature-friction": "friction that changes with the temperature",
    "presliding": "friction that builds up only some way after each reversal",
    "backlash": "free play in the gear",
    "elasticity": "a gear that gives under load",
    "efficiency": "a gear that loses a part of the power in both directions",
    "coupling": "friction shared with another joint",
    "inertial-coupling": "inertia shared with another joint",
    "hinge": "a cable or hose that pulls from some position on",
    "gravity-compensator": "a gravity compensator, or another torque that repeats with the joint",
}
"""Words by family; an effect that is not listed is called by its name."""


def effect_text(effect: Effect, axes: tuple[str, ...]) -> str:
    """Describe an effect, to follow "J3 has": `friction that grows with the load`."""
    if is_unnamed(effect):
        return f"a torque that depends on {variable_text(effect, axes)} and that no named effect explains"
    words = WORDS.get(effect.name, f"the effect {effect.name!r}")
    other = other_axis(effect)
    return words if other is None else words.replace("another joint", axes[other])


def variable_text(effect: Effect, axes: tuple[str, ...]) -> str:
    """Name the variable that an effect depends on, without its unit: `the joint position`."""
    other = other_axis(effect)
    if effect.abscissa is Abscissa.OTHER_VELOCITY and other is not None:
        return f"the velocity of {axes[other]}"
    return "the " + effect.abscissa.value.partition(" [")[0]


def other_axis(effect: Effect) -> int | None:
    """Index of the second axis of an effect on two axes."""
    number = effect.settings.get("other_axis", 0)
    return int(number) - 1 if number else None
