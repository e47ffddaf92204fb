"""The audit: whatever is done to its lines is found, what a killed writer leaves is reported,
nothing is removed.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import math
import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.errors import AuditUnusable, exit_code
from daq.ledger import audit
from daq.ledger.audit import (
    AuditAction,
    AuditEntry,
    Content,
    Flaw,
    append,
    encode,
    entry,
    judge_chain,
    read,
    verify,
)

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
TREES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(), max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)
DETAILS = st.dictionaries(st.text(max_size=8), TREES, max_size=4)


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def _filled(path: Path, count: int = 6) -> tuple[AuditEntry, ...]:
    return tuple(
        append(
            path,
            AuditAction.PROPOSED,
            at=NOW + timedelta(seconds=k),
            who="K. Ito",
            subject="/c/x.yaml",
            details={"k": k},
        )
        for k in range(count)
    )


def _judge(lines: list[bytes]) -> audit.AuditVerdict:
    content = b"".join(line + b"\n" for line in lines)
    return judge_chain(content, lambda _: None)


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines()


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.sampled_from(AuditAction), st.text(max_size=30), st.text(max_size=30), DETAILS
        ),
        max_size=5,
    )
)
def test_what_is_appended_is_read_back_and_the_chain_holds(
    asked: list[tuple[AuditAction, str, str, dict[str, object]]],
) -> None:
    asked = [(a, w, s, d) for a, w, s, d in asked if a is not AuditAction.TORN_LINE]
    with _folder() as folder:
        path = folder / "cell.audit.jsonl"
        assert read(path) == ()
        written = [append(path, a, at=NOW, who=w, subject=s, details=d) for a, w, s, d in asked]
        assert list(read(path)) == written
        expected = list(range(1, len(asked) + 1))
        assert [one.number for one in written] == expected
        for one, (action, who, subject, details) in zip(written, asked, strict=True):
            assert (one.action, one.who, one.subject, one.details) == (
                action,
                who,
                subject,
                details,
            )
        heads = [one.sha256 for one in written]
        verdict = verify(path, heads=heads)
        assert verdict.holds
        assert verdict.broken is None
        assert verdict.entries == tuple(written)


def test_the_digest_is_sha256_of_canonical_json_and_covers_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "a"
    first, second = _filled(path, 2)
    a_folder = tmp_path / "a"
    tree = json.loads(_lines(a_folder)[1])
    assert tree.pop("sha256") == second.sha256
    assert tree["previous"] == first.sha256
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    expected = hashlib.sha256(text.encode()).hexdigest()
    assert second.sha256 == expected
    assert first.previous == "0" * 64


@pytest.mark.slow
@given(line=st.integers(0, 5), data=st.data())
def test_one_changed_byte_is_found_at_its_line(line: int, data: st.DataObject) -> None:
    with _folder() as folder:
        _filled(folder / "a")
        lines = _lines(folder / "a")
    place = data.draw(st.integers(0, len(lines[line]) - 1))
    byte = data.draw(st.integers(0, 255).filter(lambda b: b not in {lines[line][place], 10}))
    lines[line] = lines[line][:place] + bytes([byte]) + lines[line][place + 1 :]
    verdict = _judge(lines)
    if line < 5:
        assert verdict.broken == line + 1
        assert verdict.flaws[0].flaw is Flaw.EDITED
        assert len(verdict.flaws) == 1
    else:
        # An unfinished last line may be a killed writer's: reported, and no longer an entry.
        assert verdict.broken == 6 or verdict.torn == (6,)


@given(line=st.integers(0, 4), count=st.integers(1, 4))
def test_removed_lines_are_found_where_they_were(line: int, count: int) -> None:
    with _folder() as folder:
        _filled(folder / "a")
        lines = _lines(folder / "a")
    last = min(line + count, 5)
    verdict = _judge(lines[:line] + lines[last:])
    expected = [(line + 1, Flaw.REMOVED)]
    assert [(flaw.line, flaw.flaw) for flaw in verdict.flaws] == expected
    line_text = str(line + 1)
    assert line_text in verdict.flaws[0].says


@pytest.mark.slow
@given(st.permutations(range(6)))
def test_a_changed_order_is_found(order: list[int]) -> None:
    with _folder() as folder:
        _filled(folder / "a")
        lines = _lines(folder / "a")
    verdict = _judge([lines[k] for k in order])
    first = next((place for place, k in enumerate(order) if place != k), None)
    assert verdict.broken == (None if first is None else first + 1)
    flaws = {flaw.flaw for flaw in verdict.flaws}
    assert flaws <= {Flaw.MOVED}


@given(place=st.integers(0, 6), copied=st.integers(0, 5))
def test_a_line_that_was_added_twice_is_found(place: int, copied: int) -> None:
    with _folder() as folder:
        _filled(folder / "a")
        lines = _lines(folder / "a")
    verdict = _judge([*lines[:place], lines[copied], *lines[place:]])
    assert not verdict.holds
    flaws = {flaw.flaw for flaw in verdict.flaws}
    assert Flaw.ADDED in flaws


@given(place=st.integers(0, 4))
def test_a_forged_entry_with_a_right_digest_breaks_the_link(place: int) -> None:
    with _folder() as folder:
        entries = _filled(folder / "a")
    was = entries[place]
    forged = entry(
        was.number, was.at, "another person", was.action, was.subject, was.details, was.previous
    )
    lines = [encode(forged if one is was else one) for one in entries]
    verdict = _judge(lines)
    expected = [(place + 1, Flaw.EDITED)]
    assert [(flaw.line, flaw.flaw) for flaw in verdict.flaws] == expected
    # Put between two others, it is one entry of that number too many.
    verdict = _judge([encode(one) for one in (*entries[:place], forged, *entries[place:])])
    assert not verdict.holds


def test_a_cut_off_tail_is_found_by_who_noted_an_entry_elsewhere(tmp_path: Path) -> None:
    entries = _filled(tmp_path / "a")
    path = tmp_path / "a"
    lines = _lines(path)[:4]
    content = b"".join(line + b"\n" for line in lines)
    (tmp_path / "a").write_bytes(content)
    assert verify(tmp_path / "a").holds
    heads = [entries[2].sha256, entries[5].sha256]
    a_folder = tmp_path / "a"
    verdict = verify(a_folder, heads=heads)
    expected = [(5, Flaw.CUT_OFF)]
    assert [(flaw.line, flaw.flaw) for flaw in verdict.flaws] == expected
    says = verdict.flaws[0].says
    sha256 = entries[5].sha256
    assert sha256[:12] in says
    none_folder = tmp_path / "none"
    broken = verify(none_folder, heads=[entries[0].sha256]).broken
    assert broken == 1


@pytest.mark.slow
@given(st.lists(st.floats(0, 1), min_size=1, max_size=4), st.data())
def test_what_killed_writers_leave_stays_and_is_reported(
    cuts: list[float], data: st.DataObject
) -> None:
    """Each write is cut at any byte; the next writer begins a line of its own,
    and the chain holds throughout.
    """
    with _folder() as folder:
        path = folder / "a"
        _filled(path, 1)
        for cut in cuts:
            before = path.read_bytes()
            _filled(path, 1)
            written = path.read_bytes()
            assert written.startswith(before)
            length = len(before) + round(cut * (len(written) - len(before)))
            path.write_bytes(written[:length])
            assert verify(path).holds
        kept = path.read_bytes()
        last = append(path, AuditAction.APPLIED, at=NOW, who="K.", subject="x", details={})
        assert path.read_bytes().startswith(kept)
        assert read(path)[-1] == last
        verdict = verify(path)
        assert verdict.holds
        expected = list(range(1, len(verdict.entries) + 1))
        numbers = [one.number for one in verdict.entries]
        assert numbers == expected
        # A fragment that is removed or changed after it was reported is missed.
        lines = _lines(path)
        for torn in verdict.torn:
            holds = _judge(lines[: torn - 1] + lines[torn:]).holds
            assert not holds
            largest_line_count = max(len(lines[torn - 1]) - 1, 0)
            place = data.draw(st.integers(0, largest_line_count))
            changed = lines[torn - 1][:place] + b"#" + lines[torn - 1][place:]
            assert not _judge([*lines[: torn - 1], changed, *lines[torn:]]).holds


def test_zeros_after_a_power_cut_are_an_unfinished_line(tmp_path: Path) -> None:
    path = tmp_path / "a"
    _filled(path, 2)
    with path.open("ab") as stream:
        stream.write(bytes(100))
    assert verify(path).torn == (3,)
    _filled(path, 1)
    verdict = verify(path)
    assert verdict.holds
    actions = [one.action for one in verdict.entries]
    expected = [AuditAction.TORN_LINE, AuditAction.PROPOSED]
    assert actions[2:] == expected
    details = verdict.entries[2].details
    assert details["torn_bytes"] == 100


@pytest.mark.parametrize(
    "content",
    [
        b"drives:\n  J1: {gain: 32.96}\n",
        b"[2003]\nObjectType=0x9\n",
        b'{\n  "gain": 1\n',
        b"no line end",
        b'{"actions": 1',
        b"SQLite format 3\x00",
        b"\xff\xfe",
    ],
)
def test_nothing_is_appended_to_a_file_that_is_no_audit(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a"
    path.write_bytes(content)
    with pytest.raises(AuditUnusable, match=r"another file, correct `history\.audit`"):
        _filled(path, 1)
    assert path.read_bytes() == content
    assert not verify(path).holds
    # After entries it is no writer's unfinished line either.
    path.unlink()
    _filled(path, 1)
    with path.open("ab") as stream:
        stream.write(content)
    assert not verify(path).holds


def test_what_is_left_of_a_first_entry_is_no_other_file(tmp_path: Path) -> None:
    _filled(tmp_path / "whole", 1)
    whole = (tmp_path / "whole").read_bytes()
    for length in range(len(whole) - 1):
        path = tmp_path / str(length)
        path.write_bytes(whole[:length])
        number = append(path, AuditAction.APPLIED, at=NOW, who="", subject="", details={}).number
        expected = 1 + (length > 0)
        assert number == expected
        assert verify(path).holds


@pytest.mark.parametrize(
    "spoil", [lambda line: line.replace(b"Ito", b"Itu"), lambda _: b"{}", lambda _: b"17"]
)
def test_nothing_is_appended_to_a_last_line_that_was_changed(
    tmp_path: Path, spoil: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "a"
    _filled(path, 2)
    first, last = _lines(path)
    content = first + b"\n" + spoil(last) + b"\n"
    path.write_bytes(content)
    spoiled = path.read_bytes()
    with pytest.raises(AuditUnusable, match="line 2, which drivegain did not write"):
        _filled(path, 1)
    assert exit_code(AuditUnusable) == 3
    assert path.read_bytes() == spoiled


def _write(
    begun: AuditAction, path: Path, subject: Path, before: bytes, after: bytes
) -> AuditEntry:
    digests = {}
    for name, b in (("before", before), ("after", after)):
        digests[f"sha256_{name}"] = hashlib.sha256(b).hexdigest()
    return append(path, begun, at=NOW, who="K.", subject=str(subject), details=digests)


@pytest.mark.parametrize("begun", [AuditAction.APPLY_BEGUN, AuditAction.ROLLBACK_BEGUN])
@pytest.mark.parametrize(
    ("now", "content"),
    [
        (b"old", Content.BEFORE),
        (b"new", Content.AFTER),
        (b"edited", Content.OTHER),
        (None, Content.OTHER),
    ],
)
def test_of_a_write_without_an_end_the_file_reports_which_it_is(
    tmp_path: Path, begun: AuditAction, now: bytes | None, content: Content
) -> None:
    path = tmp_path / "a"
    file = tmp_path / "x.yaml"
    if now is not None:
        file.write_bytes(now)
    first = _write(begun, path, file, b"old", b"new")
    open_writes = verify(path).open_writes
    assert [(one.begun, one.content) for one in open_writes] == [(first, content)]
    # The next write on the same file saw what was there, whatever is there by now.
    subject = tmp_path / "y.yaml"
    _write(begun, path, subject, b"other", b"file")
    second = _write(begun, path, file, b"new", b"newest")
    file.write_bytes(b"newest")
    details = {"begun": second.number}
    append(
        path,
        AuditAction.APPLIED,
        at=NOW,
        who="K.",
        subject=str(file),
        details=details,
    )
    found = {one.begun.number: one.content for one in verify(path).open_writes}
    expected = {1: Content.AFTER, 2: Content.OTHER}
    assert found == expected
    (tmp_path / "y.yaml").mkdir()  # unreadable
    assert {one.begun.number: one.content for one in verify(path).open_writes}[2] is Content.UNKNOWN


@pytest.mark.parametrize("end", [AuditAction.APPLIED, AuditAction.ROLLED_BACK, AuditAction.FAILED])
def test_a_write_with_an_end_is_not_open(tmp_path: Path, end: AuditAction) -> None:
    path = tmp_path / "a"
    subject = tmp_path / "x"
    begun = _write(AuditAction.APPLY_BEGUN, path, subject, b"old", b"new")
    a_folder = tmp_path / "a"
    details = {"begun": begun.number}
    append(
        a_folder,
        end,
        at=NOW,
        who="K.",
        subject=begun.subject,
        details=details,
    )
    open_writes = verify(tmp_path / "a").open_writes
    assert open_writes == ()


def test_no_number_that_is_not_finite_gets_in(tmp_path: Path) -> None:
    path = tmp_path / "a"
    details = {"gain": math.nan}
    with pytest.raises(ValueError, match="JSON"):
        append(
            path,
            AuditAction.PROPOSED,
            at=NOW,
            who="",
            subject="",
            details=details,
        )
    assert (tmp_path / "a").read_bytes() == b""


def test_what_is_no_regular_file_is_refused_and_no_one_waits(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "fifo", tmp_path, Path("/dev/zero")):
        with pytest.raises(AuditUnusable):
            read(path)
        with pytest.raises((AuditUnusable, PermissionError)):
            _filled(path, 1)
    a_folder = tmp_path / "gone" / "a"
    (tmp_path / "dangling").symlink_to(a_folder)
    for refused in (lambda path: _filled(path, 1), read, verify):
        with pytest.raises(AuditUnusable, match="where there is no file"):
            refused(tmp_path / "dangling")
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "a").touch()
    _filled(tmp_path / "dangling", 1)
    assert len(read(tmp_path / "gone" / "a")) == 1


def test_the_entry_is_on_the_disk_and_so_is_the_folder_of_a_new_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[str] = []

    def noted(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}")
        flushed.append(str(path.readlink()))

    monkeypatch.setattr(os, "fsync", noted)
    _filled(tmp_path / "a", 2)
    expected = [str(tmp_path / "a"), str(tmp_path), str(tmp_path / "a")]
    assert flushed == expected


def _append_many(path: Path, who: str) -> None:
    for k in range(25):
        append(path, AuditAction.PROPOSED, at=NOW, who=who, subject="x", details={"k": k})


def test_many_writers_make_one_chain(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    writers = []
    for k in range(4):
        writers.append(context.Process(target=_append_many, args=(tmp_path / "a", str(k))))
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    verdict = verify(tmp_path / "a")
    assert verdict.holds
    assert len(verdict.entries) == 100
    for who in "0123":
        expected = list(range(25))
        assert [one.details["k"] for one in verdict.entries if one.who == who] == expected


def test_a_lock_that_is_never_given_back_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "_PAUSE_S", 0.0)
    with (tmp_path / "a").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(AuditUnusable, match="keeps it locked"):
            _filled(tmp_path / "a", 1)


def test_an_entry_cannot_hide_a_missing_torn_line(tmp_path: Path) -> None:
    """An entry reports an unfinished line, and none is there: it was removed."""
    _filled(tmp_path / "a", 1)
    with (tmp_path / "a").open("ab") as stream:
        stream.write(b'{"action":')
    _filled(tmp_path / "a", 1)
    lines = _lines(tmp_path / "a")
    path = tmp_path / "a"
    assert verify(path).torn == (2,)
    flaws = _judge([lines[0], *lines[2:]]).flaws
    assert [flaw.flaw for flaw in flaws] == [Flaw.EDITED]


@pytest.mark.parametrize("strange", [[1], {"a": 1}, None, "1", 1.5])
def test_details_of_another_program_are_no_error(tmp_path: Path, strange: object) -> None:
    """Any program can write a chain that holds."""
    path = tmp_path / "a"
    foreign_details = {"sha256_before": strange, "sha256_after": strange, "begun": strange}
    for action in (AuditAction.APPLY_BEGUN, AuditAction.APPLIED, AuditAction.APPLY_BEGUN):
        append(path, action, at=NOW, who="", subject="x", details=foreign_details)
    verdict = verify(path)
    assert verdict.holds
    assert len(verdict.open_writes) == 2


def test_an_entry_that_the_system_takes_in_parts_is_written_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "audit.jsonl"
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, bytes(data)[:7]))
    made = append(path, AuditAction.PROPOSED, at=NOW, who="me", subject="cell", details={"n": 1})
    monkeypatch.undo()
    assert read(path) == (made,)
    assert verify(path).holds


@pytest.mark.parametrize("number", [errno.EIO, errno.EDQUOT, errno.ENOSPC])
def test_an_entry_that_is_taken_in_part_fails_with_the_cause_of_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path = tmp_path / "audit.jsonl"
    first = append(path, AuditAction.PROPOSED, at=NOW, who="me", subject="cell", details={"n": 1})
    write = os.write
    calls: list[int] = []

    def short(descriptor: int, data: bytes) -> int:
        calls.append(descriptor)
        if len(calls) > 1:
            raise OSError(number, os.strerror(number))
        return write(descriptor, bytes(data)[:20])

    monkeypatch.setattr(os, "write", short)
    with pytest.raises(OSError, match=os.strerror(number)) as caught:
        append(path, AuditAction.WRITE_FOUND, at=NOW, who="me", subject="cell", details={"n": 2})
    monkeypatch.undo()
    assert caught.value.errno == number
    # The unfinished line is reported by the next entry, and the chain holds.
    append(path, AuditAction.WRITE_FOUND, at=NOW, who="me", subject="cell", details={"n": 2})
    entries = read(path)
    assert entries[0] == first
    actions = [one.action for one in entries[1:]]
    assert actions == [AuditAction.TORN_LINE, AuditAction.WRITE_FOUND]
    assert verify(path).holds
    assert verify(path).torn == (2,)
