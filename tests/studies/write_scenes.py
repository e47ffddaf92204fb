"""The verbs that write gains, each as a scene: a cell in a folder, as the verb finds it before a
fault, and what must be true after it.

A new verb is a class of its own: what it runs, what it writes, and how it goes on after a fault.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import re
import shutil
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import ClassVar

import yaml

from daq.cli.app import main as drivegain
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import DaqError, ExitCode, exit_code
from daq.jobs.calibrate import calibrate
from daq.jobs.certificate import save_certificate
from daq.jobs.job import recalibrate
from daq.jobs.journal import Form, Journal
from daq.jobs.reporting import Conclusion, text
from daq.ledger.audit import AuditAction, verify
from daq.ledger.ledger import Verification, verify_ledger
from daq.writeback.drive_target import read_record, read_records, record_folder
from drivers.canopen import network
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import DriverError, all_notes
from drivers.simulation.hub import Hub
from ident.errors import IdentificationError
from tests.daq.calibrations import NAMEPLATE, calibration_for
from tests.daq.drives import WHOLE, entered_gain, saved_gain, simulated
from tests.daq.failing_calls import SOCKET, Call, Fault, traced
from tests.daq.histories import ledger_of
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.made_session import (
    MadeSession,
    given_answers,
    made_session_rig,
    settings_of,
)
from tests.daq.jobs.rig import WHO, Rig
from tests.daq.killing import in_a_child
from tests.studies.write_truth import Content, Facts, false_sentences, wrong_code

ERRORS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT)
KILL = "SIGKILL"
SHORT = "short write"
ENDS = (AuditAction.APPLIED, AuditAction.ROLLED_BACK, AuditAction.FAILED)
_COPY = re.compile(r"\.(.+)\.\d+-\d+\.tmp")  #: Name of a copy that replaces a file (`replace_file`)
#: Files that no write of gains is: recordings, and what the simulated cell is told
NOT_COUNTED = (".mcap", "mounted", "closed")


@dataclass(frozen=True, slots=True)
class Injection:
    """One kind of fault at a call."""

    name: str  #: of the error, or `KILL`, or `SHORT`
    is_lasting: bool = False  #: later calls meet it as well

    def at(self, number: int, size: int) -> Fault:
        """The fault at a call, which is to write so many bytes."""
        if self.name == KILL:
            return Fault(number)
        if self.name == SHORT:
            length = max(1, size // 2)
            return Fault(number, is_lasting=self.is_lasting, length=length)
        error = getattr(errno, self.name)
        return Fault(number, error, self.is_lasting)


@dataclass(frozen=True, slots=True)
class CallUnit:
    """One changing call of a verb."""

    verb: str
    number: int  #: of the call, from 0
    call: str
    file: str  #: what the call changes, in words
    size: int = 0  #: bytes that it writes

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.verb}-{self.number:03d}"

    @property
    def injections(self) -> tuple[Injection, ...]:
        """Every kind of fault that this call can meet.

        A kill at a close is one at the next call.
        """
        found = []
        if self.call != "close":
            found.append(Injection(KILL))
        for error in ERRORS:
            for is_lasting in (False, True):
                injection = Injection(errno.errorcode[error], is_lasting)
                found.append(injection)
        return (*found, *self._short)

    @property
    def fewer_injections(self) -> tuple[Injection, ...]:
        """The kill, each error either once or from this call on, and the short write:
        for a verb that takes long.
        """
        found = []
        if self.call != "close":
            found.append(Injection(KILL))
        for place, error in enumerate(ERRORS):
            is_lasting = (self.number + place) % 2 == 1
            injection = Injection(errno.errorcode[error], is_lasting)
            found.append(injection)
        return (*found, *self._short[:1])

    @property
    def _short(self) -> tuple[Injection, ...]:
        if self.size < 2:
            return ()
        return (Injection(SHORT), Injection(SHORT, is_lasting=True))


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One fault and what it has left."""

    verb: str
    number: int
    call: str
    file: str
    error: str  #: name of the error, or SIGKILL, or short write
    is_lasting: bool  #: every later changing call failed as well
    code: int  #: exit code; -1 where it was killed
    content: str  #: of the controller's file, or of the drives
    false_sentences: tuple[str, ...]
    bad_states: tuple[str, ...]


class Scene(ABC):
    """A cell in a folder, as a verb finds it before each fault;
    the verb is run in forks of this process.
    """

    verb: ClassVar[str]
    earlier_writes: ClassVar[int] = 0  #: that the history has before the verb
    other_file: ClassVar[str] = "file of the session"  #: beside the controller's and the ledger's
    most_writes: ClassVar[int] = 1  #: that the history may have got once the verb has gone on

    def __init__(self, folder: Path) -> None:
        self.place = folder / "place"
        self.kept = folder / "kept"
        self._output = folder / "output"
        self.old = b""
        self.new = b""
        self.calls: tuple[Call, ...] = ()

    def set_up(self) -> None:
        """Make the cell, run the verb once without a fault, and count its calls."""
        self.prepare()
        shutil.copytree(self.place, self.kept)
        self.old = self.gains()
        # Here, not in a fork, so that every fork has what is imported late.
        code = self.run_verb()
        assert code == 0
        self.new = self.gains()
        assert self.new != self.old
        self.restore()
        whole = traced(lambda: self.in_silence(self.run_verb), self.is_counted)
        assert whole.code == 0, self._output.read_text()
        self.calls = whole.calls

    @property
    @abstractmethod
    def cell(self) -> Path:
        """The cell file."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the files of the cell in `place`."""

    @abstractmethod
    def run_verb(self) -> int:
        """Do what is made to fail; return its exit code."""

    def go_on(self, facts: Facts) -> Iterator[str]:
        """Go on as a user does after a fault; yield what does not end as it should."""
        if self.run_in_a_child(self.run_verb) != 0:
            yield "the same command again does not end with 0"
        elif self.gains() != self.new:
            yield f"the same command again leaves {self.content().value} gains"

    def injections(self, unit: CallUnit) -> tuple[Injection, ...]:
        """Faults that are made at a call."""
        return unit.injections

    @property
    def controller(self) -> Path:
        """The controller's file."""
        found = load_cell(self.cell).controller_path
        assert found is not None
        return found

    def gains(self) -> bytes:
        """What the controller has, in bytes that can be compared."""
        return self.controller.read_bytes()

    def content(self) -> Content:
        """Whether these are the old gains or the new ones."""
        return {self.old: Content.OLD, self.new: Content.NEW}.get(self.gains(), Content.BROKEN)

    def bad_gains(self, content: Content, said: str) -> Iterator[str]:
        """Say what is wrong with what the controller has."""
        if content is Content.BROKEN:
            yield "the controller's file is neither the old one nor the new one"
        kept = self.kept / self.controller.relative_to(self.place)
        if self.controller.stat().st_mode != kept.stat().st_mode:
            yield "the mode of the controller's file has changed"

    def restore(self) -> None:
        """Put everything back, as it was before the verb."""
        shutil.rmtree(self.place)
        shutil.copytree(self.kept, self.place)

    def units(self) -> Iterator[CallUnit]:
        """Every changing call."""
        for number, call in enumerate(self.calls):
            file = self.kind_of(call.path)
            yield CallUnit(self.verb, number, call.name, file, call.size)

    def kind_of(self, path: Path) -> str:
        """What a path is, in words."""
        if path == SOCKET:
            return "bus"
        name = path.name.removesuffix(" (deleted)")
        if path.is_dir() or not path.suffix:
            return "folder"
        for ending, kind in (
            (".lock", "lock"),
            (".jsonl", "audit log"),
            (".head", "note of the audit log"),
        ):
            if name.endswith(ending):
                return kind
        is_copy = name.endswith(".tmp")
        if path.parent != self.controller.parent:
            return f"copy for a {self.other_file}" if is_copy else self.other_file
        kind = "backup" if ".bak" in name else "controller's file"
        return f"copy for the {kind}" if is_copy else kind

    def run(self, unit: CallUnit, injection: Injection) -> FaultRow:
        """Make one fault, and judge what it has left."""
        self.restore()
        before = self._files()
        fault = injection.at(unit.number, unit.size)
        found = traced(lambda: self.in_silence(self.run_verb), self.is_counted, fault)
        output = self._output.read_text(encoding="utf-8", errors="replace")
        messages = messages_of(output)
        said = " ".join(messages.split())
        facts = self._facts(before, changes_not_made(found.calls, fault))
        states = [
            *self.bad_gains(facts.content, said),
            *self._bad_history(facts, said, found.code),
            wrong_code(found.code, said, facts),
            *self.go_on(facts),
            *self._bad_end(),
        ]
        return FaultRow(
            verb=unit.verb,
            number=unit.number,
            call=unit.call,
            file=unit.file,
            error=injection.name,
            is_lasting=injection.is_lasting,
            code=-1 if found.code is None else found.code,
            content=facts.content.value,
            false_sentences=false_sentences(messages, facts),
            bad_states=tuple(state for state in states if state),
        )

    def _verification(self) -> Verification:
        return verify_ledger(ledger_of(self.cell))

    def _facts(self, before: dict[Path, bytes], not_made: frozenset[Path]) -> Facts:
        ledger = ledger_of(self.cell)
        entries = verify(ledger.audit).entries
        ended = tuple(one.action.value for one in entries if one.action in ENDS)
        history = self._verification().history
        return Facts(
            content=self.content(),
            controller=self.controller,
            before=before,
            after=self._files(),
            ended=ended[self.earlier_writes :],
            has_write=len(history.events) > self.earlier_writes,
            has_calibration=bool(history.entries),
            not_made=not_made,
        )

    def _bad_history(self, facts: Facts, said: str, code: int | None) -> Iterator[str]:
        """Compare what audit log and history have with what the controller has."""
        found = self._verification()
        if not found.verdict.holds:
            yield f"the audit log does not hold: {found.verdict.flaws[0].says}"
            return
        if found.broken:
            yield f"the history has what cannot be read: {found.broken[0]}"
        for action in facts.ended:
            expected = Content.OLD if action == AuditAction.FAILED.value else Content.NEW
            if facts.content not in (expected, Content.MIXED):
                yield f"the audit log says {action}"
        is_known = facts.has_write or not found.complete
        if facts.content is Content.NEW and not is_known and not self._is_unjudged():
            yield "the history lacks the write, and history --verify does not say so"
        if facts.content is Content.OLD and facts.has_write:
            yield "the history has a write that was not made"
        if code == 0 and not facts.has_write and "may lack" not in said:
            yield "exit 0, and the history lacks the write without a word of it"

    def _is_unjudged(self) -> bool:
        """Whether a write is open whose content no digest of a file can show."""
        return bool(self._verification().verdict.open_writes)

    def _bad_end(self) -> Iterator[str]:
        """Judge the history once the verb has gone on."""
        if self.run_command("history", str(self.cell), "--verify") != 0:
            yield "history --verify does not end with 0 after the next command"
        history = self._verification().history
        made = len(history.events) - self.earlier_writes
        if not 1 <= made <= self.most_writes:
            yield f"the history has {made} writes after the next command"
        if not history.entries:
            yield "the history has no calibration after the next command"

    def _files(self) -> dict[Path, bytes]:
        files = self.place.rglob("*")
        return {path: path.read_bytes() for path in files if path.is_file()}

    def is_counted(self, path: Path) -> bool:
        """Whether a change of this file is one of the calls."""
        return path.is_relative_to(self.place) and not path.name.endswith(NOT_COUNTED)

    def in_silence(self, work: Callable[[], int]) -> int:
        """Do some work with its output in a file; only in a fork."""
        out = os.open(self._output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        code = work()
        sys.stdout.flush()
        sys.stderr.flush()
        return code

    def run_in_a_child(self, work: Callable[[], int]) -> int:
        """Do some work in a fork; return its exit code."""
        _, status = os.waitpid(in_a_child(lambda: self.in_silence(work)), 0)
        return os.waitstatus_to_exitcode(status)

    def close(self) -> None:  # noqa: B027 - most scenes have nothing to end
        """End what runs beside it."""

    def run_command(self, *command: str) -> int:
        """Run a command in a fork; return its exit code."""
        return self.run_in_a_child(lambda: drivegain(list(command)))


class ApplyScene(Scene):
    """`apply`, to the controller's file."""

    verb = "apply"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.calibration = Path()

    @property
    def cell(self) -> Path:
        """The demonstration's cell."""
        configs_folder = self.place / "configs"
        return configs_folder / "cells" / "demo.yaml"

    def prepare(self) -> None:
        """Copy the shipped configurations, and make a calibration."""
        ignored = shutil.ignore_patterns("*.jsonl*", "*.sqlite*")
        shutil.copytree(shipped_configurations(), self.place / "configs", ignore=ignored)
        self.calibration = calibration_for(self.cell)

    @property
    def apply_command(self) -> list[str]:
        """The command line that writes the gains."""
        return ["apply", str(self.cell), str(self.calibration), "--yes"]

    def run_verb(self) -> int:
        """Write them."""
        return drivegain(self.apply_command)


class RollbackScene(ApplyScene):
    """`rollback` of the controller's file, after one `apply`."""

    verb = "rollback"
    earlier_writes = 1

    def prepare(self) -> None:
        """Write once."""
        super().prepare()
        assert self.run_command(*self.apply_command) == 0

    def run_verb(self) -> int:
        """Undo that."""
        return drivegain(["rollback", str(self.cell)])

    def go_on(self, facts: Facts) -> Iterator[str]:
        """Repeat it where it was not done; else complete the history."""
        if facts.content is Content.OLD:
            yield from super().go_on(facts)
        elif self.run_command("history", str(self.cell), "--add", str(self.calibration)) != 0:
            yield "history --add does not end with 0"


class DrivesScene(ApplyScene):
    """`apply --drives`: the gains are objects of simulated drives, in a process of its own."""

    verb = "apply-drives"
    other_file = "record of the write"
    most_writes = 2  #: drives that have the gains already are made to save them, which is a write

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        ours, theirs = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        self._drives = ours
        self._process = context.Process(target=serve_drives, args=(theirs,), daemon=True)

    def prepare(self) -> None:
        """Put the gains into the drives, which are on a hub."""
        self._process.start()
        super().prepare()
        document = yaml.safe_load(self.cell.read_text(encoding="utf-8"))
        gain = {"index": WHOLE.index, "subindex": WHOLE.subindex, "type": "i32", "factor": 1000.0}
        document["controller"] = {"objects": [gain] * len(document["axes"])}
        document["bus"] = {
            "interface": "socketcand",
            "channel": "can0",
            "host": "127.0.0.1",
            "port": self._drives.recv(),
        }
        # As JSON, which is YAML without aliases.
        self.cell.write_text(json.dumps(document), encoding="utf-8")
        self.calibration = calibration_for(self.cell)
        # Short waits: nobody else is on this bus.
        bounds = Bounds(answer_s=1.0, silence_s=0.3, listen_s=0.05)
        policy = SdoPolicy(0.3, 3)
        network.CanopenNetwork = partial(  # type: ignore[misc,assignment]
            CanopenNetwork,
            bounds=bounds,
            policy=policy,
        )

    @property
    def controller(self) -> Path:
        """The folder of the records; the gains themselves are in no file."""
        return record_folder(load_cell(self.cell))

    def run_verb(self) -> int:
        """Write them to the drives, which save them."""
        return drivegain([*self.apply_command, "--drives", "--save-unknown"])

    def injections(self, unit: CallUnit) -> tuple[Injection, ...]:
        """A frame that cannot be sent is lost with its bus."""
        if unit.call == "send":
            return (Injection(KILL), Injection("EIO", is_lasting=unit.number % 2 == 1))
        return unit.fewer_injections

    def gains(self) -> bytes:
        """Gains in each drive now, and after its next power-on."""
        self._drives.send("gains")
        return json.dumps(self._drives.recv()).encode()

    def content(self) -> Content:
        """As of a file; drives may have gains of both."""
        content = super().content()
        return Content.MIXED if content is Content.BROKEN else content

    def bad_gains(self, content: Content, said: str) -> Iterator[str]:
        """Drives with gains of both are named, or their writer was killed and its record has both;
        no drive has any other gain.
        """
        if content is not Content.MIXED:
            return
        now = json.loads(self.gains())
        document = json.loads(self.old)
        possible = zip(document, json.loads(self.new), strict=True)
        for gains, (old, new) in zip(now, possible, strict=True):
            if not set(gains) <= {*old, *new}:
                yield f"a drive has {gains}, neither {old} nor {new}"
        records = read_records(self.controller)
        if not records or len(read_record(records[-1]).drives) != len(now):
            yield "drives with gains of both, and no record of them"

    def restore(self) -> None:
        """Files and drives."""
        super().restore()
        self._drives.send("reset")
        self._drives.recv()

    def is_counted(self, path: Path) -> bool:
        """Frames count, too."""
        return path == SOCKET or super().is_counted(path)

    def close(self) -> None:
        """End the drives' process."""
        self._drives.close()
        self._process.join()


def serve_drives(requests: Connection) -> None:
    """Simulate the drives of the demonstration's cell on a hub:
    the port first, then their gains, or drives as they were at first.
    """
    with Hub(("can0",)) as hub, suppress(EOFError):
        address = hub.address()
        requests.send(address.port)
        while True:
            with simulated(address, entered=NAMEPLATE) as cell:
                while requests.recv() == "gains":
                    gains = [(entered_gain(node), saved_gain(node)) for node in cell.nodes]
                    requests.send(gains)
            requests.send("reset")


class JobScene(Scene):
    """`recalibrate` as a whole job, whose recordings and fit are copies of one that was made."""

    verb = "recalibrate"

    def __init__(self, folder: Path, made: Made) -> None:
        super().__init__(folder)
        self.made = made
        self.rig = self.make_rig()

    def make_rig(self) -> Rig:
        """The cell of the job."""
        return made_rig(self.place, self.made)

    @property
    def cell(self) -> Path:
        """Cell file of the rig."""
        return self.rig.cell_file

    def prepare(self) -> None:
        """The job's certificate is the real one."""
        save_page = partial(save_certificate, self.rig.cell_file, self.rig.cell)
        self.rig.tools = replace(self.rig.tools, save_report=save_page)

    def injections(self, unit: CallUnit) -> tuple[Injection, ...]:
        """Each error in one of its two ways: a job takes long."""
        return unit.fewer_injections

    def conclude(self, journal: Journal) -> Conclusion:
        """Run the job."""
        return recalibrate(
            self.cell, self.rig.cell, self.rig.tools, journal, who=WHO, lock_folder=self.place
        )

    def run_verb(self) -> int:
        """Run the job, and print as the command line does; each is ten minutes later."""
        self.rig.clock.go_on(minutes=10)
        journal = Journal(sys.stderr, Form.TEXT, lambda: self.rig.clock.at)
        try:
            conclusion = self.conclude(journal)
        except (DaqError, DriverError, IdentificationError) as error:
            sys.stderr.write("\n".join((f"error: {error}", *all_notes(error), "")))
            return int(exit_code(type(error)) or ExitCode.UNEXPECTED)
        sys.stdout.write(text(conclusion, self.cell))
        return conclusion.exit_code


class SessionScene(JobScene):
    """`calibrate` as a whole guided session, from copies of one that was made."""

    verb = "calibrate"
    made: MadeSession

    def make_rig(self) -> Rig:
        """The cell of the session."""
        return made_session_rig(self.place, self.made)

    def conclude(self, journal: Journal) -> Conclusion:
        """Run the session, with an operator who does and approves everything."""
        settings = settings_of(self.rig)
        operator = given_answers(self.rig)
        return calibrate(
            self.cell,
            self.rig.cell,
            settings,
            operator,
            self.rig.tools,
            journal,
            lock_folder=self.place,
        )


def changes_not_made(calls: Sequence[Call], fault: Fault) -> frozenset[Path]:
    """Files and folders of which a change was begun and not made, of calls that met a fault:
    a change begins as the file, or the copy that replaces it, is opened.
    """
    begun: set[Path] = set()
    failed: set[Path] = set()
    for number, call in enumerate(calls):
        copied = _COPY.fullmatch(call.path.name)
        path = call.path
        if copied is not None:
            path = path.with_name(copied[1])
        is_later = fault.is_lasting and number > fault.number
        is_made = fault.length > 0 or not (number == fault.number or is_later)
        if call.name == "open":
            failed |= begun & {path}
            begun.add(path)
        elif call.name == "mkdir" and not is_made:
            failed.add(path)
        elif is_made and (call.name == "rename" or (call.name == "write" and copied is None)):
            begun.discard(path)
    return frozenset(failed | begun)


def messages_of(output: str) -> str:
    """What was printed without the table and the diff of the gains,
    whose lines claim nothing about files.
    """
    kept = [
        line
        for line in output.splitlines()
        if not line.startswith(("+", "-", " ", "@@", "J", "axis", "*", "─"))
    ]
    return "\n".join(kept)


FILE_SCENES: Sequence[type[Scene]] = (ApplyScene, RollbackScene, DrivesScene)
"""Those that need no job that was made before."""
