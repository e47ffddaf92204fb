"""Whether what a command says of a write is what is on the disk.

Every sentence that claims something about files must be known here: a claim without a rule is a
finding too.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path


class Content(Enum):
    """Content of the controller's file."""

    OLD = "old"
    NEW = "new"
    BROKEN = "neither"
    MIXED = "both"  #: drives, some with old gains and some with new ones


@dataclass(frozen=True, slots=True)
class Facts:
    """What is on the disk after a command.

    Attributes:
        content: of the controller's file.
        controller: its file.
        before, after: every file of the place by its path, with its content.
        ended: actions of the writes that the audit log ends, in its order.
        has_write: the history has the write that the command was asked for.
        has_calibration: the history has the calibration.
        not_made: files and folders of which a change was begun and not made.
    """

    content: Content
    controller: Path
    before: dict[Path, bytes]
    after: dict[Path, bytes]
    ended: tuple[str, ...]
    has_write: bool
    has_calibration: bool = False
    not_made: frozenset[Path] = frozenset()

    def is_as_before(self, path: Path) -> bool:
        """Whether a file has the content that it had, or is not there as before."""
        return self.before.get(path) == self.after.get(path)


@dataclass(frozen=True, slots=True)
class Rule:
    """A sentence that claims something, and the check of its claim."""

    pattern: str
    holds: Callable[[re.Match[str], Facts], bool]


def _is_old(_: re.Match[str], facts: Facts) -> bool:
    return facts.content is Content.OLD


def _is_not_new(_: re.Match[str], facts: Facts) -> bool:
    return facts.content in (Content.OLD, Content.MIXED)


def _is_new(_: re.Match[str], facts: Facts) -> bool:
    return facts.content is Content.NEW


def _subject_as_before(found: re.Match[str], facts: Facts) -> bool:
    path = Path(found["subject"])
    return facts.is_as_before(path)


def _subject_missing(found: re.Match[str], facts: Facts) -> bool:
    """Hold where there is neither a file nor a folder of that name, or a change of it was begun and
    not made: a later entry of the same command may have made it.
    """
    subject = Path(found["subject"])
    is_there = any(path.is_relative_to(subject) for path in facts.after)
    return not is_there or subject in facts.not_made


def _subject_empty(found: re.Match[str], facts: Facts) -> bool:
    """Hold where there is a file without content, or as `_subject_missing`."""
    subject = Path(found["subject"])
    return facts.after.get(subject) == b"" or subject in facts.not_made


def _written_with_backup(found: re.Match[str], facts: Facts) -> bool:
    backup = facts.controller.parent / found["backup"]
    return (
        facts.content is Content.NEW and facts.after.get(backup) == facts.before[facts.controller]
    )


def _subject_not_begun(found: re.Match[str], facts: Facts) -> bool:
    """Hold where a change of a file, or of any file of a folder, was begun and not made, or its
    folder was not; the controller's file changes once, and is compared.
    """
    subject = Path(found["subject"])
    if subject == facts.controller and subject in facts.before:
        return facts.is_as_before(subject)
    if facts.not_made.intersection(subject.parents):
        return facts.is_as_before(subject)
    return any(path.is_relative_to(subject) for path in facts.not_made)


def _is_mixed_or_bus_failed(found: re.Match[str], facts: Facts) -> bool:
    """Hold where drives have gains of both; behind a bus that has failed, nobody knows."""
    return facts.content is Content.MIXED or ": bus " in found["why"]


def _note_not_made(found: re.Match[str], facts: Facts) -> bool:
    """Hold where a change of the note was begun and not made."""
    return Path(found["note"]) in facts.not_made


def _written_with_path(found: re.Match[str], facts: Facts) -> bool:
    path = Path(found["backup"])
    backup = facts.after.get(path)
    return facts.content is Content.NEW and backup == facts.before[facts.controller]


def _blocks_are_there(found: re.Match[str], facts: Facts) -> bool:
    names = {path.name for path in facts.after}
    blocks = found["blocks"].split(", ")
    return blocks == ["no block yet"] or names >= {f"{block}.mcap" for block in blocks}


def _is_any(_: re.Match[str], __: Facts) -> bool:
    """Hold for a sentence that says itself that it does not know,
    or that speaks of what a reader may do.
    """
    return True


RULES = (
    Rule(r"error: (?P<subject>\S+) found: [^;]*? do: it is as it was", _subject_as_before),
    Rule(r"(?P<subject>/\S+): found [^;]*; expected [^;]*; it is as it was", _subject_not_begun),
    Rule(r"error: (?P<subject>\S+) found: [^;]*? do: it was not made", _subject_missing),
    Rule(r"(?P<subject>/\S+): found [^;]*; expected [^;]*; it was not made", _subject_missing),
    Rule(r"error: (?P<subject>\S+) found: [^;]*? do: it is empty", _subject_empty),
    Rule(r"(?P<subject>/\S+): found [^;]*; expected [^;]*; it is empty", _subject_empty),
    Rule(r"nothing was written to the controller", _is_old),
    Rule(r"nothing was written to the drives", _is_old),
    Rule(r"nothing was (written|changed|restored)", _is_old),
    Rule(r"Nothing to write: the controller file has these gains already", _is_new),
    Rule(r"has the new content, complete", _is_new),
    Rule(r"the history lacks this write", lambda _, facts: not facts.has_write),
    Rule(r"the history may lack this write", _is_any),
    Rule(r"the audit log may lack the entry that it is (applied|rolled back)", _is_new),
    # Where the bus has failed, nobody knows what the drives have.
    Rule(r"the audit log may lack the entry that it is failed(?=.* NOT confirmed where)", _is_any),
    Rule(r"the audit log may lack the entry that it is failed", _is_not_new),
    Rule(r"the audit log may lack the entry that it is refused", _is_old),
    Rule(
        r"the previous values are restored in no drive, and NOT confirmed where (?P<why>.*?); do "
        "not enable an axis",
        _is_mixed_or_bus_failed,
    ),
    Rule(r"Written to \S+, backup (?P<backup>\S+); audit log", _written_with_backup),
    Rule(
        r"Restored \S+ to \S+; the replaced content is in "
        r"(?P<backup>\S+?)\.(\s|$)",
        _written_with_backup,
    ),
    Rule(r"was written before that, completely", _is_new),
    Rule(r"written to the controller's file: file \S+, backup (?P<backup>\S+)", _written_with_path),
    Rule(r"certified: id \w+, written on", _is_new),
    Rule(r"certified: id \w+, not written", lambda _, facts: not facts.has_write),
    Rule(
        r"the digest of the last entry cannot be noted in (?P<note>\S+) \([^)]*\): a missing end "
        r"of the audit log would not be noticed; [^;]*, and the next entry is noted again",
        _note_not_made,
    ),
    Rule(r"metrics could not be written", _is_any),
    Rule(r"lost cycles \d+", _is_any),
    Rule(r"`drivegain history CELL --add CALIBRATION` enters it", _is_any),
    Rule(r"the next job, apply or history --add enters it", _is_any),
    Rule(r"Written to the drives and read back", _is_new),
    Rule(r"The drives have saved", _is_new),
    Rule(r"(kept:\s+)?the previous values are restored in (J\d(, )?)+", _is_old),
    Rule(r"whether \S+ has the new content is not known", _is_any),
    Rule(r"a file system that completes what it began", _is_any),
    Rule(r"kept: (?P<blocks>no block yet|block[-\w]+(, block[-\w]+)*)", _blocks_are_there),
    Rule(r"hint: remove the cause", _is_any),
    Rule(r"a folder that can be written", _is_any),
    Rule(r"it may have the new content", _is_any),
    Rule(r"the audit log may lack the end of the session", _is_any),
    Rule(r"(kept: )?the end of the session may not be recorded", _is_any),
    Rule(r"`drivegain rollback \S+` undoes it", _is_any),
)
CLAIMS = re.compile(
    r"\b(written|unchanged|as it was|not made|is empty|as before|restored|rolled "
    r"back|kept|complete|completely|lacks|does not have|not "
    r"known|was changed|undone|lost|saved|replaced|enters?|entered|removed?|noted)\b",
    re.IGNORECASE,
)
"""Words of a sentence that claims something about files."""


def false_sentences(said: str, facts: Facts) -> tuple[str, ...]:
    """Return the sentences that are not true, and those that claim something that no rule
    judges.
    """
    text = " ".join(said.split())
    found = []
    for rule in RULES:
        matches = re.finditer(rule.pattern, text)
        found += [f"false: {match[0]}" for match in matches if not rule.holds(match, facts)]
        text = re.sub(rule.pattern, " … ", text)
    for claim in CLAIMS.finditer(text):
        around = text[max(0, claim.start() - 60) : claim.end() + 40]
        found.append(f"not judged: {around}")
    return tuple(found)


WRITTEN = (
    "has the new content",
    "written to the controller's file: file",
    "restored in no drive, and NOT confirmed where",
)
"""Words by which a command that fails says that the new gains are there: of a file, of a job, and
of drives behind a bus that has failed, which may have them.
"""


def wrong_code(code: int | None, said: str, facts: Facts) -> str:
    """Return what is wrong with an exit code; empty where it is right.

    A killed process has none.
    """
    if code is None:
        return ""
    if code == 0 and facts.content is not Content.NEW:
        return "exit 0 and the old file"
    is_said = any(words in said for words in WRITTEN)
    if code != 0 and facts.content is Content.NEW and not is_said:
        return f"exit {code}, the new file, and no word of it"
    return ""
