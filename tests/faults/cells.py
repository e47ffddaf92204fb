"""The demo cell with one fault in it, driven over a virtual bus in lockstep:
the reports, their time, and the end.
"""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import can

from daq.config.cell_buses import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import DriverError
from drivers.messages import CellEvent, EventKind
from drivers.motion.execute import execute
from drivers.move import AxisLimits, MotionPermission, synchronised_move
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultSpec
from drivers.simulation.node import Node
from drivers.simulation.spec import SdoAbort, ToggleBit
from drivers.stream.answers import StreamStatistics
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync

CONFIGS = Path(__file__).parents[2] / "configs"
PERIOD_NS = 1_000_000
ROOM = (AxisLimits(-20_000_000, 20_000_000, 900_000.0, 6_000_000.0),) * 6
TRAVEL_COUNTS = 150_000
STRIKE = 120
"""SYNCs since power-on: in the middle of the move,
which begins at about 25 and takes more than 300.
"""


Settings = tuple[tuple[tuple[bytes, ...], ...], ...]


@dataclass
class Outcome:
    """Outcome of a run.

    Attributes:
        error: that it raised, None when it ended well.
        events: in their order.
        statistics: of the stream; None when it never began.
        states: CiA 402 state of each axis at the end, read in the simulator.
        settings: of each node its 1016h:01, 1017h, 6007h, 6060h and the parameters of its PDOs,
            before and after.
        ended_cycle: SYNCs since power-on at the end.
        unguarded: what the network says of amplifiers that cannot watch it.
    """

    error: DriverError | None = None
    events: list[CellEvent] = field(default_factory=list)
    statistics: StreamStatistics | None = None
    states: tuple[PowerState, ...] = ()
    settings: tuple[Settings, Settings] = ((), ())
    ended_cycle: int = 0
    unguarded: tuple[str, ...] = ()

    @property
    def powerless(self) -> bool:
        """Whether no axis has power."""
        return not any(
            state
            in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.SWITCHED_ON)
            for state in self.states
        )

    @property
    def restored(self) -> bool:
        """Whether all nodes have the settings from before."""
        return self.restored_axes == tuple(range(len(self.states)))

    @property
    def restored_axes(self) -> tuple[int, ...]:
        """Nodes that have the settings from before."""
        return tuple(
            axis
            for axis, (one, other) in enumerate(zip(*self.settings, strict=True))
            if one == other
        )

    def cycles_of(self, kind: EventKind, axis: int | None = None) -> list[int]:
        """Cycles, counted as `FaultSpec.at_cycle` is, of the events of a kind."""
        return [
            event.time_ns // PERIOD_NS
            for event in self.events
            if event.kind is kind and (axis is None or event.axis == axis)
        ]


def settings_of(cell: SimulatedCell) -> Settings:
    """Settings of each node that a recording changes and must restore."""
    return tuple(_settings_of_node(node) for node in cell.nodes)


def _settings_of_node(node: Node) -> tuple[tuple[bytes, ...], ...]:
    received = [_pdo(node, 0x1400, number) for number in range(4)]
    sent = [_pdo(node, 0x1800, number) for number in range(4)]
    others = (
        _value(node, 0x1016, 1),
        _value(node, 0x1017, 0),
        _value(node, 0x6007, 0),
        _value(node, 0x6060, 0),
    )
    return (*received, *sent, others)


def _pdo(node: Node, base: int, number: int) -> tuple[bytes, ...]:
    mapped = node.read(base + 0x200 + number, 0)[0]
    used = [node.read(base + 0x200 + number, sub) for sub in range(mapped + 1)]
    return (node.read(base + number, 1), node.read(base + number, 2), *used)


def _value(node: Node, index: int, subindex: int) -> bytes:
    try:
        return node.read(index, subindex)
    except SdoAbort:
        return b""  # it was built without


def run(
    name: str,
    *faults: FaultSpec,
    guard_ms: int = 60_000,
    afterwards: int = 0,
    toggle_bit: ToggleBit | None = None,
) -> Outcome:
    """One move of all axes there and back in a cell with these faults.

    The driver's clock runs with the plant's time beside the wall's: a silence lasts as long in
    samples on a fast machine as on a slow one; and so does the amplifiers'.

    Args:
        name: of the virtual bus.
        faults: of the cell.
        guard_ms: silence of the recorder that the amplifiers bear.
        afterwards: SYNCs of another device when the recorder is gone, to let the plant's time pass.
        toggle_bit: of the amplifiers and of their profile.
    """
    address = BusAddress("virtual", f"faults {name}")
    outcome = Outcome()
    spec = load_simulation(CONFIGS / "simulation" / "clean.yaml")
    spec = replace(
        spec, faults=faults, axes=tuple(replace(axis, toggle_bit=toggle_bit) for axis in spec.axes)
    )
    axes = tuple(
        replace(axis, profile=replace(axis.profile, toggle_bit=toggle_bit))
        for axis in drive_axes(load_cell(CONFIGS / "cells" / "demo.yaml"))
    )
    bus: can.BusABC = open_bus(address)
    try:
        cell = SimulatedCell(spec, bus, lambda: time.monotonic() + cell.cycles * PERIOD_NS * 1e-9)
        outcome_before = settings_of(cell)
        with cell:
            network = CanopenNetwork(
                address,
                axes,
                guard_ms=guard_ms,
                bounds=Bounds(
                    answer_s=1.0, silence_s=0.3, listen_s=0.05, nmt_s=1.0, mode_s=1.0, disable_s=1.0
                ),
                policy=SdoPolicy(0.3, 3),
                clock=lambda: time.monotonic_ns() + cell.cycles * PERIOD_NS,
            )
            try:
                _drive(network, outcome)
            except DriverError as error:
                outcome.error = error
            let_pass(cell, address, afterwards)
        outcome.states = tuple(node.drive.state for node in cell.nodes)
        outcome.settings = (outcome_before, settings_of(cell))
        outcome.ended_cycle = cell.cycles
    finally:
        bus.shutdown()
    return outcome


def let_pass(cell: SimulatedCell, address: BusAddress, cycles: int) -> None:
    """Let a cell live on for so many SYNCs."""
    wanted = cell.cycles + cycles
    with open_bus(address) as bus:
        for _ in range(cycles):
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        while cell.cycles < wanted:
            cell.check()
            bus.recv(0.01)


def _drive(network: CanopenNetwork, outcome: Outcome) -> None:
    with network:
        network.prepare()
        outcome.unguarded = network.unguarded()
        stream = SyncStream(
            network, LockstepSync(PERIOD_NS, 1.0, clock=network.link.clock), outcome.events.append
        )
        try:
            first = next(stream)
            while first.missing:
                first = next(stream)
            network.check_feedback(first)
            start = first.position_counts
            there = synchronised_move(
                start, tuple(count + TRAVEL_COUNTS for count in start), ROOM, dwell_cycles=10
            )
            back = synchronised_move(there.target_counts, start, ROOM, dwell_cycles=10)
            with closing(
                execute(network, stream, (there, back), MotionPermission("the test", ROOM))
            ) as samples:
                for _ in samples:
                    pass
        finally:
            outcome.statistics = stream.statistics
