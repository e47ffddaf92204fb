"""The gate of what stands in the drives: it is still what drivegain left there, or what somebody has looked at."""

from __future__ import annotations

from pathlib import Path

from daq.errors import ControllerUnfit
from daq.write_back.drive_record import read_record, read_records
from daq.write_back.gates import Gate, Refusal
from drivers.parameter_write import ParameterValue

_LOOK = "look at a dry run and repeat it with the --base that it tells"


def drive_base_refusals(
    subject: str, base: tuple[ParameterValue, ...], base_sha256: str, folder: Path, looked_at: str | None
) -> tuple[Refusal, ...]:
    """Closed where somebody has changed a gain in a drive and nobody has looked at it since.

    The logs do not tell what stood in the drives. The newest record of a write does: a drive has what was written, or
    what stood there before, where the write was taken back or was never saved. Before the first write there is no
    record, and nothing to compare with.

    Args:
        subject: what to call the drives.
        base: what stands in them.
        base_sha256: its digest.
        folder: of the records.
        looked_at: digest of what somebody has looked at, in a dry run; it outweighs the record.
    """
    if looked_at is not None:
        if looked_at == base_sha256:
            return ()
        found, expected = f"content {base_sha256[:12]}…", f"{looked_at[:12]}…, as --base says"
        return (Refusal(Gate.BASE, subject, found, expected, "somebody has changed a gain: look at a new dry run"),)
    records = read_records(folder)
    if not records:
        return ()
    try:
        notes = {(note.axis, note.parameter): note for note in read_record(records[-1]).drives}
    except ControllerUnfit as error:
        return (Refusal(Gate.BASE, error.subject, error.found, error.expected, _LOOK),)
    changed = [
        (value, notes[value.axis.name, value.parameter])
        for value in base
        if (value.axis.name, value.parameter) in notes
        and value.word not in {(note := notes[value.axis.name, value.parameter]).old, note.new}
    ]
    return tuple(
        Refusal(
            Gate.BASE,
            f"{value.axis.name}, {value.parameter}",
            f"{value.value:.9g}",
            f"{value.parameter.value(note.new):.9g}, as {records[-1].name} says that it was written, or "
            f"{value.parameter.value(note.old):.9g} as before",
            f"somebody has changed it since, or exchanged the drive: {_LOOK}",
        )
        for value, note in changed
    )
