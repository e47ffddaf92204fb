"""Kills, failures and short writes at system calls of a write, a sample of
`tests.studies.write_faults`; and what its checks would notice.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from tests.daq.failing_calls import Call, Fault, Traced, traced, why_not_here
from tests.studies.study_rows import to_csv
from tests.studies.write_faults import counts, with_other_verbs
from tests.studies.write_scenes import (
    ERRORS,
    KILL,
    SHORT,
    ApplyScene,
    CallUnit,
    DrivesScene,
    FaultRow,
    Injection,
    Scene,
    changes_not_made,
)
from tests.studies.write_truth import Content, Facts, false_sentences, wrong_code

CONTROLLER = Path("/cell/x.yaml")
SAMPLE = (
    "chmod of lock",
    "fsync of audit log",
    "close of audit log",
    "rename of controller's file",
    "fsync of folder",
)
"""Where a lock file stays behind, where an entry is there that was not flushed,
and beside the replacement.
"""


@pytest.fixture(scope="module")
def small() -> Iterator[Executor]:
    """A process that has imported this module alone:
    its forks are quick, and no thread of another test is in it.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool


def _require_tracing(small: Executor) -> None:
    reason = small.submit(why_not_here).result()
    if reason:
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)


def _label(unit: CallUnit) -> str:
    file = "folder" if unit.file.startswith("folder") else unit.file
    return f"{unit.call} of {file}"


def _sampled(folder: Path) -> list[FaultRow]:
    """The last call of each kind of the sample:
    killed there, and failing with one error from there on.
    """
    scene = ApplyScene(folder)
    scene.set_up()
    last = _last_calls(scene)
    rows = []
    for number, label in enumerate(SAMPLE):
        unit = last[label]
        error = errno.errorcode[ERRORS[number % len(ERRORS)]]
        rows.append(scene.run(unit, Injection(KILL)))
        injection = Injection(error, is_lasting=True)
        rows.append(scene.run(unit, injection))
    return rows


def _last_calls(scene: Scene) -> dict[str, CallUnit]:
    return {_label(unit): unit for unit in scene.units()}


def test_sampled_failures_of_a_write_every_sentence_is_true_and_the_next_command_ends_well(
    tmp_path: Path, small: Executor
) -> None:
    _require_tracing(small)
    rows = small.submit(_sampled, tmp_path.resolve()).result()
    expected = [(row.call, row.file, (), ()) for row in rows]
    assert [(row.call, row.file, row.false_sentences, row.bad_states) for row in rows] == expected
    contents = {row.content for row in rows}
    assert contents == {"old", "new"}
    codes = [row.code for row in rows]
    assert codes.count(-1) == len(SAMPLE)
    assert sum(count.cases for count in counts(rows)) == len(rows)


def _closed_badly(folder: Path) -> FaultRow:
    """The first entry of the audit log is flushed, and its file cannot be closed."""
    scene = ApplyScene(folder)
    scene.set_up()
    first = next(unit for unit in scene.units() if _label(unit) == "close of audit log")
    return scene.run(first, Injection("EIO"))


def test_an_entry_that_was_flushed_counts_although_the_audit_log_cannot_be_closed(
    tmp_path: Path, small: Executor
) -> None:
    _require_tracing(small)
    row = small.submit(_closed_badly, tmp_path.resolve()).result()
    assert (row.code, row.content) == (0, "new")
    assert row.false_sentences == row.bad_states == ()


def _shortened(folder: Path) -> list[FaultRow]:
    """Every write of an apply takes half."""
    scene = ApplyScene(folder)
    scene.set_up()
    units = [unit for unit in scene.units() if unit.call == "write"]
    return [scene.run(unit, Injection(SHORT)) for unit in units]


def test_a_write_of_which_the_system_takes_half_ends_as_any_other(
    tmp_path: Path, small: Executor
) -> None:
    _require_tracing(small)
    rows = small.submit(_shortened, tmp_path.resolve()).result()
    assert len(rows) >= 8  # three entries, their notes, the backup and the file
    assert {(row.code, row.content) for row in rows} == {(0, "new")}
    assert {(row.false_sentences, row.bad_states) for row in rows} == {((), ())}


def _faults_of_drives(folder: Path) -> list[FaultRow]:
    """The record's rename, and frames before, between and behind the writes to drives."""
    scene = DrivesScene(folder)
    scene.set_up()
    try:
        frames = [unit for unit in scene.units() if unit.call == "send"]
        chosen = [_last_calls(scene)["rename of record of the write"], *frames[80::40]]
        return [scene.run(unit, Injection(name)) for unit, name in product(chosen, (KILL, "EIO"))]
    finally:
        scene.close()


def test_drives_have_old_or_new_gains_and_a_record_of_both_after_any_fault(
    tmp_path: Path, small: Executor
) -> None:
    _require_tracing(small)
    rows = small.submit(_faults_of_drives, tmp_path.resolve()).result()
    assert len(rows) >= 8
    expected = [(row.number, row.error, (), ()) for row in rows]
    assert [
        (row.number, row.error, row.false_sentences, row.bad_states) for row in rows
    ] == expected
    killed = {row.content for row in rows if row.code == -1}
    assert killed >= {"old", "both"}
    contents = {row.content for row in rows if row.code > 0}
    assert contents == {"old"}


def _append_twice(path: Path) -> int:
    """Return 0 where both lines were written, 1 where the first one failed,
    2 where the second one did.
    """
    for number in (1, 2):
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            try:
                os.write(descriptor, b"line\n")
            finally:
                os.close(descriptor)
        except OSError as error:
            return number if error.errno == errno.EDQUOT else 9
    return 0


def _traced_twice(path: Path, fault: Fault | None) -> Traced:
    return traced(lambda: _append_twice(path), path.__eq__, fault)


def test_a_fault_is_at_the_chosen_call_and_the_call_is_not_made(
    tmp_path: Path, small: Executor
) -> None:
    _require_tracing(small)
    path = tmp_path.resolve() / "file"
    whole = small.submit(_traced_twice, path, None).result()
    assert whole.code == 0
    expected = ["open", "write", "close"] * 2
    assert [call.name for call in whole.calls] == expected
    assert path.read_text() == "line\n" * 2
    path.unlink()
    fault = Fault(4, errno.EDQUOT)
    failed = small.submit(_traced_twice, path, fault).result()
    assert failed.code == 2
    assert path.read_text() == "line\n"
    path.unlink()
    killed = small.submit(_traced_twice, path, Fault(1)).result()
    assert killed.code is None
    assert path.read_text() == ""


def _written_at_once(path: Path) -> int:
    """Return the number of bytes that the system took of eight."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT)
    return os.write(descriptor, b"12345678")


def _traced_at_once(path: Path, fault: Fault) -> Traced:
    return traced(lambda: _written_at_once(path), path.__eq__, fault)


def test_a_short_write_takes_the_bytes_that_it_says(tmp_path: Path, small: Executor) -> None:
    _require_tracing(small)
    path = tmp_path.resolve() / "file"
    fault = Fault(1, length=3)
    found = small.submit(_traced_at_once, path, fault).result()
    assert found.code == 3
    assert path.read_text() == "123"
    assert found.calls[1].size == 8


STATE = Path("/cell/state.json")
COPY = Path("/cell/.state.json.12-0.tmp")
REPLACED = (
    Call("open", COPY),
    Call("write", COPY),
    Call("rename", STATE),
    Call("fsync", Path("/cell")),
)
LOGGED = (Call("open", STATE), Call("write", STATE), Call("fsync", STATE))


@pytest.mark.parametrize(
    ("calls", "failing", "is_not_made"),
    [
        (REPLACED, 1, True),
        (REPLACED, 2, True),
        (REPLACED, 3, False),
        (LOGGED, 1, True),
        (LOGGED, 2, False),
    ],
)
def test_a_change_is_made_by_its_rename_or_its_write(
    calls: tuple[Call, ...], failing: int, is_not_made: bool
) -> None:
    fault = Fault(failing, errno.EIO)
    found = changes_not_made(calls[: failing + 1], fault)
    assert found == (frozenset({STATE}) if is_not_made else frozenset())
    again = changes_not_made((*calls[: failing + 1], *REPLACED), Fault(failing, errno.EIO))
    assert again == found
    said = f"error: {STATE}: found no space; expected room; it is as it was"
    facts = _facts(Content.OLD, not_made=found)
    assert bool(false_sentences(said, facts)) is not is_not_made


def _facts(content: Content, **changed: object) -> Facts:
    before = {CONTROLLER: b"old"}
    after = {CONTROLLER: content.value.encode()}
    facts = Facts(content, CONTROLLER, before, after, (), has_write=False)
    return replace(facts, **changed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("said", "true_of"),
    [
        (
            "error: /cell/x.yaml found: no space expected: room do: it is as it was; free space",
            Content.OLD,
        ),
        ("do: nothing was written to the controller; free space or rights", Content.OLD),
        ("do: check the disk; /cell/x.yaml has the new content, complete", Content.NEW),
        ("the audit log may lack the entry that it is applied: a.jsonl: no space", Content.NEW),
        ("the audit log may lack the entry that it is failed: a.jsonl: no space", Content.OLD),
    ],
)
def test_a_sentence_is_false_of_the_other_content(said: str, true_of: Content) -> None:
    other = Content.NEW if true_of is Content.OLD else Content.OLD
    assert false_sentences(said, _facts(true_of)) == ()
    assert len(false_sentences(said, _facts(other))) == 1


def test_a_backup_that_is_named_must_have_the_old_content() -> None:
    said = "Written to /cell/x.yaml, backup x.yaml.bak; audit log a.jsonl."
    backup = CONTROLLER.with_name("x.yaml.bak")
    right = _facts(Content.NEW, after={CONTROLLER: b"new", backup: b"old"})
    assert false_sentences(said, right) == ()
    facts = replace(right, after={backup: b"o"})
    assert false_sentences(said, facts) != ()


def test_of_drives_behind_a_bus_that_has_failed_nothing_is_known() -> None:
    why = "J1, J2: bus socketcan:can0: the wire was cut"
    said = (
        "the audit log may lack the entry that it is failed: a.jsonl: no space error: the write "
        "failed midway; the previous values are restored in no drive, and NOT confirmed where "
        f"{why}; do not enable an axis before every drive has its previous value again"
    )
    for content in (Content.OLD, Content.NEW, Content.MIXED):
        assert false_sentences(said, _facts(content)) == ()
        assert wrong_code(5, said, _facts(content)) == ""
    # A drive that answers says which gains it has.
    said = said.replace(why, "J4 reads 0")
    assert false_sentences(said, _facts(Content.MIXED)) == ()
    assert len(false_sentences(said, _facts(Content.OLD))) == 1


def test_a_file_in_a_folder_that_was_not_made_is_as_it_was() -> None:
    folder = Path("/cell/session")
    said = f"{folder}/c.yaml: found no space; expected room; it is as it was"
    facts = _facts(Content.OLD)
    assert len(false_sentences(said, facts)) == 1
    assert false_sentences(said, replace(facts, not_made=frozenset((folder,)))) == ()


def test_a_file_that_is_said_not_to_be_made_or_to_be_empty_is_so() -> None:
    missing = "error: /cell/a.jsonl found: no space expected: room do: it was not made; free space"
    empty = "error: /cell/a.jsonl found: no space expected: room do: it is empty; free space"
    audit = Path("/cell/a.jsonl")
    facts = Facts(Content.OLD, Path("/cell/gains.yaml"), {}, {}, (), False)
    emptied = replace(facts, after={audit: b""})
    written = replace(facts, after={audit: b"line"})
    assert false_sentences(missing, facts) == ()
    assert false_sentences(missing, emptied)
    assert false_sentences(empty, emptied) == ()
    assert false_sentences(empty, facts)
    assert false_sentences(empty, written)


def test_a_note_that_is_said_to_be_lacking_was_not_made() -> None:
    note = Path("/cell/a.jsonl.head")
    said = (
        f"the digest of the last entry cannot be noted in {note} (input/output error): a missing "
        "end of the audit log would not be noticed; free space or rights, and the next entry is "
        "noted again"
    )
    made = _facts(Content.NEW)
    assert len(false_sentences(said, made)) == 1
    not_made = replace(made, not_made=frozenset((note,)))
    assert false_sentences(said, not_made) == ()


def test_a_claim_that_no_rule_judges_is_a_finding() -> None:
    facts = _facts(Content.OLD)
    assert false_sentences("The moon was restored.", facts) != ()


def test_an_exit_code_that_denies_or_invents_a_write_is_wrong() -> None:
    facts = _facts(Content.OLD)
    assert wrong_code(0, "", facts) != ""
    assert wrong_code(1, "", _facts(Content.NEW)) != ""
    assert wrong_code(1, "x has the new content, complete", _facts(Content.NEW)) == ""
    assert wrong_code(None, "", _facts(Content.OLD)) == ""


def _row(verb: str, number: int) -> FaultRow:
    return FaultRow(verb, number, "rename", "controller's file", KILL, False, -1, "old", (), ())


@pytest.mark.slow
def test_a_part_of_the_study_keeps_the_rows_of_the_other_verbs(tmp_path: Path) -> None:
    table = tmp_path / "rows.csv"
    earlier = (_row("apply", 1), _row("rollback", 1), _row("calibrate", 1))
    table.write_text(to_csv(FaultRow, earlier))
    new = (_row("rollback", 2), _row("rollback", 3))
    found = with_other_verbs(table, new, ["rollback"])
    expected = (earlier[0], *new, earlier[2])
    assert found == expected
    none_path = tmp_path / "none.csv"
    assert with_other_verbs(none_path, new, ["rollback"]) == new
