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
from drivers.messages import CellEvent, EventKind
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
        text: of the error that ends the recording.
        event: that the log gets.
        error: kind of that error.
        within_cycles: from the fault to that event.
        toggle_bit: of the amplifiers.
    """

    fault: FaultSpec
    text: str
    event: EventKind
    error: type[DriverError] = DriveFault
    within_cycles: int = 2
    toggle_bit: ToggleBit | None = None


def at(
    kind: FaultKind, value: int = 0, cycles: int | None = None, axis: int | None = AXIS
) -> FaultSpec:
    return FaultSpec(kind, axis, STRIKE, cycles, value)


def stands_still(kind: FaultKind, toggle_bit: ToggleBit | None = None) -> Promise:
    """Positions that stay the same for so long that the moves should have changed them."""
    text = J3 + "move 0: .* do not change"
    return Promise(
        at(kind),
        text,
        EventKind.FROZEN,
        within_cycles=60,
        toggle_bit=toggle_bit,
    )


def no_answer(kind: FaultKind) -> Promise:
    return Promise(
        at(kind),
        "no answer from J3",
        EventKind.SAMPLE_LOST,
        SampleLost,
    )


def foreign_sync(fault: FaultSpec) -> Promise:
    text = r"a SYNC \(080h\) that we did not send"
    return Promise(fault, text, EventKind.BUS_BUSY, BusBusy)


NO_HEARTBEAT = J3 + "no heart"
LIMIT_IS_ACTIVE = J3 + "a limit has been active for 0.5 s"
NO_TOGGLE = J3 + "statusword bit 14 has not toggled"
SENSOR_FAULT = at(FaultKind.EMERGENCY, 0x7305)
SECOND_MASTER = at(FaultKind.SECOND_MASTER, axis=None)
STOPS = {
    "emcy": Promise(
        SENSOR_FAULT,
        "7305h incremental sensor 1 fault",
        EventKind.EMCY,
    ),
    "following-error": Promise(
        at(FaultKind.FOLLOWING_ERROR),
        "8611h following error",
        EventKind.FOLLOWING_ERROR,
    ),
    "falls-back": Promise(
        at(FaultKind.FALLS_BACK),
        "8130h life guard error",
        EventKind.EMCY,
    ),
    "reboots": Promise(
        at(FaultKind.REBOOTS),
        "left OPERATIONAL",
        EventKind.NMT,
    ),
    "loses-power": Promise(
        at(FaultKind.LOSES_POWER),
        "left OPERATION ENABLED, is SWITCH ON DISABLED",
        EventKind.STATE,
    ),
    "heartbeat": Promise(
        at(FaultKind.NO_HEARTBEAT),
        NO_HEARTBEAT,
        EventKind.HEARTBEAT_LOST,
        within_cycles=330,
    ),
    "limit": Promise(
        at(FaultKind.LIMIT),
        LIMIT_IS_ACTIVE,
        EventKind.LIMIT,
    ),
    "frozen": stands_still(FaultKind.FROZEN),
    "stale": stands_still(FaultKind.STALE),
    "stale, toggle bit": Promise(
        at(FaultKind.STALE),
        NO_TOGGLE,
        EventKind.FROZEN,
        toggle_bit=14,
    ),
    "frozen, toggle bit": stands_still(FaultKind.FROZEN, toggle_bit=14),
    "sync-producer": foreign_sync(at(FaultKind.SYNC_PRODUCER)),
    "short-pdo": Promise(
        at(FaultKind.SHORT_PDO),
        "PDO 183h has 7 bytes, its mapping has 8",
        EventKind.PDO_LENGTH,
    ),
    "wrong-cob-id": no_answer(FaultKind.WRONG_COB_ID),
    "lost": no_answer(FaultKind.LOST),
    "second-master": foreign_sync(SECOND_MASTER),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STOPS)
def test_a_fault_is_named_logged_in_time_and_stops_all_axes(name: str) -> None:
    promise = STOPS[name]
    outcome = run(name, promise.fault, toggle_bit=promise.toggle_bit)
    error = outcome.error
    assert isinstance(error, promise.error), error
    assert_matches(promise.text, error)
    cycles = outcome.cycles_of(promise.event)
    reported = [cycle for cycle in cycles if cycle >= STRIKE]
    assert reported
    delay_cycles = reported[0] - STRIKE
    assert delay_cycles <= promise.within_cycles
    first_stop = outcome.cycles_of(EventKind.STOP)[0]
    assert first_stop >= STRIKE
    kinds = {event.kind for event in outcome.events}
    assert EventKind.STOP_UNCONFIRMED not in kinds
    assert outcome.powerless
    if name != "reboots":  # which forgets its settings by itself
        assert outcome.restored
    ends = outcome.cycles_of(EventKind.MOVE_END)
    assert len(ends) < 2  # of two: the second was not made


def assert_matches(text: str, error: DriverError) -> None:
    with pytest.raises(type(error), match=text):
        raise error


def events_of(outcome: Outcome, kind: EventKind) -> list[CellEvent]:
    return [event for event in outcome.events if event.kind is kind]


def test_a_cell_that_falls_silent_is_reported_after_one_bound_not_after_one_a_node() -> None:
    fault = at(FaultKind.SILENT, axis=None)
    outcome = run("silent", fault, guard_ms=60_000)
    assert isinstance(outcome.error, SampleLost)
    assert "no axis answered within" in str(outcome.error)
    lost = outcome.cycles_of(EventKind.SAMPLE_LOST, AXIS)
    assert lost[0] == STRIKE
    # Each of them waits, but the first alone for a whole bound
    assert outcome.ended_cycle - STRIKE <= 6
    notes = " ".join(outcome.error.__notes__)
    names = [f"J{number} (node {number})" for number in range(1, 7)]
    nodes = ", ".join(names)
    assert f"while stopping: {nodes} did not answer" in notes
    assert "while closing" in notes
    assert outcome.cycles_of(EventKind.STOP_UNCONFIRMED)


def test_an_axis_that_falls_silent_stops_the_others_and_is_shouted() -> None:
    outcome = run("silent axis", at(FaultKind.SILENT))
    assert isinstance(outcome.error, SampleLost)
    states = list(outcome.states)
    del states[AXIS]
    assert set(states) == {PowerState.SWITCH_ON_DISABLED}
    (unconfirmed,) = events_of(outcome, EventKind.STOP_UNCONFIRMED)
    assert unconfirmed.axis == AXIS
    notes = " ".join(outcome.error.__notes__)
    assert "J3 (node 3) did not answer" in notes
    assert outcome.restored_axes == (0, 1, 3, 4, 5)


@pytest.mark.slow
def test_an_axis_that_is_cut_off_stops_by_itself_since_it_hears_no_recorder() -> None:
    fault = at(FaultKind.SILENT)
    outcome = run(
        "guarded",
        fault,
        guard_ms=GUARD_MS,
        afterwards=2 * GUARD_MS,
    )
    assert isinstance(outcome.error, SampleLost)
    assert set(outcome.states) == {PowerState.SWITCH_ON_DISABLED}


@pytest.mark.slow
def test_bus_off_is_reported_at_once_and_the_axes_stop_by_themselves() -> None:
    fault = at(FaultKind.BUS_OFF, axis=None)
    outcome = run(
        "bus off",
        fault,
        guard_ms=GUARD_MS,
        afterwards=2 * GUARD_MS,
    )
    assert isinstance(outcome.error, BusError)
    assert_matches("bus-off", outcome.error)
    first = outcome.cycles_of(EventKind.BUS_LOST)[0]
    assert first - STRIKE <= 2
    assert outcome.cycles_of(EventKind.STOP_UNCONFIRMED)
    assert set(outcome.states) == {PowerState.SWITCH_ON_DISABLED}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "field"),
    [(FaultKind.LOST, "missing"), (FaultKind.LATE, "late"), (FaultKind.DUPLICATE, "duplicate")],
)
def test_a_single_bad_frame_is_counted_and_the_run_goes_on(kind: FaultKind, field: str) -> None:
    fault = at(kind, cycles=1)
    outcome = run(f"one {field}", fault)
    assert outcome.error is None
    count = getattr(outcome.statistics, field)
    assert count == 1
    assert outcome.powerless
    assert outcome.restored


def test_an_error_passive_controller_is_reported_and_the_run_goes_on() -> None:
    fault = at(FaultKind.ERROR_PASSIVE, axis=None)
    outcome = run("passive", fault)
    assert outcome.error is None
    first = outcome.cycles_of(EventKind.BUS_PASSIVE)[0]
    assert first - STRIKE <= 2
    assert outcome.restored


def test_toggle_bits_of_a_sound_cell_are_no_fault_and_a_lost_frame_is_none_of_theirs() -> None:
    fault = at(FaultKind.LOST, cycles=2)
    outcome = run("toggles", fault, toggle_bit=15)
    assert outcome.error is None
    assert not outcome.cycles_of(EventKind.FROZEN)
    assert outcome.restored


@pytest.mark.slow
def test_a_short_frame_alone_is_counted_and_the_run_goes_on() -> None:
    fault = at(FaultKind.SHORT_PDO, cycles=1)
    outcome = run("one short", fault)
    assert outcome.error is None
    assert outcome.statistics is not None
    assert outcome.statistics.wrong_length == 1
    assert outcome.statistics.missing == 1


@pytest.mark.slow
def test_someone_who_only_asks_a_drive_is_reported_and_does_not_stop_the_run() -> None:
    fault = at(FaultKind.SDO_MASTER, cycles=5)
    outcome = run("asks", fault)
    assert outcome.error is None
    (busy,) = events_of(outcome, EventKind.BUS_BUSY)
    assert busy.text == "an SDO request to J3 (node 3) (603h) that we did not send"
