"""A bus with tiny CANopen nodes on it that live in the caller's thread and in a time of their own:
no waiting, no luck.

The nodes keep to what CiA 301 and 402 demand of a drive (mapping may change only while the PDO is
not valid, transitions one at a time, set-points on the rising edge of bit 4) and deviate where a
test sets it.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterable

import can

from drivers.canopen.bus import BusAddress
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.socketcan import NO_LOSSES
from drivers.move import AxisLimits, MotionPermission
from drivers.profiles.profile import (
    Amplitude,
    Axis,
    CurrentScale,
    DriveProfile,
    Identity,
    ObjectEntry,
    TapPoint,
)

PERIOD_NS = 1_000_000
ADDRESS = BusAddress("virtual", "scripted")
PROFILE = DriveProfile(
    name="generic",
    position=ObjectEntry(0x6064, 0, 32, signed=True),
    current=ObjectEntry(0x6074, 0, 16, signed=True),
    current_scale=CurrentScale(1e-6, (ObjectEntry(0x6075, 0, 32, signed=False),)),
    amplitude=Amplitude.RMS,
    tap=TapPoint.REFERENCE,
    saturation_bit=11,
    update_period_us=1000,
    save_semantics="",
    source="test",
)

Tamper = Callable[[can.Message], Iterable[can.Message]]


class FakeClock:
    """Monotonic time that passes only while code waits."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000

    def __call__(self) -> int:
        return self.now_ns


class ScriptedNode:
    """One CiA 402 drive.

    Attributes:
        objects: value and size [bytes] by (index, subindex).
        aborts: abort code of a write, by (index, subindex); `read_aborts`: of a read.
        lies: value that a read returns instead of the stored one.
        obeys_nmt: whether it follows NMT commands.
        quick_stop_stays: it stays in QUICK STOP ACTIVE (605Ah = 5).
        ignores_setpoint: it never acknowledges one.
        second_controlword: it acknowledges a set-point only when it is said twice.
        holds_acknowledge: it keeps bit 12 until it has arrived; `keeps_acknowledge`: for ever.
        acts_at_once: RPDOs act when they arrive, not with the next SYNC.
    """

    def __init__(self, node_id: int, serial: int = 7) -> None:
        self.node_id = node_id
        self.nmt = 127
        self.statusword = 0x0250
        self.position = 0.0
        self.velocity = 0.0
        self.target = 0
        self.moving = False
        self.aborts: dict[tuple[int, int], int] = {}
        self.read_aborts: dict[tuple[int, int], int] = {}
        self.lies: dict[tuple[int, int], int] = {}
        self.obeys_nmt = self.beats = True
        self.quick_stop_stays = self.ignores_setpoint = self.second_controlword = False
        self.holds_acknowledge = self.keeps_acknowledge = self.acts_at_once = False
        self.largest_pdo_bits = 64
        self.powered_cycles = 0
        self.setpoint_cycles: list[int] = []
        self.next_beat_ns = 0
        self._pending: dict[int, bytes] = {}
        self._previous_control = 0
        self._rising_seen = 0
        o: dict[tuple[int, int], tuple[int, int]] = {
            (0x1000, 0): (0x00020192, 4),
            (0x1008, 0): (int.from_bytes(b"axis", "little"), 4),
            (0x1017, 0): (0, 2),
            (0x1018, 1): (0x29A, 4),
            (0x1018, 2): (0x40200, 4),
            (0x1018, 3): (1, 4),
            (0x1018, 4): (serial, 4),
            (0x6040, 0): (0, 2),
            (0x6041, 0): (0, 2),
            (0x6060, 0): (8, 1),
            (0x6061, 0): (8, 1),
            (0x6064, 0): (0, 4),
            (0x6074, 0): (0, 2),
            (0x6075, 0): (2000, 4),
            (0x607A, 0): (0, 4),
            (0x6081, 0): (1000, 4),
            (0x6083, 0): (1000, 4),
            (0x6084, 0): (1000, 4),
        }
        for base, cob in ((0x1400, 0x200), (0x1800, 0x180)):
            for number in range(4):
                o[base + number, 1] = (
                    cob + 0x100 * number + node_id | (0 if number < 2 else 1 << 31),
                    4,
                )
                o[base + number, 2] = (255, 1)
                o[base + 0x200 + number, 0] = (1, 1)
                for sub in range(1, 9):
                    default = 0x60400010 if base == 0x1400 else 0x60410010
                    o[base + 0x200 + number, sub] = (default if sub == 1 else 0, 4)
        self.objects = o

    def has(self, index: int, sub: int) -> bool:
        return (index, sub) in self.objects

    def value(self, index: int, sub: int) -> int:
        return self.objects[index, sub][0]

    def store(self, index: int, sub: int, value: int) -> None:
        self.objects[index, sub] = (value, self.objects[index, sub][1])

    def sdo(self, data: bytes) -> bytes | None:
        command, index, sub = struct.unpack_from("<BHB", data)
        if command == 0x80:
            return None
        if not self.has(index, sub):
            return struct.pack("<BHBL", 0x80, index, sub, 0x06020000)
        _, size = self.objects[index, sub]
        if command == 0x40 and (index, sub) in self.read_aborts:
            return struct.pack("<BHBL", 0x80, index, sub, self.read_aborts[index, sub])
        if command == 0x40:
            self._refresh()
            value = self.lies.get((index, sub), self.value(index, sub))
            answer = struct.pack("<BHB", 0x43 | (4 - size) << 2, index, sub)
            return answer + (value & (1 << 8 * size) - 1).to_bytes(size, "little").ljust(4, b"\0")
        length = 4 - (command >> 2 & 3)
        abort = self.aborts.get((index, sub)) or (
            0x06070010 if length != size else self._mapping_abort(index, sub, data)
        )
        if abort:
            return struct.pack("<BHBL", 0x80, index, sub, abort)
        self.store(index, sub, int.from_bytes(data[4 : 4 + size], "little"))
        if (index, sub) == (0x6060, 0):
            self.store(0x6061, 0, self.value(0x6060, 0))
        if (index, sub) == (0x6040, 0):
            self.control(self.value(0x6040, 0), 0)
        return struct.pack("<BHBL", 0x60, index, sub, 0)

    def _mapping_abort(self, index: int, sub: int, data: bytes) -> int:
        """CiA 301: a mapping changes only while its PDO is not valid and its count is 0."""
        if not (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00):
            return 0
        if not self.value(index - 0x200, 1) >> 31:
            return 0x06090030
        if sub:
            return 0x06010000 if self.value(index, 0) else 0
        entries = range(data[4])
        bits = sum(self.value(index, entry + 1) & 0xFF for entry in entries if data[4] <= 8)
        return 0x06040042 if bits > self.largest_pdo_bits else 0

    def _refresh(self) -> None:
        for key, value in (((0x6041, 0), self.statusword), ((0x6064, 0), round(self.position))):
            if self.has(*key):
                self.store(*key, value)

    def _mapped(self, base: int, number: int) -> list[tuple[int, int, int]]:
        words = []
        for sub in range(self.value(base + 0x200 + number, 0)):
            words.append(self.value(base + 0x200 + number, sub + 1))
        found = []
        for w in words:
            found.append((w >> 16, w >> 8 & 0xFF, (w & 0xFF) // 8))
        return found

    def receive_pdo(self, cob_id: int, data: bytes) -> None:
        if self.nmt == 5:
            self._pending[cob_id] = data
        if self.acts_at_once:
            self._apply_pdos(0)

    def on_sync(self, cycle: int, counted: bool = False) -> list[can.Message]:
        if self.nmt != 5:
            return []
        if self.has(0x1019, 0) and self.value(0x1019, 0) and not counted:
            return [self.emcy(0x8240)]  # CiA 301: unexpected SYNC data length
        answers = []
        for number in range(4):
            cob, kind = self.value(0x1800 + number, 1), self.value(0x1800 + number, 2)
            if not cob >> 31 and kind == 1:
                self._refresh()
                data = b"".join(
                    (self.value(i, s) & (1 << 8 * n) - 1).to_bytes(n, "little")
                    for i, s, n in self._mapped(0x1800, number)
                )
                arbitration_id = cob & 0x7FF
                message = can.Message(
                    arbitration_id=arbitration_id, is_extended_id=False, data=data
                )
                answers.append(message)
        self._apply_pdos(cycle)
        self._move()
        return answers

    def _apply_pdos(self, cycle: int) -> None:
        for number in range(4):
            cob = self.value(0x1400 + number, 1)
            pdo = self._pending.pop(cob & 0x7FF, None)
            if cob >> 31 or pdo is None:
                continue
            offset = 0
            for index, sub, size in self._mapped(0x1400, number):
                self.store(
                    index,
                    sub,
                    int.from_bytes(pdo[offset : offset + size], "little", signed=index == 0x607A),
                )
                offset += size
            if number == 0:
                self.control(self.value(0x6040, 0), cycle)

    def control(self, word: int, cycle: int) -> None:
        state, upper = self.statusword & 0x6F, self.statusword & ~0x6F
        rising, self._previous_control = word & ~self._previous_control, word
        if state & 0x4F == 0x08:  # fault
            if rising & 0x80:
                state = 0x40
        elif word & 0x02 == 0:
            state = 0x40
        elif word & 0x06 == 0x02:  # quick stop
            state = 0x07 if state in (0x27, 0x07) else 0x40
            self.moving = False
        elif word & 0x0F == 0x06:
            state = 0x21 if state in (0x40, 0x21, 0x23, 0x27) else state
        elif word & 0x0F == 0x07:
            state = {0x21: 0x23, 0x23: 0x23, 0x27: 0x23}.get(state, state)
        elif word & 0x0F == 0x0F:
            state = {0x23: 0x27, 0x27: 0x27}.get(state, state)
        self.statusword = upper | state
        if state != 0x27:
            self.moving = False
            return
        if not word & 0x10:
            if not self.keeps_acknowledge and not (self.holds_acknowledge and self.moving):
                self.statusword &= ~0x1000
            self._rising_seen = 0
            return
        self._rising_seen += 1
        if (
            self.ignores_setpoint
            or (self.second_controlword and self._rising_seen < 2)
            or self.statusword & 0x1000
        ):
            return
        self.statusword = (self.statusword | 0x1000) & ~0x0400
        self.target, self.moving = self.value(0x607A, 0), True
        self.setpoint_cycles.append(cycle)

    def _move(self) -> None:
        state = self.statusword & 0x6F
        self.powered_cycles += state in (0x27, 0x07)
        if state == 0x07 and not self.quick_stop_stays:
            self.statusword = self.statusword & ~0x6F | 0x40
        if self.moving:
            step = self.value(0x6081, 0) * PERIOD_NS * 1e-9
            way = self.target - self.position
            self.position += max(-step, min(step, way))
            if self.position == self.target:
                self.moving = False
                self.statusword |= 0x0400
                if self.holds_acknowledge and not self._previous_control & 0x10:
                    self.statusword &= ~0x1000

    def fault(self, following_error: bool = False) -> None:
        self.statusword = self.statusword & ~0x6F | 0x08 | (0x2000 if following_error else 0)
        self.moving = False

    def emcy(self, code: int) -> can.Message:
        data = struct.pack("<HB5x", code, 1)
        arbitration_id = 0x80 + self.node_id
        return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data)


class ScriptedBus(can.BusABC):
    """The bus of those nodes.

    Attributes:
        tamper: sees every frame of a node and returns what becomes of it.
        flood_period_ns: one frame that concerns no node in each such time, for ever; 0 for none.
        losses, remarks, read_until_ns: as of `drivers.canopen.socketcan.SocketcanBus`.
    """

    def __init__(self, nodes: tuple[ScriptedNode, ...], clock: FakeClock) -> None:
        self.nodes = nodes
        self.clock = clock
        self.flood_period_ns = 0
        self.losses = NO_LOSSES
        self.remarks: tuple[str, ...] = ()
        self.read_until_ns: int | None = None
        self.cycle = -1
        self.sent: list[can.Message] = []
        self.tamper: Tamper = lambda message: (message,)
        self.on_cycle: Callable[[int], None] = lambda cycle: None
        self.broken = False
        self._queue: deque[can.Message] = deque()
        super().__init__(channel="scripted")

    def __del__(self) -> None:
        """Nothing is open; python-can would warn in whichever test runs when this is collected."""

    def inject(self, message: can.Message) -> None:
        self._queue.append(message)

    def _answer(self, message: can.Message) -> None:
        self._queue.extend(self.tamper(message))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.broken:
            raise can.CanOperationError("the wire was cut")
        self.sent.append(msg)
        cob, data = msg.arbitration_id, bytes(msg.data)
        if cob == 0x80:
            self.cycle += 1
            self.clock.now_ns += PERIOD_NS // 4
            self.on_cycle(self.cycle)
        for node in self.nodes:
            if cob == 0x80:
                for answer in node.on_sync(self.cycle, bool(data)):
                    self._answer(answer)
            elif cob == 0 and data[1] in (0, node.node_id) and node.obeys_nmt:
                node.nmt = {1: 5, 2: 4, 128: 127}[data[0]]
            elif cob == 0x600 + node.node_id and node.nmt != 4:
                reply = node.sdo(data)
                if reply is not None:
                    arbitration_id = 0x580 + node.node_id
                    message = can.Message(
                        arbitration_id=arbitration_id, is_extended_id=False, data=reply
                    )
                    self._answer(message)
            elif 0x200 <= cob < 0x600 and cob & 0x7F == node.node_id:
                node.receive_pdo(cob, data)
        self._beat()

    def _beat(self) -> None:
        for node in self.nodes:
            period_ms = node.value(0x1017, 0) if node.has(0x1017, 0) else 0
            if node.beats and period_ms and self.clock.now_ns >= node.next_beat_ns:
                node.next_beat_ns = self.clock.now_ns + period_ms * 1_000_000
                data = bytes((node.nmt,))
                arbitration_id = 0x700 + node.node_id
                message = can.Message(
                    arbitration_id=arbitration_id, is_extended_id=False, data=data
                )
                self._answer(message)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.broken:
            raise can.CanOperationError("the wire was cut")
        end_ns = self.clock.now_ns + round((timeout or 0.0) * 1e9)
        while not self._queue and self.clock.now_ns < end_ns:
            self.clock.now_ns = min(end_ns, self.clock.now_ns + PERIOD_NS)
            self._beat()
        return (self._queue.popleft() if self._queue else None), True

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.clock.now_ns += self.flood_period_ns
        message = self._recv_internal(timeout)[0]
        if message is None and self.flood_period_ns:
            return can.Message(arbitration_id=0x7FF, is_extended_id=False)
        return message


def cell(axes: int = 2) -> tuple[CanopenNetwork, ScriptedBus]:
    """A network of so many axes, not yet entered, and the bus that it will open."""
    clock = FakeClock()
    nodes = tuple(ScriptedNode(n + 1) for n in range(axes))
    bus = ScriptedBus(nodes, clock)
    bounds = Bounds(0.1, 0.1, 0.1, 0.1)
    policy = SdoPolicy(0.02, 2)
    network = CanopenNetwork(
        ADDRESS,
        tuple(Axis(f"J{n + 1}", n + 1, PROFILE, Identity(0x29A, 0x40200, 7)) for n in range(axes)),
        heartbeat_ms=20,
        bounds=bounds,
        policy=policy,
        clock=clock,
        opener=lambda address: bus,
    )
    return network, bus


def lose_first_answer(bus: ScriptedBus, *, repeats: bool) -> None:
    """Hold node 1's first SDO answer back; it comes before its second answer,
    and if so before every one after that.
    """
    held: list[can.Message] = []
    released = False

    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        nonlocal released
        if message.arbitration_id != 0x581:
            return (message,)
        if not held:
            held.append(message)
            return ()
        if released and not repeats:
            return (message,)
        released = True
        return (held[0], message)

    bus.tamper = tamper


def permission(axes: int = 2, span: int = 100_000) -> MotionPermission:
    """For axes that may go from -span to +span."""
    axis_limits = AxisLimits(-span, span, 1e6, 1e7)
    limits = (axis_limits,) * axes
    return MotionPermission("the test", limits)
