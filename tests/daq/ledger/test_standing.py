"""The state of one calibration by the ledger:
each write, rollback and acceptance moves it, and nothing else does.
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.files import sha256
from daq.ledger.audit import AuditAction, append, read
from daq.ledger.ledger import Ledger, Standing, StandingState, read_standing, record_session
from daq.report.history import describe_actions
from tests.daq.histories import BEGIN, calibration_of, enter, ledger_in, write

NOW = BEGIN + timedelta(days=400)
FILE = "/controllers/demo.yaml"
COPY = "/controllers/copy.yaml"


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return ledger_in(tmp_path)


def accept(ledger: Ledger, digest: str, cell: str = "demo") -> None:
    details = {"session": "20260105T060000Z", "cell": cell, "calibration_sha256": digest}
    at = BEGIN + timedelta(hours=2)
    record_session(
        ledger.audit, AuditAction.ACCEPTED, at=at, who="anna", subject="session", details=details
    )


def test_new_moves_that_contradict_a_calibration_are_its_state_until_others_accept_it(
    ledger: Ledger,
) -> None:
    digest = enter(ledger, calibration_of(0))
    write(ledger, FILE, sha256(b"1"), digest=digest, at=BEGIN + timedelta(hours=1), who="anna")
    details = {
        "session": "x",
        "cell": "demo",
        "calibration_sha256": digest,
        "remark": "J4",
        "undo": "rollback",
    }
    at = BEGIN + timedelta(hours=2)
    record_session(
        ledger.audit,
        AuditAction.NOT_ACCEPTED,
        at=at,
        who="anna",
        subject="session",
        details=details,
    )
    standing = read_standing(ledger, digest, NOW)
    assert standing.state is StandingState.NOT_ACCEPTED
    assert standing.acceptance is not None
    assert (standing.acceptance.remark, standing.acceptance.undo) == ("J4", "rollback")
    (entry,) = standing.history.entries
    assert describe_actions([entry], standing.history.events, digest) == {
        digest: "applied by anna, NOT ACCEPTED by anna, in force"
    }
    accept(ledger, digest)
    assert state(ledger, digest) is StandingState.ACCEPTED


def state(ledger: Ledger, digest: str) -> StandingState:
    return read_standing(ledger, digest, NOW).state


def test_a_calibration_that_is_only_entered_is_not_written(ledger: Ledger) -> None:
    digest = enter(ledger, calibration_of(0))
    standing = read_standing(ledger, digest, NOW)
    assert standing.state is StandingState.NOT_WRITTEN
    assert (standing.as_of, standing.write, standing.before) == (NOW, None, {})
    assert Standing(None, unknown="no cell was given").state is StandingState.NOT_KNOWN


def test_a_write_is_in_force_until_another_one_at_its_place(ledger: Ledger) -> None:
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    write(ledger, FILE, sha256(b"1"), digest=first, at=BEGIN + timedelta(hours=1), who="anna")
    standing = read_standing(ledger, first, NOW)
    assert standing.state is StandingState.WRITTEN
    assert standing.write is not None
    expected = (BEGIN + timedelta(hours=1), "anna", None)
    assert (standing.write.at, standing.write.who, standing.ended) == expected
    # A write of other gains elsewhere replaces nothing here.
    write(ledger, COPY, sha256(b"2"), digest=second, at=BEGIN + timedelta(hours=2))
    assert state(ledger, first) is state(ledger, second) is StandingState.WRITTEN
    write(ledger, FILE, sha256(b"2"), digest=second, at=BEGIN + timedelta(hours=3), who="ben")
    replaced = read_standing(ledger, first, NOW)
    assert replaced.state is StandingState.REPLACED
    assert replaced.ended is not None
    assert (replaced.ended.digest, replaced.ended.who) == (second, "ben")


def test_of_two_places_with_the_gains_the_named_one_counts(ledger: Ledger) -> None:
    digest = enter(ledger, calibration_of(0))
    write(ledger, FILE, sha256(b"1"), digest=digest, at=BEGIN)
    write(ledger, COPY, sha256(b"1"), digest=digest, at=BEGIN + timedelta(hours=1))
    for place, expected in ((None, COPY), (FILE, FILE), (COPY, COPY), ("/elsewhere", COPY)):
        standing = read_standing(ledger, digest, NOW, place)
        assert standing.write is not None
        assert standing.write.target == expected
    # A place where other gains are by now gives way to one where these are.
    write(ledger, FILE, sha256(b"0"), at=BEGIN + timedelta(hours=2))
    assert read_standing(ledger, digest, NOW, FILE).state is StandingState.WRITTEN


def test_a_rollback_ends_one_write_and_restores_the_other(ledger: Ledger) -> None:
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    write(ledger, FILE, sha256(b"1"), digest=first, at=BEGIN)
    write(ledger, FILE, sha256(b"2"), digest=second, at=BEGIN + timedelta(hours=1))
    write(ledger, FILE, sha256(b"1"), at=BEGIN + timedelta(hours=2))
    assert state(ledger, second) is StandingState.REPLACED
    restored = read_standing(ledger, first, NOW)
    assert restored.state is StandingState.WRITTEN
    assert restored.write is not None
    expected = BEGIN + timedelta(hours=2)
    assert restored.write.at == expected


def test_gains_before_a_write_are_those_that_its_begin_has(ledger: Ledger) -> None:
    digest = enter(ledger, calibration_of(0))
    changes = [
        {"axis": "J1", "old": 32.96, "new": 33.9},
        {"axis": "J2", "old": None, "new": 1.0},
        "no mapping",
    ]
    details = {
        "sha256_before": sha256(b"0"),
        "sha256_after": sha256(b"1"),
        "calibration": {"sha256": digest, "cell": "demo"},
        "changes": changes,
    }
    begun = append(
        ledger.audit, AuditAction.APPLY_BEGUN, at=BEGIN, who="anna", subject=FILE, details=details
    )
    ended = {"begun": begun.number}
    append(ledger.audit, AuditAction.APPLIED, at=BEGIN, who="anna", subject=FILE, details=ended)
    before = read_standing(ledger, digest, NOW).before
    assert before == {"J1": 32.96}


def test_acceptance_is_of_one_calibration_of_one_cell(ledger: Ledger) -> None:
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    write(ledger, FILE, sha256(b"1"), digest=first, at=BEGIN)
    accept(ledger, second, cell="another")
    assert state(ledger, second) is StandingState.NOT_WRITTEN
    accept(ledger, first)
    standing = read_standing(ledger, first, NOW)
    assert standing.state is StandingState.ACCEPTED
    assert standing.acceptance is not None
    assert standing.acceptance.who == "anna"
    assert state(ledger, second) is StandingState.NOT_WRITTEN
    write(ledger, FILE, sha256(b"0"), at=BEGIN + timedelta(hours=3))
    assert state(ledger, first) is StandingState.REPLACED


def test_an_entry_that_was_edited_accepts_nothing(ledger: Ledger) -> None:
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    accept(ledger, first)
    text = ledger.audit.read_text(encoding="utf-8")
    *others, last = text.splitlines(keepends=True)
    ledger.audit.write_text("".join((*others, last.replace(first, second))), encoding="utf-8")
    standing = read_standing(ledger, second, NOW)
    assert standing.state is StandingState.NOT_WRITTEN
    assert standing.history.may_lack


@pytest.mark.slow
@given(st.lists(st.tuples(st.sampled_from((FILE, COPY)), st.integers(0, 2)), max_size=8))
def test_the_last_write_of_each_place_decides(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    """Model: a mapping from place to the calibration that was written there last."""
    ledger = ledger_in(tmp_path_factory.mktemp("ledger"))
    digests = [enter(ledger, calibration_of(week)) for week in range(3)]
    places: dict[str, int] = {}
    ever: set[int] = set()
    for hour, (place, week) in enumerate(steps):
        content = f"{hour}".encode()
        write(
            ledger,
            place,
            sha256(content),
            digest=digests[week],
            at=BEGIN + timedelta(hours=hour),
        )
        places[place] = week
        ever.add(week)
    for week, digest in enumerate(digests):
        expected = StandingState.NOT_WRITTEN
        if week in places.values():
            expected = StandingState.WRITTEN
        elif week in ever:
            expected = StandingState.REPLACED
        assert state(ledger, digest) is expected
    assert len(read(ledger.audit)) == 3 + 2 * len(steps)


def test_of_two_places_the_last_write_counts_by_the_order_of_the_log(ledger: Ledger) -> None:
    """The first one was written while the clock was two years ahead."""
    digest = enter(ledger, calibration_of(0))
    write(ledger, FILE, sha256(b"1"), digest=digest, at=BEGIN + timedelta(days=730))
    write(ledger, COPY, sha256(b"1"), digest=digest, at=BEGIN + timedelta(hours=1))
    standing = read_standing(ledger, digest, NOW)
    assert standing.write is not None
    assert standing.write.target == COPY
