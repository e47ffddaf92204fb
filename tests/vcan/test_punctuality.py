"""A machine that is too slow is recognised, and excuses a failed test; this part needs no CAN."""

from __future__ import annotations

from typing import Literal

import pytest

from tests.vcan import conftest, punctuality
from tests.vcan.punctuality import MANY_LATE, Punctuality, measure_punctuality

SLOW = Punctuality(1000, MANY_LATE, 0.0312)
PUNCTUAL = Punctuality(1000, MANY_LATE - 1, 0.0312)


def test_a_process_that_answers_too_late_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    # A period that no machine keeps: the answers cross between two processes.
    monkeypatch.setattr(punctuality, "PERIOD_S", 1e-6)
    measured = measure_punctuality(cycles=20)
    assert measured.late == 20
    assert not measured.is_enough


def test_a_machine_with_much_time_is_punctual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(punctuality, "PERIOD_S", 0.3)
    measured = measure_punctuality(cycles=5)
    assert measured.late == 0
    assert measured.is_enough


def test_the_measurement_is_a_sentence() -> None:
    assert str(SLOW) == "3 of 1000 cycles of 20 ms were late; the slowest took 31 ms"


@pytest.mark.parametrize(
    ("measured", "phase", "outcome"),
    [
        (SLOW, "call", "skipped"),
        (SLOW, "setup", "skipped"),
        (SLOW, "teardown", "failed"),
        (PUNCTUAL, "call", "failed"),
    ],
)
def test_only_a_slow_machine_excuses_a_test_and_nothing_excuses_a_wrong_log(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    measured: Punctuality,
    phase: Literal["setup", "call", "teardown"],
    outcome: str,
) -> None:
    monkeypatch.setattr(conftest, "measure_punctuality", lambda: measured)
    stash = pytest.Stash()
    stash[conftest.FIGURES] = []
    stash[conftest.EXCUSED] = False
    monkeypatch.setattr(request.config, "stash", stash)
    item = request.node
    item.add_marker("vcan")
    failed = pytest.TestReport(
        item.nodeid, item.location, {}, "failed", "6 missing answers", phase, ()
    )
    call = pytest.CallInfo.from_call(lambda: None, phase)
    hook = conftest.pytest_runtest_makereport(item, call)
    next(hook)
    with pytest.raises(StopIteration) as ended:
        hook.send(failed)
    monkeypatch.undo()
    is_excused = outcome == "skipped"
    assert ended.value.value.outcome == outcome
    assert stash[conftest.EXCUSED] is is_excused
    if is_excused:
        (said,) = stash[conftest.FIGURES]
        assert str(SLOW) in said
        assert "6 missing answers" in said
    else:
        assert stash[conftest.FIGURES] == []
