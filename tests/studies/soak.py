"""`make soak`: recordings at rising rates beside an open console and screens that nobody reads.

    python -m tests.studies.soak --minutes 60 --results docs/evidence/data/soak.csv

The demo cell, a hub (or vcan0 where there is one), the recorder and the console run in processes of
their own. An independent listener (tests/vcan/listener.py) receives every frame with the stamps of
the transport, and a watch (tests/vcan/host_watch.py) notes what the machine takes from the
programs. tests/studies/soak_judge.py says of each lost value whether the host lost it, or we.

First comes one recording at each rate. Then recordings follow at the highest rate at which a
recording came to its end and we have lost nothing in any row, until all rows together last so many
minutes. Every recording leaves a row: a run that was broken off goes on behind its last one.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path

from tests.chaos.ends import ChaosBus
from tests.chaos.processes import READY, Shared, Verb, hub_running, serve_cell, warm_up
from tests.chaos.screens import Screen, plain
from tests.faults.test_scenario import PLAN
from tests.studies.console_study import console
from tests.studies.output import print_line
from tests.studies.soak_judge import Cause, LossKind, Verdict, cause_of_end, judge_losses
from tests.vcan.cells import write_cell, write_simulation
from tests.vcan.host_watch import watched, watching
from tests.vcan.judgement import SYNC
from tests.vcan.listener import heard, listening
from tests.vcan.log_reader import read_recorded
from tests.vcan.run import INTERFACE

RATES_HZ = (25, 50, 100, 125, 200, 250, 400, 500)
SPEED = 0.2
PAIR_S = 4.9
"""Speed of the moves, as a fraction of the plan's, and time of PLAN at that speed."""
STALL_S = 5.0
READ_S = 0.2
"""Nobody reads the recorder's screen for the first time, then somebody for the second."""
START_S = 60.0
USAGE = 2  #: Exit code of a verb whose arguments are wrong
OVERDUE_S = 120.0
"""A recording that lasts so much longer than its plan is ended."""


@dataclass(frozen=True)
class Row:
    """One recording."""

    begun: str  #: UTC
    bus: str  #: kernel or hub
    processors: int
    priority: str  #: of hub, cell and recorder: usual or realtime
    rate_hz: int
    screen: str  #: pipe or terminal
    seconds: float  #: of the samples
    code: str  #: exit code of the recorder
    ended_by: str  #: host or ours, where supervision ended it
    frames: int  #: heard by the listener
    values: int  #: of all axes in all periods
    lost_by_us: int  #: of these values, with UNCOUNTED ones
    lost_by_host: int
    no_sync: int  #: values of periods without SYNC
    late: int  #: values whose answer came behind the next SYNC, or not at all
    unread: int  #: values that were on the bus in time
    doubtful: int  #: values marked because the answer before was late
    wrong: int  #: violations of what a log promises
    neighbours: int  #: values of the cycle before or after, in a log that is refused for that
    starved_percent: float  #: of the periods, with at least half a period taken by the host
    load: float  #: mean load of the machine in the last minute

    @property
    def is_ours(self) -> bool:
        """Whether we lost anything, or ended the recording."""
        return bool(self.lost_by_us or self.wrong or self.ended_by == Cause.OURS.value)

    @property
    def is_the_hosts(self) -> bool:
        """Whether the host lost anything, or ended the recording."""
        return bool(self.lost_by_host or self.ended_by == Cause.HOST.value)


NAMES = tuple(field.name for field in fields(Row))


def append_row(path: Path, row: Row) -> None:
    """Append a row, under a head in a new file."""
    is_new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(NAMES)
        writer.writerow([getattr(row, name) for name in NAMES])


def read_rows(path: Path) -> list[Row]:
    """Return the rows that there are."""
    if not path.exists():
        return []
    kinds = {field.name: field.type for field in fields(Row)}
    readers = {"int": int, "float": float, "str": str}
    rows = []
    with path.open(newline="", encoding="utf-8") as file:
        for one in csv.DictReader(file):
            values = {name: readers[str(kinds[name])](one[name]) for name in NAMES}
            rows.append(Row(**values))
    return rows


def next_rate(rows: Sequence[Row], rates: Sequence[int]) -> int:
    """Return the rate of the next recording.

    Each rate comes once. Then come the highest one that is proved and, in turn with it, the next
    higher one, if only the host has spoilt that: the machine may have less other work by now.
    """
    for rate_hz in sorted(rates):
        if not any(row.rate_hz == rate_hz for row in rows):
            return rate_hz
    best_hz = highest_rate(rows) or min(rates)
    ours = {row.rate_hz for row in rows if row.is_ours}
    higher_hz = [rate_hz for rate_hz in rates if rate_hz > best_hz and rate_hz not in ours]
    if rows[-1].rate_hz == best_hz and higher_hz:
        return min(higher_hz)
    return best_hz


def highest_rate(rows: Sequence[Row], *, with_host: bool = False) -> int | None:
    """Return the highest rate that is proved: a recording came to its end, and none has a loss of
    ours; `with_host`: nor any other loss.
    """
    bad = {row.rate_hz for row in rows if row.is_ours or (with_host and row.is_the_hosts)}
    whole = {row.rate_hz for row in rows if not row.ended_by}
    return max(whole - bad, default=None)


def summary(rows: Sequence[Row]) -> Iterator[str]:
    """Lines about all recordings, by rate."""
    yield (
        f"{'Hz':>4} {'runs':>4} {'minutes':>7} {'frames':>9} {'values':>9} {'by us':>6} "
        f"{'by host':>7} {'ended':>5} {'starved':>7}"
    )
    for rate_hz in sorted({row.rate_hz for row in rows}):
        own = [row for row in rows if row.rate_hz == rate_hz]
        minutes = sum(row.seconds for row in own) / 60.0
        starved = max(row.starved_percent for row in own)
        ended = sum(bool(row.ended_by) for row in own)
        yield (
            f"{rate_hz:>4} {len(own):>4} {minutes:>7.1f} {sum(row.frames for row in own):>9} "
            f"{sum(row.values for row in own):>9} {sum(row.lost_by_us for row in own):>6} "
            f"{sum(row.lost_by_host for row in own):>7} {ended:>5} "
            f"{starved:>6.1f}%"
        )
    yield f"highest rate without a loss of ours: {highest_rate(rows)} Hz"
    yield f"highest rate without any loss: {highest_rate(rows, with_host=True)} Hz"


# -- one recording
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """What the recordings of one rate share."""

    bus: ChaosBus
    folder: Path
    rate_hz: int
    cell: Path
    truth: Path
    plan: Path
    realtime: bool  #: whether hub, cell and recorder have real-time priority

    @classmethod
    def at(
        cls, folder: Path, bus: ChaosBus, rate_hz: int, seconds: float, *, realtime: bool
    ) -> Place:
        """Write cell, simulation and plan."""
        folder.mkdir(parents=True)
        period_us = 1_000_000 // rate_hz
        pacing = "timed"
        if bus.port is None:
            pacing = "timed\n  producer: kernel"
        cell = write_cell(folder, period_us, pacing, bus.settings)
        head, moves, body = PLAN.partition("moves:\n")
        plan = folder / "plan.yaml"
        plan.write_text(head + moves + body * max(1, round(seconds / PAIR_S)), encoding="utf-8")
        truth = write_simulation(folder, period_us)
        return cls(bus, folder, rate_hz, cell, truth, plan, realtime)


@contextmanager
def urgent(realtime: bool) -> Iterator[None]:
    """Give programs that are started in the block real-time priority."""
    if not realtime:
        yield
        return
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def cell_running(place: Place) -> Iterator[Verb]:
    """Run the amplifiers in a process of their own."""
    shared = Shared()
    words = place.folder / "cell.txt"
    with urgent(place.realtime):
        cell = Verb.start(words, lambda: serve_cell(place.truth, place.bus, (), shared))
    try:
        deadline_s = time.monotonic() + START_S
        while READY not in cell.said and cell.running and time.monotonic() < deadline_s:
            time.sleep(0.05)
        yield cell
    finally:
        cell.end(signal.SIGINT)


def play_screen(process: subprocess.Popen[bytes], screen: Screen, limit_s: float) -> None:
    """Stop the reader of a recorder's screen again and again until the recorder has ended;
    end it after a time.
    """
    deadline_s = time.monotonic() + limit_s
    while process.poll() is None:
        if time.monotonic() > deadline_s:
            process.send_signal(signal.SIGINT)
        screen.stop()
        with suppress(subprocess.TimeoutExpired):
            process.wait(STALL_S)
        screen.go_on()
        with suppress(subprocess.TimeoutExpired):
            process.wait(READ_S)


def record(place: Place, cell: Verb, seconds: float, *, terminal: bool) -> tuple[Row, Verdict]:
    """Make one recording and judge it."""
    folder = place.folder
    log = folder / "run.mcap"
    part = log.with_name(f"{log.name}.part")
    for path in (log, part):
        path.unlink(missing_ok=True)
    begun = datetime.now(UTC)
    words = folder / "record.txt"
    command = [sys.executable, "-m", "daq", "record", str(place.cell), str(place.plan)]
    command += ["--out", str(log), "--operator", "soak", "--speed", str(SPEED), "--enable-motion"]
    screen = Screen(words, terminal=terminal)
    with (
        watching(folder / "host") as watch,
        listening(place.bus.address, folder / "frames"),
    ):
        watch.add("cell", cell.pid)
        if place.bus.pid is not None:
            watch.add("hub", place.bus.pid)
        with ExitStack() as stack:
            with urgent(place.realtime):
                process = stack.enter_context(
                    subprocess.Popen(
                        command,
                        stdin=subprocess.DEVNULL,
                        stdout=screen.inside,
                        stderr=screen.inside,
                    )
                )
            watch.add("recorder", process.pid)
            # Without a reader of its screen it would not end.
            stack.callback(screen.go_on)
            stack.callback(process.kill)
            play_screen(process, screen, seconds + START_S + OVERDUE_S)
            ended_ns = time.time_ns()
    screen.close()
    code = process.returncode
    said = plain(words.read_text(encoding="utf-8", errors="replace"))
    if code == USAGE:
        raise RuntimeError(f"the recorder refuses its arguments: {said}")
    frames = heard(folder / "frames")
    ticks = watched(folder / "host")
    recorded = None
    for path in (log, part):
        if path.exists() and path.stat().st_size:
            recorded = read_recorded(path)
            break
    verdict = Verdict()
    lasted_s = 0.0
    if recorded is not None:
        lasted_s = 1e-9 * float(recorded.time_ns[-1] - recorded.time_ns[0])
        verdict = judge_losses(
            recorded,
            frames,
            ticks,
            1_000_000_000 // place.rate_hz,
            same_sync_ns=place.bus.same_sync_ns,
            in_order=place.bus.in_order,
        )
    ended_by = ""
    if not log.exists():
        verdict.notes.append(said[said.find("error:") :])
        if recorded is not None:
            ended_ns = recorded.started_ns + round(1e9 * lasted_s)
        else:
            syncs_ns = [frame.time_ns for frame in frames if frame.identifier == SYNC]
            ended_ns = max(syncs_ns, default=ended_ns)
        ended_by = cause_of_end(verdict, recorded, ticks, ended_ns).value
    kinds = verdict.by_kind()
    row = Row(
        begun=begun.isoformat(timespec="seconds"),
        bus="kernel" if place.bus.port is None else "hub",
        processors=len(os.sched_getaffinity(0)),
        priority="realtime" if place.realtime else "usual",
        rate_hz=place.rate_hz,
        screen="terminal" if terminal else "pipe",
        seconds=round(lasted_s, 1),
        code=str(code),
        ended_by=ended_by,
        frames=verdict.frames,
        values=verdict.values,
        lost_by_us=verdict.lost(Cause.OURS),
        lost_by_host=verdict.lost(Cause.HOST),
        no_sync=kinds[LossKind.NO_SYNC],
        late=kinds[LossKind.LATE],
        unread=kinds[LossKind.UNREAD] + kinds[LossKind.UNCOUNTED],
        doubtful=kinds[LossKind.DOUBTFUL],
        wrong=verdict.wrong,
        neighbours=verdict.neighbours,
        starved_percent=round(100.0 * verdict.starved_share, 1),
        load=round(os.getloadavg()[0], 1),
    )
    return row, verdict


# -- the soak
# ------------------------------------------------------------------------------------------------


def soak(bus: ChaosBus, folder: Path, options: argparse.Namespace) -> list[Row]:
    """Record until all rows together last so many minutes."""
    results: Path = options.results
    minutes: float = options.minutes
    seconds: float = options.seconds
    rates: list[int] = options.rates
    rows = read_rows(results)
    visit = 0
    while sum(row.seconds for row in rows) < 60.0 * minutes:
        rate_hz = next_rate(rows, rates)
        visit += 1
        place = Place.at(
            folder / f"{visit}-{rate_hz}", bus, rate_hz, seconds, realtime=options.realtime
        )
        with cell_running(place) as cell, console(place.cell, unread=True):
            while next_rate(rows, rates) == rate_hz:
                earlier = sum(one.rate_hz == rate_hz for one in rows)
                terminal = earlier % 2 == 1
                row, verdict = record(place, cell, seconds, terminal=terminal)
                rows.append(row)
                append_row(results, row)
                print_line(" ".join(f"{name}={getattr(row, name)}" for name in NAMES))
                for loss in verdict.losses:
                    if loss.cause is Cause.OURS:
                        print_line(f"  ours: cycle {loss.cycle}, {loss.kind.value}")
                for note in verdict.notes:
                    print_line(f"  {note}")
                if row.is_ours and options.keep is not None:
                    shutil.copytree(place.folder, options.keep / f"recording-{len(rows)}")
                if sum(one.seconds for one in rows) >= 60.0 * minutes:
                    break
    return rows


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="of all samples together")
    parser.add_argument("--seconds", type=float, default=60.0, help="of one recording")
    parser.add_argument(
        "--rates", type=int, nargs="+", default=list(RATES_HZ), metavar="HZ", help="to try"
    )
    parser.add_argument("--results", type=Path, required=True, help="CSV file of the rows")
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="FOLDER",
        help="copy the files of a recording with a loss of ours there",
    )
    parser.add_argument(
        "--hub", action="store_true", help="record over a hub even where there is vcan0"
    )
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="give hub, cell and recorder real-time priority, on a machine with other work; needs "
        "root",
    )
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Soak; 1 where we have lost something at every rate."""
    options = arguments(words)
    # The processes of a recording end, too
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="soak-")))
        bus = ChaosBus()
        warm_up(write_simulation(folder, 1_000_000 // max(options.rates)))
        if options.hub or not (Path("/sys/class/net") / INTERFACE).exists():
            with urgent(options.realtime):
                bus = stack.enter_context(hub_running())
        rows = soak(bus, folder, options)
    for line in summary(rows):
        print_line(line)
    return int(highest_rate(rows) is None)


if __name__ == "__main__":
    sys.exit(main())
