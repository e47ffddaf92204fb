"""Drives of another stack that move, in a process of their own on a socketcand hub.

    python -m tests.drivers.moving_nodes HOST:PORT

It writes "ready" when the drives answer; SIGTERM ends it.

Each is a `canopen.LocalNode`: NMT, heartbeat, SDO server and PDO maps are python-canopen's, the end
of the bus is python-can's own. Ours are the object dictionary, the state machine of CiA 402 and a
plant: the position follows the reference, no faster than the profile velocity, and the current is
that of a spring between the two, with noise. Time passes with SYNC.

Most encoders start away from zero, some of them below it.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from can.interfaces.socketcand import SocketCanDaemonBus
from canopen import LocalNode, Network, ObjectDictionary
from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.objectdictionary import datatypes as types
from canopen.pdo.base import PdoMap

from tests.vcan.listener import HUB_CHANNEL

NODES = range(1, 7)
PERIOD_S = 0.005
STIFFNESS = 0.5  #: Current by deviation of position from reference [per mille of rated per count]
NOISE_RAW = 40
SYNC = 0x080
OPERATIONAL = "OPERATIONAL"
INITIALISING = "INITIALISING"
WAIT_S = 0.5
START_COUNTS = (0, -1, 4321, -87381, 12, -7)
"""Position of each encoder at power-on; -87381 is 10 degrees of the demo cell's fourth joint."""
IDENTITY = (0x29A, 0x40200, 1)  #: Vendor, product and revision of the demo cell's drives
FIRST_SERIAL = 1000
READY = "ready\n"
PDOS = 4
ENTRIES = 8

CONTROLWORD = 0x6040
STATUSWORD = 0x6041
MODE = 0x6060
MODE_DISPLAY = 0x6061
POSITION = 0x6064
CURRENT = 0x6074
TARGET = 0x607A
VELOCITY = 0x6081

VARIABLES = (
    (0x1000, types.UNSIGNED32, "ro", 0x00020192),
    (0x1017, types.UNSIGNED16, "rw", 0),
    (CONTROLWORD, types.UNSIGNED16, "rw", 0),
    (STATUSWORD, types.UNSIGNED16, "ro", 0x0250),
    (MODE, types.INTEGER8, "rw", 8),
    (MODE_DISPLAY, types.INTEGER8, "ro", 8),
    (POSITION, types.INTEGER32, "ro", 0),
    (CURRENT, types.INTEGER16, "ro", 0),
    (0x6075, types.UNSIGNED32, "ro", 5000),
    (TARGET, types.INTEGER32, "rw", 0),
    (VELOCITY, types.UNSIGNED32, "rw", 1000),
    (0x6083, types.UNSIGNED32, "rw", 1000),
    (0x6084, types.UNSIGNED32, "rw", 1000),
)
"""Objects: index, type, access and default."""


def dictionary(node_id: int) -> ObjectDictionary:
    """Return the object dictionary of a node."""
    objects = ObjectDictionary()
    for index, kind, access, default in VARIABLES:
        objects.add_object(variable(index, 0, kind, access, default))
    identity = ODRecord("identity", 0x1018)
    values = (len(IDENTITY) + 1, *IDENTITY, FIRST_SERIAL + node_id)
    for sub, value in enumerate(values):
        kind = types.UNSIGNED32 if sub else types.UNSIGNED8
        identity.add_member(variable(0x1018, sub, kind, "ro", value))
    objects.add_object(identity)
    consumers = ODArray("heartbeats of others", 0x1016)
    consumers.add_member(variable(0x1016, 0, types.UNSIGNED8, "ro", 1))
    consumers.add_member(variable(0x1016, 1, types.UNSIGNED32, "rw", 0))
    objects.add_object(consumers)
    for base, first_cob in ((0x1400, 0x200), (0x1800, 0x180)):
        for number in range(PDOS):
            cob = first_cob + 0x100 * number + node_id
            objects.add_object(communication(base + number, cob))
            objects.add_object(mapping(base + 0x200 + number))
    return objects


def variable(index: int, sub: int, kind: int, access: str, default: int) -> ODVariable:
    """Return one object of a dictionary."""
    found = ODVariable(f"{index:04X}h:{sub:02X}", index, sub)
    found.data_type = kind
    found.access_type = access
    found.default = default
    found.pdo_mappable = True
    return found


def communication(index: int, cob: int) -> ODRecord:
    """Return the communication parameters of a PDO, which is not valid at power-on."""
    record = ODRecord(f"PDO {index:04X}h", index)
    record.add_member(variable(index, 0, types.UNSIGNED8, "ro", 2))
    record.add_member(variable(index, 1, types.UNSIGNED32, "rw", cob | 1 << 31))
    record.add_member(variable(index, 2, types.UNSIGNED8, "rw", 255))
    return record


def mapping(index: int) -> ODRecord:
    """Return the mapping of a PDO, empty at power-on."""
    record = ODRecord(f"mapping {index:04X}h", index)
    record.add_member(variable(index, 0, types.UNSIGNED8, "rw", 0))
    for sub in range(1, ENTRIES + 1):
        record.add_member(variable(index, sub, types.UNSIGNED32, "rw", 0))
    return record


class MovingDrive:
    """One drive: a LocalNode, its state machine and its plant."""

    def __init__(self, network: Network, node_id: int) -> None:
        self.node = LocalNode(node_id, dictionary(node_id))
        network.add_node(self.node)
        self._random = Random(node_id)
        self._position = START_COUNTS[node_id - 1]
        self._reference = self._position
        self._moving = False
        self._last_control = 0
        self._pending: dict[int, bytes] = {}
        self._maps_are_read = False
        self.node.add_write_callback(self._written)
        self._put(POSITION, self._position)
        self.node.nmt.state = INITIALISING  # boot-up
        self.start()

    def start(self) -> None:
        """Go on from INITIALISING, in which python-canopen stays."""
        if self.node.nmt.state == INITIALISING:
            self.node.nmt.state = "PRE-OPERATIONAL"

    def _put(self, index: int, value: int) -> None:
        kind = self._kind(index)
        self.node.data_store.setdefault(index, {})[0] = kind.encode_raw(value)

    def _get(self, index: int) -> int:
        return int(self._kind(index).decode_raw(self.node.get_data(index, 0)))

    def _kind(self, index: int) -> ODVariable:
        found = self.node.object_dictionary.get_variable(index, 0)
        if found is None:
            raise KeyError(f"{index:04X}h")
        return found

    def _written(self, index: int, data: bytes, **_: object) -> None:
        """Act on an object that SDO or an RPDO writes."""
        if index == CONTROLWORD:
            self._control(int.from_bytes(data, "little"))
        elif index == MODE:
            self._put(MODE_DISPLAY, int.from_bytes(data, "little", signed=True))
        elif 0x1400 <= index < 0x1C00:
            self._maps_are_read = False

    def _control(self, word: int) -> None:
        """Take one transition of CiA 402."""
        status = self._get(STATUSWORD)
        state = status & 0x6F
        if word & 0x02 == 0 or word & 0x04 == 0:
            state = 0x40
        elif word & 0x0F == 0x06:
            state = 0x21
        elif word & 0x0F == 0x07 and state in (0x21, 0x27):
            state = 0x23
        elif word & 0x0F == 0x0F and state in (0x23, 0x27):
            state = 0x27
        status = status & ~0x6F | state
        rising = word & ~self._last_control
        self._last_control = word
        if state != 0x27:
            self._moving = False
            self._reference = self._position
        elif rising & 0x10:
            self._reference = self._get(TARGET)
            self._moving = True
            status = (status | 0x1000) & ~0x0400
        elif word & 0x10 == 0:
            status &= ~0x1000
        self._put(STATUSWORD, status)

    def receive(self, cob_id: int, data: bytes) -> None:
        """Keep an RPDO until SYNC."""
        self._pending[cob_id] = data

    def on_sync(self) -> None:
        """Answer a SYNC, act on what came before it, and move for one period."""
        if self.node.nmt.state != OPERATIONAL:
            return
        if not self._maps_are_read:
            self.node.tpdo.read()
            self.node.rpdo.read()
            self._maps_are_read = True
        for pdo in self.node.tpdo.values():
            if pdo.enabled and pdo.trans_type == 1:
                pdo.data = self._content(pdo)
                pdo.transmit()
        for pdo in self.node.rpdo.values():
            data = self._pending.pop(pdo.cob_id or 0, None)
            if pdo.enabled and data is not None:
                self._apply(pdo, data)
        self._move()

    def _content(self, pdo: PdoMap) -> bytearray:
        content = bytearray()
        for entry in pdo:
            content += self.node.get_data(entry.index, entry.subindex)
        return content

    def _apply(self, pdo: PdoMap, data: bytes) -> None:
        offset = 0
        for entry in pdo:
            size = entry.length // 8
            self.node.set_data(entry.index, entry.subindex, bytes(data[offset : offset + size]))
            offset += size

    def _move(self) -> None:
        step = max(1, round(self._get(VELOCITY) * PERIOD_S))
        way = self._reference - self._position
        if self._moving:
            self._position += max(-step, min(step, way))
            if self._position == self._reference:
                self._moving = False
                self._put(STATUSWORD, self._get(STATUSWORD) | 0x0400)
        noise = self._random.randint(-NOISE_RAW, NOISE_RAW)
        current = round(STIFFNESS * way) + noise
        self._put(POSITION, self._position)
        self._put(CURRENT, max(-1000, min(1000, current)))


def main(address: str) -> None:
    """Answer until SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    host, _, port = address.rpartition(":")
    network = Network()
    with SocketCanDaemonBus(HUB_CHANNEL, host, int(port)) as bus:
        network.bus = bus
        drives = [MovingDrive(network, node_id) for node_id in NODES]
        sys.stdout.write(READY)
        sys.stdout.flush()
        while True:
            message = bus.recv(WAIT_S)
            if message is None or message.is_error_frame or message.is_extended_id:
                continue
            cob_id = message.arbitration_id
            network.notify(cob_id, message.data, message.timestamp)
            for drive in drives:
                drive.start()
                if cob_id == SYNC:
                    drive.on_sync()
                elif 0x200 <= cob_id < 0x580 and cob_id & 0x7F == drive.node.id:
                    drive.receive(cob_id, bytes(message.data))


@contextmanager
def moving_nodes(address: str) -> Iterator[None]:
    """Let the drives answer on a hub until the block ends."""
    command = [sys.executable, "-m", "tests.drivers.moving_nodes", address]
    root = Path(__file__).parents[2]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=root) as process:
        try:
            if process.stdout is None or process.stdout.readline() != READY:
                raise RuntimeError("no drives on the hub")
            yield
            if process.poll() is not None:
                raise RuntimeError(f"the drives ended with {process.returncode}")
        finally:
            process.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
