"""Lines of a CSV file that are no rows: units, comments, empty lines, a delimiter's name;
and rows that are cut off.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from daq.config.import_description import (
    CsvLayout,
    CurrentColumns,
    ImportDescription,
    KeptPart,
    PositionColumns,
    PositionUnit,
    Side,
    TimeColumn,
    TimeUnit,
    VelocityColumns,
    VelocityUnit,
)
from daq.config.yaml_file import parse_yaml
from daq.errors import TableUnfit
from daq.log.csv_table import read_csv
from daq.log.table import Table

COUNT = 12
NUMBER = np.arange(COUNT)
VALUES = np.column_stack((0.01 * NUMBER, np.sin(NUMBER), np.cos(NUMBER)))
ROWS = ["{:.6f},{:.6f},{:.6f}".format(*row) for row in VALUES.tolist()]
READ = np.round(VALUES, 6)[:, 1:]


def _read(
    folder: Path,
    lines: list[str],
    *,
    time: TimeUnit | None = TimeUnit.SECOND,
    unit: PositionUnit = PositionUnit.RAD,
    columns: tuple[str | int, str | int] = ("q", "i"),
    factor: float = 1.0,
    velocity: VelocityUnit | None = None,
    keep: KeptPart | None = None,
    end: str = "\n",
    stamps: str = "t",
    **layout: Any,
) -> Table:
    """Read position and current, and the stamps of column `t`."""
    path = folder / "run.csv"
    text = "\n".join(lines) + end
    path.write_text(text, encoding="utf-8")
    if time is None:
        timed = None
    else:
        timed = TimeColumn(file="run.csv", column=stamps, unit=time)
    moved = None
    side = Side.JOINT
    if velocity is not None:
        moved = VelocityColumns(file="run.csv", columns=("v",), unit=velocity, side=side)
    of_position = columns[:1]
    of_current = columns[1:]
    position = PositionColumns(file="run.csv", columns=of_position, unit=unit, side=side)
    current = CurrentColumns(file="run.csv", columns=of_current, unit="A", factor=factor)
    table = CsvLayout(**layout)
    rate_hz = None if time is not None else 100.0
    wanted = ImportDescription(
        name="run",
        cell="cell.yaml",
        table=table,
        position=position,
        current=current,
        velocity=moved,
        time=timed,
        rate_hz=rate_hz,
        keep=keep,
    )
    return read_csv(path, wanted, columns, timed)


def _with_line(line: str, place: int) -> list[str]:
    """The rows with another line among them."""
    lines = list(ROWS)
    lines.insert(place, line)
    return lines


@pytest.mark.parametrize(
    "units", ["s,rad,A", "[s],[rad],[A]", "(s), (rad), (A)", "sec,rad,", "s,m,A"]
)
def test_a_line_of_units_below_the_header_is_no_row(tmp_path: Path, units: str) -> None:
    if units.endswith(","):
        units += "Arms"
    lines = ["t,q,i", units, *ROWS]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)
    place = table.place(0, "q")
    assert place == f"{tmp_path}/run.csv:3, column q"
    expected = (f"run.csv: line 2 was taken for the units of the columns: {units!r}",)
    assert table.remarks == expected


@pytest.mark.parametrize(
    ("units", "changes", "found", "expected"),
    [
        ("s,deg,A", {}, "unit 'deg' in the line", "'rad', the unit of `position`"),
        ("s,mm,A", {}, "unit 'mm' in the line", "'rad'"),
        ("s,°,A", {}, "unit '°' in the line", "'rad'"),
        ("s,rad,A", {"unit": PositionUnit.DEG}, "unit 'rad' in the line", "'deg'"),
        ("ms,rad,A", {}, "unit 'ms' in the line", "'s', the unit of `time`"),
        ("s,rad,mA", {}, "unit 'mA' in the line", "'A', the unit of `current`"),
        ("s,rad,Nm", {}, "unit 'Nm' in the line", "'A', the unit of `current`"),
        ("s,rad,%", {}, "unit '%' in the line", "'A'"),
        ("s,rad,[V]", {}, "unit 'V' in the line", "'A'"),
        ("s,rad,A", {"factor": 0.001}, "unit 'A' in the line", "with the factor 0.001"),
        ("s,rad,mA", {"factor": 1000.0}, "unit 'mA' in the line", "with the factor 1000"),
        ("s,counts,A", {}, "unit 'counts' in the line", "'rad'"),
        ("s,RAD,A", {"unit": PositionUnit.COUNTS}, "unit 'RAD' in the line", "'counts'"),
        ("s,rad/s,A", {}, "unit 'rad/s' in the line", "'rad'"),
    ],
)
def test_units_that_contradict_the_description_are_refused(
    tmp_path: Path, units: str, changes: dict[str, Any], found: str, expected: str
) -> None:
    lines = ["t,q,i", units, *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column ") as caught:
        _read(tmp_path, lines, **changes)
    assert found in caught.value.found
    assert expected in caught.value.expected


@pytest.mark.parametrize(
    ("names", "column"),
    [("t,q [deg],i", "q [deg]"), ("t [ms],q,i [A]", "t [ms]"), ("t,q,i [mA]", "i [mA]")],
)
def test_a_unit_in_the_name_of_a_column_is_compared_too(
    tmp_path: Path, names: str, column: str
) -> None:
    stamps, position, current = names.split(",")
    lines = [names, *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:1") as caught:
        _read(tmp_path, lines, columns=(position, current), stamps=stamps)
    assert column in caught.value.subject
    assert "in the name of the column" in caught.value.found


def test_a_line_of_units_is_known_by_that_of_the_time_alone(tmp_path: Path) -> None:
    lines = ["t,q,i", "s,rounds,bits", *ROWS]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)
    assert table.remarks == (
        "run.csv: line 2 was taken for the units of the columns: 's,rounds,bits'",
    )
    with pytest.raises(
        TableUnfit,
        match=r"run\.csv:2, column t: found unit 'ms' in the "
        r"line of units",
    ):
        _read(tmp_path, ["t,q,i", "ms,rounds,bits", *ROWS])


def test_a_unit_in_a_name_must_be_that_of_the_line_of_units(tmp_path: Path) -> None:
    columns = ("q [deg]", "i [A]")
    lines = ["t,q [deg],i [A]", "s,rad,A", *ROWS]
    with pytest.raises(
        TableUnfit,
        match=r"run\.csv:2, column q \[deg\]: .* 'rad' .* and 'deg' in the name "
        r".* one unit",
    ):
        _read(tmp_path, lines, columns=columns)
    # Letters that may be no unit, and units that say the same.
    columns = ("q [A]", "i [Arms]")
    lines = ["t,q [A],i [Arms]", "s,rad,A", *ROWS]
    table = _read(tmp_path, lines, columns=columns)
    assert len(table.values) == COUNT


def test_lines_count_as_an_editor_counts_them(tmp_path: Path) -> None:
    """A form feed and a line separator of Unicode end no line."""
    note = "exported\x0cby\u2028hand"
    lines = [note, "t,q,i", "s,rad,A", *ROWS, "0.2,word,1.0", ROWS[0]]
    line = 4 + COUNT
    pattern = rf"run\.csv:{line}, column q: found 'word'"
    with pytest.raises(TableUnfit, match=pattern):
        _read(tmp_path, lines, skip_rows=1)

    lines = [note, "t,q,i", "s,deg,A", *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:3, column q: found unit 'deg'"):
        _read(tmp_path, lines, skip_rows=1)


def test_a_header_of_numbers_is_named_by_its_line_where_units_follow(tmp_path: Path) -> None:
    lines = ["exported by X", "3,7,4", "s,rad,A", *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:2: found a header of numbers, 3, 7, 4"):
        _read(
            tmp_path,
            lines,
            stamps="3",
            columns=("7", "4"),
            skip_rows=1,
        )


@pytest.mark.parametrize("unit", ["deg/s", "rpm", "mm/s"])
def test_velocities_in_another_unit_are_refused(tmp_path: Path, unit: str) -> None:
    rows = [f"{row},0.5" for row in ROWS]
    lines = ["t,q,i,v", f"s,rad,A,{unit}", *rows]
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column v") as caught:
        _read(tmp_path, lines, velocity=VelocityUnit.RAD)
    assert "'rad/s', the unit of `velocity`" in caught.value.expected


def test_letters_in_a_name_that_may_be_no_unit_say_nothing(tmp_path: Path) -> None:
    names = ("q [A]", "i [N]")
    lines = ["t,q [A],i [N]", *ROWS]
    table = _read(tmp_path, lines, columns=names)
    assert len(table.values) == COUNT


@pytest.mark.parametrize(
    ("units", "factor"), [("s,rad,Nm", 0.5), ("s,rad,%", 0.12), ("s,rad,A", 1.414)]
)
def test_a_factor_may_convert_another_quantity(tmp_path: Path, units: str, factor: float) -> None:
    lines = ["t,q,i", units, *ROWS]
    table = _read(tmp_path, lines, factor=factor)
    assert len(table.values) == COUNT


def test_a_unit_that_is_not_known_says_nothing(tmp_path: Path) -> None:
    lines = ["t,q,i", "s,turns,A", *ROWS]
    table = _read(tmp_path, lines)
    assert len(table.values) == COUNT


def test_a_row_that_is_commented_out_is_missing_at_a_rate(tmp_path: Path) -> None:
    lines = ["t,q,i", *ROWS]
    lines[5] = f"# {lines[5]}"
    with pytest.raises(TableUnfit, match=r"run\.csv:6") as caught:
        _read(tmp_path, lines, time=None, comment="#")
    assert "commented out" in caught.value.found

    table = _read(tmp_path, lines, comment="#")
    assert len(table.values) == COUNT - 1

    lines[5] = "# 12 rows"
    table = _read(tmp_path, lines, time=None, comment="#")
    assert len(table.values) == COUNT - 1


def test_a_column_that_is_no_time_names_those_that_grow(tmp_path: Path) -> None:
    lines = ["clock,t,i", *ROWS]
    with pytest.raises(TableUnfit, match="column t") as caught:
        _read(tmp_path, lines, columns=("clock", "i"))
    assert "go back" in caught.value.found
    assert "here: clock" in caught.value.expected
    assert "`time`: {column: clock}" in caught.value.remedy


def test_a_factor_explains_another_unit_of_the_current(tmp_path: Path) -> None:
    lines = ["t,q,i", "s,rad,mA", *ROWS]
    table = _read(tmp_path, lines, factor=0.001)
    assert len(table.values) == COUNT

    lines = ["t,q,i", "s,mm,A", *ROWS]
    table = _read(tmp_path, lines, unit=PositionUnit.DEG)
    assert len(table.values) == COUNT


@pytest.mark.parametrize("line", ["Time,Position,Current", "nan,nan,nan", "s,n/a,A", "-,-,-"])
def test_a_line_of_other_words_is_refused_with_the_setting(tmp_path: Path, line: str) -> None:
    lines = ["t,q,i", line, *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:2"):
        _read(tmp_path, lines)
    keep = KeptPart(from_row=2)
    table = _read(tmp_path, lines, keep=keep)
    np.testing.assert_array_equal(table.values, READ)


def test_the_advice_for_a_second_header_is_the_setting_that_reads_it(tmp_path: Path) -> None:
    lines = ["t,q,i", "Time,Position,Current", *ROWS]
    with pytest.raises(TableUnfit, match=r"`keep: \{from_row: 2\}`"):
        _read(tmp_path, lines)

    again = ["t,q,i", *_with_line("Time,Position,Current", 5)]
    keep = KeptPart(from_row=6)
    with pytest.raises(TableUnfit, match=r"`keep: \{from_row: 7\}`"):
        _read(tmp_path, again, keep=keep)
    kept_part = KeptPart(from_row=7)
    rest = _read(tmp_path, again, keep=kept_part)
    np.testing.assert_array_equal(rest.values, READ[5:])


@pytest.mark.parametrize("sign", ["#", "%", "//"])
def test_comments_before_and_after_the_rows_are_left_out(tmp_path: Path, sign: str) -> None:
    title = f"{sign} trace of a drive"
    rate = f"{sign} 100 Hz"
    count = f"{sign} {COUNT} samples"
    lines = [title, "", "t,q,i", rate, *ROWS, "", count, ""]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)
    (remark,) = table.remarks
    assert remark == f"run.csv: left out after the rows: 1 line, '{count}'"


@pytest.mark.parametrize("header", ["# t,q,i", "% t,q,i", "#t,q,i"])
@pytest.mark.parametrize("comments", [[], ["# a note, about i"]])
def test_a_header_may_begin_as_a_comment(tmp_path: Path, header: str, comments: list[str]) -> None:
    lines = [*comments, header, *ROWS]
    by_name = _read(tmp_path, lines)
    np.testing.assert_array_equal(by_name.values, READ)
    by_number = _read(tmp_path, lines, time=None, columns=(2, 3))
    np.testing.assert_array_equal(by_number.values, READ)


def test_a_name_with_the_sign_of_a_comment_is_still_a_name(tmp_path: Path) -> None:
    lines = ["t,#q,i", *ROWS]
    columns = ("#q", "i")
    table = _read(tmp_path, lines, columns=columns)
    np.testing.assert_array_equal(table.values, READ)

    lines = ["#q,t,i", *ROWS]
    table = _read(tmp_path, lines, columns=columns, time=None)
    first = np.round(VALUES[:, 0], 6)
    np.testing.assert_array_equal(table.values[:, 0], first)


@pytest.mark.parametrize(
    ("line", "place"),
    [
        ("# marker: payload on", 5),
        ("MARK begin", 5),
        ("// pause", 5),
        ("MARK end", COUNT),
        ("end of trace", COUNT),
        ("MARK,3", 5),
        ("MARK,3,", 5),
        ("MARK,3,1", 5),
        ("Samples,12", COUNT),
        ("Samples,12,", COUNT),
        ("Samples,12,4", COUNT),
        ("Samples: 12,4", COUNT),
    ],
)
def test_a_line_among_the_rows_that_is_none_is_named(tmp_path: Path, line: str, place: int) -> None:
    lines = ["t,q,i", *_with_line(line, place)]
    pattern = (
        rf"run\.csv:{place + 2}: found .*a line that is no row "
        r"of numbers"
    )
    with pytest.raises(
        TableUnfit,
        match=pattern,
    ) as caught:
        _read(tmp_path, lines)
    assert "delimiter" not in caught.value.remedy
    assert "ends early" not in caught.value.remedy
    assert f"`keep: {{to_row: {place}}}`" in caught.value.remedy
    keep = KeptPart(to_row=place)
    before = _read(tmp_path, lines, keep=keep)
    np.testing.assert_array_equal(before.values, READ[:place])

    word, _, _ = line.partition(" ")
    begins_with_letter = word[:1].isalpha()
    sign = word[:4] if begins_with_letter else word
    assert f"`comment: {sign!r}`" in caught.value.remedy
    table = _read(tmp_path, lines, comment=sign)
    np.testing.assert_array_equal(table.values, READ)
    if place < COUNT:
        assert table.remarks == ("run.csv: left out, as `comment` says: 1 line among the rows",)


@pytest.mark.parametrize("sign", ["1", "-", ".", " ", "+1", "\t#"])
def test_a_comment_that_may_be_a_number_is_refused(sign: str) -> None:
    """It would leave out rows."""
    with pytest.raises(ValidationError, match="a comment that begins as no number does"):
        TypeAdapter(CsvLayout).validate_python({"comment": sign})


def test_empty_lines_are_left_out_where_stamps_show_that_nothing_is_missing(tmp_path: Path) -> None:
    lines = ["t,q,i", *_with_line("", 5)]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)
    place = table.place(5, "q")
    assert place == f"{tmp_path}/run.csv:8, column q"
    with pytest.raises(TableUnfit, match=r"run\.csv:7: found an empty line"):
        _read(tmp_path, lines, time=None)


def test_line_ends_that_were_doubled_make_no_rows(tmp_path: Path) -> None:
    doubled: list[str] = []
    for row in ("t,q,i", *ROWS):
        doubled += [row, ""]
    table = _read(tmp_path, doubled, time=None)
    np.testing.assert_array_equal(table.values, READ)


@pytest.mark.parametrize("line", ["sep=,", '"sep=,"', "SEP=,"])
def test_the_line_that_names_the_delimiter_is_no_header(tmp_path: Path, line: str) -> None:
    lines = [line, "t,q,i", *ROWS]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)


def test_another_delimiter_than_the_files_own_is_refused(tmp_path: Path) -> None:
    rows = [row.replace(",", ";") for row in ROWS]
    lines = ["sep=;", "t;q;i", *rows]
    with pytest.raises(TableUnfit, match=r"run\.csv:1: found `sep=;`.*write `delimiter: ';'`"):
        _read(tmp_path, lines)
    table = _read(tmp_path, lines, delimiter=";")
    np.testing.assert_array_equal(table.values, READ)


def test_the_minus_sign_of_typography_is_read(tmp_path: Path) -> None:
    rows = [row.replace("-", "\u2212") for row in ROWS]
    lines = ["t,q,i", *rows]
    table = _read(tmp_path, lines)
    np.testing.assert_array_equal(table.values, READ)
    assert table.remarks == ("run.csv: the minus sign U+2212 was read as -",)


@pytest.mark.parametrize("cut_off", ["0.12,0.3", "0.12,", "0.12,0.3,", "nan,0.3", "0.12,nan,"])
def test_a_last_line_that_was_cut_off_is_left_out_by_the_setting_that_is_named(
    tmp_path: Path, cut_off: str
) -> None:
    lines = ["t,q,i", *ROWS, cut_off]
    pattern = rf"the file ends early.*`keep: \{{to_row: {COUNT}\}}`"
    with pytest.raises(TableUnfit, match=pattern):
        _read(tmp_path, lines, end="")
    keep = KeptPart(to_row=COUNT)
    table = _read(tmp_path, lines, end="", keep=keep)
    np.testing.assert_array_equal(table.values, READ)


def test_two_recordings_in_one_file_are_parted_by_the_settings_that_are_named(
    tmp_path: Path,
) -> None:
    lines = ["t,q,i", *ROWS, "t,q,i", *ROWS]
    with pytest.raises(
        TableUnfit,
        match=r"run\.csv:14, column t.*the header is there "
        r"once more",
    ) as caught:
        _read(tmp_path, lines)
    from_row = COUNT + 2
    assert f"{{to_row: {COUNT}}}" in caught.value.remedy
    assert f"{{from_row: {from_row}}}" in caught.value.remedy
    first = KeptPart(to_row=COUNT)
    second = KeptPart(from_row=from_row)
    for part in (first, second):
        table = _read(tmp_path, lines, keep=part)
        np.testing.assert_array_equal(table.values, READ)


def test_a_second_header_with_other_names_is_no_line_to_be_left_out(tmp_path: Path) -> None:
    """Which of the two is right only the file's owner knows:
    advice to keep one of them would exchange columns.
    """
    lines = ["t,i,q", "t,q,i", *ROWS]
    with pytest.raises(TableUnfit, match=r"run\.csv:2, column .*a second header") as caught:
        _read(tmp_path, lines)
    assert "`keep" not in caught.value.remedy


@pytest.mark.parametrize(("first", "last"), [(0, 2), (10, 11)])
def test_rows_without_numbers_at_an_end_are_cut_by_the_setting_that_is_named(
    tmp_path: Path, first: int, last: int
) -> None:
    rows = list(ROWS)
    for row in range(first, last + 1):
        time_s = 0.01 * row
        rows[row] = f"{time_s:.2f},nan,nan"
    lines = ["t,q,i", *rows]
    if first == 0:
        from_row = last + 2
        setting = f"from_row: {from_row}"
        part = KeptPart(from_row=from_row)
        numbers = READ[last + 1 :]
    else:
        setting = f"to_row: {first}"
        part = KeptPart(to_row=first)
        numbers = READ[:first]

    pattern = rf"`keep: \{{{setting}\}}`"
    with pytest.raises(TableUnfit, match=pattern):
        _read(tmp_path, lines)

    table = _read(tmp_path, lines, keep=part)
    np.testing.assert_array_equal(table.values, numbers)


@pytest.mark.parametrize(
    ("from_s", "to_s", "rows"), [(0.03, None, slice(3, None)), (None, 0.05, slice(0, 6))]
)
def test_times_are_kept(
    tmp_path: Path, from_s: float | None, to_s: float | None, rows: slice
) -> None:
    keep = KeptPart(from_s=from_s, to_s=to_s)
    lines = ["t,q,i", *ROWS]
    table = _read(tmp_path, lines, keep=keep)
    np.testing.assert_array_equal(table.values, READ[rows])
    assert table.stamps is not None
    times_s = VALUES[rows, 0]
    first_s = times_s[0]
    last_s = times_s[-1]
    assert table.stamps.first_ns == round(1e9 * first_s)
    duration_s = last_s - first_s
    assert table.stamps.time_s[-1] == pytest.approx(duration_s)


PIECES = (
    *ROWS[:4],
    "t,q,i",
    "s,rad,A",
    "# note",
    "",
    "sep=,",
    "\u2212",
    "nan,1,2",
    '"',
    ",,",
    "a,b,c",
    "1e999,0,0",
    "\t",
)
PARTS = (
    None,
    KeptPart(from_row=2),
    KeptPart(to_row=3),
    KeptPart(from_s=0.01),
    KeptPart(to_s=0.02),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    lines=st.lists(
        st.one_of(st.sampled_from(PIECES), st.text("0123456789.,-e #%;", max_size=12)), max_size=12
    ),
    time=st.sampled_from((None, TimeUnit.SECOND, TimeUnit.CLOCK)),
    part=st.sampled_from(PARTS),
    comment=st.sampled_from((None, "#", "a")),
)
def test_any_lines_are_read_or_refused(
    lines: list[str],
    time: TimeUnit | None,
    part: KeptPart | None,
    comment: str | None,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Numbers that are read are finite, and each stamp has its row."""
    folder = tmp_path_factory.getbasetemp()
    with_header = ["t,q,i", *lines]
    try:
        table = _read(folder, with_header, time=time, keep=part, comment=comment)
    except TableUnfit:
        return
    assert np.isfinite(table.values).all()
    assert len(table.values) > 0
    if time is not None:
        assert table.stamps is not None
        assert len(table.stamps.time_s) == len(table.values)


@pytest.mark.parametrize("part", [KeptPart(from_row=100), KeptPart(from_s=5.0)])
def test_a_part_with_nothing_in_it_is_refused(tmp_path: Path, part: KeptPart) -> None:
    lines = ["t,q,i", *ROWS]
    pattern = (
        rf"found {COUNT} rows.*none of them in "
        r"`keep`.*correct `keep`"
    )
    with pytest.raises(
        TableUnfit,
        match=pattern,
    ):
        _read(tmp_path, lines, keep=part)


@pytest.mark.parametrize(
    ("delimiter", "as_yaml"), [(";", '";"'), ("\t", r'"\t"'), ("  ", '" "'), ("|", '"|"')]
)
def test_a_header_with_another_delimiter_names_the_setting_that_reads_it(
    tmp_path: Path, delimiter: str, as_yaml: str
) -> None:
    """The advice was to correct the columns."""
    with_commas = ["t,q,i", "0,1,2", "1,2,3", "2,3,4"]
    lines = [line.replace(",", delimiter) for line in with_commas]
    with pytest.raises(TableUnfit) as refused:
        _read(tmp_path, lines[:3])
    setting = f"delimiter: {as_yaml}"
    assert refused.value.remedy.startswith(f"write `{setting}` under `table`")

    layout = parse_yaml(setting.encode(), "layout").tree
    table = _read(tmp_path, lines, **layout)
    positions = table.values[:, 0]
    assert positions.tolist() == [1.0, 2.0, 3.0]


def test_a_file_without_rows_shows_the_line_that_was_taken_for_the_header(tmp_path: Path) -> None:
    with pytest.raises(TableUnfit, match="1 line, 1 of them before the numbers: '<!doctype html>'"):
        _read(tmp_path, ["<!doctype html>"])


def test_a_tail_of_nul_is_a_loss_of_power_and_names_the_cut(tmp_path: Path) -> None:
    """The advice was to save the file as UTF-8."""
    lines = ["t,q,i", "0,1,2", "1,2,3", "2,3,4"]
    end = "\n" + "\0" * 512
    with pytest.raises(TableUnfit) as refused:
        _read(tmp_path, lines, end=end)
    text = "\n".join(lines)
    length = len(text) + 1
    assert refused.value.found == f"nothing but NUL from byte {length} to the end"
    assert f"head -c {length}" in refused.value.remedy
    content = (tmp_path / "run.csv").read_bytes()
    head = content[:length].decode()
    table = _read(tmp_path, head.splitlines())
    assert len(table.values) == 3


def test_a_packed_file_is_no_text_in_another_encoding(tmp_path: Path) -> None:
    packed = gzip.compress(b"t,q,i\n0,1,2\n1,2,3\n2,3,4\n")
    path = tmp_path / "packed"
    path.write_bytes(packed)
    unit = PositionUnit.RAD
    position = PositionColumns(file="packed", columns=("q",), unit=unit, side=Side.JOINT)
    current = CurrentColumns(file="packed", columns=("i",), unit="A")
    wanted = ImportDescription(
        name="run",
        cell="cell.yaml",
        position=position,
        current=current,
        rate_hz=100.0,
    )
    with pytest.raises(TableUnfit, match=r"packed by gzip.*gunzip"):
        read_csv(path, wanted, ("q", "i"), None)


def test_a_long_field_is_cut_in_the_message(tmp_path: Path) -> None:
    long_field = "x" * 5000
    lines = ["t,q,i", "0,1,2", f"1,{long_field},3", "2,3,4"]
    with pytest.raises(TableUnfit) as refused:
        _read(tmp_path, lines)
    assert len(refused.value.found) <= 60
