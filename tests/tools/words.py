"""`make words`: the words that this project uses more often than well-known packages do.

Words of the code are those of its identifiers, split at underscores and capitals. Words of the
prose are those of comments, docstrings, messages and pages. Both are compared with their
frequency in a corpus of anchors: installed packages that are known to be well written.
`anchors.json` has these frequencies, measured once; it has no text of the anchors.

The ratio of a word is (f + s) / (f_anchors + s), with frequencies in occurrences a thousand words
and s = SMOOTHING. A word that no anchor uses thus has a finite ratio, and a rare one a small ratio.
Words of the field are used more often for a good reason: `domain_words.txt` lists them, the
glossary defines them, and they are printed apart.

    python -m tests.tools.words                  the product and its documentation
    python -m tests.tools.words tests            other files or folders
    python -m tests.tools.words --show kept      the lines where a word occurs
    python -m tests.tools.words --measure        measure the anchors again, into anchors.json
"""

from __future__ import annotations

import argparse
import ast
import importlib.metadata
import io
import json
import keyword
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
ANCHORS_FILE = Path(__file__).with_name("anchors.json")
DOMAIN_FILE = Path(__file__).with_name("domain_words.txt")
PRODUCT = ("daq", "ident", "drivers", "lazy_names.py", "docs", "README.md", "CONTRIBUTING.md")

ANCHORS = (
    "anyio",
    "canopen",
    "click",
    "cvxpy",
    "dask",
    "distributed",
    "h11",
    "hypothesis",
    "matplotlib",
    "mcap",
    "numpy",
    "packaging",
    "pandas",
    "pydantic",
    "pytest",
    "python-can",
    "requests",
    "rich",
    "rosbags",
    "scipy",
    "starlette",
    "tornado",
    "typer",
    "uvicorn",
    "websockets",
)
NO_ANCHOR_TEXT = {"tests", "test", "testing", "_vendor", "vendor", "_vendored", "extern"}

SMOOTHING = 0.05  # occurrences a thousand words
LEAST_FREQUENCY = 0.1  # occurrences a thousand words; rarer words are no habit
LEAST_COUNT = 20
STORED_FREQUENCY = 0.005  # occurrences a thousand words; rarer words of the anchors are not stored
SHOWN = 20
NAMES = {"drivegain", "daq", "ident", "drivers"}  # of the packages

DIRECTIVE = re.compile(r"#\s*(?:noqa|type:|pragma|mypy:|pylint|fmt:|ruff)", re.IGNORECASE)
CODE_OF_PAGE = re.compile(r"^(```+|~~~+).*?^\1[ \t]*$", re.MULTILINE | re.DOTALL)
INLINE_CODE = re.compile(r"``.+?``|`[^`\n]+`")
LINK_TARGET = re.compile(r"\]\([^)\s]*\)|https?://\S+")


@dataclass(frozen=True)
class Line:
    """Words of one piece of text, with the place where it begins.

    Attributes:
        path: file.
        number: line, from 1.
        text: as it is written.
        is_code: an identifier, and not prose.
    """

    path: Path
    number: int
    text: str
    is_code: bool

    def words(self) -> list[str]:
        """Words in lower case, without single letters."""
        if self.is_code:
            return words_of_identifier(self.text)
        return words_of_prose(self.text)


@dataclass(frozen=True)
class Corpus:
    """Frequencies of the anchors, in occurrences a thousand words; every anchor counts the same.

    Attributes:
        versions: version of each package that was measured.
        words: number of words measured, of code and prose.
        code: frequency of each word in identifiers.
        prose: frequency of each word in comments, docstrings and messages.
    """

    versions: Mapping[str, str]
    words: Mapping[str, int]
    code: Mapping[str, float]
    prose: Mapping[str, float]


@dataclass(frozen=True)
class Overuse:
    """A word that is more frequent than in the anchors.

    Attributes:
        word: in lower case.
        count: occurrences.
        frequency: occurrences a thousand words.
        anchors: the same of the anchors.
        ratio: of the two, smoothed.
    """

    word: str
    count: int
    frequency: float
    anchors: float
    ratio: float


def words_of_identifier(name: str) -> list[str]:
    """Words of an identifier: `told_of` has told and of, `HTTPServer2` has http and server."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", name)
    spaced = re.sub(r"([A-Z])([A-Z][a-z])", r"\1 \2", spaced)
    return [word.lower() for word in re.findall(r"[^\W\d_]{2,}", spaced)]


def words_of_prose(text: str) -> list[str]:
    """Words of a text without its code: literals, links, and names with dots or underscores."""
    plain = INLINE_CODE.sub(" ", text)
    plain = LINK_TARGET.sub(" ", plain)
    found = []
    for token in plain.split():
        is_name = re.search(r"\w[_/=(]\w|\w\.\w|^--?\w|[{}\\<>]", token)
        if is_name is None:
            found += re.findall(r"[^\W\d_]{2,}", token)
    return [word.lower() for word in found]


def lines_of_python(path: Path, text: str) -> Iterator[Line]:
    """Yield identifiers, comments, docstrings and messages of a module.

    A message is any string constant of at least three words. Names between the braces of an
    f-string are not counted before Python 3.12, whose tokens they are.
    """
    try:
        tree = ast.parse(text)
        tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    except (SyntaxError, tokenize.TokenError):
        return
    for token in tokens:
        number = token.start[0]
        if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
            yield Line(path, number, token.string, is_code=True)
        elif token.type == tokenize.COMMENT and DIRECTIVE.match(token.string) is None:
            yield Line(path, number, token.string.lstrip("#! "), is_code=False)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            prose = without_examples(node.value)
            if len(prose.split()) >= 3:
                yield Line(path, node.lineno, prose, is_code=False)


def without_examples(text: str) -> str:
    """Text of a docstring without the lines of its examples."""
    kept = [line for line in text.splitlines() if not line.lstrip().startswith((">>>", "..."))]
    return "\n".join(kept)


def lines_of_page(path: Path, text: str) -> Iterator[Line]:
    """Yield the lines of a Markdown page that are no code."""

    def blank(block: re.Match[str]) -> str:
        return "\n" * block[0].count("\n")

    for number, line in enumerate(CODE_OF_PAGE.sub(blank, text).splitlines(), start=1):
        yield Line(path, number, line, is_code=False)


def lines_of(paths: Iterable[Path]) -> Iterator[Line]:
    """Yield the lines of Python modules and Markdown pages; other files have none."""
    for path in paths:
        if path.suffix == ".py":
            yield from lines_of_python(path, path.read_text(encoding="utf-8", errors="replace"))
        elif path.suffix == ".md":
            yield from lines_of_page(path, path.read_text(encoding="utf-8"))


def count_words(lines: Iterable[Line]) -> tuple[Counter[str], Counter[str]]:
    """Count the words of code, and those of prose."""
    code: Counter[str] = Counter()
    prose: Counter[str] = Counter()
    for line in lines:
        if line.is_code:
            code.update(line.words())
        else:
            prose.update(line.words())
    return code, prose


def per_thousand(counts: Mapping[str, int]) -> dict[str, float]:
    """Occurrences of each word a thousand words."""
    total = sum(counts.values())
    return {word: 1000.0 * count / total for word, count in counts.items()}


def mean_frequency(frequencies: list[dict[str, float]]) -> dict[str, float]:
    """Mean over the anchors of each word's frequency; words that are too rare are left out."""
    sums: Counter[str] = Counter()
    for frequency in frequencies:
        sums.update(frequency)
    means = {word: total / len(frequencies) for word, total in sorted(sums.items())}
    return {word: float(f"{mean:.3g}") for word, mean in means.items() if mean >= STORED_FREQUENCY}


def measure_corpus(packages: Mapping[str, tuple[str, list[Path]]]) -> Corpus:
    """Measure anchors: each package with its version and files."""
    code_frequencies = []
    prose_frequencies = []
    code_words = 0
    prose_words = 0
    for _, files in packages.values():
        code, prose = count_words(lines_of(files))
        code_frequencies.append(per_thousand(code))
        prose_frequencies.append(per_thousand(prose))
        code_words += code.total()
        prose_words += prose.total()
    return Corpus(
        versions={name: version for name, (version, _) in packages.items()},
        words={"code": code_words, "prose": prose_words},
        code=mean_frequency(code_frequencies),
        prose=mean_frequency(prose_frequencies),
    )


def installed_anchors() -> dict[str, tuple[str, list[Path]]]:
    """Version and modules of each anchor of this environment, without tests and vendored code."""
    packages = {}
    for name in ANCHORS:
        files = []
        for file in importlib.metadata.files(name) or []:
            if file.suffix == ".py" and NO_ANCHOR_TEXT.isdisjoint(file.parts):
                files.append(Path(str(file.locate())))
        packages[name] = (importlib.metadata.version(name), files)
    return packages


def load_corpus(path: Path = ANCHORS_FILE) -> Corpus:
    """Load the stored frequencies."""
    return Corpus(**json.loads(path.read_text(encoding="utf-8")))


def save_corpus(corpus: Corpus, path: Path = ANCHORS_FILE) -> None:
    """Store the frequencies."""
    text = json.dumps(vars(corpus), indent=0, ensure_ascii=False)
    path.write_text(f"{text}\n", encoding="utf-8")


def load_domain_words(path: Path = DOMAIN_FILE) -> dict[str, str]:
    """Words of the field, each with the term of the glossary that defines it."""
    terms = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            words, _, term = line.partition(":")
            for word in words.split():
                terms[word] = term.strip()
    return terms


def overused(counts: Counter[str], anchors: Mapping[str, float]) -> list[Overuse]:
    """Words that are used often enough to be a habit, the most over-used first."""
    found = []
    for word, frequency in per_thousand(counts).items():
        is_habit = counts[word] >= LEAST_COUNT and frequency >= LEAST_FREQUENCY
        if is_habit and word not in NAMES:
            of_anchors = anchors.get(word, 0.0)
            ratio = (frequency + SMOOTHING) / (of_anchors + SMOOTHING)
            found.append(Overuse(word, counts[word], frequency, of_anchors, ratio))
    return sorted(found, key=lambda use: (-use.ratio, use.word))


def format_table(title: str, uses: list[Overuse]) -> str:
    """Format over-used words, one a line."""
    lines = [f"{title:32}{'count':>8}{'a thousand':>12}{'anchors':>10}{'ratio':>8}"]
    for use in uses:
        lines.append(
            f"  {use.word:30}{use.count:8d}{use.frequency:12.2f}{use.anchors:10.3f}{use.ratio:8.1f}"
        )
    return "\n".join(lines) + "\n"


def report(
    lines: Iterable[Line], corpus: Corpus, domain: Mapping[str, str], shown: int = SHOWN
) -> str:
    """The most over-used words of code and prose, and those of the field apart."""
    code, prose = count_words(lines)
    parts = []
    for title, counts, anchors in (("code", code, corpus.code), ("prose", prose, corpus.prose)):
        uses = overused(counts, anchors)
        habits = [use for use in uses if use.word not in domain]
        of_field = [use for use in uses if use.word in domain]
        heading = f"{title}, {counts.total()} words"
        parts.append(format_table(heading, habits[:shown]))
        parts.append(format_table("  words of the field", of_field[:shown]))
    return "\n".join(parts)


def files_under(names: Iterable[str]) -> list[Path]:
    """Files of the working tree that git knows or would add, under these paths."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *names]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout.decode()
    paths = [ROOT / name for name in sorted(set(listed.split("\0"))) if name]
    return [path for path in paths if path.is_file()]


def main() -> int:
    """Print the tables, or the lines of a word; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="*", default=PRODUCT, help="files or folders to count")
    parser.add_argument("--show", metavar="WORD", help="list the lines where the word occurs")
    parser.add_argument("--words", type=int, default=SHOWN, help="how many words a table has")
    parser.add_argument("--measure", action="store_true", help="measure the installed anchors")
    arguments = parser.parse_args()
    if arguments.measure:
        save_corpus(measure_corpus(installed_anchors()))
        return 0
    files = files_under(arguments.paths)
    if not files:
        parser.error(f"no file under {', '.join(arguments.paths)}")
    lines = lines_of(files)
    if arguments.show is not None:
        for line in lines:
            if arguments.show.lower() in line.words():
                place = f"{line.path.relative_to(ROOT)}:{line.number}"
                sys.stdout.write(f"{place}: {' '.join(line.text.split())}\n")
        return 0
    sys.stdout.write(report(lines, load_corpus(), load_domain_words(), arguments.words))
    return 0


if __name__ == "__main__":
    sys.exit(main())
