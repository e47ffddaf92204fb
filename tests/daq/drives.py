"""The demo cell with gains in its simulated drives, for tests of writing there."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import can

from daq.cli.apply import Applier, apply_to, drives_on_the_bus
from daq.config.cell import Bus, Cell
from daq.config.cell_buses import drive_axes
from daq.config.cell_file import load_cell
from daq.config.controller import Controller, GainObject
from daq.config.policy import HistoryPlace
from daq.documents.calibration_file import encode_calibration
from daq.simulation.simulation_file import load_simulation
from daq.writeback.request import Request
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.parameters import Saving
from drivers.canopen.sdo import SdoPolicy
from drivers.profiles.profile import Axis, Mapping, ParameterKind
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.faults import FaultSpec
from drivers.simulation.node import Node
from ident.calibration import Calibration
from tests.daq.calibrations import NAMEPLATE, demo_calibration

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
ACTOR = Applier("Kim", "kim")
CONFIGS = Path(__file__).parents[2] / "configs"
WHOLE = GainObject(index=0x2003, subindex=1, type=ParameterKind.I32, factor=1000.0)
REAL = GainObject(index=0x2003, subindex=2, type=ParameterKind.F32, factor=1.0)


def demo_cell(folder: Path, *objects: GainObject) -> Cell:
    """The demo cell with its records in a folder, and the gains in these objects,
    or in 2003h:01 of all drives.
    """
    path = CONFIGS / "cells" / "demo.yaml"
    cell = load_cell(path)
    controller = Controller(objects=objects or (WHOLE,) * len(cell.axes))
    store = folder / "demo.history.sqlite"
    audit = folder / "demo.audit.jsonl"
    history = HistoryPlace(store, audit)
    return replace(
        cell,
        controller=controller,
        history=history,
    )


def on_its_own_bus(folder: Path, channel: str) -> Cell:
    """That cell on a virtual bus of a test's own."""
    bus = Bus(name="the bus", interface="virtual", channel=channel)
    declared = demo_cell(folder)
    axes = tuple(replace(axis, bus=bus.name) for axis in declared.axes)
    return replace(declared, folder=folder, buses=(bus,), axes=axes)


@contextmanager
def simulated(
    address: BusAddress, *faults: FaultSpec, entered: tuple[float, ...] = NAMEPLATE
) -> Iterator[SimulatedCell]:
    """The demo cell, its drives with entered gains and faults."""
    path = CONFIGS / "simulation" / "clean.yaml"
    spec = load_simulation(path)
    axes = tuple(
        replace(axis, entered_gain_nm_per_a=gain)
        for axis, gain in zip(spec.axes, entered, strict=True)
    )
    bus: can.BusABC = open_bus(address)
    try:
        changed_spec = replace(spec, axes=axes, faults=faults)
        with SimulatedCell(changed_spec, bus) as cell:
            yield cell
    finally:
        bus.shutdown()


def network_of(
    cell: Cell, address: BusAddress, mapping: Mapping = Mapping.STORED
) -> CanopenNetwork:
    """To be entered; with short waits, and drives of which it is known that they save so."""
    axes = tuple(with_mapping(axis, mapping) for axis in drive_axes(cell))
    bounds = Bounds(answer_s=1.0, silence_s=0.3, listen_s=0.05)
    policy = SdoPolicy(0.3, 3)
    return CanopenNetwork(
        address,
        axes,
        bounds=bounds,
        policy=policy,
    )


def with_mapping(axis: Axis, mapping: Mapping) -> Axis:
    """An axis whose drive does that with mappings when it saves."""
    save = axis.profile.save
    assert save is not None
    changed_save = replace(save, mapping=mapping)
    profile = replace(axis.profile, save=changed_save)
    return replace(axis, profile=profile)


def entered_gain(node: Node, gain_object: GainObject = WHOLE) -> float:
    """Gain in a drive now [Nm/A]."""
    word = int.from_bytes(
        node.read(gain_object.parameter.index, gain_object.parameter.subindex), "little"
    )
    return gain_object.parameter.value(word) / gain_object.factor


def saved_gain(node: Node) -> float:
    """Gain in a drive after the next power-on [Nm/A]."""
    value = node.saved.values[0x2003, 1]
    assert isinstance(value, int)
    return value / 1000.0


class Listener:
    """Hears every frame on a virtual bus."""

    def __init__(self, address: BusAddress) -> None:
        self._bus = open_bus(address)

    def frames(self) -> list[can.Message]:
        """All since the last call."""
        heard = []
        while (message := self._bus.recv(0.0)) is not None:
            heard.append(message)
        return heard

    def downloads(self) -> list[tuple[int, int, int]]:
        """Node, index and subindex of every SDO write since the last call."""
        return [
            (frame.arbitration_id - 0x600, *struct.unpack_from("<HB", bytes(frame.data), 1))
            for frame in self.frames()
            if 0x600 < frame.arbitration_id < 0x680 and frame.data[0] >> 5 == 1
        ]

    def close(self) -> None:
        """Hear no more."""
        self._bus.shutdown()


def apply_in_drives(
    cell: Cell,
    *,
    calibration: Calibration | None = None,
    yes: bool = False,
    base: str | None = None,
    as_json: bool = False,
    saving: Saving = Saving.KNOWN,
) -> None:
    """As `drivegain apply --drives` does it, in Kim's name."""
    calibration = calibration or demo_calibration()
    assert cell.history is not None
    opening = drives_on_the_bus(cell, saving)
    request = Request(
        calibration,
        NOW,
        policy=cell.apply,
        accepts_changed_configuration=True,
        base=base,
        appliers=ACTOR.names,
        file=Path("calibration.yaml"),
        content=encode_calibration(calibration),
    )
    apply_to(
        opening,
        cell,
        request,
        actor=ACTOR,
        audit=cell.history.audit,
        undo="drivegain rollback --cell cells/demo.yaml --drives",
        yes=yes,
        json=as_json,
    )
