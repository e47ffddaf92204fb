"""What goes wrong in a simulated cell, when, and on which axis: part of its truth, frozen."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class FaultKind(Enum):
    """One way to fail. Of a kind that lasts, `cycles` tells how long; the others happen once.

    Lasting: SILENT (deaf and mute: no power, cable off), NO_HEARTBEAT, FROZEN (its TPDOs repeat position and current: a
    dead encoder), STALE (its TPDOs are repeated whole: a processor that hangs behind its bus), LIMIT (statusword bit
    11), LOST, LATE (TPDOs that come with the next SYNC), DUPLICATE (TPDOs sent twice), SHORT_PDO (TPDOs that lack their
    last byte), WRONG_COB_ID (TPDOs under the identifier of TPDO4), SHIFTED (TPDOs carry another position than 6064h),
    SECOND_MASTER (somebody else's SYNC, whole cell), SDO_MASTER (somebody else's SDO requests to the axis),
    SYNC_PRODUCER (the axis sends a SYNC by itself), BUS_OFF (an error frame of this end; then nobody hears or is heard,
    whole cell); and from power-on for ever: REFUSES_NMT (it does not go to OPERATIONAL), REFUSES_MAPPING (its TPDOs
    cannot be mapped), OTHER_SERIAL (an exchanged amplifier), NO_GUARD (it has no 1016h), REFUSES_WRITE (its gain 2003h
    cannot be written), REFUSES_SAVE (1010h does not store).

    Once: EMERGENCY (an EMCY of the code `value`, and FAULT), FOLLOWING_ERROR, FALLS_BACK (PRE-OPERATIONAL with EMCY
    8130h), REBOOTS (reset: boot-up message, settings lost), LOSES_POWER (SWITCH ON DISABLED by itself, as STO does),
    ERROR_PASSIVE (an error frame says that the controller counts too many errors, whole cell).
    """

    SILENT = "silent"
    NO_HEARTBEAT = "no-heartbeat"
    FROZEN = "frozen"
    STALE = "stale"
    LIMIT = "limit"
    LOST = "lost"
    LATE = "late"
    DUPLICATE = "duplicate"
    SHORT_PDO = "short-pdo"
    WRONG_COB_ID = "wrong-cob-id"
    SHIFTED = "shifted"
    REFUSES_NMT = "refuses-nmt"
    REFUSES_MAPPING = "refuses-mapping"
    OTHER_SERIAL = "other-serial"
    NO_GUARD = "no-guard"
    REFUSES_WRITE = "refuses-write"
    REFUSES_SAVE = "refuses-save"
    SECOND_MASTER = "second-master"
    SDO_MASTER = "sdo-master"
    SYNC_PRODUCER = "sync-producer"
    EMERGENCY = "emergency"
    FOLLOWING_ERROR = "following-error"
    FALLS_BACK = "falls-back"
    REBOOTS = "reboots"
    LOSES_POWER = "loses-power"
    BUS_OFF = "bus-off"
    ERROR_PASSIVE = "error-passive"


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One fault.

    Attributes:
        kind: what goes wrong.
        axis: index from 0, or None for all.
        at_cycle: number of the SYNC since power-on that it comes with; 0 is from power-on.
        cycles: how many it lasts, None for ever.
        value: EMCY code (EMERGENCY).
    """

    kind: FaultKind
    axis: int | None = None
    at_cycle: int = 0
    cycles: int | None = None
    value: int = 0

    def active(self, cycle: int) -> bool:
        """Whether it lasts in this cycle."""
        return self.at_cycle <= cycle and (self.cycles is None or cycle < self.at_cycle + self.cycles)

    def concerns(self, axis: int) -> bool:
        """Whether it is on this axis."""
        return self.axis is None or self.axis == axis
