"""Kills and failures at every changing system call of the verbs that write gains,
and what the disk has afterwards.

    python -m tests.studies.write_faults [--minutes 60] [--tables docs/evidence/data]      goes on where it ended

One unit is one changing call of one verb: a kill (SIGKILL) before it, and EIO, ENOSPC, EROFS and
EDQUOT, once and from that call on. After each of them: the controller's file is the old one or the
new one, the audit log holds, each sentence that was printed is true, the exit code is right; then
the same command, or `history --add` where the write was done, ends with 0, and so does `history
--verify`. Nothing is drawn at random: every call is taken.
"""  # noqa: E501

from __future__ import annotations

import argparse
import errno
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.cli.app import main as drivegain
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.files import replace_file
from daq.ledger.audit import AuditAction, verify
from tests.daq.calibrations import calibration_for
from tests.daq.failing_calls import Call, Fault, traced, why_not_here
from tests.daq.histories import ledger_of
from tests.daq.killing import in_a_child
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.output import print_line
from tests.studies.study_rows import rows_of_unit, to_csv, work_off
from tests.studies.write_truth import Content, Facts, false_sentences, wrong_code

OUT = Path("out/write-faults")
MODULE = "tests.studies.write_faults"
VERBS = ("apply", "rollback")
ERRORS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT)
KILL = "SIGKILL"
#: A disk in memory, where there is one: the flushes of a real one take most of the time
MEMORY = Path("/dev/shm")
ENDS = (AuditAction.APPLIED, AuditAction.ROLLED_BACK, AuditAction.FAILED)


@dataclass(frozen=True, slots=True)
class CallUnit:
    """One changing call of a verb."""

    verb: str
    number: int  #: of the call, from 0
    call: str
    file: str  #: what the call changes, in words

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.verb}-{self.number:03d}"


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One fault and what it has left."""

    verb: str
    number: int
    call: str
    file: str
    error: str  #: name of the error, or SIGKILL
    is_lasting: bool  #: every later changing call failed as well
    code: int  #: exit code; -1 where it was killed
    content: str  #: of the controller's file
    false_sentences: tuple[str, ...]
    bad_states: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FaultCount:
    """Faults of one kind at one kind of call."""

    verb: str
    call: str
    error: str
    cases: int
    old_file: int
    new_file: int
    false_sentences: int
    bad_states: int


class Scene:
    """A cell in a folder, as a verb finds it before each case;
    the verb is run in forks of this process.
    """

    def __init__(self, folder: Path, verb: str) -> None:
        self.verb = verb
        self._place = folder / "place"
        self._kept = folder / "kept"
        self._said = folder / "said"
        shipped = shipped_configurations()
        ignored = shutil.ignore_patterns("*.jsonl*", "*.sqlite*")
        shutil.copytree(shipped, self._place / "configs", ignore=ignored)
        self.cell = self._place / "configs" / "cells" / "demo.yaml"
        controller = load_cell(self.cell).controller_path
        assert controller is not None
        self.controller = controller
        self.calibration = calibration_for(self.cell)
        if verb == "rollback":
            self._require(self._apply)
        shutil.copytree(self._place, self._kept)
        self.old = self.controller.read_bytes()
        # Here, not in a fork, so that every fork has what is imported late.
        code = drivegain(self.command)
        assert code == 0
        self.new = self.controller.read_bytes()
        assert self.new != self.old
        self.restore()
        whole = traced(lambda: self._quiet(self.command), self._is_counted)
        assert whole.code == 0
        self.calls: tuple[Call, ...] = whole.calls

    @property
    def _apply(self) -> list[str]:
        return ["apply", str(self.cell), str(self.calibration), "--yes"]

    @property
    def command(self) -> list[str]:
        """The command line that writes."""
        if self.verb == "apply":
            return self._apply
        return ["rollback", str(self.cell)]

    def restore(self) -> None:
        """Put everything back, as it was before the verb."""
        shutil.rmtree(self._place)
        shutil.copytree(self._kept, self._place)

    def units(self) -> Iterator[CallUnit]:
        """Every changing call."""
        for number, call in enumerate(self.calls):
            yield CallUnit(self.verb, number, call.name, self.kind_of(call.path))

    def kind_of(self, path: Path) -> str:
        """What a path is, in words."""
        name = path.name.removesuffix(" (deleted)")
        if path.is_dir():
            return f"folder {name}"
        for ending, kind in (
            (".lock", "lock"),
            (".jsonl", "audit log"),
            (".head", "note of the audit log"),
        ):
            if name.endswith(ending):
                return kind
        is_copy = name.endswith(".tmp")
        kind = "backup" if ".bak" in name else "controller's file"
        return f"copy for the {kind}" if is_copy else kind

    def run(self, unit: CallUnit, error: int | None, *, is_lasting: bool = False) -> FaultRow:
        """Make one fault, and judge what it has left."""
        self.restore()
        before = self._files()
        fault = Fault(unit.number, error, is_lasting)
        found = traced(lambda: self._quiet(self.command), self._is_counted, fault)
        said = self._said.read_text(encoding="utf-8", errors="replace")
        messages = messages_of(said)
        facts = self._facts(before)
        states = [
            *self._bad_states(facts),
            wrong_code(found.code, " ".join(messages.split()), facts),
        ]
        states += self._bad_follow_up(facts)
        return FaultRow(
            verb=unit.verb,
            number=unit.number,
            call=unit.call,
            file=unit.file,
            error=KILL if error is None else errno.errorcode[error],
            is_lasting=is_lasting,
            code=-1 if found.code is None else found.code,
            content=facts.content.value,
            false_sentences=false_sentences(messages, facts),
            bad_states=tuple(state for state in states if state),
        )

    def _facts(self, before: dict[Path, bytes]) -> Facts:
        content = self.controller.read_bytes()
        kind = {self.old: Content.OLD, self.new: Content.NEW}.get(content, Content.BROKEN)
        ledger = ledger_of(self.cell)
        entries = verify(ledger.audit).entries
        ended = tuple(one.action.value for one in entries if one.action in ENDS)
        earlier = 1 if self.verb == "rollback" else 0
        calibrations = [one for one in entries if one.action is AuditAction.CALIBRATION_ENTERED]
        is_ended = len(ended) > earlier and ended[-1] != AuditAction.FAILED.value
        has_write = is_ended and (self.verb == "rollback" or bool(calibrations))
        return Facts(kind, self.controller, before, self._files(), ended, has_write)

    def _bad_states(self, facts: Facts) -> Iterator[str]:
        if facts.content is Content.BROKEN:
            yield "the controller's file is neither the old one nor the new one"
        mode = self.controller.stat().st_mode
        if mode != (self._kept / self.controller.relative_to(self._place)).stat().st_mode:
            yield "the mode of the controller's file has changed"
        if not verify(ledger_of(self.cell).audit).holds:
            yield "the audit log does not hold"
        earlier = 1 if self.verb == "rollback" else 0
        for action in facts.ended[earlier:]:
            if action == AuditAction.FAILED.value:
                expected = Content.OLD
            else:
                expected = Content.NEW
            if facts.content is not expected:
                yield f"the audit log says {action}"

    def _bad_follow_up(self, facts: Facts) -> Iterator[str]:
        """Run the next commands; they must end with 0."""
        if facts.content is Content.OLD or self.verb == "apply":
            if self._run(self.command) != 0:
                yield "the same command again does not end with 0"
            elif self.controller.read_bytes() != self.new:
                yield "the same command again leaves another file"
        else:
            add = ["history", str(self.cell), "--add", str(self.calibration)]
            if self._run(add) != 0:
                yield "history --add does not end with 0"
        if self._run(["history", str(self.cell), "--verify"]) != 0:
            yield "history --verify does not end with 0 after the next command"

    def _files(self) -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in self._place.rglob("*") if path.is_file()}

    def _is_counted(self, path: Path) -> bool:
        return path.is_relative_to(self._place)

    def _quiet(self, command: Sequence[str]) -> int:
        """Run a command with its output in a file; only in a fork."""
        out = os.open(self._said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        return drivegain(command)

    def _run(self, command: Sequence[str]) -> int:
        _, status = os.waitpid(in_a_child(lambda: self._quiet(command)), 0)
        return os.waitstatus_to_exitcode(status)

    def _require(self, command: Sequence[str]) -> None:
        assert self._run(command) == 0


def messages_of(said: str) -> str:
    """What was printed without the table and the diff of the gains,
    whose lines claim nothing about files.
    """
    kept = [
        line
        for line in said.splitlines()
        if not line.startswith(("+", "-", " ", "@@", "J", "axis", "*", "─"))
    ]
    return "\n".join(kept)


def faults_of(call: str) -> list[tuple[int | None, bool]]:
    """Faults of a call: error, None for a kill, and whether it lasts.

    A kill at a close is one at the next call.
    """
    kills: list[tuple[int | None, bool]]
    if call == "close":
        kills = []
    else:
        kills = [(None, False)]
    return [*kills, *[(error, is_lasting) for error in ERRORS for is_lasting in (False, True)]]


def rows_at(scene: Scene, unit: CallUnit) -> list[FaultRow]:
    """Every fault at one call."""
    return [scene.run(unit, error, is_lasting=lasting) for error, lasting in faults_of(unit.call)]


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
        found.append(
            FaultCount(
                verb=verb,
                call=call,
                error=error,
                cases=len(of_group),
                old_file=sum(row.content == Content.OLD.value for row in of_group),
                new_file=sum(row.content == Content.NEW.value for row in of_group),
                false_sentences=sum(bool(row.false_sentences) for row in of_group),
                bad_states=sum(bool(row.bad_states) for row in of_group),
            )
        )
    return found


def main(arguments: list[str] | None = None) -> int:
    """Take the calls that were not taken yet; 1 where a sentence was false or a state bad."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {MODULE}",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--verbs", nargs="+", choices=VERBS, default=list(VERBS))
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no call is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--tables", type=Path, help="folder for the table of counts")
    options = parser.parse_args(arguments)
    reason = why_not_here()
    if reason:
        print_line(reason)
        return 1
    source = digest_of_source(MODULE, ("daq", "drivers", "ident", "tests"))
    rows: list[FaultRow] = []
    left = 0
    end_s = time.monotonic() + 60.0 * options.minutes
    for verb in options.verbs:
        with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
            scene = Scene(Path(folder).resolve(), verb)

            def done(unit: CallUnit, scene: Scene = scene) -> str:
                found = rows_of_unit(
                    options.out,
                    unit,
                    FaultRow,
                    digest(source, unit),
                    lambda one: rows_at(scene, one),
                )
                rows.extend(found)
                wrong = sum(bool(row.false_sentences or row.bad_states) for row in found)
                return f"{unit.name} {unit.call} of {unit.file}: {len(found)} faults, {wrong} wrong"

            minutes = max(0.0, end_s - time.monotonic()) / 60.0
            left += work_off(list(scene.units()), done, minutes, time.monotonic, print_line)
    for row in rows:
        for text in (*row.false_sentences, *row.bad_states):
            print_line(
                f"{row.verb} {row.number} {row.call} {row.file} {row.error} "
                f"{row.is_lasting}: {text}"
            )
    table = counts(rows)
    wrong = sum(bool(row.false_sentences or row.bad_states) for row in rows)
    print_line(f"{len(rows)} cases, {wrong} of them wrong; {left} calls were not begun")
    if options.tables is not None and left == 0:
        replace_file(options.tables / "write-faults.csv", to_csv(FaultCount, table).encode())
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
