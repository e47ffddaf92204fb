"""The next command of a commissioning, chosen from what is in the folder.

The steps are a plan, a run without load, one with the payload, a second plan with a held-out run,
`residual`, and `apply`. A command is named only where the folder leaves no doubt which files it
takes.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from daq.cli.verb import cells_in
from daq.errors import DaqError

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.workflow.plan import Plan
    from daq.writeback.gates.gate import Refusal
    from ident.calibration import Calibration
    from ident.errors import Diagnosis

LARGEST_FOLDER_BYTES = 100_000_000
"""Size of all logs of a folder up to which they are read for a hint [bytes]:
that takes about a second.
"""


def say_next(*words: object) -> None:
    """Print the command of the next step on stderr, quoted for a shell; without `--json` only."""
    # Written names of things that the user has to fill in, such as CELL, need no quotes.
    typer.echo("Next: " + " ".join(shlex.quote(str(word)) for word in words), err=True)


def say_correct_first() -> None:
    """Print on stderr that the description comes before every other step."""
    typer.echo("Next: correct the description as CHECK says, then fit the logs again.", err=True)


def _say_record_more() -> None:
    """Print on stderr that other moves come before every other step."""
    typer.echo(
        "Next: record the moves that CHECK asks for, then fit them together with these logs.",
        err=True,
    )


def _needs_other_moves(calibration: Calibration) -> bool:
    """Whether the moves of a fit hardly show a gain,
    or do not tell what is wrong with the description.
    """
    from ident.errors import CORRECTION_UNCLEAR, GAIN_UNSEEN

    return any(one.name in (CORRECTION_UNCLEAR, GAIN_UNSEEN) for one in calibration.diagnoses)


def say_look_first() -> None:
    """Print on stderr that a cause has to be found before anything is written."""
    typer.echo("Next: find the cause of what CHECK says, before any gain is written.", err=True)


@dataclass(frozen=True, slots=True)
class FolderRuns:
    """Valid runs of one cell in a folder, the oldest first."""

    unloaded: tuple[Path, ...] = ()  #: without load
    loaded: tuple[Path, ...] = ()  #: with a payload


def runs_in(folder: Path, cell: str) -> FolderRuns | None:
    """Find the valid runs of a cell in a folder;
    None where its logs are too large to be read for a hint.
    """
    from daq.report.log import info_report

    logs = sorted(folder.glob("*.mcap"), key=lambda log: log.stat().st_mtime)
    if sum(log.stat().st_size for log in logs) > LARGEST_FOLDER_BYTES:
        return None
    unloaded = []
    loaded = []
    for log in logs:
        try:
            found = info_report(log)
        except DaqError:
            continue
        if found.cell != cell or not found.valid:
            continue
        if found.payload is None:
            unloaded.append(log)
        else:
            loaded.append(log)
    return FolderRuns(tuple(unloaded), tuple(loaded))


def free_name(wanted: Path) -> Path:
    """Return a name of a file that is not there yet:
    `loaded.mcap`, else `loaded-2.mcap` and so on.
    """
    others = (wanted.with_name(f"{wanted.stem}-{number}{wanted.suffix}") for number in count(2))
    return next(name for name in chain((wanted,), others) if not name.exists())


def say_after_plan(cell: Path, declared: Cell, plan: Path, made: Plan) -> None:
    """Name the run that this plan is for, or the first run where a good plan was there before.

    A plan for the fit comes first. A second one, of another seed, is for the held-out run.
    """
    runs = runs_in(Path(), declared.name) or FolderRuns()
    if runs.unloaded and runs.loaded:
        _say_record(cell, declared, plan, Path("held-out.mcap"), loaded=True)
        return
    first = _other_good_plan(plan, made) or plan
    if runs.unloaded:
        _say_record(cell, declared, first, Path("loaded.mcap"), loaded=True)
    else:
        _say_record(cell, declared, first, Path("unloaded.mcap"), loaded=False)


def _other_good_plan(plan: Path, made: Plan) -> Path | None:
    """Return the oldest plan of this cell in the folder of a plan that is good and of another
    seed.
    """
    from daq.workflow.plan import read_plan
    from ident.planning.gain_verdict import GOOD_PERCENT

    for path in sorted(plan.parent.glob("*.yaml"), key=lambda file: file.stat().st_mtime):
        try:
            other = read_plan(path)
        except DaqError:  # another YAML file
            continue
        is_good = max(other.predicted_std_percent, default=float("inf")) <= GOOD_PERCENT
        if is_good and other.cell == made.cell and other.seed != made.seed:
            return path
    return None


def _say_record(cell: Path, declared: Cell, plan: Path, log: Path, *, loaded: bool) -> None:
    mounted: list[object] = []
    if loaded:
        mounted = ["--payload", declared.payloads[0].payload.name, "--mass", "KG"]
    say_next(
        "drivegain", "record", cell, plan, "--out", free_name(log), *mounted, "--enable-motion"
    )


def say_after_record(cell: Path, declared: Cell, plan: Path, log: Path, *, loaded: bool) -> None:
    """Name the run that is still missing, else the fit of one run without load, one with,
    and a held-out one.

    Args:
        cell: file of the cell.
        declared: its content.
        plan: file of the moves that were made.
        log: that was recorded.
        loaded: with a payload.
    """
    if not declared.payloads:
        return
    runs = runs_in(log.parent, declared.name)
    if runs is None and loaded:
        return
    runs = runs or FolderRuns(unloaded=(log,))
    if not runs.loaded:
        _say_record(cell, declared, plan, Path("loaded.mcap"), loaded=True)
        return
    if not runs.unloaded:
        _say_record(cell, declared, plan, Path("unloaded.mcap"), loaded=False)
        return
    if len(runs.unloaded) > 1:
        return
    calibration = log.with_name("calibration.yaml")
    if len(runs.loaded) == 1 and not calibration.exists():
        say_next("drivegain", "fit", *runs.unloaded, *runs.loaded, "--out", calibration)
    if len(runs.loaded) == 2 and log == runs.loaded[1]:
        used = (*runs.unloaded, runs.loaded[0], "--holdout", log)
        say_next(
            "drivegain", "residual", *used, "--out", free_name(calibration), "--report", "report"
        )


def say_after_fit(
    calibration: Calibration, arguments: Sequence[object], written: Path | None
) -> None:
    """Name the search for what the model lacks, unless the robot is described wrongly or other
    moves are needed.

    Args:
        calibration: of the fit.
        arguments: logs and options of the fit that the search takes, too.
        written: file that the fit has written; the search gets another.
    """
    from daq.writeback.gates.fit import uncorrected_description

    if _needs_other_moves(calibration):
        _say_record_more()
        return
    if uncorrected_description(calibration):
        say_correct_first()
        return
    out = free_name(written or Path("calibration.yaml"))
    say_next("drivegain", "residual", *arguments, "--out", out, "--report", "report")


def say_after_calibration(
    calibration: Calibration,
    file: Path | None,
    logs: Sequence[Path],
    cell: Path | None,
    diagnoses: Sequence[Diagnosis] | None = None,
    described: Cell | None = None,
) -> bool:
    """Name the dry run that shows what would be written, unless `apply` would refuse it or a cause
    must be found first.

    Args:
        calibration: that could be written.
        file: it is in; None where it was not written, and nothing can be applied yet.
        logs: of the command.
        cell: its file; None where the command was given none.
        diagnoses: that the command has printed; those of the calibration when None.
        described: the cell as the logs describe it, where no file of it is found; None where it is
            not known.

    Returns:
        whether a step was named.
    """
    printed = calibration.diagnoses if diagnoses is None else diagnoses
    if _say_cause_first(calibration, printed):
        return True
    if calibration.gains_fixed:  # every gate of such gains is closed
        return False
    place = cell or cell_of(calibration, logs)
    refusal = first_refusal(calibration, file, place, described)
    if refusal is not None:
        reason = f"{refusal.subject}: {refusal.found}"
        typer.echo(
            f"Next: {refusal.remedy}. `drivegain apply` refuses this calibration: {reason}.",
            err=True,
        )
        return True
    if file is None:
        return False
    say_next("drivegain", "apply", place, file)
    return True


def _say_cause_first(calibration: Calibration, printed: Sequence[Diagnosis]) -> bool:
    """Print what has to be done about diagnoses before anything is written;
    return whether there is something.
    """
    from daq.writeback.gates.fit import OF_DESCRIPTION

    if _needs_other_moves(calibration):
        _say_record_more()
        return True
    if any(one.name in OF_DESCRIPTION for one in printed):
        say_correct_first()
        return True
    if printed and not calibration.gains_fixed:
        say_look_first()
        return True
    return False


def first_refusal(
    calibration: Calibration, file: Path | None, place: Path, described: Cell | None = None
) -> Refusal | None:
    """Return the first reason for which `drivegain apply` refuses a calibration now;
    None where it does not.

    Args:
        calibration: that could be written.
        file: it is in, next to which signatures are; None where it was not written.
        place: file of the cell, or CELL where it is not certain.
        described: the cell as the logs describe it, for a file that cannot be read.
    """
    from daq.documents.calibration_file import read_calibration_bytes
    from daq.report.comparison import without_controller
    from daq.writeback.file_target import FileTarget
    from daq.writeback.gates.gate import Gate
    from daq.writeback.request import Request
    from daq.writeback.target import propose

    now = datetime.now(UTC)
    cell = _read_cell(place) or described
    if cell is not None:
        with suppress(DaqError):  # a controller that cannot be read refuses nothing yet
            if file is None:
                content = None
            else:
                content = read_calibration_bytes(file)
            request = Request(calibration, now, file=file, content=content)
            refusals = propose(FileTarget.of(cell), request).refusals
            # The dry run prints the --base that opens this one.
            return next((one for one in refusals if one.gate is not Gate.BASE), None)
    refusals = without_controller(calibration, "", now, cell).refusals
    return next(iter(refusals), None)


def _read_cell(place: Path) -> Cell | None:
    """Read a cell file; None where that fails."""
    from daq.config.cell_file import load_cell

    with suppress(DaqError):
        return load_cell(place)
    return None


def cell_of(calibration: Calibration, logs: Sequence[Path]) -> Path:
    """Find the cell file of a calibration, here or next to its logs;
    CELL, to be filled in, where it is not certain.

    Several files may describe a cell of that name, as the shipped one and a copy of it. The one
    with the content that the logs of the fit carry is meant.
    """
    from daq.config.cell_file import load_cell

    folders = dict.fromkeys([Path(), *(log.parent for log in logs)])
    found: dict[str, Path] = {}
    for folder in folders:
        for path in cells_in(folder, calibration.cell):
            found.setdefault(os.path.realpath(path), path)
    recorded = []
    for path in found.values():
        with suppress(DaqError):
            if load_cell(path).recording_digest == calibration.recording_configuration_sha256:
                recorded.append(path)
    # Without the fit's own one, the only one of that name may be it, edited since.
    likely = recorded or list(found.values())
    return likely[0] if len(likely) == 1 else Path("CELL")
