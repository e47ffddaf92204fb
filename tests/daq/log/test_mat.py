"""MATLAB files: the numbers that scipy's writer put in, or an error that says what is there."""

from __future__ import annotations

import gzip
import json
import pickle
import random
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, floating_dtypes, integer_dtypes
from scipy.io import savemat

from daq.config.import_description import ImportDescription, KeptPart, TimeColumn, TimeUnit
from daq.errors import TableUnfit
from daq.log.conversion import load_run
from daq.log.importing import import_recording
from daq.log.mat_table import read_mat
from daq.log.table import Table
from tests.daq.command_line import run_verb
from tests.daq.logs import damaged

ROWS = 300
ROW = np.arange(ROWS)[:, None]
AXIS = np.arange(6)
Q = 20.0 * np.sin(ROW / 40.0 + AXIS)
CURRENT = np.cos(ROW / 7.0 + AXIS)
WANTED = ImportDescription.model_construct()


def read(path: Path, *columns: str | int, time: TimeColumn | None = None) -> Table:
    """Columns of a file."""
    return read_mat(path, WANTED, columns, time)


@pytest.mark.parametrize("packed", [False, True], ids=("v6", "v7"))
def test_matrices_vectors_and_fields_are_read(packed: bool, tmp_path: Path) -> None:
    cycle = np.arange(ROWS, dtype=np.uint64)
    clock_ns = 1_700_000_000_123_456_789 + 4_000_000 * cycle
    seconds = np.arange(ROWS) * 4e-3
    current = CURRENT.T.astype(np.float32)
    counts = (1000.0 * Q).astype(np.int16)
    run = {"counts": counts, "t": clock_ns, "note": "bare"}
    turned = np.asfortranarray(current)
    variables = {
        "q": Q,
        "turned": turned,
        "t": seconds,
        "run": run,
    }
    path = tmp_path / "run.mat"
    savemat(path, variables, do_compression=packed)
    time = TimeColumn(file="run.mat", column="run.t", unit=TimeUnit.NANOSECOND)

    table = read(path, "q.1", "q.6", "turned.2", "run.counts.3", "t", time=time)

    first = Q[:, 0]
    sixth = Q[:, 5]
    second_current = current[1]
    third_counts = counts[:, 2]
    columns = np.column_stack((first, sixth, second_current, third_counts, seconds))
    np.testing.assert_array_equal(table.values, columns)
    assert table.stamps is not None
    first_ns = int(clock_ns[0])
    assert table.stamps.first_ns == first_ns
    np.testing.assert_allclose(table.stamps.time_s, seconds, atol=1e-12)

    time_column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.SECOND)
    other = read(path, time=time_column)
    assert other.stamps is not None
    assert other.values.shape == (ROWS, 0)
    np.testing.assert_array_equal(other.stamps.time_s, seconds)

    date_column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.ISO_8601)
    with pytest.raises(TableUnfit, match="posixtime"):
        read(path, time=date_column)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    values=arrays(
        st.one_of(floating_dtypes(sizes=(32, 64)), integer_dtypes(), st.just(np.dtype(bool))),
        array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=9),
    ),
    packed=st.booleans(),
)
def test_any_matrix_comes_back(
    values: np.ndarray[Any, Any], packed: bool, tmp_path_factory: Any
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.mat"
    savemat(path, {"q": values}, do_compression=packed)
    height, width = values.shape
    rows = values if height >= width else values.T
    count = min(height, width)
    columns = [f"q.{number + 1}" for number in range(count)]
    if np.isfinite(values).all():
        table = read(path, *columns)
        numbers = rows.astype(np.float64)
        np.testing.assert_array_equal(table.values, numbers)
    else:
        with pytest.raises(
            TableUnfit,
            match=r"row .*, column q.*: found (nan|-?inf); expected a "
            r"finite number",
        ):
            read(path, *columns)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            ("i.1",),
            r"no variable 'i'; expected one of q \(300×6\), t \(1×300\), run \(1×1 "
            r"struct\), note \(text\)",
        ),
        ((1,), "no variable '1'"),
        (("q",), r"column q, and q has 6 columns; expected one of q.1 to q.6"),
        (("q.7",), "column q.7"),
        (("q.0",), "column q.0"),
        (("t.2",), "t has 1 column; expected one of t.1"),
        (("q.q",), "q.q, where q is 300×6; expected VARIABLE, or STRUCT.FIELD"),
        (("run",), "run, where run is 1×1 struct"),
        (("run.i",), r"no field 'run.i'; expected one of run.q \(300×6\)"),
        (("many.q",), "many is 1×2 struct"),
        (("note",), "note, text; expected real numbers"),
        (("z.1",), "z, 300×6 complex; expected real numbers"),
        (("cell",), "cell, a cell array; expected real numbers"),
        (("one",), "one of size 1×1"),
        (("none",), "none of size 0×6"),
        (("block.1",), "block of size 3×4×5"),
        (("q.1", "short"), "300 values in q.1, 299 values in short; expected as many in each"),
    ],
)
def test_what_is_no_column_of_numbers_is_named(
    columns: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mat"
    first = Q[:, 0]
    complex_numbers = 1j * Q
    two_structs = np.zeros((1, 2), dtype=[("q", object)])
    cell_array = np.array([1.0, "a"], dtype=object)
    no_rows = Q[:0]
    block = np.ones((3, 4, 5))
    variables = {
        "q": Q,
        "t": first,
        "run": {"q": Q},
        "note": "text",
        "many": two_structs,
        "z": complex_numbers,
        "cell": cell_array,
        "one": 1.0,
        "none": no_rows,
        "block": block,
        "short": first[1:],
    }
    savemat(path, variables)
    with pytest.raises(TableUnfit, match=message):
        read(path, *columns)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n",
            "7.3 .HDF5.; .* '-v7'",
        ),
        (
            pickle.dumps({"q": [1, 2]}),
            "a file of an unknown kind; expected a MATLAB file of format 5, as `save -v7` writes "
            "it; correct `file`",
        ),
        (b"", "found an empty file; expected a MATLAB file"),
        (gzip.compress(b"x", mtime=0), r"found a file packed by gzip; .*gunzip"),
        (b"PK\x03\x04" + bytes(60), "found a ZIP archive"),
        (b"t,q1,q2\n0,1,2\n", r"a text file that begins with 't,q1,q2'; .*ends in \.csv"),
        (b"MATLAB 5.0", r"damaged MATLAB file \(10 bytes of a header of 128\); .*copy it again"),
        (b"MATLAB 5.0 MAT-file".ljust(128), "no mark of the order of bytes"),
        (
            b"MATLAB 5.0 MAT-file".ljust(126) + b"IM",
            r"damaged MATLAB file \(its header alone, without a variable\)",
        ),
        (
            b"MATLAB 5.0 MAT-file".ljust(126) + b"IM" + bytes(5),
            r"damaged MATLAB file \(bytes that are no variable\)",
        ),
    ],
)
def test_files_of_other_formats_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(content)
    with pytest.raises(TableUnfit, match=message):
        read(path, "q.1")


def _element(kind: int, data: bytes) -> bytes:
    tag = struct.pack("<II", kind, len(data))
    padding = bytes(-len(data) % 8)
    return tag + data + padding


MATRIX = 14  #: types of elements of the format
COMPRESSED = 15
CELL_ARRAY = 1  #: classes of a matrix
DOUBLE_ARRAY = 6
OBJECT_ARRAY = 17


def _class_element(array_class: int) -> bytes:
    flags = struct.pack("<II", array_class, 0)
    return _element(6, flags)


def _size_element(rows: int, columns: int) -> bytes:
    size = struct.pack("<2i", rows, columns)
    return _element(5, size)


def _text_element(text: bytes) -> bytes:
    return _element(1, text)


HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"


def test_cells_in_cells_are_not_followed(tmp_path: Path) -> None:
    """scipy.io.loadmat follows each of them on the stack, and the process ends."""
    depth = 20_000
    size = 0
    heads = []
    for level in range(depth):
        is_outermost = level == depth - 1
        name = b"q" if is_outermost else b""
        head = _class_element(CELL_ARRAY) + _size_element(1, 1) + _text_element(name)
        size += len(head)
        tag = struct.pack("<II", MATRIX, size)
        heads.append(tag + head)
        size += len(tag)
    path = tmp_path / "deep.mat"
    content = HEADER + b"".join(reversed(heads))
    path.write_bytes(content)
    with pytest.raises(TableUnfit, match="q, a cell array; expected real numbers"):
        read(path, "q")


def test_an_object_is_named(tmp_path: Path) -> None:
    """MATLAB's table, timetable and timeseries have no dimensions and no numbers of their own."""
    body = _class_element(OBJECT_ARRAY)
    for word in (b"run", b"MCOS", b"table"):
        body += _text_element(word)
    path = tmp_path / "table.mat"
    matrix = _element(MATRIX, body)
    path.write_bytes(HEADER + matrix)
    with pytest.raises(
        TableUnfit,
        match=r"run, an object \(a table, timetable, .*; expected "
        r"real numbers",
    ):
        read(path, "run")


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    head = _class_element(DOUBLE_ARRAY) + _size_element(2**27, 1) + _text_element(b"q")
    tag = struct.pack("<II", MATRIX, 2**30)
    zeros = bytes(2**20)
    packed = zlib.compress(tag + head + zeros)
    packed_tag = struct.pack("<II", COMPRESSED, len(packed))
    path = tmp_path / "bomb.mat"
    path.write_bytes(HEADER + packed_tag + packed)
    with pytest.raises(TableUnfit, match=r"\d+ bytes that unfold to 1073741824"):
        read(path, "q.1")


@settings(deadline=None, max_examples=80, derandomize=True)
@given(seed=st.integers(0, 10**6), hurt=st.sampled_from(("flip", "cut", "junk")))
def test_a_damaged_file_is_read_or_refused(
    seed: int, hurt: str, files: tuple[bytes, bytes], tmp_path_factory: Any
) -> None:
    """The format has no checksum: a flipped bit of a number passes, as in every reader of it."""
    rng = random.Random(seed)
    data = rng.choice(files)
    anywhere = rng.randrange(len(data))
    near_start = rng.randrange(100, 400)
    at = rng.choice((anywhere, near_start))
    path = tmp_path_factory.getbasetemp() / "hurt.mat"
    content = damaged(data, hurt, at, rng, junk_bytes=12)
    path.write_bytes(content)
    try:
        table = read(path, "run.q.1", "q.2")
    except TableUnfit as error:
        assert str(path) in str(error)
    else:
        assert table.values.shape == (20, 2)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, bytes]:
    """A small file, not packed and packed."""
    path = tmp_path_factory.mktemp("mat") / "run.mat"
    q = Q[:20]
    run = {"q": q, "note": "x"}
    variables = {"run": run, "q": q}
    savemat(path, variables, do_compression=False)
    plain = path.read_bytes()
    savemat(path, variables, do_compression=True)
    packed = path.read_bytes()
    return plain, packed


def test_a_matrix_is_imported_with_its_columns_as_axes(checkout: Path, tmp_path: Path) -> None:
    time_s = np.arange(ROWS) * 1e-3
    recorded = {"i": CURRENT, "t": time_s}
    savemat(tmp_path / "run.mat", {"q": Q, "run": recorded})
    description = tmp_path / "run.yaml"
    out = tmp_path / "log.mcap"
    position = {"file": "run.mat", "columns": ["q"], "unit": "deg", "side": "joint"}
    current = {"file": "run.mat", "columns": ["run.i"], "unit": "A"}
    cell = str(checkout / "configs/cells/demo.yaml")
    time = {"file": "run.mat", "column": "run.t", "unit": "s"}
    document = {
        "name": "run",
        "cell": cell,
        "position": position,
        "current": current,
        "time": time,
    }
    description.write_text(json.dumps(document))

    code = run_verb("import", description, "--data", tmp_path, "--out", out)

    assert code == 0
    run, _ = load_run(out)
    assert run.rate_hz == pytest.approx(1000.0)
    position_rad = np.radians(Q)
    np.testing.assert_allclose(run.position_rad, position_rad, atol=2e-9)
    np.testing.assert_allclose(run.current_a, CURRENT, atol=1e-9)


def test_a_variable_that_is_a_copy_of_the_positions_is_no_current(
    checkout: Path, tmp_path: Path
) -> None:
    savemat(tmp_path / "run.mat", {"q": Q, "i": Q})
    description = tmp_path / "run.yaml"
    position = {"file": "run.mat", "columns": ["q"], "unit": "deg", "side": "joint"}
    current = {"file": "run.mat", "columns": ["i"], "unit": "A"}
    document = {
        "name": "run",
        "cell": str(checkout / "configs/cells/demo.yaml"),
        "position": position,
        "current": current,
        "rate_hz": 1000.0,
    }
    description.write_text(json.dumps(document))
    with pytest.raises(
        TableUnfit,
        match=r"column i\.1: found the same number as column q\.1 of run\.mat in all 300 rows; "
        "expected a column of its own for each quantity",
    ):
        import_recording(description, tmp_path, tmp_path / "log.mcap", software="test")


def test_stamps_and_numbers_of_columns_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    seconds = np.linspace(0.0, 1e300, ROWS)
    microseconds = np.full(ROWS, 2**62)
    savemat(path, {"q": Q, "t": seconds, "n": microseconds})
    in_seconds = TimeColumn(file="run.mat", column="t", unit=TimeUnit.SECOND)
    in_microseconds = TimeColumn(file="run.mat", column="n", unit=TimeUnit.MICROSECOND)
    for time in (in_seconds, in_microseconds):
        with pytest.raises(TableUnfit, match="a stamp of"):
            read(path, "q.1", time=time)
    long_number = 5000 * "1"
    with pytest.raises(TableUnfit, match=r"VARIABLE|no variable"):
        read(path, f"q.{long_number}")


def test_a_column_under_two_names_is_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    position = Q[:, :1]
    current = CURRENT[:, :1]
    savemat(path, {"q": position, "i": current})
    with pytest.raises(TableUnfit, match=r"column q\.1 a second time"):
        read(path, "q", "i", "q.1")


def test_a_part_of_a_matrix_is_kept_by_rows_and_by_times(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    time_s = 0.01 * np.arange(50)
    values = np.arange(50.0)
    values[:5] = np.nan
    savemat(path, {"t": time_s, "q": values})
    column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.SECOND)
    with pytest.raises(TableUnfit, match=r"row 1, column q: found nan.*`keep: \{from_row: 6\}`"):
        read_mat(path, ImportDescription.model_construct(), ("q",), column)
    for part in (KeptPart(from_row=6), KeptPart(from_s=0.05)):
        wanted = ImportDescription.model_construct(keep=part)
        table = read_mat(path, wanted, ("q",), column)
        column_values = table.values[:, 0]
        np.testing.assert_array_equal(column_values, values[5:])
        assert table.stamps is not None
        assert table.stamps.first_ns == 50_000_000
        place = table.place(0, "q")
        assert place == f"{path}, row 6, column q"


def _read_with_time(path: Path, time: np.ndarray[Any, Any], unit: TimeUnit) -> Table:
    """Six rows with these times in their unit."""
    q = np.arange(6.0)
    savemat(path, {"t": time, "q": q})
    column = TimeColumn(file="run.mat", column="t", unit=unit)
    return read(path, "q", time=column)


@pytest.mark.parametrize("kind", [np.uint32, np.float64])
def test_a_counter_of_time_that_wraps_goes_on(kind: type, tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    first_us = 2**32 - 20_000
    counts = (first_us + 10_000 * np.arange(6)) % 2**32
    table = _read_with_time(path, counts.astype(kind), TimeUnit.MICROSECOND)
    assert table.stamps is not None
    expected_s = 0.01 * np.arange(6)
    assert table.stamps.time_s == pytest.approx(expected_s, abs=1e-9)
    assert "a counter of 32 bits in us that wraps" in table.remarks[0]


def test_a_number_since_midnight_goes_on_over_midnight(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    day_ms = 86_400_000
    since_midnight_ms = (day_ms - 12 + 4 * np.arange(6)) % day_ms
    table = _read_with_time(path, since_midnight_ms.astype(np.uint32), TimeUnit.MILLISECOND)
    assert table.stamps is not None
    expected_s = 0.004 * np.arange(6)
    assert table.stamps.time_s == pytest.approx(expected_s, abs=1e-9)
    assert "times of day that pass midnight" in table.remarks[0]
