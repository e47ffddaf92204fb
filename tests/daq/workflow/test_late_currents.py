"""What a technician reads of currents that are late: each cause has a remedy of its own."""

from __future__ import annotations

import numpy as np
import pytest

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.workflow.diagnoses import check_diagnoses, hidden_zeros_text, vector_text
from ident.discovery.geometry_check import GeometryCheck
from ident.discovery.search import Finding
from ident.effects.effect import Effect
from ident.effects.electrical import Lag, TimeSkew
from ident.effects.geometry_corrections import LatePosition
from tests.ident.findings import passed_finding
from tests.ident.recordings import gantry_truth


@pytest.fixture(scope="module")
def tx40_cell() -> Cell:
    path = shipped_configurations() / "cells" / "tx40.yaml"
    return load_cell(path)


def _finding(effect: Effect, axis: int, seconds: float) -> Finding:
    return passed_finding(effect, axis, seconds, 7e-5)


def _checked(*found: Finding) -> GeometryCheck:
    return GeometryCheck(gravity=None, mistakes=found, hidden_zeros=())


def test_a_time_skew_asks_for_the_stamps_and_for_no_encoder(tx40_cell: Cell) -> None:
    check = _checked(_finding(TimeSkew(), 0, 0.003))
    (one,) = check_diagnoses(check, tx40_cell, model_of(tx40_cell))
    assert (one.name, one.axes) == ("time-skew", ())
    assert one.found == (
        "all currents late by 3.00 ± 0.07 ms relative to the positions, the same on every axis"
    )
    assert "how positions and currents are stamped" in one.remedy
    assert "no single encoder or drive is late" in one.remedy


def test_an_early_skew_is_said_to_be_early(tx40_cell: Cell) -> None:
    effect = TimeSkew(backwards=1)
    check = _checked(_finding(effect, 0, -0.003))
    (one,) = check_diagnoses(check, tx40_cell, model_of(tx40_cell))
    assert "all currents early by 3.00 ± 0.07 ms" in one.found


def test_each_late_current_is_named_on_its_axis(tx40_cell: Cell) -> None:
    effect = Lag(filter_s=0.0015)
    first = _finding(effect, 0, 0.003)
    lag = Lag(filter_s=0.0015)
    second = _finding(lag, 1, 0.003)
    check = _checked(first, second)
    diagnoses = check_diagnoses(check, tx40_cell, model_of(tx40_cell))
    expected = [
        ("current-late", tx40_cell.axis_names[:1]),
        ("current-late", tx40_cell.axis_names[1:2]),
    ]
    assert [(one.name, one.axes) for one in diagnoses] == expected
    for one in diagnoses:
        assert one.found == f"the current of {one.axes[0]} late by 3.00 ± 0.07 ms"
        assert "what delays this current alone" in one.remedy
        assert "encoder" not in one.remedy


def test_a_late_encoder_asks_for_the_encoder(tx40_cell: Cell) -> None:
    check = _checked(_finding(LatePosition(), 2, 0.003))
    (one,) = check_diagnoses(check, tx40_cell, model_of(tx40_cell))
    assert one.name == "position-late"
    assert "what delays this encoder alone" in one.remedy


def test_a_direction_of_gravity_is_written_as_finely_as_it_is_known() -> None:
    """A hundredth of a degree is 0.0017 m/s²."""
    vector = np.array([-0.0001, 9.81 * np.sin(np.radians(0.01)), -9.81])
    turned = vector_text(vector)
    assert turned == "[0.000, 0.002, -9.810]"


def test_the_zero_of_a_slide_that_shifts_the_whole_arm_is_hidden_by_symmetry() -> None:
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=(0, 1))
    axes = ("X", "Y", "Z", "A")
    robot = gantry_truth().model.robot
    said = hidden_zeros_text(check, axes, robot)
    why = "another one turns or shifts the whole arm, and no torque depends on that"
    assert said == f"Zeros that are not seen here: of X, Y: {why}."


def test_two_zeros_that_are_seen_one_by_one_only_are_named_together(tx40_cell: Cell) -> None:
    hidden_pairs = ((1, 2), (2, 4))
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=(), hidden_pairs=hidden_pairs)
    robot = model_of(tx40_cell).robot
    said = hidden_zeros_text(check, tx40_cell.axis_names, robot)
    assert said.startswith("Not seen here where both zeros are off, one against the other")
    assert said.endswith("J2 with J3, J3 with J5.")
