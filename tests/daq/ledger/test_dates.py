"""Dates by the order of the audit log, where the clock was wrong when a calibration was entered."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.errors import ExitCode
from daq.ledger.audit import AuditAction, append
from daq.ledger.dates import SET_CLOCK, longest_ordered, times_by_order
from daq.ledger.fold import Entry
from daq.ledger.ledger import Ledger, enter_calibration, read_history
from daq.ledger.names import drives_of
from daq.ledger.watch import watch
from ident.calibration import Calibration
from tests.daq.calibrations import recorded
from tests.daq.command_line import run_verb
from tests.daq.histories import BEGIN, calibration_of, digest_of, ledger_in, ledger_of, write

FELL = (1.0, 1.0, 1.0, 0.9, 1.0, 1.0)  #: Gain of J4, 10 % less


def enter_at(ledger: Ledger, calibration: Calibration, at: datetime) -> str:
    """Record, fit and enter a calibration by a clock that says `at`."""
    changed_calibration = replace(calibration, created=at.isoformat())
    made = recorded(changed_calibration, at)
    digest = digest_of(made)
    enter_calibration(ledger, made, digest=digest, who="anna", at=at)
    return digest


def week(number: int) -> datetime:
    return BEGIN + timedelta(weeks=number)


def entries_with(
    ledger: Ledger, wrong: dict[int, timedelta], *, fell_from: int = 99, weeks: int = 14
) -> list[Entry]:
    """The history of calibrations a week apart, in some of whose weeks the clock was off."""
    for number in range(weeks):
        factors = FELL if number >= fell_from else (1.0,) * 6
        at = week(number) + wrong.get(number, timedelta(0))
        calibration = calibration_of(number, factors)
        enter_at(ledger, calibration, at)
    return list(read_history(ledger).entries)


@pytest.mark.parametrize("days", [-730, -30, 30, 730])
def test_a_calibration_under_a_wrong_date_is_at_its_place_in_the_history(
    tmp_path: Path, days: int
) -> None:
    entries = entries_with(ledger_in(tmp_path), {6: timedelta(days=days)})
    expected = [number == 6 for number in range(14)]
    assert [entry.created_by_clock is not None for entry in entries] == expected
    assert [entry.recorded for entry in entries if entry.created_by_clock is None] == [
        week(n) for n in range(14) if n != 6
    ]
    assert week(5) <= entries[6].recorded <= week(7)
    created_by_clock = entries[6].created_by_clock
    assert created_by_clock == week(6) + timedelta(days=days)


@pytest.mark.parametrize("days", [-730, 730])
def test_a_drift_is_found_behind_a_calibration_of_a_wrong_date(tmp_path: Path, days: int) -> None:
    """Dated two years ahead, a sound calibration would be the newest one,
    and the drift of every later one unseen.
    """
    entries = entries_with(ledger_in(tmp_path), {6: timedelta(days=days)}, fell_from=12)
    series = {one.axis: one for one in watch(entries, ())}
    assert series["J4"].alarmed
    assert series["J4"].onset is not None
    assert week(10) <= series["J4"].onset <= week(12)
    assert not series["J3"].alarmed


def test_the_first_calibration_may_be_the_one_of_the_wrong_date(tmp_path: Path) -> None:
    entries = entries_with(ledger_in(tmp_path), {0: timedelta(days=730)}, weeks=4)
    expected = week(0) + timedelta(days=730)
    assert entries[0].created_by_clock == expected
    assert [entry.recorded for entry in entries[1:]] == [week(1), week(2), week(3)]
    assert entries[0].recorded < week(1)


def test_old_logs_that_are_entered_later_keep_the_date_of_their_recording(tmp_path: Path) -> None:
    """Their date is theirs, not that of the day on which they were fitted;
    and that day's clock may be wrong.
    """
    ledger = ledger_in(tmp_path)
    for number in range(3, 6):
        enter_at(ledger, calibration_of(number), week(number))
    old = calibration_of(0)  # recorded in week 0
    enter_calibration(
        ledger, old, digest=digest_of(old), who="anna", at=week(6) + timedelta(days=730)
    )
    enter_at(ledger, calibration_of(7), week(7))
    entries = read_history(ledger).entries
    assert entries[0].digest == digest_of(old)
    assert entries[0].recorded == week(0)


def test_the_same_logs_fitted_again_under_a_wrong_date_keep_their_place(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    for number in range(4):
        enter_at(ledger, calibration_of(number), week(number))
    created = (week(4) + timedelta(days=730)).isoformat()
    again = replace(calibration_of(1, FELL), created=created)
    enter_calibration(
        ledger, again, digest=digest_of(again), who="anna", at=week(4) + timedelta(days=730)
    )
    enter_at(ledger, calibration_of(5), week(5))
    entries = read_history(ledger).entries
    (found,) = (entry for entry in entries if entry.digest == digest_of(again))
    assert found.recorded == week(1)
    expected = week(4) + timedelta(days=730)
    assert found.created_by_clock == expected


def test_history_says_which_date_was_wrong(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ignore = shutil.ignore_patterns("*.jsonl*")
    configs = Path(shutil.copytree(checkout / "configs", tmp_path / "configs", ignore=ignore))
    file = configs / "cells/demo.yaml"
    entries_with(ledger_of(file), {2: timedelta(days=730)}, weeks=5)
    assert run_verb("history", file) == ExitCode.OK
    printed = capsys.readouterr().out
    shown = " ".join(printed.split())
    assert (
        "found the date 2028-01-19; expected one about 2026-01-12, by the order of the audit log"
    ) in shown
    assert run_verb("history", file, "--json") == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    (axis, *_) = document["axes"]
    expected = [False, False, True, False, False]
    assert ["misdated" in point for point in axis["points"]] == expected


def test_a_write_that_was_found_is_in_force_after_one_of_a_wrong_later_date(tmp_path: Path) -> None:
    """By their dates the older write would be the last one,
    and its gains and their σ those in force.
    """
    ledger = ledger_in(tmp_path)
    target = drives_of(ledger.cell.name)
    digests = [enter_at(ledger, calibration_of(number), week(number)) for number in range(3)]
    write(ledger, target, "a" * 64, digest=digests[0], at=week(0))
    write(ledger, target, "b" * 64, digest=digests[1], at=week(1) + timedelta(days=730))
    details: dict[str, object] = {
        "sha256_before": "b" * 64,
        "sha256_after": "c" * 64,
        "action": "applied",
    }
    calibration = {"sha256": digests[2], "cell": ledger.cell.name}
    details |= {"calibration": calibration}
    append(
        ledger.audit,
        AuditAction.WRITE_FOUND,
        at=week(2),
        who="anna",
        subject=target,
        details=details,
    )
    write(ledger, str(tmp_path / "another"), "d" * 64, digest=digests[0], at=week(3))
    history = read_history(ledger)
    assert [event.digest for event in history.events if event.target == target] == digests
    assert history.in_force(target) == digests[2]


def test_a_right_calibration_is_not_misdated_by_one_of_a_clock_that_was_behind(
    tmp_path: Path,
) -> None:
    """Of two calibrations nobody could say which clock was wrong; the other entries say it."""
    ledger = ledger_in(tmp_path)
    right = enter_at(ledger, calibration_of(20), week(20))
    target = drives_of(ledger.cell.name)
    write(ledger, target, "a" * 64, digest=right, at=week(20))
    enter_at(ledger, calibration_of(21), week(16))
    entries = {entry.digest: entry for entry in read_history(ledger).entries}
    assert entries[right].created_by_clock is None
    assert entries[right].created == week(20)


def test_times_in_order_are_left_alone() -> None:
    times = [week(number) for number in (0, 1, 1, 5)]
    assert times_by_order(times) == (None,) * 4
    assert times_by_order([]) == ()
    # A time service sets a clock by seconds.
    found = times_by_order([week(1), week(1) - timedelta(seconds=30), week(2)])
    assert found == (None,) * 3


@given(st.lists(st.integers(0, 30), max_size=12))
def test_the_longest_series_is_one_that_never_decreases_and_none_is_longer(
    hours: list[int],
) -> None:
    times = [BEGIN + timedelta(hours=hour) for hour in hours]
    chosen = longest_ordered(times)
    assert chosen == sorted(set(chosen))
    series = [times[index] for index in chosen]
    assert series == sorted(series)
    lengths: list[int] = []  # of the longest series that ends with each time
    for index, time in enumerate(times):
        before = [
            length for other, length in zip(times[:index], lengths, strict=True) if other <= time
        ]
        largest_before = max(before, default=0)
        lengths.append(1 + largest_before)
    expected = max(lengths, default=0)
    assert len(chosen) == expected


@given(st.lists(st.integers(-20_000, 20_000), min_size=1, max_size=12))
def test_corrected_times_are_in_the_order_of_the_log(hours: list[int]) -> None:
    times = [BEGIN + timedelta(hours=hour) for hour in hours]
    found = [by_order or time for time, by_order in zip(times, times_by_order(times), strict=True)]
    for earlier, later in pairwise(found):
        assert later - earlier > -SET_CLOCK
