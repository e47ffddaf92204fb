"""`drivegain certificate`, once called `report`: the certificate of a calibration as one page."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import check_folder, check_page, check_replaceable, print_view, write_file
from daq.cli.verb import (
    CalibrationArgument,
    JsonOption,
    output_option,
    print_json,
    read_calibration,
    read_cell,
)
from daq.files import sha256


def certificate_verb(
    calibration: CalibrationArgument,
    out: Annotated[
        Path | None,
        output_option("--out", "Page to write; by default next to the calibration, as .html."),
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option("--cell", help="Cell file: compare with the gains in its controller."),
    ] = None,
    beside: Annotated[
        Path | None, typer.Option("--beside", help="Earlier calibration to compare with.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write the certificate of a calibration:
    one page for screen, phone and paper, without network or script.

    It shows one verdict, each gain with the current gain and the limits, the error on held-out
    runs, the effects, what would be written or was written where, and a line to sign. Nothing is
    written to the controller. The earlier name of this verb, `report`, goes on working.
    """

    from daq.documents.calibration_file import decode_calibration, read_calibration_bytes
    from daq.jobs.session import session_of
    from daq.report.certificate import Origin, certificate_report, certify, status_text
    from daq.report.certificate_page import certificate_page
    from daq.report.comparison import compare, without_controller
    from daq.report.html import MARK
    from daq.report.text import terminal_text
    from daq.writeback.request import Request

    page = out or calibration.with_suffix(".html")
    check_page(page, "--out")
    check_folder(page)
    check_replaceable(page, MARK, "page of drivegain")
    content = read_calibration_bytes(calibration)
    fitted = decode_calibration(content, str(calibration))
    earlier = None if beside is None else read_calibration(beside)
    request = Request(fitted, datetime.now(UTC), file=calibration, content=content)
    digest = sha256(content)
    if cell is None:
        unread = (
            "The controller was not read; add --cell CELL to compare with its gains and the "
            "limits of the cell."
        )
        comparison = without_controller(fitted, unread, request.now)
    else:
        command = f"drivegain apply {shlex.quote(str(cell))} {shlex.quote(str(calibration))}"
        comparison = compare(read_cell(cell), request, command)
    certificate = certify(
        fitted, comparison, earlier, Origin(digest, session_of(calibration, digest))
    )
    write_file(page, certificate_page(certificate))
    if json:
        print_json(certificate_report(certificate))
    else:
        status = f"Certificate {certificate.origin.id}, {status_text(comparison)}."
        print_view((terminal_text(certificate.sentence), terminal_text(status)), page)
