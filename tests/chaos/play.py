"""One round: a cell, a recorder, faults at their moments, and what is left of it;
judge.py judges that.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random

from daq.cli.app import main
from tests.chaos.clock import StepClock
from tests.chaos.ends import ChaosBus, End, flood
from tests.chaos.faults import AFTERWARDS, FROM_START, NODES, Act, Fault, Inside
from tests.chaos.judge import (
    ALLOWANCE_S,
    ENABLED,
    GUARD_S,
    POWERED,
    RPDO1,
    STATUSWORD_MASK,
    Round,
    is_setpoint,
    judge,
)
from tests.chaos.processes import READY, Objects, Shared, Verb, serve_cell
from tests.chaos.screens import Screen, plain, screen_of
from tests.chaos.writes import WRITTEN_GAINS, Office
from tests.vcan.cells import write_cell
from tests.vcan.judgement import FEEDBACK, SYNC, TPDO1
from tests.vcan.listener import heard, listening
from tests.vcan.run import INTERFACE

PERIOD_US = 20_000
HEARTBEAT = 0x700
LOWEST_RECORDER = 112
HIGHEST_ID = 127
LSS_REQUEST = 0x7E5  # CiA 305: switch state global, to configuration
DISK_MB = 80  #: More than a recording wants free before it moves (`daq.workflow.safeguards`)
ERROR_PASSIVE = (0x2000_0004, bytes((0, 0x30, 0, 0, 0, 0, 0, 0)))  # linux/can/error.h
BUS_OFF = (0x2000_0040, bytes(8))
START_S, RUN_S = 60.0, 90.0  #: A round is broken off after so long
CLAIM_S, CLAIMS = 0.1, 20  #: Heartbeats of a device that takes the recorder's id
ON_SCREEN_OR_CLOCK = frozenset(
    {Act.SCREEN_STOPPED, Act.SCREEN_CLOSED, Act.TERMINAL_CLOSED, Act.CLOCK_STEP}
)

Action = tuple[float, Callable[[], object]]
"""An act and its moment [s]."""


@dataclass
class Stage:
    """What the acts of a round act on."""

    bus: ChaosBus
    recorder: Verb
    cell: Verb
    disk: Path  #: folder of the log
    screen: Screen | None
    clock: StepClock | None
    end: End  #: hears the recorder, and sends foreign frames
    recorder_id: int = HIGHEST_ID  #: node id of its heartbeats


def play(
    faults: Sequence[Fault],
    folder: Path,
    bus: ChaosBus,
    simulation: str,
    plan: Path,
    clock: StepClock | None,
) -> Round:
    """Play one round in an empty folder, and judge it."""
    outcome = Round(faults)
    kinds = {fault.kind for fault in faults}
    log = folder / "disk" / "run.mcap"
    cell_folder = folder / "cell"
    cell_folder.mkdir()
    cell_file = write_cell(cell_folder, PERIOD_US, "timed", bus.settings)
    truth = folder / "simulation.yaml"
    inside = "".join(fault.entry() for fault in faults if isinstance(fault.kind, Inside))
    truth.write_text(simulation + (f"\nfaults:\n{inside}" if inside else ""), encoding="utf-8")
    office = Office(cell_file, outcome, clock)
    office.write_first()
    shared = Shared()
    aborts = [(fault.node, *fault.aborted) for fault in faults if fault.kind is Act.SDO_ABORT]
    arguments = [
        "record",
        str(cell_file),
        str(plan),
        "--out",
        str(log),
        "--operator",
        "chaos",
        "--speed",
        "0.2",
    ]
    outcome.permitted = Act.NO_PERMISSION not in kinds
    if outcome.permitted:
        arguments.append("--enable-motion")
    with ExitStack() as stack:
        stack.enter_context(_disk(log.parent, folder))
        stack.enter_context(listening(bus.address, folder / "frames"))
        cell = Verb.start(folder / "cell.txt", lambda: serve_cell(truth, bus, aborts, shared))
        stack.callback(cell.end)
        _until(lambda: READY in cell.said or not cell.running, START_S)
        objects = Objects(bus)
        stack.callback(objects.close)
        before = {node: objects.settings(node) for node in NODES}
        words = folder / "record.txt"
        screen = screen_of(faults, words)
        shared.aborting = True
        outcome.began_ns = time.time_ns()
        recorder = Verb.start(
            words, lambda: main(arguments), None if screen is None else screen.inside, clock
        )
        stack.callback(recorder.end)
        with bus.end(((RPDO1, 0x780), (HEARTBEAT, 0x780))) as end:
            _strike(outcome, Stage(bus, recorder, cell, log.parent, screen, clock, end))
        shared.aborting = False
        if screen is not None:
            screen.close()
        if clock is not None:
            clock.step(0)
        outcome.code = recorder.code
        outcome.said = plain(recorder.said)
        outcome.cell = cell.running
        if outcome.cell:
            _look(outcome, objects, before)
            scan = Verb.start(folder / "scan.txt", lambda: main(["scan", str(cell_file)]))
            scan.wait(START_S)
            outcome.scanned = (scan.end(), scan.said)
        cell.end(signal.SIGINT)
    office.write_again()
    outcome.frames = heard(folder / "frames")
    outcome.cell_said = cell.said
    steps_ns = [
        fault.clock_step_s * 1_000_000_000 for fault in faults if fault.kind is Act.CLOCK_STEP
    ]
    outcome.clock_steps_ns = (0, *steps_ns)
    judge(
        outcome,
        folder / log.name,
        office.before,
        WRITTEN_GAINS,
        bus.same_sync_ns,
        in_order=bus.in_order,
    )
    return outcome


@contextmanager
def _disk(place: Path, kept: Path) -> Iterator[None]:
    """Mount a small disk for the log; the logs are copied from it in the end."""
    place.mkdir()
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "chaos", str(place)], check=True
    )
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


# -- the faults
# --------------------------------------------------------------------------------------------------------  # noqa: E501


def _strike(outcome: Round, stage: Stage) -> None:
    """Make the faults at their moments until the recorder has ended, and undo what lasts."""
    begun_s = time.monotonic()
    moved_s = 0.0
    recorder = stage.recorder
    waiting = []
    for fault in outcome.faults:
        if fault.kind in FROM_START:
            outcome.struck.append((fault, time.time_ns()))
        elif isinstance(fault.kind, Act) and fault.kind not in AFTERWARDS:
            waiting.append(fault)
    later: list[Action] = []
    while recorder.running and time.monotonic() < begun_s + RUN_S:
        for identifier, data in stage.end.hear(0.002):
            if identifier >= HEARTBEAT + LOWEST_RECORDER:
                stage.recorder_id = identifier - HEARTBEAT
            elif not outcome.moved_ns and is_setpoint(identifier, data):
                outcome.moved_ns = time.time_ns()
                moved_s = time.monotonic()
        now_s = time.monotonic()
        for fault in [one for one in waiting if now_s >= _moment_s(one, begun_s, moved_s)]:
            waiting.remove(fault)
            outcome.struck.append((fault, time.time_ns()))
            later += [
                (now_s + after_s, action) for after_s, action in _actions(fault, outcome, stage)
            ]
        for due in sorted((one for one in later if one[0] <= now_s), key=lambda one: one[0]):
            later.remove(due)
            with suppress(OSError):  # the process has ended, the interface is down
                due[1]()
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


def _actions(fault: Fault, outcome: Round, stage: Stage) -> Iterator[Action]:
    """Yield what a fault does, with the time after it [s]."""
    name = fault.kind.name
    if name.startswith(("RECORDER", "CAPTURE", "CELL")):
        who, _, what = name.partition("_")
        recorder = stage.recorder
        pids = {
            "RECORDER": [recorder.pid],
            "CAPTURE": recorder.children(),
            "CELL": [stage.cell.pid],
        }[who]
        for pid in pids:
            yield from _signals(pid, what, fault.for_s)
    elif fault.kind is Act.FLOOD:
        flooding = Verb.start(stage.disk / "flood.txt", partial(flood, stage.bus))
        yield fault.for_s, flooding.end
    elif fault.kind is Act.LINK_DOWN:
        for after_s, how in ((0.0, "down"), (fault.for_s, "up")):
            yield (
                after_s,
                partial(subprocess.run, ["ip", "link", "set", INTERFACE, how], check=True),
            )
    elif fault.kind is Act.DISK_FULL:
        yield 0.0, partial(_fill, stage.disk)
        yield fault.for_s, (stage.disk / "filler").unlink
    elif fault.kind in ON_SCREEN_OR_CLOCK:
        yield from _screen_or_clock(fault, stage)
    elif fault.kind is Act.ID_TAKEN:
        yield 0.0, partial(stage.end.send, HEARTBEAT + stage.recorder_id, b"\x00")  # boot-up
        for number in range(CLAIMS):
            heartbeat = partial(stage.end.send, HEARTBEAT + stage.recorder_id, b"\x05")
            yield (number + 1) * CLAIM_S, heartbeat
    else:
        random = Random(fault.value)
        for number in range(fault.times):
            identifier, data = _foreign(fault, stage.recorder_id, random)
            if fault.kind is Act.TWIN:
                outcome.twins.add(data)
            yield number * fault.gap_s, partial(stage.end.send, identifier, data)


def _screen_or_clock(fault: Fault, stage: Stage) -> Iterator[Action]:
    screen = stage.screen
    clock = stage.clock
    if fault.kind is Act.SCREEN_STOPPED and screen is not None:
        yield 0.0, screen.stop
        yield fault.for_s, screen.go_on
    elif fault.kind in (Act.SCREEN_CLOSED, Act.TERMINAL_CLOSED) and screen is not None:
        if screen.terminal is (fault.kind is Act.TERMINAL_CLOSED):
            yield 0.0, screen.close_reader
    elif fault.kind is Act.CLOCK_STEP and clock is not None:
        yield 0.0, partial(clock.step, fault.clock_step_s)


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


def _foreign(fault: Fault, recorder_id: int, random: Random) -> tuple[int, bytes]:
    """Return a frame of another device; each call draws its data anew."""
    node = fault.node
    word = random.choice((0x0627, 0x0250, 0x0618))
    feedback = FEEDBACK.pack(
        random.randrange(-(1 << 20), 1 << 20), random.randrange(-2000, 2000), word
    )
    frames = {
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
    }
    return frames[Act(fault.kind)]


# -- what is left
# ------------------------------------------------------------------------------------------------------  # noqa: E501


def _look(outcome: Round, objects: Objects, before: dict[int, tuple[int | None, ...]]) -> None:
    """Read states and settings of the axes when nothing disturbs them any more;
    recorder and faults have ended.
    """
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
