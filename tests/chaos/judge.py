"""The judgement of a round, by what a listener, the files and the exit codes show:
nothing of the product is imported.

The listener must have heard the bus: one that heard nothing shows no violation. Eight things must
hold whatever the faults were: (a) no value is in the log that was not on the bus, (b) every loss is
counted, (c) the axes stop within their bound, (d) settings are restored, and the bus can be used
again, (e) the exit code is one that the faults, or a stall on the bus, explain, without a
traceback, (f) nothing moves without permission, (g) the controller's file is whole: all gains are
those of one write, and nothing else has changed, (h) the chain of the audit log is unbroken, and
what was removed from it is reported.

Frames are decoded by the identifiers and layouts of CiA 301 and of the drives' data sheet, logs by
the `mcap` package, the chain by hashlib. Bounds and exit codes are those that the documentation
states (docs/reference/faults.md, docs/reference/exit-codes.md), written down here again: a number
that changes in the product alone is a violation.
"""

from __future__ import annotations

import hashlib
import json
import re
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

from tests.chaos.faults import AFTERWARDS, MOTION_S, NODES, Act, Fault, Inside
from tests.vcan.judgement import FEEDBACK, SAME_SYNC_NS, SYNC, TPDO1, compare
from tests.vcan.listener import Frame
from tests.vcan.log_reader import read_recorded

RPDO1 = 0x200
NEW_SETPOINT = 0x10  #: Bit of the controlword, which is behind the target in RPDO1
TARGET_BYTES = 4
HEARTBEAT_CONSUMER = 0x1016
CYCLE_S = 0.02
GUARD_S = 0.5
LATENESS_S = 1.0
LIMIT_S = 0.5  #: An active limit ends a run after so long
SPACE_CHECK_S = 0.1  #: Time between two looks at the free space of the disk
ALLOWANCE_S = 0.4
"""For a guest whose host gives its time to others;
the latest of some 50 measured stops came 0.17 s after its bound.
"""


class ExitCode(IntEnum):
    """Exit codes of drivegain (docs/reference/exit-codes.md)."""

    OK = 0
    UNEXPECTED = 1
    USAGE = 2
    CALIBRATION_REFUSED = 3
    DATA_UNFIT = 4
    DEVICE_FAULT = 5
    NOT_RELEASED = 11
    INTERRUPTED = 130


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


PROMPT = Stop(2 * CYCLE_S)
UNANSWERED_S = 4 * CYCLE_S
STOPS: dict[Act | Inside, Stop] = {
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
    # The kernel does not distinguish the SYNC of another program on this machine from the
    # recorder's own: the recorder notices when there are four or five too many
    # (`drivers.stream.sync.SURPLUS`).
    Act.SYNC: Stop(7 * CYCLE_S, least_times=6),
    Act.NMT: PROMPT,
    Act.HEARTBEAT: PROMPT,
    Act.EMCY: PROMPT,
    Act.SETPOINT: PROMPT,
    Act.LSS: PROMPT,
    Act.ID_TAKEN: PROMPT,
    Act.TERMINAL_CLOSED: PROMPT,
    Act.BUS_OFF: Stop(GUARD_S),
    Act.LINK_DOWN: Stop(GUARD_S),
    Act.DISK_FULL: Stop(SPACE_CHECK_S + 2 * CYCLE_S),
    Inside.EMERGENCY: PROMPT,
    Inside.FOLLOWING_ERROR: PROMPT,
    Inside.FALLS_BACK: PROMPT,
    Inside.REBOOTS: PROMPT,
    Inside.LOSES_POWER: PROMPT,
    Inside.SECOND_MASTER: Stop(7 * CYCLE_S, least_cycles=6),
    Inside.NO_HEARTBEAT: Stop(0.33, least_cycles=25),
    Inside.LIMIT: Stop(LIMIT_S + 2 * CYCLE_S, least_cycles=30),
    Inside.FROZEN: Stop(0.06 + CYCLE_S, least_cycles=25),
    Inside.STALE: Stop(0.06 + CYCLE_S, least_cycles=25),
    Inside.SHORT_PDO: Stop(3 * CYCLE_S, least_cycles=3),
    Inside.WRONG_COB_ID: Stop(UNANSWERED_S, least_cycles=6),
    Inside.LOST: Stop(UNANSWERED_S, least_cycles=6),
    Inside.SILENT: Stop(UNANSWERED_S, least_cycles=6),
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
    Act.SCREEN_CLOSED: {int(ExitCode.UNEXPECTED)},
    Act.NO_PERMISSION: {int(ExitCode.USAGE)},
    Act.TERMINAL_CLOSED: {int(ExitCode.UNEXPECTED), int(ExitCode.INTERRUPTED), -signal.SIGHUP},
}
"""Exit codes that each act allows besides those of SPOILS and STOPS_RUN."""
SPOILS = {
    Act.RECORDER_PAUSE,
    Act.RECORDER_HANG,
    Act.CAPTURE_KILL,
    Act.CAPTURE_PAUSE,
    Act.CAPTURE_HANG,
    Act.CAPTURE_INT,
    Act.CELL_KILL,
    Act.CELL_PAUSE,
    Act.CELL_HANG,
    Act.CELL_INT,
    Act.FLOOD,
    Act.SYNC,
    Act.NMT,
    Act.TWIN,
    Act.TWIN_SHORT,
    Act.ERROR_PASSIVE,
    Act.BUS_OFF,
    Act.LINK_DOWN,
    Inside.SILENT,
    Inside.FROZEN,
    Inside.STALE,
    Inside.LIMIT,
    Inside.LOST,
    Inside.LATE,
    Inside.DUPLICATE,
    Inside.SHORT_PDO,
    Inside.WRONG_COB_ID,
    Inside.SHIFTED,
    Inside.SECOND_MASTER,
}
"""Faults that damage or delay samples, so that a recording may end as unfit."""
OWN_ENDS = {
    Act.RECORDER_KILL,
    Act.RECORDER_INT,
    Act.RECORDER_INT_TWICE,
    Act.RECORDER_TERM,
    Act.TERMINAL_CLOSED,
    Act.DISK_FULL,
}
"""Faults that stop the axes with exit codes of their own."""
STOPS_RUN = (set(STOPS) - OWN_ENDS) | {
    Act.RECORDER_PAUSE,
    Act.CAPTURE_PAUSE,
    Act.CAPTURE_INT,
    Act.FLOOD,
    Act.TWIN,
    Act.TWIN_SHORT,
    Act.TWIN_SDO,
    Act.SDO_MASTER,
    Act.SDO_ABORT,
    Inside.SDO_MASTER,
}
"""Faults of a device or of the bus, after which a recording may end as a device fault."""
LATE_CYCLES = 1.5
SILENT_CYCLES = 3
"""Cycles without a SYNC on the bus, or without an answer of an axis, that explain unfit data and a
device fault: a busy host stalls recorder and cell. The listener shows it, not the recorder's words.
"""
UNSTOPPED_CODES = {int(ExitCode.OK), int(ExitCode.DATA_UNFIT)}
"""Exit codes of a recording that came to its end: wrong after a fault that must stop it."""
UNREAD = {Act.SCREEN_CLOSED, Act.TERMINAL_CLOSED}
"""Acts after which nobody reads what the recorder says."""
WRITE_CODES = {int(ExitCode.OK), int(ExitCode.CALIBRATION_REFUSED)}
"""Exit codes of a write whose clock is wrong: the ages of what it reads may refuse it."""
UNRESTORED = {Act.RECORDER_KILL, Act.RECORDER_INT_TWICE, Act.NMT, Inside.REBOOTS}
"""Faults after which a drive may have other settings, and no message reports it:
the recorder is gone or gave up, or the drive was reset.
"""
UNREACHABLE = {
    Inside.SILENT,
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
    Act.SDO_ABORT,
}
"""Faults after which a drive may have other settings if a message names it:
it or the bus did not answer for a time.
"""
NOT_RESTORED = re.compile(r"settings (?:of .{1,200}? )?not restored.*?switch these drives off")
MAY_BE_SILENT = {Inside.SILENT, Act.NMT, Act.CELL_KILL, Act.CELL_INT, Act.LINK_DOWN}
FOREIGN_MASTERS = {Inside.SECOND_MASTER, Inside.SDO_MASTER}
"""Faults of the cell that may last on after the recorder's end:
a scan that finds them refuses, and says so.
"""
FOREIGN = "that we did not send"
GONE = {Act.CELL_KILL, Act.CELL_INT, Act.LINK_DOWN}
"""Faults after which there may be no cell any more."""
GAIN = re.compile(r"^(\s*gain:\s*)(\S+)", re.MULTILINE)
"""The gain of a drive in the controller's file, and what is before it on the line."""
DIGEST = re.compile(r',"sha256":"([0-9a-f]{64})"')
CHAIN_KEYS = ("previous", "sha256")
FIRST = "0" * 64  #: Digest before the first entry of an audit log
#: Statuswords under the mask 6Fh: OPERATION ENABLED, all with power
ENABLED, POWERED = 0x27, (0x27, 0x07, 0x23)
STATUSWORD_MASK = 0x6F


@dataclass(frozen=True)
class Written:
    """A verb on the controller's file or the audit log."""

    verb: str
    code: int | None  #: exit code, minus the signal that ended it
    said: str  #: its words
    right_clock: bool = True
    killed: bool = False


@dataclass(frozen=True)
class FilesSeen:
    """Files after a write."""

    controller: str  #: text of the controller's file
    audit: str  #: text of the audit log, empty where it is absent
    #: whether a writer was killed, which may leave an unfinished line at the end
    torn: bool = False


@dataclass
class Round:
    """What happened in a round."""

    faults: Sequence[Fault]  #: that were drawn
    #: acts and when they were made [ns since 1970]
    struck: list[tuple[Fault, int]] = field(default_factory=list)
    twins: set[bytes] = field(default_factory=set)  #: data of the frames of a second node
    moved_ns: int = 0  #: time of the first set-point, 0 without one
    ended_ns: int = 1 << 63  #: time of the recorder's end
    frames: list[Frame] = field(default_factory=list)  #: of the listener
    code: int | None = None  #: exit code of the recorder
    said: str = ""  #: its words
    cell: bool = True  #: whether the cell outlived the recorder
    cell_said: str = ""  #: words of the cell
    enabled: list[int] = field(default_factory=list)  #: nodes that are enabled after the guard time
    #: nodes that have power after the time of their stop
    powered: list[int] = field(default_factory=list)
    unrestored: list[int] = field(default_factory=list)  #: nodes with other settings than before
    silent: list[int] = field(default_factory=list)  #: nodes that do not answer
    permitted: bool = True  #: whether the recorder was allowed to move the axes
    began_ns: int = 0  #: time at which the recorder began
    #: by how much its wall clock may have been off at its start
    clock_steps_ns: tuple[int, ...] = (0,)
    #: writes of gains around the recording, in their order
    written: list[Written] = field(default_factory=list)
    #: controller's file and audit log, after each of them
    files: list[FilesSeen] = field(default_factory=list)
    #: Exit code and words of `drivegain scan` afterwards, None where there is no cell any more.
    scanned: tuple[int | None, str] | None = None
    compared: int = 0  #: values that were compared with the bus
    #: of these, of the cycle before or after, in a log that is refused for that
    neighbours: int = 0
    #: time from a fault to the stop, less its bound, by name
    late_s: dict[str, float] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)  #: of what must hold

    @property
    def moments(self) -> list[tuple[Fault, int]]:
        """The faults that came before the end of the recorder, and when [ns since 1970]."""
        syncs = [
            one.time_ns
            for one in self.frames
            if one.identifier == SYNC and one.time_ns < self.ended_ns
        ]
        inside = [
            fault
            for fault in self.faults
            if isinstance(fault.kind, Inside) and fault.at_cycle < len(syncs)
        ]
        return [*self.struck, *((fault, syncs[fault.at_cycle]) for fault in inside)]

    @property
    def injected(self) -> list[Fault]:
        """The faults that came before the end of the recorder."""
        return [fault for fault, _ in self.moments]

    @property
    def kinds(self) -> set[Act | Inside]:
        """Kinds of the injected faults."""
        return {fault.kind for fault in self.injected}

    @property
    def stopping(self) -> list[tuple[Fault, int]]:
        """The faults in motion that must stop the axes, and when they came [ns since 1970]."""
        end_ns = self.moved_ns + round(MOTION_S * 1e9)
        return [
            (fault, at_ns)
            for fault, at_ns in self.moments
            if 0 < self.moved_ns < at_ns < end_ns
            and (stop := STOPS.get(fault.kind)) is not None
            and stop.due(fault)
        ]


# -- the judgement
# ------------------------------------------------------------------------------------------------


def judge(
    outcome: Round,
    log: Path,
    before: str,
    gains: Sequence[Sequence[float]],
    same_sync_ns: int = SAME_SYNC_NS,
    in_order: bool = False,
) -> None:
    """Add all violations to a round.

    Args:
        outcome: what was seen.
        log: final name of the log; it may be unfinished or absent.
        before: controller's file before any write.
        gains: what the writes of the round had to write, all gains of one write in each entry.
        same_sync_ns: see `tests.vcan.judgement.compare`; its stamps are those of the bus.
        in_order: see there.
    """
    judge_listener(outcome)
    judge_log(outcome, log, same_sync_ns, in_order=in_order)
    judge_stop(outcome)
    judge_end(outcome)
    judge_code(outcome)
    judge_permission(outcome)
    judge_controller(outcome, before, gains)
    judge_audit(outcome)
    judge_writes(outcome)


def judge_listener(outcome: Round) -> None:
    """Add a listener that cannot have heard the bus:
    what it would show seems to hold then, (c) and (f) above all.
    """
    if not outcome.frames:
        outcome.violations.append("(listener) the listener heard nothing")
    elif outcome.moved_ns and not any(
        is_setpoint(one.identifier, one.data) for one in outcome.frames
    ):
        outcome.violations.append(
            "(listener) the listener heard nothing of the set-points, and the axes got some"
        )
    elif outcome.moved_ns and not any(is_answer(one) for one in outcome.frames):
        outcome.violations.append(
            "(listener) the listener heard nothing of the axes, and they got set-points"
        )


def is_setpoint(identifier: int, data: bytes) -> bool:
    """Whether a frame is a new set-point for an axis."""
    return (
        identifier & ~0x7F == RPDO1
        and len(data) > TARGET_BYTES
        and data[TARGET_BYTES] & NEW_SETPOINT != 0
    )


def is_answer(frame: Frame) -> bool:
    """Whether a frame is the whole answer of an axis to a SYNC."""
    is_of_axis = frame.identifier & ~0x7F == TPDO1 and frame.identifier & 0x7F in NODES
    return is_of_axis and len(frame.data) == FEEDBACK.size


def allowed_codes(outcome: Round) -> set[int]:
    """Exit codes that the faults of a round, or a stall that the listener heard, can explain."""
    kinds = outcome.kinds
    allowed = {int(ExitCode.OK)}
    stalled_cycles = longest_stall_cycles(outcome)
    if kinds & SPOILS or stalled_cycles > LATE_CYCLES:
        allowed.add(int(ExitCode.DATA_UNFIT))
    if kinds & STOPS_RUN or stalled_cycles > SILENT_CYCLES:
        allowed.add(int(ExitCode.DEVICE_FAULT))
    if unguarded_nodes(outcome):
        allowed.add(int(ExitCode.USAGE))
    for kind in kinds:
        if isinstance(kind, Act):
            allowed |= CODES.get(kind, set())
    return allowed


def unguarded_nodes(outcome: Round) -> list[int]:
    """Return the nodes that refused to watch the recorder's heartbeat.

    Their axes move with an option alone.
    """
    return [
        fault.node
        for fault in outcome.injected
        if fault.kind is Act.SDO_ABORT and fault.aborted[0] == HEARTBEAT_CONSUMER
    ]


def longest_stall_cycles(outcome: Round) -> float:
    """Longest time without a SYNC, or without an answer of an axis,
    from the first set-point to the end of power.

    Returns:
        The time in cycles; 0 without motion.
    """
    powered_ns = [
        one.time_ns
        for one in outcome.frames
        if is_answer(one) and FEEDBACK.unpack(one.data)[2] & STATUSWORD_MASK == ENABLED
    ]
    until_ns = max(powered_ns, default=0)
    if not 0 < outcome.moved_ns < until_ns:
        return 0.0
    last_ns: dict[int, int] = {}
    longest_ns = 0
    for one in outcome.frames:
        is_regular = one.identifier == SYNC or is_answer(one)
        if not is_regular or not outcome.moved_ns <= one.time_ns <= until_ns:
            continue
        before_ns = last_ns.get(one.identifier, one.time_ns)
        longest_ns = max(longest_ns, one.time_ns - before_ns)
        last_ns[one.identifier] = one.time_ns
    return longest_ns * 1e-9 / CYCLE_S


def judge_end(outcome: Round) -> None:
    """Add what is wrong with the state of the cell."""
    say = outcome.violations.append
    kinds = outcome.kinds
    if not outcome.cell and not kinds & GONE:
        say(f"the simulated cell ended by itself: {outcome.cell_said}")
    if outcome.enabled or outcome.powered:
        say(
            f"(c) after its end nodes {outcome.enabled} are enabled, nodes {outcome.powered} "
            "have power"
        )
    if outcome.unrestored and not kinds & (UNRESTORED | UNREAD):
        named = " ".join(NOT_RESTORED.findall(" ".join(outcome.said.split())))
        unnamed = [node for node in outcome.unrestored if not re.search(rf"\bJ{node}\b", named)]
        if unnamed:
            say(
                f"(d) nodes {unnamed} have other settings than before, and no message reports it: "
                f"{outcome.said}"
            )
        elif not kinds & UNREACHABLE:
            say(f"(d) nodes {outcome.unrestored} were left with other settings: {outcome.said}")
    if outcome.silent and not kinds & MAY_BE_SILENT:
        say(f"(d) nodes {outcome.silent} do not answer any more")
    if (
        outcome.scanned is not None
        and outcome.scanned[0] != ExitCode.OK
        and not kinds & MAY_BE_SILENT
    ):
        scan_code, scan_said = outcome.scanned
        # A fault of the cell counts cycles, and none passes between the recorder's end and the
        # scan.
        refused_master = scan_code == ExitCode.DEVICE_FAULT and FOREIGN in scan_said
        if not (refused_master and kinds & FOREIGN_MASTERS):
            say(f"(d) scan ended with {scan_code} afterwards: {scan_said}")


def judge_code(outcome: Round) -> None:
    """Add what is wrong with the exit code and the words."""
    say = outcome.violations.append
    kinds = outcome.kinds
    allowed = allowed_codes(outcome)
    came_to_its_end = outcome.code in UNSTOPPED_CODES and outcome.stopping
    if outcome.code not in allowed and not came_to_its_end:
        say(f"(e) exit code {outcome.code}, expected one of {sorted(allowed)}: {outcome.said}")
    if not outcome.permitted and outcome.code in UNSTOPPED_CODES:
        say(f"(e) exit code {outcome.code} without permission to move: {outcome.said}")
    if outcome.code == ExitCode.USAGE:
        for node in unguarded_nodes(outcome):
            if f"J{node}" not in outcome.said or "--unguarded" not in outcome.said:
                say(f"(e) no message names J{node}, which is unguarded: {outcome.said}")
    aborts = [fault for fault in outcome.injected if fault.kind is Act.SDO_ABORT]
    if outcome.code == ExitCode.DEVICE_FAULT and kinds - AFTERWARDS == {Act.SDO_ABORT}:
        words = " ".join(outcome.said.split())
        for fault in aborts:
            if f"node {fault.node})" not in words or "expect" not in words:
                say(
                    f"(e) no message names node {fault.node}, whose SDO abort ended the run: "
                    f"{outcome.said}"
                )
    if came_to_its_end:
        faults = ", ".join(fault.name for fault, _ in outcome.stopping)
        say(f"(e) exit code {outcome.code} after {faults} in motion: {outcome.said}")
    scanned = "" if outcome.scanned is None else outcome.scanned[1]
    for name, words in (
        ("record", outcome.said),
        ("scan", scanned),
        ("the cell", outcome.cell_said),
    ):
        if "Traceback" in words:
            say(f"(e) {name} shows a traceback: {words}")


def judge_log(
    outcome: Round, log: Path, same_sync_ns: int = SAME_SYNC_NS, in_order: bool = False
) -> None:
    """Add what is wrong with the log, whole or unfinished."""
    path = next((one for one in (log, log.with_name(f"{log.name}.part")) if one.exists()), None)
    if path is None or path.stat().st_size == 0:
        return
    try:
        recorded = read_recorded(path)
    except Exception as error:  # noqa: BLE001  of any kind: a log with its final name must be readable
        outcome.violations.append(f"(a, b) {path.name} cannot be read: {error}")
        return
    if recorded is None:
        return
    syncs = [place for place, one in enumerate(outcome.frames) if one.identifier == SYNC]
    foreign = outcome.kinds & {Act.SYNC, Inside.SECOND_MASTER}
    found = compare(
        recorded,
        outcome.frames,
        foreign_syncs=syncs if foreign else (),
        same_sync_ns=same_sync_ns,
        in_order=in_order,
        clock_steps_ns=outcome.clock_steps_ns,
    )
    outcome.compared = found.values + found.neighbours
    outcome.neighbours = found.neighbours
    outcome.violations += [f"(a, b) {line}" for line in found.violations[:5]]
    if len(found.violations) > 5:
        outcome.violations.append(f"(a, b) and {len(found.violations) - 5} more")


def judge_permission(outcome: Round) -> None:
    """Add axes that moved, or were enabled, before the recorder began,
    or at all without permission.
    """
    if outcome.kinds & {Act.SETPOINT, Act.TWIN, Act.SDO_MASTER}:
        return  # another master's frames are on the bus
    if outcome.permitted:
        until_ns = outcome.began_ns
    else:
        until_ns = outcome.ended_ns
    for one in outcome.frames:
        if one.time_ns >= until_ns:
            break
        node = one.identifier & 0x7F
        if node not in NODES:
            continue
        if is_setpoint(one.identifier, one.data):
            outcome.violations.append(f"(f) node {node} got a set-point without permission to move")
            return
        if not is_answer(one):
            continue
        if FEEDBACK.unpack(one.data)[2] & STATUSWORD_MASK == ENABLED:
            outcome.violations.append(f"(f) node {node} was enabled without permission to move")
            return


def judge_controller(outcome: Round, before: str, gains: Sequence[Sequence[float]]) -> None:
    """Add controller's files that are not of one write.

    Args:
        outcome: of the round.
        before: the file as it was first.
        gains: the gains that a file may have, all of them of one entry; those of `before` are
            allowed, too.
    """
    frame = GAIN.sub(r"\1", before)
    allowed = [_gains(before), *(tuple(one) for one in gains)]
    for seen in outcome.files:
        if GAIN.sub(r"\1", seen.controller) != frame:
            outcome.violations.append(
                "(g) the controller's file has changed beside its gains, or is not whole"
            )
        elif not any(_are_close(_gains(seen.controller), one) for one in allowed):
            outcome.violations.append(
                f"(g) the controller's file has gains of no single write: {_gains(seen.controller)}"
            )


def _gains(text: str) -> tuple[float, ...]:
    found = []
    for _, word in GAIN.findall(text):
        try:
            found.append(float(word))
        except ValueError:
            found.append(float("nan"))
    return tuple(found)


def _are_close(found: Sequence[float], expected: Sequence[float]) -> bool:
    """Whether gains are equal to the digits that are written."""
    if len(found) != len(expected):
        return False
    return all(
        abs(one - other) <= 2e-4 * abs(other) for one, other in zip(found, expected, strict=True)
    )


def broken_chain(text: str, torn: bool = False) -> str:
    """Return what is wrong with the chain of an audit log; empty if it is unbroken.

    Every line is JSON with the SHA-256 of itself without that digest, and with the digest of the
    line before. A writer that was killed may leave an unfinished line.
    """
    previous = FIRST
    for number, line in enumerate(text.splitlines(), 1):
        try:
            entry = json.loads(line)
        except ValueError:
            if torn:
                continue
            return f"line {number} is no entry"
        if not isinstance(entry, dict):
            return f"line {number} is no entry"
        absent = [key for key in CHAIN_KEYS if not isinstance(entry.get(key), str)]
        if absent:
            return f"line {number} lacks {' and '.join(absent)}"
        if entry["previous"] != previous:
            return f"line {number} does not follow the one before"
        digests = DIGEST.findall(line)
        if digests:
            content = line.replace(f',"sha256":"{digests[-1]}"', "")
        else:
            content = line
        if hashlib.sha256(content.encode()).hexdigest() != entry["sha256"]:
            return f"line {number} was changed"
        previous = entry["sha256"]
    return ""


def judge_audit(outcome: Round) -> None:
    """Add breaks of the chain that no act explains,
    and removals that `history --verify` does not report.
    """
    removed = outcome.kinds & {Act.AUDIT_DELETED, Act.AUDIT_CUT}
    for seen in outcome.files:
        problem = broken_chain(seen.audit, seen.torn)
        if problem:
            outcome.violations.append(f"(h) audit log: {problem}")
            break
    for one in outcome.written:
        if one.verb == "history" and bool(removed) is not (one.code == ExitCode.DATA_UNFIT):
            if removed:
                expected = "entries were removed"
            else:
                expected = "no entry was removed"
            outcome.violations.append(
                f"(h) history --verify ended with {one.code}, and {expected}: {one.said}"
            )


def judge_writes(outcome: Round) -> None:
    """Add writes that ended otherwise than they must."""
    for one in outcome.written:
        if "Traceback" in one.said:
            outcome.violations.append(f"(e) {one.verb} shows a traceback: {one.said}")
        if one.verb != "apply":
            continue
        if one.right_clock:
            allowed = {int(ExitCode.OK)}
        else:
            allowed = set(WRITE_CODES)
        if one.killed:
            allowed.add(-signal.SIGKILL)
        if one.code not in allowed:
            outcome.violations.append(
                f"(e) {one.verb} ended with {one.code}, expected one of {sorted(allowed)}: "
                f"{one.said}"
            )


def judge_stop(outcome: Round) -> None:
    """Add the faults in motion after which an axis answered as enabled beyond the bound."""
    repeating = {fault.node for fault in outcome.injected if fault.kind is Inside.STALE}
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
        stop = STOPS[fault.kind]
        last_s = (max(enabled, default=0) - at_ns) * 1e-9
        bound_s = stop.bound_s + (fault.for_s if stop.lasts else 0.0)
        held_up_s = sum(
            HOLDS_UP_S.get(kind, 0.0)
            for kind in outcome.kinds - {fault.kind}
            if isinstance(kind, Act)
        )
        if last_s > 0.0:
            outcome.late_s[fault.name] = max(
                last_s - bound_s - held_up_s, outcome.late_s.get(fault.name, -1e9)
            )
        if last_s > bound_s + held_up_s + ALLOWANCE_S:
            outcome.violations.append(
                f"(c) {fault.name}: an axis is enabled {last_s:.2f} s after it"
            )
