"""MATLAB files: the numbers that scipy's writer put in, or an error that says what is there."""

from __future__ import annotations

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
from daq.log.mat_table import read_mat
from daq.log.table import Table
from tests.daq.command_line import run_verb
from tests.daq.logs import damaged

ROWS = 300
Q = 20.0 * np.sin(np.arange(ROWS)[:, None] / 40.0 + np.arange(6))
CURRENT = np.cos(np.arange(ROWS)[:, None] / 7.0 + np.arange(6))
WANTED = ImportDescription.model_construct()


def read(path: Path, *columns: str | int, time: TimeColumn | None = None) -> Table:
    """Columns of a file."""
    return read_mat(path, WANTED, columns, time)


@pytest.mark.parametrize("packed", [False, True], ids=("v6", "v7"))
def test_matrices_vectors_and_fields_are_read(packed: bool, tmp_path: Path) -> None:
    clock_ns = 1_700_000_000_123_456_789 + 4_000_000 * np.arange(ROWS, dtype=np.uint64)
    seconds = np.arange(ROWS) * 4e-3
    current = CURRENT.T.astype(np.float32)
    counts = (1000.0 * Q).astype(np.int16)
    run = {"counts": counts, "t": clock_ns, "note": "bare"}
    variables = {
        "q": Q,
        "turned": np.asfortranarray(current),
        "t": seconds,
        "run": run,
    }
    path = tmp_path / "run.mat"
    savemat(path, variables, do_compression=packed)
    time = TimeColumn(file="run.mat", column="run.t", unit=TimeUnit.NANOSECOND)
    table = read(path, "q.1", "q.6", "turned.2", "run.counts.3", "t", time=time)
    expected = (
        Q[:, 0],
        Q[:, 5],
        CURRENT[:, 1].astype(np.float32),
        (1000.0 * Q[:, 2]).astype(np.int16),
        seconds,
    )
    np.testing.assert_array_equal(table.values, np.column_stack(expected))
    assert table.stamps is not None
    clock_n = int(clock_ns[0])
    assert table.stamps.first_ns == clock_n
    np.testing.assert_allclose(table.stamps.time_s, np.arange(ROWS) * 4e-3, atol=1e-12)
    time_column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.SECOND)
    other = read(path, time=time_column)
    assert other.stamps is not None
    assert other.values.shape == (ROWS, 0)
    np.testing.assert_array_equal(other.stamps.time_s, seconds)
    with pytest.raises(TableUnfit, match="posixtime"):
        read(path, time=TimeColumn(file="run.mat", column="t", unit=TimeUnit.ISO_8601))


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
    rows = values if values.shape[0] >= values.shape[1] else values.T
    columns = [f"q.{number}" for number in range(1, rows.shape[1] + 1)]
    if np.isfinite(values).all():
        np.testing.assert_array_equal(read(path, *columns).values, rows.astype(np.float64))
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
        (("t.2",), "t has 1 columns; expected one of t.1"),
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
    many = np.zeros((1, 2), dtype=[("q", object)])
    cell = np.array([1.0, "a"], dtype=object)
    savemat(path, {"q": Q, "t": Q[:, 0], "run": {"q": Q}, "note": "text", "many": many, "z": 1j * Q, "cell": cell,  # noqa: E501
                   "one": 1.0, "none": Q[:0], "block": np.ones((3, 4, 5)), "short": Q[1:, 0]})  # fmt: skip  # noqa: E501
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
            "first bytes .*; expected a MATLAB file of format 5, as `save -v7` writes it",
        ),
        (b"", "first bytes b''"),
        (b"MATLAB 5.0 MAT-file".ljust(126) + b"IM", "no variable 'q'; expected one of none"),
    ],
)
def test_files_of_other_formats_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(content)
    with pytest.raises(TableUnfit, match=message):
        read(path, "q.1")


def _element(kind: int, data: bytes) -> bytes:
    packed = struct.pack("<II", kind, len(data))
    return packed + data + bytes(-len(data) % 8)


HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"


def test_cells_in_cells_are_not_followed(tmp_path: Path) -> None:
    """scipy.io.loadmat follows each of them on the stack, and the process ends."""
    depth = 20_000
    size = 0
    heads = []
    for level in range(depth):
        name = _element(1, b"q" if level == depth - 1 else b"")
        packed = struct.pack("<II", 1, 0)
        head = _element(6, packed) + _element(5, struct.pack("<2i", 1, 1)) + name
        size += len(head)
        heads.append(struct.pack("<II", 14, size) + head)
        size += 8
    path = tmp_path / "deep.mat"
    content = HEADER + b"".join(reversed(heads))
    path.write_bytes(content)
    with pytest.raises(TableUnfit, match="q, a cell array; expected real numbers"):
        read(path, "q")


def test_an_object_is_named(tmp_path: Path) -> None:
    """MATLAB's table, timetable and timeseries have no dimensions and no numbers of their own."""
    packed = struct.pack("<II", 17, 0)
    body = _element(6, packed) + b"".join(_element(1, word) for word in (b"run", b"MCOS", b"table"))
    path = tmp_path / "table.mat"
    path.write_bytes(HEADER + _element(14, body))
    with pytest.raises(
        TableUnfit,
        match=r"run, an object \(a table, timetable, .*; expected "
        r"real numbers",
    ):
        read(path, "run")


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    head = (
        _element(6, struct.pack("<II", 6, 0))
        + _element(5, struct.pack("<2i", 2**27, 1))
        + _element(1, b"q")
    )
    packed = zlib.compress(struct.pack("<II", 14, 2**30) + head + bytes(2**20))
    path = tmp_path / "bomb.mat"
    content = HEADER + struct.pack("<II", 15, len(packed)) + packed
    path.write_bytes(content)
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
    at = rng.choice((rng.randrange(len(data)), rng.randrange(100, 400)))
    path = tmp_path_factory.getbasetemp() / "hurt.mat"
    path.write_bytes(damaged(data, hurt, at, rng, junk_bytes=12))
    try:
        table = read(path, "run.q.1", "q.2")
    except TableUnfit as error:
        assert str(path) in str(error)
    else:
        assert table.values.shape == (20, 2)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, bytes]:
    """A small file, not packed and packed."""
    made = []
    for packed in (False, True):
        path = tmp_path_factory.mktemp("mat") / "run.mat"
        run = {"q": Q[:20], "note": "x"}
        savemat(path, {"run": run, "q": Q[:20]}, do_compression=packed)
        made.append(path.read_bytes())
    return made[0], made[1]


def test_a_matrix_is_imported_with_its_columns_as_axes(checkout: Path, tmp_path: Path) -> None:
    savemat(tmp_path / "run.mat", {"q": Q, "run": {"i": CURRENT, "t": np.arange(ROWS) * 1e-3}})
    description = tmp_path / "run.yaml"
    out = tmp_path / "log.mcap"
    position = {"file": "run.mat", "columns": ["q"], "unit": "deg", "side": "joint"}
    current = {"file": "run.mat", "columns": ["run.i"], "unit": "A"}
    cell = str(checkout / "configs/cells/demo.yaml")
    document = {
        "name": "run",
        "cell": cell,
        "position": position,
        "current": current,
        "time": {"file": "run.mat", "column": "run.t", "unit": "s"},
    }
    description.write_text(json.dumps(document))
    assert run_verb("import", description, "--data", tmp_path, "--out", out) == 0
    run, _ = load_run(out)
    assert run.rate_hz == pytest.approx(1000.0)
    np.testing.assert_allclose(run.position_rad, np.radians(Q), atol=2e-9)
    np.testing.assert_allclose(run.current_a, CURRENT, atol=1e-9)


def test_stamps_and_numbers_of_columns_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    grid = np.linspace(0.0, 1e300, ROWS)
    savemat(path, {"q": Q, "t": grid, "n": np.full(ROWS, 2**62)})
    for column, unit in (("t", TimeUnit.SECOND), ("n", TimeUnit.MICROSECOND)):
        time = TimeColumn(file="run.mat", column=column, unit=unit)
        with pytest.raises(TableUnfit, match="a stamp of"):
            read(path, "q.1", time=time)
    with pytest.raises(TableUnfit, match=r"VARIABLE|no variable"):
        read(path, "q." + 5000 * "1")


def test_a_column_under_two_names_is_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    savemat(path, {"q": Q[:, :1], "i": CURRENT[:, :1]})
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
        actual = table.values[:, 0]
        np.testing.assert_array_equal(actual, values[5:])
        assert table.stamps is not None
        assert table.stamps.first_ns == 50_000_000
        assert table.place(0, "q") == f"{path}, row 6, column q"


@pytest.mark.parametrize("kind", [np.uint32, np.float64])
def test_a_counter_of_time_that_wraps_goes_on(kind: type, tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    counts = (2**32 - 20_000 + 10_000 * np.arange(6)) % 2**32
    savemat(path, {"t": counts.astype(kind), "q": np.arange(6.0)})
    column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.MICROSECOND)
    table = read_mat(path, ImportDescription.model_construct(), ("q",), column)
    assert table.stamps is not None
    expected = 0.01 * np.arange(6)
    assert table.stamps.time_s == pytest.approx(expected, abs=1e-9)
    assert "a counter of 32 bits in us that wraps" in table.remarks[0]


def test_a_number_since_midnight_goes_on_over_midnight(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    since_midnight_ms = (86_400_000 - 12 + 4 * np.arange(6)) % 86_400_000
    savemat(path, {"t": since_midnight_ms.astype(np.uint32), "q": np.arange(6.0)})
    column = TimeColumn(file="run.mat", column="t", unit=TimeUnit.MILLISECOND)
    table = read_mat(path, ImportDescription.model_construct(), ("q",), column)
    assert table.stamps is not None
    expected = 0.004 * np.arange(6)
    assert table.stamps.time_s == pytest.approx(expected, abs=1e-9)
    assert "times of day that pass midnight" in table.remarks[0]
