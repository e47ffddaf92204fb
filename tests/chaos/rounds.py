"""One round: a cell, a recorder, faults at their moments, and the judgement of what is left of it.

Five things must hold whatever the faults were: (a) no value is in the log that was not on the bus, (b) every loss is
counted, (c) the axes stop within their bound, (d) settings are restored, and the bus can be used again, (e) the exit
code is that of the fault, without a traceback.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random

from daq.errors import ExitCode
from daq.workflow.record import SPACE_CHECK_S
from drivers.simulation.faults import FaultKind
from drivers.stream.watch import LIMIT_S
from tests.chaos.faults import MOTION_S, NODES, Act, Fault
from tests.chaos.processes import FRAME, Objects, Verb, frame, raw
from tests.vcan.judgement import FEEDBACK, SYNC, TPDO1, compare, read_recorded
from tests.vcan.listener import Frame, heard, listening
from tests.vcan.run import INTERFACE
from tests.vcan.test_stalls import FLOOD

RPDO1, HEARTBEAT, LOWEST_RECORDER, HIGHEST_ID = 0x200, 0x700, 112, 127
LSS_REQUEST = 0x7E5  # CiA 305: switch state global, to configuration
DISK_MB = 80  #: More than a recording wants free before it moves (`daq.workflow.safeguards`)
NEW_SETPOINT = 0x10  #: Bit of the controlword, which is behind the target in RPDO1
ERROR_PASSIVE = (0x2000_0004, bytes((0, 0x30, 0, 0, 0, 0, 0, 0)))  # linux/can/error.h
BUS_OFF = (0x2000_0040, bytes(8))
FLOOD_HZ = 4000
START_S, RUN_S = 60.0, 90.0  #: A round is broken off after so long
CYCLE_S, GUARD_S, LATENESS_S = 0.02, 0.5, 1.0
ALLOWANCE_S = 0.4
"""For a guest whose host gives its time to others; the latest of some 50 measured stops came 0.17 s after its bound."""


@dataclass(frozen=True, slots=True)
class Stop:
    """The stop that a fault in motion must lead to (docs/reference/faults.md)."""

    bound_s: float  #: from the fault to the last answer of an enabled axis, without allowance [s]
    least_s: float = 0.0  #: a stopped process must last so long for it [s]
    least_cycles: int = 0  #: a fault of the cell must last so many cycles for it
    least_times: int = 0  #: so many frames must come for it
    lasts: bool = False  #: the bound counts from the end of the act

    def due(self, fault: Fault) -> bool:
        """Whether the fault lasts long enough."""
        enough = fault.cycles is None or fault.cycles >= self.least_cycles
        return enough and fault.for_s >= self.least_s and fault.times >= self.least_times


PROMPT, UNANSWERED_S = Stop(2 * CYCLE_S), 4 * CYCLE_S
STOPS: dict[Act | FaultKind, Stop] = {
    Act.RECORDER_KILL: Stop(GUARD_S),
    Act.RECORDER_HANG: Stop(GUARD_S),
    Act.RECORDER_INT: PROMPT,
    Act.RECORDER_INT_TWICE: PROMPT,
    Act.RECORDER_TERM: PROMPT,
    Act.CAPTURE_KILL: PROMPT,
    Act.CAPTURE_HANG: Stop(LATENESS_S),
    Act.CELL_KILL: PROMPT,
    Act.CELL_PAUSE: Stop(UNANSWERED_S, least_s=0.15, lasts=True),
    Act.CELL_HANG: Stop(UNANSWERED_S, lasts=True),
    Act.CELL_INT: PROMPT,
    # The kernel does not distinguish the SYNC of another program on this machine from the recorder's own: the
    # recorder notices when there are four or five too many (`drivers.stream.sync.SURPLUS`).
    Act.SYNC: Stop(7 * CYCLE_S, least_times=6),
    Act.NMT: PROMPT,
    Act.HEARTBEAT: PROMPT,
    Act.EMCY: PROMPT,
    Act.SETPOINT: PROMPT,
    Act.LSS: PROMPT,
    Act.BUS_OFF: Stop(GUARD_S),
    Act.LINK_DOWN: Stop(GUARD_S),
    Act.DISK_FULL: Stop(SPACE_CHECK_S + 2 * CYCLE_S),
    FaultKind.EMERGENCY: PROMPT,
    FaultKind.FOLLOWING_ERROR: PROMPT,
    FaultKind.FALLS_BACK: PROMPT,
    FaultKind.REBOOTS: PROMPT,
    FaultKind.LOSES_POWER: PROMPT,
    FaultKind.SECOND_MASTER: Stop(7 * CYCLE_S, least_cycles=6),
    FaultKind.NO_HEARTBEAT: Stop(0.33, least_cycles=25),
    FaultKind.LIMIT: Stop(LIMIT_S + 2 * CYCLE_S, least_cycles=30),
    FaultKind.FROZEN: Stop(0.06 + CYCLE_S, least_cycles=25),
    FaultKind.STALE: Stop(0.06 + CYCLE_S, least_cycles=25),
    FaultKind.SHORT_PDO: Stop(3 * CYCLE_S, least_cycles=3),
    FaultKind.WRONG_COB_ID: Stop(UNANSWERED_S, least_cycles=6),
    FaultKind.LOST: Stop(UNANSWERED_S, least_cycles=6),
    FaultKind.SILENT: Stop(UNANSWERED_S, least_cycles=6),
}
"""All other faults are counted or reported, without a stop."""
HOLDS_UP_S = {
    Act.CELL_HANG: 6.0,
    Act.CAPTURE_HANG: LATENESS_S,
    Act.RECORDER_HANG: GUARD_S,
    Act.RECORDER_KILL: GUARD_S,
    Act.CELL_PAUSE: 0.3,
    Act.CAPTURE_PAUSE: 0.3,
    Act.RECORDER_PAUSE: 0.3,
}
"""Time by which an act delays the stop that another fault of its round leads to [s]."""
CODES = {
    Act.RECORDER_KILL: {-signal.SIGKILL},
    Act.RECORDER_INT: {int(ExitCode.INTERRUPTED)},
    Act.RECORDER_INT_TWICE: {int(ExitCode.INTERRUPTED)},
    Act.RECORDER_TERM: {int(ExitCode.INTERRUPTED), -signal.SIGTERM},
    Act.DISK_FULL: {int(ExitCode.UNEXPECTED)},
}
"""Exit codes that each act allows besides ANY_CODES."""
ANY_CODES = {int(ExitCode.OK), int(ExitCode.DATA_UNFIT), int(ExitCode.DEVICE_FAULT)}
UNSTOPPED_CODES = {int(ExitCode.OK), int(ExitCode.DATA_UNFIT)}
"""Exit codes of a recording that came to its end: wrong after a fault that must stop it."""
UNRESTORED = {Act.RECORDER_KILL, Act.RECORDER_INT_TWICE, Act.NMT, FaultKind.REBOOTS}
"""Faults after which a drive may have other settings, and no message reports it: the recorder is gone or gave up, or
the drive was reset."""
UNREACHABLE = {
    FaultKind.SILENT,
    Act.TWIN_SDO,
    Act.BUS_OFF,
    Act.LINK_DOWN,
    Act.CAPTURE_KILL,
    Act.CAPTURE_HANG,
    Act.CAPTURE_INT,
    Act.CELL_PAUSE,
    Act.CELL_HANG,
    Act.RECORDER_INT,
    Act.RECORDER_TERM,
}
"""Faults after which a drive may have other settings if a message names it: it or the bus did not answer for a time."""
NOT_RESTORED = re.compile(r"settings (?:of .{1,200}? )?not restored.*?switch these drives off")
MAY_BE_SILENT = {FaultKind.SILENT, Act.NMT, Act.CELL_KILL, Act.CELL_INT, Act.LINK_DOWN}
GONE = {Act.CELL_KILL, Act.CELL_INT, Act.LINK_DOWN}
"""Faults after which there may be no cell any more."""
ENABLED, POWERED = 0x27, (0x27, 0x07, 0x23)  #: Statuswords under the mask 6Fh: OPERATION ENABLED, all with power
STATUSWORD_MASK = 0x6F


Action = tuple[float, Callable[[], object]]
"""An act and its moment [s]."""


@dataclass
class Round:
    """What happened in a round."""

    faults: Sequence[Fault]  #: that were drawn
    struck: list[tuple[Fault, int]] = field(default_factory=list)  #: acts and when they were made [ns since 1970]
    twins: set[bytes] = field(default_factory=set)  #: data of the frames of a second node
    moved_ns: int = 0  #: time of the first set-point, 0 without one
    ended_ns: int = 1 << 63  #: time of the recorder's end
    frames: list[Frame] = field(default_factory=list)  #: of the listener
    code: int | None = None  #: exit code of the recorder
    said: str = ""  #: its words
    cell: bool = True  #: whether the cell outlived the recorder
    cell_said: str = ""  #: words of the cell
    enabled: list[int] = field(default_factory=list)  #: nodes that are enabled after the guard time
    powered: list[int] = field(default_factory=list)  #: nodes that have power after the time of their stop
    unrestored: list[int] = field(default_factory=list)  #: nodes with other settings than before
    silent: list[int] = field(default_factory=list)  #: nodes that do not answer
    #: Exit code and words of `drivegain scan` afterwards, None where there is no cell any more.
    scanned: tuple[int | None, str] | None = None
    compared: int = 0  #: values that were compared with the bus
    late_s: dict[str, float] = field(default_factory=dict)  #: time from a fault to the stop, less its bound, by name
    violations: list[str] = field(default_factory=list)  #: of what must hold

    @property
    def moments(self) -> list[tuple[Fault, int]]:
        """The faults that came before the end of the recorder, and when [ns since 1970]."""
        syncs = [one.time_ns for one in self.frames if one.identifier == SYNC and one.time_ns < self.ended_ns]
        inside = [fault for fault in self.faults if isinstance(fault.kind, FaultKind) and fault.at_cycle < len(syncs)]
        return [*self.struck, *((fault, syncs[fault.at_cycle]) for fault in inside)]

    @property
    def injected(self) -> list[Fault]:
        """The faults that came before the end of the recorder."""
        return [fault for fault, _ in self.moments]

    @property
    def kinds(self) -> set[Act | FaultKind]:
        """Kinds of the injected faults."""
        return {fault.kind for fault in self.injected}

    @property
    def stopping(self) -> list[tuple[Fault, int]]:
        """The faults in motion that must stop the axes, and when they came [ns since 1970]."""
        end_ns = self.moved_ns + round(MOTION_S * 1e9)
        return [
            (fault, at_ns)
            for fault, at_ns in self.moments
            if 0 < self.moved_ns < at_ns < end_ns and (stop := STOPS.get(fault.kind)) is not None and stop.due(fault)
        ]


def play(faults: Sequence[Fault], folder: Path, cell_file: Path, simulation: str, plan: Path) -> Round:
    """Play one round in an empty folder, and judge it."""
    outcome, log = Round(faults), folder / "disk" / "run.mcap"
    truth = folder / "simulation.yaml"
    inside = "".join(fault.entry() for fault in faults if isinstance(fault.kind, FaultKind))
    truth.write_text(simulation + (f"\nfaults:\n{inside}" if inside else ""), encoding="utf-8")
    with ExitStack() as stack:
        stack.enter_context(_disk(log.parent, folder))
        stack.enter_context(listening(INTERFACE, folder / "frames"))
        arguments = ["simulate", str(truth), "--interface", "socketcan", "--channel", INTERFACE]
        cell = Verb.start(folder / "cell.txt", arguments)
        stack.callback(cell.end)
        _until(lambda: "amplifiers" in cell.said or not cell.running, START_S)
        objects = Objects()
        stack.callback(objects.close)
        before = {node: objects.settings(node) for node in NODES}
        arguments = ["record", str(cell_file), str(plan), "--out", str(log), "--enable-motion", "--operator", "chaos"]
        recorder = Verb.start(folder / "record.txt", [*arguments, "--speed", "0.2"])
        stack.callback(recorder.end)
        _strike(outcome, recorder, cell, log.parent)
        outcome.code, outcome.said = recorder.code, recorder.said
        outcome.cell = cell.running
        if outcome.cell:
            _look(outcome, objects, before)
            scan = Verb.start(folder / "scan.txt", ["scan", str(cell_file)])
            scan.wait(START_S)
            outcome.scanned = (scan.end(), scan.said)
        cell.end(signal.SIGINT)
    outcome.frames, outcome.cell_said = heard(folder / "frames"), cell.said
    judge_log(outcome, folder / log.name)
    judge_stop(outcome)
    judge_end(outcome)
    return outcome


@contextmanager
def _disk(place: Path, kept: Path) -> Iterator[None]:
    """Mount a small disk for the log; the logs are copied from it in the end."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "chaos", str(place)], check=True)
    try:
        yield
    finally:
        for path in place.glob("*.mcap*"):
            shutil.copy(path, kept)
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def _fill(place: Path) -> None:
    """Leave no room on the disk of a folder."""
    filler = place / "filler"
    with filler.open("wb") as out:
        os.posix_fallocate(out.fileno(), 0, shutil.disk_usage(place).free)


def _until(done: Callable[[], bool], seconds: float) -> bool:
    deadline_s = time.monotonic() + seconds
    while not (there := done()) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return there


# -- the faults --------------------------------------------------------------------------------------------------------


def _strike(outcome: Round, recorder: Verb, cell: Verb, disk: Path) -> None:
    """Make the faults at their moments until the recorder has ended, and undo what lasts."""
    begun_s = time.monotonic()
    moved_s, recorder_id = 0.0, HIGHEST_ID
    waiting = [fault for fault in outcome.faults if isinstance(fault.kind, Act)]
    later: list[Action] = []
    with raw(((RPDO1, 0xC000_0780), (HEARTBEAT, 0xC000_0780))) as ear, raw() as mouth:
        ear.setblocking(False)
        while recorder.running and time.monotonic() < begun_s + RUN_S:
            with suppress(BlockingIOError, OSError):
                while True:
                    identifier, _, data = FRAME.unpack(ear.recv(FRAME.size))
                    if identifier >= HEARTBEAT + LOWEST_RECORDER:
                        recorder_id = identifier - HEARTBEAT
                    elif not outcome.moved_ns and identifier & 0x780 == RPDO1 and data[4] & NEW_SETPOINT:
                        outcome.moved_ns, moved_s = time.time_ns(), time.monotonic()
            now_s = time.monotonic()
            for fault in [one for one in waiting if now_s >= _moment_s(one, begun_s, moved_s)]:
                waiting.remove(fault)
                outcome.struck.append((fault, time.time_ns()))
                context = (outcome, recorder, cell, disk, recorder_id, mouth.send)
                later += [(now_s + after_s, action) for after_s, action in _actions(fault, *context)]
            for due in sorted((one for one in later if one[0] <= now_s), key=lambda one: one[0]):
                later.remove(due)
                with suppress(OSError):  # the process has ended, the interface is down
                    due[1]()
            time.sleep(0.002)
        outcome.ended_ns = time.time_ns()
        if recorder.running:
            outcome.violations.append(f"(c) the recorder did not end within {RUN_S:g} s")
            recorder.end()
        # The last undoings come even after the recorder's end.
        for due_s, action in sorted(later, key=lambda one: one[0]):
            time.sleep(max(0.0, min(due_s - time.monotonic(), 5.0)))
            with suppress(OSError):
                action()


def _moment_s(fault: Fault, begun_s: float, moved_s: float) -> float:
    """Moment of a fault by the monotonic clock [s]; infinite while its anchor has not come."""
    if fault.in_motion:
        return moved_s + fault.at_s if moved_s else float("inf")
    return begun_s + fault.at_s


def _actions(
    fault: Fault,
    outcome: Round,
    recorder: Verb,
    cell: Verb,
    disk: Path,
    recorder_id: int,
    send: Callable[[bytes], object],
) -> Iterator[Action]:
    """Yield what a fault does, with the time after it [s]."""
    name = fault.kind.name
    if name.startswith(("RECORDER", "CAPTURE", "CELL")):
        who, _, what = name.partition("_")
        pids = {"RECORDER": [recorder.pid], "CAPTURE": recorder.children(), "CELL": [cell.pid]}[who]
        for pid in pids:
            yield from _signals(pid, what, fault.for_s)
    elif fault.kind is Act.FLOOD:
        flood = subprocess.Popen(
            [sys.executable, "-S", "-c", FLOOD, INTERFACE, str(FLOOD_HZ)], stderr=subprocess.DEVNULL
        )
        yield fault.for_s, flood.kill
        yield fault.for_s, flood.wait
    elif fault.kind is Act.LINK_DOWN:
        for after_s, how in ((0.0, "down"), (fault.for_s, "up")):
            yield after_s, partial(subprocess.run, ["ip", "link", "set", INTERFACE, how], check=True)
    elif fault.kind is Act.DISK_FULL:
        yield 0.0, partial(_fill, disk)
        yield fault.for_s, (disk / "filler").unlink
    else:
        random = Random(fault.value)
        for number in range(fault.times):
            packed = _foreign(fault, recorder_id, random)
            if fault.kind is Act.TWIN:
                outcome.twins.add(packed[8:])
            yield number * fault.gap_s, partial(send, packed)


def _signals(pid: int, what: str, for_s: float) -> Iterator[Action]:
    numbers = {
        "KILL": (signal.SIGKILL,),
        "INT": (signal.SIGINT,),
        "INT_TWICE": (signal.SIGINT, signal.SIGINT),
        "TERM": (signal.SIGTERM,),
        "PAUSE": (signal.SIGSTOP, signal.SIGCONT),
        "HANG": (signal.SIGSTOP, signal.SIGCONT),
    }[what]
    for place, number in enumerate(numbers):
        yield place * max(for_s, 0.4 if what == "INT_TWICE" else 0.0), partial(os.kill, pid, number)


def _foreign(fault: Fault, recorder_id: int, random: Random) -> bytes:
    """Return a frame of another device; each call draws its data anew."""
    node, word = fault.node, random.choice((0x0627, 0x0250, 0x0618))
    feedback = FEEDBACK.pack(random.randrange(-(1 << 20), 1 << 20), random.randrange(-2000, 2000), word)
    identifier, data = {
        Act.SYNC: (SYNC, b""),
        Act.NMT: (0x000, bytes((fault.value & 0xFF, node))),
        Act.HEARTBEAT: (HEARTBEAT + recorder_id, b"\x05"),
        Act.TWIN: (TPDO1 + node, feedback),
        Act.TWIN_SHORT: (TPDO1 + node, feedback[:-1]),
        Act.TWIN_SDO: (0x580 + node, b"\x4b\x41\x60\x00" + feedback[6:] + b"\0\0"),
        Act.EMCY: (0x080 + node, (fault.value & 0xFFFF).to_bytes(2, "little") + b"\x01" + bytes(5)),
        Act.SDO_MASTER: (0x600 + node, b"\x40\x41\x60\x00" + bytes(4)),
        Act.SETPOINT: (RPDO1 + node, feedback[:4] + b"\x0f\x00"),
        Act.LSS: (LSS_REQUEST, bytes((4, 1, *bytes(6)))),
        Act.NOISE: ((TPDO1 + node) | random.choice((0x4000_0000, 0x8000_0000)), feedback),
        Act.ERROR_PASSIVE: ERROR_PASSIVE,
        Act.BUS_OFF: BUS_OFF,
    }[Act(fault.kind)]
    return frame(identifier, data)


# -- what is left ------------------------------------------------------------------------------------------------------


def _look(outcome: Round, objects: Objects, before: dict[int, tuple[int | None, ...]]) -> None:
    """Read states and settings of the axes when nothing disturbs them any more; recorder and faults have ended."""
    time.sleep(GUARD_S + ALLOWANCE_S)
    outcome.enabled = [node for node in NODES if _state(outcome, objects, node) == ENABLED]
    for _ in range(10):
        objects.syncs(20)
        outcome.powered = [node for node in NODES if _state(outcome, objects, node) in POWERED]
        if not outcome.powered:
            break
    for node in NODES:
        with suppress(TimeoutError):
            if node not in outcome.silent and objects.settings(node) != before[node]:
                outcome.unrestored.append(node)


def _state(outcome: Round, objects: Objects, node: int) -> int | None:
    if node in outcome.silent:
        return None
    try:
        return (objects.read(node, 0x6041, 0) or 0) & STATUSWORD_MASK
    except TimeoutError:
        outcome.silent.append(node)
        return None


# -- the judgement -----------------------------------------------------------------------------------------------------


def judge_end(outcome: Round) -> None:
    """Add what is wrong with the state of the cell, the exit code and the words."""
    say, kinds = outcome.violations.append, outcome.kinds
    if not outcome.cell and not kinds & GONE:
        say(f"the simulated cell ended by itself: {outcome.cell_said}")
    if outcome.enabled or outcome.powered:
        say(f"(c) after its end nodes {outcome.enabled} are enabled, nodes {outcome.powered} have power")
    if outcome.unrestored and not kinds & UNRESTORED:
        named = " ".join(NOT_RESTORED.findall(" ".join(outcome.said.split())))
        unnamed = [node for node in outcome.unrestored if not re.search(rf"\bJ{node}\b", named)]
        if unnamed:
            say(f"(d) nodes {unnamed} have other settings than before, and no message reports it: {outcome.said}")
        elif not kinds & UNREACHABLE:
            say(f"(d) nodes {outcome.unrestored} were left with other settings: {outcome.said}")
    if outcome.silent and not kinds & MAY_BE_SILENT:
        say(f"(d) nodes {outcome.silent} do not answer any more")
    if outcome.scanned is not None and outcome.scanned[0] != ExitCode.OK and not kinds & MAY_BE_SILENT:
        say(f"(d) scan ended with {outcome.scanned[0]} afterwards: {outcome.scanned[1]}")
    allowed = ANY_CODES.union(*(CODES.get(kind, set()) for kind in kinds if isinstance(kind, Act)))
    if outcome.code not in allowed:
        say(f"(e) exit code {outcome.code}, expected one of {sorted(allowed)}: {outcome.said}")
    if outcome.code in UNSTOPPED_CODES and outcome.stopping:
        faults = ", ".join(fault.name for fault, _ in outcome.stopping)
        say(f"(e) exit code {outcome.code} after {faults} in motion: {outcome.said}")
    scanned = "" if outcome.scanned is None else outcome.scanned[1]
    for name, words in (("record", outcome.said), ("scan", scanned), ("the cell", outcome.cell_said)):
        if "Traceback" in words:
            say(f"(e) {name} shows a traceback: {words}")


def judge_log(outcome: Round, log: Path) -> None:
    """Add what is wrong with the log, whole or unfinished."""
    path = next((one for one in (log, log.with_name(f"{log.name}.part")) if one.exists()), None)
    recorded = None if path is None or path.stat().st_size == 0 else read_recorded(path)
    if recorded is None:
        return
    syncs = [place for place, one in enumerate(outcome.frames) if one.identifier == SYNC]
    foreign = outcome.kinds & {Act.SYNC, FaultKind.SECOND_MASTER}
    found = compare(recorded, outcome.frames, foreign_syncs=syncs if foreign else ())
    outcome.compared = found.values
    outcome.violations += [f"(a, b) {line}" for line in found.violations[:5]]
    if len(found.violations) > 5:
        outcome.violations.append(f"(a, b) and {len(found.violations) - 5} more")


def judge_stop(outcome: Round) -> None:
    """Add the faults in motion after which an axis answered as enabled beyond the bound."""
    repeating = {fault.node for fault in outcome.injected if fault.kind is FaultKind.STALE}
    enabled = [
        one.time_ns
        for one in outcome.frames
        if one.identifier & ~0x7F == TPDO1
        and one.identifier & 0x7F in NODES
        and one.identifier & 0x7F not in repeating
        and len(one.data) == FEEDBACK.size
        and one.data not in outcome.twins
        and FEEDBACK.unpack(one.data)[2] & STATUSWORD_MASK == ENABLED
    ]
    for fault, at_ns in outcome.stopping:
        stop, last_s = STOPS[fault.kind], (max(enabled, default=0) - at_ns) * 1e-9
        bound_s = stop.bound_s + (fault.for_s if stop.lasts else 0.0)
        held_up_s = sum(HOLDS_UP_S.get(kind, 0.0) for kind in outcome.kinds - {fault.kind} if isinstance(kind, Act))
        if last_s > 0.0:
            outcome.late_s[fault.name] = max(last_s - bound_s - held_up_s, outcome.late_s.get(fault.name, -1e9))
        if last_s > bound_s + held_up_s + ALLOWANCE_S:
            outcome.violations.append(f"(c) {fault.name}: an axis is enabled {last_s:.2f} s after it")
