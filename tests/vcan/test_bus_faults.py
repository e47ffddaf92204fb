"""Bus-off, error passive and an interface that goes down, on the kernel's CAN while the axes move.

The amplifiers are on vcan1, the recorder on vcan0, and a wire between them that can be cut: what
breaks the recorder's end must not break the amplifiers', which have to stop by themselves.
"""

from __future__ import annotations

import errno
import fcntl
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.errors import ExitCode
from daq.log.metadata import reports_only_losses
from daq.log.reader import Log, read_log
from drivers.messages import EventKind
from drivers.profiles.cia402 import State, decode
from tests.faults.test_scenario import PLAN
from tests.vcan.cells import simulated, write_cell, write_simulation
from tests.vcan.run import INTERFACE, SECOND_INTERFACE

PERIOD_US = 40_000
"""Two capture processes, the recorder, the cell and the wire between them share the one processor
of the guest.
"""
STRIKE = 20
"""SYNCs after the first set-point; the move takes some fifty."""
PATIENCE_S = 120.0
NODES = range(1, 7)
SYNC = 0x080
RPDO = 0x200
SDO_REQUEST = 0x600
SDO_ANSWER = 0x580
NEW_SETPOINT = 0x10
# linux/can.h, linux/can/error.h
CAN_ERR_FLAG, CAN_ERR_CRTL, CAN_ERR_BUSOFF = 0x2000_0000, 0x004, 0x040
PASSIVE = 0x30  # CAN_ERR_CRTL_RX_PASSIVE | CAN_ERR_CRTL_TX_PASSIVE, in the second byte
IFF_UP, SIOCGIFFLAGS, SIOCSIFFLAGS = 0x1, 0x8913, 0x8914  # linux/if.h, linux/sockios.h
_FLAGS = struct.Struct("16sh14x")
_FRAME = struct.Struct("=IB3x8s")

pytestmark = pytest.mark.skipif(
    not (Path("/sys/class/net") / SECOND_INTERFACE).exists(),
    reason=f"no {SECOND_INTERFACE} in this kernel; `make test-vcan` brings one",
)


def raw(interface: str) -> socket.socket:
    """An end of a bus that sees plain frames alone."""
    end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    end.bind((interface,))
    return end


def frame(identifier: int, data: bytes = b"") -> bytes:
    return _FRAME.pack(identifier, len(data), data.ljust(8, b"\0"))


@dataclass
class Wire:
    """Between vcan0 and vcan1, in a thread of its own.

    Attributes:
        strike: what happens in the middle of the first move; it may cut the wire.
        cut: nothing passes any more.
        struck_ns: when that was [ns since 1970].
    """

    strike: Callable[[Wire], None]
    cut: bool = False
    struck_ns: int = 0
    _ended: threading.Event = field(default_factory=threading.Event)

    def run(self, near: socket.socket, far: socket.socket) -> None:
        """Until `end`."""
        syncs = -1
        while not self._ended.is_set():
            for end in select.select((near, far), (), (), 0.05)[0]:
                try:
                    passed = end.recv(_FRAME.size)
                    if not self.cut:
                        (far if end is near else near).send(passed)
                except OSError as error:
                    if error.errno != errno.ENETDOWN:
                        raise
                    continue
                identifier, _, data = _FRAME.unpack(passed)
                if (
                    end is near
                    and syncs < 0
                    and identifier & 0x780 == RPDO
                    and data[0] & NEW_SETPOINT
                ):
                    syncs = 0
                elif end is near and syncs >= 0 and identifier == SYNC:
                    syncs += 1
                    if syncs == STRIKE:
                        self.struck_ns = time.time_ns()
                        self.strike(self)

    def end(self) -> None:
        self._ended.set()


@dataclass(frozen=True)
class Ended:
    """Outcome of a recording.

    Attributes:
        code, output: exit code and what it said on stderr.
        log: whole, or what was salvaged of it.
        after_cycles: samples in the log from after the strike.
        states: of the axes, once they came to rest without any recorder; and 50 SYNCs later.
    """

    code: int
    output: str
    log: Log
    after_cycles: int
    states: tuple[list[State], list[State]]


def record(folder: Path, strike: Callable[[Wire], None]) -> Ended:
    """One recording, struck in the middle of its first move."""
    cell = write_cell(folder, PERIOD_US, "timed")
    simulation = write_simulation(folder, PERIOD_US)
    plan = folder / "plan.yaml"
    out = folder / "run.mcap"
    plan.write_text(PLAN, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "daq",
        "record",
        str(cell),
        str(plan),
        "--out",
        str(out),
        "--enable-motion",
    ]
    command += ["--operator", "test", "--speed", "0.2"]
    wire = Wire(strike)
    with (
        simulated(simulation, buses={SECOND_INTERFACE: NODES}),
        raw(INTERFACE) as near,
        raw(SECOND_INTERFACE) as far,
    ):
        thread = threading.Thread(target=wire.run, args=(near, far), name="wire")
        thread.start()
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=PATIENCE_S, check=False
            )
        finally:
            wire.end()
            thread.join()
        with raw(SECOND_INTERFACE) as end:
            states = (at_rest(end), states_after(end, 50))
    if not out.exists():
        assert main(["salvage", f"{out}.part", "--out", str(folder / "saved.mcap")]) == ExitCode.OK
        out = folder / "saved.mcap"
    log = read_log(out)
    return Ended(
        done.returncode, done.stderr, log, int((log.samples.time_ns > wire.struck_ns).sum()), states
    )


def at_rest(end: socket.socket) -> list[State]:
    """States of the axes when none has power any more;
    SYNC lets their time pass, and no command reaches them.
    """
    deadline = time.monotonic() + PATIENCE_S / 4
    while True:
        states = states_after(end, 10)
        if set(states) == {State.SWITCH_ON_DISABLED} or time.monotonic() > deadline:
            return states


def states_after(end: socket.socket, syncs: int) -> list[State]:
    """States of the axes by SDO, after so many SYNCs of ours."""
    for _ in range(syncs):
        end.send(frame(SYNC))
    return [decode(upload(end, node, 0x6041)) for node in NODES]


def upload(end: socket.socket, node: int, index: int) -> int:
    """One object of at most four bytes."""
    end.send(frame(SDO_REQUEST + node, struct.pack("<BHB4x", 0x40, index, 0)))
    while select.select((end,), (), (), PATIENCE_S / 4)[0]:
        identifier, _, data = _FRAME.unpack(end.recv(_FRAME.size))
        if identifier == SDO_ANSWER + node and data[1:3] == struct.pack("<H", index):
            return int.from_bytes(data[4:6], "little")
    raise RuntimeError(f"node {node} does not answer")


def error_frame(error_class: int, data: bytes) -> None:
    """From a raw socket, as the driver of a controller sends them to the ends that listen."""
    with raw(INTERFACE) as end:
        end.send(frame(CAN_ERR_FLAG | error_class, data))


def bus_off(wire: Wire) -> None:
    """The recorder's controller leaves the bus."""
    wire.cut = True
    error_frame(CAN_ERR_BUSOFF, bytes(8))


def error_passive(_wire: Wire) -> None:
    """The recorder's controller counts too many errors; its frames still pass."""
    error_frame(CAN_ERR_CRTL, bytes((0, PASSIVE, 0, 0, 0, 0, 0, 0)))


def goes_down(wire: Wire) -> None:
    """Take the recorder's interface down."""
    set_link(up=False)
    wire.cut = True


def set_link(*, up: bool) -> None:
    """As `ip link set vcan0 up` and `down`, without the time that a process takes to start."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        flags = _FLAGS.unpack(
            fcntl.ioctl(any_socket, SIOCGIFFLAGS, _FLAGS.pack(INTERFACE.encode(), 0))
        )[1]
        wanted = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, _FLAGS.pack(INTERFACE.encode(), wanted))


@pytest.fixture
def link() -> Iterator[None]:
    """It is up again afterwards."""
    yield
    set_link(up=True)


@pytest.mark.parametrize(
    ("strike", "words"),
    [(bus_off, "bus-off"), (goes_down, "interface is down")],
    ids=["bus-off", "interface down"],
)
@pytest.mark.usefixtures("link")
def test_the_recorder_says_so_and_the_axes_stop_by_themselves(
    tmp_path: Path, strike: Callable[[Wire], None], words: str, figure: Callable[[str], None]
) -> None:
    ended = record(tmp_path, strike)
    assert ended.code == ExitCode.DEVICE_FAULT, ended.output
    assert words in ended.output
    assert "NOT CONFIRMED WITHOUT POWER" in ended.output  # they could not be reached
    assert [
        event.text
        for event in ended.log.events
        if event.kind is EventKind.BUS_LOST and words in event.text
    ]
    kinds = [event.kind for event in ended.log.events]
    assert EventKind.STOP_UNCONFIRMED in kinds
    assert EventKind.MOVE_END not in kinds
    assert ended.states == ([State.SWITCH_ON_DISABLED] * len(NODES),) * 2
    figure(
        f"{words}: reported {ended.after_cycles} cycles after it happened; the axes stopped by "
        "their own 1016h"
    )


def test_error_passive_is_reported_and_the_run_goes_on(
    tmp_path: Path, figure: Callable[[str], None]
) -> None:
    ended = record(tmp_path, error_passive)
    # The run goes on to its end; a frame that was lost on the way makes it unfit, and nothing else
    # may.
    counted = ended.log.statistics
    assert ended.code == (ExitCode.OK if counted.valid else ExitCode.DATA_UNFIT), ended.output
    assert counted.valid or reports_only_losses(counted.reason), counted.reason
    reported = [event for event in ended.log.events if event.kind is EventKind.BUS_PASSIVE]
    assert len(reported) == 1
    assert "error passive" in reported[0].text
    assert [event.kind for event in ended.log.events].count(EventKind.MOVE_END) == 2
    assert ended.states == ([State.SWITCH_ON_DISABLED] * len(NODES),) * 2
    figure(f"error passive: in the log, run {'valid' if ended.log.statistics.valid else 'invalid'}")
