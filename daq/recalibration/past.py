"""What the cell's history says of the gains in force, and what a job adds to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from daq.configuration.cell import Cell
from daq.configuration.history_place import HistoryPlace
from daq.digest import sha256_of
from daq.history.audited import enter_applied
from daq.history.entry import Deed, Event
from daq.history.judgement import Known, known_of
from daq.history.store import HistoryStore
from daq.history.watch import watch
from daq.history.words import alarm_words
from daq.recalibration.session import WatchedGain
from daq.write_back.audit import told_of
from daq.write_back.gain_gates import GainChange
from daq.write_back.link import followed
from ident.calibration import Calibration


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
        self._target = str(followed(controller))
        self._now = now
        self._who = who
        self._store = HistoryStore(place.store)
        self._cell = cell
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
        self._digest = sha256_of(path) or ""
        self._store.add(calibration, digest=self._digest, at=self._now())

    def note_applied(self, audit: Path, sha256_after: str) -> None:
        """The controller has this session's gains; noted once. Raises as `keep`.

        Args:
            audit: which tells of the write.
            sha256_after: of the controller's file with these gains, by which a later way back to it is known.
        """
        if self._store.in_force(self._target) != self._digest:
            told = told_of(audit, self._target, sha256_after)
            event = Event(self._digest, Deed.APPLIED, self._now(), self._who, self._target, told, sha256_after)
            enter_applied(self._cell, self._store, event)

    def watched(self) -> tuple[WatchedGain, ...]:
        """What the charts of all gains say, in the order of the axes. Raises as `keep`."""
        series = watch(self._store.entries(), self._store.acknowledgements())
        return tuple(WatchedGain(axis=one.axis, alarm=alarm_words(one) or "") for one in series)

    def known(self, changes: Sequence[GainChange]) -> Known:
        """What the changes by this session's calibration are judged by. Raises as `keep`."""
        return known_of(self._store, self._target, self._digest, changes)
