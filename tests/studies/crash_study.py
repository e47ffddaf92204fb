"""Kills recorders at random moments and damages finished logs,
and counts what is lost and what is believed.

The truth comes from outside the killed process: the simulated cell lives in this one and keeps
every SYNC that reached it and every frame that it sent. Sent = recovered + lost, and what was
recovered must be what was sent.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import can
import numpy as np
from numpy.typing import NDArray

from daq.cli.app import main as drivegain
from daq.environment import shipped_configurations
from daq.errors import ExitCode, LogUnreadable
from daq.log.reader import Log, LogReader, SampleBlock, read_log
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.simulation.cell import SYNC_ID, SimulatedCell
from drivers.simulation.hub import Hub
from tests.studies.output import print_line

OUT = Path("out/crash-study.json")
PROMISED_MS = 200.0
CYCLE_MS = 1.0
POLL_S = 0.002
QUIET_S = 0.3
"""Without a SYNC for so long, nothing of the killed recorder is on its way any more."""
PATIENCE_S = 300.0
FEEDBACK = struct.Struct("<ihH")
"""The one TPDO of an axis of the demo cell: 6064h, 6074h, 6041h."""


class Tap:
    """A bus that keeps what its cell was asked and what it answered."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.syncs = 0
        self.answers: list[tuple[int, bytes]] = []

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """As of a bus."""
        message = self._bus.recv(timeout)
        if message is not None and message.arbitration_id == SYNC_ID:
            self.syncs += 1
        return message

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        """As of a bus."""
        if 0x180 < message.arbitration_id < 0x200:
            self.answers.append((message.arbitration_id - 0x180, bytes(message.data)))
        self._bus.send(message, timeout)


ASKED = 1
"""SYNCs before the log begins: a recorder first reads the positions of the axes
(daq/workflow/record.py).
"""


@dataclass(frozen=True)
class Kill:
    """One killed recording.

    Attributes:
        target: SYNCs after which it was killed.
        sent: SYNCs of the recording that reached the cell.
        recovered, lost: samples in the salvaged log, and not in it.
        lost_ms: recorded time that is gone [ms].
        same: what was recovered is what the cell had sent, cycle by cycle.
        salvage: exit code of `drivegain salvage`.
        partial: the log says so.
        part_refused: the `.part` itself is no log to any other verb.
    """

    target: int
    sent: int
    recovered: int
    lost: int
    lost_ms: float
    same: bool
    salvage: int
    partial: bool
    part_refused: bool

    @property
    def kept(self) -> bool:
        """All that is promised."""
        whole = self.salvage == ExitCode.OK and self.same and self.partial and self.part_refused
        return whole and self.lost_ms <= PROMISED_MS


@contextmanager
def recording(
    cell_file: Path, plan: Path, log: Path
) -> Iterator[tuple[Tap, subprocess.Popen[bytes]]]:
    """A recorder in a process of its own, and the cell that it records, fresh from power-on,
    in this one.
    """
    with Hub(("can0",)) as hub:
        address = hub.address()
        bus = open_bus(address)
        tap = Tap(bus)
        reported = cell_file.with_name("cell-on-hub.yaml")
        text = cell_file.read_text(encoding="utf-8")
        reported.write_text(_on_hub(text, address), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "daq",
            "record",
            str(reported),
            str(plan),
            "--out",
            str(log),
            "--enable-motion",
        ]
        try:
            with (
                SimulatedCell(load_simulation(shipped_simulation("clean")), cast(can.BusABC, tap)),
                subprocess.Popen(
                    command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
                ) as recorder,
            ):
                try:
                    yield tap, recorder
                finally:
                    recorder.kill()
        finally:
            bus.shutdown()


def _on_hub(text: str, address: BusAddress) -> str:
    bus = (
        f"bus:\n  interface: socketcand\n  channel: {address.channel}\n  host: {address.host}\n  "
        f"port: {address.port}\n"
    )
    bus += (
        f"  bitrate_bit_s: {address.bitrate_bit_s}\nsync:\n  period_us: 1000\n  pacing: lockstep\n"
    )
    robots = str(shipped_configurations() / "robots")
    return re.sub(r"bus:\n.*?(?=axes:)", bus, text, flags=re.DOTALL).replace("../robots", robots)


def kill_once(cell_file: Path, plan: Path, folder: Path, target: int) -> Kill:
    """Record, kill -9 once so many SYNCs have reached the cell, salvage, compare."""
    log = folder / "killed.mcap"
    saved = folder / "saved.mcap"
    part = log.with_name(log.name + ".part")
    with recording(cell_file, plan, log) as (tap, recorder):
        begun = time.monotonic()
        while (
            tap.syncs < target and recorder.poll() is None and time.monotonic() < begun + PATIENCE_S
        ):
            time.sleep(POLL_S)
        recorder.kill()  # SIGKILL: nothing of the recorder runs after this
        recorder.wait()
        quiet_since = time.monotonic()
        seen = tap.syncs
        while time.monotonic() < quiet_since + QUIET_S:
            time.sleep(POLL_S)
            if tap.syncs != seen:
                quiet_since = time.monotonic()
                seen = tap.syncs
    refused = drivegain(["info", str(part)]) == ExitCode.DATA_UNFIT
    code = drivegain(["salvage", str(part), "--out", str(saved)])
    recovered = 0
    same = False
    partial = False
    if code == ExitCode.OK:
        found = read_log(saved)
        recovered = len(found.samples.cycle)
        same = _as_sent(found.samples, tap.answers)
        partial = found.partial
    part.unlink(missing_ok=True)
    saved.unlink(missing_ok=True)
    lost = tap.syncs - ASKED - recovered
    sent = tap.syncs - ASKED
    lost_ms = lost * CYCLE_MS
    return Kill(target, sent, recovered, lost, lost_ms, same, code, partial, refused)


def _as_sent(samples: SampleBlock, answers: list[tuple[int, bytes]]) -> bool:
    """Every sample from the first SYNC on, without a gap,
    with the numbers that the cell put on the bus.
    """
    axes = samples.position_counts.shape[1]
    by_axis: list[list[tuple[int, ...]]] = []
    for axis in range(axes):
        by_axis.append([FEEDBACK.unpack(data) for node, data in answers if node == axis + 1])
    sent = np.array(by_axis, dtype=np.int64)
    length = len(samples.cycle)
    logged: tuple[NDArray[np.integer], ...] = (
        samples.position_counts,
        samples.current_raw,
        samples.statusword,
    )
    return bool(
        np.array_equal(samples.cycle, np.arange(length, dtype=np.uint64))
        and not samples.missing.any()
        and all(
            np.array_equal(column, sent[:, ASKED : ASKED + length, field].T)
            for field, column in enumerate(logged)
        )
    )


@dataclass(frozen=True)
class Damage:
    """Outcome of one kind of damage to a finished log.

    Attributes:
        tried: files.
        named: refused with a named error, by its name.
        same: read, and the same as before in every number.
        wrong: read, and another in some number; must be zero.
        crashed: any other exception, by its name; must be empty.
        salvage_wrong: something before the damage that salvage would take was not as recorded; must
            be zero.
        recovered_share: of the samples before the damage, least and mean.
    """

    tried: int
    named: dict[str, int]
    same: int
    wrong: int
    crashed: dict[str, int]
    salvage_wrong: int
    recovered_share: tuple[float, float]

    @property
    def kept(self) -> bool:
        """No wrong data, no crash, every one named."""
        return sum(self.named.values()) == self.tried and not (
            self.wrong or self.crashed or self.salvage_wrong
        )


def damage(log: Path, changed: Iterator[bytes], tried: int) -> Damage:
    """Read damaged copies of a log, as a fit does and as salvage does."""
    original = read_log(log)
    named: Counter[str] = Counter()
    crashed: Counter[str] = Counter()
    same = wrong = salvage_wrong = 0
    shares = []
    copy = log.with_name("damaged.mcap")
    for _, data in zip(range(tried), changed, strict=False):
        copy.write_bytes(data)
        try:
            if equal(read_log(copy), original):
                same += 1
            else:
                wrong += 1
        except LogUnreadable as error:
            named[type(error).__name__] += 1
        except Exception as error:  # noqa: BLE001 - counted: it is what the study looks for
            crashed[type(error).__name__] += 1
        try:
            right, share = _before_damage(copy, original)
            salvage_wrong += not right
            shares.append(share)
        except LogUnreadable:
            shares.append(0.0)
        except Exception as error:  # noqa: BLE001 - counted: it is what the study looks for
            crashed[f"{type(error).__name__} in salvage"] += 1
    copy.unlink()
    mean = float(np.mean(shares)) if shares else 0.0
    recovered_share = (min(shares, default=0.0), mean)
    return Damage(
        tried,
        dict(named),
        same,
        wrong,
        dict(crashed),
        salvage_wrong,
        recovered_share,
    )


def equal(one: Log, other: Log) -> bool:
    """In everything that a fit takes."""
    heads = (one.head, one.events, one.statistics) == (other.head, other.events, other.statistics)
    return heads and all(np.array_equal(*pair) for pair in _columns(one.samples, other.samples))


def _columns(one: SampleBlock, other: SampleBlock) -> Iterator[tuple[Any, Any]]:
    return ((getattr(one, name), getattr(other, name)) for name in SampleBlock.__slots__)


def _before_damage(path: Path, original: Log) -> tuple[bool, float]:
    """Whether what salvage would take is a beginning of the original,
    and its share of the samples.
    """
    reader = LogReader(path)
    done = 0
    for block in reader.until_damage():
        end = done + len(block.cycle)
        if not all(
            np.array_equal(now, then[done:end]) for now, then in _columns(block, original.samples)
        ):
            return False, 0.0
        done = end
    if not done:
        return True, 0.0
    right = (
        reader.head == original.head
        and tuple(reader.events) == original.events[: len(reader.events)]
    )
    return right, done / len(original.samples.cycle)


def flipped(data: bytes, chance: random.Random) -> Iterator[bytes]:
    """Copies with one bit turned."""
    for _ in count():
        copy = bytearray(data)
        copy[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        yield bytes(copy)


def cut(data: bytes, chance: random.Random) -> Iterator[bytes]:
    """Copies without their end."""
    for _ in count():
        yield data[: chance.randrange(len(data))]


def study(kills: int, damages: int, seconds: float, seed: int) -> dict[str, Any]:
    """All of it; the document that is written."""
    chance = random.Random(seed)
    with TemporaryDirectory(prefix="crash-study-") as name:
        folder = Path(name)
        cell_file = folder / "cell.yaml"
        plan = folder / "plan.yaml"
        log = folder / "whole.mcap"
        demo_path = shipped_configurations() / "cells" / "demo.yaml"
        text = demo_path.read_text(encoding="utf-8")
        robots_folder = shipped_configurations() / "robots"
        changed_text = text.replace("../robots", str(robots_folder))
        cell_file.write_text(changed_text, encoding="utf-8")
        options = [
            "--out",
            str(plan),
            "--duration",
            str(seconds),
            "--exchanges",
            "0",
            "--condition",
            "1e9",
        ]
        if drivegain(["plan", str(cell_file), *options]) != ExitCode.OK:
            raise SystemExit("no plan")
        begun = time.monotonic()
        with recording(cell_file, plan, log) as (tap, recorder):
            recorder.wait()
        whole = read_log(log)
        length = len(whole.samples.cycle)
        line = (
            f"a whole recording: {tap.syncs} SYNCs, {length} samples, "
            f"{time.monotonic() - begun:.0f} s of wall time"
        )
        print_line(line)
        done = []
        for number in range(kills):
            target = chance.randrange(1, length)
            done.append(kill_once(cell_file, plan, folder, target))
            one = done[-1]
            print_line(
                f"kill {number + 1}: sent {one.sent} = recovered {one.recovered} + lost "
                f"{one.lost}, as sent: {one.same}"
            )
        data = log.read_bytes()
        changed = flipped(data, chance)
        flips = damage(log, changed, damages)
        cuts = damage(log, cut(data, chance), damages)
    kept = (
        all(one.kept for one in done) and flips.kept and cuts.kept and tap.syncs == ASKED + length
    )
    extra_syncs = tap.syncs - ASKED
    return {
        "kept": kept,
        "promised_ms": PROMISED_MS,
        "seed": seed,
        "whole": {
            "sent": extra_syncs,
            "logged": length,
            "as_sent": _as_sent(whole.samples, tap.answers),
        },
        "kills": [asdict(one) for one in done],
        "largest_loss_ms": max((one.lost_ms for one in done), default=None),
        "bit_flips": asdict(flips),
        "truncations": asdict(cuts),
        "machine": {"cores": os.cpu_count(), "load": os.getloadavg()[0]},
    }


def main(arguments: list[str] | None = None) -> int:
    """Write the study; 1 when a promise was broken."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.crash_study", description=__doc__
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument(
        "--damages", type=int, default=200, help="bit flips, and as many truncations"
    )
    parser.add_argument("--seconds", type=float, default=12.0, help="of the plan [s]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    document = study(options.kills, options.damages, options.seconds, options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document, indent=1)
    options.out.write_text(text + "\n", encoding="utf-8")
    line = (
        f"largest loss of {len(document['kills'])} kills: {document['largest_loss_ms']} ms, "
        f"{PROMISED_MS:g} promised"
    )
    print_line(line)
    for title in ("bit_flips", "truncations"):
        found = document[title]
        counts = ", ".join(
            f"{key} {found[key]}" for key in ("named", "same", "wrong", "crashed", "salvage_wrong")
        )
        print_line(f"{found['tried']} {title.replace('_', ' ')}: {counts}")
    print_line(f"every promise kept: {document['kept']}; {options.out}")
    return 0 if document["kept"] else 1


if __name__ == "__main__":
    sys.exit(main())
