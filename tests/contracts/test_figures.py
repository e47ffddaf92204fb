"""Figures in the text of evidence pages are those of the data beside them.

A study writes its tables; the sentences about them are written by hand. After a table is replaced,
these tests name the sentence to correct.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

EVIDENCE = Path(__file__).parents[2] / "docs/evidence"

Row = dict[str, str]


def _rows(name: str) -> list[Row]:
    with (EVIDENCE / "data" / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _total(rows: Iterable[Row], column: str) -> int:
    return sum(int(row[column]) for row in rows)


def _grouped(number: int) -> str:
    """Write a number in groups of three digits, as the pages do."""
    return f"{number:,}".replace(",", " ")


def real_robots() -> list[str]:
    """How many effects raise an axis where the arm was not, and the errors of `today`."""
    rows = _rows("real-summary.csv")
    regions = [row for row in rows if row["split"] == "region" and row["recording"] != "all"]
    ur10 = [row for row in regions if row["recording"] == "ur10"]
    others = [row for row in regions if row["recording"] != "ur10"]
    counts: list[str] = []
    for group in (others, ur10):
        raised = _total(group, "raise an axis beyond noise")
        written = _total(group, "effects written")
        counts.append(f"{raised} of {written}")
    after: dict[str, str] = {}
    for row in rows:
        if row["split"] == "today":
            _, after[row["recording"]] = row["total error %"].split(" → ")
    by_axis_after = ""
    for row in rows:
        if row["recording"] == "tx40" and row["split"] == "today":
            _, by_axis_after = row["mean error %"].split(" → ")
    (ur10_regions,) = ur10
    return [
        f"On the TX-40 and the KR300 it is {counts[0]}, on the UR10 {counts[1]}.",
        f"| TX-40, mean of the axes and all of them | 7.08, 4.55 | {by_axis_after}, "
        f"{after['tx40']} |",
        f"| KR300, A to C | 4.30, 3.32, 2.95 | {after['kr300-A']}, {after['kr300-B']}, "
        f"{after['kr300-C']} |",
        f"| UR10 | 3.2 | {after['ur10']} |",
        f"the twelve together | {ur10_regions['total error %'].replace(' → ', ' | ')} |",
    ]


def _series(row: Row) -> tuple[str, str, str]:
    """The rows that differ in size and seed: zeros of each axis have sizes in degrees or mm."""
    axis = row["axis"] if row["mistake"] == "zero-offset" else ""
    return row["robot"], row["mistake"], axis


def geometry() -> list[str]:
    """How many wrong zeros, leaning bases and late signals are named."""
    rows = _rows("geometry.csv")
    simulated = [row for row in rows if row["mistake"] not in ("clean", "turned gravity")]
    sizes: dict[tuple[str, str, str], list[float]] = {}
    for row in simulated:
        sizes.setdefault(_series(row), []).append(float(row["size"]))
    planted = [row for row in simulated if row["planted"] == "yes"]
    larger: list[Row] = []
    for row in planted:
        if float(row["size"]) > min(sizes[_series(row)]):
            larger.append(row)
    named = [row for row in planted if row["named"] == "yes"]
    larger_named = [row for row in larger if row["named"] == "yes"]
    clean = [row for row in rows if row["mistake"] == "clean"]
    bent = [row for row in clean if row["named"] == "yes" or row["others"]]
    assert len(clean) == 16
    assert not bent
    return [
        f"of the two larger sizes {len(larger_named)} of {len(larger)} are named, of all "
        f"{len(named)} of {len(planted)}; of sixteen clean cells none has an effect."
    ]


def _named_of(rows: Iterable[Row]) -> tuple[int, int]:
    """How many of the rows name all their effects, and how many rows there are."""
    named = 0
    count = 0
    for row in rows:
        count += 1
        planted = set(row["effects"].split(", "))
        if planted <= set(row["named"].split(", ")):
            named += 1
    return named, count


def effects() -> list[str]:
    """How many effects are named in the world of the measurement and in the disturbed one."""
    sentences: list[str] = []
    for table, asked in (("effects-study.csv", 28), ("effects-loop3.csv", 26)):
        rows = _rows(table)
        named, count = _named_of(row for row in rows if row["part"] == "single")
        clean = [row for row in rows if row["part"] == "clean"]
        false = sum(row["named"] != "–" for row in clean)
        sentences.append(f"**{named} of {count}** ({asked} asked) | {false} of {len(clean)} |")
    together = [row for row in _rows("effects-study.csv") if row["part"] == "together"]
    named, count = _named_of(together)
    sentences.append(f"both named in {named} of {count}")
    return sentences


def soak() -> list[str]:
    """Values that were lost by drivegain and by the host, over all recordings and by rate."""
    rows = _rows("soak.csv")
    minutes = round(sum(float(row["seconds"]) for row in rows) / 60.0)
    of_rate: dict[int, list[Row]] = {}
    for row in rows:
        of_rate.setdefault(int(row["rate_hz"]), []).append(row)
    without_loss = [rate for rate, found in of_rate.items() if not _total(found, "lost_by_us")]
    highest_hz = max(without_loss)
    at_highest = of_rate[highest_hz]
    highest_minutes = round(sum(float(row["seconds"]) for row in at_highest) / 60.0)
    return [
        f"The highest rate at which nothing was lost by us is {highest_hz} Hz: {highest_minutes} "
        f"minutes, {_grouped(_total(at_highest, 'values'))} values, "
        f"{_total(at_highest, 'lost_by_host')} lost by the host.",
        f"Of all {_grouped(_total(rows, 'values'))} values of {minutes} minutes, we lost "
        f"{_total(rows, 'lost_by_us')} and the host {_grouped(_total(rows, 'lost_by_host'))}",
    ]


def write_faults() -> list[str]:
    """Faults at the calls of a write, and what they left."""
    rows = _rows("write-faults.csv")
    columns = ("cases", "old_file", "new_file", "both", "false_sentences", "bad_states")
    totals = " | ".join(f"**{_total(rows, column)}**" for column in columns)
    return [f"| **all** | | {totals} |"]


def _page(name: str) -> str:
    text = (EVIDENCE / name).read_text(encoding="utf-8")
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize(
    ("page", "sentences"),
    [
        ("real.md", real_robots),
        ("geometry.md", geometry),
        ("effects-study.md", effects),
        ("stream.md", soak),
        ("write-path.md", write_faults),
    ],
)
def test_the_figures_of_a_page_are_those_of_its_data(
    page: str, sentences: Callable[[], list[str]]
) -> None:
    text = _page(page)
    missing = [sentence for sentence in sentences() if sentence not in text]
    assert missing == []
