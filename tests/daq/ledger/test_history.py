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
from dataclasses import replace
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
from daq.writeback.judgement import known_of
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


def drifting(week: int) -> tuple[float, ...]:
    """J4 loses 6 % from the 14th calibration on, in twelve weeks."""
    largest_week = max(week - 13, 0)
    smallest = min(largest_week / 12.0, 1.0)
    return (1.0, 1.0, 1.0, 1.0 - 0.06 * smallest, 1.0, 1.0)


def sloping(week: int) -> tuple[float, ...]:
    """J4 loses 0.2 % a week from the first calibration on."""
    return (1.0, 1.0, 1.0, 1.0 - 0.002 * week, 1.0, 1.0)


def stepping(factors: tuple[float, ...]) -> Callable[[int], tuple[float, ...]]:
    """All gains by their factors from the 15th calibration on."""
    return lambda week: factors if week > 14 else FLAT


def _place(cell_file: Path) -> HistoryPlace:
    place = load_cell(cell_file).history
    assert place is not None
    return place


_audits: dict[tuple[tuple[float, ...], ...], tuple[tuple[str, ...], bytes]] = {}
"""Digests of the calibrations and content of the file, by the true factors of each week."""


def _filled(
    cell_file: Path, weeks: int, true: Callable[[int], tuple[float, ...]]
) -> tuple[str, ...]:
    """Fill the history, which has no file yet; the digests of its calibrations.

    Equal ones are filled once.
    """
    path = _place(cell_file).audit
    key = tuple(map(true, range(weeks)))
    assert not path.exists()
    if key not in _audits:
        digests = fill(ledger_of(cell_file), weeks, true)
        _audits[key] = digests, path.read_bytes()
    digests, content = _audits[key]
    path.write_bytes(content)
    return digests


def _series(cell_file: Path) -> tuple[Series, ...]:
    history = history_of(cell_file)
    return watch(history.entries, history.acknowledgements)


def _json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["history", *arguments, "--json"]) == 0
    printed = capsys.readouterr().out
    found: dict[str, Any] = json.loads(printed)
    return found


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
    keys = {gain.axis: f"drives.{gain.axis}.gain" for gain in entry.gains}
    document = read_controller(controller.read_bytes(), controller.name)
    scalars = document.locate(tuple(keys.values()))
    spelling = {
        s.key: rewrite_gain(s, g.value, g.std).spelling
        for s, g in zip(scalars, entry.gains, strict=True)
    }
    controller.write_bytes(document.with_values(spelling).content)
    return str(controller.resolve())


def test_an_empty_history_says_what_to_do(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["history", str(cell_file)]) == 0
    assert "The history is empty" in capsys.readouterr().out
    axes = _json(capsys, str(cell_file))["axes"]
    assert axes == []
    assert main(["history", str(cell_file), "--verify"]) == 0
    assert "0 entries, chain unbroken" in capsys.readouterr().out
    assert not _place(cell_file).audit.exists()
    assert main(["history", str(cell_file), "--axis", "J4"]) == 2
    assert main(["history", str(cell_file), "--plot", str(cell_file.with_suffix(".png"))]) == 2


def test_a_calibration_is_entered_by_hand(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration_of(0), file)
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
    shown = capsys.readouterr()
    assert "entered" in shown.err
    assert "33.90 ± 0.14" in shown.out
    assert "baseline: 1 of 12" in shown.out
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
    assert "already" in capsys.readouterr().err
    calibration = replace(calibration_of(1), cell="another")
    save_calibration(calibration, file)
    assert main(["history", str(cell_file), "--add", str(file)]) == 4
    assert "another" in capsys.readouterr().err
    assert main(["history", str(cell_file), "--add", str(cell_file)]) == 4
    assert main(["history", str(cell_file), "--add", str(file) + ".none"]) == 4
    points = _series(cell_file)[0].points
    assert len(points) == 1


@pytest.mark.slow
def test_a_drift_is_reported_with_its_time_its_size_and_a_question(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    digests = _filled(cell_file, 26, drifting)
    write(ledger_of(cell_file), "x.yaml", "1", digest=digests[8], at=BEGIN + timedelta(weeks=8))
    _put(cell_file, digests[8])
    assert main(["history", str(cell_file)]) == 0
    printed = capsys.readouterr().out
    out = " ".join(printed.split())
    assert re.search(r"ALARM: gain of J4 fell 5\.\d % since 2026-04-\d\d, \d\d\.\d σ", out)
    assert out.count("ALARM:") == 1
    assert "demagnetised" in out
    assert "Worn teeth alone do not change a ratio" in out
    assert "applied by anna, in force" in out
    found = _json(capsys, str(cell_file), "--axis", "J4")
    (axis,) = found["axes"]
    assert found["pattern"] == "one axis"
    assert axis["alarmed"]
    assert axis["change_percent"] == pytest.approx(-5.7, abs=0.5)
    # 6 % in twelve weeks with σ 0.4 % have cumulated 3 σ after three.
    first = next(number for number, point in enumerate(axis["points"]) if point["alarm"])
    assert 15 <= first <= 18
    assert found["in_force"] == digests[8]
    assert [point["applied_by"] for point in axis["points"] if point["applied_by"]] == ["anna"]


@pytest.mark.slow
def test_a_drift_from_the_first_day_is_reported_as_steady(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 9, sloping)
    assert main(["history", str(cell_file), "--axis", "J4"]) == 0
    printed = capsys.readouterr().out
    out = " ".join(printed.split())
    reported = re.search(
        r"ALARM: gain of J4 falls steadily since 2026-01-05, (\d\.\d) % until "
        r"now, (\d\.\d) σ",
        out,
    )
    assert reported is not None
    assert float(reported[1]) == pytest.approx(1.6, abs=1.0)  # 8 × 0.2 %, and its σ is 0.5 %
    assert "demagnetised" in out
    found = _json(capsys, str(cell_file), "--axis", "J4")
    points = found["axes"][0]["points"]
    point = points[-1]
    assert point["alarm"] == "trend"
    absolute_trend_sigma = abs(point["trend_sigmas"])
    assert absolute_trend_sigma == pytest.approx(float(reported[2]), abs=0.05)
    trend = found["chart"]["trend"]
    assert point["trend_sigmas"] < -trend
    picture = cell_file.parent / "history.svg"
    assert main(["history", str(cell_file), "--plot", str(picture)]) == 0
    assert b"steady change" in picture.read_bytes()


@pytest.mark.slow
def test_an_alarm_that_has_passed_has_no_date(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """5 % on one day, the fourth: its row keeps the alarm,
    and the rest of the gain is as of any other.
    """
    _filled(cell_file, 20, lambda week: (1.0, 1.0, 1.0, 0.95 if week == 3 else 1.0, 1.0, 1.0))
    series = _series(cell_file)[3]
    assert series.alarm_at(3) is not None
    assert (series.alarmed, series.onset, alarm_text(series)) == (False, None, None)
    (axis,) = _json(capsys, str(cell_file), "--axis", "J4")["axes"]
    assert (axis["alarmed"], axis["alarm"], axis["since"]) == (False, None, None)
    known = [point.gain.value for point in series.points[:12]]
    stds = [point.gain.std for point in series.points[:12]]
    weights = np.array(stds) ** -2.0
    mean_known = np.average(known, weights=weights)
    assert axis["baseline"] == pytest.approx(mean_known)


@pytest.mark.slow
def test_without_a_drift_there_is_no_alarm(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 25, lambda _: FLAT)
    assert main(["history", str(cell_file)]) == 0
    out = capsys.readouterr().out
    assert "No alarm." in out
    assert "ALARM" not in out
    assert _json(capsys, str(cell_file))["questions"] == []


@pytest.mark.parametrize(
    ("factors", "says"),
    [
        ((0.96,) * 6, "is the payload heavier than the mass that was entered"),
        ((1.04,) * 6, "is the payload lighter than the mass that was entered"),
        ((1.0, 1.0, 1.0, 1.05, 1.0, 1.0), "Magnets do not grow stronger"),
        ((1.0, 0.95, 1.0, 1.05, 1.0, 1.0), "several axes, each by an amount of its own"),
    ],
)
def test_each_pattern_has_its_question(
    cell_file: Path, factors: tuple[float, ...], says: str
) -> None:
    _filled(cell_file, 20, stepping(factors))
    assert says in questions(_series(cell_file))[0]


def test_a_configuration_that_changed_is_asked_for(cell_file: Path) -> None:
    factors = (0.96,) * 6
    _filled(cell_file, 20, stepping(factors))
    enter(
        ledger_of(cell_file),
        replace(calibration_of(20, (0.96,) * 6), configuration_sha256="d" * 64),
    )
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
    fits = [
        replace(
            calibration_of(week, (1.0 + 0.001 * week,) * 6),
            sources=logs[::-1] if week % 2 else logs,
        )
        for week in range(12)
    ]
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
    assert [point.entry.digest for point in points()] == [digests[4], digest_of(calibration_of(1))]
    gains = fits[0].gains
    held = tuple(replace(gain, std=0.0) for gain in gains)
    # Knows no gain, hides none
    sources = calibration_of(1).sources
    changed_fit = replace(fits[0], gains=held, sources=sources)
    enter(ledger, changed_fit)
    digest = points()[1].entry.digest
    assert digest == digest_of(calibration_of(1))
    # Another log held out is another question to the same recordings.
    sha256 = "9" * 64
    changed_log = replace(logs[2], sha256=sha256)
    other = replace(fits[0], sources=(*logs[:2], changed_log))
    assert logs_of(other, "") == logs_of(fits[0], "")
    calibration = replace(fits[0], sources=())
    assert logs_of(calibration, "its own") == "its own"


def test_old_logs_fitted_today_report_their_own_time(cell_file: Path) -> None:
    """A gain that was another one a year ago has not changed today."""
    _filled(cell_file, 20, lambda _: FLAT)
    factors = (0.9,) * 6
    calibration = calibration_of(30, factors)
    begin_difference = BEGIN - timedelta(days=400)
    year_ago = recorded(calibration, begin_difference)
    enter(ledger_of(cell_file), year_ago)
    last_entry = history_of(cell_file).entries[-1]
    assert last_entry.digest == digest_of(year_ago)  # fitted last
    series = _series(cell_file)[3]
    digest = series.points[0].entry.digest
    assert digest == digest_of(year_ago)
    expected = [BEGIN - timedelta(days=400), BEGIN]
    assert [point.entry.recorded for point in series.points[:2]] == expected
    assert series.onset is None or series.onset < BEGIN + timedelta(weeks=1)


@pytest.mark.parametrize("recorded_s", [None, float("nan"), 1e300])
def test_a_log_without_its_time_has_that_of_the_fit(recorded_s: float | None) -> None:
    calibration = with_recordings(calibration_of(3), recorded_s=recorded_s)
    assert recorded_at(calibration, BEGIN) == BEGIN


def test_a_gain_that_was_held_fixed_knows_nothing(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 3, lambda _: FLAT)
    fixed = calibration_of(5)
    enter(
        ledger_of(cell_file),
        replace(fixed, gains=(replace(fixed.gains[0], std=0.0), *fixed.gains[1:])),
    )
    point_counts = [len(series.points) for series in _series(cell_file)]
    expected = [3, 4, 4, 4, 4, 4]
    assert point_counts == expected
    assert main(["history", str(cell_file)]) == 0
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
    changes = [
        GainChange(name, name, 1, 1.0, 1.0, 0.1, "Nm/A", 1.0, "") for name in declared.axis_names
    ]
    known = known_of(history_of(cell_file), str(resolve_links(controller)), digest, changes)
    return dict(known.dispersions)


def test_a_job_and_the_charts_know_one_scatter(cell_file: Path) -> None:
    """Also where a session was fitted again with a gain held fixed,
    and where that is its only fit.
    """
    _filled(cell_file, 12, lambda week: (1.0 + 0.012 * (-1) ** week,) * 6)
    before = {series.axis: series.dispersion for series in _series(cell_file)}
    assert min(before.values()) > 1.5
    assert _job_s_dispersions(cell_file) == before
    factors = (1.0 - 0.012,) * 6
    fitted = calibration_of(5, factors)
    changed_gain = replace(fitted.gains[0], std=0.0)
    gains = (changed_gain, *fitted.gains[1:])
    again = replace(fitted, gains=gains)
    enter(ledger_of(cell_file), again)
    charts = _series(cell_file)
    point_counts = [len(series.points) for series in charts]
    assert point_counts == [12] * 6
    refitted = {series.axis: series.dispersion for series in charts}
    assert _job_s_dispersions(cell_file) == refitted
    assert refitted == pytest.approx(before, rel=0.05)  # the same recordings of all axes as before
    alone = calibration_of(12)
    enter(
        ledger_of(cell_file),
        replace(alone, gains=(replace(alone.gains[0], std=0.0), *alone.gains[1:])),
    )
    charts = _series(cell_file)
    expected = [12, 13, 13, 13, 13, 13]
    assert [len(series.points) for series in charts] == expected
    found = {series.axis: series.dispersion for series in charts}
    assert _job_s_dispersions(cell_file) == found
    # What a session has found itself is not what it is judged by.
    own = calibration_of(13, (1.2,) * 6)
    assert _job_s_dispersions(cell_file, own) == found
    assert {series.axis: series.dispersion for series in _series(cell_file)} != found


def test_the_scatter_of_axes_is_reported_together_where_the_same_recordings_know_them() -> None:
    rng = np.random.default_rng(12)
    names = tuple(f"J{number}" for number in range(1, 4))
    values = rng.normal(10.0, 0.3, (9, 3))
    stds_nm_per_a = np.full(values.shape, 0.1)
    stds_nm_per_a[4, 2] = 0.0  # J3 was held fixed once.
    entries = []
    for week, row in enumerate(values):
        gains = [
            Gain(axis, float(value), float(std), "Nm/A", 10.0)
            for axis, value, std in zip(names, row, stds_nm_per_a[week], strict=True)
        ]
        entry = _entry(str(week))
        recorded = BEGIN + timedelta(weeks=week)
        entries.append(replace(entry, logs=str(week), recorded=recorded, gains=tuple(gains)))
    found = dispersions_of(entries, names)
    assert tuple(found) == names
    expected = dispersions(values[:, :2].T, np.full((2, 9), 0.1))
    np.testing.assert_allclose([found["J1"], found["J2"]], expected)
    alone = np.delete(values[:, 2], 4)
    stds = np.full((1, 8), 0.1)
    np.testing.assert_allclose(found["J3"], dispersions([alone], stds)[0])
    assert dispersions_of(entries[:4], names) == dict.fromkeys(names, DISPERSION)
    assert dispersions_of((), names) == dict.fromkeys(names, DISPERSION)
    assert dispersions_of(entries, ("J9",)) == {"J9": DISPERSION}
    assert dispersions_of(entries, ()) == {}


def test_an_axis_has_a_table_of_its_own(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 5, lambda _: FLAT)
    assert main(["history", str(cell_file), "--axis", "J4"]) == 0
    out = capsys.readouterr().out
    assert out.count("2026-0") == 5
    assert "CUSUM" in out
    assert "No alarm" in out
    assert main(["history", str(cell_file), "--axis", "J9"]) == 2
    error_output = capsys.readouterr().err
    assert "one of J1" in " ".join(error_output.split())


def test_a_change_that_is_explained_begins_a_new_baseline(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 26, drifting)
    explain = [
        "history",
        str(cell_file),
        "--acknowledge",
        "J4",
        "--by",
        "anna",
        "--why",
        "gearbox changed",
    ]
    assert main(explain) == 0
    capsys.readouterr()
    series = _series(cell_file)[3]
    assert not series.alarmed
    assert series.began == 25
    assert [stretch.began for stretch in series.stretches] == [0, 25]
    assert series.alarm_at(24) is not None  # a shown alarm stays
    assert not any(other.acknowledged for other in _series(cell_file) if other.axis != "J4")
    path = _place(cell_file).audit
    entry = read(path)[-1]
    assert entry.action is AuditAction.ACKNOWLEDGED
    assert entry.who.startswith("anna")
    assert entry.details["why"] == "gearbox changed"
    assert main(["history", str(cell_file), "--axis", "J4"]) == 0
    assert "gearbox changed" in capsys.readouterr().out
    assert main(["history", str(cell_file), "--verify"]) == 0
    # The next calibrations at the new level are compared with that level.
    for week in range(26, 30):
        enter(ledger_of(cell_file), calibration_of(week, drifting(week)))
    assert not _series(cell_file)[3].alarmed


def test_a_new_baseline_begins_where_one_says(cell_file: Path) -> None:
    factors = (1.0, 1.0, 1.0, 0.9, 1.0, 1.0)
    _filled(cell_file, 20, stepping(factors))
    explain = [
        "history",
        str(cell_file),
        "--acknowledge",
        "J4",
        "--why",
        "motor exchanged",
        "--since",
    ]
    assert main([*explain, "someday"]) == 2
    assert main([*explain, (BEGIN + timedelta(weeks=15)).date().isoformat()]) == 0
    series = _series(cell_file)[3]
    assert series.began == 15
    assert not series.alarmed
    # A baseline that is still to come would silence the axis until then.
    acknowledge(
        ledger_of(cell_file), "J4", since=BEGIN.replace(year=2130), at=BEGIN, who="anna", why="x"
    )
    assert _series(cell_file)[3].acknowledged == series.acknowledged
    # One that began after the newest recording.
    acknowledge(
        ledger_of(cell_file),
        "J4",
        since=BEGIN.replace(year=2130),
        at=BEGIN.replace(year=2130),
        who="a",
        why="x",
    )
    series = _series(cell_file)[3]
    assert (series.began, series.drift, series.onset, alarm_text(series)) == (20, None, None, None)
    assert main(["history", str(cell_file), "--axis", "J4"]) == 0


def test_a_baseline_that_begins_later_than_now_is_refused(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _filled(cell_file, 3, lambda _: FLAT)
    explain = ["history", str(cell_file), "--acknowledge", "J4", "--why", "planned", "--since"]
    assert main([*explain, "2130-01-02T03:04:05+01:00"]) == 2
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    assert "2130-01-02 02:04:05 UTC" in output
    assert f"no later than now, {datetime.now(UTC):%Y-%m-%d}" in output
    path = _place(cell_file).audit
    assert len(read(path)) == 3
    assert main([*explain, datetime.now(UTC).date().isoformat()]) == 0


def test_a_log_of_tomorrow_begins_its_baseline_now(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clock of its recorder was ahead."""
    days = (datetime.now(UTC) - BEGIN).days
    weeks = days // 7 + 2
    enter(ledger_of(cell_file), calibration_of(weeks))
    assert main(["history", str(cell_file), "--acknowledge", "J4", "--why", "motor exchanged"]) == 0
    assert _series(cell_file)[3].began == 0
    assert main(["history", str(cell_file), "--verify"]) == 0
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
    assert main(["history", str(cell_file), *arguments]) == 2
    path = _place(cell_file).audit
    assert len(read(path)) == 3


@pytest.mark.slow
def test_the_table_leaves_as_csv(cell_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _filled(cell_file, 15, drifting)
    out = cell_file.parent / "history.csv"
    assert main(["history", str(cell_file), "--csv", str(out)]) == 0
    assert main(["history", str(cell_file), "--csv", str(out)]) == 0  # an earlier one is replaced
    with out.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert tuple(rows[0]) == COLUMNS
    assert [row["axis"] for row in rows[::15]] == list(AXES)
    found = {series.axis: series for series in _series(cell_file)}
    points = found["J4"].points
    for row, point in zip(rows[45:60], points, strict=True):
        gain = float(row["gain"])
        assert gain == point.gain.value
        assert datetime.fromisoformat(row["created"]) == point.entry.created
        assert row["unit"] == "Nm/A"
    assert rows[0]["change_percent"] == ""
    capsys.readouterr()
    assert main(["history", str(cell_file), "--csv", str(cell_file)]) == 2
    assert cell_file.read_bytes().startswith(b"#") or b"axes" in cell_file.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".png", ".svg"])
@pytest.mark.parametrize("arguments", [[], ["--axis", "J4"]])
def test_the_picture_is_drawn_the_same_each_time(
    cell_file: Path, suffix: str, arguments: list[str]
) -> None:
    _filled(cell_file, 26, drifting)
    out = cell_file.parent / f"history{suffix}"
    draw = ["history", str(cell_file), "--plot", str(out), *arguments]
    assert main(draw) == 0
    first = out.read_bytes()
    assert len(first) > 10_000
    assert first.startswith({".png": b"\x89PNG", ".svg": b"<?xml"}[suffix])
    assert main(draw) == 0
    assert out.read_bytes() == first


@pytest.mark.slow
def test_a_picture_has_its_kind_and_replaces_only_its_like(cell_file: Path) -> None:
    _filled(cell_file, 1, lambda _: FLAT)
    history_path = cell_file.parent / "history.pdf"
    assert main(["history", str(cell_file), "--plot", str(history_path)]) == 2
    notes = cell_file.parent / "notes.png"
    notes.write_text("my notes")
    assert main(["history", str(cell_file), "--plot", str(notes)]) == 2
    assert notes.read_text() == "my notes"
    none_folder = cell_file.parent / "none"
    assert main(["history", str(cell_file), "--plot", str(none_folder / "history.png")]) == 1


def test_a_broken_audit_is_reported_by_its_first_line(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = _place(cell_file).audit
    for number in range(4):
        append(
            audit, AuditAction.PROPOSED, at=BEGIN, who="anna", subject="x", details={"k": number}
        )
    verify = ["history", str(cell_file), "--verify"]
    assert main(verify) == 0
    assert "4 entries, chain unbroken" in capsys.readouterr().out
    changed_content = audit.read_bytes().replace(b'"k":2', b'"k":7')
    audit.write_bytes(changed_content)
    assert main(verify) == 4
    shown = capsys.readouterr()
    assert "line 3" in shown.err
    assert "BROKEN" in shown.out
    assert "keep this file" in shown.err
    assert main([*verify, "--json"]) == 4
    document = json.loads(capsys.readouterr().out)
    assert document["audit"]["broken_line"] == 3


def test_an_audit_whose_end_was_cut_off_is_noticed(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A chain cannot show that by itself: the note beside it knows its last entry."""
    place = _place(cell_file)
    entries = [
        append(place.audit, AuditAction.APPLIED, at=BEGIN, who="anna", subject="x", details={})
        for _ in range(3)
    ]
    assert main(["history", str(cell_file), "--verify"]) == 0
    lines = place.audit.read_bytes().splitlines(keepends=True)
    place.audit.write_bytes(b"".join(lines[:2]))
    assert main(["history", str(cell_file), "--verify"]) == 4
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
    assert main(["history", str(cell_file), "--verify"]) == 0
    state = session.state.with_(audit_sha256=ended.sha256)
    save_session(replace(session, state=state))
    assert main(["history", str(cell_file), "--verify"]) == 0
    _place(cell_file).audit.unlink()
    assert main(["history", str(cell_file), "--verify"]) == 4
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
    digest = hashlib.sha256(b"old").hexdigest()
    digests = {
        "sha256_before": digest,
        "sha256_after": hashlib.sha256(b"new").hexdigest(),
    }
    path = _place(cell_file).audit
    append(
        path,
        AuditAction.APPLY_BEGUN,
        at=BEGIN,
        who="anna",
        subject=str(file),
        details=digests,
    )
    assert main(["history", str(cell_file), "--verify"]) == 0
    printed = capsys.readouterr().out
    assert says in " ".join(printed.split())


def _write_down(
    cell_file: Path, digest: str, *, back: bool = False, at: datetime = BEGIN
) -> AuditEntry:
    """A write to the cell's controller; the entry that ends it."""
    controller = str(load_cell(cell_file).controller_path)
    if back:
        return write(ledger_of(cell_file), controller, "1" * 64, at=at)
    return write(ledger_of(cell_file), controller, digest[::-1], digest=digest, at=at)


def _verified(cell_file: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the findings of --verify in one line; empty where all is well."""
    capsys.readouterr()
    code = main(["history", str(cell_file), "--verify"])
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    assert code == (4 if output else 0)
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
    for part in (f"entry {first.number} of", "applied by anna", digest[:12], "--add"):
        assert part in reported
    assert main(["history", str(cell_file), "--verify", "--json"]) == 4
    printed = capsys.readouterr().out
    found = json.loads(printed)["audit"]
    assert [(one["number"], one["calibration_sha256"]) for one in found["unknown_writes"]] == [
        (2, digest)
    ]
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
    error_output = capsys.readouterr().err
    assert error_output.count("Entered too") == 1
    assert _verified(cell_file, capsys) == ""
    history = history_of(cell_file)
    expected = [
        (WriteAction.APPLIED, BEGIN, "anna", first.sha256),
        (WriteAction.ROLLED_BACK, BEGIN, "anna", back.sha256),
    ]
    assert [
        (event.action, event.at, event.who, event.audit) for event in history.events
    ] == expected
    assert history.in_force() is None
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
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
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
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
    assert main(["history", str(cell_file), "--add", str(file)]) == 3
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
    for before in ("0" * 64, "1" * 64):
        write(ledger_of(cell_file), subject, "1" * 64, digest=digest, before=before)
    assert _verified(cell_file, capsys) == ""
    history = history_of(cell_file)
    expected = [(subject, digest)] * 2
    assert [(event.target, event.digest) for event in history.events] == expected
    assert history.in_force(subject) == digest


def test_in_force_is_what_the_cell_s_own_controller_has(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = _filled(cell_file, 3, lambda _: FLAT)
    own = _put(cell_file, first)

    def applied(digest: str, target: str) -> None:
        write(ledger_of(cell_file), target, digest[::-1], digest=digest)

    def found_in_force() -> str | None:
        in_force = _json(capsys, str(cell_file))["in_force"]
        return str(found) if (found := in_force) else None

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
    assert main(["history", str(cell_file)]) == 0
    printed = capsys.readouterr().out
    assert " ".join(printed.split()).count("in force") == 1
    _put(cell_file, third)
    Path(own).write_text(re.sub("gain: -9[.0-9]*", "gain: -9.5", Path(own).read_text()))
    assert found_in_force() is None
    Path(own).unlink()
    assert found_in_force() is None


def test_what_was_done_is_reported_in_the_words_of_who_did_it() -> None:
    def event(digest: str | None, action: WriteAction, who: str, target: str = "x") -> Event:
        return Event(digest, action, BEGIN, who, target)

    entries = tuple(_entry(name) for name in ("a", "b", "c"))
    done = [event("a", WriteAction.APPLIED, "anna")]
    assert describe_actions(entries, done, "a") == {
        "a": "applied by anna, in force",
        "b": "-",
        "c": "-",
    }
    done += [event("b", WriteAction.APPLIED, "ben"), event("c", WriteAction.APPLIED, "cem", "y")]
    assert describe_actions(entries, done, "b") == {
        "a": "applied by anna",
        "b": "applied by ben, in force",
        "c": "applied by cem",
    }
    done += [event("a", WriteAction.ROLLED_BACK, "dora")]
    assert describe_actions(entries, done, "a") == {
        "a": "gains restored by the rollback of dora, in force",
        "b": "applied by ben, rolled back by dora",
        "c": "applied by cem",
    }
    done += [event(None, WriteAction.ROLLED_BACK, "eva", "y")]  # to numbers of no calibration
    assert describe_actions(entries, done, None)["c"] == "applied by cem, rolled back by eva"
    assert describe_actions(entries, done, "c")["c"] == (
        "applied by cem, rolled back by eva, in force"
    )


def test_no_one_waits_for_a_pipe_or_reads_a_device_to_its_end(cell_file: Path) -> None:
    os.mkfifo(cell_file.parent / "pipe")
    pipe_folder = cell_file.parent / "pipe"
    for path in (pipe_folder, Path("/dev/zero"), cell_file.parent):
        assert main(["history", str(cell_file), "--add", str(path)]) == 4


@pytest.mark.parametrize("lost", ["removed", "truncated"])
def test_a_lost_history_is_not_called_empty(
    cell_file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, lost: str
) -> None:
    calibration = calibration_of(0)
    file = cell_file.parent / "calibration.yaml"
    save_calibration(calibration, file)
    assert main(["history", str(cell_file), "--add", str(file)]) == 0
    _write_down(cell_file, digest_of(calibration))
    kept = _place(cell_file).audit.read_bytes()
    _place(cell_file).audit.unlink()
    if lost == "truncated":
        _place(cell_file).audit.touch()
    capsys.readouterr()
    assert main(["history", str(cell_file)]) == 0
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
    assert main(["history", str(cell_file)]) == 0
    events = history_of(cell_file).events
    assert [event.who for event in events] == ["anna"]


def test_nothing_is_cut_off_in_80_columns(
    cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _filled(cell_file, 3, lambda _: FLAT)
    assert main(["history", str(cell_file)]) == 0
    shown = capsys.readouterr().out
    assert "nameplate" in shown
    assert "…" not in shown


def test_an_audit_that_is_no_regular_file_is_broken(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = _place(cell_file).audit
    pipe_folder = cell_file.parent / "pipe"
    for target in (cell_file.parent, Path("/dev/null"), pipe_folder):
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
