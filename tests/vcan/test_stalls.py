"""A recorder, or its capture process, that is stopped while the axes move;
a flooded bus with a deaf node.
"""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from daq.cli.terminal import ONE_KEY_S
from daq.errors import ExitCode
from daq.log.reader import read_log
from drivers.profiles.cia402 import State
from tests.faults.test_scenario import PLAN
from tests.vcan.cells import simulated, write_cell, write_simulation
from tests.vcan.run import INTERFACE
from tests.vcan.test_bus_faults import NODES, at_rest, raw, states_after

PERIOD_US = 20_000
CYCLE_S = PERIOD_US * 1e-6
PATIENCE_S = 120.0
SO_TIMESTAMPNS, SO_RCVBUFFORCE = 35, 33  # asm-generic/socket.h
SYNC = 0x080
EMCY = 0x080
TPDO1 = 0x180
RPDO1 = 0x200
HEARTBEAT = 0x700
STRIKE = 150  #: SYNCs from power-on to a fault, in the first move
CLOSING_S = 13.0  #: The time limit of 10 s, and the end of a program in the guest
LOWEST_RECORDER = 112
NEW_SETPOINT, RUNNING = 0x10, 0x04  #: Bits of the controlword; quick stop clears the second
FLOOD_HZ = 11_000
FLOOD = """
import socket, struct, sys, time
end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
end.bind((sys.argv[1],))
end.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
frame = struct.pack("=IB3x8s", int(sys.argv[3], 16), 8, bytes(8))
begun, sent, most = time.monotonic(), 0, int(sys.argv[2])
while True:
    for _ in range(most // 500):
        end.send(frame)
    sent += most // 500
    left = begun + sent / most - time.monotonic()
    if left > 0:
        time.sleep(left)
"""


@dataclass
class Heard:
    """SYNC, EMCY, TPDO1, RPDO1 and heartbeats on the bus with the kernel's times,
    in a thread of its own.

    Attributes:
        frames: time [ns since 1970], identifier and low byte of a controlword of each; RPDO1 has
            the target before it.
        moves: is set by the first new set-point.
    """

    frames: list[tuple[int, int, int]] = field(default_factory=list)
    moves: threading.Event = field(default_factory=threading.Event)
    _ended: threading.Event = field(default_factory=threading.Event)

    def run(self, end: socket.socket) -> None:
        """Until `end`."""
        while not self._ended.is_set():
            if not select.select((end,), (), (), 0.05)[0]:
                continue
            data, ancillary, _, _ = end.recvmsg(16, 64)
            identifier, _, payload = struct.unpack("=IB3x8s", data)
            seconds, rest_ns = struct.unpack("=qq", ancillary[0][2])
            self.frames.append((1_000_000_000 * seconds + rest_ns, identifier, payload[4]))
            if identifier & 0x780 == RPDO1 and payload[4] & NEW_SETPOINT:
                self.moves.set()

    def end(self) -> None:
        self._ended.set()

    def last_s(self, after_ns: int, before_ns: int, wanted: Callable[[int], bool]) -> float:
        """Time from one moment to the last frame before another whose identifier is wanted [s]."""
        times = [
            at_ns
            for at_ns, number, _ in self.frames
            if after_ns < at_ns < before_ns and wanted(number)
        ]
        return (max(times, default=after_ns) - after_ns) * 1e-9

    def stop_s(self, after_ns: int) -> float:
        """Time from one moment to the first command without power for the axes [s];
        infinite without one.
        """
        times = [
            at_ns
            for at_ns, number, word in self.frames
            if at_ns > after_ns and number & 0x780 == RPDO1 and not word & RUNNING
        ]
        return (min(times, default=float("inf")) - after_ns) * 1e-9


@contextmanager
def listening() -> Iterator[Heard]:
    heard = Heard()
    filters = (
        (SYNC, 0xC000_0780),
        (TPDO1, 0xC000_0780),
        (RPDO1, 0xC000_0780),
        (HEARTBEAT, 0xC000_0780),
    )
    with raw(INTERFACE) as end:
        end.setsockopt(
            socket.SOL_CAN_RAW,
            socket.CAN_RAW_FILTER,
            b"".join(struct.pack("=II", *each) for each in filters),
        )
        end.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 4 << 20)
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        thread = threading.Thread(target=heard.run, args=(end,), name="heard")
        thread.start()
        try:
            yield heard
        finally:
            heard.end()
            thread.join()


@dataclass
class Recording:
    """`drivegain record` in a process of its own, whose axes move."""

    process: subprocess.Popen[str]
    heard: Heard

    def send(self, number: signal.Signals) -> int:
        """Send a signal; returns its time [ns since 1970]."""
        now_ns = time.time_ns()
        os.kill(self.process.pid, number)
        return now_ns

    def end(self) -> tuple[str, float]:
        """Wait for its end; returns its words on stderr, and how long that took [s]."""
        begun_s = time.monotonic()
        _, said = self.process.communicate(timeout=PATIENCE_S)
        return said, time.monotonic() - begun_s

    def captures(self) -> list[int]:
        """Process ids of its capture processes."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text(
            encoding="ascii"
        )
        return [int(word) for word in children.split()]


@contextmanager
def recording(folder: Path, faults: str = "") -> Iterator[Recording]:
    cell = write_cell(folder, PERIOD_US, "timed")
    simulation = write_simulation(folder, PERIOD_US)
    if faults:
        text = simulation.read_text(encoding="utf-8")
        simulation.write_text(f"{text}\nfaults:\n{faults}", encoding="utf-8")
    plan = folder / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "daq",
        "record",
        str(cell),
        str(plan),
        "--out",
        str(folder / "run.mcap"),
    ]
    command += ["--enable-motion", "--operator", "test", "--speed", "0.2"]
    with simulated(simulation), listening() as heard:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            give_up_s = time.monotonic() + PATIENCE_S
            while not heard.moves.wait(0.1):
                assert process.poll() is None, process.communicate()[1]
                assert time.monotonic() < give_up_s, "no motion"
            time.sleep(0.5)
            yield Recording(process, heard)
        finally:
            process.kill()
            process.communicate()


def test_sync_and_heartbeat_end_when_the_recorder_hangs(
    tmp_path: Path, figure: Callable[[str], None]
) -> None:
    with recording(tmp_path) as run:
        stopped_ns = run.send(signal.SIGSTOP)
        time.sleep(5.0)
        resumed_ns = run.send(signal.SIGCONT)
        sync_s = run.heard.last_s(stopped_ns, resumed_ns, lambda number: number == SYNC)
        beat_s = run.heard.last_s(
            stopped_ns, resumed_ns, lambda number: number >= HEARTBEAT + LOWEST_RECORDER
        )
        said, _ = run.end()
        assert run.process.returncode == ExitCode.DEVICE_FAULT, said
        with raw(INTERFACE) as end:
            assert at_rest(end) == [State.SWITCH_ON_DISABLED] * len(NODES)
        figure(
            f"recorder stopped for 5 s: last SYNC after {sync_s:.3f} s, last heartbeat after "
            f"{beat_s:.3f} s"
        )
        assert sync_s < 0.5
        assert beat_s < 0.1


@pytest.mark.parametrize("whole", [True, False], ids=["recorder", "capture process"])
def test_a_short_stop_loses_nothing(
    tmp_path: Path, attempts: range, whole: bool, figure: Callable[[str], None]
) -> None:
    name = "recorder" if whole else "capture process"
    statistics = None
    for attempt in attempts:
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with recording(folder) as run:
            pids = [run.process.pid] if whole else run.captures()
            for stop_s in (0.03, 0.1, 0.3):
                for pid in pids:
                    os.kill(pid, signal.SIGSTOP)
                time.sleep(stop_s)
                for pid in pids:
                    os.kill(pid, signal.SIGCONT)
                time.sleep(1.0)
            said, _ = run.end()
        if run.process.returncode == ExitCode.DEVICE_FAULT:
            # A busy host may starve the amplifiers: supervision ends such a run.
            continue
        assert run.process.returncode in (ExitCode.OK, ExitCode.DATA_UNFIT), said
        found = read_log(folder / "run.mcap")
        statistics = found.statistics
        if statistics.valid:
            break
    assert statistics is not None, said
    lost = statistics.reason or "nothing lost"
    figure(
        f"{name} stopped for 30, 100, 300 ms: {len(found.samples.cycle)} samples, {lost}, "
        f"attempt {attempt}"
    )
    assert statistics.valid


@contextmanager
def flooded(identifier: str = "7F0", rate_hz: int = FLOOD_HZ) -> Iterator[None]:
    """Flood the bus with frames that have this identifier."""
    with subprocess.Popen(
        [sys.executable, "-S", "-c", FLOOD, INTERFACE, str(rate_hz), identifier]
    ) as flooding:
        try:
            yield
        finally:
            flooding.kill()


@pytest.mark.parametrize(
    ("identifier", "rate_hz"),
    # Recorder and listener count surplus PDOs one by one: more of them starve the one processor of
    # a guest.
    [("7F0", FLOOD_HZ), ("481", 1000)],
    ids=["unused identifier", "surplus PDOs"],
)
def test_ctrl_c_stops_the_axes_on_a_flooded_bus(
    tmp_path: Path, attempts: range, identifier: str, rate_hz: int, figure: Callable[[str], None]
) -> None:
    for attempt in attempts:
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with recording(folder) as run, flooded(identifier, rate_hz):
            time.sleep(1.0)
            asked_ns = run.send(signal.SIGINT)
            said, closing_s = run.end()
            stop_s = run.heard.stop_s(asked_ns)
            with raw(INTERFACE) as end:
                states = states_after(end, 1)
        # A busy host may starve all amplifiers before
        if run.process.returncode == ExitCode.INTERRUPTED:
            break
    name = f"flood of {rate_hz} frames/s {identifier}h"
    figure(
        f"{name}: stop {1e3 * stop_s:.0f} ms after Ctrl-C, ended after {closing_s:.1f} s, "
        f"attempt {attempt}"
    )
    assert run.process.returncode == ExitCode.INTERRUPTED, said
    assert "emergency" not in said
    assert stop_s < max(2 * CYCLE_S, 0.05)
    assert closing_s < CLOSING_S
    assert states == [State.SWITCH_ON_DISABLED] * len(NODES)


def test_a_second_ctrl_c_ends_at_once(tmp_path: Path, figure: Callable[[str], None]) -> None:
    with recording(tmp_path) as run, flooded():
        run.send(signal.SIGINT)
        time.sleep(1.1 * ONE_KEY_S)
        run.send(signal.SIGINT)
        said, closing_s = run.end()
        figure(f"flood of {FLOOD_HZ} frames/s, Ctrl-C twice: ended after {closing_s:.1f} s")
        assert run.process.returncode == ExitCode.INTERRUPTED, said
        assert "settings not restored (asked a second time)" in said
        assert closing_s < CLOSING_S / 4


def test_a_fault_stops_the_axes_on_a_flooded_bus(
    tmp_path: Path, attempts: range, figure: Callable[[str], None]
) -> None:
    fault = f"  - {{fault: emergency, axis: J3, at_cycle: {STRIKE}, emcy_code: 0x2310}}\n"
    for attempt in attempts:
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with recording(folder, fault) as run, flooded():
            said, _ = run.end()
            emcy_ns = [at_ns for at_ns, number, _ in run.heard.frames if number == EMCY + 3]
        # A busy host may starve all amplifiers before J3 sends its EMCY.
        if emcy_ns:
            break
    assert emcy_ns, said
    stop_s = run.heard.stop_s(emcy_ns[0])
    figure(
        f"flood of {FLOOD_HZ} frames/s: stop {1e3 * stop_s:.0f} ms after the EMCY of an axis, "
        f"attempt {attempt}"
    )
    assert run.process.returncode == ExitCode.DEVICE_FAULT, said
    assert "emergency stop" not in said
    assert stop_s < max(2 * CYCLE_S, 0.05)


def test_a_deaf_node_on_a_flooded_bus_is_named_within_the_time_limit(
    tmp_path: Path, attempts: range, figure: Callable[[str], None]
) -> None:
    for attempt in attempts:
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with (
            recording(folder, f"  - {{fault: silent, axis: J3, at_cycle: {STRIKE}}}\n") as run,
            flooded(),
        ):
            said, _ = run.end()
            ended_ns = time.time_ns()
            answers_ns = [at_ns for at_ns, number, _ in run.heard.frames if number == TPDO1 + 3]
        # A flooded guest on a busy host may starve the other amplifiers, too, before J3 is deaf.
        if answers_ns and not re.search("no (axis answered|answer from J1)", said):
            break
    assert answers_ns, said
    stop_s = run.heard.stop_s(answers_ns[-1])
    closing_s = (ended_ns - answers_ns[-1]) * 1e-9
    stop_ms = 1e3 * stop_s
    figure(
        f"flood, J3 deaf: stop {stop_ms:.0f} ms after its last answer, end {closing_s:.1f} s, "
        f"attempt {attempt}"
    )
    assert run.process.returncode == ExitCode.DEVICE_FAULT, said
    assert "J3 (node 3) NOT CONFIRMED WITHOUT POWER: use the emergency stop" in said
    assert stop_s < 6 * CYCLE_S + 0.05  # four cycles without an answer are tolerated
    assert closing_s < CLOSING_S
