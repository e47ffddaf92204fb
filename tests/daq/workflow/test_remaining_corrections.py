"""A calibration that corrects the description, beside a cell file that was corrected since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.config.cell import Cell, model_of
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.workflow.validate import not_corrected_since, on_cell, with_described
from ident.calibration import AcceptedEffect, Calibration, Parameter
from ident.effects.geometry_corrections import corrected_model, turn_between, turned_gravity
from ident.errors import Diagnosis
from ident.prediction import corrections_of
from tests.daq.calibrations import demo_calibration

ZERO_RAD = 0.03
TURN_RAD = (0.04, -0.02)
angles = st.floats(-0.3, 0.3)


def _calibration(*effects: AcceptedEffect) -> Calibration:
    return replace(demo_calibration(), effects=effects)


def _zero() -> AcceptedEffect:
    coefficients = (Parameter("zero-offset offset 2", ZERO_RAD, 1e-3, "rad"),)
    return AcceptedEffect(
        "zero-offset",
        "J2",
        {},
        coefficients,
        6.0,
        3.0,
    )


def _gravity() -> AcceptedEffect:
    turns = tuple(
        Parameter(f"gravity-direction turn {number} 1", turn, 1e-3, "rad")
        for number, turn in enumerate(TURN_RAD, start=1)
    )
    return AcceptedEffect("gravity-direction", "all axes", {}, turns, 6.0, 3.0)


def _with_zero(cell: Cell, offset_rad: float) -> Cell:
    axes = tuple(
        replace(axis, zero_offset_rad=axis.zero_offset_rad + offset_rad)
        if axis.name == "J2"
        else axis
        for axis in cell.axes
    )
    return replace(cell, axes=axes)


@pytest.mark.parametrize("corrected_rad", [0.0, 0.5 * ZERO_RAD, ZERO_RAD, -0.01])
def test_of_a_zero_the_difference_to_the_cell_is_left(cell: Cell, corrected_rad: float) -> None:
    calibration = _calibration(_zero())
    known = with_described(calibration, cell)
    left, _ = on_cell(known, _with_zero(cell, corrected_rad))
    coefficient = left.effects[0].coefficients[0].value
    assert coefficient == pytest.approx(ZERO_RAD - corrected_rad, abs=1e-12)


ZERO_OFF = Diagnosis(
    "zero-off", (), ("J2",), "the zero of J2 off", "that of the URDF", "correct it"
)
OTHER_ZERO = replace(ZERO_OFF, axes=("J3",))
TILTED = Diagnosis("gravity-tilted", (), (), "gravity turned", "the cell file's", "correct it")


@pytest.mark.parametrize(
    ("corrected_rad", "left"),
    [
        (0.0, (ZERO_OFF, OTHER_ZERO)),
        (0.5 * ZERO_RAD, (ZERO_OFF, OTHER_ZERO)),
        (ZERO_RAD, (OTHER_ZERO,)),
    ],
)
def test_a_zero_that_the_cell_file_has_right_since_is_not_named_again(
    cell: Cell, corrected_rad: float, left: tuple[Diagnosis, ...]
) -> None:
    calibration = _calibration(_zero())
    known = replace(with_described(calibration, cell), diagnoses=(ZERO_OFF, OTHER_ZERO))
    assert not_corrected_since(known, _with_zero(cell, corrected_rad)) == left


def test_a_mounting_that_the_cell_file_has_right_since_is_not_named_again(cell: Cell) -> None:
    calibration = _calibration(_gravity())
    known = replace(with_described(calibration, cell), diagnoses=(TILTED,))
    assert not_corrected_since(known, cell) == (TILTED,)
    declared_m_s2 = model_of(cell).robot.gravity_m_s2
    found = turned_gravity(declared_m_s2, TURN_RAD)
    changed_cell = replace(cell, gravity_m_s2=tuple(found))
    assert not_corrected_since(known, changed_cell) == ()


def test_of_gravity_the_turn_from_the_cell_is_left(cell: Cell) -> None:
    calibration = _calibration(_gravity())
    known = with_described(calibration, cell)
    declared = model_of(cell).robot.gravity_m_s2
    found = turned_gravity(declared, TURN_RAD)
    turn_rad = [0.5 * turn for turn in TURN_RAD]
    half = turned_gravity(declared, turn_rad)
    for now in (declared, half, found):
        changed = replace(cell, gravity_m_s2=tuple(now))
        left, model = on_cell(known, changed)
        predicting = corrected_model(model, corrections_of(left))
        assert predicting.robot.gravity_m_s2 == pytest.approx(found, abs=1e-9)


def test_a_calibration_of_before_corrects_as_a_whole(cell: Cell) -> None:
    """It does not say how the number was described;
    `validate`, `weigh` and `contact` warn of it.
    """
    calibration = _calibration(_zero())
    left, _ = on_cell(calibration, _with_zero(cell, ZERO_RAD))
    coefficients = left.effects[0].coefficients
    assert coefficients[0].value == ZERO_RAD


def test_what_was_described_is_kept_in_the_file(cell: Cell) -> None:
    calibration = _calibration(_zero(), _gravity())
    known = with_described(calibration, cell)
    read = decode_calibration(encode_calibration(known), "calibration.yaml")
    expected = [one.described for one in known.effects]
    assert [one.described for one in read.effects] == expected
    described = known.effects[0].described
    assert described == (cell.axes[1].zero_offset_rad,)


@given(angles, angles, angles, angles)
def test_a_turn_between_two_directions_leads_from_one_to_the_other(
    a: float, b: float, c: float, d: float
) -> None:
    down = np.array([0.0, 0.0, -9.81])
    one = turned_gravity(down, (a, b))
    other = turned_gravity(down, (c, d))
    turn = turn_between(one, other)
    assert turned_gravity(one, turn.tolist()) == pytest.approx(other, abs=1e-9)
