"""`drivegain history`: what a technician sees of drifts, of broken audits,
and of nothing at all.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.documents.calibration_file import save_calibration
from daq.files import sha256_of
from daq.formats.document import decode_document as read_controller
from daq.formats.scalar import rewrite_gain
from daq.jobs.session import Basis, begin
from daq.jobs.session import save as save_session
from daq.ledger.audit import AuditAction, AuditEntry, append, read
from daq.ledger.fold import Entry, Event, WriteAction, logs_of, recorded_at
from daq.ledger.ledger import acknowledge, enter_calibration, read_history
from daq.ledger.names import drives_of
from daq.ledger.watch import Point, Series, alarm_text, dispersions_of, questions, watch
from daq.report.history import COLUMNS, describe_actions
from daq.writeback.file_access import resolve_links
from daq.writeback.judgement import figures_of_history
from daq.writeback.request import GainChange
from ident.calibration import Calibration, Gain
from ident.drift.change import DISPERSION, dispersions
from tests.daq.calibrations import AXES, recorded, with_recordings
from tests.daq.histories import (
    BEGIN,
    RECALIBRATION,
    calibration_of,
    digest_of,
    enter,
    fill,
    history_of,
    ledger_of,
    write,
)

FLAT = (1.0,) * 6
Factors = tuple[float, ...]


def _of_j4(factor: float) -> Factors:
    """The gain of J4 by this factor, the others by 1."""
    return (1.0, 1.0, 1.0, factor, 1.0, 1.0)


def drifting(week: int) -> Factors:
    """J4 loses 6 % from the 14th calibration on, in twelve weeks."""
    weeks_of_drift = max(week - 13, 0)
    drift_share = min(weeks_of_drift / 12.0, 1.0)
    factor = 1.0 - 0.06 * drift_share
    return _of_j4(factor)


def sloping(week: int) -> Factors:
    """J4 loses 0.2 % a week from the first calibration on."""
    factor = 1.0 - 0.002 * week
    return _of_j4(factor)


def stepping(factors: Factors) -> Callable[[int], Factors]:
    """All gains by their factors from the 15th calibration on."""
    return lambda week: factors if week > 14 else FLAT


def _place(cell_file: Path) -> HistoryPlace:
    place = load_cell(cell_file).history
    assert place is not None
    return place


@dataclass(frozen=True)
class _FilledAudit:
    """Digests of the calibrations, and content of the file."""

    digests: tuple[str, ...]
    content: bytes


_audits: dict[tuple[Factors, ...], _FilledAudit] = {}
"""Filled ones, by the true factors of each week."""


def _filled(cell_file: Path, weeks: int, true: Callable[[int], Factors]) -> tuple[str, ...]:
    """Fill the history, which has no file yet; the digests of its calibrations.

    Equal ones are filled once.
    """
    path = _place(cell_file).audit
    key = tuple(map(true, range(weeks)))
    assert not path.exists()
    if key not in _audits:
        digests = fill(ledger_of(cell_file), weeks, true)
        _audits[key] = _FilledAudit(digests, path.read_bytes())
    filled = _audits[key]
    path.write_bytes(filled.content)
    return filled.digests


def _series(cell_file: Path) -> tuple[Series, ...]:
    history = history_of(cell_file)
    return watch(history.entries, history.acknowledgements)


def _history(cell_file: Path, *arguments: str | Path) -> int:
    """Run `drivegain history` on the cell; its exit code."""
    texts = [str(argument) for argument in arguments]
    return main(["history", str(cell_file), *texts])


def _json(capsys: pytest.CaptureFixture[str], cell_file: Path, *arguments: str) -> dict[str, Any]:
    assert _history(cell_file, *arguments, "--json") == 0
    printed = capsys.readouterr().out
    found: dict[str, Any] = json.loads(printed)
    return found


def _one_spaced(text: str) -> str:
    """The words of a text, one space between them."""
    return " ".join(text.split())


def _dispersions(cell_file: Path) -> dict[str, float]:
    """Those of the charts."""
    return {series.axis: series.dispersion for series in _series(cell_file)}


def _with_first_gain_fixed(calibration: Calibration) -> Calibration:
    first, *others = calibration.gains
    fixed = replace(first, std=0.0)
    return replace(calibration, gains=(fixed, *others))


def _event_facts(event: Event) -> tuple[Any, ...]:
    return (event.action, event.at, event.who, event.audit)


def _entry(digest: str) -> Entry:
    demo = calibration_of(0)
    return Entry(
        digest, BEGIN, BEGIN, "", BEGIN, "demo", "", "ml", "", 3.0, None, 1, demo.gains, ()
    )


def _put(cell_file: Path, digest: str) -> str:
    """The gains of a calibration into the cell's controller, past drivegain; its file."""
    controller = load_cell(cell_file).controller_path
    assert controller is not None
    entries = history_of(cell_file).entries
    (entry,) = [one for one in entries if one.digest == digest]
    keys = tuple(f"drives.{gain.axis}.gain" for gain in entry.gains)
    document = read_controller(controller.read_bytes(), controller.name)
    scalars = document.locate(keys)
    spelling = {}
    for scalar, gain in zip(scalars, entry.gains, strict=True):
        rewritten = rewrite_gain(scalar, gain.value, gain.std)
        spelling[scalar.key] = rewritten.spelling
    controller.write_bytes(document.with_values(spelling).content)
    return str(controller.resolve())


def test_an_empty_history_says_what_to_do(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _history(cell_file) == 0
    assert "The history is empty" in capsys.readouterr().out
    axes = _json(capsys, cell_file)["axes"]
    assert axes == []
    assert _history(cell_file, "--verify") == 0
    assert "0 entries, chain unbroken" in capsys.readouterr().out
    assert not _place(cell_file).audit.exists()
    assert _history(cell_file, "--axis", "J4") == 2
    picture = cell_file.with_suffix(".png")
    assert _history(cell_file, "--plot", picture) == 2


def test_a_calibration_is_entered_by_hand(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration_of(0), file)
    assert _history(cell_file, "--add", file) == 0
    shown = capsys.readouterr()
    assert "entered" in shown.err
    assert "33.90 ± 0.14" in shown.out
    assert "baseline: 1 of 12" in shown.out
    assert _history(cell_file, "--add", file) == 0
    assert "already" in capsys.readouterr().err
    calibration = replace(calibration_of(1), cell="another")
    save_calibration(calibration, file)
    assert _history(cell_file, "--add", file) == 4
    assert "another" in capsys.readouterr().err
    assert _history(cell_file, "--add", cell_file) == 4
    missing = f"{file}.none"
    assert _history(cell_file, "--add", missing) == 4
    points = _series(cell_file)[0].points
    assert len(points) == 1


@pytest.mark.slow
def test_a_drift_is_reported_with_its_time_its_size_and_a_question(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    digests = _filled(cell_file, 26, drifting)
    written = BEGIN + timedelta(weeks=8)
    write(ledger_of(cell_file), "x.yaml", "1", digest=digests[8], at=written)
    _put(cell_file, digests[8])
    assert _history(cell_file) == 0
    printed = capsys.readouterr().out
    out = _one_spaced(printed)
    assert re.search(r"ALARM: gain of J4 fell 5\.\d % since 2026-04-\d\d, \d\d\.\d σ", out)
    assert out.count("ALARM:") == 1
    assert "demagnetised" in out
    assert "Worn teeth alone do not change a ratio" in out
    assert "applied by anna, in force" in out

    found = _json(capsys, cell_file, "--axis", "J4")
    (axis,) = found["axes"]
    assert found["pattern"] == "one axis"
    assert axis["alarmed"]
    percent = axis["change_percent"]
    assert percent == pytest.approx(-5.7, abs=0.5)

    # 6 % in twelve weeks with σ 0.4 % have cumulated 3 σ after three.
    alarms = [bool(point["alarm"]) for point in axis["points"]]
    first = alarms.index(True)
    assert 15 <= first <= 18

    assert found["in_force"] == digests[8]
    writers = [point["applied_by"] for point in axis["points"]]
    names = [name for name in writers if name]
    assert names == ["anna"]


@pytest.mark.slow
def test_a_drift_from_the_first_day_is_reported_as_steady(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 9, sloping)
    assert _history(cell_file, "--axis", "J4") == 0
    printed = capsys.readouterr().out
    out = _one_spaced(printed)
    reported = re.search(
        r"ALARM: gain of J4 falls steadily since 2026-01-05, (\d\.\d) % until "
        r"now, (\d\.\d) σ",
        out,
    )
    assert reported is not None
    percent = float(reported[1])
    sigmas = float(reported[2])
    assert percent == pytest.approx(1.6, abs=1.0)  # 8 × 0.2 %, and its σ is 0.5 %
    assert "demagnetised" in out
    found = _json(capsys, cell_file, "--axis", "J4")
    points = found["axes"][0]["points"]
    point = points[-1]
    assert point["alarm"] == "trend"
    absolute_trend_sigma = abs(point["trend_sigmas"])
    assert absolute_trend_sigma == pytest.approx(sigmas, abs=0.05)
    trend = found["chart"]["trend"]
    assert point["trend_sigmas"] < -trend
    picture = cell_file.parent / "history.svg"
    assert _history(cell_file, "--plot", picture) == 0
    assert b"steady change" in picture.read_bytes()


@pytest.mark.slow
def test_an_alarm_that_has_passed_has_no_date(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """5 % on one day, the fourth: its row keeps the alarm,
    and the rest of the gain is as of any other.
    """

    def fourth_day(week: int) -> Factors:
        factor = 0.95 if week == 3 else 1.0
        return _of_j4(factor)

    _filled(cell_file, 20, fourth_day)

    series = _series(cell_file)[3]
    assert series.alarm_at(3) is not None
    assert series.alarmed is False
    assert series.onset is None
    assert alarm_text(series) is None

    found = _json(capsys, cell_file, "--axis", "J4")
    (axis,) = found["axes"]
    assert axis["alarmed"] is False
    assert axis["alarm"] is None
    assert axis["since"] is None
    gains = [point.gain for point in series.points[:12]]
    known = [gain.value for gain in gains]
    stds = [gain.std for gain in gains]
    weights = np.array(stds) ** -2.0
    mean_known = np.average(known, weights=weights)
    assert axis["baseline"] == pytest.approx(mean_known)


@pytest.mark.slow
def test_without_a_drift_there_is_no_alarm(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 25, lambda _: FLAT)
    assert _history(cell_file) == 0
    out = capsys.readouterr().out
    assert "No alarm." in out
    assert "ALARM" not in out
    found = _json(capsys, cell_file)
    assert found["questions"] == []


@pytest.mark.parametrize(
    ("factors", "says"),
    [
        ((0.96,) * 6, "is the payload heavier than the mass that was entered"),
        ((1.04,) * 6, "is the payload lighter than the mass that was entered"),
        ((1.0, 1.0, 1.0, 1.05, 1.0, 1.0), "Magnets do not grow stronger"),
        ((1.0, 0.95, 1.0, 1.05, 1.0, 1.0), "several axes, each by an amount of its own"),
    ],
)
def test_each_pattern_has_its_question(cell_file: Path, factors: Factors, says: str) -> None:
    _filled(cell_file, 20, stepping(factors))
    assert says in questions(_series(cell_file))[0]


def test_a_configuration_that_changed_is_asked_for(cell_file: Path) -> None:
    factors = (0.96,) * 6
    _filled(cell_file, 20, stepping(factors))
    calibration = calibration_of(20, factors)
    configured = replace(calibration, configuration_sha256="d" * 64)
    enter(ledger_of(cell_file), configured)
    assert "configuration changed" in questions(_series(cell_file))[1]


def test_a_gain_below_zero_falls_towards_zero(cell_file: Path) -> None:
    factors = (1.0, 1.0, 1.0, 0.9, 1.0, 1.0)
    _filled(cell_file, 20, stepping(factors))
    series = _series(cell_file)[3]
    last_point = series.points[-1]
    assert last_point.gain.value < 0
    words = alarm_text(series)
    assert words is not None
    assert words.startswith("gain of J4 fell 9.6 %")


def test_the_same_logs_fitted_again_are_no_other_day(cell_file: Path) -> None:
    """Twelve fits of one session are one calibration:
    the newest that was applied, else the newest.
    """
    logs = calibration_of(0).sources
    fits = []
    for week in range(12):
        factor = 1.0 + 0.001 * week
        calibration = calibration_of(week, (factor,) * 6)
        sources = logs[::-1] if week % 2 else logs
        fits.append(replace(calibration, sources=sources))
    ledger = ledger_of(cell_file)

    def points() -> tuple[Point, ...]:
        entries = read_history(ledger).entries
        return watch(entries, ())[3].points

    digests = [enter(ledger, fit) for fit in fits]
    assert len(read_history(ledger).entries) == 12
    (point,) = points()
    expected = digests[-1]
    assert point.entry.digest == expected
    assert point.entry.recorded == BEGIN
    write(ledger, "x.yaml", "1", digest=digests[4])
    enter(ledger, calibration_of(1))
    next_day = digest_of(calibration_of(1))
    charted = [point.entry.digest for point in points()]
    assert charted == [digests[4], next_day]

    # Knows no gain, hides none
    gains = fits[0].gains
    fixed = tuple(replace(gain, std=0.0) for gain in gains)
    sources = calibration_of(1).sources
    changed_fit = replace(fits[0], gains=fixed, sources=sources)
    enter(ledger, changed_fit)
    digest = points()[1].entry.digest
    assert digest == next_day

    # Another log held out is another question to the same recordings.
    sha256 = "9" * 64
    changed_log = replace(logs[2], sha256=sha256)
    other_sources = (*logs[:2], changed_log)
    other = replace(fits[0], sources=other_sources)
    assert logs_of(other, "") == logs_of(fits[0], "")
    calibration = replace(fits[0], sources=())
    assert logs_of(calibration, "its own") == "its own"


def test_old_logs_fitted_today_report_their_own_time(cell_file: Path) -> None:
    """A gain that was another one a year ago has not changed today."""
    _filled(cell_file, 20, lambda _: FLAT)
    factors = (0.9,) * 6
    calibration = calibration_of(30, factors)
    time_of_logs = BEGIN - timedelta(days=400)
    year_ago = recorded(calibration, time_of_logs)
    enter(ledger_of(cell_file), year_ago)
    last_entry = history_of(cell_file).entries[-1]
    assert last_entry.digest == digest_of(year_ago)  # fitted last
    series = _series(cell_file)[3]
    digest = series.points[0].entry.digest
    assert digest == digest_of(year_ago)
    times = [point.entry.recorded for point in series.points[:2]]
    assert times == [time_of_logs, BEGIN]
    second_week = BEGIN + timedelta(weeks=1)
    assert series.onset is None or series.onset < second_week


@pytest.mark.parametrize("recorded_s", [None, float("nan"), 1e300])
def test_a_log_without_its_time_has_that_of_the_fit(recorded_s: float | None) -> None:
    calibration = with_recordings(calibration_of(3), recorded_s=recorded_s)
    assert recorded_at(calibration, BEGIN) == BEGIN


def test_a_gain_that_was_held_fixed_knows_nothing(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 3, lambda _: FLAT)
    fixed = _with_first_gain_fixed(calibration_of(5))
    enter(ledger_of(cell_file), fixed)
    charts = _series(cell_file)
    point_counts = [len(series.points) for series in charts]
    assert point_counts == [3, 4, 4, 4, 4, 4]
    assert _history(cell_file) == 0
    assert "J1" in capsys.readouterr().out


def _job_s_dispersions(cell_file: Path, own: Calibration | None = None) -> dict[str, float]:
    """Those that a job judges by, which has kept its own calibration where one is given."""
    declared = load_cell(cell_file)
    controller = declared.controller_path
    assert controller is not None
    digest = ""
    if own is not None:
        file = cell_file.parent / "own.yaml"
        save_calibration(own, file)
        digest = sha256_of(file) or ""
        enter_calibration(ledger_of(cell_file), own, digest=digest, who="job", at=BEGIN)
    changes = []
    for name in declared.axis_names:
        changes.append(GainChange(name, name, 1, 1.0, 1.0, 0.1, "Nm/A", 1.0, ""))
    target = str(resolve_links(controller))
    known = figures_of_history(history_of(cell_file), target, digest, changes)
    return dict(known.dispersions)


def test_a_job_and_the_charts_know_one_scatter(cell_file: Path) -> None:
    """Also where a session was fitted again with a gain held fixed,
    and where that is its only fit.
    """

    def scattering(week: int) -> Factors:
        factor = 1.0 + 0.012 * (-1) ** week
        return (factor,) * 6

    _filled(cell_file, 12, scattering)
    before = _dispersions(cell_file)
    assert min(before.values()) > 1.5
    assert _job_s_dispersions(cell_file) == before

    factors = (1.0 - 0.012,) * 6
    again = _with_first_gain_fixed(calibration_of(5, factors))
    enter(ledger_of(cell_file), again)
    charts = _series(cell_file)
    point_counts = [len(series.points) for series in charts]
    assert point_counts == [12] * 6
    refitted = _dispersions(cell_file)
    assert _job_s_dispersions(cell_file) == refitted
    assert refitted == pytest.approx(before, rel=0.05)  # the same recordings of all axes as before

    alone = _with_first_gain_fixed(calibration_of(12))
    enter(ledger_of(cell_file), alone)
    charts = _series(cell_file)
    point_counts = [len(series.points) for series in charts]
    assert point_counts == [12, 13, 13, 13, 13, 13]
    found = _dispersions(cell_file)
    assert _job_s_dispersions(cell_file) == found

    # What a session has found itself is not what it is judged by.
    own = calibration_of(13, (1.2,) * 6)
    assert _job_s_dispersions(cell_file, own) == found
    assert _dispersions(cell_file) != found


def test_the_scatter_of_axes_is_reported_together_where_the_same_recordings_know_them() -> None:
    rng = np.random.default_rng(12)
    names = ("J1", "J2", "J3")
    values = rng.normal(10.0, 0.3, (9, 3))
    stds_nm_per_a = np.full(values.shape, 0.1)
    stds_nm_per_a[4, 2] = 0.0  # J3 was held fixed once.
    entries = []
    for week, row in enumerate(values):
        gains = []
        for axis, value, std in zip(names, row, stds_nm_per_a[week], strict=True):
            gains.append(Gain(axis, float(value), float(std), "Nm/A", 10.0))
        entry = _entry(str(week))
        recorded = BEGIN + timedelta(weeks=week)
        week_entry = replace(entry, logs=str(week), recorded=recorded, gains=tuple(gains))
        entries.append(week_entry)

    found = dispersions_of(entries, names)

    assert tuple(found) == names
    stds = np.full((2, 9), 0.1)
    together = dispersions(values[:, :2].T, stds)
    found_together = [found["J1"], found["J2"]]
    np.testing.assert_allclose(found_together, together)
    without_fixed = np.delete(values[:, 2], 4)
    stds = np.full((1, 8), 0.1)
    (alone,) = dispersions([without_fixed], stds)
    np.testing.assert_allclose(found["J3"], alone)

    of_few_recordings = dict.fromkeys(names, DISPERSION)
    assert dispersions_of(entries[:4], names) == of_few_recordings
    assert dispersions_of((), names) == of_few_recordings
    assert dispersions_of(entries, ("J9",)) == {"J9": DISPERSION}
    assert dispersions_of(entries, ()) == {}


def test_an_axis_has_a_table_of_its_own(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 5, lambda _: FLAT)
    assert _history(cell_file, "--axis", "J4") == 0
    out = capsys.readouterr().out
    assert out.count("2026-0") == 5
    assert "CUSUM" in out
    assert "No alarm" in out
    assert _history(cell_file, "--axis", "J9") == 2
    error_output = capsys.readouterr().err
    assert "one of J1" in _one_spaced(error_output)


def test_a_change_that_is_explained_begins_a_new_baseline(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 26, drifting)
    why = ("--why", "gearbox changed")
    assert _history(cell_file, "--acknowledge", "J4", "--by", "anna", *why) == 0
    capsys.readouterr()
    series = _series(cell_file)[3]
    assert not series.alarmed
    assert series.began == 25
    begins = [stretch.began for stretch in series.stretches]
    assert begins == [0, 25]
    assert series.alarm_at(24) is not None  # a shown alarm stays
    charts = _series(cell_file)
    others = [other for other in charts if other.axis != "J4"]
    assert not any(other.acknowledged for other in others)
    path = _place(cell_file).audit
    entry = read(path)[-1]
    assert entry.action is AuditAction.ACKNOWLEDGED
    assert entry.who.startswith("anna")
    assert entry.details["why"] == "gearbox changed"
    assert _history(cell_file, "--axis", "J4") == 0
    assert "gearbox changed" in capsys.readouterr().out
    assert _history(cell_file, "--verify") == 0
    # The next calibrations at the new level are compared with that level.
    for week in range(26, 30):
        calibration = calibration_of(week, drifting(week))
        enter(ledger_of(cell_file), calibration)
    assert not _series(cell_file)[3].alarmed


def test_a_new_baseline_begins_where_one_says(cell_file: Path) -> None:
    factors = (1.0, 1.0, 1.0, 0.9, 1.0, 1.0)
    _filled(cell_file, 20, stepping(factors))
    explain = ("--acknowledge", "J4", "--why", "motor exchanged", "--since")
    assert _history(cell_file, *explain, "someday") == 2
    exchanged = BEGIN + timedelta(weeks=15)
    day = exchanged.date().isoformat()
    assert _history(cell_file, *explain, day) == 0
    series = _series(cell_file)[3]
    assert series.began == 15
    assert not series.alarmed

    # A baseline that is still to come would silence the axis until then.
    to_come = BEGIN.replace(year=2130)
    ledger = ledger_of(cell_file)
    acknowledge(ledger, "J4", since=to_come, at=BEGIN, who="anna", why="x")
    assert _series(cell_file)[3].acknowledged == series.acknowledged

    # One that began after the newest recording.
    acknowledge(ledger, "J4", since=to_come, at=to_come, who="a", why="x")
    series = _series(cell_file)[3]
    assert series.began == 20
    assert series.drift is None
    assert series.onset is None
    assert alarm_text(series) is None
    assert _history(cell_file, "--axis", "J4") == 0


def test_a_baseline_that_begins_later_than_now_is_refused(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 3, lambda _: FLAT)
    explain = ("--acknowledge", "J4", "--why", "planned", "--since")
    assert _history(cell_file, *explain, "2130-01-02T03:04:05+01:00") == 2
    error_output = capsys.readouterr().err
    output = _one_spaced(error_output)
    assert "2130-01-02 02:04:05 UTC" in output
    now = datetime.now(UTC)
    assert f"no later than now, {now:%Y-%m-%d}" in output
    path = _place(cell_file).audit
    assert len(read(path)) == 3
    today = datetime.now(UTC).date().isoformat()
    assert _history(cell_file, *explain, today) == 0


def test_a_log_of_tomorrow_begins_its_baseline_now(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clock of its recorder was ahead."""
    days = (datetime.now(UTC) - BEGIN).days
    weeks = days // 7 + 2
    enter(ledger_of(cell_file), calibration_of(weeks))
    explain = ("--acknowledge", "J4", "--why", "motor exchanged")
    assert _history(cell_file, *explain) == 0
    assert _series(cell_file)[3].began == 0
    assert _history(cell_file, "--verify") == 0
    capsys.readouterr()


@pytest.mark.parametrize(
    "arguments",
    [
        ["--acknowledge", "J4"],
        ["--acknowledge", "J4", "--why", "  "],
        ["--acknowledge", "J9", "--why", "x"],
        ["--why", "x"],
        ["--by", "anna"],
        ["--since", "2026-01-01"],
    ],
)
def test_an_explanation_without_its_parts_is_refused(cell_file: Path, arguments: list[str]) -> None:
    _filled(cell_file, 3, lambda _: FLAT)
    assert _history(cell_file, *arguments) == 2
    path = _place(cell_file).audit
    assert len(read(path)) == 3


@pytest.mark.slow
def test_the_table_leaves_as_csv(cell_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _filled(cell_file, 15, drifting)
    out = cell_file.parent / "history.csv"
    assert _history(cell_file, "--csv", out) == 0
    assert _history(cell_file, "--csv", out) == 0  # an earlier one is replaced
    with out.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert tuple(rows[0]) == COLUMNS
    axes = [row["axis"] for row in rows[::15]]
    assert axes == list(AXES)
    found = {series.axis: series for series in _series(cell_file)}
    points = found["J4"].points
    rows_of_j4 = rows[45:60]
    for row, point in zip(rows_of_j4, points, strict=True):
        gain = float(row["gain"])
        created = datetime.fromisoformat(row["created"])
        assert gain == point.gain.value
        assert created == point.entry.created
        assert row["unit"] == "Nm/A"
    assert rows[0]["change_percent"] == ""
    capsys.readouterr()
    assert _history(cell_file, "--csv", cell_file) == 2
    content = cell_file.read_bytes()
    assert content.startswith(b"#") or b"axes" in content


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".png", ".svg"])
@pytest.mark.parametrize("arguments", [[], ["--axis", "J4"]])
def test_the_picture_is_drawn_the_same_each_time(
    cell_file: Path, suffix: str, arguments: list[str]
) -> None:
    _filled(cell_file, 26, drifting)
    out = cell_file.parent / f"history{suffix}"
    assert _history(cell_file, "--plot", out, *arguments) == 0
    first = out.read_bytes()
    assert len(first) > 10_000
    start = {".png": b"\x89PNG", ".svg": b"<?xml"}[suffix]
    assert first.startswith(start)
    assert _history(cell_file, "--plot", out, *arguments) == 0
    assert out.read_bytes() == first


@pytest.mark.slow
def test_a_picture_has_its_kind_and_replaces_only_its_like(cell_file: Path) -> None:
    _filled(cell_file, 1, lambda _: FLAT)
    history_path = cell_file.parent / "history.pdf"
    assert _history(cell_file, "--plot", history_path) == 2
    notes = cell_file.parent / "notes.png"
    notes.write_text("my notes")
    assert _history(cell_file, "--plot", notes) == 2
    assert notes.read_text() == "my notes"
    in_no_folder = cell_file.parent / "none" / "history.png"
    assert _history(cell_file, "--plot", in_no_folder) == 1


def test_a_broken_audit_is_reported_by_its_first_line(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = _place(cell_file).audit
    for number in range(4):
        details = {"k": number}
        append(audit, AuditAction.PROPOSED, at=BEGIN, who="anna", subject="x", details=details)
    assert _history(cell_file, "--verify") == 0
    assert "4 entries, chain unbroken" in capsys.readouterr().out
    changed_content = audit.read_bytes().replace(b'"k":2', b'"k":7')
    audit.write_bytes(changed_content)
    assert _history(cell_file, "--verify") == 4
    shown = capsys.readouterr()
    assert "line 3" in shown.err
    assert "BROKEN" in shown.out
    assert "keep this file" in shown.err
    assert _history(cell_file, "--verify", "--json") == 4
    document = json.loads(capsys.readouterr().out)
    assert document["audit"]["broken_line"] == 3


def _to_crlf(content: bytes) -> bytes:
    return content.replace(b"\n", b"\r\n")


def _to_utf_16(content: bytes) -> bytes:
    return content.decode().encode("utf-16")


def _indented(content: bytes) -> bytes:
    entries = [json.loads(line) for line in content.splitlines()]
    return "\n".join(json.dumps(entry, indent=2) for entry in entries).encode()


def _entered_by_hand(cell_file: Path) -> Path:
    """A calibration that the history has."""
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration_of(0), file)
    assert _history(cell_file, "--add", file) == 0
    return file


@pytest.mark.parametrize(
    ("convert", "said"),
    [
        pytest.param(_to_crlf, "its line ends were converted (CRLF)", id="CRLF"),
        pytest.param(_to_utf_16, "its encoding was converted (UTF-16)", id="UTF-16"),
    ],
)
def test_verify_of_a_converted_log_is_one_finding_and_nothing_is_entered(
    cell_file: Path,
    convert: Callable[[bytes], bytes],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _entered_by_hand(cell_file)
    path = _place(cell_file).audit
    written = path.read_bytes()
    path.write_bytes(convert(written))
    capsys.readouterr()
    reported = _verified(cell_file, capsys)
    assert "1 place that is not what was written" in reported
    assert said in reported
    assert "dos2unix" in reported
    assert "who can write to it" not in reported
    other = cell_file.parent / "other.yaml"
    save_calibration(calibration_of(1), other)
    for arguments in (("--acknowledge", "J4", "--why", "new motor"), ("--add", other)):
        assert _history(cell_file, *arguments) == 3
        refused = _one_spaced(capsys.readouterr().err)
        assert said in refused
        assert "nothing was written" in refused
    assert path.read_bytes() == convert(written)
    path.write_bytes(written)
    assert _history(cell_file, "--verify") == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("--acknowledge", "J4", "--why", "new motor"),
        ("--axis", "J4"),
        ("--axis", "J4", "--json"),
        ("--plot", "gains.png"),
    ],
)
def test_gains_that_cannot_be_read_in_a_changed_log_are_not_called_absent(
    cell_file: Path, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    _entered_by_hand(cell_file)
    path = _place(cell_file).audit
    changed = _indented(path.read_bytes())
    path.write_bytes(changed)
    capsys.readouterr()
    assert _history(cell_file, *arguments) == 4
    refused = _one_spaced(capsys.readouterr().err)
    assert "changed lines may have one" in refused
    assert "drivegain history CELL --verify" in refused
    assert "--add" not in refused
    assert path.read_bytes() == changed


def test_an_audit_whose_end_was_cut_off_is_noticed(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A chain cannot show that by itself: the note beside it knows its last entry."""
    place = _place(cell_file)
    audit = place.audit
    entries = []
    for _ in range(3):
        entry = append(audit, AuditAction.APPLIED, at=BEGIN, who="anna", subject="x", details={})
        entries.append(entry)
    assert _history(cell_file, "--verify") == 0
    lines = audit.read_bytes().splitlines(keepends=True)
    without_end = b"".join(lines[:2])
    audit.write_bytes(without_end)
    assert _history(cell_file, "--verify") == 4
    sha256 = entries[2].sha256
    error_output = capsys.readouterr().err
    assert sha256[:12] in error_output


def test_an_audit_without_the_end_of_a_session_is_noticed(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A session keeps the digest of the entry that ends it."""
    cell_file.write_text(cell_file.read_text() + RECALIBRATION)
    declared = load_cell(cell_file)
    assert declared.recalibration is not None
    path = _place(cell_file).audit
    ended = append(
        path,
        AuditAction.RECALIBRATION_ENDED,
        at=BEGIN,
        who="job",
        subject="x",
        details={},
    )
    basis = Basis(declared.name, declared.digest, "")
    session = begin(declared.recalibration.folder, basis, BEGIN)
    assert _history(cell_file, "--verify") == 0
    state = session.state.with_(audit_sha256=ended.sha256)
    save_session(replace(session, state=state))
    assert _history(cell_file, "--verify") == 0
    _place(cell_file).audit.unlink()
    assert _history(cell_file, "--verify") == 4
    error_output = capsys.readouterr().err
    assert ended.sha256[:12] in error_output


@pytest.mark.parametrize(
    ("content", "says"), [(b"old", "as before the write"), (b"new", "the new content")]
)
def test_a_write_that_never_ended_is_reported_with_what_the_file_is(
    cell_file: Path, capsys: pytest.CaptureFixture[str], content: bytes, says: str
) -> None:
    file = cell_file.parent / "controller.yaml"
    file.write_bytes(content)
    before = hashlib.sha256(b"old").hexdigest()
    after = hashlib.sha256(b"new").hexdigest()
    digests = {"sha256_before": before, "sha256_after": after}
    path = _place(cell_file).audit
    append(
        path,
        AuditAction.APPLY_BEGUN,
        at=BEGIN,
        who="anna",
        subject=str(file),
        details=digests,
    )
    assert _history(cell_file, "--verify") == 0
    printed = capsys.readouterr().out
    assert says in _one_spaced(printed)


def _write_down(
    cell_file: Path, digest: str, *, back: bool = False, at: datetime = BEGIN
) -> AuditEntry:
    """A write to the cell's controller; the entry that ends it."""
    controller = str(load_cell(cell_file).controller_path)
    ledger = ledger_of(cell_file)
    if back:
        return write(ledger, controller, "1" * 64, at=at)
    return write(ledger, controller, digest[::-1], digest=digest, at=at)


def _verified(cell_file: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the findings of --verify in one line; empty where all is well."""
    capsys.readouterr()
    code = _history(cell_file, "--verify")
    error_output = capsys.readouterr().err
    output = _one_spaced(error_output)
    expected_code = 4 if output else 0
    assert code == expected_code
    return output


def test_a_write_of_which_the_history_does_not_know_is_reported_and_entered_by_hand(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = calibration_of(0)
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration, file)
    digest = digest_of(calibration)
    first = _write_down(cell_file, digest)
    back = _write_down(cell_file, digest, back=True)
    # Of another target the history of this cell need not know.
    path = _place(cell_file).audit
    append(
        path,
        AuditAction.APPLIED,
        at=BEGIN,
        who="anna",
        subject="/other.yaml",
        details={"begun": 1},
    )
    reported = _verified(cell_file, capsys)
    assert f"entry {first.number} of" in reported
    assert "applied by anna" in reported
    assert digest[:12] in reported
    assert "--add" in reported
    assert _history(cell_file, "--verify", "--json") == 4
    printed = capsys.readouterr().out
    found = json.loads(printed)["audit"]
    (unknown,) = found["unknown_writes"]
    assert unknown["number"] == 2
    assert unknown["calibration_sha256"] == digest
    assert _history(cell_file, "--add", file) == 0
    error_output = capsys.readouterr().err
    assert error_output.count("Entered too") == 1
    assert _verified(cell_file, capsys) == ""
    history = history_of(cell_file)
    applied_event, rollback_event = history.events
    applied = (WriteAction.APPLIED, BEGIN, "anna", first.sha256)
    rolled_back = (WriteAction.ROLLED_BACK, BEGIN, "anna", back.sha256)
    assert _event_facts(applied_event) == applied
    assert _event_facts(rollback_event) == rolled_back
    assert history.in_force() is None
    assert _history(cell_file, "--add", file) == 0
    assert "Entered too" not in capsys.readouterr().err


def test_a_write_whose_calibration_is_added_later_is_in_its_place(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (second,) = _filled(cell_file, 1, lambda _: FLAT)
    calibration = calibration_of(5)
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration, file)
    first = digest_of(calibration)
    lost = _write_down(cell_file, first)
    known = _write_down(cell_file, second)
    reported = _verified(cell_file, capsys)
    assert f"entry {lost.number} of" in reported
    assert f"entry {known.number} of" not in reported
    assert _history(cell_file, "--add", file) == 0
    error_output = capsys.readouterr().err
    assert error_output.count("Entered too") == 1
    assert _verified(cell_file, capsys) == ""
    events = history_of(cell_file).events
    digests = [event.digest for event in events]
    assert digests == [first, second]


def test_nothing_is_entered_from_an_audit_that_someone_changed(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = calibration_of(0)
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration, file)
    _write_down(cell_file, digest_of(calibration))
    audit = _place(cell_file).audit
    changed_content = audit.read_bytes().replace(b'"who":"anna"', b'"who":"kim"')
    audit.write_bytes(changed_content)
    changed = audit.read_bytes()
    assert _history(cell_file, "--add", file) == 3
    assert "Entered too" not in capsys.readouterr().err
    assert audit.read_bytes() == changed
    assert history_of(cell_file).events == ()


def test_drives_that_are_written_once_more_are_written_twice(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`apply --drives` writes the values that are already there once more,
    to let the drives save it.
    """
    (digest,) = _filled(cell_file, 1, lambda _: FLAT)
    subject = drives_of("demo")
    ledger = ledger_of(cell_file)
    for before in ("0" * 64, "1" * 64):
        write(ledger, subject, "1" * 64, digest=digest, before=before)
    assert _verified(cell_file, capsys) == ""
    history = history_of(cell_file)
    targets = [event.target for event in history.events]
    digests = [event.digest for event in history.events]
    assert targets == [subject] * 2
    assert digests == [digest] * 2
    assert history.in_force(subject) == digest


def test_in_force_is_what_the_cell_s_own_controller_has(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = _filled(cell_file, 3, lambda _: FLAT)
    own = _put(cell_file, first)

    def applied(digest: str, target: str) -> None:
        write(ledger_of(cell_file), target, digest[::-1], digest=digest)

    def found_in_force() -> str | None:
        in_force = _json(capsys, cell_file)["in_force"]
        return str(in_force) if in_force else None

    applied(first, own)
    applied(second, "/another/controller.yaml")
    assert found_in_force() == first
    applied(third, own)
    # Whatever the history says: the backup was copied back by hand
    assert found_in_force() == first
    _put(cell_file, third)
    assert found_in_force() == third
    text = Path(own).read_text()
    edited = text.replace("loop:", "lopp:")
    Path(own).write_text(edited + "# K.\n")
    assert found_in_force() == third  # the gains are the same
    capsys.readouterr()
    assert _history(cell_file) == 0
    printed = capsys.readouterr().out
    assert _one_spaced(printed).count("in force") == 1
    _put(cell_file, third)
    text = Path(own).read_text()
    other_gain = re.sub("gain: -9[.0-9]*", "gain: -9.5", text)
    Path(own).write_text(other_gain)
    assert found_in_force() is None
    Path(own).unlink()
    assert found_in_force() is None


def test_what_was_done_is_reported_in_the_words_of_who_did_it() -> None:
    def event(digest: str | None, action: WriteAction, who: str, target: str = "x") -> Event:
        return Event(digest, action, BEGIN, who, target)

    entries = [_entry("a"), _entry("b"), _entry("c")]

    done = [event("a", WriteAction.APPLIED, "anna")]
    assert describe_actions(entries, done, "a") == {
        "a": "applied by anna, in force",
        "b": "-",
        "c": "-",
    }

    done.append(event("b", WriteAction.APPLIED, "ben"))
    done.append(event("c", WriteAction.APPLIED, "cem", "y"))
    assert describe_actions(entries, done, "b") == {
        "a": "applied by anna",
        "b": "applied by ben, in force",
        "c": "applied by cem",
    }

    done.append(event("a", WriteAction.ROLLED_BACK, "dora"))
    assert describe_actions(entries, done, "a") == {
        "a": "gains restored by the rollback of dora, in force",
        "b": "applied by ben, rolled back by dora",
        "c": "applied by cem",
    }

    done.append(event(None, WriteAction.ROLLED_BACK, "eva", "y"))  # to numbers of no calibration
    actions = describe_actions(entries, done, None)
    assert actions["c"] == "applied by cem, rolled back by eva"
    actions = describe_actions(entries, done, "c")
    assert actions["c"] == "applied by cem, rolled back by eva, in force"


def test_no_one_waits_for_a_pipe_or_reads_a_device_to_its_end(cell_file: Path) -> None:
    pipe = cell_file.parent / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), cell_file.parent):
        assert _history(cell_file, "--add", path) == 4


@pytest.mark.parametrize("lost", ["removed", "truncated"])
def test_a_lost_history_is_not_called_empty(
    cell_file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, lost: str
) -> None:
    calibration = calibration_of(0)
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration, file)
    assert _history(cell_file, "--add", file) == 0
    _write_down(cell_file, digest_of(calibration))
    kept = _place(cell_file).audit.read_bytes()
    _place(cell_file).audit.unlink()
    if lost == "truncated":
        _place(cell_file).audit.touch()
    capsys.readouterr()
    assert _history(cell_file) == 0
    assert "--verify" in caplog.text
    assert "no calibration" not in capsys.readouterr().out
    # The next entry does not hide that there were others.
    path = _place(cell_file).audit
    entered = append(path, AuditAction.PROPOSED, at=BEGIN, who="anna", subject="x", details={})
    reported = _verified(cell_file, capsys)
    assert "noted elsewhere and missing here" in reported
    assert entered.sha256[:12] not in reported
    _place(cell_file).audit.write_bytes(kept)
    caplog.clear()
    assert _history(cell_file) == 0
    events = history_of(cell_file).events
    assert [event.who for event in events] == ["anna"]


def test_nothing_is_cut_off_in_80_columns(
    cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _filled(cell_file, 3, lambda _: FLAT)
    assert _history(cell_file) == 0
    shown = capsys.readouterr().out
    assert "nameplate" in shown
    assert "…" not in shown


def test_an_audit_that_is_no_regular_file_is_broken(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = _place(cell_file).audit
    pipe = cell_file.parent / "pipe"
    for target in (cell_file.parent, Path("/dev/null"), pipe):
        if not target.exists():
            os.mkfifo(target)
        audit.symlink_to(target)
        reported = _verified(cell_file, capsys)
        assert "correct `history.audit` of the cell file" in reported
        assert "--audit" not in reported
        audit.unlink()


def test_a_deleted_audit_is_reported_as_missing(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (digest,) = _filled(cell_file, 1, lambda _: FLAT)
    _write_down(cell_file, digest)
    _place(cell_file).audit.unlink()
    reported = _verified(cell_file, capsys)
    assert "no file" in reported
    assert "line 1" not in reported
