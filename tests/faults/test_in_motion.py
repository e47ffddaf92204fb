"""Faults in the middle of a move: the name, the time to report it,
and all axes without power at the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from drivers.errors import (
    BusBusy,
    BusError,
    DriveFault,
    DriverError,
    SampleLost,
)
from drivers.messages import EventKind
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.spec import ToggleBit
from tests.faults.cells import STRIKE, Outcome, run

pytestmark = pytest.mark.slow  # each fault takes a recording of its own

AXIS = 2
GUARD_MS = 2000


J3 = r"J3 \(node 3\): "


@dataclass(frozen=True)
class Promise:
    """Promise for one fault.

    Attributes:
        fault: that comes.
        error, text: that ends the recording.
        event: that the log gets.
        within_cycles: from the fault to that event.
        toggle_bit: of the amplifiers.
    """

    fault: FaultSpec
    error: type[DriverError]
    text: str
    event: EventKind
    within_cycles: int
    toggle_bit: ToggleBit | None = None


def at(
    kind: FaultKind, value: int = 0, cycles: int | None = None, axis: int | None = AXIS
) -> FaultSpec:
    return FaultSpec(kind, axis, STRIKE, cycles, value)


STOPS = {
    "emcy": Promise(
        at(FaultKind.EMERGENCY, 0x7305),
        DriveFault,
        "7305h incremental sensor 1 fault",
        EventKind.EMCY,
        2,
    ),
    "following-error": Promise(
        at(FaultKind.FOLLOWING_ERROR),
        DriveFault,
        "8611h following error",
        EventKind.FOLLOWING_ERROR,
        2,
    ),
    "falls-back": Promise(
        at(FaultKind.FALLS_BACK), DriveFault, "8130h life guard error", EventKind.EMCY, 2
    ),
    "reboots": Promise(at(FaultKind.REBOOTS), DriveFault, "left OPERATIONAL", EventKind.NMT, 2),
    "loses-power": Promise(
        at(FaultKind.LOSES_POWER),
        DriveFault,
        "left OPERATION ENABLED, is SWITCH ON DISABLED",
        EventKind.STATE,
        2,
    ),
    "heartbeat": Promise(
        at(FaultKind.NO_HEARTBEAT), DriveFault, J3 + "no heart", EventKind.HEARTBEAT_LOST, 330
    ),
    "limit": Promise(
        at(FaultKind.LIMIT),
        DriveFault,
        J3 + "a limit has been active for 0.5 s",
        EventKind.LIMIT,
        2,
    ),
    "frozen": Promise(
        at(FaultKind.FROZEN), DriveFault, J3 + "move 0: .* do not change", EventKind.FROZEN, 60
    ),
    "stale": Promise(
        at(FaultKind.STALE), DriveFault, J3 + "move 0: .* do not change", EventKind.FROZEN, 60
    ),
    "stale, toggle bit": Promise(
        at(FaultKind.STALE),
        DriveFault,
        J3 + "statusword bit 14 has not toggled",
        EventKind.FROZEN,
        2,
        toggle_bit=14,
    ),
    "frozen, toggle bit": Promise(
        at(FaultKind.FROZEN),
        DriveFault,
        J3 + "move 0: .* do not change",
        EventKind.FROZEN,
        60,
        toggle_bit=14,
    ),
    "sync-producer": Promise(
        at(FaultKind.SYNC_PRODUCER),
        BusBusy,
        r"a SYNC \(080h\) that we "
        r"did not send",
        EventKind.BUS_BUSY,
        2,
    ),
    "short-pdo": Promise(
        at(FaultKind.SHORT_PDO),
        DriveFault,
        "PDO 183h has 7 bytes, its mapping has 8",
        EventKind.PDO_LENGTH,
        2,
    ),
    "wrong-cob-id": Promise(
        at(FaultKind.WRONG_COB_ID), SampleLost, "no answer from J3", EventKind.SAMPLE_LOST, 2
    ),
    "lost": Promise(at(FaultKind.LOST), SampleLost, "no answer from J3", EventKind.SAMPLE_LOST, 2),
    "second-master": Promise(
        at(FaultKind.SECOND_MASTER, axis=None),
        BusBusy,
        r"a SYNC \(080h\) that we "
        r"did not send",
        EventKind.BUS_BUSY,
        2,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STOPS)
def test_a_fault_is_named_logged_in_time_and_stops_all_axes(name: str) -> None:
    promise = STOPS[name]
    outcome = run(name, promise.fault, toggle_bit=promise.toggle_bit)
    error = outcome.error
    assert isinstance(error, promise.error), error
    assert_matches(promise.text, error)
    reported = [cycle for cycle in outcome.cycles_of(promise.event) if cycle >= STRIKE]
    assert reported
    assert reported[0] - STRIKE <= promise.within_cycles
    assert outcome.cycles_of(EventKind.STOP)[0] >= STRIKE
    assert EventKind.STOP_UNCONFIRMED not in {event.kind for event in outcome.events}
    assert outcome.powerless
    if name != "reboots":  # which forgets its settings by itself
        assert outcome.restored
    assert len(outcome.cycles_of(EventKind.MOVE_END)) < 2  # of two: the second was not made


def assert_matches(text: str, error: DriverError) -> None:
    with pytest.raises(type(error), match=text):
        raise error


def test_a_cell_that_falls_silent_is_reported_after_one_bound_not_after_one_a_node() -> None:
    outcome = run("silent", at(FaultKind.SILENT, axis=None), guard_ms=60_000)
    assert isinstance(outcome.error, SampleLost)
    assert "no axis answered within" in str(outcome.error)
    assert outcome.cycles_of(EventKind.SAMPLE_LOST, AXIS)[0] == STRIKE
    # Each of them waits, but the first alone for a whole bound
    assert outcome.ended_cycle - STRIKE <= 6
    notes = " ".join(outcome.error.__notes__)
    nodes = ", ".join(f"J{number} (node {number})" for number in range(1, 7))
    assert f"while stopping: {nodes} did not answer" in notes
    assert "while closing" in notes
    assert outcome.cycles_of(EventKind.STOP_UNCONFIRMED)


def test_an_axis_that_falls_silent_stops_the_others_and_is_shouted() -> None:
    outcome = run("silent axis", at(FaultKind.SILENT))
    assert isinstance(outcome.error, SampleLost)
    others = [state for axis, state in enumerate(outcome.states) if axis != AXIS]
    assert set(others) == {PowerState.SWITCH_ON_DISABLED}
    assert [event.axis for event in outcome.events if event.kind is EventKind.STOP_UNCONFIRMED] == [
        AXIS
    ]
    assert "J3 (node 3) did not answer" in " ".join(outcome.error.__notes__)
    assert outcome.restored_axes == tuple(axis for axis in range(6) if axis != AXIS)


@pytest.mark.slow
def test_an_axis_that_is_cut_off_stops_by_itself_since_it_hears_no_recorder() -> None:
    outcome = run("guarded", at(FaultKind.SILENT), guard_ms=GUARD_MS, afterwards=2 * GUARD_MS)
    assert isinstance(outcome.error, SampleLost)
    assert set(outcome.states) == {PowerState.SWITCH_ON_DISABLED}


@pytest.mark.slow
def test_bus_off_is_reported_at_once_and_the_axes_stop_by_themselves() -> None:
    outcome = run(
        "bus off", at(FaultKind.BUS_OFF, axis=None), guard_ms=GUARD_MS, afterwards=2 * GUARD_MS
    )
    assert isinstance(outcome.error, BusError)
    assert_matches("bus-off", outcome.error)
    assert outcome.cycles_of(EventKind.BUS_LOST)[0] - STRIKE <= 2
    assert outcome.cycles_of(EventKind.STOP_UNCONFIRMED)
    assert set(outcome.states) == {PowerState.SWITCH_ON_DISABLED}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "field"),
    [(FaultKind.LOST, "missing"), (FaultKind.LATE, "late"), (FaultKind.DUPLICATE, "duplicate")],
)
def test_a_single_bad_frame_is_counted_and_the_run_goes_on(kind: FaultKind, field: str) -> None:
    outcome: Outcome = run(f"one {field}", at(kind, cycles=1))
    assert outcome.error is None
    assert getattr(outcome.statistics, field) == 1
    assert outcome.powerless
    assert outcome.restored


def test_an_error_passive_controller_is_reported_and_the_run_goes_on() -> None:
    outcome = run("passive", at(FaultKind.ERROR_PASSIVE, axis=None))
    assert outcome.error is None
    assert outcome.cycles_of(EventKind.BUS_PASSIVE)[0] - STRIKE <= 2
    assert outcome.restored


def test_toggle_bits_of_a_sound_cell_are_no_fault_and_a_lost_frame_is_none_of_theirs() -> None:
    outcome = run("toggles", at(FaultKind.LOST, cycles=2), toggle_bit=15)
    assert outcome.error is None
    assert not outcome.cycles_of(EventKind.FROZEN)
    assert outcome.restored


@pytest.mark.slow
def test_a_short_frame_alone_is_counted_and_the_run_goes_on() -> None:
    outcome = run("one short", at(FaultKind.SHORT_PDO, cycles=1))
    assert outcome.error is None
    assert outcome.statistics is not None
    assert (outcome.statistics.wrong_length, outcome.statistics.missing) == (1, 1)


@pytest.mark.slow
def test_someone_who_only_asks_a_drive_is_reported_and_does_not_stop_the_run() -> None:
    outcome = run("asks", at(FaultKind.SDO_MASTER, cycles=5))
    assert outcome.error is None
    assert [event.text for event in outcome.events if event.kind is EventKind.BUS_BUSY] == [
        "an SDO request to J3 (node 3) (603h) that we did not send"
    ]
