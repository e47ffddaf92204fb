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

_ERRORS = ("identified", "%σ", "%e")
_GAIN_ERRORS = ("identified", "%σ", "%e from the nameplate", "%e from the truth")
_SUMMARY_ERRORS = ("relative error", "gain error mean", "worst", "second payload mean", "worst")

SUMMARY = ("robot", "gains", *_SUMMARY_ERRORS, "coverage")
GAINS = ("robot", "axis", "unit", "nameplate", *_GAIN_ERRORS)
PAYLOADS = ("robot", "first payload [kg]", *_ERRORS, "second payload [kg]", *_ERRORS)


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
    summary: list[tuple[str, ...]] = []
    gains: list[tuple[str, ...]] = []
    payloads: list[tuple[str, ...]] = []
    for robot in figures:
        first_seed = first[robot["robot"]]
        summary.append(_summary(robot))
        gains.extend(_gains(first_seed))
        payloads.append(_payloads(first_seed))
    _write_csv(folder / "robots.csv", SUMMARY, summary)
    _write_csv(folder / "robots-gains.csv", GAINS, gains)
    _write_csv(folder / "robots-payloads.csv", PAYLOADS, payloads)


def _write_csv(path: Path, headings: tuple[str, ...], lines: list[tuple[str, ...]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(lines)
    content = text.getvalue().encode()
    replace_file(path, content)


def _summary(robot: dict[str, Any]) -> tuple[str, ...]:
    return (
        robot["robot"],
        str(robot["gains"]),
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
        # σ is kept in percent of the truth.
        std_percent = row["gain_std_percent"][axis] * abs(true / identified)
        yield (
            row["robot"],
            axis,
            row["gain_unit"][axis],
            f"{nameplate:.4g}",
            f"{identified:.4g}",
            f"{std_percent:.2f}",
            f"{change:.2f}",
            f"{abs(error):.2f}",
        )


def _payloads(row: dict[str, Any]) -> tuple[str, ...]:
    cells = [row["robot"]]
    for role in ("first_payload", "payload"):
        true_kg = row[f"{role}_kg"]
        error_percent = row[f"{role}_error_percent"]
        std_percent = row[f"{role}_std_percent"]
        identified_kg = true_kg * (1.0 + error_percent / 100.0)
        cells.append(f"{true_kg:g}")
        cells.append(f"{identified_kg:.4g}")
        cells.append(f"{std_percent:.2f}")
        cells.append(f"{abs(error_percent):.2f}")
    return tuple(cells)
