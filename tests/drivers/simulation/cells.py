"""Descriptions of simulated cells for the tests, and a plain master that speaks raw frames."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from daq.simulation.simulation_file import load_simulation
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec, UndeclaredEffect

FloatArray = NDArray[np.float64]

CLEAN = Path(__file__).parents[3] / "configs" / "simulation" / "clean.yaml"

STOPPED_CLOCK: Callable[[], float] = lambda: 0.0  # noqa: E731 - a clock that never runs, so heartbeats follow the plant


def clean_cell(payload: str | None = None, effects: tuple[UndeclaredEffect, ...] = ()) -> CellSpec:
    """The cell of configs/simulation/clean.yaml."""
    return replace(load_simulation(CLEAN, payload), effects=effects)


@dataclass
class Master:
    """Raw frames to and from a cell; nothing of the driver under test elsewhere is used.

    Attributes:
        bus: of the master.
        answers: TPDO frames of every SYNC, as (COB-ID, data), in the order of arrival.
        others: every other frame that came.
    """

    bus: can.BusABC
    answers: list[tuple[int, bytes]] = field(default_factory=list)
    others: list[tuple[int, bytes]] = field(default_factory=list)

    def send(self, can_id: int, data: bytes) -> None:
        """One frame."""
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self.bus.send(message)

    def receive(self) -> tuple[int, bytes]:
        """The next frame; a cell that falls silent fails the test."""
        message = self.bus.recv(30.0)
        assert message is not None, "the cell is silent"
        return message.arbitration_id, bytes(message.data)

    def sdo(self, node_id: int, request: bytes) -> bytes:
        """One SDO request and its answer."""
        self.send(0x600 + node_id, request.ljust(8, b"\0"))
        while True:
            can_id, data = self.receive()
            if can_id == 0x580 + node_id:
                return data
            self.others.append((can_id, data))

    def write(self, node_id: int, index: int, subindex: int, kind: str, value: int) -> int:
        """Expedited download; returns the abort code, or 0."""
        data = struct.pack("<" + kind, value)
        head = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, subindex)
        answer = self.sdo(node_id, head + data)
        return abort_code(answer)

    def read(self, node_id: int, index: int, subindex: int, kind: str) -> int:
        """Expedited upload of a number."""
        packed = struct.pack("<BHB", 0x40, index, subindex)
        answer = self.sdo(node_id, packed)
        assert abort_code(answer) == 0, f"{index:04X}h:{subindex:02X} {answer.hex()}"
        unpack = struct.unpack_from("<" + kind, answer, 4)
        return int(unpack[0])

    def set_up(self, node_ids: range) -> None:
        """Map position, current reference and statusword into TPDO1 and the controlword into RPDO1,
        both on SYNC.
        """
        for node_id in node_ids:
            steps = [(0x1017, 0, "H", 0), (0x6060, 0, "b", 1)]
            steps += [(0x1800, 1, "I", 0xC0000180 + node_id), (0x1A00, 0, "B", 0)]
            steps += [
                (0x1A00, k, "I", entry)
                for k, entry in enumerate((0x60640020, 0x60740010, 0x60410010), start=1)
            ]
            steps += [
                (0x1A00, 0, "B", 3),
                (0x1800, 2, "B", 1),
                (0x1800, 1, "I", 0x40000180 + node_id),
            ]
            steps += [
                (0x1400, 1, "I", 0x80000200 + node_id),
                (0x1400, 2, "B", 1),
                (0x1400, 1, "I", 0x200 + node_id),
            ]
            for step in steps:
                assert self.write(node_id, *step) == 0, step
        self.send(0x000, bytes([1, 0]))

    def sync(self, count: int = 6) -> list[tuple[int, int, int]]:
        """One SYNC; position, current reference and statusword of each axis."""
        self.send(0x080, b"")
        got: dict[int, tuple[int, int, int]] = {}
        while len(got) < count:
            can_id, data = self.receive()
            if 0x180 < can_id < 0x200:
                self.answers.append((can_id, data))
                got[can_id] = struct.unpack("<ihH", data)
            else:
                self.others.append((can_id, data))
        return [got[key] for key in sorted(got)]

    def enable(self, node_ids: range) -> None:
        """Shutdown, switch on, enable operation, all axes on the same SYNCs."""
        for controlword in (0x06, 0x07, 0x0F):
            self.control(node_ids, controlword)
            answer = self.sync(len(node_ids))
        for _, _, word in answer:
            assert word & 0x6F == 0x27, answer

    def control(self, node_ids: range, controlword: int) -> None:
        """Controlword of all nodes by RPDO; it acts on the next SYNC."""
        for node_id in node_ids:
            packed = struct.pack("<H", controlword)
            self.send(0x200 + node_id, packed)


def abort_code(answer: bytes) -> int:
    """0 where the answer is no abort."""
    if answer[0] == 0x80:
        unpack = struct.unpack_from("<I", answer, 4)
        return int(unpack[0])
    return 0


@contextmanager
def running(
    spec: CellSpec, channel: str, clock: Callable[[], float] = STOPPED_CLOCK
) -> Iterator[tuple[SimulatedCell, Master]]:
    """A cell in a thread and a master on one virtual bus;
    the master's bus is open before the cell boots.
    """
    with (
        can.Bus(interface="virtual", channel=channel) as near,
        can.Bus(interface="virtual", channel=channel) as far,
        SimulatedCell(spec, far, clock) as cell,
    ):
        yield cell, Master(near)
