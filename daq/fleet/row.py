"""One line of a fleet's table: a cell with what came of it, or with what stood in the way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daq.fleet.cell_fit import Failure
from daq.fleet.summary import Summary


@dataclass(frozen=True, slots=True)
class FleetRow:
    """What is told of one cell.

    Attributes:
        cell: its name; that of the log where the log does not tell whose it is.
        configuration_sha256: of its configuration; empty where nobody knows it.
        fit, holdout: names of the logs.
        result: what came of it, or why nothing did.
        seconds: that it took.
        configurations: in how many different ones the cell's logs were made; each has a row.
        file: of the calibration, where it is kept.
        kept: it stood already, and its logs are the same.
    """

    cell: str
    configuration_sha256: str
    fit: tuple[str, ...]
    holdout: tuple[str, ...]
    result: Summary | Failure
    seconds: float
    configurations: int = 1
    file: Path | None = None
    kept: bool = False

    @property
    def fitted(self) -> bool:
        """Whether there is a calibration."""
        return isinstance(self.result, Summary)
