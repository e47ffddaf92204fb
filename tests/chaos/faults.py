"""The faults of each round, drawn from a seed: kind, moment and size; nothing here touches a bus or a process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from random import Random

from drivers.simulation.faults import FaultKind

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


INSIDE = (
    FaultKind.SILENT,
    FaultKind.NO_HEARTBEAT,
    FaultKind.FROZEN,
    FaultKind.STALE,
    FaultKind.LIMIT,
    FaultKind.LOST,
    FaultKind.LATE,
    FaultKind.DUPLICATE,
    FaultKind.SHORT_PDO,
    FaultKind.WRONG_COB_ID,
    FaultKind.SHIFTED,
    FaultKind.SECOND_MASTER,
    FaultKind.SDO_MASTER,
    FaultKind.EMERGENCY,
    FaultKind.FOLLOWING_ERROR,
    FaultKind.FALLS_BACK,
    FaultKind.REBOOTS,
    FaultKind.LOSES_POWER,
)
"""Faults that the simulated cell makes by itself; those of its bus come from outside, and those from power-on are in
tests/faults."""
ONCE = frozenset(
    {FaultKind.EMERGENCY, FaultKind.FOLLOWING_ERROR, FaultKind.FALLS_BACK, FaultKind.REBOOTS, FaultKind.LOSES_POWER}
)
WHOLE_CELL = frozenset({FaultKind.SECOND_MASTER})
IN_MOTION = 0.75  #: Share of the faults whose moment counts from the first set-point; the others' from the start
MOTION_S, RUN_S = 3.5, 8.0  #: Latest moments
CYCLES = range(20, 330)  #: SYNCs from power-on to a fault of the cell
EMCY_CODES = (0x2310, 0x3210, 0x4310, 0x5530, 0x7305, 0x8611, 0xFF01)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault."""

    kind: Act | FaultKind  #: an act from outside, or a fault that the cell makes by itself
    in_motion: bool  #: whether `at_s` counts from the first set-point, not from the start of the recorder
    at_s: float  #: moment of an act [s]
    for_s: float  #: how long a process is stopped, the interface down, a flood or a full disk lasts [s]
    node: int  #: node id that it concerns
    times: int  #: number of frames
    gap_s: float  #: time between two of them [s]
    value: int  #: EMCY code, NMT command, or any number that makes the data of a frame
    at_cycle: int  #: SYNC since power-on at which a fault of the cell begins
    cycles: int | None  #: how many SYNCs a fault of the cell lasts; None is without end

    @property
    def name(self) -> str:
        """For the table of faults."""
        return self.kind.value if isinstance(self.kind, Act) else f"cell: {self.kind.value}"

    def __str__(self) -> str:
        if isinstance(self.kind, Act):
            since = "the first set-point" if self.in_motion else "its start"
            return f"{self.name}, {self.at_s:.3f} s after {since}"
        return f"{self.name}, node {self.node}, SYNC {self.at_cycle}, {self.cycles or 'all'} cycles"

    def entry(self) -> str:
        """The line of a simulation file for a fault of the cell."""
        words = [f"fault: {self.kind.value}", f"at_cycle: {self.at_cycle}"]
        words += [] if self.kind in WHOLE_CELL else [f"axis: J{self.node}"]
        words += [] if self.cycles is None else [f"cycles: {self.cycles}"]
        words += [f"emcy_code: {self.value:#x}"] if self.kind is FaultKind.EMERGENCY else []
        return f"  - {{{', '.join(words)}}}\n"


def rounds(seed: int) -> Iterator[tuple[Fault, ...]]:
    """Yield the faults of each round, without end: every kind comes before one comes again."""
    random = Random(seed)
    deck: list[Act | FaultKind] = []
    while True:
        faults = []
        for _ in range(random.choices((1, 2, 3), weights=(6, 3, 1))[0]):
            if not deck:
                deck = [*Act, *INSIDE]
                random.shuffle(deck)
            faults.append(_draw(random, deck.pop()))
        yield tuple(faults)


def _draw(random: Random, kind: Act | FaultKind) -> Fault:
    in_motion = random.random() < IN_MOTION
    hang = kind in (Act.RECORDER_HANG, Act.CAPTURE_HANG, Act.CELL_HANG)
    value = random.randrange(1 << 31)
    if kind in (Act.EMCY, FaultKind.EMERGENCY):
        value = random.choice(EMCY_CODES)
    elif kind is Act.NMT:
        value = random.choice((0x01, 0x02, 0x80, 0x81, 0x82))
    short = random.random() < 0.5
    cycles = None if kind in ONCE else (1 if short else random.randrange(2, 60))
    return Fault(
        kind,
        in_motion,
        at_s=random.uniform(0.0, MOTION_S if in_motion else RUN_S),
        for_s=5.0 if hang else random.uniform(*((0.5, 4.0) if kind in (Act.FLOOD, Act.DISK_FULL) else (0.03, 0.3))),
        node=random.choice(NODES),
        times=1 if random.random() < 0.5 else random.randrange(2, 30),
        gap_s=random.choice((0.0, 0.003, 0.02)),
        value=value,
        at_cycle=random.choice(CYCLES),
        cycles=cycles,
    )
