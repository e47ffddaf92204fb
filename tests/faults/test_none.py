"""The same run without any fault: nothing is reported, nothing is left behind."""

from __future__ import annotations

import pytest

from drivers.messages import EventKind
from tests.faults.cells import STRIKE, run

INCIDENTS = {
    EventKind.EMCY,
    EventKind.FOLLOWING_ERROR,
    EventKind.LIMIT,
    EventKind.HEARTBEAT_LOST,
    EventKind.SAMPLE_LOST,
    EventKind.BUS_BUSY,
    EventKind.BUS_LOST,
    EventKind.PDO_LENGTH,
    EventKind.FROZEN,
    EventKind.STOP_UNCONFIRMED,
}


@pytest.mark.slow
def test_a_cell_without_faults_moves_there_and_back_and_gets_its_settings_back() -> None:
    outcome = run("none")
    assert outcome.error is None
    assert not INCIDENTS & {event.kind for event in outcome.events}
    assert outcome.cycles_of(EventKind.MOVE_START)[0] < STRIKE - 60
    assert outcome.cycles_of(EventKind.MOVE_END)[0] > STRIKE + 100
    assert outcome.powerless
    assert outcome.restored
