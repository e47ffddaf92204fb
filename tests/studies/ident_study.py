"""How far the gains are off, by estimator and noise floor.

Run by `make ident-study`; records what is missing (record_study.py, over the real driver path), and
writes out/ident-study.json and the first table of docs/evidence/estimators.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.log.conversion import load_run
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System
from ident.estimators.comparison import ESTIMATORS
from ident.estimators.least_squares import wls
from ident.model.model import Model
from tests.studies.output import as_csv
from tests.studies.record_study import CELL, FLOORS, SEEDS, StudyLogs, record_study, study_logs

FloatArray = NDArray[np.float64]

OUT = Path("out/ident-study.json")
TABLE = Path("docs/evidence/data/estimators.csv")
PLATE = "plate"


@dataclass(frozen=True, slots=True)
class Score:
    """One estimator on one cell.

    Attributes:
        error_percent: of each gain.
        second_payload_percent: of the second payload's mass on each of its trajectories, found with
            these gains.
        relative_error_percent: of the fit.
    """

    error_percent: tuple[float, ...]
    second_payload_percent: tuple[float, ...]
    relative_error_percent: float


@dataclass(frozen=True, slots=True)
class Summary:
    """One estimator on all cells of a noise floor; payload masses are means of absolute errors."""

    mean_percent: float
    max_percent: float
    second_payload_percent: float
    second_payload_max_percent: float
    relative_error_percent: float


def score(logs: StudyLogs, model: Model, conditioning: Conditioning) -> dict[str, Score]:
    """Every estimator on one cell of the study.

    The second payload is weighed as in the paper's Table 8: gains fixed, classical IDIM-WLS on the
    runs without load and one trajectory with the payload, of which nothing is known.
    """
    runs = [load_run(path)[0] for path in logs.fit]
    system = _system(model, runs, conditioning, instruments=True)
    bare = [run for run in runs if run.payload is None]
    weighing = [
        _system(model, [*bare, load_run(path)[0]], conditioning) for path in logs.second_payload
    ]
    true = np.array(logs.truth.gains_nm_per_a)
    mass = logs.truth.payloads[PLATE].mass_kg
    scores = {}
    for name, estimator in ESTIMATORS.items():
        found = estimator(system)
        second_payload_percent = tuple(
            100.0 * (_mass(one, found.gains) / mass - 1.0) for one in weighing
        )
        error_percent = tuple(float(error) for error in 100.0 * (found.gains / true - 1.0))
        relative_error_percent = found.relative_error(system).total
        scores[name] = Score(
            error_percent=error_percent,
            second_payload_percent=second_payload_percent,
            relative_error_percent=relative_error_percent,
        )
    return scores


def _system(
    model: Model, runs: Sequence[Run], conditioning: Conditioning, *, instruments: bool = False
) -> System:
    """Equations of some runs; `iv` needs the instruments."""
    standard = reduce_runs(model, runs, conditioning, instruments=instruments)
    return regrouped(standard)


def _mass(system: System, gains: FloatArray) -> float:
    found = wls(system, gains)
    names = [column.name for column in found.unknowns]
    return float(found.parameters[next(i for i, name in enumerate(names) if name.startswith("m:"))])


def summarise(scores: Sequence[Score]) -> Summary:
    """Over the cells of a noise floor."""
    error_percent = [one.error_percent for one in scores]
    errors = np.abs(error_percent)
    second_payload_percent = [one.second_payload_percent for one in scores]
    masses = np.abs(second_payload_percent)
    mean_relative_error_percent = np.mean([one.relative_error_percent for one in scores])
    relative_error_percent = float(mean_relative_error_percent)
    mean_percent = float(errors.mean())
    max_percent = float(errors.max())
    mean_mass = float(masses.mean())
    second_payload_max_percent = float(masses.max())
    return Summary(
        mean_percent=mean_percent,
        max_percent=max_percent,
        second_payload_percent=mean_mass,
        second_payload_max_percent=second_payload_max_percent,
        relative_error_percent=relative_error_percent,
    )


def _key(estimator: str) -> str:
    """`tls` is the paper's, rows weighted per joint."""
    return "tls" if estimator == "tls, rows (paper)" else estimator


def _print_line(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def main(arguments: list[str] | None = None) -> int:
    """Record, score and report."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.ident_study", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--floors", nargs="+", choices=tuple(FLOORS), default=list(FLOORS))
    parser.add_argument(
        "--kept", action="store_true", help="score what was recorded, whatever software recorded it"
    )
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    cell = load_cell(CELL)
    model = model_of(cell)
    if options.kept:
        logs = study_logs(options.seeds, options.floors)
    else:
        logs = record_study(options.seeds, options.floors, report_line=_print_line)
    result: dict[str, Any] = {_key(name): {} for name in ESTIMATORS}
    lines = [
        "| floor % | estimator | gain error mean / max % | second payload mean / max % |",
        "|---|---|---|---|",
    ]
    cells: list[dict[str, Any]] = []
    for floor in options.floors:
        scored = [
            (one.seed, score(one, model, cell.conditioning)) for one in logs if one.floor == floor
        ]
        for seed, of in scored:
            cells += [
                {"floor": floor, "seed": seed, "estimator": name, **asdict(one)}
                for name, one in of.items()
            ]
        for name in ESTIMATORS:
            scores = [of[name] for _, of in scored]
            reported = summarise(scores)
            result[_key(name)][floor] = asdict(reported)
            lines.append(
                f"| {reported.relative_error_percent:.1f} | {name} | {reported.mean_percent:.2f} / "
                f"{reported.max_percent:.2f} | {reported.second_payload_percent:.2f} / "
                f"{reported.second_payload_max_percent:.2f} |"
            )
    result["cells"] = cells
    for floor in options.floors:
        mean_percent = result["tls"][floor]["mean_percent"]
        ratio = mean_percent / result["ml"][floor]["mean_percent"]
        result.setdefault("tls_over_ml", {})[floor] = ratio
        lines.append(f"\nfloor {floor} %: mean gain error of tls / ml = {ratio:.2f}")
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(result, indent=2) + "\n")
    text = "\n".join(lines) + "\n"
    options.table.write_text(as_csv(text), encoding="utf-8")
    sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
