"""Simulated cell on one or several CAN buses:
n nodes and one plant that advance in lockstep with SYNC.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial

import can
import numpy as np

from drivers.canopen.bus import SocketcandBus, base_frame, is_plain, send_burst
from drivers.canopen.split_bus import SplitBus
from drivers.errors import BusError
from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import ERROR_FRAMES, FOREIGN_SDO, Disturbance, FaultKind, FaultSpec
from drivers.simulation.node import Node, Send
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec, SpecInvalid

SYNC_ID = 0x080

IDLE_S = 0.02  #: Longest wait for a frame [s]; it limits the punctuality of heartbeats by wall time

#: Plant time without a moving axis after which time that runs without SYNC stops again
LONE_REST_S = 0.1
#: Most cycles without SYNC between two looks at the bus: a busy machine goes on answering
LONE_CYCLES = 100

#: SYNCs of one bus that may wait for another bus: a busy machine delivers some of one bus first
PATIENCE = 3

#: Cycles to run now, each given by the buses whose nodes take part
Cycles = tuple[frozenset[int], ...]


POWERED = (
    PowerState.SWITCHED_ON,
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP_ACTIVE,
    PowerState.FAULT_REACTION_ACTIVE,
)

#: Return the cell with its present payload, or None if unchanged
Mounted = Callable[[], CellSpec | None]


class SyncGate:
    """Combines the SYNCs of several buses into cycles:
    a cycle begins when each bus has received one.

    A bus without SYNC is left out when too many of another bus wait, or when the cell closes the
    gate after `IDLE_S`. Its next SYNC is late: its nodes answer it, time does not advance, and
    later cycles include the bus again.
    """

    def __init__(self, buses: int) -> None:
        self._waiting = [0] * buses
        self._absent: frozenset[int] = frozenset()

    @property
    def open(self) -> bool:
        """Whether a cycle waits for the SYNC of a bus."""
        return any(self._waiting)

    def late(self, bus: int) -> bool:
        """Return whether a SYNC on this bus belongs to a cycle that was run without it."""
        if bus not in self._absent:
            return False
        self._absent -= {bus}
        return True

    def arrive(self, bus: int) -> Cycles:
        """Count a SYNC that is not late."""
        self._waiting[bus] += 1
        if self._waiting[bus] > PATIENCE:
            return self.close()
        return self._complete()

    def close(self) -> Cycles:
        """Stop waiting for the buses without SYNC."""
        self._absent |= {bus for bus, count in enumerate(self._waiting) if not count}
        return self._complete()

    def _complete(self) -> Cycles:
        present = frozenset(range(len(self._waiting))) - self._absent
        cycles = min((self._waiting[bus] for bus in present), default=0)
        for bus in present:
            self._waiting[bus] -= cycles
        return (present,) * cycles


@dataclass(slots=True)
class _LoneTime:
    """Time that runs without SYNC."""

    since_s: float  #: by the clock
    cycles: int = 0  #: run since then
    rested: int = 0  #: of those, the last ones in which no axis moved


class SimulatedCell:
    """Cell that answers on a bus until it is closed.

    Each SYNC (COB-ID 80h) advances the plant by one sync period and is answered with the transmit
    PDOs, so equal frames give equal answers. SDO, NMT and heartbeats need no SYNC. On several buses
    the plant advances when SYNC has come on all of them, and each node receives its own bus only.

    When the heartbeat that a node monitors (1016h) stays away, its master is gone and sends no SYNC
    either: the plant then advances by the clock until no axis moves any more, or a SYNC comes.

    As a context manager it answers in a thread of its own; ``serve_forever`` answers in the
    caller's thread.
    """

    def __init__(
        self,
        spec: CellSpec,
        bus: can.BusABC,
        clock: Callable[[], float] = time.monotonic,
        mounted: Mounted | None = None,
    ) -> None:
        """Build the cell; it is powered on when it begins to serve.

        Args:
            spec: description of the cell.
            bus: any python-can bus that does not receive its own messages, or a split bus; the
                caller shuts it down.
            clock: seconds, for heartbeats while no SYNC comes, and for the end of the motion of a
                master that is gone.
            mounted: exchanges the payload while no axis has power; called after each wait for a
                frame, so it must be fast, and another object is another payload. The loops keep
                their tuning, as those of real drives do.

        Raises:
            SpecInvalid: the description is wrong, or a node is on none of the buses.
        """
        ids = [axis.node_id for axis in spec.axes]
        self._spec = spec
        self._mounted = mounted
        #: its mechanics (read it when the cell is closed, or between answers)
        self.plant = Plant(spec)
        self.cycles = 0  #: SYNCs since power-on
        self._amplifiers = AmplifierSet(spec, self.plant)
        # Compile with numba on copies: the first SYNC must not wait for it.
        Plant(spec).step(np.zeros(len(ids)))
        AmplifierSet(spec, self.plant).control(self.plant.motor_rad)
        self._enabled = np.zeros(len(ids), dtype=np.int64)
        self._bus = bus
        self._clock = clock
        self._burst: list[can.Message] | None = None
        self._disturbance = Disturbance(spec.faults)
        nodes = []
        for index, axis in enumerate(spec.axes):
            send: Send = self._send
            if spec.faults:
                send = partial(self._send_of, index)
            nodes.append(Node(index, axis, self._amplifiers, send))
        self.nodes = tuple(nodes)
        self._wires, ids_of_wires = _wires(bus, ids)
        self._on_wire = tuple(self._nodes_of(wire_ids) for wire_ids in ids_of_wires)
        self._gate = SyncGate(len(self._wires))
        _refuse_error_frames(spec.faults, bus)
        for index, node in enumerate(self.nodes):
            for kind in FaultKind:
                if self._disturbance.active(kind, index):
                    node.inject(kind)
        self._lone: _LoneTime | None = None  # while time runs without SYNC
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None

    def __enter__(self) -> SimulatedCell:
        self._thread = threading.Thread(
            target=self._serve_in_thread, name="simulated cell", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        # If both sides failed, the caller's error is usually a consequence of the silent cell.
        if self._failure is not None:
            raise self._failure from error

    def check(self) -> None:
        """Raise the error that ended the cell's thread, if any."""
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """Make ``serve_forever`` return; may be called from any thread."""
        self._stopping.set()

    def serve_forever(self) -> None:
        """Power on and answer until ``stop`` is called.

        Raises:
            can.CanError, BusError: the bus, or every bus, has failed.
            FrictionUnsolved: the plant could not be advanced.
        """
        wall_s = self._clock()
        for node in self.nodes:
            node.boot(wall_s)
        while not self._stopping.is_set():
            message = self._next_frame()
            if message is not None and is_plain(message):
                self._receive(message)
            elif message is None and self._gate.open:
                for wires in self._gate.close():
                    self._advance(wires)
            looked_s = wall_s
            wall_s = self._clock()
            self._excuse_silence(wall_s - looked_s - IDLE_S)
            now_us = self.time_us
            for node in self.nodes:
                if node.keep_time(now_us, wall_s) and self._lone is None:
                    self._lone = _LoneTime(wall_s)
            self._run_alone(wall_s)
            if message is None and self._disturbance:
                self._interfere()  # other masters do not wait for our SYNC

    def _excuse_silence(self, held_up_s: float) -> None:
        """Leave out the time for which a busy machine has held up the cell."""
        if held_up_s > 0.0:
            for node in self.nodes:
                node.excuse_silence(held_up_s)

    def _nodes_of(self, ids: Collection[int]) -> tuple[Node, ...]:
        return tuple(node for node in self.nodes if node.node_id in ids)

    def _next_frame(self) -> can.Message | None:
        message = None
        try:
            message = self._bus.recv(IDLE_S)
        except BusError:
            if not self._goes_on():
                raise
        if self._mounted is not None and not self._is_powered():
            spec = self._mounted()
            if spec is not None and spec is not self._spec:
                self._spec = spec
                self.plant.mount(spec)
        return message

    def _is_powered(self) -> bool:
        return any(node.drive.state in POWERED for node in self.nodes)

    def _goes_on(self) -> bool:
        """Return whether another bus works after one has failed."""
        return isinstance(self._bus, SplitBus) and self._bus.alive

    @property
    def time_us(self) -> int:
        """Plant time since power-on [us]."""
        return self.cycles * self._spec.sync_period_us

    def _serve_in_thread(self) -> None:
        try:
            self.serve_forever()
        except Exception as error:  # noqa: BLE001 - raised again in the thread that owns the cell
            self._failure = error

    def _receive(self, message: can.Message) -> None:
        wire = 0
        if len(self._wires) > 1:
            wire = self._wires.index(str(message.channel))
        if message.arbitration_id == SYNC_ID:
            self._receive_sync(wire)
            return
        for node in self._on_wire[wire]:
            if not (self._disturbance and self._disturbance.cut_off(self.nodes.index(node))):
                node.receive(message.arbitration_id, bytes(message.data), self._clock)

    def _run_alone(self, wall_s: float) -> None:
        """Advance by wall time while the axes of a master that is gone come to rest;
        no node receives a SYNC.
        """
        lone = self._lone
        period_s = self._spec.sync_period_us * 1e-6
        for _ in range(LONE_CYCLES):
            # Another bus of this cell may still have its master, whose next SYNC ends this.
            if lone is None or lone.cycles * period_s > wall_s - lone.since_s - IDLE_S:
                return
            self._advance(())
            moving = any(node.drive.powered and node.drive.moving for node in self.nodes)
            lone.cycles = lone.cycles + 1
            lone.rested = lone.rested + 1
            if moving:
                lone.rested = 0
            if lone.rested * period_s >= LONE_REST_S:
                lone = self._lone = None

    def _receive_sync(self, wire: int) -> None:
        self._lone = None
        if self._gate.late(wire):
            for node in self._on_wire[wire]:
                node.begin_cycle()
                node.send_sync(self.time_us)
            return
        for wires in self._gate.arrive(wire):
            self._advance(wires)

    def _interfere(self) -> None:
        """Send the frames of other masters."""
        for index, node in enumerate(self.nodes):
            if self._disturbance.active(FaultKind.SDO_MASTER, index):
                self._send(0x600 + node.node_id, FOREIGN_SDO)
        if self._has(FaultKind.SECOND_MASTER) or self._has(FaultKind.SYNC_PRODUCER):
            self._send(SYNC_ID, b"")

    def _has(self, kind: FaultKind) -> bool:
        """Whether a fault is active on any axis."""
        return any(self._disturbance.active(kind, index) for index in range(len(self.nodes)))

    def _begin_faults(self) -> None:
        """Apply the faults that begin with this cycle, before the plant moves."""
        for index, node in enumerate(self.nodes):
            node.drive.limited = self._disturbance.active(FaultKind.LIMIT, index)
        for fault in self._disturbance.beginning():
            for index, node in enumerate(self.nodes):
                if fault.concerns(index):
                    node.strike(fault, self._clock())
            if fault.kind in ERROR_FRAMES:
                error_class, data = ERROR_FRAMES[fault.kind]
                error_frame = can.Message(
                    is_error_frame=True, arbitration_id=error_class, data=data
                )
                self._bus.send(error_frame)

    def _advance(self, wires: Collection[int]) -> None:
        """Run one cycle; the nodes on these buses received a SYNC."""
        plant = self.plant
        amplifiers = self._amplifiers
        synchronised: list[Node] = []
        for wire in sorted(wires):
            synchronised += self._on_wire[wire]
        for node in synchronised:
            node.begin_cycle()
        if self._disturbance:
            self._disturbance.cycle = self.cycles
            for frame in self._disturbance.release():
                self._send(*frame)
            self._begin_faults()
            self._interfere()
        loops = amplifiers.loops
        loops["limited"] = 0
        if (loops["enabled"] != self._enabled).any():
            self._enabled = loops["enabled"].copy()
            plant.set_brakes(self._enabled == 0)
        current_a = loops["current_a"]
        for _ in range(self._spec.substeps):
            plant.step(current_a)
            # The loops read the position at the end of the step: a reported current belongs to its
            # reported position.
            amplifiers.control(plant.motor_rad)
        self.cycles += 1
        amplifiers.report()
        for node in self.nodes:
            node.end_cycle()
        # The answers to a SYNC are one burst: on a hub one system call instead of one for each
        # frame.
        self._burst = []
        for node in synchronised:
            node.send_sync(self.time_us)
        burst = self._burst
        self._burst = None
        if burst:
            self._put(burst)

    def _send_of(self, index: int, can_id: int, data: bytes) -> None:
        for frame in self._disturbance.sent(index, self.nodes[index].node_id, can_id, data):
            self._send(*frame)

    def _send(self, can_id: int, data: bytes) -> None:
        message = base_frame(can_id, data)
        if self._burst is None:
            self._put((message,))
        else:
            self._burst.append(message)

    def _put(self, messages: Sequence[can.Message]) -> None:
        try:
            send_burst(self._bus, messages)
        except BusError:
            if not self._goes_on():
                raise


def _wires(
    bus: can.BusABC, node_ids: Sequence[int]
) -> tuple[tuple[str, ...], tuple[frozenset[int], ...]]:
    """Return the names of the buses, as in received frames, and the node ids on each."""
    if not isinstance(bus, SplitBus):
        return ("",), (frozenset(node_ids),)
    there = tuple(part.node_ids for part in bus.address.parts)
    alone = sorted(set(node_ids).difference(*there))
    if alone:
        raise SpecInvalid(
            f"node {', '.join(map(str, alone))} is on none of the buses {bus.address}"
        )
    return tuple(map(str, bus.address.parts)), there


def _refuse_error_frames(faults: Sequence[FaultSpec], bus: can.BusABC) -> None:
    """Refuse error frames that the bus cannot carry:
    they would end the cell in the middle of a run.
    """
    if isinstance(bus, SplitBus):
        hub = any(part.address.kind.has_server for part in bus.address.parts)
    else:
        hub = isinstance(bus, SocketcandBus)
    error_frame_faults = sorted(
        {fault.kind.value for fault in faults if fault.kind in ERROR_FRAMES}
    )
    if hub and error_frame_faults:
        raise SpecInvalid(
            f"the faults {', '.join(error_frame_faults)} are error frames, which the socketcand "
            "protocol does not have: leave them out (`silent` without an axis is bus-off without "
            "its error frame), or take another bus"
        )
