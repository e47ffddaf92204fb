"""CiA 402 node on a bus: NMT, heartbeat, SDO, PDO and EMCY around one drive."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.drive import Drive, ErrorCode
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.objects import (
    LOAD,
    NO_OBJECT,
    READ_ONLY,
    SAVE,
    Kind,
    SdoServer,
    amplifier_dictionary,
    find,
    vendor,
)
from drivers.simulation.pdo import Pdo, PdoParameters, default_pdos
from drivers.simulation.spec import AxisSpec, SdoAbort

Send = Callable[[int, bytes], None]

# SDO abort codes (CiA 301)
NOT_STORED = 0x08000020
NOT_IN_THIS_STATE = 0x08000022
NO_DATA = 0x08000024
# Objects by their index. CiA 301:
SYNC_COB_ID = 0x1005
ERROR_FIELD = 0x1003
STORE = 0x1010
LOAD_DEFAULTS = 0x1011
#: Node id in bits 16 to 22, time [ms] in bits 0 to 15
CONSUMER_HEARTBEAT = 0x1016
#: Period [ms]
PRODUCER_HEARTBEAT = 0x1017
IDENTITY = 0x1018
# Of the manufacturer:
GAIN = 0x2003
# CiA 402:
ABORT_CONNECTION_OPTION = 0x6007
CONTROLWORD = (0x6040, 0)
FOLLOWING_ERROR_WINDOW = 0x6065
FOLLOWING_ERROR_TIMEOUT = 0x6066
POSITION_WINDOW = 0x6067
POSITION_WINDOW_TIME = 0x6068
MAX_CURRENT = 0x6073
#: Value of 6007h. The others: 0 no action, 1 fault, 2 disable voltage.
QUICK_STOP = 3
#: Transmission type of a PDO; higher ones are event-driven
LAST_SYNCHRONOUS_TYPE = 240
#: In 1005h
PRODUCES_SYNC = 1 << 30


class NmtState(IntEnum):
    """NMT state, coded as in a heartbeat."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """First byte of an NMT frame."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


@dataclass(frozen=True, slots=True)
class Stored:
    """Parameters stored by 1010h: every value and the parameters of every PDO."""

    values: dict[tuple[int, int], int]
    pdos: tuple[PdoParameters, ...]


def _is_pdo_mapping(index: int) -> bool:
    """Whether the index of a PDO parameter is that of a mapping (1600h, 1A00h and on)."""
    return bool(index & 0x200)


class Node:
    """Node and its object dictionary; all methods are called from the cell's one thread."""

    def __init__(self, index: int, axis: AxisSpec, amplifiers: AmplifierSet, send: Send) -> None:
        self.node_id = axis.node_id
        self.nmt = NmtState.INITIALISING
        self.drive = Drive(index, amplifiers, self._number)
        self._index = index
        self._axis = axis
        self._amplifiers = amplifiers
        self._send = send
        self._dictionary = amplifier_dictionary(axis)
        self._vendor_currents = {
            current.key: current.source(amplifiers, index) for current in vendor(axis).currents
        }
        self._values = {key: entry.default for key, entry in self._dictionary.items()}
        self._rpdos, self._tpdos = default_pdos(axis.node_id, self._dictionary, self._source)
        self.saved = self._stored()  #: parameters that become valid with the next power-on
        self._defaults = self.saved
        # Data by PDO number, until the next SYNC
        self._waiting_rpdos: dict[int, bytes] = {}
        # Newest first
        self._error_history: list[int] = []
        self._sdo = SdoServer(self.read, self.write)
        self._now_us = 0
        self._beat_us = 0
        self._beat_wall_s = 0.0
        self._heard_wall_s: float | None = None
        self._toggle = 0
        self._toggle_mask = 0
        if axis.toggle_bit is not None:
            self._toggle_mask = 1 << axis.toggle_bit
        self._refused: set[int] = set()
        self._obeys_nmt = True

    def boot(self, wall_s: float) -> None:
        """Send the boot-up message and enter PRE-OPERATIONAL."""
        self._apply_settings()
        self._send(0x700 + self.node_id, bytes([NmtState.INITIALISING]))
        self.nmt = NmtState.PRE_OPERATIONAL
        self._beat_us = self._now_us
        self._beat_wall_s = wall_s

    def command_nmt(self, command: int, wall_s: float) -> None:
        """Execute an NMT command; unknown ones are ignored, as CiA 301 requires."""
        if command == NmtCommand.START and not self._obeys_nmt:
            return
        if command == NmtCommand.START and self.nmt is not NmtState.OPERATIONAL:
            self.nmt = NmtState.OPERATIONAL
            self._waiting_rpdos.clear()
            for pdo in self._tpdos:
                pdo.reset()
            self.send_events()
        elif command == NmtCommand.STOP:
            self._abort_connection()
            self.nmt = NmtState.STOPPED
        elif command == NmtCommand.ENTER_PRE_OPERATIONAL:
            self.nmt = NmtState.PRE_OPERATIONAL
        elif command == NmtCommand.RESET_NODE:
            self.drive.reset()
            self._restore(self.saved, first=0x1000, last=0x9FFF)
            self._error_history.clear()
            self.boot(wall_s)
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._abort_connection()
            self._restore(self.saved, first=0x1000, last=0x1FFF)
            self.boot(wall_s)

    def receive(self, can_id: int, data: bytes, clock: Callable[[], float]) -> None:
        """Take a frame of the bus that is no SYNC; most are for others.

        The upper four bits of an identifier are its service (CiA 301, predefined connection set).
        """
        service = can_id & 0x780
        if can_id == 0:
            if len(data) >= 2 and data[1] in (0, self.node_id):
                self.command_nmt(data[0], clock())
        elif service == 0x600:
            if can_id == 0x600 + self.node_id:
                self.request(data)
        elif service == 0x700:
            self.hear_heartbeat(can_id - 0x700, clock())
        else:
            self.receive_pdo(can_id, data)

    def hear_heartbeat(self, producer: int, wall_s: float) -> None:
        """Note a heartbeat; that of the node in 1016h is monitored from its first one on."""
        monitored_node = (self._number(CONSUMER_HEARTBEAT, 1) >> 16) & 0x7F
        if producer == monitored_node:
            self._heard_wall_s = wall_s

    def excuse_silence(self, seconds: float) -> None:
        """Do not count a time in which the cell did not run as silence of the master.

        The heartbeats of that time may still wait to be read.
        """
        if self._heard_wall_s is not None:
            self._heard_wall_s += seconds

    def keep_time(self, now_us: int, wall_s: float) -> bool:
        """React by 6007h when the monitored heartbeat is overdue,
        and send the own one when it is due.

        Args:
            now_us: plant time [us]; it stands still while no SYNC comes.
            wall_s: wall time [s].

        Returns:
            whether the monitored heartbeat has become overdue now.
        """
        lost = self._monitored_heartbeat_is_lost(wall_s)
        if lost:
            self.fall_back()
        self._now_us = now_us
        self._send_heartbeat_if_due(wall_s)
        return lost

    def _monitored_heartbeat_is_lost(self, wall_s: float) -> bool:
        """Whether the heartbeat of 1016h is overdue; then its monitoring ends.

        By wall time: plant time stands still where the master has died.
        """
        allowed_ms = self._number(CONSUMER_HEARTBEAT, 1) & 0xFFFF
        lost = False
        if allowed_ms and self._heard_wall_s is not None:
            silent_ms = (wall_s - self._heard_wall_s) * 1e3
            lost = silent_ms >= allowed_ms
        if lost or not allowed_ms:
            self._heard_wall_s = None
        return lost

    def _send_heartbeat_if_due(self, wall_s: float) -> None:
        """Send the heartbeat after the period of 1017h by plant time or wall time, the faster."""
        period_ms = self._number(PRODUCER_HEARTBEAT)
        if period_ms == 0 or self.nmt is NmtState.INITIALISING:
            return
        since_us = self._now_us - self._beat_us
        since_wall_ms = (wall_s - self._beat_wall_s) * 1e3
        if since_us >= 1000 * period_ms or since_wall_ms >= period_ms:
            self._beat_us = self._now_us
            self._beat_wall_s = wall_s
            self._send(0x700 + self.node_id, bytes([self.nmt]))

    def fall_back(self) -> None:
        """React to a heartbeat error: EMCY, the reaction of 6007h,
        and PRE-OPERATIONAL (the default of 1029h).
        """
        self._emergency(ErrorCode.HEARTBEAT_LOST)
        self._abort_connection()
        self.nmt = NmtState.PRE_OPERATIONAL

    def fail(self, code: int) -> None:
        """Enter FAULT and send an EMCY."""
        self.drive.fail(code)
        self._emergency(code)

    def inject(self, kind: FaultKind) -> None:
        """Inject a fault that lasts from power-on; other kinds have no effect here."""
        match kind:
            case FaultKind.REFUSES_NMT:
                self._obeys_nmt = False
            case FaultKind.OTHER_SERIAL:
                self._values[IDENTITY, 4] += 1
            case FaultKind.REFUSES_MAPPING:
                for pdo in self._tpdos:
                    pdo.locked = True
            case FaultKind.SYNC_PRODUCER:
                # The cell sends the SYNC.
                self._values[SYNC_COB_ID, 0] |= PRODUCES_SYNC
            case FaultKind.NO_GUARD:
                for subindex in range(2):
                    # Its value stays zero: no heartbeat is monitored.
                    del self._dictionary[CONSUMER_HEARTBEAT, subindex]
            case FaultKind.REFUSES_WRITE:
                self._refused.add(GAIN)
            case FaultKind.REFUSES_SAVE:
                self._refused.add(STORE)

    def strike(self, fault: FaultSpec, wall_s: float) -> None:
        """Undergo a fault that happens once; other kinds have no effect here."""
        match fault.kind:
            case FaultKind.EMERGENCY:
                self.fail(fault.value)
            case FaultKind.FOLLOWING_ERROR:
                self.fail(ErrorCode.FOLLOWING_ERROR)
            case FaultKind.FALLS_BACK:
                self.fall_back()
            case FaultKind.REBOOTS:
                self.command_nmt(NmtCommand.RESET_NODE, wall_s)
            case FaultKind.LOSES_POWER:
                self.drive.reset()

    def receive_pdo(self, can_id: int, data: bytes) -> None:
        """Accept a receive PDO of this node: at once if event-driven, else with the next SYNC."""
        if self.nmt is not NmtState.OPERATIONAL:
            return
        for number, pdo in enumerate(self._rpdos):
            if not pdo.valid or pdo.can_id != can_id:
                continue
            if len(data) < pdo.layout.size:
                self._emergency(ErrorCode.PDO_TOO_SHORT)
            elif pdo.parameters.transmission <= LAST_SYNCHRONOUS_TYPE:
                self._waiting_rpdos[number] = data
            else:
                self._unpack(pdo, data)
                self.send_events()

    def begin_cycle(self) -> None:
        """Apply the synchronous receive PDOs on SYNC."""
        if self._waiting_rpdos:
            waiting = self._waiting_rpdos
            self._waiting_rpdos = {}
            for number, data in waiting.items():
                self._unpack(self._rpdos[number], data)

    def end_cycle(self) -> None:
        """Update faults, waiting set-points and the toggle bit after the plant has moved."""
        self._toggle ^= self._toggle_mask
        fault = self.drive.monitor()
        if fault is not ErrorCode.NONE:
            self._emergency(fault)

    def send_sync(self, now_us: int) -> None:
        """Send the transmit PDOs of this SYNC."""
        self._now_us = now_us
        self._transmit_pdos(Pdo.on_sync)

    def send_events(self) -> None:
        """Send the event-driven transmit PDOs whose values changed."""
        self._transmit_pdos(Pdo.on_event)

    def _transmit_pdos(self, due: Callable[[Pdo, int], bytes | None]) -> None:
        """Send the valid transmit PDOs for which `due` returns data."""
        if self.nmt is not NmtState.OPERATIONAL:
            return
        for pdo in self._tpdos:
            data = None
            if pdo.valid:
                data = due(pdo, self._now_us)
            if data is not None:
                self._send(pdo.can_id, data)

    def request(self, data: bytes) -> None:
        """Answer an SDO request; a stopped node is silent."""
        if self.nmt in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
            answer = self._sdo.answer(data)
            if answer is not None:
                self._send(0x580 + self.node_id, answer)
            self.send_events()

    def read(self, index: int, subindex: int) -> bytes:
        """Return the bytes of an entry.

        Raises:
            SdoAbort: it does not exist or cannot be read.
        """
        pdo = self._pdo(index)
        if pdo is not None:
            if _is_pdo_mapping(index):
                return pdo.read_mapping(subindex)
            return pdo.read_communication(subindex)
        entry = find(self._dictionary, index, subindex)
        if (index, subindex) == (ERROR_FIELD, 1) and not self._error_history:
            raise SdoAbort(NO_DATA)
        if entry.kind is Kind.TEXT:
            return entry.text.encode("ascii")
        read_value = self._source((index, subindex))
        return entry.kind.encode(read_value())

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an entry.

        Raises:
            SdoAbort: it does not exist, is read only, or refuses the value.
        """
        pdo = self._pdo(index)
        if pdo is not None:
            if _is_pdo_mapping(index):
                pdo.write_mapping(subindex, data)
            else:
                pdo.write_communication(subindex, data)
            return
        entry = find(self._dictionary, index, subindex)
        if not entry.writable:
            raise SdoAbort(READ_ONLY)
        value = entry.decode(data)
        # Drives write their memory with the power stage off.
        if index in self._refused or (index == STORE and self.drive.powered):
            raise SdoAbort(NOT_IN_THIS_STATE)
        if index == STORE:
            if value != SAVE:
                raise SdoAbort(NOT_STORED)
            self.saved = self._stored()
        elif index == LOAD_DEFAULTS:
            if value != LOAD:
                raise SdoAbort(NOT_STORED)
            # Restored parameters become valid with the next reset (CiA 301 §7.5.2.14).
            self.saved = self._defaults
        elif index == ERROR_FIELD:
            self._error_history.clear()
        else:
            self._set((index, subindex), value)

    def _pdo(self, index: int) -> Pdo | None:
        """Return the PDO to which an index belongs; None for all other objects.

        CiA 301: RPDOs have 1400h to 17FFh, TPDOs 1800h to 1BFFh, 512 communication parameters and
        512 mappings each.
        """
        if not 0x1400 <= index <= 0x1BFF:
            return None
        pdos = self._rpdos
        if index >= 0x1800:
            pdos = self._tpdos
        number = index & 0x1FF
        if number >= len(pdos):
            raise SdoAbort(NO_OBJECT)
        return pdos[number]

    def _source(self, key: tuple[int, int]) -> Callable[[], int]:
        """Return a function that reads the present value of an entry, by index and subindex."""
        i = self._index
        drive = self.drive
        amplifiers = self._amplifiers
        live: dict[int, Callable[[], int]] = {
            0x1001: lambda: int(drive.error is not ErrorCode.NONE),
            0x2005: lambda: round(10.0 * float(amplifiers.temperature_c[i])),
            0x603F: lambda: int(drive.error),
            0x6040: lambda: drive.controlword,
            0x6041: lambda: drive.statusword() | self._toggle,
            0x6061: lambda: self._number(0x6060),
            0x6062: lambda: amplifiers.readings.demand[i],
            **dict.fromkeys((0x2240, 0x6063, 0x6064), lambda: amplifiers.readings.position[i]),
            0x606C: lambda: amplifiers.readings.velocity[i],
            0x6074: lambda: amplifiers.readings.current_demand[i],
            **dict.fromkeys((0x6077, 0x6078), lambda: amplifiers.readings.current[i]),
            0x60F4: lambda: amplifiers.readings.demand[i] - amplifiers.readings.position[i],
        }
        index, subindex = key
        if index == ERROR_FIELD and subindex:
            return self._last_error
        if index == ERROR_FIELD:
            # Of all errors it reports the last one only.
            return lambda: len(self._error_history[:1])
        if key in self._vendor_currents:
            return self._vendor_currents[key]
        return live.get(index, lambda: self._number(index, subindex))

    def _last_error(self) -> int:
        """Return object 1003h:01."""
        if self._error_history:
            return self._error_history[0]
        return 0

    def _number(self, index: int, subindex: int = 0) -> int:
        """Return the last value that was written to an entry, or its default."""
        return self._values[index, subindex]

    def _unpack(self, pdo: Pdo, data: bytes) -> None:
        """Set the values of a receive PDO.

        A controlword comes last, so that it acts on the set-points in the same PDO.
        """
        values = dict(zip(pdo.mapped, pdo.layout.unpack_from(data), strict=True))
        for key in sorted(values, key=lambda key: key == CONTROLWORD):
            if self._dictionary[key].accepts(values[key]):
                self._set(key, values[key])

    def _set(self, key: tuple[int, int], value: int) -> None:
        """Set the value of an entry, and act on it."""
        self._values[key] = value
        index, _ = key
        if key == CONTROLWORD:
            error_before = self.drive.error
            self.drive.command(value)
            had_error = error_before is not ErrorCode.NONE
            if had_error and self.drive.error is ErrorCode.NONE:
                # EMCY 0000h (CiA 301): error reset
                emcy = struct.pack("<HB5x", ErrorCode.NONE, 0)
                self._send(0x80 + self.node_id, emcy)
        elif FOLLOWING_ERROR_WINDOW <= index <= MAX_CURRENT:
            self._apply_settings()

    def _apply_settings(self) -> None:
        """Pass windows, times and current limit to the control loop."""
        loop = self._amplifiers.loops[self._index]
        loop["error_window"] = self._number(FOLLOWING_ERROR_WINDOW)
        loop["error_time_s"] = self._number(FOLLOWING_ERROR_TIMEOUT) * 1e-3
        loop["target_window"] = self._number(POSITION_WINDOW)
        loop["target_time_s"] = self._number(POSITION_WINDOW_TIME) * 1e-3
        # An amplifier without 6073h keeps its peak current.
        if (MAX_CURRENT, 0) in self._dictionary:
            per_mille = self._number(MAX_CURRENT)
            loop["limit_a"] = per_mille * 1e-3 * self._axis.rated_current_a

    def _abort_connection(self) -> None:
        """React by the abort connection option code 6007h."""
        option = self._number(ABORT_CONNECTION_OPTION)
        if option == 0 or (not self.drive.powered and option < QUICK_STOP):
            return
        if option == 1:
            self.drive.fail(ErrorCode.COMMUNICATION_LOST)
            self._emergency(ErrorCode.COMMUNICATION_LOST)
        elif option == 2:
            self.drive.command(0x0000)
        else:
            self.drive.quick_stop()

    def _emergency(self, code: int) -> None:
        self._error_history.insert(0, int(code))
        if self.nmt in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
            register = int(self.drive.error is not ErrorCode.NONE)
            emcy = struct.pack("<HB5x", code, register)
            self._send(0x80 + self.node_id, emcy)

    def _stored(self) -> Stored:
        return Stored(
            dict(self._values), tuple(pdo.parameters for pdo in self._rpdos + self._tpdos)
        )

    def _restore(self, stored: Stored, first: int, last: int) -> None:
        for key, value in stored.values.items():
            if first <= key[0] <= last:
                self._values[key] = value
        for pdo, parameters in zip(self._rpdos + self._tpdos, stored.pdos, strict=True):
            pdo.restore(parameters)
        self._waiting_rpdos.clear()
