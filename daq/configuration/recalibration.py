"""What a scheduled recalibration does, and when it may: `recalibration` of the cell file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from daq.configuration.yaml_file import StrictModel


@dataclass(frozen=True, slots=True)
class Recalibration:
    """A scheduled recalibration.

    Attributes:
        folder: where its logs, its state and its reports are; absolute.
    """

    folder: Path


class RecalibrationModel(StrictModel):
    """`recalibration`; the folder is relative to the cell file."""

    folder: Annotated[str, Field(min_length=1)] = "recalibration"

    def recalibration(self, cell_file: Path) -> Recalibration:
        """With absolute paths."""
        return Recalibration((cell_file.parent / self.folder).resolve())
