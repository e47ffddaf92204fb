"""The glossary is true: its identifiers exist, its terms are used, and it defines the words of the
field that `make words` prints apart.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.tools.words import PRODUCT, files_under, load_domain_words

ROOT = Path(__file__).parents[2]
GLOSSARY = ROOT / "docs" / "glossary.md"
ROW = re.compile(
    r"^\| (?P<term>[^|]+?) \| (?P<meaning>[^|]+) \| (?P<names>[^|]+) \|$", re.MULTILINE
)


@pytest.fixture(scope="module")
def rows() -> list[re.Match[str]]:
    """Rows of the terms; the symbols of the paper come behind them."""
    terms, _, _ = GLOSSARY.read_text(encoding="utf-8").partition("## Symbols")
    found = [row for row in ROW.finditer(terms) if row["term"] != "term"]
    assert len(found) > 100
    return found


def test_every_identifier_of_the_glossary_is_in_the_code() -> None:
    code = {"daq", "drivers"}
    for folder in ("daq", "ident", "drivers"):
        for file in (ROOT / folder).rglob("*.py"):
            code |= set(re.findall(r"\w+", file.read_text(encoding="utf-8")))
    named = set()
    for line in re.findall(
        r"^\|.*\| (`.*`) \|$", GLOSSARY.read_text(encoding="utf-8"), re.MULTILINE
    ):
        named |= set(re.findall(r"`([^`]+)`", line))
    assert len(named) > 100
    assert sorted(name for name in named if not set(name.split(".")) <= code) == []


def test_every_term_of_the_glossary_is_used(rows: list[re.Match[str]]) -> None:
    text = ""
    for file in files_under(PRODUCT):
        if file.suffix in (".py", ".md") and file != GLOSSARY:
            text += file.read_text(encoding="utf-8").lower().replace("_", " ")
    text = " ".join(text.split())
    for row in rows:
        for term in row["term"].split(", "):
            assert term.lower() in text, f"{term}: remove it from the glossary, or use it"


def test_every_word_of_the_field_has_a_row_of_the_glossary(rows: list[re.Match[str]]) -> None:
    terms = {row["term"] for row in rows}
    for word, term in load_domain_words().items():
        assert term in terms, f"{word}: domain_words.txt names {term!r}, which is no term"
