"""Where a session finds and writes the gains of a cell:
the controller's file, or the drives themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.config.cell import Cell
from daq.config.policy import HistoryPlace
from daq.errors import ConfigurationInconsistent
from daq.files import sha256_of
from daq.ledger.names import drives_of
from daq.writeback.drive_target import DriveTarget
from daq.writeback.file_access import resolve_links
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Edit
from daq.writeback.target import Target
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from ident.calibration import Calibration

NetworkMaker = Callable[[Cell, SignalBlocker], CanopenNetwork]
"""Makes the network of a cell's drives, to be entered; as `daq.workflow.record.network_of`."""


@dataclass(frozen=True, slots=True)
class GainTarget:
    """The place that holds the gains of a cell, and the history of the cell."""

    cell: Cell  #: as it is now
    history: HistoryPlace  #: files of history and audit
    file: Path | None  #: the controller's file, absolute; None where the drives hold the gains

    @property
    def in_drives(self) -> bool:
        """Whether the drives hold the gains."""
        return self.file is None

    @property
    def subject(self) -> str:
        """The place, as audit and history name it.

        Raises:
            ControllerUnfit: the file is a symbolic link that a write would not follow.
        """
        if self.file is None:
            return drives_of(self.cell.name)
        return str(resolve_links(self.file))

    @contextmanager
    def opened(
        self, network_of: NetworkMaker, block_signals: SignalBlocker
    ) -> Iterator[Target[Any]]:
        """Open the target of a write; a bus is open within the context alone.

        Raises:
            ConfigurationInconsistent: the cell does not say where the gains are.
            DriverError: the bus cannot be opened, or a drive does not answer.
        """
        if self.file is not None:
            yield FileTarget.of(self.cell, self.file)
            return
        with network_of(self.cell, block_signals) as network:
            yield DriveTarget(self.cell, network)

    def content_sha256(
        self, calibration: Calibration, network_of: NetworkMaker, block_signals: SignalBlocker
    ) -> str | None:
        """Return the SHA-256 of the content now, read back from the drives;
        None for a file that is not there.

        Raises:
            DriverError: a drive does not answer.
        """
        if self.file is not None:
            return sha256_of(self.file)
        with self.opened(network_of, block_signals) as target:
            edit: Edit = target.plan(calibration)
        return edit.base_sha256


def target_of(cell: Cell) -> GainTarget:
    """Find the place of a cell's gains; a controller's file, where there are both.

    Raises:
        ConfigurationInconsistent: the cell names neither a controller's file nor objects in its
            drives.
        ControllerUnfit: the file is a symbolic link that a write would not follow
            (`daq.writeback.file_access`), or it lacks a gain.
    """
    controller = cell.controller
    file = cell.controller_path
    if controller is not None and cell.history is not None:
        if file is not None and controller.gains:
            _require_gains_in(cell, file)
            return GainTarget(cell, cell.history, file)
        if controller.objects:
            return GainTarget(cell, cell.history, None)
    raise ConfigurationInconsistent(
        f"cell {cell.name!r}: controller",
        found="neither a file nor objects in the drives",
        expected="the place of the gains: a session compares its gains with those there",
        remedy="name it in the cell file (docs/how-to/write-gains.md)",
    )


def _require_gains_in(cell: Cell, file: Path) -> None:
    """Refuse a controller's file now, not after an hour of recordings.

    Raises:
        ControllerUnfit: it is a symbolic link that a write would not follow, or lacks a gain.
    """
    resolve_links(file)
    FileTarget.of(cell, file).require_gains()


def file_of(cell: Cell) -> GainTarget:
    """Find the controller's file of a cell, for a job without an operator:
    what is in drives a person writes.

    Raises:
        ConfigurationInconsistent: the cell names no controller file.
        ControllerUnfit: see `target_of`.
    """
    if cell.controller is None or cell.controller_path is None or cell.history is None:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}: controller",
            found="no file",
            expected="a controller's file: a job compares its gains with those in it",
            remedy="name it in the cell file; `drivegain calibrate` writes what is in drives, with "
            "an operator",
        )
    _require_gains_in(cell, cell.controller_path)
    return GainTarget(cell, cell.history, cell.controller_path)
