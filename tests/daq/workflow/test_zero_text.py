"""The words for a zero that is off: one number and one sign, by torque, by encoders,
and on the certificate.
"""

from __future__ import annotations

from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.report.gains import encoder_text
from daq.workflow.diagnoses import _correction_diagnosis, check_diagnoses
from daq.workflow.geometry_diagnoses import encoder_misfit_of, geometry_diagnoses
from daq.workflow.zero_text import zero_decimals, zero_off_text
from ident.discovery.geometry_check import GeometryCheck
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import ZeroOffset
from ident.estimators.geometry_estimate import GeometryEstimate, GeometryFinding
from ident.model.geometry import GeometryKind, GeometryParameter
from tests.ident.findings import passed_finding

DECLARED_TOO_LARGE_DEG = (2.0, -2.0)
STD_DEG = 0.04


def _by_torque(value_rad: float) -> Finding:
    """A finding by torques: the offset that has to be added to the position of the second axis."""
    return passed_finding(ZeroOffset(), 1, value_rad, radians(STD_DEG))


def _by_encoders(value_rad: float) -> GeometryFinding:
    """A finding by redundant encoders, of the second axis of a closed chain."""
    parameter = GeometryParameter(GeometryKind.ZERO, "crank-2")
    correction = GeometryEstimate(parameter, value_rad, radians(STD_DEG))
    covariance = np.array([[radians(STD_DEG) ** 2]])
    return GeometryFinding(4e-4, 6e-6, 5e-6, True, (correction,), covariance, (), ())


@pytest.mark.slow
@pytest.mark.parametrize("too_large_deg", DECLARED_TOO_LARGE_DEG)
def test_a_zero_has_one_sign_by_torque_by_encoders_and_on_the_certificate(
    checkout: Path, too_large_deg: float
) -> None:
    """A zero that is declared 2° too large is off by -2°,
    and the cell file is right with that added.
    """
    value_rad = -radians(too_large_deg)
    right_deg = 10.0
    said = f"{-too_large_deg:+.2f} ± 0.04° (to be added to its position)"
    typed = (
        f"add {-too_large_deg:+.2f} to `zero_offset_deg` of {{}} in the cell file, which makes it "
        f"{right_deg:.2f},"
    )

    serial = load_cell(checkout / "configs/cells/demo.yaml")
    zero_offset_rad = radians(right_deg + too_large_deg)
    declared = replace(serial.axes[1], zero_offset_rad=zero_offset_rad)
    axes = (serial.axes[0], declared, *serial.axes[2:])
    serial = replace(serial, axes=axes)
    mistakes = (_by_torque(value_rad),)
    check = GeometryCheck(gravity=None, mistakes=mistakes, hidden_zeros=())
    (by_torque,) = check_diagnoses(check, serial, model_of(serial))
    name = declared.name
    expected = f"the zero of {name} off by {said}"
    assert by_torque.found == expected
    assert by_torque.remedy.startswith(typed.format(name))

    closed = load_cell(checkout / "configs/cells/dualv.yaml")
    crank = replace(closed.axes[1], zero_offset_rad=radians(right_deg + too_large_deg))
    closed = replace(closed, axes=(closed.axes[0], crank, *closed.axes[2:]))
    finding = _by_encoders(value_rad)
    (by_encoders,) = geometry_diagnoses(finding, closed, applied=False)
    assert f"the zero of crank-2 off by {said}" in by_encoders.found
    assert by_encoders.remedy.startswith(typed.format("crank-2"))

    misfit = encoder_misfit_of(finding, closed, applied=False)
    assert misfit is not None
    assert f"the zero of crank-2 off by {said}" in encoder_text(misfit)


def test_a_zero_of_a_slide_is_in_millimetres() -> None:
    text = zero_off_text("J1", 3.0, 0.05, "mm")
    assert text == "the zero of J1 off by +3.00 ± 0.05 mm (to be added to its position)"


@pytest.mark.parametrize(
    ("std", "decimals"), [(0.4, 2), (0.04, 2), (0.004, 3), (0.0004, 4), (1e-7, 4), (0.0, 4)]
)
def test_a_zero_has_the_decimals_that_its_deviation_leaves(std: float, decimals: int) -> None:
    assert zero_decimals(std) == decimals


@pytest.mark.parametrize(("name", "is_serial"), [("demo", True), ("five-bar", False)])
def test_a_zero_of_a_serial_arm_may_be_a_length(
    checkout: Path, name: str, *, is_serial: bool
) -> None:
    """A closed chain has encoders that contradict a length; a serial arm has not."""
    cells_folder = checkout / "configs" / "cells"
    path = cells_folder / f"{name}.yaml"
    cell = load_cell(path)
    placed = PlacedEffect(ZeroOffset(), 1)
    deviations = np.array([0.001])
    said = _correction_diagnosis(placed, np.array([0.02]), deviations, cell, model_of(cell))
    assert said.name == "zero-off"
    assert ("measure the lengths of the links in the URDF" in said.remedy) == is_serial
