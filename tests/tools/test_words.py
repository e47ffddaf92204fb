"""`make words` on a small corpus: what is a word, what is counted, and what is over-used."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.tools.words import (
    ANCHORS,
    LEAST_COUNT,
    SMOOTHING,
    Corpus,
    count_words,
    lines_of,
    load_corpus,
    load_domain_words,
    measure_corpus,
    overused,
    report,
    save_corpus,
    words_of_identifier,
    words_of_prose,
)

MODULE = '''"""Keep the torque beside the motor."""

# noqa: E501
# The torque is held.
import numpy as np


def held_torque(motorGain):
    """Return torques.

    >>> held_torque(of_an_example)
    """
    if motorGain == "short":
        raise ValueError(f"found {2}, expected a torque of the motor")
    return np.zeros(3)
'''


def test_identifiers_are_split_at_underscores_and_capitals() -> None:
    assert words_of_identifier("_held_torque2_nm") == ["held", "torque", "nm"]
    assert words_of_identifier("HTTPServerError") == ["http", "server", "error"]
    assert words_of_identifier("DIGITS_OF_x") == ["digits", "of"]


def test_prose_has_no_literals_links_and_names() -> None:
    text = "The `torque` of ``a b`` [is here](page.md), daq.fit in_code --yes {value} drive-gain."
    assert words_of_prose(text) == ["the", "of", "is", "here", "drive", "gain"]


def test_code_and_prose_of_a_module_are_counted_apart(tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    file.write_text(MODULE, encoding="utf-8")
    code, prose = count_words(lines_of([file]))
    assert code == Counter(
        {
            "held": 1,
            "torque": 1,
            "motor": 2,
            "gain": 2,
            "np": 2,
            "numpy": 1,
            "zeros": 1,
            "value": 1,
            "error": 1,
        }
    )
    assert prose["torque"] == 3  # docstring, comment, message
    assert prose["beside"] == 1
    assert prose["expected"] == 1
    assert not {"noqa", "example", "short"} & set(prose)


def test_code_blocks_of_a_page_are_not_counted(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("The gain\n\n```console\n$ drivegain fit\n```\n\nis held.\n", encoding="utf-8")
    lines = list(lines_of([page]))
    code, prose = count_words(lines)
    assert not code
    assert prose == Counter(["the", "gain", "is", "held"])
    assert [line.number for line in lines if "held" in line.words()] == [7]


def test_every_anchor_counts_the_same_whatever_its_size(tmp_path: Path) -> None:
    small = tmp_path / "small.py"
    small.write_text("held = held\n", encoding="utf-8")
    large = tmp_path / "large.py"
    large.write_text("kept = 1\n" * 1000, encoding="utf-8")
    corpus = measure_corpus({"small": ("1.0", [small]), "large": ("2.1", [large])})
    assert corpus.code == {"held": 500.0, "kept": 500.0}
    assert corpus.words == {"code": 1002, "prose": 0}
    assert corpus.versions == {"small": "1.0", "large": "2.1"}


def test_a_corpus_is_stored_as_numbers_and_loaded_again(tmp_path: Path) -> None:
    corpus = Corpus({"small": "1.0"}, {"code": 10, "prose": 5}, {"held": 0.125}, {"the": 60.0})
    save_corpus(corpus, tmp_path / "anchors.json")
    assert load_corpus(tmp_path / "anchors.json") == corpus


def test_the_ratio_is_smoothed_and_rare_words_are_left_out() -> None:
    counts = Counter({"common": 900, "private": 80, "rare": LEAST_COUNT - 1, "last": 1})
    uses = overused(counts, {"common": 900.0, "rare": 0.0})
    assert [use.word for use in uses] == ["private", "common"]
    private, common = uses
    assert private.frequency == pytest.approx(80.0)
    assert private.ratio == pytest.approx((80.0 + SMOOTHING) / SMOOTHING)
    assert common.ratio == pytest.approx(1.0)


def test_words_of_the_field_are_printed_apart(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("torque beside torque\n" * 30, encoding="utf-8")
    corpus = Corpus({"small": "1.0"}, {"code": 10, "prose": 10}, {}, {"the": 60.0})
    text = report(lines_of([page]), corpus, {"torque": "torque"})
    habits, _, of_field = text.partition("prose, 90 words")[2].partition("words of the field")
    assert "beside" in habits
    assert "torque" not in habits
    assert "torque" in of_field
    assert "beside" not in of_field


def test_the_stored_corpus_names_its_anchors_and_is_large() -> None:
    corpus = load_corpus()
    assert set(corpus.versions) == set(ANCHORS)
    assert min(corpus.words.values()) > 1_000_000
    assert corpus.prose["the"] > 20.0
    assert corpus.code["self"] > 5.0
    assert not set(load_domain_words()) & {"the", "of", "self", "value", "name"}
