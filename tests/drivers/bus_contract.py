"""Requirements on every bus, whatever its interface;
subclass it with a fixture ``ends`` of three open ends.
"""

from __future__ import annotations

import can
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import send_burst

WAIT_S = 5.0
Ends = tuple[can.BusABC, can.BusABC, can.BusABC]

frames = st.builds(
    lambda extended, number, data: can.Message(
        arbitration_id=number if extended else number & 0x7FF, is_extended_id=extended, data=data
    ),
    st.booleans(),
    st.integers(0, 0x1FFF_FFFF),
    st.binary(max_size=8),
)


def same(one: can.Message | None, other: can.Message) -> bool:
    """Equal in all that is on the wire."""
    return one is not None and one.equals(
        other, timestamp_delta=None, check_channel=False, check_direction=False
    )


class BusContract:
    """The tests; a subclass has the fixture."""

    # The ends stay open over all examples, and every interface runs the same examples: both are
    # meant.
    @settings(
        max_examples=30,
        deadline=None,
        database=None,
        suppress_health_check=[
            HealthCheck.function_scoped_fixture,
            HealthCheck.differing_executors,
        ],
    )
    @given(burst=st.lists(frames, min_size=1, max_size=20))
    def test_every_other_end_gets_every_frame_in_order(
        self, ends: Ends, burst: list[can.Message]
    ) -> None:
        sender, *others = ends
        send_burst(sender, burst)
        for end in others:
            for frame in burst:
                assert same(end.recv(WAIT_S), frame)

    def test_no_end_hears_itself(self, ends: Ends) -> None:
        first, second, _ = ends
        message = can.Message(arbitration_id=1, is_extended_id=False)
        first.send(message)
        second.send(can.Message(arbitration_id=2, is_extended_id=False))
        heard = first.recv(WAIT_S)
        assert heard is not None
        assert heard.arbitration_id == 2
        assert first.recv(0.0) is None

    def test_nothing_to_receive_is_none(self, ends: Ends) -> None:
        assert ends[0].recv(0.0) is None

    def test_a_long_burst_loses_nothing(self, ends: Ends) -> None:
        sender, *others = ends
        burst = []
        for n in range(3000):
            data = n.to_bytes(8, "big")
            burst.append(can.Message(arbitration_id=n & 0x7FF, is_extended_id=False, data=data))
        for start in range(0, 3000, 100):
            send_burst(sender, burst[start : start + 100])
        for end in others:
            received = [end.recv(WAIT_S) for _ in burst]
            expected = [bytes(frame.data) for frame in burst]
            assert [bytes(frame.data) for frame in received if frame] == expected

    def test_shutdown_twice_is_harmless(self, ends: Ends) -> None:
        ends[2].shutdown()
        ends[2].shutdown()
