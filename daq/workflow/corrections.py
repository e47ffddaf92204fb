"""Say once in what a corrected description of a cell differs from the one in its logs."""

from __future__ import annotations

import logging
from pathlib import Path

from ident.data.run import Run

_LOG = logging.getLogger("drivegain")


class Corrections:
    """The corrections that were said; logs that carry one description share one line."""

    def __init__(self) -> None:
        self._said: set[tuple[str, ...]] = set()

    def note(self, log: Path, run: Run) -> None:
        """Say what the given description corrects in a log, unless an earlier log of the command had the same."""
        recording = run.recording
        if recording is None or not recording.corrected or recording.corrected in self._said:
            return
        self._said.add(recording.corrected)
        _LOG.warning(
            "%s: the given description of the cell replaces the one in the log; they differ in %s",
            log,
            ", ".join(recording.corrected),
        )
