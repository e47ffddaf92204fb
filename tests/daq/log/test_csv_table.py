"""CSV files as exporters write them: the same table from each, or an error that says what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from daq.config.import_description import (
    CsvLayout,
    CurrentColumns,
    ImportDescription,
    PositionColumns,
    PositionUnit,
    Side,
    TimeColumn,
    TimeUnit,
)
from daq.errors import TableUnfit
from daq.log.csv_table import read_csv
from daq.log.table import Stamps, Table

ROWS = ("0.125,1.50", "0.250,1.25", "0.375,1.00", "0.500,0.75")
VALUES = np.array([row.split(",") for row in ROWS], dtype=float)
GERMAN_ROWS = tuple(row.replace(",", ";").replace(".", ",") for row in ROWS)
"""The same with semicolons and decimal commas."""


def _read(
    tmp_path: Path,
    data: bytes,
    columns: tuple[str | int, ...],
    time: TimeUnit | None = None,
    **layout: Any,
) -> Table:
    path = tmp_path / "run.csv"
    path.write_bytes(data)
    wanted = ImportDescription(
        name="run",
        cell="cell.yaml",
        table=CsvLayout(**layout),
        position=PositionColumns(
            file="run.csv", columns=columns[:1], unit=PositionUnit.DEG, side=Side.JOINT
        ),
        current=CurrentColumns(file="run.csv", columns=columns[1:], unit="A"),
    )
    time_column = None
    if time is not None:
        time_column = TimeColumn(file="run.csv", column=1, unit=time)
    return read_csv(path, wanted, columns, time_column)


def _text(*rows: str, header: str = "Winkel [°],Strom [µA]") -> str:
    return "\n".join((header, *rows)) + "\n"


def _csv(*rows: str, header: str = "Winkel [°],Strom [µA]") -> bytes:
    return _text(*rows, header=header).encode()


@pytest.mark.parametrize(
    ("encoding", "bom", "remark"),
    [
        ("utf-8", b"", ""),
        ("utf-8-sig", b"", ""),
        ("cp1252", b"", "Windows-1252"),
        ("utf-16-le", b"\xff\xfe", "UTF-16"),
        ("utf-16-be", b"\xfe\xff", "UTF-16"),
    ],
)
def test_encodings(tmp_path: Path, encoding: str, bom: bytes, remark: str) -> None:
    data = bom + _text(*ROWS).encode(encoding)
    table = _read(tmp_path, data, ("Winkel [°]", "Strom [µA]"))
    assert np.array_equal(table.values, VALUES)
    if not remark:
        assert table.remarks == ()
        return
    (found,) = table.remarks
    assert found.startswith("run.csv: ")
    assert remark in found


def test_a_european_export_is_read(tmp_path: Path) -> None:
    """Semicolons, decimal commas, Windows-1252, CRLF and umlauts at once."""
    lines = ("Größe [°];Strom [µA]", *GERMAN_ROWS, "")
    data = "\r\n".join(lines).encode("cp1252")
    columns = ("Größe [°]", "Strom [µA]")
    table = _read(tmp_path, data, columns, delimiter=";", decimal=",")
    assert_array_equal(table.values, VALUES)
    assert table.remarks == ("run.csv: no UTF-8; read as Windows-1252",)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (_text(*ROWS, header="a,b").encode("utf-16-le"), "byte 1 is NUL"),
        (b"\xff\xfe" + _text(*ROWS).encode("utf-16-le")[:-1], "no UTF-16"),
        (b"a,b\n\x81\x8d,1\n", "byte 4 is no UTF-8"),
        ("\u03b1,b\n1,\0\n".encode(), "byte 7 is NUL"),
        ("\u03b1,b\n1,\0\n".encode("utf-8-sig"), "byte 10 is NUL"),
        (b"\xef\xbb\xbfa,b\n\xe9,1\n", "byte 7 is no UTF-8"),
        (b"\xff\xfe" + "a,b\n1,\0\n".encode("utf-16-le"), "byte 14 is NUL"),
        (b"\xfe\xff" + "\U0001f916,b\n1,\0\n".encode("utf-16-be"), "byte 16 is NUL"),
    ],
)
def test_what_is_no_text(tmp_path: Path, data: bytes, found: str) -> None:
    with pytest.raises(TableUnfit, match=found) as caught:
        _read(tmp_path, data, (1, 2))
    assert "save it as UTF-8" in caught.value.remedy


def test_a_decimal_comma_has_to_be_declared(tmp_path: Path) -> None:
    data = _csv(*GERMAN_ROWS, header="q;i")
    declared = _read(tmp_path, data, ("q", "i"), delimiter=";", decimal=",")
    assert_array_equal(declared.values, VALUES)
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column q") as caught:
        _read(tmp_path, data, ("q", "i"), delimiter=";")
    assert 'write `decimal: ","`' in caught.value.remedy


def test_a_point_under_a_decimal_comma_is_refused(tmp_path: Path) -> None:
    """Whole mA as 1.234 would be 1.234 A."""
    rows = []
    for k in range(20):
        angle = f"{0.5 * k}".replace(".", ",")
        current = f"1.{k:03d}"
        rows.append(f"{angle};{current}")
    data = _csv(*rows, header="q;i")
    message = r"run\.csv:2, column i: found '1\.000', with a point"
    with pytest.raises(TableUnfit, match=message) as caught:
        _read(tmp_path, data, ("q", "i"), delimiter=";", decimal=",")
    assert "without them" in caught.value.remedy
    # Another column may have points
    table = _read(tmp_path, data, ("q",), delimiter=";", decimal=",")
    assert len(table.values) == 20


@pytest.mark.parametrize("decimal", [".", ","])
def test_thousands_that_are_grouped_by_the_decimal_sign_are_refused(
    decimal: str, tmp_path: Path
) -> None:
    rows = []
    for value in range(-1500, 1500, 37):
        grouped = f"{value:,}".replace(",", decimal)
        rows.append(f"0{decimal}5;{grouped}")
    data = _csv(*rows, header="q;i")
    message = r"column i: found '-1[.,]500' and '-982': three digits after every"
    with pytest.raises(TableUnfit, match=message):
        _read(tmp_path, data, ("q", "i"), delimiter=";", decimal=decimal)


@given(st.lists(st.integers(-9999, 9999), min_size=2, max_size=50))
def test_decimals_of_one_width_are_no_groups(
    tmp_path_factory: pytest.TempPathFactory, values: list[int]
) -> None:
    rows = [f"0.5;{value / 1000:.3f}" for value in values]
    data = _csv(*rows, header="q;i")
    table = _read(tmp_path_factory.mktemp("csv"), data, ("i",), delimiter=";")
    assert_array_equal(table.values[:, 0], np.array(values) / 1000)


def test_a_comma_under_a_decimal_point_may_group_thousands(tmp_path: Path) -> None:
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column i") as caught:
        _read(tmp_path, _csv("0.5;1,234", header="q;i"), ("q", "i"), delimiter=";")
    assert "if commas group thousands" in caught.value.remedy


def test_a_file_without_a_header(tmp_path: Path) -> None:
    first, *others = ROWS
    data = _csv(*others, header=first)
    table = _read(tmp_path, data, (1, 2), header=False)
    assert_array_equal(table.values, VALUES)
    message = r"run\.csv:1: found a header of numbers, 0\.125, 1\.50"
    with pytest.raises(TableUnfit, match=message) as caught:
        _read(tmp_path, data, (1, 2))
    assert "write `header: false`" in caught.value.remedy


def test_a_header_that_is_not_declared(tmp_path: Path) -> None:
    with pytest.raises(TableUnfit, match=r"run\.csv:1, column 1") as caught:
        _read(tmp_path, _csv(*ROWS), (1, 2), header=False)
    assert "write `header: true`" in caught.value.remedy


def test_columns_may_be_called_by_numbers(tmp_path: Path) -> None:
    table = _read(tmp_path, _csv(*ROWS, header="0,1"), ("0", "1"))
    assert_array_equal(table.values, VALUES)


def _without_last_end(data: bytes) -> bytes:
    return data.removesuffix(b"\n")


@pytest.mark.parametrize("last", ["0.625,0.50", "0.625,0.5000"])
def test_a_last_line_without_its_end_is_taken_when_it_is_complete(
    tmp_path: Path, last: str
) -> None:
    data = _without_last_end(_csv(*ROWS, last))
    table = _read(tmp_path, data, (1, 2))
    assert table.values[-1].tolist() == [0.625, 0.5]
    assert "no end of line" in table.remarks[0]


@pytest.mark.parametrize("last", ["0.625,0.5", "0.625,", "0.625", "0.62", "0.625,-", "0.625,20.50"])
def test_a_last_line_that_may_lack_digits_is_refused(tmp_path: Path, last: str) -> None:
    data = _without_last_end(_csv(*ROWS, last))
    with pytest.raises(TableUnfit, match=r"run\.csv:6") as caught:
        _read(tmp_path, data, (1, 2))
    assert "the file ends early" in caught.value.remedy


def test_a_text_in_the_last_column_lacks_no_digits(tmp_path: Path) -> None:
    rows = [f"{row},ok" for row in ROWS]
    data = _without_last_end(_csv(*rows, header="q,i,state"))
    table = _read(tmp_path, data, ("q", "i"))
    assert_array_equal(table.values, VALUES)


def test_lines_may_end_with_a_delimiter(tmp_path: Path) -> None:
    rows = [f"{row}," for row in ROWS]
    table = _read(tmp_path, _csv(*rows, header="q,i,"), ("q", "i"))
    assert_array_equal(table.values, VALUES)


START_NS = 1_772_348_400_123_456_789  #: 2026-03-01T07:00:00.123456789Z
STEP_NS = 12_000_001


def _stamped(tmp_path: Path, unit: TimeUnit, texts: list[str]) -> Table:
    """Table of rows with these stamps."""
    rows = [f"{text},1,2" for text in texts]
    return _read(tmp_path, _csv(*rows, header="t,q,i"), ("q", "i"), unit)


def _stamps(tmp_path: Path, unit: TimeUnit, texts: list[str]) -> Stamps:
    stamps = _stamped(tmp_path, unit, texts).stamps
    assert stamps is not None
    return stamps


@pytest.mark.parametrize(
    "unit", [TimeUnit.SECOND, TimeUnit.MILLISECOND, TimeUnit.MICROSECOND, TimeUnit.NANOSECOND]
)
def test_stamps_since_1970_are_exact_in_every_unit(tmp_path: Path, unit: TimeUnit) -> None:
    decimals = 9 - unit.digits
    texts = []
    for index in range(4):
        text = str(START_NS + STEP_NS * index)
        if decimals:
            text = f"{text[:-decimals]}.{text[-decimals:]}"
        texts.append(text)
    stamps = _stamps(tmp_path, unit, texts)
    assert stamps.first_ns == START_NS
    expected = [STEP_NS * index * 1e-9 for index in range(4)]
    assert stamps.time_s.tolist() == expected


def test_dates_with_a_zone(tmp_path: Path) -> None:
    texts = [
        "2026-03-01T07:00:00.123456789Z",
        "2026-03-01T08:00:00.135+01:00",
        "2026-03-01 06:00:01-0100",
        "2026-03-01T07:00:01.5Z",
    ]
    stamps = _stamps(tmp_path, TimeUnit.ISO_8601, texts)
    assert stamps.first_ns == START_NS
    assert stamps.time_s == pytest.approx([0.0, 0.011543211, 0.876543211, 1.376543211], abs=1e-12)


@pytest.mark.parametrize(
    "text", ["2026-03-01T07:00:00.1", "2026-13-01T07:00:00Z", "7:00", "1772348400.1"]
)
def test_a_date_without_a_zone_is_refused(tmp_path: Path, text: str) -> None:
    texts = [text] * 3
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column 1") as caught:
        _stamped(tmp_path, TimeUnit.ISO_8601, texts)
    assert "add the zone" in caught.value.remedy


def test_stamps_since_some_start_are_those_of_the_file(tmp_path: Path) -> None:
    stamps = _stamps(tmp_path, TimeUnit.MILLISECOND, ["512300", "512310", "512322"])
    assert stamps.first_ns == 512_300_000_000
    assert stamps.time_s == pytest.approx([0.0, 0.010, 0.022], abs=1e-9)


@pytest.mark.parametrize("last", [TimeUnit.SECOND, TimeUnit.NANOSECOND])
def test_stamps_that_no_log_holds_are_refused(tmp_path: Path, last: TimeUnit) -> None:
    too_large = ["1", "1e308", "3"]
    with pytest.raises(TableUnfit, match=r"run\.csv:3, column 1"):
        _stamped(tmp_path, last, too_large)
    too_late = ["9999-01-01T00:00:00Z"] * 2
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column 1"):
        _stamped(tmp_path, TimeUnit.ISO_8601, too_late)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
def test_a_delimiter_in_quotes_belongs_to_its_field(tmp_path: Path, delimiter: str) -> None:
    header = delimiter.join((f'"state{delimiter}mode"', '"q 1"', "i"))
    quoted = f'"run auto{delimiter}mode"'
    rows = [delimiter.join((quoted, *row.split(","))) for row in ROWS]
    data = _csv(*rows, header=header)
    by_name = _read(tmp_path, data, ("q 1", "i"), delimiter=delimiter)
    assert_array_equal(by_name.values, VALUES)
    by_number = _read(tmp_path, data, (2, 3), delimiter=delimiter)
    assert_array_equal(by_number.values, VALUES)


@pytest.mark.parametrize("row", ['"run,0.25,1.25', '"0.25"0,1.25'])
def test_a_quote_that_is_not_closed_is_refused(tmp_path: Path, row: str) -> None:
    data = _csv(ROWS[0], row, ROWS[2], header="q,i")
    with pytest.raises(TableUnfit, match=r"run\.csv:3") as caught:
        _read(tmp_path, data, ("q", "i"))
    assert "quote" in caught.value.found


def test_an_empty_line_is_no_sample_of_a_single_column(tmp_path: Path) -> None:
    with pytest.raises(TableUnfit, match=r"run\.csv:3"):
        _read(tmp_path, b"q\n1.5\n\n2.5\n3.5\n", ("q",))


def test_a_column_by_name_and_by_number_is_one(tmp_path: Path) -> None:
    with pytest.raises(TableUnfit, match="a second time"):
        _read(tmp_path, _csv(*ROWS, header="q,i"), ("q", 1))


@pytest.mark.parametrize(
    ("texts", "first_ns", "time_s"),
    [
        (["08:59:00.000", "08:59:00.010", "08:59:00.02"], 32_340_000_000_000, [0.0, 0.01, 0.02]),
        (["8:59:59,99", "9:00:00,00", "9:00:00,01"], 32_399_990_000_000, [0.0, 0.01, 0.02]),
        (
            ["2026-03-01 23:59:59.5", "2026-03-02 00:00:00.0", "2026-03-02T00:00:00.5"],
            86_399_500_000_000,
            [0, 0.5, 1],
        ),
    ],
)
def test_times_of_day_are_stamps_since_midnight(
    tmp_path: Path, texts: list[str], first_ns: int, time_s: list[float]
) -> None:
    """A decimal comma in them needs another delimiter."""
    rows = [f"{text};1;2" for text in texts]
    data = _csv(*rows, header="t;q;i")
    table = _read(tmp_path, data, ("q", "i"), TimeUnit.CLOCK, delimiter=";")
    assert table.stamps is not None
    assert table.stamps.first_ns == first_ns
    assert table.stamps.time_s == pytest.approx(time_s, abs=1e-12)
    assert table.remarks == ()


def test_times_of_day_go_on_over_midnight(tmp_path: Path) -> None:
    texts = ["23:59:59.98", "23:59:59.99", "00:00:00.00", "00:00:00.01"]
    table = _stamped(tmp_path, TimeUnit.CLOCK, texts)
    assert table.stamps is not None
    assert table.stamps.time_s == pytest.approx([0.0, 0.01, 0.02, 0.03], abs=1e-9)
    assert "times of day that pass midnight" in table.remarks[0]


def test_dates_that_go_back_a_day_do_not_pass_midnight(tmp_path: Path) -> None:
    texts = [
        "2026-03-02 23:59:59.98",
        "2026-03-02 23:59:59.99",
        "2026-03-02 00:00:00.00",
        "2026-03-02 00:00:00.01",
    ]
    table = _stamped(tmp_path, TimeUnit.CLOCK, texts)
    assert table.stamps is not None
    steps_s = np.diff(table.stamps.time_s)
    assert steps_s.min() < -86_000.0
    assert table.remarks == ()


@pytest.mark.parametrize(
    "text", ["8:59 AM", "24:00:00", "08:59", "2026-02-30 08:00:00", "08:60:00", "5.0"]
)
def test_what_is_no_time_of_day_is_refused(tmp_path: Path, text: str) -> None:
    texts = [text] * 3
    message = r"run\.csv:2, column 1: .*expected a time of day of 24 hours"
    with pytest.raises(TableUnfit, match=message):
        _stamped(tmp_path, TimeUnit.CLOCK, texts)


@pytest.mark.parametrize(
    "text", ["08:59:00.000", "2026-03-01 08:59:00.000", "2026-03-01T08:59:00.000Z"]
)
def test_a_time_of_day_where_a_number_is_expected_names_the_unit(tmp_path: Path, text: str) -> None:
    texts = [text] * 3
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column t.*`unit: clock`.*`unit: iso8601`"):
        _stamped(tmp_path, TimeUnit.SECOND, texts)


@pytest.mark.parametrize(
    "text",
    [
        "08:59:00:000",
        "08:59:00.000 AM",
        "8:59 AM",
        "08:59",
        "01.03.2026 08:59:00",
        "03/01/2026 08:59:00.000",
    ],
)
def test_a_time_in_another_spelling_is_no_line_to_be_left_out(tmp_path: Path, text: str) -> None:
    texts = [text] * 3
    with pytest.raises(TableUnfit, match=r"export it as 08:00:00\.004.*`unit: clock`") as caught:
        _stamped(tmp_path, TimeUnit.SECOND, texts)
    assert "from_row" not in caught.value.remedy


@pytest.mark.parametrize(
    ("unit", "digits", "step"),
    [(TimeUnit.MILLISECOND, 0, 4), (TimeUnit.SECOND, 3, 4), (TimeUnit.MICROSECOND, 0, 4000)],
)
def test_a_number_since_midnight_goes_on_over_midnight(
    tmp_path: Path, unit: TimeUnit, digits: int, step: int
) -> None:
    """A time of day of a PLC (IEC 61131-3): so many ms since midnight."""
    scale = 10**digits
    day = round(86_400 * scale / unit.seconds)
    counts = (day - 3 * step + step * np.arange(8)) % day
    assert min(np.diff(counts)) < 0
    texts = [f"{count / scale:.{digits}f}" for count in counts]
    table = _stamped(tmp_path, unit, texts)
    assert table.stamps is not None
    expected = step / scale * unit.seconds * np.arange(8.0)
    assert table.stamps.time_s == pytest.approx(expected, abs=1e-9)
    assert "times of day that pass midnight" in table.remarks[0]


@pytest.mark.parametrize(
    ("unit", "bits", "step"),
    [
        (TimeUnit.MICROSECOND, 32, 10_000),
        (TimeUnit.MILLISECOND, 32, 4),
        (TimeUnit.MILLISECOND, 16, 4),
        (TimeUnit.NANOSECOND, 32, 1_000_000),
    ],
)
@pytest.mark.parametrize("signed", [False, True])
def test_a_counter_of_time_that_wraps_goes_on(
    tmp_path: Path, unit: TimeUnit, bits: int, step: int, signed: bool
) -> None:
    """The case of a microsecond counter of 32 bits that is written in seconds is the first one,
    in another unit.
    """
    values = 2**bits
    least = -values // 2 if signed else 0
    counts = (values - 3 * step - 1 + step * np.arange(8)) % values + least
    assert min(np.diff(counts)) < 0
    texts = [str(count) for count in counts]
    table = _stamped(tmp_path, unit, texts)
    assert table.stamps is not None
    expected = step * unit.seconds * np.arange(8.0)
    assert table.stamps.time_s == pytest.approx(expected, abs=1e-9)
    assert f"a counter of {bits} bits in {unit.value} that wraps" in table.remarks[0]


def test_two_recordings_are_no_counter_that_wraps(tmp_path: Path) -> None:
    stamps = _stamps(tmp_path, TimeUnit.MICROSECOND, ["10", "20", "30", "0", "10"])
    assert stamps.time_s[3] < 0.0
