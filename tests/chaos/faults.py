"""The faults of each round, drawn from a seed: kind, moment and size;
nothing here touches a bus or a process.

Nothing of the product is imported either: the judgement builds on this module.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from random import Random

NODES = range(1, 7)


class Act(Enum):
    """A fault from outside the cell."""

    RECORDER_KILL = "recorder killed"
    RECORDER_PAUSE = "recorder stopped for 30 to 300 ms"
    RECORDER_HANG = "recorder stopped for 5 s"
    RECORDER_INT = "Ctrl-C"
    RECORDER_INT_TWICE = "Ctrl-C twice"
    RECORDER_TERM = "SIGTERM"
    CAPTURE_KILL = "capture process killed"
    CAPTURE_PAUSE = "capture process stopped for 30 to 300 ms"
    CAPTURE_HANG = "capture process stopped for 5 s"
    CAPTURE_INT = "Ctrl-C at the capture process"
    CELL_KILL = "cell killed"
    CELL_PAUSE = "cell stopped for 30 to 300 ms"
    CELL_HANG = "cell stopped for 5 s"
    CELL_INT = "cell ended"
    FLOOD = "flood of an unused identifier"
    SYNC = "foreign SYNC"
    NMT = "foreign NMT"
    HEARTBEAT = "foreign heartbeat with the recorder's id"
    TWIN = "answers of a second node"
    TWIN_SHORT = "short answers of a second node"
    TWIN_SDO = "SDO answers of a second node"
    EMCY = "foreign EMCY of an axis"
    SDO_MASTER = "SDO requests of another master"
    SETPOINT = "set-points of another master"
    NOISE = "remote and extended frames"
    ERROR_PASSIVE = "error frame: passive"
    BUS_OFF = "error frame: bus-off"
    LINK_DOWN = "interface down and up"
    LSS = "layer setting service"
    DISK_FULL = "disk of the log full"
    SCREEN_STOPPED = "reader of the screen stopped"
    SCREEN_CLOSED = "reader of the screen gone"
    TERMINAL_CLOSED = "terminal closed"
    CLOCK_STEP = "clock stepped while recording"
    CLOCK_WRONG = "clock wrong in a write"
    SDO_ABORT = "SDO abort at set-up"
    ID_TAKEN = "device that takes the recorder's id"
    NO_PERMISSION = "recorder without permission to move"
    AUDIT_DELETED = "audit log deleted between jobs"
    AUDIT_CUT = "last entry of the audit log removed between jobs"
    WRITE_KILL = "write killed"


class Inside(Enum):
    """A fault that the simulated cell makes by itself, under its name in simulation files.

    Those of its bus come from outside, and those from power-on are in tests/faults.
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
    SECOND_MASTER = "second-master"
    SDO_MASTER = "sdo-master"
    EMERGENCY = "emergency"
    FOLLOWING_ERROR = "following-error"
    FALLS_BACK = "falls-back"
    REBOOTS = "reboots"
    LOSES_POWER = "loses-power"


ONCE = frozenset(
    {
        Inside.EMERGENCY,
        Inside.FOLLOWING_ERROR,
        Inside.FALLS_BACK,
        Inside.REBOOTS,
        Inside.LOSES_POWER,
    }
)
KINDS: tuple[Act | Inside, ...] = (*Act, *Inside)
KERNEL_ONLY = frozenset(
    {
        Act.CAPTURE_KILL,
        Act.CAPTURE_PAUSE,
        Act.CAPTURE_HANG,
        Act.CAPTURE_INT,
        Act.ERROR_PASSIVE,
        Act.BUS_OFF,
        Act.LINK_DOWN,
    }
)
"""Acts that need the kernel's CAN: a hub has no interface, no error frames,
and no capture process reads it.
"""
NEEDS_CLOCK = frozenset({Act.CLOCK_STEP, Act.CLOCK_WRONG})
FROM_START = frozenset({Act.SDO_ABORT, Act.NO_PERMISSION})
"""Acts that are there from the start of the recorder on."""
AFTERWARDS = frozenset({Act.CLOCK_WRONG, Act.AUDIT_DELETED, Act.AUDIT_CUT, Act.WRITE_KILL})
"""Acts between the recording and the write that follows it, or in that write."""
CLOCK_STEPS_DAYS = (-730, -3, 3, 730)
SETUP_OBJECTS = (
    (0x1000, 0),
    (0x1016, 0),
    (0x1016, 1),
    (0x1017, 0),
    (0x1018, 1),
    (0x1018, 2),
    (0x1018, 4),
    (0x1400, 1),
    (0x1400, 2),
    (0x1600, 0),
    (0x1600, 1),
    (0x1800, 1),
    (0x1800, 2),
    (0x1A00, 0),
    (0x1A00, 1),
    (0x1A00, 2),
    (0x1A00, 3),
    (0x6007, 0),
    (0x6040, 0),
    (0x6041, 0),
    (0x6060, 0),
    (0x6061, 0),
    (0x6064, 0),
    (0x6075, 0),
    (0x607A, 0),
    (0x6081, 0),
    (0x6083, 0),
)
"""Objects that the set-up of a drive reads or writes (CiA 301, CiA 402);
an SDO abort meets one of them.
"""
WHOLE_CELL = frozenset({Inside.SECOND_MASTER})
#: Share of the faults whose moment counts from the first set-point; the others' from the start
IN_MOTION = 0.75
MOTION_S, RUN_S = 3.5, 8.0  #: Latest moments
SHORT_S, LONG_S, HANG_S = (0.03, 0.3), (0.5, 4.0), 5.0  #: How long acts last
CYCLES = range(20, 230)  #: SYNCs from power-on to a fault of the cell
EMCY_CODES = (0x2310, 0x3210, 0x4310, 0x5530, 0x7305, 0x8611, 0xFF01)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault."""

    kind: Act | Inside  #: an act from outside, or a fault that the cell makes by itself
    #: whether `at_s` counts from the first set-point, not from the start of the recorder
    in_motion: bool
    at_s: float  #: moment of an act [s]
    #: how long a process is stopped, the interface down, a flood or a full disk lasts [s]
    for_s: float
    node: int  #: node id that it concerns
    times: int  #: number of frames
    gap_s: float  #: time between two of them [s]
    value: int  #: EMCY code, NMT command, or any number that makes the data of a frame
    at_cycle: int  #: SYNC since power-on at which a fault of the cell begins
    cycles: int | None  #: how many SYNCs a fault of the cell lasts; None is without end

    @property
    def name(self) -> str:
        """For the table of faults."""
        if isinstance(self.kind, Act):
            return self.kind.value
        return f"cell: {self.kind.value}"

    def __str__(self) -> str:
        if self.kind in FROM_START:
            return f"{self.name}, node {self.node}"
        if self.kind in AFTERWARDS:
            return self.name
        if isinstance(self.kind, Act):
            if self.in_motion:
                since = "the first set-point"
            else:
                since = "its start"
            return f"{self.name}, {self.at_s:.3f} s after {since}"
        return f"{self.name}, node {self.node}, SYNC {self.at_cycle}, {self.cycles or 'all'} cycles"

    @property
    def clock_step_s(self) -> int:
        """Step of the clock [s]."""
        return 86_400 * self.value

    @property
    def aborted(self) -> tuple[int, int]:
        """Index and sub-index of the object that an SDO abort meets."""
        return SETUP_OBJECTS[self.value % len(SETUP_OBJECTS)]

    def entry(self) -> str:
        """The line of a simulation file for a fault of the cell."""
        words = [f"fault: {self.kind.value}", f"at_cycle: {self.at_cycle}"]
        if self.kind not in WHOLE_CELL:
            words.append(f"axis: J{self.node}")
        if self.cycles is not None:
            words.append(f"cycles: {self.cycles}")
        if self.kind is Inside.EMERGENCY:
            words.append(f"emcy_code: {self.value:#x}")
        return f"  - {{{', '.join(words)}}}\n"


def rounds(seed: int, kinds: Sequence[Act | Inside] = KINDS) -> Iterator[tuple[Fault, ...]]:
    """Yield the faults of each round, without end: every kind comes before one comes again."""
    random = Random(seed)
    deck: list[Act | Inside] = []
    while True:
        faults = []
        for _ in range(random.choices((1, 2, 3), weights=(6, 3, 1))[0]):
            if not deck:
                deck = list(kinds)
                random.shuffle(deck)
            faults.append(_draw(random, deck.pop()))
        yield tuple(faults)


def _draw(random: Random, kind: Act | Inside) -> Fault:
    in_motion = random.random() < IN_MOTION
    hang = kind in (Act.RECORDER_HANG, Act.CAPTURE_HANG, Act.CELL_HANG)
    value = random.randrange(1 << 31)
    if kind in (Act.EMCY, Inside.EMERGENCY):
        value = random.choice(EMCY_CODES)
    elif kind in NEEDS_CLOCK:
        value = random.choice(CLOCK_STEPS_DAYS)
    elif kind is Act.NMT:
        value = random.choice((0x01, 0x02, 0x80, 0x81, 0x82))
    short = random.random() < 0.5
    duration_s = SHORT_S
    if kind in (Act.FLOOD, Act.DISK_FULL, Act.SCREEN_STOPPED):
        duration_s = LONG_S
    if kind in ONCE:
        cycles = None
    else:
        cycles = 1 if short else random.randrange(2, 60)
    return Fault(
        kind,
        in_motion,
        at_s=random.uniform(0.0, MOTION_S if in_motion else RUN_S),
        for_s=HANG_S if hang else random.uniform(*duration_s),
        node=random.choice(NODES),
        times=1 if random.random() < 0.5 else random.randrange(2, 30),
        gap_s=random.choice((0.0, 0.003, 0.02)),
        value=value,
        at_cycle=random.choice(CYCLES),
        cycles=cycles,
    )
