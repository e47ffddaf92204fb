"""`drivegain weigh` and `contact`: what hangs on the flange, and what pushes against the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import print_view, status, write_output
from daq.cli.verb import CalibrationArgument, CellOption, JsonOption, Verb, output_option, print_json


def weigh_verb(
    calibration: CalibrationArgument,
    logs: Annotated[list[Path], typer.Argument(help="Logs with the body, mounted one way.")],
    bare: Annotated[
        list[Path] | None, typer.Option("--bare", help="Log of the same robot without load; repeatable.")
    ] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Weigh the body on the flange: mass, centre of mass and inertia, each with its σ.

    The effects of the calibration are in the model. Without --bare the robot is the calibration's, except the friction
    of its joints; with --bare it is found again together with the body, which takes more moves and trusts the
    calibration's gains alone. Says which of the ten parameters these moves identify, and which moves would help.
    """
    from daq.config.cell_file import load_cell
    from daq.documents.calibration_file import load_calibration
    from daq.report.weighing_views import weigh_report, weighed_view
    from daq.workflow.weigh import weigh_logs

    with status("weighing"):
        described = None if cell is None else load_cell(cell)
        found = weigh_logs(load_calibration(calibration), logs, bare=bare or (), cell=described)
    if json:
        print_json(weigh_report(found))
    else:
        print_view(weighed_view(found))


WEIGH = Verb("weigh", weigh_verb, "drivegain weigh calibration.yaml held-out.mcap --bare unloaded.mcap")


def contact_verb(
    calibration: CalibrationArgument,
    log: Annotated[Path, typer.Argument(help="Log to examine.")],
    quiet: Annotated[
        list[Path] | None, typer.Option("--quiet", help="Log of such motion without contact; repeatable.")
    ] = None,
    pictures: Annotated[Path | None, output_option("--pictures", "Folder for a picture of the torques.")] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Compute the external torque of each axis, its prediction band, and a threshold for contact.

    The threshold gives less than one false alarm in an hour of motion, extrapolated from the quiet logs, or, without
    any, from the quiet part of the log itself. A payload must be one that the calibration knows.
    """
    from daq.config.cell_file import load_cell
    from daq.documents.calibration_file import load_calibration
    from daq.report.weighing_views import contact_report, contact_view, draw_contact
    from daq.workflow.weigh import contact_in

    picture = None
    with status("predicting"):
        given = None if cell is None else load_cell(cell)
        found, described = contact_in(load_calibration(calibration), log, quiet=quiet or (), cell=given)
        if pictures is not None:
            with write_output(pictures):
                pictures.mkdir(parents=True, exist_ok=True)
                picture = draw_contact(found, described, log, pictures)
    if json:
        print_json(contact_report(found, described, log, picture))
    else:
        print_view(contact_view(found, described), picture)


CONTACT = Verb("contact", contact_verb, "drivegain contact calibration.yaml loaded.mcap --quiet held-out.mcap")
