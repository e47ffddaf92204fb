"""Rows that are clear of stops, on which friction must show, too.

A joint at rest holds any torque up to its dry friction, and a row counts although standstill fills
a small share of its filter window (`Conditioning.standstill_share`). On an arm with little noise,
what rows beside stops hold of it is more than noise, and looks like friction that builds up after a
reversal. Friction that is really there acts in rows clear of stops as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.discovery.evidence import Evidence
from ident.effects.effect import Effect, Property
from ident.effects.signals import Abscissa
from ident.effects.unnamed import is_unnamed
from ident.equations.observation import Observation
from ident.equations.rows import row_masks
from ident.estimators.estimate import Estimate
from ident.estimators.identify import estimate_with

CLEAR_SHARE = 0.5
"""Largest share of standstill in the window of a row that is clear of stops,
in parts of what the cell allows.
"""


def turns_with_motion(effect: Effect) -> bool:
    """Whether an effect's torque turns with the motion, as friction of joints at rest seems to."""
    if is_unnamed(effect):
        return effect.abscissa in {Abscissa.VELOCITY, Abscissa.DISTANCE}
    return effect.declares is Property.ODD_IN_VELOCITY


def rows_clear_of_stops(evidence: Evidence) -> Observation:
    """Rows of the fit, of which those alone count that are clear of stops."""
    rows = evidence.training
    allowed = evidence.conditioning.standstill_share
    conditioning = replace(evidence.conditioning, standstill_share=CLEAR_SHARE * allowed)
    masks = [row_masks(evidence.model, data, conditioning) for data in evidence.fit_runs]
    use = np.concatenate([of_joints for of_joints, _ in masks], axis=1)
    motor_use = np.concatenate([of_motors for _, of_motors in masks], axis=1)
    return replace(rows, use=rows.use & use, motor_use=rows.motor_use & motor_use)


def fitted_clear_of_stops(evidence: Evidence) -> Estimate:
    """Estimate the same model, effects included, from rows that are clear of stops.

    Raises:
        RankDeficient, NotConverged: these rows do not determine it.
    """
    system = rows_clear_of_stops(evidence).system()
    return estimate_with(evidence.estimate.method, system, evidence.estimate.fixed_gains)
