"""The hub between processes: clients that send without end, and clients that read nothing."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import can
import pytest

from drivers.canopen.bus import open_bus
from drivers.simulation.hub import BACKLOG_BYTES, THROTTLE_BYTES, Hub
from tests.drivers.raw_client import raw_client

WAIT_S = 30.0
FLOOD_BYTES = 20_000_000
FRAME = b"< send 123 8 01 02 03 04 05 06 07 08 >"
LINES = 1000  #: in one write


class Flood(threading.Thread):
    """Sends one line again and again; `sent` counts the lines that the system has taken."""

    def __init__(self, client: socket.socket, line: bytes) -> None:
        super().__init__()
        self.sent = 0
        self._client = client
        self._line = line

    def run(self) -> None:
        with suppress(OSError):  # the hub may hang up, or the test is over
            while self.sent * len(self._line) < FLOOD_BYTES:
                self._client.sendall(self._line * LINES)
                self.sent += LINES


def until_still(count: Callable[[], int]) -> int:
    """Wait until a number does not grow any more."""
    end_s = time.monotonic() + WAIT_S
    last = -1
    while last != (last := count()) and time.monotonic() < end_s:
        time.sleep(0.5)
    return last


def frame(number: int) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False, data=b"\x2a")


@pytest.mark.slow
def test_a_client_that_sends_without_end_waits_for_the_cell_and_no_frame_is_lost() -> None:
    """20 MB from one client disconnected the cell itself after 8 MB:
    `simulate` ended with exit code 5.
    """
    with Hub(("can0",)) as hub:
        cell = open_bus(hub.address())
        with raw_client(hub) as hostile:
            flood = Flood(hostile, FRAME)
            flood.start()
            waiting = until_still(lambda: flood.sent)
            # The rest is not taken from it while the cell reads nothing
            assert waiting * len(FRAME) < FLOOD_BYTES
            assert hub.cells["can0"] in hub.clients
            received = 0
            expected = -(-FLOOD_BYTES // (LINES * len(FRAME))) * LINES
            while received < expected and (message := cell.recv(WAIT_S)) is not None:
                assert message.arbitration_id == 0x123
                received += 1
            flood.join()
        assert received == flood.sent == expected
        cell.shutdown()


def test_a_cell_that_reads_late_keeps_little_waiting_for_it() -> None:
    with Hub(("can0",)) as hub:
        cell = open_bus(hub.address())
        with raw_client(hub) as hostile:
            flood = Flood(hostile, FRAME)
            flood.start()
            until_still(lambda: flood.sent)
            waits = hub.cells["can0"]._transport.get_write_buffer_size()
            # The last chunk that was read is passed on whole.
            assert THROTTLE_BYTES < waits < THROTTLE_BYTES + (1 << 20)
        flood.join()
        cell.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("line", [b"< send 12345 8 01 >", b"< echo >", b"< nonsense >", b"<>"])
def test_a_deaf_client_that_is_answered_holds_up_nobody_and_fills_no_output(
    line: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """Thousands of lines "socket.send() raised exception" came from asyncio,
    one for each answer to a closed client.
    """
    with caplog.at_level(logging.WARNING), Hub(("can0",)) as hub:
        ends = [open_bus(hub.address()) for _ in range(2)]
        with raw_client(hub) as deaf:
            flood = Flood(deaf, line)
            flood.start()
            until_still(lambda: flood.sent)
            for number in (1, 2, 3):
                ends[1].send(frame(number))
                message = ends[0].recv(WAIT_S)
                assert message is not None
                assert message.arbitration_id == number
        flood.join()
        for end in ends:
            end.shutdown()
    assert caplog.messages == []


@pytest.mark.slow
def test_a_deaf_client_is_disconnected_and_the_others_hear_everything(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING), Hub(("can0",)) as hub:
        cell = open_bus(hub.address())
        with raw_client(hub), raw_client(hub) as reading:
            count = 2 * BACKLOG_BYTES // 40
            heard = []

            def read() -> None:
                frames = 0
                with suppress(OSError):
                    while frames < count:
                        timeout = 1 << 16
                        frames += reading.recv(timeout).count(b">")
                heard.append(frames)

            reader = threading.Thread(target=read)
            reader.start()
            for _ in range(count // LINES + 1):
                for _ in range(LINES):
                    cell.send(frame(0x181))
            reader.join()
            assert heard[0] >= count
            assert len(hub.clients) == 2
        cell.shutdown()
    assert caplog.messages == []


def test_another_client_becomes_the_cell_of_a_channel_when_the_first_has_gone() -> None:
    with Hub(("can0",)) as hub:
        open_bus(hub.address()).shutdown()
        end_s = time.monotonic() + WAIT_S
        while hub.cells and time.monotonic() < end_s:
            time.sleep(0.01)
        assert hub.cells == {}
        ends = [open_bus(hub.address()) for _ in range(2)]
        ends[0].send(frame(5))
        assert ends[1].recv(WAIT_S) is not None
        assert set(hub.cells.values()) < hub.clients
        for end in ends:
            end.shutdown()
