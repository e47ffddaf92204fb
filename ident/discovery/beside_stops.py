"""Rows that are clear of stops, on which friction must show, too.

A joint at rest holds any torque up to its dry friction, and a row counts although standstill fills a small share of its
filter window (`Conditioning.standstill_share`). On an arm with little noise, what rows beside stops hold of it is more
than noise, and looks like friction that builds up after a reversal. Friction that is really there acts in rows clear
of stops as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.discovery.candidates import SearchProblem, folds_around
from ident.effects.effect import Effect, Property
from ident.effects.signals import Abscissa
from ident.effects.unnamed import is_unnamed
from ident.equations.rows import row_masks
from ident.estimators.estimate import Estimate

CLEAR_SHARE = 0.05
"""Largest share of standstill in the filter window of a row that is clear of stops.

With 0.02 it silences the same clean cells, and leaves fewer rows (docs/evidence/effects-study.md)."""


def turns_with_motion(effect: Effect) -> bool:
    """Whether an effect could be taken for friction of joints at rest: its torque turns with the sense of motion."""
    if is_unnamed(effect):
        return effect.abscissa in {Abscissa.VELOCITY, Abscissa.DISTANCE}
    return effect.declares is Property.ODD_IN_VELOCITY


def clear_of_stops(search_problem: SearchProblem, estimate: Estimate) -> SearchProblem:
    """Linearise a problem around its estimate again, with those rows alone that are clear of stops.

    Args:
        search_problem: linearised around the estimate.
        estimate: by ``ml``.

    Raises:
        TooFewMoves: there are too few moves to leave some out.
    """
    rows = search_problem.observation
    conditioning = replace(rows.conditioning, standstill_share=min(CLEAR_SHARE, rows.conditioning.standstill_share))
    masks = [row_masks(search_problem.model, data, conditioning) for data in search_problem.datasets]
    of_joints = np.concatenate([of_joints for of_joints, _ in masks], axis=1)
    of_motors = np.concatenate([of_motors for _, of_motors in masks], axis=1)
    clear = replace(rows, use=rows.use & of_joints, motor_use=rows.motor_use & of_motors)
    folds, step = folds_around(search_problem.model, clear, estimate)
    return replace(search_problem, observation=clear, folds=folds, step=step)
