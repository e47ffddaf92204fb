"""Processes of a round, and the cell's objects by SDO, without any code of `drivers`.

A verb runs in a fork of this process, which has imported it: that saves four seconds of start-up a
process, in a guest whose one processor all processes share. From there on it is a process like any
other.
"""

from __future__ import annotations

import fcntl
import gc
import importlib
import mmap
import os
import signal
import struct
import sys
import termios
import time
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, bus_errors, open_bus
from drivers.errors import BusError
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.hub import Hub
from drivers.simulation.node import Node
from drivers.simulation.spec import SdoAbort
from tests.chaos.clock import StepClock
from tests.chaos.ends import ChaosBus
from tests.vcan.listener import HUB_CHANNEL
from tests.vcan.run import INTERFACE

SOCKETCAN = "socketcan"
SOCKETCAND = "socketcand"
READY = "ready"
BUS_LOST = 5  #: Exit code of a cell whose bus is gone
ABORT = 0x08000022  #: "because of the present device state"
SDO_REQUEST = 0x600
SDO_ANSWER = 0x580
SYNC = 0x080
ANSWER_S = 1.0
POLL_S = 0.01
USED = (
    "daq.cli.apply",
    "daq.cli.history",
    "daq.cli.record",
    "daq.cli.scan",
    "daq.report.bus_views",
    "daq.workflow.record",
)


def warm_up(simulation: Path) -> None:
    """Import what the verbs use, and build the cell once."""
    for name in USED:
        importlib.import_module(name)
    with open_bus(BusAddress("virtual", "warm-up")) as bus:
        SimulatedCell(load_simulation(simulation), bus)
    gc.freeze()


class Shared:
    """What the parent tells processes of a round while they run, in shared memory."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)

    @property
    def aborting(self) -> bool:
        """Whether the cell's SDO aborts are in force: they meet the recorder alone."""
        return self._memory[0] != 0

    @aborting.setter
    def aborting(self, value: bool) -> None:
        self._memory[0] = int(value)


def serve_hub(port_end: int) -> int:
    """Run a hub until the process is killed; its port is written into a pipe."""
    with Hub((HUB_CHANNEL,)) as hub, os.fdopen(port_end, "w", encoding="ascii") as pipe:
        pipe.write(f"{hub.address().port}\n")
        pipe.flush()
        while True:
            signal.pause()


@contextmanager
def hub_running() -> Iterator[ChaosBus]:
    """Give a bus of a hub in a process of its own."""
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(read_end)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is killed at the end
        serve_hub(write_end)
        os._exit(1)
    os.close(write_end)
    try:
        with os.fdopen(read_end, encoding="ascii") as pipe:
            yield ChaosBus(int(pipe.readline()), pid)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def serve_cell(
    truth: Path, bus: ChaosBus, aborts: Collection[tuple[int, int, int]], shared: Shared
) -> int:
    """Run the simulated cell until SIGINT;
    `aborts` has node, index and sub-index of what is refused by SDO.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    address = BusAddress(SOCKETCAN, INTERFACE)
    if bus.port is not None:
        address = BusAddress(SOCKETCAND, HUB_CHANNEL, port=bus.port)
    try:
        with (
            suppress(KeyboardInterrupt),
            open_bus(address, answering=True) as end,
            bus_errors(address),
        ):
            cell = SimulatedCell(load_simulation(truth), end)
            for node, index, subindex in aborts:
                _refuse(cell.nodes[node - 1], (index, subindex), shared)
            os.write(1, f"{READY}\n".encode())
            cell.serve_forever()
    except BusError as error:  # the interface is down
        os.write(1, f"{error}\n".encode())
        return BUS_LOST
    return 0


def _refuse(node: Node, key: tuple[int, int], shared: Shared) -> None:
    """Let a node abort each reading and writing of an object while aborts are in force."""
    server = node._sdo
    for name in ("_read", "_write"):
        sound = getattr(server, name)
        setattr(server, name, partial(_refused, sound, key, shared))


def _refused(
    sound: Callable[..., object],
    key: tuple[int, int],
    shared: Shared,
    index: int,
    subindex: int,
    *data: bytes,
) -> object:
    if shared.aborting and (index, subindex) == key:
        raise SdoAbort(ABORT)
    return sound(index, subindex, *data)


@dataclass
class Verb:
    """A verb of drivegain, or another part of a round, in a process of its own."""

    pid: int  #: of the process; also of its group
    words: Path  #: file with what it says
    code: int | None = None  #: exit code, minus the signal that ended it, None while it runs

    @classmethod
    def start(
        cls,
        words: Path,
        job: Callable[[], int],
        screen: int | None = None,
        clock: StepClock | None = None,
    ) -> Verb:
        """Fork.

        Args:
            words: file for what it says, unless it has a screen.
            job: its work; returns the exit code.
            screen: descriptor of its screen, a pipe or the end of a terminal.
            clock: its wall clock.
        """
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                if clock is not None:
                    clock.adopt()
                _begin(words, screen)
                code = job()
            except SystemExit as leaving:
                if isinstance(leaving.code, int):
                    code = leaving.code
                else:
                    code = 1
            except Exception:
                traceback.print_exc()
                raise
            finally:
                with suppress(OSError, ValueError):
                    sys.stdout.flush()
                os._exit(code)
        return cls(pid, words)

    @property
    def running(self) -> bool:
        """Whether it runs still."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is None

    @property
    def said(self) -> str:
        """What it said until now."""
        if self.words.exists():
            return self.words.read_text(encoding="utf-8", errors="replace")
        return ""

    def children(self) -> list[int]:
        """Process ids of its capture processes."""
        try:
            found = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text(encoding="ascii")
        except OSError:
            return []
        return [int(word) for word in found.split()]

    def wait(self, seconds: float) -> bool:
        """Whether it ended within so many seconds."""
        deadline_s = time.monotonic() + seconds
        while self.running and time.monotonic() < deadline_s:
            time.sleep(POLL_S)
        return not self.running

    def end(self, number: signal.Signals = signal.SIGKILL, patience_s: float = 20.0) -> int | None:
        """Send a signal and wait; kill it where that does not help. Returns the exit code."""
        for sent in (signal.SIGCONT, number, signal.SIGKILL):
            if self.running:
                os.kill(self.pid, sent)
            if sent is not signal.SIGCONT and self.wait(patience_s):
                break
        return self.code


def _begin(words: Path, screen: int | None) -> None:
    """Make a fork a process group or, at a terminal, a session;
    what it says goes to its screen or file.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # chaos itself handles it
    if screen is None:
        os.setpgid(0, 0)
        screen = os.open(words, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    elif os.isatty(screen):
        os.setsid()
        fcntl.ioctl(screen, termios.TIOCSCTTY, 0)
    else:
        os.setpgid(0, 0)
    os.dup2(screen, 1)
    os.dup2(screen, 2)
    os.closerange(3, 64)


class Objects:
    """Object dictionaries of the nodes, read over a socket of its own;
    objects of at most four bytes.
    """

    def __init__(self, bus: ChaosBus) -> None:
        self._end = bus.end(((SDO_ANSWER, 0x780),))

    def close(self) -> None:
        """Close the socket."""
        self._end.close()

    def read(self, node: int, index: int, subindex: int) -> int | None:
        """Return an object; None where the node refuses it.

        Raises:
            TimeoutError: the node does not answer.
        """
        key = struct.pack("<HB", index, subindex)
        self._end.drain()  # of answers to the recorder
        self._end.send(SDO_REQUEST + node, b"\x40" + key + bytes(4))
        deadline_s = time.monotonic() + ANSWER_S
        while (left_s := deadline_s - time.monotonic()) > 0:
            for identifier, data in self._end.hear(left_s):
                if identifier == SDO_ANSWER + node and data[1:4] == key:
                    if data[0] == 0x80:
                        return None
                    return int.from_bytes(data[4:8], "little")
        raise TimeoutError(f"node {node} does not answer to {index:04X}h:{subindex}")

    def settings(self, node: int) -> tuple[int | None, ...]:
        """Settings that a recording changes and must restore:
        parameters of the PDOs, 1016h, 1017h, 6007h, 6060h.
        """
        keys = [(0x1016, 1), (0x1017, 0), (0x6007, 0), (0x6060, 0)]
        for number in range(2):
            for base in (0x1400, 0x1800):
                keys += [(base + number, 1), (base + number, 2)]
            for base in (0x1600, 0x1A00):
                mapped = self.read(node, base + number, 0) or 0
                keys += [(base + number, sub) for sub in range(mapped + 1)]
        return tuple(self.read(node, *key) for key in keys)

    def syncs(self, number: int) -> None:
        """Let the cell's time pass."""
        for _ in range(number):
            self._end.send(SYNC)
            time.sleep(0.001)
