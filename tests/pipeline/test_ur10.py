"""The real UR10: a base that is declared leaning by some degrees is named,
and no joint is blamed for it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import model_of
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
