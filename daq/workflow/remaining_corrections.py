"""A calibration that corrects the description of a robot, beside a description that was corrected since.

A search corrects what the cell file says of zeros and of the mounting (`ident.effects.geometry_corrections`), and tells
the operator to correct the cell file. Once that is done, a calibration of before must not correct the same number
again: it keeps how the number was described, and what is left to correct is the difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from daq.config.cell import Cell, model_of
from daq.workflow.diagnoses import calibrated_model
from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration
from ident.effects.dictionary import GEOMETRY
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import GravityDirection, ZeroOffset, turn_between, turned_gravity
from ident.model.model import Model
from ident.prediction import placed_effect

CORRECTIONS = frozenset(family[0].name for family in GEOMETRY)  #: Names of effects that correct the description


def with_described(calibration: Calibration, cell: Cell) -> Calibration:
    """Keep with each correction how its fit found the number described.

    Args:
        calibration: of a fit.
        cell: that the fit was made with.
    """
    effects: list[AcceptedEffect] = []
    for accepted in calibration.effects:
        kept = accepted
        if accepted.name in CORRECTIONS:
            placed, _ = placed_effect(accepted, calibration)
            kept = replace(accepted, described=_described(placed, cell))
        effects.append(kept)
    return replace(calibration, effects=tuple(effects))


def on_cell(calibration: Calibration, cell: Cell) -> tuple[Calibration, Model]:
    """A calibration with the corrections that a cell still needs, and the model with which it predicts.

    Args:
        calibration: of the cell, at any date.
        cell: as it is described now.

    Raises:
        EffectRefused: the calibration holds an effect that does not exist.
        ModelError: the robot is described otherwise than at the fit.
    """
    effects = tuple(_remaining(accepted, calibration, cell) for accepted in calibration.effects)
    return replace(calibration, effects=effects), calibrated_model(calibration, cell)


def _remaining(accepted: AcceptedEffect, calibration: Calibration, cell: Cell) -> AcceptedEffect:
    """An effect with what is left of it to correct."""
    if accepted.described is None:
        return accepted
    placed, values = placed_effect(accepted, calibration)
    now = _described(placed, cell)
    if now is None or now == accepted.described:
        return accepted
    then = np.array(accepted.described)
    match placed.effect:
        case ZeroOffset():
            left = values - (np.array(now) - then)
        case GravityDirection():
            left = turn_between(np.array(now), turned_gravity(then, values.tolist()))
        case _:
            return accepted
    by_name = dict(zip((column.name for column in placed.columns), left, strict=True))
    coefficients = tuple(replace(one, value=float(by_name[one.name])) for one in accepted.coefficients)
    return replace(accepted, coefficients=coefficients)


def _described(placed: PlacedEffect, cell: Cell) -> tuple[float, ...] | None:
    """The number that a correction corrects, as a cell describes it; None of a correction of recordings."""
    match placed.effect:
        case ZeroOffset():
            return (float(cell.axes[placed.axis].zero_offset_rad),)
        case GravityDirection():
            gravity: FloatArray = model_of(cell).robot.gravity_m_s2
            return tuple(float(one) for one in gravity)
        case _:
            return None
