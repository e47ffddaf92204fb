"""The capture process on the kernel's CAN: its stamps, what it counts, and how it ends."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from daq.log.conversion import load_run
from daq.log.reader import read_log
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.socketcan import CapturedMessage, SocketcanBus, open_socketcan
from drivers.errors import BusError
from tests.vcan.cells import record_once, say, simulated, write_cell, write_simulation
from tests.vcan.run import INTERFACE

FRAME = struct.Struct("=IB3x8s")
WAIT_S = 10.0
SPARE = "vcan9"
PERIOD_US = 20_000
HOLDER = """
import sys, time
from drivers.canopen.socketcan import open_socketcan
bus = open_socketcan(sys.argv[1])
print(bus.capture_pid, flush=True)
while True:
    bus.recv(1.0)
"""


@pytest.fixture
def wire() -> Iterator[socket.socket]:
    """Another program's socket on the bus."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as other:
        other.bind((INTERFACE,))
        yield other


@pytest.fixture
def bus() -> Iterator[SocketcanBus]:
    end = open_socketcan(INTERFACE)
    yield end
    end.shutdown()


@pytest.fixture
def spare() -> Iterator[str]:
    """An interface that may be set down."""
    if (
        subprocess.call(["ip", "link", "add", SPARE, "type", "vcan"], stderr=subprocess.DEVNULL)
        != 0
    ):
        pytest.skip("only root may add an interface")
    subprocess.check_call(["ip", "link", "set", SPARE, "up"])
    yield SPARE
    subprocess.call(["ip", "link", "delete", SPARE], stderr=subprocess.DEVNULL)


def received(bus: can.BusABC) -> CapturedMessage:
    message = bus.recv(WAIT_S)
    assert isinstance(message, CapturedMessage)
    return message


def is_there(process: int) -> bool:
    try:
        return (
            Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(") ")[2][0] != "Z"
        )
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_stamps_are_the_kernels_own_in_whole_nanoseconds(
    bus: SocketcanBus, wire: socket.socket
) -> None:
    begin_wall_ns = time.time_ns()
    begin_ns = time.monotonic_ns()
    for number in range(500):
        wire.send(FRAME.pack(0x181, 8, number.to_bytes(8, "little")))
    sent_wall_ns = time.time_ns()
    sent_ns = time.monotonic_ns()
    messages = [received(bus) for _ in range(500)]
    assert [int.from_bytes(message.data, "little") for message in messages] == list(range(500))
    for stamps, begin, sent in (
        ([message.kernel_ns for message in messages], begin_wall_ns, sent_wall_ns),
        ([message.monotonic_ns for message in messages], begin_ns, sent_ns),
    ):
        assert all(type(stamp) is int for stamp in stamps)
        assert stamps == sorted(stamps)
        # When the kernel got them, not when they were read; the clocks are compared to a fraction
        # of a millisecond.
        assert begin - 1_000_000 <= stamps[0]
        assert stamps[-1] <= sent + 1_000_000
    assert all(message.local and message.is_rx for message in messages)


def test_our_own_sync_comes_back_with_its_time_and_nothing_else_does(
    bus: SocketcanBus, wire: socket.socket
) -> None:
    bus.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=b"12"))
    bus.send(can.Message(arbitration_id=0x080, is_extended_id=False))
    wire.send(FRAME.pack(0x181, 0, bytes(8)))
    sync = received(bus)
    other = received(bus)
    assert (sync.arbitration_id, sync.is_rx) == (0x080, False)
    assert (other.arbitration_id, other.is_rx) == (0x181, True)
    assert sync.monotonic_ns <= other.monotonic_ns
    assert bus.recv(0.0) is None


def test_what_a_full_buffer_drops_is_counted_to_the_frame(wire: socket.socket) -> None:
    bus = open_socketcan(INTERFACE, receive_buffer_bytes=8192)
    try:
        os.kill(bus.capture_pid, signal.SIGSTOP)
        for _ in range(2000):
            wire.send(FRAME.pack(0x181, 0, bytes(8)))
        os.kill(bus.capture_pid, signal.SIGCONT)
        got = 0
        while got + sum(bus.losses) < 2000:  # no frame comes after them: the socket itself is asked
            message = bus.recv(WAIT_S)
            got += message is not None
            assert message is not None or sum(bus.losses) > 0
        assert 0 < bus.losses.kernel < 2000
        assert (got + bus.losses.kernel, bus.losses.backlog, bus.losses.interface) == (2000, 0, 0)
        wire.send(FRAME.pack(0x182, 0, bytes(8)))
        while received(bus).arbitration_id != 0x182:
            pytest.fail("more frames than were sent")
        assert got + sum(bus.losses) == 2000
    finally:
        os.kill(bus.capture_pid, signal.SIGCONT)
        bus.shutdown()


def test_the_capture_ends_with_a_parent_that_is_killed(figure: Callable[[str], None]) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, INTERFACE], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        capture = int(parent.stdout.readline())
        assert is_there(capture)
        parent.kill()
        parent.wait()
        begun = time.monotonic()
        while is_there(capture) and time.monotonic() < begun + WAIT_S:
            os.sched_yield()
        assert not is_there(capture)
        figure(
            f"capture process gone {1e3 * (time.monotonic() - begun):.0f} ms after its parent "
            "was killed"
        )


def test_an_interface_that_goes_down_is_named(spare: str, figure: Callable[[str], None]) -> None:
    bus = open_bus(BusAddress("socketcan", spare))
    try:
        subprocess.check_call(["ip", "link", "set", spare, "down"])
        begun = time.monotonic()
        with pytest.raises(can.CanOperationError, match=r"the interface is down \(ENETDOWN\)"):
            bus.recv(WAIT_S)
        figure(f"interface down: reported {1e3 * (time.monotonic() - begun):.0f} ms later")
    finally:
        bus.shutdown()
    with pytest.raises(BusError, match="the interface is down"):
        open_bus(BusAddress("socketcan", spare))


def test_an_interface_that_is_removed_is_named(spare: str) -> None:
    bus = open_bus(BusAddress("socketcan", spare))
    subprocess.check_call(["ip", "link", "delete", spare])
    with pytest.raises(can.CanOperationError, match=r"interface (is down|has gone)"):
        bus.recv(WAIT_S)
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    bus.shutdown()


def test_a_capture_that_is_killed_is_named(bus: SocketcanBus) -> None:
    os.kill(bus.capture_pid, signal.SIGKILL)
    with pytest.raises(can.CanOperationError, match=r"capture process ended by itself \(-9\)"):
        bus.recv(WAIT_S)


def test_bus_off_is_reported(wire: socket.socket) -> None:
    link = Link(BusAddress("socketcan", INTERFACE), SdoPolicy(), time.monotonic_ns)
    link.open()
    try:
        wire.send(FRAME.pack(0x2000_0000 | 0x40, 8, bytes(8)))
        with pytest.raises(BusError, match="bus-off"):
            link.pump(WAIT_S)
    finally:
        link.close()


def test_a_recording_that_follows_the_kernels_sync_loses_nothing(
    tmp_path: Path, attempts: range, figure: Callable[[str], None]
) -> None:
    cell = write_cell(tmp_path, PERIOD_US, "timed")
    simulation = write_simulation(tmp_path, PERIOD_US)
    text = cell.read_text(encoding="utf-8")
    cell.write_text(
        text.replace("pacing: timed\n", "pacing: timed\n  producer: kernel\n"), encoding="utf-8"
    )
    plan = tmp_path / "plan.yaml"
    how = ("--duration", "10", "--exchanges", "1", "--seed", "3", "--condition", "1e9")
    say("plan", str(cell), "--out", str(plan), *how)
    with simulated(simulation):
        for attempt in attempts:
            log = tmp_path / f"{attempt}.mcap"
            reported = record_once(cell, plan, log)
            if reported["valid"]:
                break
    assert reported["valid"], reported["reason"]
    assert (reported["lost_cycles"], reported["missing"]) == (0, [0] * 6)
    step_us = np.diff(read_log(log).samples.time_ns) * 1e-3
    spread = ", ".join(f"{np.percentile(step_us, share):.0f}" for share in (0, 1, 50, 99, 100))
    figure(
        f"SYNC by the kernel every {PERIOD_US} us, {len(step_us) + 1} samples, attempt {attempt}: "
        f"least, p1, p50, p99, most {spread} us"
    )
    assert abs(step_us.mean() / PERIOD_US - 1.0) < 0.001
    load_run(log)
