"""Tables 1 to 8 of the paper on simulated cells, beside the paper's own figures: `make paper`.

`python -m tests.studies.paper_tables --seeds 1 2 3` records what is missing, fits every case,
validates all of them on runs that no fit has seen, and puts the tables of the first seed and the
order of merit over all of them into docs/evidence/paper.md, between its two marks. Everything goes
through the command line, as a technician would do it.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.cli import main as drivegain
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.report.paper_tables import PaperTable, percent
from daq.workflow.plan import load_plan
from daq.workflow.record import RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import Body
from tests.studies.fingerprint import digest, finish, is_finished
from tests.studies.output import as_csv
from tests.studies.paper_figures import paper_table
from tests.studies.record_study import CELL, FLOORS, OUT, PROCESSES, StudyLogs, record_study
from tests.studies.study_cells import declared_payload, spec_of, study_cell, study_masses

FOLDER = Path("out/paper")
PAGE = Path("docs/evidence/paper.md")
DATA = Path("docs/evidence/data")
"""Folder of the tables, a CSV file each."""
MARKS = ("<!-- made by `make paper`: begin -->", "<!-- made by `make paper`: end -->")
FLOOR = "3.5"
RATIO = 20
CENTRE_ERROR = 0.05
"""Of each coordinate of the payload's centre in its drawing:
first moments 5 % off, to either side.
"""
INERTIA_ERROR = (0.10, 0.20)
"""Of its inertia about the centre: 10 to 20 % off, to either side,
as the paper found drawings to be (§4.2).
"""
DISC_PLANS = ("d", "e", "f")
"""Three runs with the disc that no fit sees, on plans of their own,
as the paper's three trajectories.
"""
CASES = ("manufacturer", "case-1", "case-2", "case-3", "case-4", "ml")


@dataclass(frozen=True, slots=True)
class Merit:
    """Merit of a set of gains on one cell [%].

    Attributes:
        gains: |g/truth − 1| of each axis.
        error: mean of Table 6.
        disc, plate: mean %e of Tables 7 and 8.
    """

    gains: tuple[float, ...]
    error: float
    disc: float
    plate: float


def one(logs: StudyLogs) -> dict[str, Merit]:
    """Fit and validate one cell; its tables are left in its folder."""
    folder = FOLDER / str(logs.seed)
    path = folder / "cell.yaml"
    cell = _cell_with_drawing(logs, path)
    discs = tuple(_disc_run(logs, plan, folder) for plan in DISC_PLANS)
    common = ("--cell", str(cell), "--json")
    fit = (
        "fit",
        *map(str, logs.fit),
        "--cases",
        str(folder / "cases"),
        "--essential",
        str(RATIO),
        *common,
    )
    fitted = _drivegain(fit)["cases"]
    runs = (logs.validation[0], *discs, *logs.second_payload)
    manufacturer_path = folder / "cases" / "manufacturer.yaml"
    beside = (
        str(manufacturer_path),
        *map(str, runs),
        "--beside",
        str(folder / "cases"),
    )
    checked = _drivegain(("validate", *beside, "--out", str(folder), *common))
    truth = np.array(logs.truth.gains_nm_per_a)
    return {case: _merit(case, fitted[case], checked, truth) for case in CASES}


def _merit(
    case: str, fitted: dict[str, Any], checked: dict[str, Any], truth: np.ndarray[Any, Any]
) -> Merit:
    gains = np.array([gain["value"] for gain in fitted["gains"]])
    errors = []
    for run in checked["runs"]:
        if case in run["relative_error_percent"]:
            errors.extend(run["relative_error_percent"][case]["axes"])
    masses = {}
    for name in ("disc", "plate"):
        masses[name] = [
            run["masses"][case]["error_percent"]
            for run in checked["payloads"]
            if run["payload"] == name
        ]
    disc = float(np.mean(masses["disc"]))
    plate = float(np.mean(masses["plate"]))
    error = float(np.mean(errors))
    return Merit(
        gains=tuple((100.0 * np.abs(gains / truth - 1.0)).tolist()),
        error=error,
        disc=disc,
        plate=plate,
    )


def _drivegain(arguments: tuple[str, ...]) -> dict[str, Any]:
    """Run the command; what it prints as JSON."""
    line = "drivegain " + " ".join(arguments)
    _print_line(line)
    printed = io.StringIO()
    with redirect_stdout(printed):
        code = drivegain(list(arguments))
    if code:
        raise RuntimeError(f"exit code {code} of drivegain {' '.join(arguments)}")
    found: dict[str, Any] = json.loads(printed.getvalue())
    return found


def _cell_with_drawing(logs: StudyLogs, path: Path) -> Path:
    """The cell file of the recordings, with what a drawing of the disc might say of it,
    and the plate's weight.
    """
    rng = np.random.default_rng(np.random.SeedSequence(logs.seed, spawn_key=(4,)))
    noise_factor = FLOORS[logs.floor]
    body = study_cell(logs.seed, noise_factor).bodies["disc"]
    drawn = _drawing(body, rng)
    document = yaml.safe_load(CELL.read_text(encoding="utf-8"))
    path.parent.mkdir(parents=True, exist_ok=True)
    for entry, key in ((document["robot"], "urdf"), (document["controller"], "file")):
        entry[key] = os.path.relpath(CELL.parent / entry[key], path.parent)
    (disc,) = document["payloads"]
    disc |= {"centre_m": list(drawn.centre_m), "inertia_kg_m2": list(drawn.inertia_kg_m2)}
    document["payloads"].append(
        {"name": "plate", "mounting": "flange-b", "mass_kg": study_masses()["plate"]}
    )
    text = yaml.safe_dump(document, sort_keys=False)
    path.write_text(text, encoding="utf-8")
    return path


def _drawing(body: Body, rng: np.random.Generator) -> Body:
    sides = rng.choice([-1.0, 1.0], 4)
    centre_m = np.array(body.centre_m)
    x, y, z = (float(v) for v in centre_m * (1.0 + CENTRE_ERROR * sides[:3]))
    scale = 1.0 + float(sides[3] * rng.uniform(*INERTIA_ERROR))
    xx, xy, xz, yy, yz, zz = (scale * value for value in body.inertia_kg_m2)
    inertia_kg_m2 = (xx, xy, xz, yy, yz, zz)
    return Body(body.mass_kg, (x, y, z), inertia_kg_m2)


def _disc_run(logs: StudyLogs, letter: str, folder: Path) -> Path:
    """A run with the disc on a plan that no fit sees, unless it is there."""
    cell = load_cell(CELL)
    plan_file = OUT / "plans" / f"{logs.seed}-{letter}.yaml"
    path = folder / f"disc-{letter}.mcap"
    like = logs.validation[1].with_name(logs.validation[1].name + ".fingerprint").read_text()
    fingerprint = digest(like, plan_file.read_text(encoding="utf-8"))
    if is_finished(path, fingerprint):
        return path
    for leftover in (path, path.with_name(path.name + ".part")):
        leftover.unlink(missing_ok=True)
    _print_line(f"recording {path}")
    noise_factor = FLOORS[logs.floor]
    spec = spec_of(study_cell(logs.seed, noise_factor), "disc", 100 + ord(letter))
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            plan = load_plan(plan_file, cell)
            request = RecordingRequest(
                CELL,
                cell,
                plan,
                path,
                payload=declared_payload("disc"),
                operator="study",
                granted_by="the study of the paper's tables: a simulated cell",
                run_id=f"paper-{logs.seed}-{letter}",
            )
            recorded = record(request)
    finally:
        bus.shutdown()
    if not recorded.log.valid:
        raise RuntimeError(
            f"{path}: {recorded.log.reason}; record again on a machine with less to do"
        )
    finish(path, fingerprint)
    return path


def merit_table(merits: dict[int, dict[str, Merit]]) -> PaperTable:
    """Each set of gains over all cells: the true error of the gains,
    and what Tables 6 to 8 say of it.
    """
    rows = []
    for case in CASES:
        of = [cell[case] for cell in merits.values()]
        gains: list[float] = []
        for merit in of:
            gains.extend(merit.gains)
        means = (
            np.mean(gains),
            np.max(gains),
            np.mean([merit.error for merit in of]),
            np.mean([merit.disc for merit in of]),
            np.mean([merit.plate for merit in of]),
        )
        rows.append((case, *(percent(float(value)) for value in means)))
    seeds = ", ".join(map(str, merits))
    headings = (
        "set",
        "gain error, mean",
        "max",
        "Table 6, mean",
        "Table 7, mean %e",
        "Table 8, mean %e",
    )
    notes = (
        f"In %, cells of seed {seeds}. The error of the gains is against the truth of the "
        "simulated cell.",
    )
    return PaperTable(
        title="Order of merit",
        headings=headings,
        rows=tuple(rows),
        notes=notes,
    )


def write_tables(folder: Path, data: Path) -> None:
    """Write each table of a cell as CSV, and the paper's own beside it."""
    tables = []
    tables_path = folder / "cases" / "tables.md"
    for file in (tables_path, folder / "tables.md"):
        text = file.read_text(encoding="utf-8")
        tables += text.split("\n## ")[1:]
    data.mkdir(exist_ok=True)
    for number, table in enumerate(tables, start=1):
        (data / f"paper-{number}.csv").write_text(as_csv(table), encoding="utf-8")
        markdown = paper_table(number).markdown()
        published = as_csv(markdown)
        (data / f"paper-{number}-published.csv").write_text(published, encoding="utf-8")


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Record what is missing, fit, validate, and write the page."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.paper_tables", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--floor", choices=tuple(FLOORS), default=FLOOR)
    parser.add_argument(
        "--processes", type=int, default=PROCESSES, help="that plan and record side by side"
    )
    options = parser.parse_args(arguments)
    logs = record_study(
        options.seeds, (options.floor,), processes=options.processes, report_line=_print_line
    )
    merits = {cell.seed: one(cell) for cell in logs}
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    made = merit_table(merits).markdown()
    after = rest.split(MARKS[1])[1]
    PAGE.write_text(f"{before}{MARKS[0]}\n\n{made}\n{MARKS[1]}{after}", encoding="utf-8")
    seed_text = str(options.seeds[0])
    folder = FOLDER / seed_text
    write_tables(folder, DATA)
    _print_line(made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
