"""The CiA 402 state machine against the transitions of the standard."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.profiles.cia402 import (
    CONTROL_CHANGE_IMMEDIATELY,
    CONTROL_NEW_SETPOINT,
    ENABLED,
    FAULT_RESET_SEQUENCE,
    FAULTY,
    POWERLESS,
    STATUS_FAULT,
    STATUS_FOLLOWING_ERROR,
    STATUS_SETPOINT_ACKNOWLEDGE,
    STATUS_TARGET_REACHED,
    ControlCommand,
    Goal,
    State,
    decode,
    next_command,
)

STATES = tuple(state for state in State if state is not State.UNKNOWN)


def transition(state: State, command: int) -> State:
    """Reaction of the standard's drive to a controlword (transitions 2 to 16;
    605Ah = 5, so a stop is held).
    """
    powered = state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
    after: State
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE, State.NOT_READY_TO_SWITCH_ON):
        if state is State.FAULT and command & 0x80:
            after = State.SWITCH_ON_DISABLED
        else:
            after = state
    elif command & 0x02 == 0 or (command & 0x04 == 0 and not powered):
        after = State.SWITCH_ON_DISABLED
    elif command & 0x04 == 0:
        after = State.QUICK_STOP_ACTIVE
    elif state is State.QUICK_STOP_ACTIVE:
        # Transition 16, which some drives have
        after = State.OPERATION_ENABLED if command & 0x0F == 0x0F else state
    elif command & 0x01 == 0:
        after = State.READY_TO_SWITCH_ON
    elif state is State.SWITCH_ON_DISABLED:
        after = state
    elif state is State.READY_TO_SWITCH_ON:
        after = State.SWITCHED_ON
    elif command & 0x08:
        after = State.OPERATION_ENABLED
    else:
        after = State.SWITCHED_ON
    return after


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY_TO_SWITCH_ON),
        (0x0250, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY_TO_SWITCH_ON),
        (0x0233, State.SWITCHED_ON),
        (0x1637, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP_ACTIVE),
        (0x020F, State.FAULT_REACTION_ACTIVE),
        (0x0208, State.FAULT),
        (0x0228, State.FAULT),
        (0x0001, State.UNKNOWN),
    ],
)
def test_statuswords_of_the_standard(statusword: int, state: State) -> None:
    assert decode(statusword) is state


@given(st.integers(0, 0xFFFF))
def test_at_most_one_state_matches_and_other_bits_do_not_matter(statusword: int) -> None:
    matching = [state for state in STATES if statusword & state.value[0] == state.value[1]]
    assert len(matching) <= 1
    assert decode(statusword) is (matching[0] if matching else State.UNKNOWN)
    assert decode(statusword ^ 0xFF90) is decode(statusword)


@given(st.sampled_from(STATES), st.sampled_from(list(Goal)))
def test_every_way_ends_at_its_goal(state: State, goal: Goal) -> None:
    way = [state]
    for _ in range(5):
        command = next_command(way[-1], goal)
        way.append(transition(way[-1], command))
    ends = {
        Goal.OPERATION_ENABLED: State.OPERATION_ENABLED,
        Goal.SWITCH_ON_DISABLED: State.SWITCH_ON_DISABLED,
        Goal.QUICK_STOP: State.SWITCH_ON_DISABLED,
    }
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE, State.NOT_READY_TO_SWITCH_ON):
        assert way[-1] is state  # nothing leaves these by itself
    elif goal is Goal.QUICK_STOP and state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
        assert way[-1] is State.QUICK_STOP_ACTIVE
    else:
        assert way[-1] is ends[goal]
    if goal is not Goal.OPERATION_ENABLED:
        assert State.OPERATION_ENABLED not in way[1:]


def test_a_state_that_the_standard_does_not_name_is_not_known_to_be_without_power() -> None:
    state = decode(0x0001)
    assert state not in POWERLESS
    assert next_command(state, Goal.QUICK_STOP) is ControlCommand.DISABLE_VOLTAGE


def test_a_fault_reset_ends_without_power() -> None:
    state = State.FAULT
    for command in FAULT_RESET_SEQUENCE:
        state = transition(state, command)
    assert state is State.SWITCH_ON_DISABLED
    # Otherwise there is no rising edge
    assert FAULT_RESET_SEQUENCE[0] & ControlCommand.FAULT_RESET == 0


@pytest.mark.parametrize(
    ("bit", "number"),
    [
        (STATUS_FAULT, 3),
        (STATUS_TARGET_REACHED, 10),
        (STATUS_SETPOINT_ACKNOWLEDGE, 12),
        (STATUS_FOLLOWING_ERROR, 13),
        (CONTROL_NEW_SETPOINT, 4),
        (CONTROL_CHANGE_IMMEDIATELY, 5),
    ],
)
def test_bits_stand_where_cia_402_puts_them(bit: int, number: int) -> None:
    assert bit == 1 << number


@pytest.mark.parametrize(
    ("command", "word"),
    [
        (ControlCommand.DISABLE_VOLTAGE, 0x00),
        (ControlCommand.QUICK_STOP, 0x02),
        (ControlCommand.SHUTDOWN, 0x06),
        (ControlCommand.SWITCH_ON, 0x07),
        (ControlCommand.DISABLE_OPERATION, 0x07),
        (ControlCommand.ENABLE_OPERATION, 0x0F),
        (ControlCommand.FAULT_RESET, 0x80),
    ],
)
def test_commands_have_the_controlwords_of_cia_402(command: ControlCommand, word: int) -> None:
    assert int(command) == word


def test_a_state_is_named_in_the_words_of_the_standard() -> None:
    assert str(State.SWITCH_ON_DISABLED) == "SWITCH ON DISABLED"
    assert str(State.FAULT) == "FAULT"


def test_a_drive_in_fault_reaction_or_quick_stop_still_has_torque() -> None:
    with_torque = {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE}
    assert set(ENABLED) == with_torque
    assert not with_torque & set(POWERLESS)
    assert set(FAULTY) == {State.FAULT, State.FAULT_REACTION_ACTIVE}
