"""The finite state automaton of CiA 402-2, transition by transition."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulation.drive import PowerState as P
from drivers.simulation.drive import next_state

SHUTDOWN = 0x06
SWITCH_ON = 0x07
ENABLE = 0x0F
DISABLE_VOLTAGE = 0x00
QUICK_STOP = 0x02
FAULT_RESET = 0x80


@pytest.mark.parametrize(
    ("number", "state", "controlword", "after"),
    (
        (2, P.SWITCH_ON_DISABLED, SHUTDOWN, P.READY_TO_SWITCH_ON),
        (3, P.READY_TO_SWITCH_ON, SWITCH_ON, P.SWITCHED_ON),
        (4, P.SWITCHED_ON, ENABLE, P.OPERATION_ENABLED),
        (5, P.OPERATION_ENABLED, SWITCH_ON, P.SWITCHED_ON),
        (6, P.SWITCHED_ON, SHUTDOWN, P.READY_TO_SWITCH_ON),
        (7, P.READY_TO_SWITCH_ON, DISABLE_VOLTAGE, P.SWITCH_ON_DISABLED),
        (7, P.READY_TO_SWITCH_ON, QUICK_STOP, P.SWITCH_ON_DISABLED),
        (8, P.OPERATION_ENABLED, SHUTDOWN, P.READY_TO_SWITCH_ON),
        (9, P.OPERATION_ENABLED, DISABLE_VOLTAGE, P.SWITCH_ON_DISABLED),
        (10, P.SWITCHED_ON, DISABLE_VOLTAGE, P.SWITCH_ON_DISABLED),
        (10, P.SWITCHED_ON, QUICK_STOP, P.SWITCH_ON_DISABLED),
        (11, P.OPERATION_ENABLED, QUICK_STOP, P.QUICK_STOP_ACTIVE),
        (12, P.QUICK_STOP_ACTIVE, DISABLE_VOLTAGE, P.SWITCH_ON_DISABLED),
        (15, P.FAULT, FAULT_RESET, P.SWITCH_ON_DISABLED),
    ),
)
def test_transition(number: int, state: P, controlword: int, after: P) -> None:
    assert next_state(state, controlword, 0x0000, stays_in_quick_stop=False) is after, number


def test_transition_16_exists_only_where_the_option_keeps_quick_stop() -> None:
    assert (
        next_state(P.QUICK_STOP_ACTIVE, ENABLE, QUICK_STOP, stays_in_quick_stop=True)
        is P.OPERATION_ENABLED
    )
    assert (
        next_state(P.QUICK_STOP_ACTIVE, ENABLE, QUICK_STOP, stays_in_quick_stop=False)
        is P.QUICK_STOP_ACTIVE
    )


@given(
    state=st.sampled_from(P), controlword=st.integers(0, 0xFFFF), previous=st.integers(0, 0xFFFF)
)
def test_power_only_through_switched_on_and_faults_only_left_by_an_edge(
    state: P, controlword: int, previous: int
) -> None:
    after = next_state(state, controlword, previous, stays_in_quick_stop=False)
    if after is P.OPERATION_ENABLED:
        assert controlword & 0x0F == 0x0F
        assert state in (P.READY_TO_SWITCH_ON, P.SWITCHED_ON, P.OPERATION_ENABLED)
    if state is P.FAULT and after is not P.FAULT:
        assert controlword & 0x80
        assert not previous & 0x80
        assert after is P.SWITCH_ON_DISABLED
    if not controlword & 0x02 and state not in (
        P.FAULT,
        P.FAULT_REACTION_ACTIVE,
        P.NOT_READY_TO_SWITCH_ON,
    ):
        assert after is P.SWITCH_ON_DISABLED
