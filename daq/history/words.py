"""Alarms as sentences for a technician: what changed, since when, how sure, and what it may be.

Questions, not verdicts: a gain tells that the torque for a current is another one, not why.
"""

from __future__ import annotations

from collections.abc import Sequence

from daq.history.watch import Series
from ident.drift_chart import AlarmKind
from ident.drift_pattern import Pattern, pattern

_LESS = (
    "less torque for the same current: magnets warmer than usual or demagnetised, a gear that turns harder under load, "
    "or an amplifier that was exchanged or scales its current otherwise? Worn teeth alone do not change a ratio; they "
    "show as backlash and friction (`drivegain residual`)"
)
_MORE = (
    "more torque for the same current: magnets colder than usual, a gear that was greased or has run in, or an "
    "amplifier that was exchanged or scales its current otherwise? Magnets do not grow stronger"
)
_ALL_LESS = (
    "all gains fell by the same factor, as motors seldom do: is the payload heavier than the mass that was entered, or "
    "was the scale of the currents changed (RMS or peak, rated current)?"
)
_ALL_MORE = (
    "all gains rose by the same factor, as motors seldom do: is the payload lighter than the mass that was entered, or "
    "was the scale of the currents changed (RMS or peak, rated current)?"
)
_SEVERAL = (
    "several axes, each by an amount of its own: another temperature of the cell, a payload that was mounted "
    "otherwise, or amplifiers that were exchanged?"
)


def alarm_words(series: Series) -> str | None:
    """`gain of J4 fell 6.0 % since 2026-03-02, 5.1 σ`; None where the newest calibration raises no alarm."""
    drift, onset = series.drift, series.onset
    if drift is None or drift.alarm is None or onset is None:
        return None
    rose, since = drift.change_percent > 0, f"since {onset:%Y-%m-%d}"
    percent, sigmas = f"{abs(drift.change_percent):.1f} %", f"{abs(drift.change_sigmas):.1f} σ"
    moved = "rose" if rose else "fell"
    match drift.alarm.kind:
        case AlarmKind.DRIFT:
            told = f"{moved} {percent} {since}"
        case AlarmKind.JUMP:
            told = f"{moved} {percent} at once, {since}"
        case AlarmKind.TREND:
            told = f"{'rises' if rose else 'falls'} steadily {since}, {percent} until now"
    return f"gain of {series.axis} {told}, {sigmas}"


def pattern_of(all_series: Sequence[Series]) -> Pattern:
    """What the changes of all axes look like together; axes without a calibration since their baseline say nothing."""
    known = [(s, s.drift) for s in all_series if s.drift is not None and s.drift.change_sigmas != 0]
    changes = [drift.change_percent for _, drift in known]
    stds = [drift.change_percent / drift.change_sigmas for _, drift in known]
    return pattern(changes, stds, [series.alarmed for series, _ in known])


def questions(all_series: Sequence[Series]) -> tuple[str, ...]:
    """What the alarms may come from; nothing where there are none."""
    alarmed = [s.drift for s in all_series if s.alarmed and s.drift is not None]
    rose = [drift.change_percent > 0 for drift in alarmed]
    match pattern_of(all_series):
        case Pattern.NONE:
            return ()
        case Pattern.COMMON:
            found = [_ALL_MORE if rose[0] else _ALL_LESS]
        case Pattern.ONE:
            found = [_MORE if rose[0] else _LESS]
        case Pattern.SEVERAL:
            found = [_SEVERAL]
    changed = len({entry for s in all_series for entry in _configurations(s)}) > 1
    return (*found, *(["the cell's configuration changed in this time: what was changed?"] if changed else []))


def _configurations(series: Series) -> tuple[str, ...]:
    """Digests of the cell configuration from the baseline on."""
    return tuple(point.entry.configuration_sha256 for point in series.points[series.began :])
