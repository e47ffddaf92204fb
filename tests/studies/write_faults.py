"""Kills, errors and short writes at every changing system call of the verbs that write gains,
and what the disk and the drives have afterwards.

    python -m tests.studies.write_faults [--verbs apply calibrate] [--minutes 60] [--tables docs/evidence/data]      goes on where it ended

One unit is one changing call of one verb: a kill (SIGKILL) before it; EIO, ENOSPC, EROFS and
EDQUOT, once and from that call on; and for a write(2), that the system takes half of it. `apply
--drives`, `recalibrate` and `calibrate` take longer: there each call gets the kill, each error
either once or from that call on, and the short write. After each fault: the controller's file is
the old one or the new one, drives have old and new gains of which a record knows, the audit log
holds, the history has what was written, each sentence that was printed is true, the exit code is
right; then the same command, or `history --add` where the write was done, ends with 0, and so does
`history --verify`.
Nothing is drawn at random: every call is taken.
"""  # noqa: E501

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.files import replace_file
from tests.daq.failing_calls import why_not_here
from tests.daq.jobs.made import whole_job
from tests.daq.jobs.made_session import whole_session
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.output import print_line
from tests.studies.session_kills import made_once
from tests.studies.study_rows import finished_rows, from_csv, rows_of_unit, to_csv, work_off
from tests.studies.write_scenes import (
    FILE_SCENES,
    CallUnit,
    FaultRow,
    JobScene,
    Scene,
    SessionScene,
)
from tests.studies.write_truth import Content

OUT = Path("out/write-faults")
MODULE = "tests.studies.write_faults"
VERBS = (*(scene.verb for scene in FILE_SCENES), JobScene.verb, SessionScene.verb)
#: A disk in memory, where there is one: the flushes of a real one take most of the time
MEMORY = Path("/dev/shm")


@dataclass(frozen=True, slots=True)
class FaultCount:
    """Faults of one kind at one kind of call."""

    verb: str
    call: str
    error: str
    cases: int
    old_file: int
    new_file: int
    both: int  #: drives, some with old gains and some with new ones
    false_sentences: int
    bad_states: int


def made_scene(verb: str, folder: Path, out: Path) -> Scene:
    """The scene of a verb in a folder, set up; a job that it copies is kept in `out`."""
    scene: Scene
    if verb == JobScene.verb:
        scene = JobScene(folder, made_once(out / "job", _made_from("made"), whole_job))
    elif verb == SessionScene.verb:
        made = made_once(out / "session", _made_from("made_session"), whole_session)
        scene = SessionScene(folder, made)
    else:
        (kind,) = [one for one in FILE_SCENES if one.verb == verb]
        scene = kind(folder)
    scene.set_up()
    return scene


def _made_from(name: str) -> str:
    rooms = ("daq", "drivers", "ident", "tests")
    return digest_of_source(f"tests.daq.jobs.{name}", rooms)


def rows_at(scene: Scene, unit: CallUnit) -> list[FaultRow]:
    """Every fault at one call."""
    return [scene.run(unit, injection) for injection in scene.injections(unit)]


def counts(rows: Sequence[FaultRow]) -> list[FaultCount]:
    """Exact counts by verb, call and error."""
    groups: dict[tuple[str, str, str], list[FaultRow]] = {}
    for row in rows:
        if row.is_lasting:
            error = f"{row.error} from then on"
        else:
            error = row.error
        groups.setdefault((row.verb, row.call, error), []).append(row)
    found = []
    for (verb, call, error), of_group in groups.items():
        old_file = sum(row.content == Content.OLD.value for row in of_group)
        new_file = sum(row.content == Content.NEW.value for row in of_group)
        both = sum(row.content == Content.MIXED.value for row in of_group)
        false_sentences = sum(bool(row.false_sentences) for row in of_group)
        bad_states = sum(bool(row.bad_states) for row in of_group)
        fault_count = FaultCount(
            verb=verb,
            call=call,
            error=error,
            cases=len(of_group),
            old_file=old_file,
            new_file=new_file,
            both=both,
            false_sentences=false_sentences,
            bad_states=bad_states,
        )
        found.append(fault_count)
    return found


def with_other_verbs(
    table: Path, rows: Sequence[FaultRow], verbs: Sequence[str]
) -> tuple[FaultRow, ...]:
    """Rows of some verbs, and those of the others that a table has, in the order of `VERBS`."""
    found = list(rows)
    if table.is_file():
        text = table.read_text(encoding="utf-8")
        for row in from_csv(FaultRow, text):
            if row.verb not in verbs:
                found.append(row)
    return tuple(sorted(found, key=lambda row: VERBS.index(row.verb)))


def main(arguments: list[str] | None = None) -> int:
    """Take the calls that were not taken yet; 1 where a sentence was false or a state bad."""
    prog = f"python -m {MODULE}"
    parser = argparse.ArgumentParser(
        prog=prog,
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--verbs", nargs="+", choices=VERBS, default=list(VERBS))
    parser.add_argument("--every", type=int, default=1, help="take every k-th call of a verb")
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no call is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--tables", type=Path, help="folder for the table of counts")
    options = parser.parse_args(arguments)
    reason = why_not_here()
    if reason:
        print_line(reason)
        return 1
    rooms = ("daq", "drivers", "ident", "tests")
    source = digest_of_source(MODULE, rooms)

    def fingerprint_of(unit: CallUnit) -> str:
        # Not the number of bytes, which a time or a path in a file may change.
        return digest(source, unit.name, unit.call, unit.file)

    every_unit: list[CallUnit] = []
    left = 0
    end_s = time.monotonic() + 60.0 * options.minutes
    for verb in options.verbs:
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            path = Path(folder).resolve()
            scene = made_scene(verb, path, options.out)

            def done(unit: CallUnit, scene: Scene = scene) -> str:
                found = rows_of_unit(
                    options.out,
                    unit,
                    FaultRow,
                    fingerprint_of(unit),
                    lambda one: rows_at(scene, one),
                )
                wrong = sum(bool(row.false_sentences or row.bad_states) for row in found)
                return f"{unit.name} {unit.call} of {unit.file}: {len(found)} faults, {wrong} wrong"

            every_unit += scene.units()
            units = list(scene.units())[:: options.every]
            end_difference_s = end_s - time.monotonic()
            minutes = max(0.0, end_difference_s) / 60.0
            left += work_off(units, done, minutes, time.monotonic, print_line)
            scene.close()
    rows = finished_rows(options.out, every_unit, FaultRow, fingerprint_of)
    for row in rows:
        for text in (*row.false_sentences, *row.bad_states):
            line = (
                f"{row.verb} {row.number} {row.call} {row.file} {row.error} "
                f"{row.is_lasting}: {text}"
            )
            print_line(line)
    wrong = sum(bool(row.false_sentences or row.bad_states) for row in rows)
    print_line(f"{len(rows)} cases, {wrong} of them wrong; {left} calls were not begun")
    if options.tables is not None and left == 0:
        table_of_rows = options.tables / "write-fault-rows.csv"
        every_row = with_other_verbs(table_of_rows, rows, options.verbs)
        content = to_csv(FaultRow, every_row).encode()
        replace_file(table_of_rows, content)
        every_count = to_csv(FaultCount, counts(every_row))
        write_faults_path = options.tables / "write-faults.csv"
        replace_file(write_faults_path, every_count.encode())
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
