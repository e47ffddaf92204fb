"""Processes of a round, and the cell's objects by SDO, without any code of `drivers`.

A verb runs in a fork of this process, which has imported it: that saves four seconds of start-up a process, in a guest
whose one processor all processes share. From there on it is a process like any other.
"""

from __future__ import annotations

import gc
import importlib
import os
import select
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.cli.app import main
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.simulation.cell import SimulatedCell
from tests.vcan.run import INTERFACE

FRAME = struct.Struct("=IB3x8s")
SDO_REQUEST, SDO_ANSWER, SYNC = 0x600, 0x580, 0x080
ANSWER_S = 1.0
POLL_S = 0.01
USED = ("daq.cli.record", "daq.cli.scan", "daq.cli.simulate", "daq.report.bus_views", "daq.workflow.record")


def warm_up(simulation: Path) -> None:
    """Import what the verbs use, and build the cell once."""
    for name in USED:
        importlib.import_module(name)
    with open_bus(BusAddress("virtual", "warm-up")) as bus:
        SimulatedCell(load_simulation(simulation), bus)
    gc.freeze()


@dataclass
class Verb:
    """A verb of drivegain in a process of its own."""

    pid: int  #: of the process; also of its group
    words: Path  #: file with what it says
    code: int | None = None  #: exit code, minus the signal that ended it, None while it runs

    @classmethod
    def start(cls, words: Path, arguments: Sequence[str]) -> Verb:
        """Fork."""
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.setpgid(0, 0)
                with words.open("wb") as out:
                    os.dup2(out.fileno(), 1)
                    os.dup2(out.fileno(), 2)
                os.closerange(3, 64)
                code = main(arguments)
            except SystemExit as leaving:
                code = leaving.code if isinstance(leaving.code, int) else 1
            except Exception:
                traceback.print_exc()
                raise
            finally:
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
        return self.words.read_text(encoding="utf-8", errors="replace") if self.words.exists() else ""

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


def raw(filters: Sequence[tuple[int, int]] = ()) -> socket.socket:
    """An end of the bus that receives the base data frames of these identifiers and masks alone."""
    end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    packed = b"".join(struct.pack("=II", *one) for one in filters)
    end.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
    end.bind((INTERFACE,))
    return end


def frame(identifier: int, data: bytes = b"") -> bytes:
    """The bytes of a frame."""
    return FRAME.pack(identifier, len(data), data.ljust(8, b"\0"))


class Objects:
    """Object dictionaries of the nodes, read over a socket of its own; objects of at most four bytes."""

    def __init__(self) -> None:
        self._end = raw(((SDO_ANSWER, 0xC000_0780),))

    def close(self) -> None:
        """Close the socket."""
        self._end.close()

    def read(self, node: int, index: int, subindex: int) -> int | None:
        """Return an object; None where the node refuses it.

        Raises:
            TimeoutError: the node does not answer.
        """
        key = struct.pack("<HB", index, subindex)
        self._end.send(frame(SDO_REQUEST + node, b"\x40" + key + bytes(4)))
        deadline_s = time.monotonic() + ANSWER_S
        while (left_s := deadline_s - time.monotonic()) > 0 and select.select((self._end,), (), (), left_s)[0]:
            identifier, _, data = FRAME.unpack(self._end.recv(FRAME.size))
            if identifier == SDO_ANSWER + node and data[1:4] == key:
                return None if data[0] == 0x80 else int.from_bytes(data[4:8], "little")
        raise TimeoutError(f"node {node} does not answer to {index:04X}h:{subindex}")

    def settings(self, node: int) -> tuple[int | None, ...]:
        """Settings that a recording changes and must restore: parameters of the PDOs, 1016h, 1017h, 6007h, 6060h."""
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
            self._end.send(frame(SYNC))
            time.sleep(0.001)
