"""The certificate of a calibration that a session has made:
first before its decision, and again after it.

The page needs the fit for its details, and a command that goes on with a session does not have it
any more. So they are kept in a file next to the page, and the page is made again from calibration,
audit log and this file.
"""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.errors import writing
from daq.files import read_regular, replace_file
from daq.jobs.session import CALIBRATION, REPORT
from daq.report.certificate import Certificate, Origin, certify
from daq.report.certificate_page import certificate_page
from daq.report.comparison import Comparison, compare
from daq.report.residual_page import PAGE, PageDetails, page_details, save_report
from daq.workflow.fit import Fit
from daq.writeback.request import Request
from ident.calibration import Calibration
from ident.discovery.before_after import Account

DETAILS = "details.json"  #: Next to the page
LARGEST_BYTES = 64 << 20  #: Of the details; drawings of a long session take a few megabytes


def save_certificate(
    cell_file: Path,
    cell: Cell,
    fitted: Fit,
    changed: Account,
    calibration: Calibration,
    folder: Path,
) -> Certificate:
    """Write the page of a session, with the gains compared with the current ones.

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
    session = folder.parent
    comparison = _compared(cell_file, cell, calibration, session, datetime.now(UTC))
    details = page_details(fitted, changed, calibration)
    with writing(folder / DETAILS):
        replace_file(folder / DETAILS, details.model_dump_json().encode())
    save_report(fitted, changed, calibration, folder, comparison, session=session.name)
    return certify(calibration, comparison)


def renew_certificate(
    cell_file: Path, cell: Cell, calibration: Calibration, session: Path, now: datetime
) -> Certificate:
    """Write the page of a session again, with what the audit log says by now.

    Args:
        cell_file: for the command that the page shows.
        cell: of the session.
        calibration: of the session.
        session: its folder.
        now: wall clock.

    Raises:
        OutputFailed: the file system refuses.
    """
    comparison = _compared(cell_file, cell, calibration, session, now)
    certificate = certify(calibration, comparison, origin=Origin.of(calibration, session.name))
    report = session / REPORT
    details = read_details(report / DETAILS)
    page = certificate_page(certificate, details.consequence, details.sections)
    with writing(report / PAGE):
        replace_file(report / PAGE, page.encode())
    return certificate


def read_details(path: Path) -> PageDetails:
    """Return the details of a page; none where their file is missing or cannot be read."""
    try:
        return PageDetails.model_validate_json(read_regular(path, LARGEST_BYTES))
    except (OSError, ValueError):
        return PageDetails(consequence="", sections=())


def _compared(
    cell_file: Path, cell: Cell, calibration: Calibration, session: Path, now: datetime
) -> Comparison:
    command = (
        f"drivegain apply {shlex.quote(str(cell_file))} {shlex.quote(str(session / CALIBRATION))}"
    )
    return compare(cell, Request(calibration, now), command)
