"""Gates of the logs behind a calibration:
whole, fresh, of these drives, and with a payload weighed twice.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from daq.config.cell import WeighedPayload
from daq.workflow.safeguards import agree, tolerance_kg
from daq.writeback.gates.gate import GateContext
from daq.writeback.request import GateFinding
from ident.calibration import Source
from ident.data.run import Recording
from ident.plausible import format_at_limit

_FIT = "fit"
_HOLDOUT = "holdout"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_UNFINISHED = ".part"
_DAY_S = 86_400.0
_CLOCKS_DAYS = 1.0  #: By which the recorder's clock may be ahead of ours
_LONGEST_DAYS = 1e5  #: Some 270 years: no log is so old


def sources(context: GateContext) -> Iterator[GateFinding]:
    """Require logs with their digests and recording data,
    for every axis (not those of an earlier drivegain).
    """
    if not context.calibration.sources:
        yield "calibration", "no logs it rests on", "at least one", "fit from logs of this cell"
    for source in context.calibration.sources:
        name = f"log {source.name}"
        unfinished = source.name.endswith(_UNFINISHED)
        if unfinished or not _SHA256.fullmatch(source.sha256):
            digest = f"no SHA-256 digest ({source.sha256[:20]!r})"
            if unfinished:
                found = "a recording that was never finished"
            else:
                found = digest
            yield name, found, "a finished, valid log", "record it again and fit"
        if context.cell is None:
            continue
        if source.recording is None:
            yield (
                name,
                "no data on the recording: the calibration is of an earlier drivegain",
                "its date, drives, payload and losses",
                "fit the logs again",
            )
        else:
            yield from _incomplete(source.recording, name, len(context.axis_names))


def _incomplete(recording: Recording, name: str, axes: int) -> Iterator[GateFinding]:
    """Find missing figures: an axis without one must not pass for an axis without a problem."""
    numbers = (
        ("serial numbers", len(recording.serials)),
        ("shares of saturated samples", len(recording.saturated_percent)),
        ("counts of missing answers", len(recording.missing)),
    )
    for kind, count in numbers:
        if count != axes:
            expected = f"one for each of the {axes} axes that the calibration has"
            yield name, f"{kind} of {count} axes", expected, "fit the logs again"
    shares = [percent for percent in recording.saturated_percent if not 0.0 <= percent <= 100.0]
    counts = [count for count in (recording.lost_cycles, *recording.missing) if count < 0]
    if shares or counts:
        if shares:
            found = f"{shares[0]:g} % of saturated samples"
        else:
            found = f"a loss of {counts[0]} samples"
        yield name, found, "shares from 0 to 100 %, and counts of 0 or more", "fit the logs again"


def roles(context: GateContext) -> Iterator[GateFinding]:
    """Require two logs in the fit, one with a payload;
    each recording once, with the role `fit` or `holdout`.
    """
    logs = context.calibration.sources
    if context.cell is None or not logs:
        return
    for source in logs:
        if source.role not in {_FIT, _HOLDOUT}:
            expected = f"{_FIT!r} or {_HOLDOUT!r}"
            yield f"log {source.name}", f"the role {source.role!r}", expected, "fit the logs again"
    fitted = [source for source in logs if source.role == _FIT]
    if not fitted:
        yield "calibration", "no log that was fitted", "at least one", "fit the logs again"
    elif not any(source.payload for source in fitted):
        yield (
            "calibration",
            "no payload in any log that was fitted",
            "one with a weighed payload, which sets the scale of the gains",
            "fit a loaded run too",
        )
    elif len(fitted) < 2:
        expected = "one without load and one with a weighed payload, or more"
        yield "calibration", "one log that was fitted", expected, "fit both"
    first: dict[str, str] = {}
    for source in logs:
        if source.sha256 in first:
            yield (
                f"log {source.name}",
                f"the same recording as log {first[source.sha256]}",
                "every recording once, in the fit or held out",
                "fit the logs again, each once",
            )
        first.setdefault(source.sha256, source.name)


def partial(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a log that was salvaged, or whose losses were accepted."""
    for source in context.calibration.sources:
        if source.partial:
            yield (
                f"log {source.name}",
                "the salvaged part of a recording that was never finished, or one with losses",
                "a complete recording that its recorder declared valid",
                "record it again and fit",
            )


def losses(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a log in which cycles or answers are missing."""
    for source, recording, name in _recordings(context):
        # A log whose losses were accepted is partial: one refusal is enough.
        if not source.partial and (recording.lost_cycles or any(recording.missing)):
            yield (
                name,
                f"{recording.lost_cycles} SYNC cycles lost, {sum(recording.missing)} "
                "answers missing",
                "a recording without losses",
                "record it again, with less load on the bus and the computer, and fit",
            )


def age(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a log that is too old, dated in the future, or has no valid date (imports)."""
    longest = context.policy.max_age_days
    if context.cell is None or longest is None:
        return
    expected = f"recorded within the last {_span(longest)}"
    for _, recording, name in _recordings(context):
        if recording.recorded_s is None:
            remedy = (
                "record with drivegain, or allow it with `max_age_days: null` in the cell's "
                "`policy: {apply: ...}`"
            )
            yield name, "no date: it was imported", expected, remedy
            continue
        # In numbers, not in dates: a hand-made date may be one that no calendar has.
        days = (context.request.now.timestamp() - recording.recorded_s) / _DAY_S
        if -_CLOCKS_DAYS <= days <= longest:
            continue
        if not abs(days) < _LONGEST_DAYS:
            found = f"an impossible date, {recording.recorded_s:g} s of Unix time"
            remedy = "fit the logs again"
        elif days > 0:
            found = f"recorded {_span(days, longest)} ago"
            remedy = "record again and fit"
        else:
            found = f"recorded {_span(-days)} from now"
            remedy = (
                "set the clocks of this computer and of the recorder; if a log was recorded under "
                "a wrong date, it "
            )
            remedy += "keeps that date: record again and fit"
        yield name, found, expected, remedy


def _span(days: float, limit_days: float = 0.0) -> str:
    """A time in days, or in hours where days would be a small fraction;
    with as many digits as show that it is beyond a limit.
    """
    if days < 1.0:
        return f"{24.0 * days:.2g} hours"
    rounded = round(days, 1)
    if rounded > limit_days:
        return f"{rounded:g} days"
    return f"{format_at_limit(days, limit_days, 2)} days"


def serials(context: GateContext) -> Iterator[GateFinding]:
    """Require the drives of the cell file, and the same drives in all logs of the fit."""
    axes = context.axis_names
    if context.cell is None:
        of_cell = {}
    else:
        of_cell = {axis.name: axis.identity for axis in context.cell.axes}
    declared = {name: identity.serial for name, identity in of_cell.items() if identity is not None}
    recordings = list(_recordings(context))
    for _, recording, name in recordings:
        for axis, serial in zip(axes, recording.serials, strict=False):
            wanted = declared.get(axis)
            if wanted is not None and serial != wanted:
                yield (
                    f"{name}, axis {axis}",
                    "a drive that reported no serial number"
                    if serial is None
                    else f"serial number {serial}",
                    f"{wanted}, the drive of this axis in the cell file",
                    "was the drive exchanged? then record again with it; else correct the "
                    "cell file",
                )
    for index, axis in enumerate(axes):
        logs: dict[int, str] = {}
        for source, recording, _ in recordings:
            if index < len(recording.serials):
                serial = recording.serials[index]
            else:
                serial = None
            if serial is not None:
                logs.setdefault(serial, source.name)
        if len(logs) > 1:
            found = ", ".join(f"{serial} in {name}" for serial, name in logs.items())
            yield (
                f"axis {axis}",
                f"drives of different serial numbers ({found})",
                "one drive in all logs of a fit",
                "fit the logs of one drive only",
            )


def saturation(context: GateContext) -> Iterator[GateFinding]:
    """Bound the share of samples of an axis in which a limit of the drive acted."""
    bound = context.policy.max_saturated_percent
    for _, recording, name in _recordings(context):
        for axis, percent in zip(context.axis_names, recording.saturated_percent, strict=False):
            if percent > bound:
                yield (
                    f"{name}, axis {axis}",
                    f"a limit acting in {format_at_limit(percent, bound, 1)} % of the samples",
                    f"at most {bound:g} %",
                    "record slower moves (`record --speed`), or a smaller payload",
                )


def mass(context: GateContext) -> Iterator[GateFinding]:
    """Require a mass entered twice, and in the fit and the cell file as it is now,
    alike within the tolerance.
    """
    if context.cell is None:
        return
    payloads = context.cell.payloads
    for source, recording, name in _recordings(context):
        fitted_kg = source.mass_kg
        if source.payload is None:
            if fitted_kg is not None or recording.entered_kg is not None:
                yield name, "a mass, and no payload", "both or neither", "fit the logs again"
            continue
        subject = f"{name}, payload {source.payload}"
        yield from _mass_now(subject, source.payload, fitted_kg, payloads)
        weighed_kg = (recording.entered_kg, context.request.entered_kg.get(source.payload))
        entered = [kg for kg in weighed_kg if kg is not None]
        if fitted_kg is None or not entered:
            yield (
                subject,
                "no mass"
                if fitted_kg is None
                else f"{fitted_kg:g} kg, entered once (in the cell file)",
                "the same mass entered a second time, from the scale",
                f"weigh it and give --payload-mass {source.payload}=KG, or `record --mass KG` the "
                "next time",
            )
            continue
        within_kg = tolerance_kg(payloads, source.payload)
        for other_kg in entered:
            if not agree(other_kg, fitted_kg, within_kg):
                yield (
                    subject,
                    f"{other_kg:g} kg entered the second time",
                    f"{fitted_kg:g} kg within {within_kg:g} kg, as fitted",
                    "weigh it again, correct the wrong one of the two, and fit: all gains scale "
                    "with this mass",
                )


def _mass_now(
    subject: str, payload: str, fitted_kg: float | None, payloads: tuple[WeighedPayload, ...]
) -> Iterator[GateFinding]:
    """Compare with the cell file of now: a mass that was corrected there means that the fit used a
    wrong one.
    """
    declared = [one for one in payloads if one.name == payload]
    if not declared:
        names = ", ".join(one.name for one in payloads) or "none"
        remedy = "give it back its name in the cell file, with its mass"
        yield subject, "no such payload in the cell file now", f"one of the cell's: {names}", remedy
    elif fitted_kg is not None and not any(
        agree(one.mass_kg, fitted_kg, one.mass_tolerance_kg) for one in declared
    ):
        yield (
            subject,
            f"fitted with {fitted_kg:g} kg",
            f"{declared[0].mass_kg:g} kg within {declared[0].mass_tolerance_kg:g} kg, as in the "
            "cell file now",
            "fit the logs again with --cell, or correct the cell file: all gains scale with "
            "this mass",
        )


def _recordings(context: GateContext) -> Iterator[tuple[Source, Recording, str]]:
    """Logs whose recording is described, each with the name for messages."""
    for source in context.calibration.sources:
        if source.recording is not None:
            yield source, source.recording, f"log {source.name}"
