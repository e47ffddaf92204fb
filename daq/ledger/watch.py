"""The gains of a history as series with their charts,
and their alarms as sentences for a technician.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np

from daq.ledger.fold import Acknowledgement, Entry
from ident.arrays import FloatArray
from ident.calibration import Gain
from ident.drift.change import (
    Alarm,
    AlarmKind,
    Change,
    Drift,
    Pattern,
    change_significance,
    cusum,
    dispersions,
    pattern,
)


@dataclass(frozen=True, slots=True)
class Point:
    """One gain of one calibration."""

    entry: Entry  #: the calibration
    gain: Gain  #: identified, with σ
    change: Change | None  #: from the one before; None for the first


@dataclass(frozen=True, slots=True)
class Stretch:
    """Calibrations with one baseline."""

    began: int  #: index of the first of them in the points of its series
    drift: Drift  #: of the gain within

    @property
    def ended(self) -> int:
        """Index after the last of them."""
        return self.began + len(self.drift.deviations)


@dataclass(frozen=True, slots=True)
class Series:
    """One gain over time."""

    axis: str  #: of the gain
    unit: str  #: of the gain
    #: scatter of repeated calibrations over their σ; it is in every σ of this series
    dispersion: float
    #: Oldest recording first, one for the same logs, without calibrations that held the gain fixed.
    points: tuple[Point, ...]
    stretches: tuple[Stretch, ...]  #: between changes that were explained, oldest first
    #: whether the last of them goes on; not where no calibration came since the last explanation
    watching: bool
    acknowledged: tuple[Acknowledgement, ...]  #: changes that were explained, oldest first

    @property
    def began(self) -> int:
        """Index of the first point of the present baseline;
        as many as there are points where none came since.
        """
        if self.watching:
            return self.stretches[-1].began
        return len(self.points)

    @property
    def drift(self) -> Drift | None:
        """From the present baseline on; None without points since."""
        return self.stretches[-1].drift if self.watching else None

    @property
    def alarmed(self) -> bool:
        """Whether the newest calibration raises an alarm."""
        return self.drift is not None and self.drift.alarmed

    @property
    def onset(self) -> datetime | None:
        """When the last calibration before the change was recorded;
        None where the newest one raises no alarm.
        """
        if self.drift is None or self.drift.onset is None:
            return None
        return self.points[self.began + self.drift.onset].entry.recorded

    def stretch_at(self, index: int) -> Stretch:
        """The stretch that a point is in, by its index in `points`."""
        return next(stretch for stretch in self.stretches if stretch.began <= index < stretch.ended)

    def alarm_at(self, index: int) -> Alarm | None:
        """The alarm of a point, by its index in `points`."""
        stretch = self.stretch_at(index)
        return next(
            (alarm for alarm in stretch.drift.alarms if stretch.began + alarm.index == index), None
        )


def watch(
    entries: Sequence[Entry], acknowledgements: Sequence[Acknowledgement]
) -> tuple[Series, ...]:
    """Return one series an axis, in the order of the axes.

    Entries are of one cell, acknowledgements oldest first.
    """
    if not entries:
        return ()
    axes = {gain.axis: gain.unit for gain in entries[-1].gains}
    found = []
    for axis, dispersion in dispersions_of(entries, tuple(axes)).items():
        known = _known(entries, axis)
        acknowledged = tuple(noted for noted in acknowledgements if noted.axis == axis)
        # A stretch begins with the first calibration since an acknowledgement.
        starts: set[int] = set()
        for noted in acknowledged:
            starts.add(sum(entry.recorded < noted.since for entry, _ in known))
        stretches = []
        for began, ended in pairwise(sorted({0, *starts, len(known)})):
            gains = [gain for _, gain in known[began:ended]]
            values = [gain.value for gain in gains]
            deviations = [gain.std for gain in gains]
            drift = cusum(values, deviations, dispersion=dispersion)
            stretches.append(Stretch(began, drift))
        points = []
        for index, (entry, gain) in enumerate(known):
            change = None
            if index:
                before = known[index - 1][1]
                change = change_significance(
                    before.value, before.std, gain.value, gain.std, dispersion=dispersion
                )
            points.append(Point(entry, gain, change))
        watching = bool(stretches) and len(known) not in starts
        found.append(
            Series(
                axis,
                axes[axis],
                dispersion,
                tuple(points),
                tuple(stretches),
                watching,
                acknowledged,
            )
        )
    return tuple(found)


def dispersions_of(entries: Sequence[Entry], axes: Sequence[str]) -> dict[str, float]:
    """Return the scatter of a cell's calibrations over their σ, by axis, in the order of `axes`.

    It is estimated from the calibrations that identified an axis, one for the same logs
    (`of_each_recording`), together for axes that the same recordings identified
    (`ident.drift.change.dispersions`), also where a gain of one of them was held fixed when these
    were fitted again.

    Returns:
        at least 1 each, `ident.drift.change.DISPERSION` before there are five recordings of the
        axis.
    """
    #: for each axis its gains and their σ, shape (2, n)
    alike: dict[tuple[str, ...], dict[str, FloatArray]] = {}
    for axis in axes:
        known = _known(entries, axis)
        numbers = np.array([(gain.value, gain.std) for _, gain in known]).reshape(-1, 2)
        alike.setdefault(tuple(entry.logs for entry, _ in known), {})[axis] = numbers.T
    factors: dict[str, float] = {}
    for together in alike.values():
        values, stds = np.stack(list(together.values()), axis=1)
        factors |= zip(together, map(float, dispersions(values, stds)), strict=True)
    return {axis: factors[axis] for axis in axes}


def _known(entries: Sequence[Entry], axis: str) -> list[tuple[Entry, Gain]]:
    """Return the calibrations that identified the gain of an axis, with it."""
    known: dict[str, Gain] = {}
    for entry in entries:
        gain = entry.gain_of(axis)
        if gain is not None and gain.std > 0 and gain.value:
            known[entry.digest] = gain
    identified = [entry for entry in entries if entry.digest in known]
    return [(entry, known[entry.digest]) for entry in of_each_recording(identified)]


def of_each_recording(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """Return one calibration for the same logs, in the order in which the logs were recorded.

    The robot is watched: the same logs fitted again show nothing new of it, and logs of last year
    show last year, whenever they were fitted. Of several fits the newest applied one counts, else
    the newest.
    """
    chosen: dict[str, Entry] = {}
    for entry in sorted(entries, key=lambda one: (one.applied, one.created, one.entered)):
        chosen[entry.logs] = entry
    return tuple(sorted(chosen.values(), key=lambda one: (one.recorded, one.created, one.entered)))


# Questions, not verdicts: a gain shows that the torque for a current has changed, not why.
_LESS = (
    "less torque for the same current: magnets warmer than usual or demagnetised, a gear that "
    "turns harder under load, or an amplifier that was exchanged or scales its current otherwise? "
    "Worn teeth alone do not change a ratio; they show as backlash and friction (`drivegain "
    "residual`)"
)
_MORE = (
    "more torque for the same current: magnets colder than usual, a gear that was greased or has "
    "run in, or an amplifier that was exchanged or scales its current otherwise? Magnets do not "
    "grow stronger"
)
_ALL_LESS = (
    "all gains fell by the same factor, as motors seldom do: is the payload heavier than the mass "
    "that was entered, or was the scale of the currents changed (RMS or peak, rated current)?"
)
_ALL_MORE = (
    "all gains rose by the same factor, as motors seldom do: is the payload lighter than the mass "
    "that was entered, or was the scale of the currents changed (RMS or peak, rated current)?"
)
_SEVERAL = (
    "several axes, each by an amount of its own: another temperature of the cell, a payload that "
    "was mounted otherwise, or amplifiers that were exchanged?"
)


def alarm_text(series: Series) -> str | None:
    """`gain of J4 fell 6.0 % since 2026-03-02, 5.1 σ`;
    None where the newest calibration raises no alarm.
    """
    drift = series.drift
    onset = series.onset
    if drift is None or drift.alarm is None or onset is None:
        return None
    rose = drift.change_percent > 0
    since = f"since {onset:%Y-%m-%d}"
    percent = f"{abs(drift.change_percent):.1f} %"
    sigmas = f"{abs(drift.change_sigmas):.1f} σ"
    moved = "rose" if rose else "fell"
    match drift.alarm.kind:
        case AlarmKind.DRIFT:
            sentence = f"{moved} {percent} {since}"
        case AlarmKind.JUMP:
            sentence = f"{moved} {percent} at once, {since}"
        case AlarmKind.TREND:
            sentence = f"{'rises' if rose else 'falls'} steadily {since}, {percent} until now"
    return f"gain of {series.axis} {sentence}, {sigmas}"


def pattern_of(all_series: Sequence[Series]) -> Pattern:
    """Return the pattern of the changes of all axes, without axes that have no calibration since
    their baseline.
    """
    known = [(s, s.drift) for s in all_series if s.drift is not None and s.drift.change_sigmas != 0]
    changes = [drift.change_percent for _, drift in known]
    stds = [drift.change_percent / drift.change_sigmas for _, drift in known]
    return pattern(changes, stds, [series.alarmed for series, _ in known])


def questions(all_series: Sequence[Series]) -> tuple[str, ...]:
    """Return possible causes of the alarms as questions; none without an alarm."""
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
    configurations: set[str] = set()
    for series in all_series:
        points = series.points[series.began :]
        configurations.update(point.entry.configuration_sha256 for point in points)
    if len(configurations) > 1:
        found.append("the cell's configuration changed in this time: what was changed?")
    return tuple(found)
