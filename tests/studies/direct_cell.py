"""Runs of a simulated cell without a bus:
the same plant, loops, nodes and moves, and no frames back and forth.

The coverage study needs hundreds of runs, and most of a recorded run's time is frames and threads.
What moves the cell is unchanged: `drivers.motion.execute.execute` walks the moves of
`daq.workflow.record.motor_moves` through the nodes' own CiA 402 state machines, and the amplifiers
round and add noise as they do on the bus. `tests.studies.coverage_runs --check` compares it with a
recording over the bus, count by count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import can
import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.config.cell_buses import drive_axes
from daq.log.conversion import SiScaling, moves, scaling
from daq.log.metadata import AxisReadback, Readback
from daq.workflow.plan import Plan
from daq.workflow.record import motor_limits, motor_moves
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.pdo import SETPOINT_PDOS, Direction, records, wanted_pdos, write_pdo_record
from drivers.canopen.sdo import ObjectAccess
from drivers.canopen.setup import MODE_OF_OPERATION, PROFILE_POSITION_MODE
from drivers.messages import CellEvent, EventKind, EventSink, Sample
from drivers.motion.execute import execute
from drivers.move import MotionPermission
from drivers.profiles.profile import ObjectEntry
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.node import NmtCommand, Node
from drivers.simulation.spec import CellSpec
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from ident.data.run import Run
from ident.model.bodies import Payload

MOVING = ("drivers.simulation", "drivers.motion")
"""What moves a simulated cell: kept runs outlive a change of anything else,
as of what reads the samples.
"""


@dataclass(frozen=True, slots=True, eq=False)
class RawRun:
    """The samples of one run as the amplifiers report them.

    Attributes:
        name: of the run.
        payload: what was mounted, as declared.
        position_counts: int32, shape (k, n).
        demand_counts: what the position loops were to follow (6062h), int32, shape (k, n).
        current_raw: per mille of rated current, int16, shape (k, n).
        limited: whether a limit acted (6041h, bit of the drive profile), shape (k, n).
        move: number of the move, shape (k,).
        ampere_per_unit: of the raw current, as the drives' own objects say, shape (n,).
        began_s: how long the cell had been on when the run began.
    """

    name: str
    payload: Payload | None
    position_counts: NDArray[np.int32]
    demand_counts: NDArray[np.int32]
    current_raw: NDArray[np.int16]
    limited: NDArray[np.bool_]
    move: NDArray[np.int64]
    ampere_per_unit: NDArray[np.float64]
    began_s: float = 0.0


def simulate_run(
    cell: Cell, spec: CellSpec, plan: Plan, name: str, payload: Payload | None, began_s: float = 0.0
) -> RawRun:
    """Make a plan's moves on a simulated cell.

    Args:
        cell: as declared: limits and drive train of the moves.
        spec: its truth, with the mounted body and the seed of its noise.
        plan: the moves.
        name: of the run.
        payload: what is mounted, as declared; None without load.
        began_s: how long the cell has been on, which is when what depends on time began.

    Raises:
        DriverError: the moves leave the limits, or an axis did not follow.
        FrictionUnsolved, SpecInvalid: from the simulated cell.
    """
    stream = DirectStream(cell, spec, began_s)
    scale = _scaling(cell, stream.ampere_per_unit)
    first = next(stream)  # as a recording does: it reads the positions before its log begins
    limits = motor_limits(cell, scale)
    permission = MotionPermission("a simulated cell", limits)
    planned = motor_moves(cell, plan, scale, first.position_counts)
    samples = [next(stream)]
    # The walk asks of network and stream what DirectStream has, and no more.
    with closing(execute(stream.network, cast(SyncStream, stream), planned, permission)) as walk:
        samples += walk
    time_ns = np.array([sample.time_ns for sample in samples], dtype=np.int64)
    events = tuple(stream.events)
    move = moves(events, time_ns)
    if move is None:
        raise ValueError(f"run {name}: the plan has no moves")
    statuswords = [sample.statusword for sample in samples]
    status = np.array(statuswords, dtype=np.uint16)
    bits = [None if axis.profile is None else axis.profile.saturation_bit for axis in cell.axes]
    masks = np.array([0 if bit is None else 1 << bit for bit in bits], dtype=np.uint16)
    demand_counts = np.array(stream.demand_counts[-len(samples) :], dtype=np.int32)
    position_counts = np.array([sample.position_counts for sample in samples], dtype=np.int32)
    current_raw = np.array([sample.current_raw for sample in samples], dtype=np.int16)
    ampere_per_unit = np.array(stream.ampere_per_unit)
    return RawRun(
        name=name,
        payload=payload,
        position_counts=position_counts,
        demand_counts=demand_counts,
        current_raw=current_raw,
        limited=(status & masks) != 0,
        move=move,
        ampere_per_unit=ampere_per_unit,
        began_s=began_s,
    )


def run_of(raw: RawRun, cell: Cell) -> Run:
    """A raw run in SI units, as `daq.log.conversion` makes it of a log."""
    if cell.sync is None:
        raise ValueError(f"cell {cell.name}: no sync period")
    scale = _scaling(cell, raw.ampere_per_unit)
    time_s = np.arange(len(raw.move), dtype=np.float64) / (1e6 / cell.sync.period_us)
    counts = raw.position_counts.astype(np.int64)
    position_rad = scale.joint_position(counts)
    current_a = raw.current_raw * scale.current_per_unit
    valid = ~raw.limited
    return Run(
        name=raw.name,
        time_s=time_s,
        position_rad=position_rad,
        current_a=current_a,
        payload=raw.payload,
        move=raw.move,
        valid=valid,
        started_s=raw.began_s,
    )


def demand_rad(raw: RawRun, cell: Cell) -> NDArray[np.float64]:
    """Position demand of the joints [rad], shape (k, n):
    the trajectory that the position loops were to follow.
    """
    return _scaling(cell, raw.ampere_per_unit).joint_position(raw.demand_counts.astype(np.int64))


def _scaling(cell: Cell, ampere_per_unit: Iterable[float]) -> SiScaling:
    answers = (
        AxisReadback(name, float(scale))
        for name, scale in zip(cell.axis_names, ampere_per_unit, strict=True)
    )
    readback = Readback(tuple(answers))
    return scaling(cell, readback)


class DirectStream:
    """A stream of samples of a simulated cell that is called instead of being sent frames.

    It has what `drivers.motion.execute.execute` uses of a `SyncStream` and of its network.

    Attributes:
        network: what the walk asks of a network: its nodes and the names of its axes.
        pacing: of the samples' time.
        silent: never, a node always answers.
        emit: receives its events, as the walk may replace it; they go to `events`.
        events: in their order.
        time_ns: of the last sample.
        demand_counts: position demand of each sample, with the samples.
        ampere_per_unit: of the raw current, from the drives' own scale objects.
    """

    def __init__(self, cell: Cell, spec: CellSpec, began_s: float = 0.0) -> None:
        if cell.sync is None or cell.sync.period_us != spec.sync_period_us:
            raise ValueError(
                f"cell {cell.name}: its sync period is not the simulated one, "
                f"{spec.sync_period_us} us"
            )
        period_ns = spec.sync_period_us * 1000
        self.pacing = LockstepSync(period_ns)
        self.bus = self
        self.silent = False
        self.events: list[CellEvent] = []
        self.emit: EventSink = self.events.append
        self.time_ns = 0
        self.demand_counts: list[tuple[int, ...]] = []
        self._cycle = 0
        # Its nodes answer on a bus without readers.
        simple_namespace = SimpleNamespace(send=lambda _message: None)
        bus = cast(can.BusABC, simple_namespace)
        self._cell = SimulatedCell(spec, bus)
        self._cell.plant.time_s = began_s
        self.outgoing: list[can.Message] = []
        axes = drive_axes(cell)
        # No bus between this recorder and its amplifiers can fail: they need not be guarded.
        node_ids = tuple(axis.node_id for axis in axes)
        pdos = tuple(map(wanted_pdos, axes))
        self.network = cast(
            CanopenNetwork,
            SimpleNamespace(
                axes=axes,
                node_ids=node_ids,
                pdos=pdos,
                powered=set(),
                begin_stop=lambda nodes: None,
                begin_closing=lambda: None,
                end_closing=lambda: None,
                guard=lambda: None,
                unguard=lambda: None,
                block_signals=nullcontext,
                find_silent=lambda _axes: None,
            ),
        )
        accesses = [_DirectAccess(node) for node in self._cell.nodes]
        for access in accesses:
            access.prepare()
        self.ampere_per_unit = tuple(
            axis.profile.current_scale.factor
            * math.prod(map(access.read, axis.profile.current_scale.objects))
            for axis, access in zip(axes, accesses, strict=True)
        )

    def __next__(self) -> Sample:
        return self.advance()

    def check(self) -> None:
        """No fault waits: a drive that leaves OPERATION ENABLED is seen in its statusword."""

    def read_on(self, seconds: float, lag_s: float = 0.0) -> None:
        """Nothing comes behind the last cycle."""

    def report(self, axis: int | None, kind: EventKind, code: int, text: str) -> None:
        """Keep an event of the walk's."""
        cell_event = CellEvent(self.time_ns, axis, kind, code, text)
        self.emit(cell_event)

    def advance(self) -> Sample:
        """One SYNC period, in the order of drivers.simulation.cell.SimulatedCell."""
        outgoing = self.outgoing
        self.outgoing = []
        nodes = self._cell.nodes
        for message in outgoing:
            for node in nodes:
                node.receive_pdo(message.arbitration_id, bytes(message.data))
        for node in nodes:
            node.begin_cycle()
        self._cell._advance(())
        readings = self._cell._amplifiers.readings
        self.time_ns = self._cycle * self.pacing.period_ns
        self.demand_counts.append(tuple(readings.demand))
        statuswords = tuple(node.drive.statusword() for node in nodes)
        position_counts = tuple(readings.position)
        current_raw = tuple(readings.current_demand)
        sample = Sample(
            self._cycle,
            self.time_ns,
            position_counts,
            current_raw,
            statuswords,
        )
        self._cycle += 1
        return sample


@dataclass(frozen=True, slots=True)
class _DirectAccess:
    """The objects of one node, as drivers.sdo.ObjectAccess reads and writes them,
    without SDO frames.
    """

    node: Node

    @property
    def node_id(self) -> int:
        return self.node.node_id

    def read(self, entry: ObjectEntry) -> int:
        return int.from_bytes(
            self.node.read(entry.index, entry.subindex), "little", signed=entry.signed
        )

    def read_optional(self, entry: ObjectEntry) -> int | None:
        return self.read(entry)  # a simulated node has every object that is optional

    def write(self, entry: ObjectEntry, value: int) -> None:
        data = value.to_bytes(entry.bits // 8, "little", signed=entry.signed)
        self.node.write(entry.index, entry.subindex, data)

    def prepare(self) -> None:
        """Act as `CanopenNetwork.prepare` does on a node that has just been powered on:
        it needs no SYNC for that.
        """
        self.node.boot(0.0)
        for record in records(Direction.RPDO, self.node_id, SETPOINT_PDOS):
            write_pdo_record(cast(ObjectAccess, self), record)
        self.write(MODE_OF_OPERATION, PROFILE_POSITION_MODE)
        self.node.command_nmt(NmtCommand.START, 0.0)
