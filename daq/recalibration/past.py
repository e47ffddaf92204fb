"""What the cell's history says of the gains in force, and what a job adds to it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from daq.calibration_file import decode
from daq.configuration.cell import Cell
from daq.configuration.history_place import HistoryPlace
from daq.history.store import HistoryStore
from daq.recalibration.session import digest_of
from daq.write_back.link import followed
from ident.calibration import Calibration
from ident.drift import DISPERSION, dispersions

SAME_SIGMAS = 0.5
"""A number in the controller's file that is that near to a gain of the history is that gain, rounded for the file."""


class Past:
    """The history of a cell, open; a context manager.

    Args:
        cell: that it is of.
        place: of its files.
        controller: file whose gains are in force.
        now: wall clock.
        who: the job.
    """

    def __init__(
        self, cell: Cell, place: HistoryPlace, controller: Path, now: Callable[[], datetime], who: str
    ) -> None:
        self._axes = cell.axis_names
        self._target = str(followed(controller))
        self._now = now
        self._who = who
        self._store = HistoryStore(place.store)
        self._digest = ""

    def __enter__(self) -> Self:
        """Open it.

        Raises:
            HistoryUnreadable: see `daq.history.store`.
        """
        self._store.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._store.__exit__(kind, error, trace)

    def keep(self, calibration: Calibration, path: Path) -> None:
        """Enter this session's calibration; once, however often a session is taken up.

        Raises:
            HistoryMixed, HistoryUnreadable, OutputFailed: see `daq.history.store`.
        """
        self._digest = digest_of(path) or ""
        self._store.add(calibration, digest=self._digest, at=self._now())

    def note_applied(self) -> None:
        """The controller has this session's gains; noted once. Raises as `keep`."""
        if self._store.in_force(self._target) != self._digest:
            self._store.applied(self._digest, at=self._now(), who=self._who, target=self._target)

    def stds_in_force(self, gains: dict[str, float]) -> dict[str, float]:
        """σ of gains in the controller's file, by axis.

        That of the calibration which the history has as in force, where the number is still that calibration's; 0 for
        one that somebody entered by hand, or of which nothing is known: then only the new one's σ counts.

        Args:
            gains: in the file now, by axis.
        """
        digest = self._store.in_force(self._target)
        document = None if digest is None else self._store.document(digest)
        known = () if document is None else decode(document, f"calibration {digest}").gains
        stds = {
            gain.axis: gain.std
            for gain in known
            if gain.axis in gains and abs(gains[gain.axis] - gain.value) <= SAME_SIGMAS * gain.std
        }
        return {axis: stds.get(axis, 0.0) for axis in gains}

    def dispersions(self) -> dict[str, float]:
        """How much more this cell's calibrations scatter than their σ says, by axis (`ident.drift.dispersions`)."""
        entries = [entry for entry in self._store.entries() if entry.digest != self._digest]
        rows = [{gain.axis: gain for gain in entry.gains if gain.std > 0} for entry in entries]
        whole = [row for row in rows if set(self._axes) <= row.keys()]
        if not whole:
            return dict.fromkeys(self._axes, DISPERSION)
        values, stds = (
            np.array([[getattr(row[axis], part) for row in whole] for axis in self._axes]) for part in ("value", "std")
        )
        return dict(zip(self._axes, map(float, dispersions(values, stds)), strict=True))
