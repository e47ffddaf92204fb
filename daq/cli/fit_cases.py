"""`drivegain fit --cases`: the paper's cases and ours from the same logs, a calibration file each."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from daq.atomic_file import replace_file
from daq.calibration_file import as_document, save
from daq.cases import CASES, Case, CaseFit, calibration_of_case, fit_case, reduce_logs
from daq.cli.output import check_output, say_written
from daq.cli.progress import status
from daq.cli.verb import print_json, printable
from daq.configuration.cell import Cell
from daq.errors import OutputFailed
from daq.fit import DOUBTFUL_PERCENT
from daq.report.paper_tables import PaperTable, gain_table, page, parameter_table
from ident.calibration import Calibration

TABLES = "drivegain-fit-tables"
"""What a page of tables says it is."""


def fit_cases(
    logs: Sequence[Path],
    holdout: Sequence[Path],
    cell: Cell | None,
    ratio: float | None,
    folder: Path,
    format_: str,
    created: datetime,
    *,
    json: bool,
) -> None:
    """Fit every case, write its calibration, and tabulate them as Tables 1 to 4.

    Args:
        logs, holdout, cell, ratio: as of daq.cases.
        folder: for the calibrations, and tables.md.
        format_: what a calibration file says it is.
        created: when.
        json: print one JSON object.

    Raises:
        OutputExists, OutputFailed: a file of another kind is in the way, or the file system refuses.
        DaqError, IdentificationError: a case cannot be fitted.
    """
    files = {case.name: folder / f"{case.name}.yaml" for case in CASES}
    page_file = folder / "tables.md"
    check_output(page_file, (*logs, *holdout), TABLES)
    for file in files.values():
        check_output(file, (*logs, *holdout), format_)
    with status("identifying") as telling:
        reduced = reduce_logs(logs, holdout, cell)
        fits: dict[str, CaseFit] = {}
        for case in CASES:
            telling(case.title)
            fits[case.name] = fit_case(reduced, case.method, case.known, gains_fixed=case.gains_fixed, ratio=ratio)
        calibrations = {name: calibration_of_case(found, created) for name, found in fits.items()}
    tables = case_tables(calibrations)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            save(calibrations[name], file)
        title = f"Identification of {reduced.cell.name}"
        replace_file(page_file, page(title, tables, marker=TABLES).encode())
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    if json:
        print_json({"cases": {case.name: _document(case, fits, calibrations) for case in CASES}})
        return
    console = Console(soft_wrap=True, highlight=False)
    for name, found in fits.items():
        left = found.fitted.identification.training_error.total
        if left > DOUBTFUL_PERCENT:
            console.print(f"{name} did not succeed: its relative error is {left:.3g} %.", style="bold", markup=False)
    for table in tables:
        console.print(table.on_screen())
        for note in table.notes:
            console.print(printable(note), markup=False)
        console.print()
    say_written(console, *files.values(), page_file)


def case_tables(calibrations: dict[str, Calibration]) -> tuple[PaperTable, ...]:
    """Tables 1 to 4."""
    wls, tls = ((calibrations[f"case-{drawn}"], calibrations[f"case-{mass}"]) for drawn, mass in ((1, 2), (3, 4)))
    return (
        parameter_table(1, *wls, "IDIM-WLS"),
        gain_table(2, *wls, "IDIM-WLS"),
        parameter_table(3, *tls, "IDIM-TLS"),
        gain_table(4, *tls, "IDIM-TLS"),
    )


def _document(case: Case, fits: dict[str, CaseFit], calibrations: dict[str, Calibration]) -> dict[str, Any]:
    return {
        "title": case.title,
        "known": case.known.value,
        **as_document(calibrations[case.name]),
        "removed": removed(fits[case.name]),
    }


def removed(found: CaseFit) -> list[dict[str, Any]]:
    """Base parameters that were taken out, in the order in which they went, for --json."""
    steps = () if found.essential is None else found.essential.removed
    return [{"name": step.name, "std_percent": step.std_percent} for step in steps]
