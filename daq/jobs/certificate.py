"""The certificate of a calibration that a session has made."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.jobs.session import CALIBRATION
from daq.report.certificate import Certificate, certify
from daq.report.comparison import compare
from daq.report.residual_page import save_report
from daq.workflow.fit import Fit
from daq.writeback.request import Request
from ident.calibration import Calibration
from ident.discovery.before_after import Account


def save_certificate(
    cell_file: Path, cell: Cell, fitted: Fit, changed: Account, calibration: Calibration, folder: Path
) -> Certificate:
    """Write the page of a session, with the gains beside the current ones.

    Args:
        cell_file: for the command that the page shows.
        cell: of the session.
        fitted: with all effects.
        changed: by the effects.
        calibration: of the fit.
        folder: of the page, in that of the session.

    Raises:
        OutputFailed: the file system refuses.
    """
    command = f"drivegain apply {shlex.quote(str(cell_file))} {shlex.quote(str(folder.parent / CALIBRATION))}"
    comparison = compare(cell, Request(calibration, datetime.now(UTC)), command)
    save_report(fitted, changed, calibration, folder, comparison, session=folder.parent.name)
    return certify(calibration, comparison)
