"""The one reader of a bus: sends, receives, and dispatches every frame that is no PDO.

There is no receiving thread. Code that waits (for an SDO answer, a heartbeat, the answers to a
SYNC) reads the bus while it waits. See docs/decisions/0002-stream-owns-the-bus.md.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import can

from drivers.canopen.bus import base_frame, bus_errors, send_burst
from drivers.canopen.emcy import describe_error_code
from drivers.canopen.sdo import (
    SDO_ANSWER,
    SDO_REQUEST,
    Clock,
    ObjectAccess,
    SdoPolicy,
    SynchronousSdoClient,
)
from drivers.canopen.socketcan import CapturedMessage, receive_only
from drivers.canopen.split_bus import BUS_OFF, BUS_OFF_REASON, CellAddress, open_cell_bus
from drivers.errors import BusBusy, BusError, StateRefused, node_label
from drivers.messages import CellEvent, EventKind

SYNC_COB_ID = 0x080
NMT_COB_ID = 0x000
EMCY = 0x080
HEARTBEAT = 0x700
#: Layer setting services (CiA 305): a device gets another node id or bit rate
LSS = frozenset((0x7E4, 0x7E5))
_COMMANDS = LSS | {NMT_COB_ID, SYNC_COB_ID}
#: Set-points of a drive (CiA 301, predefined connection set)
_RPDOS = frozenset((0x200, 0x300, 0x400, 0x500))
#: Command specifiers (upper three bits) of downloads: segment, begin, block
_WRITES = frozenset((0, 1, 6))
_LSS_NAME = "a layer setting service, which changes node ids"
_NAMES = {NMT_COB_ID: "an NMT command", SYNC_COB_ID: "a SYNC", **dict.fromkeys(LSS, _LSS_NAME)}
BOOTS_S = 0.5  #: Two boot-up messages in this time are those of two devices
BEATS_KEPT = 8  #: Heartbeats of each node by which a second device is found
BEATS_JUDGED, JUDGED_PERIODS = 4, 2.2
"""So many heartbeats of one device last three periods;
those of two that have one node id, two at most.
"""
BEATS_S = 3.0  #: Longest time to listen for the heartbeats of a second device
#: Periods in which two devices send `BEATS_JUDGED` heartbeats, and then at least one more
PERIODS_HEARD = 3.0
LISTEN_S = 0.2  #: Usual time to listen for other masters before the first frame is sent
PUMP_S = 0.1  #: Longest time spent on frames that have already arrived, however fast more arrive
# linux/can/error.h: classes of an error frame, and the controller's state in its second byte.
_CONTROLLER = 0x004
_RESTARTED = 0x100
_OVERFLOW = 0x03
_WARNING = 0x0C
_PASSIVE = 0x30
_ACTIVE = 0x40


class NmtState(IntEnum):
    """State in a heartbeat (CiA 301)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    def __str__(self) -> str:
        return self.name.replace("_", "-")


class NmtCommand(IntEnum):
    """Command of the NMT master (CiA 301)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128


@dataclass(frozen=True, slots=True)
class Beat:
    """A heartbeat of a node."""

    at_ns: int  #: when it was sent
    state: int  #: NMT state in it
    syncs: int  #: SYNCs of another producer until then


SdoListener = Callable[[bytearray], None]
"""Receives every SDO answer of one node; most are for others."""


def never() -> bool:
    """Return False: see `Link.given_up`."""
    return False


def nmt_name(state: int | None) -> str:
    """Return the name of an NMT state."""
    if state is None:
        return "nothing"
    if state in tuple(NmtState):
        return str(NmtState(state))
    return f"unknown ({state})"


def command_name(identifier: int, names: Mapping[int, str]) -> str:
    """Describe a frame that only the recorder should send; `names` of the axes are by node id."""
    shown = f"({identifier:03X}h)"
    node_id = identifier & 0x7F
    if identifier >= HEARTBEAT and identifier not in LSS:
        name = f"a heartbeat with the recorder's own node id {node_id}"
    elif identifier >= SDO_REQUEST and identifier not in LSS:
        name = f"an SDO request to {node_label(node_id, names)}"
    elif node_id in names:
        name = f"a set-point of {node_label(node_id, names)}"
    else:
        name = _NAMES.get(identifier, f"a frame with the recorder's own node id {node_id}")
    return f"{name} {shown}"


def _too_fast(beats: Sequence[Beat], period_ms: int) -> bool:
    """Whether heartbeats come so fast, more than once,
    that they are those of two devices with this period.
    """
    fast = 0
    for first, last in zip(beats, beats[BEATS_JUDGED - 1 :], strict=False):
        timed_by_clock = first.syncs == last.syncs
        lasting_ns = last.at_ns - first.at_ns
        fast += timed_by_clock and lasting_ns < JUDGED_PERIODS * 1e6 * period_ms
    return fast > 1


def _sent_ns(message: can.Message, now_ns: int) -> int:
    """Return the time of a frame by its own stamp where it has one, however late it is read;
    one clock for one bus.
    """
    if isinstance(message, CapturedMessage):
        return message.monotonic_ns
    return round(message.timestamp * 1e9) or now_ns


class Link:
    """An open bus and the last known state of its nodes.

    Methods that use the bus raise BusError when it is lost.
    """

    def __init__(
        self,
        address: CellAddress,
        policy: SdoPolicy,
        clock: Clock,
        opener: Callable[[CellAddress], can.BusABC] = open_cell_bus,
    ) -> None:
        self.address = address
        self.clock = clock
        self.policy = policy
        self.nmt: dict[int, int] = {}  #: Last NMT state of each node that sent a heartbeat
        self.heard_ns: dict[int, int] = {}  #: Time of that heartbeat by the clock
        #: Last error of each node that has reported one since the bus was opened, and not its end
        self.reported: dict[int, str] = {}
        self.answered: Counter[int] = Counter()  #: SDO answers of each node
        #: Boot-up messages of each node id right after another
        self.boots: Counter[int] = Counter()
        self.twice: dict[int, str] = {}  #: Node ids whose request was answered twice, and by what
        #: Client of the last SDO request to each node; none where it had none
        self.asked_by: dict[int, object] = {}
        self._beats: dict[int, deque[Beat]] = {}  # the last ones of each node
        self._foreign_syncs = 0  # since the bus was opened
        #: Nodes that did not answer their last request, and sent nothing since
        self.silent: set[int] = set()
        #: Node ids of which any frame arrived since the bus was opened
        self.heard: set[int] = set()
        #: Number of frames by identifier that only we should send (NMT, SYNC, LSS, SDO request,
        #: set-point of one of our axes, any frame with our own node id) and that we did not send.
        self.foreign: Counter[int] = Counter()
        #: Downloads to our axes that we did not send, by identifier
        self.written: dict[int, str] = {}
        self.own_id: int | None = None  #: Node id of our heartbeat, None before one was chosen
        self.names: Mapping[int, str] = {}  #: Of our axes by node id
        #: Time by the clock at which everything that waits must end [ns]; None while the network is
        #: not closed.
        self.deadline_ns: int | None = None
        #: Whether the operator wants what is left to be given up.
        self.given_up: Callable[[], bool] = never
        #: Device that sends SYNC on our behalf (drivers/stream/producers.py); None while only we
        #: send it.
        self.sync_producer: str | None = None
        self._beat: can.Message | None = None
        self._beat_period_ns = 0
        self._next_beat_ns = 0
        self._opener = opener
        self._bus: can.BusABC | None = None
        self._listeners: dict[int, list[SdoListener]] = {}
        self._access: dict[tuple[int, SdoPolicy], ObjectAccess] = {}
        self._events: deque[tuple[int, EventKind, int, str]] = deque()

    def open(self) -> None:
        """Open the bus."""
        self._bus = self._opener(self.address)

    def narrow(self) -> None:
        """Receive from now on only what concerns our axes, or is a command:
        a flood of others costs nothing.
        """
        services = (EMCY, *range(0x180, SDO_REQUEST, 0x80), HEARTBEAT)
        wanted: list[tuple[int, int]] = []
        for service in services:
            wanted += [(service + node_id, 0x7FF) for node_id in self.names]
        wanted += [(number, 0x7FF) for number in sorted(_COMMANDS)]
        wanted += [(SDO_REQUEST, 0x780), (self.own_id or NMT_COB_ID, 0x7F)]
        receive_only(self.bus, wanted)

    def close(self) -> None:
        """Close the bus if it is open."""
        bus = self._bus
        self._bus = None
        self._beat = None
        if bus is not None:
            with bus_errors(self.address):
                bus.shutdown()

    @property
    def bus(self) -> can.BusABC:
        """The open bus."""
        if self._bus is None:
            raise BusError(str(self.address), "is not open; use the network as a context manager")
        return self._bus

    def send(self, messages: Sequence[can.Message]) -> None:
        """Send frames in their order."""
        for message in messages:
            if SDO_REQUEST < message.arbitration_id < HEARTBEAT:
                self.asked_by.pop(message.arbitration_id - SDO_REQUEST, None)
        with bus_errors(self.address):
            send_burst(self.bus, messages)

    def pump(self, timeout_s: float) -> None:
        """Handle one frame, waiting at most ``timeout_s`` for it;
        with 0, all frames that have already arrived.
        """
        self.beat()
        with bus_errors(self.address):
            message = self.bus.recv(timeout_s)
            end_ns = self.clock() + round(PUMP_S * 1e9) if timeout_s == 0 else 0
            while message is not None:
                self.dispatch(message)
                message = self.bus.recv(0.0) if self.clock() < end_ns else None

    def allowed_s(self, seconds: float) -> float:
        """Return how long a step may wait that takes so many seconds:
        less, or not at all, while the network closes.
        """
        if self.deadline_ns is None:
            return seconds
        if self.given_up():
            return 0.0
        left_s = (self.deadline_ns - self.clock()) * 1e-9
        return min(seconds, max(0.0, left_s))

    def pass_time(self) -> None:
        """Send one SYNC and handle frames for 1 ms: a cell in lockstep advances by SYNC alone."""
        self.send((base_frame(SYNC_COB_ID),))
        self.wait(0.001)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Handle frames for a time, or until a condition holds; returns whether it does."""
        deadline = self.clock() + round(self.allowed_s(seconds) * 1e9)
        while not (done := until()) and (left_ns := deadline - self.clock()) > 0:
            self.pump(left_ns * 1e-9)
        return done

    def require_quiet(self, listen_s: float) -> None:
        """Listen for a while before the first frame is sent.

        Raises:
            BusBusy: another master commands this bus.
        """
        self.foreign.clear()
        self.written.clear()
        self.wait(listen_s)
        self.require_alone()

    def require_alone(self) -> None:
        """Check the frames that arrived since `require_quiet`.

        Raises:
            BusBusy: a command of another master was among them.
        """
        if self.foreign:
            seen = ", ".join(
                command_name(identifier, self.names) for identifier in sorted(self.foreign)
            )
            raise BusBusy.by_master(self.address, seen)

    def start_heartbeat(self, node_id: int, period_ms: int) -> None:
        """Send a heartbeat with this node id from now on, whenever the bus is read."""
        self._beat = base_frame(HEARTBEAT + node_id, bytes((NmtState.OPERATIONAL,)))
        self._beat_period_ns, self._next_beat_ns = period_ms * 1_000_000, self.clock()

    @property
    def sends_heartbeat(self) -> bool:
        """Whether the recorder's heartbeat is sent now."""
        return self._beat is not None

    def stop_heartbeat(self) -> None:
        """Send no heartbeat any more."""
        self._beat = None

    def beat(self) -> None:
        """Send our heartbeat if it is due."""
        if self._beat is not None and (now := self.clock()) >= self._next_beat_ns:
            self._next_beat_ns = now + self._beat_period_ns
            self.send((self._beat,))

    def dispatch(self, message: can.Message) -> bool:
        """Process a frame; returns False for a frame, such as a PDO, that is left to the caller.

        An error frame which reports that the controller went off the bus raises BusError.
        """
        if message.is_error_frame:
            self._note_error_frame(message)
        if message.is_error_frame or not message.is_rx:
            return True  # also our own SYNC, which is received for its time stamp
        identifier = message.arbitration_id
        service = identifier & 0x780
        node_id = identifier & 0x7F
        if message.is_extended_id or message.is_remote_frame:
            return False
        setpoint = service in _RPDOS and node_id in self.names
        request = service == SDO_REQUEST and node_id != 0
        if identifier in _COMMANDS or setpoint or request or self.is_own(identifier):
            if identifier != SYNC_COB_ID or self.sync_producer is None:
                self.note_foreign(identifier)
            if (
                service == SDO_REQUEST
                and node_id in self.names
                and message.data
                and message.data[0] >> 5 in _WRITES
            ):
                self._note_write(identifier)
            return True
        if node_id == 0:
            return False
        self.heard.add(node_id)
        self.silent.discard(node_id)
        if service == HEARTBEAT and message.data:
            self._note_heartbeat(node_id, message)
        elif service == EMCY and len(message.data) == 8:
            self._note_error(node_id, message)
        elif service == SDO_ANSWER:
            self.answered[node_id] += 1
            for listener in self._listeners.get(node_id, ()):
                listener(message.data)
        else:
            return False
        return True

    def _note_error(self, node_id: int, message: can.Message) -> None:
        """Report an EMCY, the end of an error too, and keep the last error of each node."""
        code, register, data = struct.unpack("<HB5s", message.data)
        error = f"EMCY {code:04X}h {describe_error_code(code)}"
        # CiA 301: codes 00xxh report the end of an error.
        if code & 0xFF00:
            kind = EventKind.EMCY
            self.reported[node_id] = error
        else:
            kind = EventKind.EMCY_RESET
            self.reported.pop(node_id, None)
        text = f"{error}, error register {register:02X}h, data {data.hex()}"
        self._events.append((node_id, kind, code, text))

    def _note_error_frame(self, message: can.Message) -> None:
        """Report the state of the CAN controller; the kernel sends each change once."""
        if message.arbitration_id & BUS_OFF:
            raise BusError(str(self.address), BUS_OFF_REASON)
        if message.arbitration_id & _RESTARTED:
            self._events.append(
                (0, EventKind.CONTROLLER, _RESTARTED, "the CAN controller was restarted")
            )
        bits = 0
        if message.arbitration_id & _CONTROLLER and len(message.data) > 1:
            bits = message.data[1]
        if bits & _PASSIVE:
            text = "the CAN controller is error passive: check termination, wiring and bit rate"
            self._events.append((0, EventKind.BUS_PASSIVE, bits, text))
        elif bits:
            states = (
                (_OVERFLOW, "overflows, frames are lost"),
                (_WARNING, "counts errors"),
                (_ACTIVE, "recovered"),
            )
            texts = [text for mask, text in states if bits & mask]
            description = ", ".join(texts) or f"reports {bits:02X}h"
            text = f"the CAN controller {description}"
            self._events.append((0, EventKind.CONTROLLER, bits, text))

    def is_own(self, identifier: int) -> bool:
        """Whether only a device with our own node id sends a frame with this identifier."""
        service = identifier & 0x780
        sent_by_it = 0 < service <= HEARTBEAT and service != SDO_REQUEST
        return self.own_id is not None and sent_by_it and identifier & 0x7F == self.own_id

    def note_foreign(self, identifier: int) -> None:
        """Count a command, or a heartbeat with our node id,
        that neither we nor our SYNC producer sent.
        """
        self.foreign[identifier] += 1
        self._foreign_syncs += identifier == SYNC_COB_ID
        if self.foreign[identifier] == 1:  # once: a master would fill the log
            seen = command_name(identifier, self.names)
            self._events.append((0, EventKind.BUS_BUSY, identifier, f"{seen} that we did not send"))

    def _note_write(self, identifier: int) -> None:
        """Report, once, that another master writes to one of our axes by SDO:
        that can move it, or stop a move.
        """
        if identifier not in self.written:
            seen = command_name(identifier, self.names).replace(
                "an SDO request", "an SDO download (it writes)"
            )
            self.written[identifier] = seen
            self._events.append((0, EventKind.BUS_BUSY, identifier, f"{seen} that we did not send"))

    def _note_heartbeat(self, node_id: int, message: can.Message) -> None:
        previous = self.nmt.get(node_id)
        state = message.data[0] & 0x7F
        now_ns = self.clock()
        if state == NmtState.BOOT_UP:
            self.count_beats(node_id)
            if previous == state and now_ns - self.heard_ns[node_id] < BOOTS_S * 1e9:
                self.boots[node_id] += 1
        else:
            beat = Beat(_sent_ns(message, now_ns), state, self._foreign_syncs)
            self._beats.setdefault(node_id, deque(maxlen=BEATS_KEPT)).append(beat)
        self.nmt[node_id] = state
        self.heard_ns[node_id] = now_ns
        if previous != state:
            self._events.append(
                (node_id, EventKind.NMT, state, f"NMT {nmt_name(previous)} -> {nmt_name(state)}")
            )

    def note_twice(self, node_id: int, first: bytes, second: bytes) -> None:
        """Note that a node gave two answers to one request,
        unless another program asked the same.
        """
        if SDO_REQUEST + node_id not in self.foreign:
            entry = f"{first[2]:02X}{first[1]:02X}h:{first[3]:02X}"
            values = f"{first[4:].hex(' ')} and {second[4:].hex(' ')}"
            self.twice.setdefault(node_id, f"two answers to one request for {entry} ({values})")

    def booted_since(self, node_id: int, since_ns: int) -> bool:
        """Whether the last that a node sent of its NMT state since then is its boot-up message."""
        return self.nmt.get(node_id) == NmtState.BOOT_UP and self.heard_ns[node_id] >= since_ns

    def count_beats(self, node_id: int) -> None:
        """Forget the heartbeats of a node: its period has changed, or it has booted."""
        self._beats.pop(node_id, None)

    def hear_beats(self, period_ms: int) -> None:
        """Listen for as long as `shared_id` needs, where the slowest node has this period."""
        self.wait(min(BEATS_S, PERIODS_HEARD * period_ms * 1e-3))

    def shared_id(self, node_id: int, period_ms: int) -> str:
        """Describe the evidence that two devices have a node id; empty without any.

        Heartbeats count by their rate where no SYNC of another producer came between them: a cell
        in lockstep lives as fast as its SYNC comes, and its heartbeats with it.

        Args:
            node_id: of the node.
            period_ms: of its heartbeat since `count_beats`, or since its first one; 0 where that is
                unknown. One late heartbeat is no evidence.
        """
        if node_id in self.twice:
            return self.twice[node_id]
        if self.boots[node_id]:
            return f"{self.boots[node_id] + 1} boot-up messages within {BOOTS_S:g} s"
        beats = tuple(self._beats.get(node_id, ()))
        if _too_fast(beats, period_ms):
            elapsed_ms = (beats[-1].at_ns - beats[0].at_ns) * 1e-6
            return f"{len(beats)} heartbeats in {elapsed_ms:.0f} ms, its period is {period_ms} ms"
        states = [beat.state for beat in beats]
        between = []
        for before, state, after in zip(states, states[1:], states[2:], strict=False):
            if before == after != state:
                between.append((before, state))
        if len(between) > 1:
            one, other = map(nmt_name, between[0])
            return f"heartbeats {one} and {other} in turn"
        return ""

    def take_events(self, time_ns: int, node_ids: Sequence[int]) -> tuple[CellEvent, ...]:
        """Return the events since the last call in their order;
        axis is None for nodes that are no axes of ours.
        """
        taken = self._events
        self._events = deque()
        found = []
        for node, kind, code, text in taken:
            axis = node_ids.index(node) if node in node_ids else None
            subject = f"{node_label(self.objects(node))}: " if node else ""
            found.append(CellEvent(time_ns, axis, kind, code, f"{subject}{text}"))
        return tuple(found)

    def objects(self, node_id: int, policy: SdoPolicy | None = None) -> ObjectAccess:
        """Return access to the object dictionary of a node, with the link's policy or another."""
        policy = policy or self.policy
        if (node_id, policy) not in self._access:
            client = SynchronousSdoClient(node_id, self, policy)
            self.listen(node_id, client.receive)
            name = self.names.get(node_id, "")
            self._access[node_id, policy] = ObjectAccess(node_id, client, policy, name)
        return self._access[node_id, policy]

    def listen(self, node_id: int, listener: SdoListener) -> None:
        """Pass every SDO answer of a node to a listener."""
        self._listeners.setdefault(node_id, []).append(listener)

    def command_nmt(self, node_id: int, command: NmtCommand) -> int:
        """Send an NMT command; node 0 means all. Returns the time by the clock [ns]."""
        now = self.clock()
        self.send((base_frame(NMT_COB_ID, bytes((command, node_id))),))
        return now

    def confirm_nmt(self, node_id: int, state: NmtState, since_ns: int, within_s: float) -> None:
        """Wait for a heartbeat with this state that was read after ``since_ns`` by the clock.

        Raises:
            StateRefused: none came in time; canopen would have believed the command.
        """

        def found() -> int | None:
            heard_ns = self.heard_ns.get(node_id)
            if heard_ns is None or heard_ns < since_ns:
                return None
            return self.nmt[node_id]

        if not self.wait(within_s, lambda: found() == state):
            waited_s = (self.clock() - since_ns) * 1e-9
            shown = f"{nmt_name(found())} after {waited_s:.3g} s"
            raise StateRefused(
                self.objects(node_id),
                f"NMT {state}",
                shown,
                reported=self.reported.get(node_id, ""),
            )
