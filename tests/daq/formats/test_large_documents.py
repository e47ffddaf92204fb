"""Controller files of any size: read within seconds of processor time, or refused at once."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from daq.config.yaml_file import MAX_BYTES as MAX_CELL_BYTES
from daq.config.yaml_file import parse_yaml
from daq.errors import ControllerUnfit, YamlInvalid
from daq.formats import yaml_document as limits
from daq.formats.document import decode_document

GAIN = "drives: {J1: {gain: 32.96}}\n"


def test_the_page_states_the_limits_of_yaml(checkout: Path) -> None:
    page = (checkout / "docs/how-to/write-gains.md").read_text(encoding="utf-8")
    values = f"{limits.MAX_VALUES:,}".replace(",", " ")
    expected = f"YAML of up to {limits.MAX_BYTES // 1024} KiB and {values} values"
    assert expected in page


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(GAIN + "more:\n" + "- 1.5\n" * (limits.MAX_VALUES + 1), id="values"),
        pytest.param(GAIN + "# a comment\n" * (limits.MAX_BYTES // 10), id="bytes"),
        pytest.param(GAIN + "more: " + "[" * 2000 + "]" * 2000, id="nested"),
        pytest.param(GAIN + "more: " + "[" * 200_000, id="unclosed"),
    ],
)
def test_yaml_that_would_take_minutes_is_refused_at_once(text: str) -> None:
    began = time.process_time()
    with pytest.raises(ControllerUnfit, match="nothing was written"):
        decode_document(text.encode(), "controller.yaml").locate(("drives.J1.gain",))
    assert time.process_time() - began < 2.0


@pytest.mark.slow
def test_yaml_within_the_bounds_is_read_and_rewritten() -> None:
    text = GAIN + "more:\n" + "- 1.5\n" * 5000 + "# a comment\n" * 10_000
    document = decode_document(text.encode(), "controller.yaml")
    assert document.with_values({"drives.J1.gain": "33.1"}).text == text.replace("32.96", "33.1")


@pytest.mark.parametrize(
    "content",
    [
        b"\n" * (MAX_CELL_BYTES - 100) + b"a: [1\n",
        b"[" * MAX_CELL_BYTES,
        b"- 1\n" * 200_000,
        b"a: 1\n" * 2_500_000,
    ],
    ids=["blank", "brackets", "values", "10 MB"],
)
def test_a_large_cell_file_is_refused_at_once(content: bytes) -> None:
    began = time.process_time()
    with pytest.raises(YamlInvalid, match="right file"):
        parse_yaml(content, "cell.yaml")
    assert time.process_time() - began < 2.0
