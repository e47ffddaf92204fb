"""The tables of docs/evidence/robots.md, from the rows of the robot study (any_robot.py).

Form of the paper's Tables 4, 7 and 8: gains of the first seed beside the nameplate, and the masses
of the payload that the fit was given (in a run of its own) and of a second one.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from daq.files import replace_file

SUMMARY = (
    "robot",
    "gains",
    "relative error",
    "gain error mean",
    "worst",
    "second payload mean",
    "worst",
    "coverage",
)
GAINS = (
    "robot",
    "axis",
    "unit",
    "nameplate",
    "identified",
    "%σ",
    "%e from the nameplate",
    "%e from the truth",
)
PAYLOADS = (
    "robot",
    "first payload [kg]",
    "identified",
    "%σ",
    "%e",
    "second payload [kg]",
    "identified",
    "%σ",
    "%e",
)


def write_tables(
    folder: Path, figures: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]
) -> None:
    """Write robots.csv, robots-gains.csv and robots-payloads.csv.

    Args:
        folder: of the tables.
        figures: of each robot over its seeds.
        rows: of all seeds; the gains are those of each robot's first.
    """
    first = {row["robot"]: row for row in reversed(rows)}
    tables = {
        "robots.csv": (SUMMARY, [_summary(robot) for robot in figures]),
        "robots-gains.csv": (
            GAINS,
            [line for robot in figures for line in _gains(first[robot["robot"]])],
        ),
        "robots-payloads.csv": (PAYLOADS, [_payloads(first[robot["robot"]]) for robot in figures]),
    }
    for name, (headings, lines) in tables.items():
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([headings, *lines])
        content = text.getvalue().encode()
        replace_file(folder / name, content)


def _summary(robot: dict[str, Any]) -> tuple[str, ...]:
    gains_text = str(robot["gains"])
    return (
        robot["robot"],
        gains_text,
        f"{robot['floor_percent']:.1f}",
        f"{robot['mean_gain_error_percent']:.2f}",
        f"{robot['worst_gain_error_percent']:.2f}",
        f"{robot['mean_payload_error_percent']:.2f}",
        f"{robot['worst_payload_error_percent']:.2f}",
        f"{robot['coverage_percent']:.0f}",
    )


def _gains(row: dict[str, Any]) -> Iterable[tuple[str, ...]]:
    for axis, error in row["gain_error_percent"].items():
        nameplate = row["nameplate_gain"][axis]
        true = row["true_gain"][axis]
        identified = true * (1.0 + error / 100.0)
        change = 100.0 * abs(identified / nameplate - 1.0)
        yield (
            row["robot"],
            axis,
            row["gain_unit"][axis],
            f"{nameplate:.4g}",
            f"{identified:.4g}",
            # σ is kept in percent of the truth.
            f"{row['gain_std_percent'][axis] * abs(true / identified):.2f}",
            f"{change:.2f}",
            f"{abs(error):.2f}",
        )


def _payloads(row: dict[str, Any]) -> tuple[str, ...]:
    cells = [row["robot"]]
    for role in ("first_payload", "payload"):
        true, error, std = (
            row[f"{role}_{what}"] for what in ("kg", "error_percent", "std_percent")
        )
        cells += [
            f"{true:g}",
            f"{true * (1.0 + error / 100.0):.4g}",
            f"{std:.2f}",
            f"{abs(error):.2f}",
        ]
    return tuple(cells)
