"""A calibration of a real robot, shared by the tests of what uses one."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.documents.calibration_file import save_calibration
from daq.log.importing import import_recording
from daq.workflow.fit import calibration_of, fit


@pytest.fixture(scope="session")
def real(
    checkout: Path, shared_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A calibration file of the real TX-40 with its gains fixed, and the log that it rests on."""
    folder = tmp_path_factory.mktemp("tx40")
    log = folder / "tx40.mcap"
    file = folder / "calibration.yaml"
    description = checkout / "configs/imports/tx40.yaml"
    import_recording(description, shared_data / "tx40", log, software="test")
    fitted = fit([log], gains_fixed=True)
    created = datetime(2025, 1, 2, tzinfo=UTC)
    save_calibration(calibration_of(fitted, created), file)
    return file, log
