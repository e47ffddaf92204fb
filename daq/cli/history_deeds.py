"""What was done with each calibration, in words, and which one's gains the controller has now."""

from __future__ import annotations

import math
from collections.abc import Sequence

from daq.configuration.cell import Cell
from daq.errors import ControllerUnfit
from daq.history.entry import Deed, Entry, Event
from daq.history.store import HistoryStore
from daq.write_back.controller_file import decode, read_bytes
from daq.write_back.drive_proposal import drives_of
from daq.write_back.link import followed
from daq.write_back.scalar import Scalar, respell

_WORDS = {Deed.APPLIED: "applied", Deed.ROLLED_BACK: "restored"}
"""Of an event after which a controller had the gains of a calibration."""


def in_force(cell: Cell, store: HistoryStore) -> str | None:
    """Digest of the calibration whose gains this cell's own controller has.

    The controller's file is asked, not the history alone: somebody may have edited it, or copied a backup back by hand,
    and what was written to another file (`apply --to`) is not in this controller. What stands in drives is asked of
    nobody here: there, what the history says counts.

    Returns:
        None where the file has other numbers than every calibration, or cannot be read.
    """
    controller, file = cell.controller, cell.controller_path
    if controller is None:
        return None
    if file is None or not controller.gains:
        return store.in_force(drives_of(cell.name)) if controller.objects else None
    try:
        target = str(followed(file))
        scalars = decode(read_bytes(file), str(file), controller.format).locate(controller.gains)
    except (ControllerUnfit, OSError):
        return None
    factors = controller.factors or (1.0,) * len(scalars)
    numbers = dict(zip(cell.axis_names, zip(scalars, factors, strict=True), strict=True))
    known, writes = store.in_force(target), [event.digest for event in store.events()]
    # Where several have these numbers: the one that the history names, else the one that was written last.
    order = [digest for digest in (known, *reversed(writes)) if digest is not None]
    having = [entry.digest for entry in reversed(store.entries()) if _has(entry, numbers)]
    return next((digest for digest in (*order, *having) if digest in having), None)


def deed_words(entries: Sequence[Entry], events: Sequence[Event], digest_in_force: str | None) -> dict[str, str]:
    """What was done with each calibration, by its digest.

    Args:
        entries: the calibrations.
        events: of all controllers, oldest first.
        digest_in_force: see `in_force`.
    """
    return {entry.digest: _words(entry.digest, events, digest_in_force) for entry in entries}


def _words(digest: str, events: Sequence[Event], digest_in_force: str | None) -> str:
    mine = [place for place, event in enumerate(events) if event.digest == digest]
    told = []
    if mine:
        last = events[mine[-1]]
        told.append(f"{_WORDS[last.deed]} by {last.who}")
        then = next((event for event in events[mine[-1] + 1 :] if event.target == last.target), None)
        if then is not None and then.deed is Deed.ROLLED_BACK:
            told.append(f"taken back by {then.who}")
    if digest == digest_in_force:
        told.append("in force")
    return ", ".join(told) or "-"


def _has(entry: Entry, numbers: dict[str, tuple[Scalar, float]]) -> bool:
    """Whether a write of this calibration would change no number."""
    gains = {gain.axis: gain for gain in entry.gains}
    if gains.keys() != numbers.keys():
        return False
    for axis, (scalar, factor) in numbers.items():
        gain = gains[axis]
        if not (math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value):
            return False
        try:
            put = respell(scalar, gain.value, gain.std, factor)
        except ControllerUnfit:
            return False
        if put.new != put.old:
            return False
    return True
