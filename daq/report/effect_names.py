"""Effects in a technician's words, with their sizes; a term without a name as its curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.report.gains import with_deviation
from daq.report.text import SHOWN_SIGMAS
from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration, Parameter
from ident.effects.effect import Effect, PlacedEffect, Reported, is_shipped
from ident.effects.signals import Abscissa
from ident.effects.unnamed import FOLDED, Periodic, Smooth, is_unnamed
from ident.errors import EffectRefused
from ident.prediction import placed_effect

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
    "offset-drift": "an offset of the current that drifts",
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
    "hinge": "a cable or hose that pulls beyond some position",
    "cable": "a cable or hose that is shared with another joint",
    "slack-cable": "a cable or hose that is shared with another joint, and slack in a part of the "
    "workspace",
    "gravity-compensator": "a gravity compensator, or another torque that repeats with the joint",
    "counterbalance": "a balancer between two links",
    "passive-friction": "friction in a joint without a motor",
    "passive-spring": "a spring in a joint without a motor",
    "zero-offset": "a zero that is off",
    "gravity-direction": "another direction of gravity than the cell file says",
    "late-position": "a position that is later than the others",
}
"""Words by family; an effect that is not listed has its own (`Effect.phrase`),
or is called by its name.
"""

_WHERE = {
    "stribeck": "below about {speed_rad_s:.2g} rad/s",
    "nonlinear-viscous": "with the speed to the power {exponent:.2g}",
    "cogging": "{order:g} times in a turn of the motor",
    "ripple": "{order:.4g} times in a turn",
    "warm-up": "within about {time_constant_s:.2g} s",
    "offset-drift": "within about {time_constant_s:.2g} s",
    "presliding": "within about {distance_rad:.2g} rad",
    "hinge": "from a position of {start_rad:.2g} rad on",
    "gravity-compensator": "{order:g} times in a turn of the joint",
    "zero-offset": "to be added to its position",
    "counterbalance": "with a lever of {ratio:.2g} of its foot's distance",
}
"""Where or how fast an effect acts, by family, from its searched parameters;
other families need no such words.
"""
_POINTS = 61


@dataclass(frozen=True, slots=True)
class Curve:
    """Torque of a term without a name over its variable."""

    x: FloatArray  #: variable, of a velocity its magnitude, shape (k,)
    torque_nm: FloatArray  #: torque that the term adds in the positive direction, shape (k,)
    #: two σ of it, shape (k,); None where the calibration has no covariance
    half_nm: FloatArray | None
    variable: str  #: name of the variable with its unit
    force: str  #: unit of the torque: Nm, or N along a prismatic joint
    turns: bool  #: whether the torque turns with the direction of motion, as friction does

    @property
    def text(self) -> str:
        """Its range in words."""
        turns = ""
        if self.turns:
            turns = ", against the motion in either direction"
        return (
            f"between {self.torque_nm.min():+.2g} and {self.torque_nm.max():+.2g} "
            f"{self.force}{turns}"
        )


def effect_text(effect: Effect, axes: tuple[str, ...]) -> str:
    """Describe an effect, to follow "J3 has": `friction that grows with the load`."""
    if is_unnamed(effect):
        return (
            f"a torque that depends on {variable_text(effect, axes)} and that no named "
            "effect explains"
        )
    words = WORDS.get(effect.name) or effect.phrase or f"the effect {effect.name!r}"
    other = other_axis(effect)
    if other is None:
        return words
    return words.replace("another joint", axes[other])


def variable_text(effect: Effect, axes: tuple[str, ...]) -> str:
    """Name the variable that an effect depends on, without its unit: `the joint position`."""
    other = other_axis(effect)
    quantity = effect.abscissa.value.partition(" [")[0]
    if effect.abscissa.is_of_other_joint and other is not None:
        quantity = quantity.replace("the other joint", axes[other])
    return f"the {quantity}"


def variable_label(effect: Effect, axes: tuple[str, ...], force: str) -> str:
    """Name the variable with its unit, in N and metres where the joint's force is in N:
    `joint position [rad]`.
    """
    abscissa = effect.abscissa
    label = (
        f"{variable_text(effect, axes).removeprefix('the ')} [{abscissa.value.partition(' [')[2]}"
    )
    is_of_other_unit = abscissa in {Abscissa.MOTOR_ANGLE, Abscissa.CURRENT}
    if force != "N" or is_of_other_unit or abscissa.is_of_other_joint:
        return label
    return label.replace("rad", "m").replace("Nm", "N").replace("torque", "force")


def accepted_text(accepted: AcceptedEffect, calibration: Calibration) -> str:
    """Describe an effect of a calibration, to follow "J3 has"."""
    placed = _placed(accepted, calibration)
    if placed is None:
        return WORDS.get(accepted.name, f"the effect {accepted.name!r}")
    return effect_text(placed.effect, calibration.places)


def size_text(accepted: AcceptedEffect, calibration: Calibration) -> str:
    """Describe the size of an effect ± σ: `coefficient 12.0 ± 0.2 % of the load torque`;
    no searched parameter's name.

    An effect that this version cannot place has its coefficients alone.
    """
    placed = _placed(accepted, calibration)
    if placed is None:
        return ", ".join(
            _sized("coefficient", one, Reported.COEFFICIENTS) for one in accepted.coefficients
        )
    if (curve := curve_of(accepted, calibration)) is not None:
        return curve.text
    return named_size(placed.effect, _in_order(accepted, placed))


def named_size(effect: Effect, found: Sequence[Parameter]) -> str:
    """Describe the size of a named effect from its coefficients,
    in the order of `effect.coefficients`.
    """
    names = [column.name for column in effect.coefficients]
    where = _WHERE.get(effect.name, "").format(**effect.settings)
    if not is_shipped(effect):
        where = ", ".join(f"{name} {value:.4g}" for name, value in effect.settings.items())
    if effect.reported is Reported.AMPLITUDE:
        cosine, sine = found
        amplitude = math.hypot(cosine.value, sine.value)
        std = math.hypot(cosine.value * cosine.std, sine.value * sine.std) / (amplitude or 1.0)
        sizes = f"amplitude {with_deviation(amplitude, std)} {cosine.unit}"
    elif effect.fits_rotor:
        loss, rest = found
        # It follows its rest until this is small against σ: where that is large, the sum may be
        # below zero.
        inertia = max(0.0, effect.known_rotor_kg_m2 + rest.value / (loss.value or math.inf))
        std = rest.std / (abs(loss.value) or math.inf)
        rotor = f"with a rotor of {with_deviation(inertia, std)} kg m²"
        sizes = f"{_sized(names[0], loss, effect.reported)}, {rotor}"
    else:
        sizes = ", ".join(
            _sized(name, one, effect.reported) for name, one in zip(names, found, strict=True)
        )
    if where:
        return f"{sizes}, {where}"
    return sizes


def curve_of(accepted: AcceptedEffect, calibration: Calibration) -> Curve | None:
    """Return the curve of a term without a name; None for any other effect."""
    placed = _placed(accepted, calibration)
    if placed is None or not isinstance(placed.effect, Smooth | Periodic):
        return None
    effect = placed.effect
    if isinstance(effect, Smooth):
        lower = effect.lower
        upper = effect.upper
    else:
        lower = 0.0
        upper = 2.0 * math.pi
    x = np.linspace(lower, upper, _POINTS)
    shapes = effect.shapes(x)
    words = [column.name for column in placed.columns]
    index = {
        parameter.name: number
        for number, parameter in enumerate(calibration.parameters, len(calibration.gains))
    }
    half_nm = None
    if (covariance := calibration.covariance) is not None and all(name in index for name in words):
        rows = [index[name] for name in words]
        half_nm = SHOWN_SIGMAS * np.sqrt(
            np.einsum("pk,pq,qk->k", shapes, covariance[np.ix_(rows, rows)], shapes)
        )
    folded = isinstance(effect, Smooth) and effect.variable in FOLDED
    # Of a joint without a motor, which has no gain, a coefficient's unit begins with that of its
    # force.
    units = [gain.unit for gain in calibration.gains]
    if placed.axis < len(units):
        unit = units[placed.axis]
    else:
        unit = accepted.coefficients[0].unit
    force = unit.partition("/")[0]
    name, _, unit = variable_label(effect, calibration.places, force).partition(" [")
    name += ", magnitude" if folded else ""
    values = np.array([one.value for one in _in_order(accepted, placed)])
    return Curve(x, values @ shapes, half_nm, f"{name} [{unit}", force, bool(effect.signed))


def _placed(accepted: AcceptedEffect, calibration: Calibration) -> PlacedEffect | None:
    """Place an effect; None for one of another version, which a gate refuses."""
    try:
        return placed_effect(accepted, calibration)[0]
    except EffectRefused:
        return None


def _in_order(accepted: AcceptedEffect, placed: PlacedEffect) -> list[Parameter]:
    by_name = {one.name: one for one in accepted.coefficients}
    return [by_name[column.name] for column in placed.columns]


def _sized(name: str, one: Parameter, reported: Reported) -> str:
    # A zero of a prismatic joint is in metres
    if reported is Reported.ANGLES and one.unit == "rad":
        return f"{name} {with_deviation(math.degrees(one.value), math.degrees(one.std))}°"
    if reported is Reported.SHARE_OF_LOAD:
        return f"{with_deviation(100.0 * one.value, 100.0 * one.std)} % of the load torque"
    if reported is Reported.DELAY:
        return f"{with_deviation(1e3 * one.value, 1e3 * one.std)} ms"
    return f"{name} {with_deviation(one.value, one.std)} {one.unit}"


def other_axis(effect: Effect) -> int | None:
    """Index of the second axis of an effect on two axes."""
    number = effect.second_axis
    if number is None:
        return None
    return number - 1
