"""`drivegain validate`, `weigh` and `contact`:
what a calibration says of logs that its fit has not seen.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.next_step import say_after_calibration
from daq.cli.terminal import check_output, print_view, replace_output, status
from daq.cli.verb import (
    CalibrationArgument,
    CellOption,
    JsonOption,
    corrected_cell,
    output_option,
    print_json,
    read_calibration,
)
from daq.errors import CalibrationMissing
from daq.files import replace_file

if TYPE_CHECKING:
    from ident.calibration import Calibration

TABLES = "drivegain-validation-tables"  #: Format of the page of tables


def validate_verb(
    calibration: CalibrationArgument,
    logs: Annotated[list[Path], typer.Argument(help="Logs of the same cell.")],
    pictures: Annotated[
        Path | None, output_option("--pictures", "Folder for pictures of the torques.")
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(help="Another calibration, or a folder of them (`fit --cases`); repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        output_option(
            "--out", "Folder for tables.md: the same in the form of the paper's Tables 5 to 8."
        ),
    ] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Predict the torque of runs with a calibration and weigh their payload with its gains.

    Prints the relative error of each axis, the condition number of each run, and the payload mass
    that the gains give; with --beside every calibration side by side. With unloaded logs among the
    others, the payload mass does not depend on the calibration's robot parameters.
    """
    from daq.report.paper_tables import paper_page
    from daq.report.validation import (
        draw_validations,
        validate_report,
        validation_tables,
        validation_view,
    )
    from daq.workflow.validate import cross_validate

    page_file = None if out is None else out / "tables.md"
    check_output(page_file, (calibration, *logs), TABLES)
    drawn: dict[Path, Path] = {}
    with status("predicting"):
        calibrations = load_beside(calibration, beside or [])
        known = next(iter(calibrations.values()))
        found = cross_validate(calibrations, logs, corrected_cell(cell))
        if pictures is not None:
            with replace_output(pictures):
                drawn = draw_validations(known, found.validations, pictures)
    if page_file is not None:
        tables = validation_tables(found, complete=True)
        with replace_output(page_file):
            page_file.parent.mkdir(parents=True, exist_ok=True)
            replace_file(
                page_file, paper_page(f"Validation of {known.cell}", tables, marker=TABLES).encode()
            )
    if json:
        print_json(validate_report(known, found, drawn))
    else:
        print_view(validation_view(known, found), *drawn.values(), page_file)
        say_after_calibration(known, calibration, logs, cell, found.diagnoses)


def load_beside(calibration: Path, beside: list[Path]) -> dict[str, Calibration]:
    """Load calibrations by label, the one to validate first;
    a file that is named twice counts once.
    """

    files = [calibration]
    for place in beside:
        if place.is_dir():
            found = sorted(place.glob("*.yaml"))
        else:
            found = [place]
        if not found:
            raise CalibrationMissing(
                str(place),
                found="no .yaml file in it",
                expected="calibrations written by `drivegain fit --cases`",
                remedy="name another folder",
            )
        known = {os.path.realpath(file) for file in files}
        files += [file for file in found if os.path.realpath(file) not in known]
    stems = Counter(file.stem for file in files)
    return {
        file.stem if stems[file.stem] == 1 else str(file): read_calibration(file) for file in files
    }


def weigh_verb(
    calibration: CalibrationArgument,
    logs: Annotated[list[Path], typer.Argument(help="Logs with the body, mounted one way.")],
    bare: Annotated[
        list[Path] | None,
        typer.Option("--bare", help="Log of the same robot without load; repeatable."),
    ] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Weigh the body on the flange: mass, centre of mass and inertia, each with its σ.

    The effects of the calibration are in the model. Without --bare the robot is the calibration's,
    except the friction of its joints; with --bare it is found again together with the body, which
    takes more moves and trusts the calibration's gains alone. Says which of the ten parameters
    these moves identify, and which moves would help.
    """
    from daq.report.weighing_views import weigh_report, weighed_view
    from daq.workflow.weigh import weigh_logs

    with status("weighing"):
        found = weigh_logs(
            read_calibration(calibration), logs, bare=bare or (), cell=corrected_cell(cell)
        )
    if json:
        print_json(weigh_report(found))
    else:
        print_view(weighed_view(found))


def contact_verb(
    calibration: CalibrationArgument,
    log: Annotated[Path, typer.Argument(help="Log to examine.")],
    quiet: Annotated[
        list[Path] | None,
        typer.Option("--quiet", help="Log of such motion without contact; repeatable."),
    ] = None,
    pictures: Annotated[
        Path | None, output_option("--pictures", "Folder for a picture of the torques.")
    ] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Compute the external torque of each axis, its prediction band, and a threshold for contact.

    The threshold gives on average less than one false alarm in an hour of motion, extrapolated from
    the quiet logs, or, without any, from the quiet part of the log itself; five quiet minutes or
    more are needed. A payload must be one that the calibration knows.
    """
    from daq.report.weighing_views import contact_report, contact_view, draw_contact
    from daq.workflow.weigh import contact_in

    picture = None
    with status("predicting"):
        known = read_calibration(calibration)
        found, described = contact_in(known, log, quiet=quiet or (), cell=corrected_cell(cell))
        if pictures is not None:
            with replace_output(pictures):
                pictures.mkdir(parents=True, exist_ok=True)
                picture = draw_contact(found, described, log, pictures)
    if json:
        print_json(contact_report(found, described, log, picture))
    else:
        print_view(contact_view(found, described), picture)
