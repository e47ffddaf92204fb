"""Only a machine that stands still excuses a failed test; this part needs no CAN."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from tests.vcan import conftest
from tests.vcan.host_stalls import HostStalls, stalls_between
from tests.vcan.host_watch import Tick

BEGIN_S = 1000.0
END_S = 1040.0


def _tick(time_s: float, late_ms: float) -> Tick:
    return Tick(
        time_ns=round(1e9 * time_s),
        since_ns=2_500_000,
        late_ns=round(1e6 * late_ms),
        work_ns=20_000,
        waited_ns=0,
        stolen_ns=0,
        dropped=0,
        cpu=0,
    )


def test_stalls_are_counted_from_5_ms_on_within_the_test() -> None:
    ticks = [
        _tick(BEGIN_S - 0.1, 30.0),
        _tick(BEGIN_S + 1.0, 4.9),
        _tick(BEGIN_S + 2.0, 5.1),
        _tick(BEGIN_S + 3.0, 12.0),
        _tick(END_S + 0.1, 30.0),
    ]
    stalls = stalls_between(ticks, BEGIN_S, END_S)
    assert stalls.count == 2
    assert stalls.longest_s == pytest.approx(0.012)
    assert str(stalls) == "the machine stood still 2 times in 40 s, for 12 ms at most"


@pytest.mark.parametrize(
    ("count", "lasted_s", "excuses"),
    [(0, 1.0, False), (1, 1.0, True), (1, 40.0, False), (2, 40.0, True), (6, 136.0, False)],
)
def test_stalls_excuse_where_there_is_one_for_each_recording(
    count: int, lasted_s: float, excuses: bool
) -> None:
    stalls = HostStalls(count, 0.012, lasted_s)
    assert stalls.excuse_a_failure is excuses


def _fail() -> None:
    raise AssertionError("6 missing answers")


@pytest.mark.parametrize(
    ("late_ms", "phase", "outcome"),
    [
        (12.0, "call", "skipped"),
        (12.0, "setup", "skipped"),
        (12.0, "teardown", "failed"),
        (1.0, "call", "failed"),
    ],
)
def test_only_a_stall_excuses_a_test_and_nothing_excuses_a_wrong_log(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    late_ms: float,
    phase: Literal["setup", "call", "teardown"],
    outcome: str,
) -> None:
    stash = pytest.Stash()
    stash[conftest.FIGURES] = []
    stash[conftest.EXCUSED] = {}
    stash[conftest.HOST_WATCH] = Path("watch")
    monkeypatch.setattr(request.config, "stash", stash)
    item = request.node
    failed = pytest.TestReport(
        item.nodeid, item.location, {}, "failed", "6 missing answers", phase, ()
    )
    call = pytest.CallInfo.from_call(_fail, phase)
    ticks = [_tick(call.start, late_ms), _tick(call.stop, late_ms)]
    monkeypatch.setattr(conftest, "watched", lambda _path: ticks)
    hook = conftest.pytest_runtest_makereport(item, call)
    next(hook)
    with pytest.raises(StopIteration) as ended:
        hook.send(failed)
    monkeypatch.undo()
    is_excused = outcome == "skipped"
    assert ended.value.value.outcome == outcome
    assert bool(stash[conftest.EXCUSED]) is is_excused
    if is_excused:
        (said,) = stash[conftest.FIGURES]
        assert "the machine stood still" in said
        assert "6 missing answers" in said
    else:
        assert stash[conftest.FIGURES] == []
