"""The folder that `drivegain residual --report` fills."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile

from daq.atomic_file import replace_file
from daq.cli.verb import json_text
from daq.errors import OutputExists, OutputFailed
from daq.fit import Fit
from daq.report.html import GENERATOR
from daq.report.residual_document import FORMAT, VERSION, residual_document
from daq.report.residual_page import residual_page
from ident.before_after import Account
from ident.calibration import Calibration

PAGE, DOCUMENT = "report.html", "residual.json"
_LOOK_BYTES = 4096
_OURS = ((PAGE, f'<meta name="generator" content="{GENERATOR}">'), (DOCUMENT, f'"format": "{FORMAT}"'))
"""What the beginning of either file says, so that an earlier report may be replaced and nothing else."""


def check_report(folder: Path | None) -> None:
    """Make the folder, before any long work, and refuse one in which something would be destroyed.

    Args:
        folder: None where no report is wanted.

    Raises:
        OutputExists: it holds a file of one of these names that is no earlier report.
        OutputFailed: it cannot be made, or nothing can be written into it.
    """
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    for name, mark in _OURS:
        path = folder / name
        if path.exists() and not (path.is_file() and mark.encode() in _head(path)):
            raise OutputExists(
                str(path),
                found="something that is no report of `drivegain residual`",
                expected="no such file, or that of an earlier report",
                remedy="choose another folder, or move it away",
            )


def save_report(fitted: Fit, account: Account, calibration: Calibration, folder: Path) -> None:
    """Both files, each whole or not at all.

    Args:
        fitted: with the turns of the loop.
        account: of them.
        calibration: with the accepted effects.
        folder: checked.

    Raises:
        OutputFailed: the file system refuses.
    """
    body = residual_document(fitted, account, calibration)
    document = json_text({"format": FORMAT, "version": VERSION, **body})
    try:
        replace_file(folder / PAGE, residual_page(fitted, account, calibration).encode())
        replace_file(folder / DOCUMENT, document.encode())
    except OSError as error:
        raise OutputFailed.of(folder, error) from error


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_LOOK_BYTES)
