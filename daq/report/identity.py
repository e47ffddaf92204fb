"""Identity of a calibration: drives, operator, payload, dates, encoders and software, as texts by their names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from daq.report.gains import encoder_text, mass_texts
from daq.report.text import minute_text
from ident.calibration import Calibration
from ident.data.run import Recording


def identity(calibration: Calibration) -> dict[str, str]:
    """Drives, operator, payload, dates, encoders and software as texts by their names; what is missing is said.

    Encoders are there where the robot has more of them than degrees of freedom.
    """
    recordings = [source.recording for source in calibration.sources if source.recording is not None]
    operators = sorted({one.operator for one in recordings if one.operator})
    payloads = "; ".join(payload_texts(calibration))
    if payloads and not calibration.gains_fixed:
        # No residual shows a wrong mass: it must be on the sheet that a person signs.
        influences = "; ".join(mass_texts(calibration.payload_mass))
        # Calibrations of earlier versions do not say more.
        known = influences or "a wrong mass changes every gain, by the same share where nothing else of it is known"
        payloads = f"{payloads}; {known}"
    names = {
        "Serial numbers": _serials(calibration, recordings),
        "Operator": ", ".join(operators) or "not known: the recordings name none",
        "Payload": payloads or "none: every run was recorded without load",
        "Recorded": _period([one.recorded_s for one in recordings if one.recorded_s is not None]),
    }
    if calibration.encoder_misfit is not None:
        names["Encoders"] = encoder_text(calibration.encoder_misfit)
    names["Fitted"] = f"{minute_text(calibration.created)}, {calibration.software or 'software not known'}"
    return names


def payload_texts(calibration: Calibration) -> Iterator[str]:
    """The mass of each payload as it was entered twice: in the cell file, and from the scale at each recording."""
    mounted: dict[tuple[str, float | None], list[float]] = {}
    for source in calibration.sources:
        if source.payload is not None:
            entered = None if source.recording is None else source.recording.entered_kg
            masses = mounted.setdefault((source.payload, source.mass_kg), [])
            if entered is not None and entered not in masses:
                masses.append(entered)
    for (name, declared), masses in mounted.items():
        entry = "no mass in the cell file" if declared is None else f"{declared:g} kg in the cell file"
        scale = "not weighed a second time"
        if masses:
            scale = f"{' and '.join(f'{one:g}' for one in masses)} kg on the scale"
        yield f"{name}: {entry}, {scale}"


def _period(times_s: Sequence[float]) -> str:
    """Write the time between the first and the last recording to the minute, in UTC."""
    if not times_s:
        return "not known: the logs have no time of day"
    first, last = (datetime.fromtimestamp(one, UTC).strftime("%Y-%m-%d %H:%M") for one in (min(times_s), max(times_s)))
    if first == last:
        return f"{first} UTC"
    same_day = first[:10] == last[:10]
    return f"{first} to {last[11:] if same_day else last} UTC"


def _serials(calibration: Calibration, recordings: Sequence[Recording]) -> str:
    found = []
    for index, gain in enumerate(calibration.gains):
        serials = dict.fromkeys(one.serials[index] for one in recordings if index < len(one.serials))
        known = [str(serial) for serial in serials if serial is not None]
        if known:
            found.append(f"{gain.axis} {' and '.join(known)}")
    return ", ".join(found) or "not known: the drives reported none"
