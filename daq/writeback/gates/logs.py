"""Gates of the logs that a calibration rests on: whole, fresh, of these drives, and with a payload weighed twice."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime

from daq.config.cell import WeighedPayload
from daq.config.policy import ApplyPolicy
from daq.workflow.safeguards import agree, tolerance_kg
from daq.writeback.gates.fit import role_refusals
from daq.writeback.gates.table import Gate, GateContext, Refusal
from daq.writeback.gates.target import axis_refusals
from ident.calibration import Calibration, Source
from ident.data.run import Recording

_SHA256 = re.compile(r"[0-9a-f]{64}")
_UNFINISHED = ".part"
_DAY_S = 86_400.0
_CLOCKS_DAYS = 1.0
"""By which the recorder's clock may be ahead of ours."""
_LONGEST_DAYS = 1e5
"""Some 270 years: no log is so old."""


def source_refusals(calibration: Calibration, policy: ApplyPolicy, held: GateContext) -> tuple[Refusal, ...]:
    """Closed gates of the logs, and of what the calibration says of the axes.

    Args:
        calibration: to be written.
        policy: bounds.
        held: what all of it is held against.
    """
    of_axes = () if held.axes is None else tuple(axis_refusals(calibration, held.axes))
    if not calibration.sources:
        return (
            *of_axes,
            Refusal(Gate.SOURCES, "calibration", "no logs it rests on", "at least one", "fit from logs of this cell"),
        )
    axes = [gain.axis for gain in calibration.gains]
    closed = [refusal for source in calibration.sources for refusal in _refusals(source, axes, policy, held)]
    roles = role_refusals(calibration) if held.is_given else ()
    return (*of_axes, *closed, *roles, *_exchanged(calibration.sources, axes))


def _refusals(source: Source, axes: list[str], policy: ApplyPolicy, held: GateContext) -> Iterator[Refusal]:
    name = f"log {source.name}"
    if source.name.endswith(_UNFINISHED) or not _SHA256.fullmatch(source.sha256):
        unfinished = source.name.endswith(_UNFINISHED)
        found = "a recording that was never finished" if unfinished else f"no SHA-256 digest ({source.sha256[:20]!r})"
        yield Refusal(Gate.SOURCES, name, found, "a finished, valid log", "record it again and fit")
    if source.partial:
        yield Refusal(
            Gate.PARTIAL,
            name,
            "what was salvaged of a recording that was never finished, or one with losses",
            "a recording that its recorder stands for to the end",
            "record it again and fit",
        )
    recording = source.recording
    if recording is None:
        if held.is_given:
            yield Refusal(
                Gate.SOURCES,
                name,
                "nothing of how it was recorded: the calibration is of an earlier drivegain",
                "its date, drives, payload and losses",
                "fit the logs again",
            )
        return
    if held.is_given:
        yield from _incomplete(recording, name, axes)
    yield from _losses(source, recording, name)
    yield from _age(recording, name, policy, held.now)
    yield from _serials(recording, name, axes, held)
    yield from _saturation(recording, name, axes, policy)
    yield from _mass(source, recording, name, held)


def _incomplete(recording: Recording, name: str, axes: list[str]) -> Iterator[Refusal]:
    """What a log does not tell of an axis must not pass for an axis with nothing to tell."""
    numbers = (
        ("serial numbers", len(recording.serials)),
        ("shares of saturated samples", len(recording.saturated_percent)),
        ("counts of missing answers", len(recording.missing)),
    )
    for what, count in numbers:
        if count != len(axes):
            yield Refusal(
                Gate.SOURCES,
                name,
                f"{what} of {count} axes",
                f"of each of the {len(axes)} axes that the calibration has",
                "fit the logs again",
            )
    shares = [percent for percent in recording.saturated_percent if not 0.0 <= percent <= 100.0]
    counts = [count for count in (recording.lost_cycles, *recording.missing) if count < 0]
    if shares or counts:
        yield Refusal(
            Gate.SOURCES,
            name,
            f"{shares[0]:g} % of saturated samples" if shares else f"a loss of {counts[0]} samples",
            "shares from 0 to 100 %, and counts of 0 or more",
            "fit the logs again",
        )


def _losses(source: Source, recording: Recording, name: str) -> Iterator[Refusal]:
    # A log whose losses somebody has accepted is called partial: once is enough.
    if not source.partial and (recording.lost_cycles or any(recording.missing)):
        yield Refusal(
            Gate.LOSSY,
            name,
            f"{recording.lost_cycles} SYNC cycles lost, {sum(recording.missing)} answers missing",
            "a recording without losses",
            "record it again, with less load on the bus and the computer, and fit",
        )


def _age(recording: Recording, name: str, policy: ApplyPolicy, now: datetime | None) -> Iterator[Refusal]:
    if now is None or policy.max_age_days is None:
        return
    expected = f"recorded within the last {_span(policy.max_age_days)}"
    days = None if recording.recorded_s is None else (now.timestamp() - recording.recorded_s) / _DAY_S
    # In numbers, not in dates: a hand-made date may be one that no calendar has.
    if days is not None and -_CLOCKS_DAYS <= days <= policy.max_age_days:
        return
    if days is None:
        found = "no date: it was imported"
        remedy = "record with drivegain, or allow it with `max_age_days: null` in the cell's `policy: {apply: ...}`"
    elif not abs(days) < _LONGEST_DAYS:
        found, remedy = f"a date that cannot be, {recording.recorded_s:g} s of Unix time", "fit the logs again"
    else:
        found = f"recorded {_span(days)} ago" if days > 0 else f"recorded {_span(-days)} from now"
        remedy = "record again and fit" if days > 0 else "set the clocks of this computer and of the recorder"
    yield Refusal(Gate.STALE, name, found, expected, remedy)


def _span(days: float) -> str:
    """In hours where days would be a small fraction."""
    return f"{round(days, 1):g} days" if days >= 1.0 else f"{24.0 * days:.2g} hours"


def _serials(recording: Recording, name: str, axes: list[str], held: GateContext) -> Iterator[Refusal]:
    declared = {} if held.serials is None else held.serials
    for axis, serial in zip(axes, recording.serials, strict=False):
        wanted = declared.get(axis)
        if wanted is not None and serial != wanted:
            yield Refusal(
                Gate.SERIAL,
                f"{name}, axis {axis}",
                "a drive that told no serial number" if serial is None else f"serial number {serial}",
                f"{wanted}, the drive of this axis in the cell file",
                "was the drive exchanged? then record again with it; else correct the cell file",
            )


def _exchanged(sources: tuple[Source, ...], axes: list[str]) -> Iterator[Refusal]:
    """Drives that differ between the logs of one fit."""
    logs = [(source.name, source.recording.serials) for source in sources if source.recording is not None]
    for index, axis in enumerate(axes):
        met: dict[int, str] = {}
        for name, serials in logs:
            serial = serials[index] if index < len(serials) else None
            if serial is not None:
                met.setdefault(serial, name)
        if len(met) > 1:
            found = ", ".join(f"{serial} in {name}" for serial, name in met.items())
            yield Refusal(
                Gate.SERIAL,
                f"axis {axis}",
                f"drives of different serial numbers ({found})",
                "one drive in all logs of a fit",
                "fit the logs of one drive only",
            )


def _saturation(recording: Recording, name: str, axes: list[str], policy: ApplyPolicy) -> Iterator[Refusal]:
    for axis, percent in zip(axes, recording.saturated_percent, strict=False):
        if percent > policy.max_saturated_percent:
            yield Refusal(
                Gate.SATURATED,
                f"{name}, axis {axis}",
                f"a limit acting in {percent:.1f} % of the samples",
                f"at most {policy.max_saturated_percent:g} %",
                "record slower moves (`record --speed`), or a smaller payload",
            )


def _mass(source: Source, recording: Recording, name: str, held: GateContext) -> Iterator[Refusal]:
    if held.payloads is None:
        return
    if source.payload is None:
        if source.mass_kg is not None or recording.entered_kg is not None:
            yield Refusal(Gate.MASS, name, "a mass, and no payload", "both or neither", "fit the logs again")
        return
    subject, fitted_kg = f"{name}, payload {source.payload}", source.mass_kg
    yield from _mass_now(subject, source.payload, fitted_kg, held.payloads)
    at_apply_kg = held.entered_kg.get(source.payload)
    entered = [kg for kg in (recording.entered_kg, at_apply_kg) if kg is not None]
    if fitted_kg is None or not entered:
        found = "no mass" if fitted_kg is None else f"{fitted_kg:g} kg, entered once (in the cell file)"
        yield Refusal(
            Gate.MASS,
            subject,
            found,
            "the same mass entered a second time, from the scale",
            f"weigh it and give --payload-mass {source.payload}=KG, or `record --mass KG` the next time",
        )
        return
    within_kg = tolerance_kg(held.payloads, source.payload)
    for other_kg in entered:
        if not agree(other_kg, fitted_kg, within_kg):
            yield Refusal(
                Gate.MASS,
                subject,
                f"{other_kg:g} kg entered the second time",
                f"{fitted_kg:g} kg within {within_kg:g} kg, as fitted",
                "weigh it again, correct the wrong one of the two, and fit: all gains are in proportion to this mass",
            )


def _mass_now(
    subject: str, payload: str, fitted_kg: float | None, payloads: tuple[WeighedPayload, ...]
) -> Iterator[Refusal]:
    """Whoever corrects a mass in the cell file says that the fit went with a wrong one."""
    declared = [one for one in payloads if one.name == payload]
    if not declared:
        names = ", ".join(one.name for one in payloads) or "none"
        yield Refusal(
            Gate.MASS,
            subject,
            "no such payload in the cell file now",
            f"one of the cell's: {names}",
            "give it back its name in the cell file, with its mass",
        )
    elif fitted_kg is not None and not any(agree(one.mass_kg, fitted_kg, one.mass_tolerance_kg) for one in declared):
        yield Refusal(
            Gate.MASS,
            subject,
            f"fitted with {fitted_kg:g} kg",
            f"{declared[0].mass_kg:g} kg within {declared[0].mass_tolerance_kg:g} kg, as in the cell file now",
            "fit the logs again with --cell, or correct the cell file: all gains are in proportion to this mass",
        )
