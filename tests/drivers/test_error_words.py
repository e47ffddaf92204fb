"""What each error of the drivers says and carries: the node, what was found, what to do."""

from __future__ import annotations

import pickle

import pytest

from drivers.errors import (
    BusBusy,
    BusError,
    DriveFault,
    DriverError,
    MotionRefused,
    MotionTimeout,
    NodeMisplaced,
    NodeMissing,
    ObjectAccessError,
    ParametersMixed,
    SampleLost,
    SetupRefused,
    StateRefused,
    node_label,
)
from drivers.profiles.profile import Axis

J2 = Axis("J2", 2)
ACKNOWLEDGE_REMEDY = "check that the drive is in profile position mode (6061h = 1)"


@pytest.mark.parametrize(
    ("node", "names", "label"),
    [
        (3, None, "node 3"),
        (3, {2: "J2"}, "node 3"),
        (2, {2: "J2"}, "J2 (node 2)"),
        (J2, None, "J2 (node 2)"),
        (Axis("", 2), None, "node 2"),
    ],
)
def test_a_node_is_named_by_its_axis_where_that_is_known(
    node: int | Axis, names: dict[int, str] | None, label: str
) -> None:
    assert node_label(node, names) == label


def test_an_error_of_a_bus_names_its_address_first() -> None:
    error = BusError("socketcan:can0", "no such device")
    assert str(error) == "bus socketcan:can0: no such device"
    assert (error.address, error.reason) == ("socketcan:can0", "no such device")


def test_frames_of_another_master_are_named_with_the_bus_and_what_to_do() -> None:
    error = BusBusy.by_master("can0", "SYNC")
    assert error.found == "SYNC that we did not send"
    assert str(error) == (
        "bus can0: found SYNC that we did not send; expected no other master, recorder or SYNC "
        "producer; end the other program first"
    )


@pytest.mark.parametrize(
    ("identifier", "words"),
    [
        (0x701, "a heartbeat 701h of another device, which has node id 1 too"),
        (0x77F, "a heartbeat 77Fh of another device, which has node id 127 too"),
        (0x700 - 1, "a frame 6FFh of another device, which has node id 127 too"),
        (0x582, "a frame 582h of another device, which has node id 2 too"),
    ],
)
def test_a_device_with_our_node_id_is_named_by_its_frame(identifier: int, words: str) -> None:
    assert BusBusy.by_own_id("can0", identifier).found == words


def test_silent_nodes_are_named_with_those_that_answered_and_the_wait() -> None:
    error = NodeMissing([J2, 5], (1, 3), 1.5)
    assert str(error).startswith(
        "J2 (node 2), node 5 did not answer within 1.5 s (answered: 1, 3); check power"
    )
    assert error.node_ids == (2, 5)
    assert error.found == (1, 3)
    assert "(answered: none)" in str(NodeMissing([5], (), 1.0))


def test_a_node_on_the_other_bus_is_named_with_both() -> None:
    error = NodeMisplaced(4, "can0", "can1", "J4")
    assert str(error).startswith(
        "J4 (node 4) is heard on bus can1, the cell configuration has it on bus can0"
    )
    assert error.node_id == 4
    assert error.expected == "can0"
    assert error.found == "can1"


def test_an_sdo_that_failed_names_node_object_and_abort_code() -> None:
    error = ObjectAccessError(J2, "6064h:00", "aborted", 0x06010002)
    assert str(error) == "J2 (node 2): object 6064h:00: aborted"
    assert (error.node_id, error.entry) == (2, "6064h:00")
    assert (error.reason, error.abort_code) == ("aborted", 0x06010002)


def test_a_refused_set_up_says_found_expected_and_what_to_do() -> None:
    error = SetupRefused(J2, "6061h is 8", expected="1", remedy="set the mode")
    assert str(error) == "J2 (node 2): 6061h is 8; expected 1; set the mode"
    assert error.found == "J2 (node 2): 6061h is 8"
    assert (error.expected, error.remedy) == ("1", "set the mode")
    assert str(SetupRefused(2, "6061h is 8")) == "node 2: 6061h is 8"


@pytest.mark.parametrize(
    ("statusword", "remedy", "ending"),
    [
        (None, None, "its heartbeat still says FAULT; read its error register 1001h"),
        (
            0x18,
            None,
            "statusword 0x0018 says FAULT; check the power stage, the safety chain (STO) and the "
            "fault memory",
        ),
        (0x18, "reset it", "statusword 0x0018 says FAULT; reset it"),
    ],
)
def test_a_state_that_was_not_reached_says_what_was_read(
    statusword: int | None, remedy: str | None, ending: str
) -> None:
    error = StateRefused(2, "SWITCHED ON", "FAULT", statusword, remedy=remedy)
    assert str(error) == f"node 2: asked for SWITCHED ON, {ending}"
    assert error.asked == "SWITCHED ON"
    assert error.found == "FAULT"
    assert error.statusword == statusword


def test_drives_of_which_some_have_new_values_are_told_apart() -> None:
    error = ParametersMixed(("J1", "J2"), ("J3 does not answer", "J4 reads 0"))
    assert "are restored in J1, J2, and NOT confirmed where J3 does not answer; J4 reads 0" in str(
        error
    )
    assert "are restored in no drive, and" in str(ParametersMixed((), ("J3 does not answer",)))
    assert error.restored == ("J1", "J2")
    assert error.problems == ("J3 does not answer", "J4 reads 0")


def test_a_fault_says_that_all_axes_stop_and_carries_its_codes() -> None:
    error = DriveFault(2, "EMCY 8611h", 0x18, 0x8611, "look at the brake")
    assert str(error) == (
        "node 2: EMCY 8611h; stopping all axes, none is enabled again; look at the brake"
    )
    assert (error.statusword, error.emcy_code) == (0x18, 0x8611)
    assert str(DriveFault(2, "limit")).endswith("none is enabled again")


def test_a_lost_sample_names_the_silent_axes_or_says_that_none_answers() -> None:
    error = SampleLost(12, (1, 2), ("J2", "J3"))
    assert str(error) == "cycle 12: no answer from J2, J3"
    assert error.cycle == 12
    assert error.axes == (1, 2)
    error = SampleLost(12, (1, 2), ("J2", "J3"), None, ("", "EMCY 8130h life guard error"))
    assert str(error) == (
        "cycle 12: no answer from J2, J3; J3 had reported EMCY 8130h life guard error"
    )
    error = SampleLost(12, (2,), ("J3",), None, ("EMCY 8130h life guard error",))
    assert str(error) == "cycle 12: no answer from J3; it had reported EMCY 8130h life guard error"
    silent = SampleLost(12, (0, 1, 2), ("J1", "J2", "J3"), 0.12345)
    assert str(silent).startswith("cycle 12: no axis answered within 0.123 s; check the power")
    small = SampleLost(12, (0,), ("J1",), 0.5, ("EMCY 8130h life guard error",))
    assert str(small).endswith("and the bus; it had reported EMCY 8130h life guard error")


def test_refused_motion_says_what_was_found_and_what_to_do() -> None:
    error = MotionRefused("no permission", expected="one", remedy="give --enable-motion")
    assert str(error) == "found no permission; expected one; give --enable-motion"
    assert (error.found, error.expected) == ("no permission", "one")
    assert error.remedy == "give --enable-motion"
    assert str(MotionRefused("J1 starts outside")) == "J1 starts outside"


@pytest.mark.parametrize(
    ("acknowledge", "found", "remedy"),
    [
        (None, "did not reach the target", "check brakes and limits, or use slower moves"),
        (1, "did not set statusword bit 12 (set-point acknowledge)", ACKNOWLEDGE_REMEDY),
        (
            0,
            "did not clear statusword bit 12 (set-point acknowledge)",
            "the drive still works on an earlier set-point",
        ),
    ],
)
def test_a_late_move_says_what_did_not_come(
    acknowledge: int | None, found: str, remedy: str
) -> None:
    error = MotionTimeout(3, (1,), [J2], 2.5, acknowledge)
    expected = f"move 3: J2 (node 2) {found} within 2.5 s; stopping all axes; {remedy}"
    assert str(error).startswith(expected)
    assert error.move == 3
    assert error.axes == (1,)


def test_a_late_move_beside_another_master_names_it_first() -> None:
    text = str(MotionTimeout(3, (1,), [J2], 2.5, None, "another master sends SYNC"))
    assert "did not reach the target, and another master sends SYNC, within 2.5 s" in text
    assert "; end the other program first; else check brakes" in text


@pytest.mark.parametrize(
    "error",
    [
        DriverError("a"),
        NodeMissing([J2], (1,), 1.0),
        MotionTimeout(3, (1,), [J2], 2.5, 1),
        StateRefused(2, "a", "b", 7),
    ],
)
def test_an_error_that_leaves_a_process_is_the_same(error: DriverError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
