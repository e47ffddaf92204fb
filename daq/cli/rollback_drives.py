"""The drives as before the last write: what `drivegain rollback --drives` does."""

from __future__ import annotations

from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from daq.cli.applier import Applier, tell_history
from daq.cli.drives import kept, on_the_bus, outcome
from daq.cli.verb import print_json, printable
from daq.configuration.cell import Cell
from daq.errors import OutputFailed
from daq.history.store import HistoryStore
from daq.write_back.drive_proposal import drives_of
from daq.write_back.drive_record import record_folder
from daq.write_back.drive_way_back import DriveWayBack, way_back_of_drives
from daq.write_back.drive_write import DrivesWritten, roll_back_drives
from drivers.parameter_write import Saving


def rollback_drives(
    declared: Cell, *, now: datetime, doer: Applier, saving: Saving, audit: Path | None, yes: bool, json: bool
) -> None:
    """Show what stood in the drives before the last write, and put it back with `yes`; a second time undoes it.

    Args:
        declared: the cell.
        now, doer, audit: as for a controller's file.
        saving: whether the drives keep it.
        yes: write.
        json: tell it to a program.
    """
    done: DrivesWritten | None = None
    with on_the_bus(declared) as network:
        way = way_back_of_drives(declared, network)
        if not json:
            _show_way(way)
        if yes:
            try:
                done = roll_back_drives(way, network, now, saving=saving, audit=audit, who=str(doer))
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if done is not None:
        tell_history(declared, partial(_tell_back, done, now, doer))
    if json:
        print_json(_described_way(way, done))
        return
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if done is None:
        console.print("Dry run, nothing was written. To put it back, repeat the command with --yes.")
        return
    console.print(f"Restored what {done.source} says; what stood there is now in {done.record.name}. {kept(saving)}")


def _show_way(way: DriveWayBack) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for value, write in zip(way.base, way.writes, strict=True):
        new = value.parameter.value(write.word)
        console.print(f"{value.axis.name}, {value.parameter}: {value.value:.9g} -> {new:.9g}")
    console.print(f"These stood there before the write of {way.record.at} by {printable(way.record.who)}.")


def _described_way(way: DriveWayBack, done: DrivesWritten | None) -> dict[str, Any]:
    return {
        "drives": drives_of(way.cell),
        "source": str(way.record.path),
        "restored": done is not None,
        "changes": [
            {
                "axis": value.axis.name,
                "object": str(value.parameter),
                "old": value.value,
                "new": value.parameter.value(write.word),
            }
            for value, write in zip(way.base, way.writes, strict=True)
        ],
        **({} if done is None else outcome(done)),
    }


def _tell_back(done: DrivesWritten, now: datetime, doer: Applier, store: HistoryStore) -> None:
    store.rolled_back(
        at=now, who=str(doer), target=done.target, sha256_after=done.sha256_after, audit=done.audit_sha256
    )
