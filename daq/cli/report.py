"""`drivegain report`: the certificate of a calibration as one page."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import check_folder, check_replaceable, print_view, replace_output
from daq.cli.verb import CalibrationArgument, JsonOption, Verb, output_option, print_json
from daq.files import replace_file


def report_verb(
    calibration: CalibrationArgument,
    out: Annotated[
        Path | None,
        output_option("--out", "Page to write; by default beside the calibration, as .html."),
    ] = None,
    cell: Annotated[
        Path | None, typer.Option("--cell", help="Cell file: compare with the gains in its controller.")
    ] = None,
    beside: Annotated[Path | None, typer.Option("--beside", help="Earlier calibration to compare with.")] = None,
    json: JsonOption = False,
) -> None:
    """Write the certificate of a calibration: one page for screen, phone and paper, without network or script.

    It shows each gain beside the one in the controller with the limits, the error on held-out runs, the effects, what
    would be written where, and one verdict. Nothing is written to the controller.
    """

    from daq.config.cell_file import load_cell
    from daq.documents.calibration_file import decode_calibration, load_calibration, read_calibration_bytes
    from daq.report.certificate import certificate_report, certify, compare, without_controller
    from daq.report.certificate_page import certificate_page
    from daq.report.html import MARK
    from daq.writeback.request import Request

    page = out or calibration.with_suffix(".html")
    check_folder(page)
    check_replaceable(page, MARK, "page of drivegain")
    content = read_calibration_bytes(calibration)
    fitted = decode_calibration(content, str(calibration))
    earlier = None if beside is None else load_calibration(beside)
    request = Request(fitted, datetime.now(UTC), file=calibration, content=content)
    if cell is None:
        unread = "The controller was not read; add --cell CELL to compare with its gains and the limits of the cell."
        comparison = without_controller(fitted, unread, request.now)
    else:
        command = f"drivegain apply {shlex.quote(str(cell))} {shlex.quote(str(calibration))}"
        comparison = compare(load_cell(cell), request, command)
    certificate = certify(fitted, comparison, earlier)
    with replace_output(page):
        replace_file(page, certificate_page(certificate).encode())
    if json:
        print_json(certificate_report(certificate))
    else:
        print_view((certificate.sentence,), page)


REPORT = Verb("report", report_verb, "drivegain report calibration.yaml --cell CELL")
