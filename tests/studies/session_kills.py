"""Guided sessions that are killed (-9) at random moments of all stages,
each finished by the same command.

    python -m tests.studies.session_kills --kills 40 --seed 1 --minutes 60      goes on where it ended
    python -m tests.studies.session_kills --real 5

A moment is drawn from the tools that a session calls (`daq.jobs.context.Tools`): any tool, any of
its calls, any time of that call. So the write, which takes milliseconds, is hit as often as a
recording. After each kill the same command is started until it ends with 0. Then there is one
session, one certificate that says "accepted", and one write; the controller's file was the old or
the new one at any time; and the interlock was asked right before each motion. A kill that does not
end so is an AssertionError.

One session is made first, over the driver. The others copy its recordings, and know the result of
its fits. With `--real`, recordings are made over the driver, at a simulated cell that is a process
of its own and goes on when the session is killed; these kills are all drawn from recordings.
Layout: out/session-kills/<number>.csv.
"""  # noqa: E501

from __future__ import annotations

import argparse
import pickle
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from daq.files import replace_file
from tests.daq.jobs.made import Made
from tests.daq.jobs.made_session import MadeSession, whole_session
from tests.daq.jobs.rig import Rig
from tests.daq.jobs.test_killed_recording import cell_process
from tests.daq.jobs.test_killed_session import (
    Moment,
    TimedCall,
    drawn_moment,
    ends_well_after,
    killed_rig,
    timed_calls,
)
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.output import print_line
from tests.studies.study_rows import rows_of_unit, work_off

OUT = Path("out/session-kills")
RECORDINGS = 4  #: Of a session: three blocks, and the moves that accept the gains
RECORDING_S = 10.0  #: Some time within or behind a recording
MODULE = "tests.studies.session_kills"
MadeThing = TypeVar("MadeThing", bound=Made)


@dataclass(frozen=True, slots=True)
class KillUnit:
    """One session that is killed."""

    number: int
    seed: int
    real: bool  #: with recordings over the driver

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{'real' if self.real else 'copied'}-{self.seed}-{self.number}"


@dataclass(frozen=True, slots=True)
class KillRow:
    """How it went."""

    number: int
    real: bool
    tool: str  #: that was called last
    in_time: bool  #: killed before the session ended
    was_written: bool  #: the controller had the new gains by then
    attempts: int  #: of the same command after the kill


def kill(unit: KillUnit, made: MadeSession, calls: Sequence[TimedCall]) -> KillRow:
    """Kill a session, and let the same command finish it."""
    chance = random.Random(f"{unit.seed} {unit.number}")
    moment = drawn_moment(list(calls), chance)
    if unit.real:
        number = chance.randrange(RECORDINGS)
        wait_s = chance.uniform(0.0, RECORDING_S)
        moment = Moment("record", number, wait_s)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / f"cell-{unit.number}"
        rig = killed_rig(folder, made, real=unit.real)
        if not unit.real:
            found = ends_well_after(rig, moment)
        else:
            with cell_process(rig):
                found = ends_well_after(rig, moment)
    return KillRow(
        unit.number, unit.real, found.tool, found.in_time, found.was_written, found.attempts
    )


def made_once(
    out: Path, fingerprint: str, make: Callable[[Path], tuple[Rig, MadeThing]]
) -> MadeThing:
    """The session or job that the others copy; it is made unless it is there."""
    path = out / "made.pickle"
    folder = out.absolute() / "made"
    if not is_finished(path, fingerprint):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        _, made = make(folder)
        replace_file(path, pickle.dumps(made))
        finish(path, fingerprint)
    found: MadeThing = pickle.loads(path.read_bytes())
    return found


def summary(rows: Sequence[KillRow]) -> str:
    """What the kills have shown."""
    killed = [row for row in rows if row.in_time]
    after_write = sum(row.was_written for row in killed)
    again = Counter(row.attempts for row in killed)
    tools = Counter(row.tool for row in killed)
    listed = ", ".join(f"{tool} {count}" for tool, count in tools.most_common())
    return (
        f"{len(killed)} sessions killed ({sum(row.real for row in killed)} with recordings over "
        "the driver), "
        f"{after_write} of them after their write; the same command ended with 0 after "
        f"{', '.join(f'{number} more start(s): {count}' for number, count in sorted(again.items()))}\n"  # noqa: E501
        f"last call before the kill: {listed}\n"
        "every session: one certificate, one write, the interlock asked before every motion"
    )


def main(arguments: list[str] | None = None) -> int:
    """Kill what was not killed yet, and print what all kills have shown."""
    prog = f"python -m {MODULE}"
    parser = argparse.ArgumentParser(
        prog=prog,
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--kills", type=int, default=40, help="of sessions that copy their recordings"
    )
    parser.add_argument(
        "--real", type=int, default=0, help="of sessions that record over the driver"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no kill is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    source = digest_of_source(MODULE)
    made = made_once(options.out, digest(source), whole_session)
    units = [KillUnit(number, options.seed, real=True) for number in range(options.real)]
    units += [KillUnit(number, options.seed, real=False) for number in range(options.kills)]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "timed"
        calls = timed_calls(killed_rig(folder, made))
    rows: list[KillRow] = []

    def done(unit: KillUnit) -> str:
        fingerprint = digest(source, unit)
        (row,) = rows_of_unit(
            options.out, unit, KillRow, fingerprint, lambda one: [kill(one, made, calls)]
        )
        rows.append(row)
        return f"{unit.name}: killed in or behind {row.tool}, {row.attempts} more start(s)"

    left = work_off(units, done, options.minutes, time.monotonic, print_line)
    line = f"\n{left} kills were not begun\n{summary(rows)}"
    print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
