"""Where a cell keeps what became of its calibrations: `history` of the cell file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daq.configuration.yaml_file import StrictModel


@dataclass(frozen=True, slots=True)
class HistoryPlace:
    """Files of a cell's history, absolute.

    Attributes:
        store: SQLite file with every calibration.
        audit: hash-chained record of whatever was asked of the controller.
    """

    store: Path
    audit: Path


class HistoryModel(StrictModel):
    """`history`: file names relative to the cell file; beside it and by its name where not given."""

    store: str | None = None
    audit: str | None = None


def history_place(model: HistoryModel, cell_file: Path) -> HistoryPlace:
    """Where the history of the cell in `cell_file` is."""
    folder, stem = cell_file.parent, cell_file.stem
    return HistoryPlace(
        (folder / (model.store or f"{stem}.history.sqlite")).resolve(),
        (folder / (model.audit or f"{stem}.audit.jsonl")).resolve(),
    )
