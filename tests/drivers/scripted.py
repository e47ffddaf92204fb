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
CURRENT_SCALE = CurrentScale(1e-6, (ObjectEntry(0x6075, 0, 32, signed=False),))
PROFILE = DriveProfile(
    name="generic",
    position=ObjectEntry(0x6064, 0, 32, signed=True),
    current=ObjectEntry(0x6074, 0, 16, signed=True),
    current_scale=CURRENT_SCALE,
    amplitude=Amplitude.RMS,
    tap=TapPoint.REFERENCE,
    saturation_bit=11,
    update_period_us=1000,
    save_semantics="",
    source="test",
)

Tamper = Callable[[can.Message], Iterable[can.Message]]


def frame(cob_id: int, data: bytes = b"") -> can.Message:
    """A frame with an identifier of 11 bits."""
    return can.Message(arbitration_id=cob_id, is_extended_id=False, data=data)


def abort_answer(index: int, sub: int, code: int) -> bytes:
    """Answer of an SDO server that refuses."""
    return struct.pack("<BHBL", 0x80, index, sub, code)


def little_endian(value: int, size: int) -> bytes:
    """A value as the frames carry it; negative values as two's complement."""
    mask = (1 << 8 * size) - 1
    return (value & mask).to_bytes(size, "little")


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
        self.obeys_nmt = True
        self.beats = True
        self.quick_stop_stays = False
        self.ignores_setpoint = False
        self.second_controlword = False
        self.holds_acknowledge = False
        self.keeps_acknowledge = False
        self.acts_at_once = False
        self.largest_pdo_bits = 64
        self.powered_cycles = 0
        self.setpoint_cycles: list[int] = []
        self.next_beat_ns = 0
        self._pending: dict[int, bytes] = {}
        self._previous_control = 0
        self._rising_seen = 0
        self.objects: dict[tuple[int, int], tuple[int, int]] = {
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
        for number in range(4):
            cob = 0x200 + 0x100 * number
            self._add_pdo(0x1400 + number, cob, 0x60400010)
        for number in range(4):
            cob = 0x180 + 0x100 * number
            self._add_pdo(0x1800 + number, cob, 0x60410010)

    def _add_pdo(self, communication: int, cob: int, mapped: int) -> None:
        """Add the objects of a PDO with one entry; those of the third and fourth are not valid."""
        mapping = communication + 0x200
        cob_id = cob + self.node_id
        if communication & 3 >= 2:
            cob_id |= 1 << 31
        self.objects[communication, 1] = (cob_id, 4)
        self.objects[communication, 2] = (255, 1)
        self.objects[mapping, 0] = (1, 1)
        self.objects[mapping, 1] = (mapped, 4)
        for sub in range(2, 9):
            self.objects[mapping, sub] = (0, 4)

    def has(self, index: int, sub: int) -> bool:
        return (index, sub) in self.objects

    def value(self, index: int, sub: int) -> int:
        return self.objects[index, sub][0]

    def store(self, index: int, sub: int, value: int) -> None:
        size = self.objects[index, sub][1]
        self.objects[index, sub] = (value, size)

    def sdo(self, data: bytes) -> bytes | None:
        command, index, sub = struct.unpack_from("<BHB", data)
        if command == 0x80:
            return None
        if not self.has(index, sub):
            return abort_answer(index, sub, 0x06020000)
        if command == 0x40:
            return self._upload(index, sub)
        return self._download(index, sub, data)

    def _upload(self, index: int, sub: int) -> bytes:
        key = (index, sub)
        if key in self.read_aborts:
            return abort_answer(index, sub, self.read_aborts[key])
        self._refresh()
        value, size = self.objects[key]
        value = self.lies.get(key, value)
        command = 0x43 | (4 - size) << 2
        answer = struct.pack("<BHB", command, index, sub)
        return answer + little_endian(value, size).ljust(4, b"\0")

    def _download(self, index: int, sub: int, data: bytes) -> bytes:
        key = (index, sub)
        _, size = self.objects[key]
        length = 4 - (data[0] >> 2 & 3)
        abort = self.aborts.get(key)
        if not abort and length != size:
            abort = 0x06070010
        if not abort:
            abort = self._mapping_abort(index, sub, data)
        if abort:
            return abort_answer(index, sub, abort)
        content = data[4 : 4 + size]
        self.store(index, sub, int.from_bytes(content, "little"))
        if key == (0x6060, 0):
            self.store(0x6061, 0, self.value(0x6060, 0))
        if key == (0x6040, 0):
            self.control(self.value(0x6040, 0), 0)
        return struct.pack("<BHBL", 0x60, index, sub, 0)

    def _mapping_abort(self, index: int, sub: int, data: bytes) -> int:
        """CiA 301: a mapping changes only while its PDO is not valid and its count is 0."""
        is_mapping = 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00
        if not is_mapping:
            return 0
        cob_id = self.value(index - 0x200, 1)
        if not cob_id >> 31:
            return 0x06090030
        count = self.value(index, 0)
        if sub and count:
            return 0x06010000
        if sub:
            return 0
        new_count = data[4]
        bits = 0
        if new_count <= 8:
            for entry in range(new_count):
                bits += self.value(index, entry + 1) & 0xFF
        if bits > self.largest_pdo_bits:
            return 0x06040042
        return 0

    def _refresh(self) -> None:
        self._report(0x6041, self.statusword)
        self._report(0x6064, round(self.position))

    def _report(self, index: int, value: int) -> None:
        if self.has(index, 0):
            self.store(index, 0, value)

    def _mapped(self, base: int, number: int) -> list[tuple[int, int, int]]:
        """Index, subindex and size [bytes] of what a PDO carries."""
        mapping = base + 0x200 + number
        found = []
        for entry in range(self.value(mapping, 0)):
            word = self.value(mapping, entry + 1)
            index = word >> 16
            sub = word >> 8 & 0xFF
            bits = word & 0xFF
            found.append((index, sub, bits // 8))
        return found

    def receive_pdo(self, cob_id: int, data: bytes) -> None:
        if self.nmt == 5:
            self._pending[cob_id] = data
        if self.acts_at_once:
            self._apply_pdos(0)

    def on_sync(self, cycle: int, counted: bool = False) -> list[can.Message]:
        if self.nmt != 5:
            return []
        counts = self.has(0x1019, 0) and self.value(0x1019, 0)
        if counts and not counted:
            return [self.emcy(0x8240)]  # CiA 301: unexpected SYNC data length
        answers = []
        for number in range(4):
            cob = self.value(0x1800 + number, 1)
            kind = self.value(0x1800 + number, 2)
            if not cob >> 31 and kind == 1:
                content = self._tpdo_content(number)
                answers.append(frame(cob & 0x7FF, content))
        self._apply_pdos(cycle)
        self._move()
        return answers

    def _tpdo_content(self, number: int) -> bytes:
        self._refresh()
        content = b""
        for index, sub, size in self._mapped(0x1800, number):
            content += little_endian(self.value(index, sub), size)
        return content

    def _apply_pdos(self, cycle: int) -> None:
        for number in range(4):
            cob = self.value(0x1400 + number, 1)
            pdo = self._pending.pop(cob & 0x7FF, None)
            if cob >> 31 or pdo is None:
                continue
            offset = 0
            for index, sub, size in self._mapped(0x1400, number):
                part = pdo[offset : offset + size]
                is_signed = index == 0x607A
                self.store(index, sub, int.from_bytes(part, "little", signed=is_signed))
                offset += size
            if number == 0:
                self.control(self.value(0x6040, 0), cycle)

    def control(self, word: int, cycle: int) -> None:
        state = self.statusword & 0x6F
        upper = self.statusword & ~0x6F
        rising = word & ~self._previous_control
        self._previous_control = word
        state = self._next_state(state, word, rising)
        self.statusword = upper | state
        if state != 0x27:
            self.moving = False
            return
        if not word & 0x10:
            self._rising_seen = 0
            must_keep = self.holds_acknowledge and self.moving
            if not self.keeps_acknowledge and not must_keep:
                self.statusword &= ~0x1000
            return
        self._rising_seen += 1
        must_be_said_again = self.second_controlword and self._rising_seen < 2
        is_acknowledged = self.statusword & 0x1000
        if self.ignores_setpoint or must_be_said_again or is_acknowledged:
            return
        self.statusword |= 0x1000
        self.statusword &= ~0x0400
        self.target = self.value(0x607A, 0)
        self.moving = True
        self.setpoint_cycles.append(cycle)

    def _next_state(self, state: int, word: int, rising: int) -> int:
        """State after a controlword, by the table of CiA 402."""
        if state & 0x4F == 0x08:  # fault
            if rising & 0x80:
                state = 0x40
        elif word & 0x02 == 0:
            state = 0x40
        elif word & 0x06 == 0x02:  # quick stop
            state = 0x07 if state in (0x27, 0x07) else 0x40
        elif word & 0x0F == 0x06:
            if state in (0x40, 0x21, 0x23, 0x27):
                state = 0x21
        elif word & 0x0F == 0x07:
            if state in (0x21, 0x23, 0x27):
                state = 0x23
        elif word & 0x0F == 0x0F and state in (0x23, 0x27):
            state = 0x27
        return state

    def _move(self) -> None:
        state = self.statusword & 0x6F
        self.powered_cycles += state in (0x27, 0x07)
        if state == 0x07 and not self.quick_stop_stays:
            self.statusword &= ~0x6F
            self.statusword |= 0x40
        if not self.moving:
            return
        step = self.value(0x6081, 0) * PERIOD_NS * 1e-9
        way = self.target - self.position
        self.position += max(-step, min(step, way))
        if self.position == self.target:
            self.moving = False
            self.statusword |= 0x0400
            is_setpoint_gone = not self._previous_control & 0x10
            if self.holds_acknowledge and is_setpoint_gone:
                self.statusword &= ~0x1000

    def fault(self, following_error: bool = False) -> None:
        self.statusword &= ~0x6F
        self.statusword |= 0x08
        if following_error:
            self.statusword |= 0x2000
        self.moving = False

    def emcy(self, code: int) -> can.Message:
        data = struct.pack("<HB5x", code, 1)
        return frame(0x80 + self.node_id, data)


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
        cob = msg.arbitration_id
        data = bytes(msg.data)
        if cob == 0x80:
            self.cycle += 1
            self.clock.now_ns += PERIOD_NS // 4
            self.on_cycle(self.cycle)
        for node in self.nodes:
            self._deliver(node, cob, data)
        self._beat()

    def _deliver(self, node: ScriptedNode, cob: int, data: bytes) -> None:
        if cob == 0x80:
            for answer in node.on_sync(self.cycle, bool(data)):
                self._answer(answer)
        elif cob == 0:
            self._command_nmt(node, data[0], data[1])
        elif cob == 0x600 + node.node_id and node.nmt != 4:
            reply = node.sdo(data)
            if reply is not None:
                self._answer(frame(0x580 + node.node_id, reply))
        elif 0x200 <= cob < 0x600 and cob & 0x7F == node.node_id:
            node.receive_pdo(cob, data)

    def _command_nmt(self, node: ScriptedNode, command: int, node_id: int) -> None:
        states = {1: 5, 2: 4, 128: 127}
        if node_id in (0, node.node_id) and node.obeys_nmt:
            node.nmt = states[command]

    def _beat(self) -> None:
        for node in self.nodes:
            now_ns = self.clock.now_ns
            period_ms = 0
            if node.has(0x1017, 0):
                period_ms = node.value(0x1017, 0)
            if node.beats and period_ms and now_ns >= node.next_beat_ns:
                node.next_beat_ns = now_ns + period_ms * 1_000_000
                state = bytes((node.nmt,))
                self._answer(frame(0x700 + node.node_id, state))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.broken:
            raise can.CanOperationError("the wire was cut")
        timeout_s = timeout or 0.0
        end_ns = self.clock.now_ns + round(timeout_s * 1e9)
        while not self._queue and self.clock.now_ns < end_ns:
            next_ns = self.clock.now_ns + PERIOD_NS
            self.clock.now_ns = min(end_ns, next_ns)
            self._beat()
        if self._queue:
            return self._queue.popleft(), True
        return None, True

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.clock.now_ns += self.flood_period_ns
        message, _ = self._recv_internal(timeout)
        if message is None and self.flood_period_ns:
            return frame(0x7FF)
        return message


def cell(axes: int = 2) -> tuple[CanopenNetwork, ScriptedBus]:
    """A network of so many axes, not yet entered, and the bus that it will open."""
    clock = FakeClock()
    identity = Identity(0x29A, 0x40200, 7)
    bounds = Bounds(0.1, 0.1, 0.1, 0.1)
    policy = SdoPolicy(0.02, 2)
    nodes = []
    network_axes = []
    for number in range(1, axes + 1):
        nodes.append(ScriptedNode(number))
        network_axes.append(Axis(f"J{number}", number, PROFILE, identity))
    bus = ScriptedBus(tuple(nodes), clock)
    network = CanopenNetwork(
        ADDRESS,
        tuple(network_axes),
        heartbeat_ms=20,
        bounds=bounds,
        policy=policy,
        clock=clock,
        opener=lambda address: bus,
    )
    return network, bus


def lose_first_answer(bus: ScriptedBus, *, repeats: bool) -> None:
    """Delay node 1's first SDO answer; it comes before its second answer,
    and if so before every one after that.
    """
    withheld: list[can.Message] = []
    released = False

    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        nonlocal released
        if message.arbitration_id != 0x581:
            return (message,)
        if not withheld:
            withheld.append(message)
            return ()
        if released and not repeats:
            return (message,)
        released = True
        return (withheld[0], message)

    bus.tamper = tamper


def permission(axes: int = 2, span: int = 100_000) -> MotionPermission:
    """For axes that may go from -span to +span."""
    axis_limits = AxisLimits(-span, span, 1e6, 1e7)
    limits = (axis_limits,) * axes
    return MotionPermission("the test", limits)
