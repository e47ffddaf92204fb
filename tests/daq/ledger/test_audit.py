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
from collections.abc import Callable, Iterable, Iterator
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
LINE_END = ord("\n")
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(), max_size=20)
)


def _containers(inner: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    """Lists and objects of JSON values."""
    lists = st.lists(inner, max_size=3)
    keys = st.text(max_size=8)
    return lists | st.dictionaries(keys, inner, max_size=3)


TREES = st.recursive(SCALARS, _containers, max_leaves=8)
DETAILS = st.dictionaries(st.text(max_size=8), TREES, max_size=4)
WRITES = st.tuples(
    st.sampled_from(AuditAction),
    st.text(max_size=30),
    st.text(max_size=30),
    DETAILS,
)


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def _filled(path: Path, count: int = 6) -> tuple[AuditEntry, ...]:
    entries = []
    for k in range(count):
        one = append(
            path,
            AuditAction.PROPOSED,
            at=NOW + timedelta(seconds=k),
            who="K. Ito",
            subject="/c/x.yaml",
            details={"k": k},
        )
        entries.append(one)
    return tuple(entries)


def _append(
    path: Path, action: AuditAction, subject: str, details: dict[str, object], who: str = "K."
) -> AuditEntry:
    """Append an entry of someone."""
    return append(path, action, at=NOW, who=who, subject=subject, details=details)


def _add_bytes(path: Path, content: bytes) -> None:
    """Write bytes at the end of a file."""
    with path.open("ab") as stream:
        stream.write(content)


def _content(lines: list[bytes]) -> bytes:
    """Content of a file with these lines."""
    ended = [line + b"\n" for line in lines]
    return b"".join(ended)


def _judge(lines: list[bytes]) -> audit.AuditVerdict:
    return judge_chain(_content(lines), lambda _: None)


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines()


def _six_lines() -> list[bytes]:
    """Lines of an audit with six entries."""
    with _folder() as folder:
        path = folder / "a"
        _filled(path)
        return _lines(path)


def _flaws(verdict: audit.AuditVerdict) -> list[tuple[int, Flaw]]:
    """Line and kind of each flaw."""
    return [(flaw.line, flaw.flaw) for flaw in verdict.flaws]


def _numbers(entries: Iterable[AuditEntry]) -> list[int]:
    """Numbers of entries."""
    return [one.number for one in entries]


def _digest(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


@pytest.mark.slow
@given(st.lists(WRITES, max_size=5))
def test_what_is_appended_is_read_back_and_the_chain_holds(
    drawn: list[tuple[AuditAction, str, str, dict[str, object]]],
) -> None:
    writes = [write for write in drawn if write[0] is not AuditAction.TORN_LINE]
    with _folder() as folder:
        path = folder / "cell.audit.jsonl"
        assert read(path) == ()
        written = []
        for action, who, subject, details in writes:
            one = append(path, action, at=NOW, who=who, subject=subject, details=details)
            written.append(one)
        assert list(read(path)) == written
        expected = list(range(1, len(writes) + 1))
        assert _numbers(written) == expected
        for one, (action, who, subject, details) in zip(written, writes, strict=True):
            assert one.action == action
            assert one.who == who
            assert one.subject == subject
            assert one.details == details
        heads = [one.sha256 for one in written]
        verdict = verify(path, heads=heads)
        assert verdict.holds
        assert verdict.broken is None
        assert verdict.entries == tuple(written)


def test_the_digest_is_sha256_of_canonical_json_and_covers_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "a"
    first, second = _filled(path, 2)
    second_line = _lines(path)[1]
    tree = json.loads(second_line)
    assert tree.pop("sha256") == second.sha256
    assert tree["previous"] == first.sha256
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    assert second.sha256 == _digest(text.encode())
    assert first.previous == "0" * 64


@pytest.mark.slow
@given(line=st.integers(0, 5), data=st.data())
def test_one_changed_byte_is_found_at_its_line(line: int, data: st.DataObject) -> None:
    lines = _six_lines()
    before = lines[line]
    place = data.draw(st.integers(0, len(before) - 1))
    excluded = {before[place], LINE_END}
    other_bytes = st.integers(0, 255).filter(lambda b: b not in excluded)
    changed = bytearray(before)
    changed[place] = data.draw(other_bytes)
    lines[line] = bytes(changed)
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
    lines = _six_lines()
    last = min(line + count, 5)
    del lines[line:last]
    verdict = _judge(lines)
    assert _flaws(verdict) == [(line + 1, Flaw.REMOVED)]
    line_text = str(line + 1)
    assert line_text in verdict.flaws[0].says


@pytest.mark.slow
@given(st.permutations(range(6)))
def test_a_changed_order_is_found(order: list[int]) -> None:
    lines = _six_lines()
    verdict = _judge([lines[k] for k in order])
    moved = [place for place, k in enumerate(order) if place != k]
    if moved:
        assert verdict.broken == moved[0] + 1
    else:
        assert verdict.broken is None
    flaws = {flaw.flaw for flaw in verdict.flaws}
    assert flaws <= {Flaw.MOVED}


@given(place=st.integers(0, 6), copied=st.integers(0, 5))
def test_a_line_that_was_added_twice_is_found(place: int, copied: int) -> None:
    lines = _six_lines()
    lines.insert(place, lines[copied])
    verdict = _judge(lines)
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
    lines = [encode(one) for one in entries]
    lines[place] = encode(forged)
    verdict = _judge(lines)
    assert _flaws(verdict) == [(place + 1, Flaw.EDITED)]
    # Put between two others, it is one entry of that number too many.
    lines = [encode(one) for one in entries]
    lines.insert(place, encode(forged))
    verdict = _judge(lines)
    assert not verdict.holds


def test_a_cut_off_tail_is_found_by_who_noted_an_entry_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "a"
    entries = _filled(path)
    remaining = _lines(path)[:4]
    path.write_bytes(_content(remaining))
    assert verify(path).holds
    heads = [entries[2].sha256, entries[5].sha256]
    verdict = verify(path, heads=heads)
    assert _flaws(verdict) == [(5, Flaw.CUT_OFF)]
    says = verdict.flaws[0].says
    sha256 = entries[5].sha256
    assert sha256[:12] in says
    none = tmp_path / "none"
    verdict = verify(none, heads=[entries[0].sha256])
    assert verdict.broken == 1


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
            added = len(written) - len(before)
            length = len(before) + round(cut * added)
            path.write_bytes(written[:length])
            assert verify(path).holds
        left = path.read_bytes()
        last = _append(path, AuditAction.APPLIED, "x", {})
        assert path.read_bytes().startswith(left)
        assert read(path)[-1] == last
        verdict = verify(path)
        assert verdict.holds
        expected = list(range(1, len(verdict.entries) + 1))
        assert _numbers(verdict.entries) == expected
        # A fragment that is removed or changed after it was reported is missed.
        lines = _lines(path)
        for torn in verdict.torn:
            index = torn - 1
            before_it = lines[:index]
            behind_it = lines[torn:]
            without = _judge([*before_it, *behind_it])
            assert not without.holds
            fragment = lines[index]
            last_place = max(len(fragment) - 1, 0)
            place = data.draw(st.integers(0, last_place))
            changed = fragment[:place] + b"#" + fragment[place:]
            with_changed = _judge([*before_it, changed, *behind_it])
            assert not with_changed.holds


@pytest.mark.parametrize(
    ("cut_bytes", "flaw", "torn"),
    [
        pytest.param(30, (6, Flaw.UNFINISHED), (), id="its digest is left"),
        pytest.param(250, (9, Flaw.CUT_OFF), (6,), id="its digest is lost"),
    ],
)
def test_a_noted_entry_that_was_torn_stays_missing_after_later_entries(
    tmp_path: Path, cut_bytes: int, flaw: tuple[int, Flaw], torn: tuple[int, ...]
) -> None:
    path = tmp_path / "a"
    lost = _filled(path)[-1]
    content = path.read_bytes()
    path.write_bytes(content[:-cut_bytes])
    first_heads = audit.noted_heads(path)
    first = verify(path, heads=first_heads)
    assert len(first.flaws) == 1
    assert lost.sha256[:12] in first.flaws[0].says
    assert first.torn == torn
    assert first.is_torn_end
    _append(path, AuditAction.APPLIED, "x", {})
    later_heads = audit.noted_heads(path)
    assert lost.sha256 in later_heads
    later = verify(path, heads=later_heads)
    assert _flaws(later) == [flaw]
    assert lost.sha256[:12] in later.flaws[0].says
    assert later.torn == torn
    _append(path, AuditAction.APPLIED, "x", {})
    assert lost.sha256 in audit.noted_heads(path)


def test_an_unfinished_line_whose_entry_was_never_noted_is_no_flaw(tmp_path: Path) -> None:
    path = tmp_path / "a"
    _filled(path, 2)
    note = audit.head_file(path)
    noted = note.read_bytes()
    _filled(path, 1)
    content = path.read_bytes()
    path.write_bytes(content[:-30])  # killed while it appended
    note.write_bytes(noted)
    for _ in range(2):
        verdict = verify(path, heads=audit.noted_heads(path))
        assert verdict.holds
        assert verdict.torn == (3,)
        _append(path, AuditAction.APPLIED, "x", {})


def test_zeros_after_a_power_cut_are_an_unfinished_line(tmp_path: Path) -> None:
    path = tmp_path / "a"
    _filled(path, 2)
    _add_bytes(path, bytes(100))
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
    _add_bytes(path, content)
    assert not verify(path).holds


def test_what_is_left_of_a_first_entry_is_no_other_file(tmp_path: Path) -> None:
    complete = tmp_path / "complete"
    _filled(complete, 1)
    content = complete.read_bytes()
    for length in range(len(content) - 1):
        path = tmp_path / str(length)
        path.write_bytes(content[:length])
        one = _append(path, AuditAction.APPLIED, "", {}, who="")
        if length == 0:
            assert one.number == 1
        else:
            assert one.number == 2
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
    spoiled = _content([first, spoil(last)])
    path.write_bytes(spoiled)
    with pytest.raises(AuditUnusable, match="line 2, which drivegain did not write"):
        _filled(path, 1)
    assert exit_code(AuditUnusable) == 3
    assert path.read_bytes() == spoiled


def _write(
    begun: AuditAction, path: Path, subject: Path, before: bytes, after: bytes
) -> AuditEntry:
    digests: dict[str, object] = {
        "sha256_before": _digest(before),
        "sha256_after": _digest(after),
    }
    return _append(path, begun, str(subject), digests)


def _open_contents(path: Path) -> dict[int, Content]:
    """What files have of the writes without an end, by the numbers of their entries."""
    open_writes = verify(path).open_writes
    return {one.begun.number: one.content for one in open_writes}


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
    (open_write,) = verify(path).open_writes
    assert open_write.begun == first
    assert open_write.content == content

    # The next write on the same file saw what was there, whatever is there by now.
    other = tmp_path / "y.yaml"
    _write(begun, path, other, b"other", b"file")
    second = _write(begun, path, file, b"new", b"newest")
    file.write_bytes(b"newest")
    _append(path, AuditAction.APPLIED, str(file), {"begun": second.number})
    assert _open_contents(path) == {1: Content.AFTER, 2: Content.OTHER}

    other.mkdir()  # unreadable
    assert _open_contents(path)[2] is Content.UNKNOWN


@pytest.mark.parametrize("end", [AuditAction.APPLIED, AuditAction.ROLLED_BACK, AuditAction.FAILED])
def test_a_write_with_an_end_is_not_open(tmp_path: Path, end: AuditAction) -> None:
    path = tmp_path / "a"
    subject = tmp_path / "x"
    begun = _write(AuditAction.APPLY_BEGUN, path, subject, b"old", b"new")
    _append(path, end, begun.subject, {"begun": begun.number})
    assert verify(path).open_writes == ()


def test_no_number_that_is_not_finite_gets_in(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with pytest.raises(ValueError, match="JSON"):
        _append(path, AuditAction.PROPOSED, "", {"gain": math.nan}, who="")
    assert path.read_bytes() == b""


def test_what_is_no_regular_file_is_refused_and_no_one_waits(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (fifo, tmp_path, Path("/dev/zero")):
        with pytest.raises(AuditUnusable):
            read(path)
        with pytest.raises((AuditUnusable, PermissionError)):
            _filled(path, 1)

    folder = tmp_path / "gone"
    target = folder / "a"
    dangling = tmp_path / "dangling"
    dangling.symlink_to(target)
    for refused in (lambda path: _filled(path, 1), read, verify):
        with pytest.raises(AuditUnusable, match="where there is no file"):
            refused(dangling)
    folder.mkdir()
    target.touch()
    _filled(dangling, 1)
    assert len(read(target)) == 1


def test_the_entry_is_on_the_disk_and_so_is_the_folder_of_a_new_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[str] = []

    def noted(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}")
        flushed.append(str(path.readlink()))

    monkeypatch.setattr(os, "fsync", noted)
    path = tmp_path / "a"
    _filled(path, 2)
    assert flushed == [str(path), str(tmp_path), str(path)]


def _append_many(path: Path, who: str) -> None:
    for k in range(25):
        append(path, AuditAction.PROPOSED, at=NOW, who=who, subject="x", details={"k": k})


def test_many_writers_make_one_chain(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    path = tmp_path / "a"
    writers = []
    for who in "0123":
        writer = context.Process(target=_append_many, args=(path, who))
        writers.append(writer)
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    verdict = verify(path)
    assert verdict.holds
    assert len(verdict.entries) == 100
    for who in "0123":
        of_writer = [one for one in verdict.entries if one.who == who]
        numbers = [one.details["k"] for one in of_writer]
        assert numbers == list(range(25))


def test_a_lock_that_is_never_given_back_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "_PAUSE_S", 0.0)
    path = tmp_path / "a"
    with path.open("w") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        with pytest.raises(AuditUnusable, match="keeps it locked"):
            _filled(path, 1)


def test_an_entry_cannot_hide_a_missing_torn_line(tmp_path: Path) -> None:
    """An entry reports an unfinished line, and none is there: it was removed."""
    path = tmp_path / "a"
    _filled(path, 1)
    _add_bytes(path, b'{"action":')
    _filled(path, 1)
    assert verify(path).torn == (2,)
    lines = _lines(path)
    del lines[1]
    (flaw,) = _judge(lines).flaws
    assert flaw.flaw is Flaw.EDITED


@pytest.mark.parametrize("strange", [[1], {"a": 1}, None, "1", 1.5])
def test_details_of_another_program_are_no_error(tmp_path: Path, strange: object) -> None:
    """Any program can write a chain that holds."""
    path = tmp_path / "a"
    foreign_details = {"sha256_before": strange, "sha256_after": strange, "begun": strange}
    for action in (AuditAction.APPLY_BEGUN, AuditAction.APPLIED, AuditAction.APPLY_BEGUN):
        _append(path, action, "x", foreign_details, who="")
    verdict = verify(path)
    assert verdict.holds
    assert len(verdict.open_writes) == 2


def test_an_entry_that_the_system_takes_in_parts_is_written_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "audit.jsonl"
    write = os.write

    def seven_bytes(descriptor: int, data: bytes) -> int:
        part = bytes(data)[:7]
        return write(descriptor, part)

    monkeypatch.setattr(os, "write", seven_bytes)
    made = _append(path, AuditAction.PROPOSED, "cell", {"n": 1}, who="me")
    monkeypatch.undo()
    assert read(path) == (made,)
    assert verify(path).holds


@pytest.mark.parametrize("number", [errno.EIO, errno.EDQUOT, errno.ENOSPC])
def test_an_entry_that_is_taken_in_part_fails_with_the_cause_of_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path = tmp_path / "audit.jsonl"
    first = _append(path, AuditAction.PROPOSED, "cell", {"n": 1}, who="me")
    write = os.write
    calls: list[int] = []

    def short(descriptor: int, data: bytes) -> int:
        calls.append(descriptor)
        if len(calls) > 1:
            raise OSError(number, os.strerror(number))
        part = bytes(data)[:20]
        return write(descriptor, part)

    monkeypatch.setattr(os, "write", short)
    with pytest.raises(OSError, match=os.strerror(number)) as caught:
        _append(path, AuditAction.WRITE_FOUND, "cell", {"n": 2}, who="me")
    monkeypatch.undo()
    assert caught.value.errno == number
    # The unfinished line is reported by the next entry, and the chain holds.
    _append(path, AuditAction.WRITE_FOUND, "cell", {"n": 2}, who="me")
    entries = read(path)
    assert entries[0] == first
    actions = [one.action for one in entries[1:]]
    assert actions == [AuditAction.TORN_LINE, AuditAction.WRITE_FOUND]
    assert verify(path).holds
    assert verify(path).torn == (2,)
