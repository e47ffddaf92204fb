"""A drive of another stack on the scripted bus:
`canopen.LocalNode` with the objects of a maker's data sheet.

The object dictionary, its access rights and the SDO server are canopen's. Only the sheet says which
objects and PDOs there are. RPDOs are applied object by object in the order of their mapping, and a
controlword acts at once, with the target that the drive has at that moment.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import can
import pytest
from canopen import LocalNode, Network
from canopen.objectdictionary import ODVariable

from daq.config.drive import drive_from_text
from daq.environment import shipped_configurations
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.setup import Profiles
from drivers.move import Move
from drivers.profiles.profile import Axis, DriveProfile
from tests.daq.config.data_sheet import data_sheet
from tests.drivers.scripted import ADDRESS, FakeClock, ScriptedBus, ScriptedNode

RATED_MA = 2000
_READ_ONLY = 0x06010002
MAKES = {  # shipped profile by data sheet
    "pilz_prbt_0_1.dcf": "schunk-pilz-prbt",
    "Schunk_0_63_cob.dcf": "schunk-pilz-prbt",
    "Elmo_cob.dcf": "elmo-gold",
    "ElmoSimplIQ_cob.dcf": "elmo-gold",
    "maxon_epos4.eds": "maxon-epos4",
}
MOVE = Move((3000, -2000), (100_000, 80_000), (1_000_000, 800_000))


def shipped(name: str) -> DriveProfile:
    """Return a shipped drive profile."""
    drives_folder = shipped_configurations() / "drives"
    path = drives_folder / f"{name}.yaml"
    return drive_from_text(path.read_bytes(), path.name)


class _Wire(Network):
    """Takes what the SDO server answers."""

    def __init__(self) -> None:
        super().__init__()
        self.answers: list[bytes] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.answers.append(bytes(data))


class ForeignNode(ScriptedNode):
    """One drive; `fixed` keeps its PDO mapping as the sheet has it."""

    def __init__(self, node_id: int, sheet: Path, *, fixed: bool = False) -> None:
        self.local = LocalNode(node_id, data_sheet(sheet.read_bytes(), sheet.name))
        self.local._write_callbacks.clear()  # the scripted bus sends the heartbeats
        self._wire = _Wire()
        self.local.associate_network(self._wire)
        self.fixed = fixed
        super().__init__(node_id)
        self.objects.clear()  # the objects are the sheet's
        for base, first in ((0x1400, 0x200), (0x1800, 0x180)):
            for number in self.numbers(base):
                self.store(base + number, 1, first + 0x100 * number + node_id)
        for key, value in (
            ((0x6075, 0), RATED_MA),
            ((0x1018, 1), 0x5A),
            ((0x1018, 2), 1),
            ((0x1018, 4), 7),
        ):
            if self.has(*key):
                self.store(*key, value)

    def numbers(self, base: int) -> list[int]:
        return [number for number in range(8) if base + number in self.local.object_dictionary]

    def has(self, index: int, sub: int) -> bool:
        variable = self.local.object_dictionary.get_variable(index, sub)
        return variable is not None

    def _variable(self, index: int, sub: int) -> ODVariable:
        variable = self.local.object_dictionary.get_variable(index, sub)
        assert variable is not None
        return variable

    def value(self, index: int, sub: int) -> int:
        if not self.has(index, sub):
            return 0
        variable = self._variable(index, sub)
        kept: dict[int, bytes] = self.local.data_store.get(index, {})
        if sub not in kept and not isinstance(variable.default, int):
            return 0
        data = self.local.get_data(index, sub)
        return int.from_bytes(data, "little")

    def store(self, index: int, sub: int, value: int) -> None:
        if self.has(index, sub):
            size = len(self._variable(index, sub)) // 8
            self.local.set_data(index, sub, (value & (1 << 8 * size) - 1).to_bytes(size, "little"))

    def sdo(self, data: bytes) -> bytes | None:
        command, index, sub = struct.unpack_from("<BHB", data)
        writes = command >> 5 == 1
        if self.fixed and writes and 0x1600 <= index & ~0x1FF <= 0x1A00 and index & 0x200:
            return struct.pack("<BHBL", 0x80, index, sub, _READ_ONLY)
        self._refresh()
        if (
            command >> 5 == 2
            and self.has(index, sub)
            and not isinstance(self._variable(index, sub).default, str)
        ):
            self.store(index, sub, self.value(index, sub))  # an object without a default is 0
        self._wire.answers.clear()
        self.local.sdo.on_request(0x600 + self.node_id, data, 0.0)
        if writes and self._wire.answers and self._wire.answers[0][0] != 0x80:
            self._written(index)
        return self._wire.answers[0] if self._wire.answers else None

    def _written(self, index: int) -> None:
        if index == 0x6060:
            self.store(0x6061, 0, self.value(0x6060, 0))
        elif index == 0x6040:
            self.control(self.value(0x6040, 0), 0)

    def control(self, word: int, cycle: int) -> None:
        super().control(word, cycle)
        if self.target >= 1 << 31:
            self.target = self.target - (1 << 32)

    def on_sync(self, cycle: int, counted: bool = False) -> list[can.Message]:
        if self.nmt != 5:
            return []
        answers = []
        for number in self.numbers(0x1800):
            cob = self.value(0x1800 + number, 1)
            kind = self.value(0x1800 + number, 2)
            if not cob >> 31 and kind == 1 and (mapped := self._mapped(0x1800, number)):
                self._refresh()
                data = b"".join(self.value(i, s).to_bytes(n, "little") for i, s, n in mapped)
                arbitration_id = cob & 0x7FF
                message = can.Message(
                    arbitration_id=arbitration_id, is_extended_id=False, data=data
                )
                answers.append(message)
        for number in self.numbers(0x1400):
            cob = self.value(0x1400 + number, 1)
            pdo = self._pending.pop(cob & 0x7FF, None)
            offset = 0
            for index, sub, size in (
                self._mapped(0x1400, number) if pdo is not None and not cob >> 31 else ()
            ):
                self.store(
                    index, sub, int.from_bytes((pdo or b"")[offset : offset + size], "little")
                )
                offset += size
                self._written(index)
        self._move()
        return answers


def foreign_cell(
    sheet: Path, profile: DriveProfile, axes: int = 2, profiles: Profiles = tuple, **how: Any
) -> tuple[CanopenNetwork, ScriptedBus]:
    """A network of so many drives of one data sheet, not yet entered,
    and the bus that it will open.
    """
    if not sheet.is_file():
        pytest.skip(f"no data sheet at {sheet}: set DRIVEGAIN_DATA to the folder that holds eds/")
    clock = FakeClock()
    nodes = tuple(ForeignNode(n + 1, sheet, **how) for n in range(axes))
    bus = ScriptedBus(nodes, clock)
    bounds = Bounds(0.1, 0.1, 0.1, 0.1)
    policy = SdoPolicy(0.02, 2)
    network = CanopenNetwork(
        ADDRESS,
        tuple(Axis(f"J{n + 1}", n + 1, profile) for n in range(axes)),
        heartbeat_ms=20,
        bounds=bounds,
        policy=policy,
        clock=clock,
        opener=lambda address: bus,
        profiles=profiles,
    )
    return network, bus
