"""Friction must show in rows that are clear of stops, where no joint at rest holds any of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.beside_stops import CLEAR_SHARE, rows_clear_of_stops, turns_with_motion
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.joining import refuted_clear_of_stops
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.electrical import Lag
from ident.effects.friction import Presliding, Stribeck
from ident.effects.position import Spring
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth
from ident.equations.rows import row_masks
from tests.ident.recordings import Truth, search_problem_of, with_current

FloatArray = NDArray[np.float64]
AXIS = 1
AMOUNT_NM = 6.0
PLACED = PlacedEffect(Presliding(0.04), AXIS)


def _clear_rows(evidence: Evidence) -> NDArray[np.bool_]:
    """Rows of each joint that hold no more standstill than a row that is clear of stops, shape (n,
    r).
    """
    allowed = evidence.conditioning.standstill_share
    standstill_share = CLEAR_SHARE * allowed
    strict = replace(evidence.conditioning, standstill_share=standstill_share)
    masks = [row_masks(evidence.model, data, strict)[0] for data in evidence.datasets]
    return np.concatenate(masks, axis=1)


def _torque_of_presliding(evidence: Evidence) -> FloatArray:
    """Torque of AMOUNT_NM of it on the rows, shape (r,)."""
    column = search_problem_of(evidence).torque(PLACED.effect, AXIS)
    return np.asarray(AMOUNT_NM * column[AXIS, 0])


def _refuted(small: Evidence, truth: Truth, torque_nm: FloatArray) -> str:
    """What the gate says of presliding that is fitted to runs with this torque on the joint."""
    of_joints = np.zeros((len(truth.gains), len(torque_nm)))
    of_joints[AXIS] = torque_nm
    to_motor = truth.model.drive_train.to_motor
    added_a = to_motor @ of_joints / truth.gains[:, None]
    joined = with_effects(with_current(small, added_a), (PLACED,))
    return refuted_clear_of_stops(joined, PLACED)


@pytest.mark.slow
def test_presliding_that_acts_in_all_rows_joins(small: Evidence, small_truth: Truth) -> None:
    assert not _refuted(small, small_truth, _torque_of_presliding(small))


def test_what_only_rows_beside_stops_hold_is_refused(small: Evidence, small_truth: Truth) -> None:
    beside = small.training.use[AXIS] & ~_clear_rows(small)[AXIS]
    assert 20 < beside.sum() < 0.2 * small.training.use[AXIS].sum()
    torque_nm = np.where(beside, _torque_of_presliding(small), 0.0)
    assert "in rows that are clear of stops, " in _refuted(small, small_truth, torque_nm)


def test_rows_that_are_clear_are_those_of_a_smaller_share_of_standstill(small: Evidence) -> None:
    clear = rows_clear_of_stops(small)
    assert np.array_equal(clear.use, small.training.use & _clear_rows(small))
    assert clear.use.sum() < small.training.use.sum()
    assert clear.motor_use.sum() < small.training.motor_use.sum()


@pytest.mark.parametrize(
    ("effect", "is_asked"),
    [
        (Presliding(0.04), True),
        (Stribeck(0.2), True),
        (Smooth(Abscissa.VELOCITY), True),
        (Smooth(Abscissa.POSITION), False),
        (Spring(), False),
        (Lag(), False),
    ],
)
def test_only_what_turns_with_the_motion_could_be_friction_at_rest(
    effect: Effect, is_asked: bool
) -> None:
    assert turns_with_motion(effect) is is_asked
