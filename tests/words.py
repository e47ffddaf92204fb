"""`make words`: count the words of the old house language that are still in code,
tests and documentation.

The phrases are the left column of the project's language table, each with the plain English to
write instead. Files are read as text: comments, messages, docstrings, identifiers (`told_of` and
`TellingTime` are split into words), file names and documentation. Phrases broken over lines are
joined first. Docstrings are found with `ast`.

    python -m tests.words                          the working tree beside the baseline; exit code 1 above the limit
    python -m tests.words --at REV                 the same for a git revision
    python -m tests.words --show "stand"           where a phrase occurs (part of its name is enough)
    python -m tests.words --at ad5bfbc --baseline  prints BASELINE, the table at the end
"""  # noqa: E501

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMIT = 0.02  # of the baseline's total
AREAS = ("code", "tests", "docs")
DOCUMENTS = (".md", ".rst")
# Fixed by others, or about the old words themselves.
EXEMPT = {
    "LICENSE",
    "requirements.lock",
    "tests/vcan/foreign/package-lock.json",
    "docs/glossary.md",
    "tests/words.py",
    "tests/contracts/test_words.py",
}

Counts = dict[str, list[int]]  # phrase -> occurrences in each of AREAS


@dataclass(frozen=True)
class Phrase:
    """An entry of the table: a way of writing that is on its way out.

    Attributes:
        name: as the table prints it.
        instead: the plain English.
        pattern: regular expression. It is matched against the joined words in lower case, or
            against the text itself when `raw` is set.
        raw: whether the pattern is for identifiers as they are written.
    """

    name: str
    instead: str
    pattern: str
    raw: bool = False

    def found_in(self, source: Source) -> Iterator[str]:
        """Yield each occurrence with the words around it."""
        text = source.raw if self.raw else source.words
        for match in re.finditer(self.pattern, text):
            yield " ".join(text[max(0, match.start() - 50) : match.end() + 40].split())


PHRASES = (
    Phrase("told", "reported, shown, identified", r"\btold\b"),
    Phrase("tell, tells, telling", "reports, shows, distinguishes", r"\btell(?:s|ing|ings)?\b"),
    # Not: standstill, standard, standalone (other words), stand-alone, "stands still" of a joint at
    # rest.
    Phrase(
        "stand, stands, stood, standing",
        "is in, is, holds; approves",
        r"\b(?<!self-)(?:stands?|stood|standing)\b(?!-alone|-by| still| alone)",
    ),
    Phrase("whoever, whomever", "operator, caller, client", r"\bwho(?:m?ever|soever)\b"),
    Phrase(
        "somebody, anybody, who asks",
        "operator, caller, another program",
        r"\b(?:somebody|anybody|who asks?)\b",
    ),
    Phrase("nobody", "no one is needed: name the thing that is missing", r"\bnobody\b"),
    Phrase("way back", "rollback", r"\bways? back\b"),
    Phrase(
        "fails while … is told",
        "reporting failures are attached as notes",
        r"\bwhat fails? while\b",
    ),
    Phrase(
        "take … back",
        "undo, roll back",
        r"\b(?:take|takes|took|taken|taking)(?: "
        r"[\w`{}.']+){0,6} back\b",
    ),
    Phrase(
        "closed gate",
        "failed check",
        r"\bclosed gates?\b|\bgates? "
        r"(?:is|are|was|were|stays?|stayed) closed\b",
    ),
    Phrase("inertia only", "identifiable only through inertia", r"\binertia only\b"),
    Phrase("as fit; then find", "fit, then detect and add missing effects", r"\bas fit; then\b"),
    Phrase(
        "what the model lacks",
        "missing effects",
        r"\bwhat (?:the|a|their) model (?:may "
        r")?lack(?:s|ed)?\b",
    ),
    Phrase("make a log of", "convert CSV files to a log", r"\bmake a log of\b"),
    Phrase(
        "unused, not used (runs)",
        "held-out",
        r"\bunused\b|\bruns? that (?:was|were|is|are) not used\b",
    ),
    Phrase("short_searches", "defer_full_gc", r"\bshort_searches\b", raw=True),
    Phrase("deed, doer", "WriteAction, actor", r"\bdeeds?\b|\bdoers?\b"),
    Phrase("Cellside", "JobContext", r"\bcell ?side\b"),
    Phrase("stranger", "foreign SYNC, foreign node, another user", r"\bstrangers?\b"),
    Phrase("written_down", "recorded in the audit log", r"\bwritten[_ ]down\b"),
    Phrase("looked_at", "reviewed", r"\blooked[_ ]at\b"),
    Phrase("circumstances", "GateContext", r"\bcircumstances?\b"),
    Phrase("garbage", "deferred_gc; full collection", r"\bgarbage\b(?! collect)"),
)
DOCSTRING = "docstring begins with Of or What"


@dataclass(frozen=True)
class Source:
    """A file of the repository.

    Attributes:
        path: in the repository, with slashes.
        raw: its text, after its path.
        words: the same in lower case on one line, identifiers split into words.
    """

    path: str
    raw: str
    words: str

    @staticmethod
    def of(path: str, text: str) -> Source:
        """Prepare a file for the search."""
        if path == "CHANGELOG.md":
            shown = re.sub(r'`[^`\n]*`|"[^"\n]*"|“[^”\n]*”', "", text)
        else:
            shown = text
        raw = f"{path}\n{shown}"
        # A message in several pieces
        joined = re.sub(r'(?<!")"[ \t]*\n[ \t]*[fr]{0,2}"(?!")', "", raw)
        joined = re.sub(r"\s*\n[ \t]*(?:#+(?!\w)|>|\*|//)?[ \t]*", " ", joined)
        split = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", joined).replace("_", " ")
        return Source(path, raw, re.sub(r"[ \t]+", " ", split).lower())

    @property
    def area(self) -> int:
        """Index into AREAS."""
        if self.path.startswith("tests/"):
            return 1
        if self.path.startswith("docs/") or self.path.endswith(DOCUMENTS):
            return 2
        return 0

    def odd_docstrings(self) -> Iterator[str]:
        """Yield the docstrings that begin with "Of" or "What"."""
        if not self.path.endswith(".py"):
            return
        for node in ast.walk(ast.parse(self.raw.split("\n", 1)[1])):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = (ast.get_docstring(node) or "").lstrip()
                if re.match(r"(?:Of|What)\b", text):
                    yield text.splitlines()[0]


def working_tree() -> Iterator[Source]:
    """Yield the files of the working tree that git knows or would add."""
    listed = _git("ls-files", "-z", "--cached", "--others", "--exclude-standard").decode()
    for path in sorted(filter(None, listed.split("\0"))):
        file = ROOT / path
        if path not in EXEMPT and file.is_file() and not file.is_symlink():
            yield from _decoded(path, file.read_bytes())


def revision(name: str) -> Iterator[Source]:
    """Yield the files of a git revision."""
    with tarfile.open(fileobj=io.BytesIO(_git("archive", "--format=tar", name))) as archive:
        for member in archive:
            if member.isfile():
                content = archive.extractfile(member)
            else:
                content = None
            if content is not None and member.name not in EXEMPT:
                yield from _decoded(member.name, content.read())


def occurrences(source: Source) -> Iterator[tuple[str, str]]:
    """Yield the phrases of a file, each with the words around it."""
    for phrase in PHRASES:
        for context in phrase.found_in(source):
            yield phrase.name, context
    for first_line in source.odd_docstrings():
        yield DOCSTRING, first_line


def count(sources: Iterator[Source]) -> Counts:
    """Count every phrase in each of AREAS."""
    counts: Counts = {
        name: [0] * len(AREAS) for name in (*(phrase.name for phrase in PHRASES), DOCSTRING)
    }
    for source in sources:
        for name, _ in occurrences(source):
            counts[name][source.area] += 1
    return counts


def table(counts: Counts) -> str:
    """Format the counts beside the baseline, one phrase a line and the totals last."""
    rows = [(name, *found, sum(found), sum(BASELINE[name])) for name, found in counts.items()]
    totals = [sum(column) for column in zip(*(figures for _, *figures in rows), strict=True)]
    lines = [f"{'phrase':34}" + "".join(f"{head:>10}" for head in (*AREAS, "total", "baseline"))]
    lines += [
        f"{name:34}" + "".join(f"{figure:10d}" for figure in figures) for name, *figures in rows
    ]
    lines.append(f"{'total':34}" + "".join(f"{figure:10d}" for figure in totals))
    return "\n".join(lines)


def main() -> int:
    """Print the table, or the places of a phrase; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--at", metavar="REV", help="count a git revision in place of the working tree"
    )
    parser.add_argument("--show", metavar="PHRASE", help="list where the phrase occurs")
    parser.add_argument(
        "--baseline", action="store_true", help="print the counts as the table BASELINE"
    )
    arguments = parser.parse_args()
    if arguments.at:
        sources = revision(arguments.at)
    else:
        sources = working_tree()
    if arguments.show is not None:
        for source in sources:
            for name, context in occurrences(source):
                if arguments.show in name:
                    sys.stdout.write(f"{source.path}: {context}\n")
        return 0
    counts = count(sources)
    if arguments.baseline:
        sys.stdout.write(
            "".join(f'    "{name}": {tuple(found)},\n' for name, found in counts.items())
        )
        return 0
    total = _total(counts)
    allowed = LIMIT * _total(BASELINE)
    sys.stdout.write(
        f"{table(counts)}\n{total} found, at most {allowed:.0f} allowed: {LIMIT:.0%} "
        "of the baseline\n"
    )
    return int(total > allowed)


def _total(counts: Mapping[str, Sequence[int]]) -> int:
    """Sum of all counts."""
    return sum(sum(found) for found in counts.values())


def _decoded(path: str, content: bytes) -> Iterator[Source]:
    """Yield the file when it is text."""
    try:
        yield Source.of(path, content.decode())
    except UnicodeDecodeError:
        return


def _git(*arguments: str) -> bytes:
    """Output of a git command in the repository."""
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True).stdout


# python -m tests.words --at ad5bfbc --baseline
BASELINE: dict[str, tuple[int, ...]] = {
    "told": (446, 550, 26),
    "tell, tells, telling": (283, 144, 51),
    "stand, stands, stood, standing": (213, 70, 41),
    "whoever, whomever": (48, 24, 25),
    "somebody, anybody, who asks": (106, 43, 25),
    "nobody": (94, 72, 26),
    "way back": (25, 17, 1),
    "fails while … is told": (1, 0, 0),
    "take … back": (10, 9, 7),
    "closed gate": (26, 5, 7),
    "inertia only": (2, 5, 1),
    "as fit; then find": (1, 0, 0),
    "what the model lacks": (5, 0, 4),
    "make a log of": (3, 0, 0),
    "unused, not used (runs)": (17, 56, 21),
    "short_searches": (3, 3, 0),
    "deed, doer": (83, 32, 0),
    "Cellside": (22, 0, 0),
    "stranger": (8, 8, 1),
    "written_down": (32, 9, 6),
    "looked_at": (70, 35, 10),
    "circumstances": (20, 5, 0),
    "garbage": (3, 5, 2),
    "docstring begins with Of or What": (300, 99, 0),
}


if __name__ == "__main__":
    sys.exit(main())
