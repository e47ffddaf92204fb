"""The real UR10: a base that is declared leaning by some degrees is named, and no joint is blamed
for it; its filtered currents are named, and the calibration predicts with the filter.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import model_of
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.log.importing import import_recording
from daq.workflow.fit import calibration_of, close_loop, fit
from daq.workflow.validate import cross_validate
from ident.discovery.evidence import gather
from ident.discovery.geometry_check import check_geometry
from ident.effects.geometry_corrections import GravityDirection
from ident.equations.instants import read_instants
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.estimators.turned_geometry import find_turned_geometry, with_gravity
from tests.studies.real_runs import ur10

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("tilt_deg", [5.0, 9.0])
def test_a_leaning_base_is_named_and_no_zero(shared_data: Path, tilt_deg: float) -> None:
    """A zero of the first joint that is off by 97° was named, and nothing else judged."""
    recording = ur10(shared_data)
    cell = recording.cell
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    right = model_of(cell)
    angle = np.deg2rad(tilt_deg)
    declared = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    leaning = with_gravity(right, declared)
    instants = read_instants(leaning, recording.runs, cell.conditioning)
    assert find_turned_geometry(leaning, instants, gains) is None
    found = identify(
        leaning, recording.runs, cell.conditioning, method=Method.ML, fixed_gains=gains, judge=False
    )
    (mistake,) = check_geometry(gather(found, recording.runs), np.random.default_rng(0)).mistakes
    assert isinstance(mistake.effect, GravityDirection)
    turn_deg = np.rad2deg(np.linalg.norm(mistake.coefficients))
    assert turn_deg == pytest.approx(tilt_deg, abs=1.0)


def test_filtered_currents_are_named_and_predicted_with(shared_data: Path, tmp_path: Path) -> None:
    bag = "ur10_exciting_trajectory.db3"
    description = tmp_path / "ur10.yaml"
    document = {
        "name": "ur10",
        "cell": str(shared_data / "ur10/ur10-cell.yaml"),
        "position": {"file": bag, "columns": ["position"], "unit": "rad", "side": "joint"},
        "current": {"file": bag, "columns": ["effort"], "unit": "Nm"},
        "time": {"file": bag, "column": "header.stamp", "unit": "ns"},
        "holdout": {"from_s": 16.512},
    }
    description.write_text(json.dumps(document), encoding="utf-8")
    log = tmp_path / "fit.mcap"
    unseen = tmp_path / "held-out.mcap"
    import_recording(description, shared_data / "ur10", log, software="test", holdout=unseen)
    fitted = fit([log], holdout=[unseen], gains_fixed=True, keep_rows=True, judge_holdout=False)
    assert fitted.current_filter is not None
    assert fitted.current_filter.cutoff_hz == pytest.approx(1.74, abs=0.1)
    assert "currents-filtered" in {one.name for one in fitted.diagnoses}
    closed = close_loop(fitted, 0)
    made = calibration_of(closed, datetime(2026, 1, 1, tzinfo=UTC))
    path = tmp_path / "calibration.yaml"
    save_calibration(made, path)
    read = load_calibration(path)
    assert read.conditioning == closed.identification.conditioning
    error = closed.final.holdout_error
    assert error is not None
    assert error.total < 3.2
    checked = cross_validate({"own": read}, [unseen])
    (validation,) = checked.validations
    assert validation.error.total == pytest.approx(error.total, rel=0.05)
