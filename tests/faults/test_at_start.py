"""Every fault that is there before a recording:
it is refused by name, and no axis ever has power.
"""

from __future__ import annotations

import pytest

from drivers.errors import (
    BusBusy,
    DriveFault,
    DriverError,
    NodeMissing,
    SampleLost,
    SetupRefused,
    StateRefused,
)
from drivers.messages import EventKind
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind, FaultSpec
from tests.faults.cells import run

REFUSALS: dict[FaultKind, tuple[type[DriverError], str]] = {
    FaultKind.SILENT: (
        NodeMissing,
        r"J2 \(node 2\) did not answer within 1 s \(answered: 1, 3, "
        r"4, 5, 6\)",
    ),
    FaultKind.OTHER_SERIAL: (
        SetupRefused,
        r"J2 \(node 2\): serial number 1018h:04 is 1003, .* "
        r"expects 1002",
    ),
    FaultKind.REFUSES_NMT: (
        StateRefused,
        r"J2 \(node 2\): asked for NMT OPERATIONAL, its heartbeat still says PRE-OPERATIONAL",
    ),
    FaultKind.REFUSES_MAPPING: (
        SetupRefused,
        r"J2 \(node 2\): TPDO1: writing 0x0 to 1A00h:00: aborted.*0x06010002",
    ),
    FaultKind.SHIFTED: (
        SetupRefused,
        r"J2 \(node 2\): object 6064h(:00)? is -?\d+ by SDO and "
        r"-?\d+ in its PDO",
    ),
    FaultKind.SECOND_MASTER: (BusBusy, r"a SYNC \(080h\) that we did not send"),
    FaultKind.SYNC_PRODUCER: (
        BusBusy,
        r"a SYNC \(080h\) that we did not send; .* no other master, .* SYNC producer",
    ),
    FaultKind.SDO_MASTER: (
        BusBusy,
        r"an SDO request to J2 \(node 2\) \(602h\) that we "
        r"did not send",
    ),
}


@pytest.mark.parametrize("kind", REFUSALS, ids=lambda kind: kind.value)
def test_a_fault_from_the_start_is_refused_by_name_before_anything_moves(kind: FaultKind) -> None:
    error, text = REFUSALS[kind]
    outcome = run(f"start {kind.value}", FaultSpec(kind, 1))
    assert isinstance(outcome.error, error), outcome.error
    with pytest.raises(error, match=text):
        raise outcome.error
    assert set(outcome.states) == {PowerState.SWITCH_ON_DISABLED}
    assert not outcome.cycles_of(EventKind.MOVE_START)
    assert outcome.restored


@pytest.mark.parametrize("at_cycle", [0, 1, 2])
def test_an_error_that_an_axis_reports_before_it_has_power_is_in_the_message(at_cycle: int) -> None:
    fault = FaultSpec(FaultKind.EMERGENCY, 2, at_cycle, None, 0x4310)
    outcome = run(f"overheated {at_cycle}", fault)
    assert isinstance(outcome.error, (StateRefused, DriveFault)), outcome.error
    assert "J3 (node 3)" in str(outcome.error)
    assert "EMCY 4310h drive temperature too high" in str(outcome.error)
    assert not outcome.cycles_of(EventKind.MOVE_START)


@pytest.mark.parametrize("at_cycle", [0, 1])
def test_an_axis_that_falls_silent_with_the_first_sync_is_named_with_its_error(
    at_cycle: int,
) -> None:
    outcome = run(f"fell back {at_cycle}", FaultSpec(FaultKind.FALLS_BACK, 2, at_cycle))
    assert isinstance(outcome.error, (SampleLost, DriveFault)), outcome.error
    assert "J3 (node 3)" in str(outcome.error)
    assert "EMCY 8130h life guard error or heartbeat error" in str(outcome.error)
    assert not outcome.cycles_of(EventKind.MOVE_START)


@pytest.mark.slow
def test_an_amplifier_without_consumer_heartbeat_is_recorded_and_said_so() -> None:
    outcome = run("no guard", FaultSpec(FaultKind.NO_GUARD, 1))
    assert outcome.error is None
    assert outcome.unguarded == (
        "J2: no 1016h: it does NOT stop by itself when the recorder is killed",
    )
