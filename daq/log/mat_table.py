"""Read MATLAB files of format 5 (`save -v6`, `save -v7`) as tables.

A column is named as the variable, or `struct.field`; a matrix adds the number of its column,
counted from 1: `q.1`, `run.q.1`. The longer side of a matrix is time.

The file may be truncated, damaged or malicious: only the named variables are unpacked, every length
is compared with the bytes that are there, nothing is followed deeper than the fields of a struct,
and no object is ever built.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.config.foreign_files import HEAD_BYTES
from daq.config.import_description import Column, ImportDescription, TimeColumn, TimeUnit
from daq.errors import TableUnfit, counted, first_few, on_one_line
from daq.files import read_regular
from daq.log.table import (
    MIDNIGHT,
    Stamps,
    Table,
    check_reach,
    counter_wraps,
    cut_stamps,
    digest_of,
    kind_of_content,
    repeated,
    require_finite,
    require_kept,
    rows_in_time,
    stamps_of_ns,
    stamps_of_numbers,
    unreadable,
    without_wraps,
)

MAGIC = b"MATLAB 5.0 MAT-file"
LARGEST_BYTES = 2**31 - 1  #: Largest file and variable; the format has no larger ones
#: Largest ratio of an unpacked variable to its packed bytes, beyond SMALL_BYTES
LARGEST_RATIO = 200
SMALL_BYTES = 64 * 2**20
_HEADER_BYTES = 128
_PEEK_BYTES = 4096  #: Class, dimensions and name of a variable are in its first bytes

# Types of elements and classes of arrays, by their numbers in the format.
_MATRIX = 14
_COMPRESSED = 15
_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_STRUCT = 2
_OPAQUE = 17
_FLOATS = (6, 7)
_INTEGERS = range(8, 16)
_KINDS = {
    1: "a cell array", 3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function",
    17: "an object (a table, timetable, timeseries, datetime or duration)",
}  # fmt: skip
_COMPLEX = 0x0800


def read_mat(
    path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None
) -> Table:
    """Read columns of a MATLAB file.

    Raises:
        TableUnfit: the file cannot be read, is of another format, a variable is missing or holds no
            real numbers, or the columns are of different lengths.
    """
    if time is not None and time.unit.is_text:
        raise TableUnfit(
            str(path),
            found=f"time column {time.column!r} in {time.unit.value}",
            expected="numbers in s, ms, us or ns",
            remedy="in MATLAB, posixtime(t) makes seconds of a datetime",
        )
    file = _MatFile(path, _content(path))
    names = columns if time is None else (*columns, time.column)
    found = [file.column(name) for name in names]
    lengths = [len(numbers) for numbers in found]
    if len(set(lengths)) > 1:
        described: list[str] = []
        for name, length in zip(names, lengths, strict=True):
            values_there = counted(length, "value")
            described.append(f"{values_there} in {name}")
        raise TableUnfit(
            str(path),
            found=", ".join(described),
            expected="as many in each",
            remedy="are they of one run? the longer side of a matrix is taken for time",
        )
    addresses = set[int]()
    for name, numbers in zip(names, found, strict=True):
        address = numbers.ctypes.data  # they are views of what was read
        if address in addresses:
            raise repeated(path, name, "under another name")
        addresses.add(address)
    part = wanted.keep
    rows = slice(None) if part is None else part.rows
    require_kept(path, len(found[0]), rows)
    clock = None
    remarks: tuple[str, ...] = ()
    if time is not None:
        stamps = found[-1][rows]
        stamp_column = stamps.astype(np.float64)[:, None]
        require_finite(
            Table(path, (time.column,), stamp_column, "", first_row=rows.start or 0),
        )
        clock, remarks = _stamps(path, stamps, time)
        if part is not None and part.is_by_time:
            rows = rows_in_time(clock, part)
            require_kept(path, len(stamps), rows)
            clock = cut_stamps(clock, rows)
    first_row, end, _ = rows.indices(len(found[0]))
    values = np.empty((end - first_row, len(columns)))
    for index in range(len(columns)):
        values[:, index] = found[index][rows]
    digest = digest_of(values, clock)
    table = Table(path, columns, values, digest, clock, first_row=first_row, remarks=remarks)
    return require_finite(table)


def _stamps(path: Path, values: NDArray[Any], time: TimeColumn) -> tuple[Stamps, tuple[str, ...]]:
    """Return the stamps of a column, and remarks on them."""
    factor = round(time.unit.seconds * 1e9)
    seconds = values.astype(np.float64) * time.unit.seconds
    check_reach(seconds, lambda row: f"{path}, row {row + 1}, column {time.column}")
    whole_s, remarks = without_wraps(seconds, (*counter_wraps(), MIDNIGHT))
    if remarks:
        stamps = stamps_of_numbers(whole_s, TimeUnit.SECOND)
        return stamps, tuple(f"{path.name}: {remark}" for remark in remarks)
    if values.dtype.kind in "iu":
        stamp_ns = values.astype(np.int64) * factor
        return stamps_of_ns(stamp_ns.tolist()), ()
    return stamps_of_numbers(values.astype(np.float64), time.unit), ()


def _content(path: Path) -> memoryview:
    """Read a file of format 5.

    Raises:
        TableUnfit: it cannot be read, or is of another format.
    """
    try:
        content = read_regular(path, LARGEST_BYTES)
    except OSError as error:
        raise unreadable(path, error, "a MATLAB file (.mat) of at most 2 GB") from error
    byte_order = content[126:128]
    has_magic = content.startswith(MAGIC)
    if has_magic and byte_order in (b"IM", b"MI"):
        return memoryview(content)
    is_begin = 0 < len(content) < _HEADER_BYTES and content.startswith(MAGIC[: len(content)])
    if is_begin:
        size = counted(len(content), "byte")
        raise _damaged(path, f"{size} of a header of {_HEADER_BYTES}")
    if has_magic:
        raise _damaged(path, "no mark of the order of bytes in its header")
    if b"\x89HDF\r\n" in content[: 512 + 8]:
        found = "a MATLAB file of format 7.3 (HDF5)"
        remedy = "in MATLAB: save('run.mat', 'q', 'i', 't', '-v7') with the names of your variables"
    else:
        found, remedy = kind_of_content(content[:HEAD_BYTES])
        remedy += "; of MATLAB or Octave, save the variables with -v7"
    raise TableUnfit(
        str(path),
        found=found,
        expected="a MATLAB file of format 5, as `save -v7` writes it",
        remedy=remedy,
    )


def _damaged(path: Path, found: str) -> TableUnfit:
    """Make the error for a file that is none to its end."""
    return TableUnfit(
        str(path),
        found=f"a damaged MATLAB file ({found})",
        expected="whole variables",
        remedy="the file ends early or was changed: save or copy it again",
    )


@dataclass(frozen=True, slots=True)
class _Array:
    """An array whose numbers are not yet read."""

    kind: int  #: class
    shape: tuple[int, ...]  #: dimensions
    imaginary: bool  #: complex numbers
    body: memoryview  #: elements after the name

    def __str__(self) -> str:
        size = "×".join(map(str, self.shape))
        if self.kind in _KINDS:
            return _KINDS[self.kind]
        if self.kind == _STRUCT:
            return f"{size} struct"
        if self.imaginary:
            return f"{size} complex"
        return size


class _MatFile:
    """The variables of a file, unpacked when they are asked for."""

    def __init__(self, path: Path, content: memoryview) -> None:
        self._path = path
        is_little_endian = bytes(content[126:128]) == b"IM"
        self._order = "<" if is_little_endian else ">"
        self._read: dict[str, NDArray[Any]] = {}
        try:
            self._variables = dict(self._found(content[_HEADER_BYTES:]))
        except (ValueError, struct.error, zlib.error) as error:
            raise self._broken(error) from error
        if not self._variables:
            raise _damaged(path, "its header alone, without a variable")

    def _found(self, data: memoryview) -> Iterator[tuple[str, tuple[_Array, memoryview | None]]]:
        """Name, array and packed bytes of each variable;
        an array that is packed lacks its body yet.
        """
        at = 0
        while at < len(data):
            kind, body, at = self._element(data, at)
            if kind == _COMPRESSED:
                unpacked = zlib.decompressobj().decompress(body, _PEEK_BYTES)
                name, array = self._head(memoryview(unpacked)[8:])
                yield name, (array, body)
            elif kind == _MATRIX:
                name, array = self._head(body)
                yield name, (array, None)
            else:
                raise ValueError(f"an element of type {kind}")

    def column(self, column: Column) -> NDArray[Any]:
        """Return a column as numbers, shape (k,).

        Raises:
            TableUnfit: it is not there, or holds no real numbers.
        """
        parts = str(column).split(".")
        number = None
        if len(parts) > 1 and re.fullmatch("[0-9]{1,9}", parts[-1]):
            number = int(parts.pop())
        name = ".".join(parts)
        if name not in self._read:
            try:
                self._read[name] = self._numbers(name, parts)
            except (ValueError, struct.error, zlib.error, MemoryError) as error:
                raise self._broken(error) from error
        values = self._read[name]
        width = values.shape[1]
        if number is None and width == 1:
            number = 1
        if number is None or not 1 <= number <= width:
            if width == 1:
                known = f"{name}.1"
            else:
                known = f"{name}.1 to {name}.{width}"
            columns = counted(width, "column")
            raise self._unfit(f"column {column}, and {name} has {columns}", f"one of {known}")
        return values[:, number - 1]

    def _numbers(self, name: str, parts: list[str]) -> NDArray[Any]:
        """Read the array of a variable or field, shape (k, columns)."""
        array = self._array(name, parts)
        if array.kind not in (*_FLOATS, *_INTEGERS) or array.imaginary:
            raise self._unfit(f"{name}, {array}", "real numbers")
        sides = [side for side in array.shape if side != 1]
        if not sides or len(sides) > 2 or min(sides) < 1:
            raise self._unfit(
                f"{name} of size {array}", "a column for each axis, a row for each sample"
            )
        kind, data, _ = self._element(array.body, 0)
        element_type = _TYPES.get(kind, "V1")
        dtype = np.dtype(self._order + element_type)
        if len(data) % dtype.itemsize:
            raise ValueError(f"{len(data)} bytes of numbers of {dtype.itemsize} bytes each")
        values = np.frombuffer(data, dtype=dtype)
        if values.dtype.kind == "V" or len(values) != prod(sides):
            raise ValueError(f"{len(values)} numbers for {array}")
        table = values.reshape(sides[0], -1, order="F")
        if table.shape[0] < table.shape[1]:
            table = table.T
        is_integer = array.kind in _INTEGERS and table.dtype.kind in "iu"
        if is_integer and (table.dtype != np.uint64 or table.max() < 2**63):
            return table.astype(np.int64)
        return table.astype(np.float64)

    def _array(self, name: str, parts: list[str]) -> _Array:
        """Find the array of a variable or of a field, by the parts of its name."""
        known = {variable: array for variable, (array, _) in self._variables.items() if variable}
        variable = parts[0]
        if variable not in known:
            raise self._unfit(f"no variable {variable!r}", "one of " + _listed(known))
        array = self._whole(variable)
        is_struct = array.kind == _STRUCT
        if is_struct and len(parts) == 2 and prod(array.shape) == 1:
            fields = dict(self._fields(array))
            if parts[1] not in fields:
                listed = _listed(fields, f"{variable}.")
                raise self._unfit(f"no field {name!r}", f"one of {listed}")
            return fields[parts[1]]
        if is_struct or len(parts) > 1:
            raise self._unfit(
                f"{name}, where {variable} is {array}",
                "VARIABLE, or STRUCT.FIELD of one struct, and .NUMBER for a column of a matrix",
            )
        return array

    def _whole(self, name: str) -> _Array:
        """Unpack a variable."""
        array, packed = self._variables[name]
        if packed is None:
            return array
        unpack = zlib.decompressobj()
        tag = unpack.decompress(packed, 8)
        (size,) = struct.unpack(self._order + "4xI", tag)
        largest = min(LARGEST_BYTES, SMALL_BYTES + LARGEST_RATIO * len(packed))
        if size > largest:
            raise ValueError(f"{len(packed)} bytes that unfold to {size}")
        body = unpack.decompress(unpack.unconsumed_tail, size)
        if len(body) < size:
            raise ValueError(f"{len(body)} bytes of {size} in {name}")
        return self._head(memoryview(body))[1]

    def _fields(self, array: _Array) -> Iterator[tuple[str, _Array]]:
        """Name and array of each field of one struct."""
        _, length, at = self._element(array.body, 0)
        _, names, at = self._element(array.body, at)
        (width,) = struct.unpack(self._order + "i", length)
        if width < 1:
            raise ValueError(f"names of {width} bytes")
        for start in range(0, len(names), width):
            _, body, at = self._element(array.body, at)
            name = _text(names[start : start + width])
            _, field = self._head(body)
            yield name, field

    def _head(self, body: memoryview) -> tuple[str, _Array]:
        """Read name, class and dimensions of a matrix."""
        if not body:  # a field that was never set
            return "", _Array(_FLOATS[0], (0, 0), imaginary=False, body=body)
        _, flags, at = self._element(body, 0)
        (word,) = struct.unpack_from(self._order + "I", flags)
        kind = word & 0xFF
        shape = ()
        if kind != _OPAQUE:
            _, sides, at = self._element(body, at)
            shape = struct.unpack(f"{self._order}{len(sides) // 4}i", sides)
        _, name, at = self._element(body, at)
        is_complex = bool(word & _COMPLEX)
        return _text(name), _Array(kind, shape, is_complex, body[at:])

    def _element(self, data: memoryview, at: int) -> tuple[int, memoryview, int]:
        """Return type and content of the element at an offset, and the offset of the next one."""
        kind, size = struct.unpack_from(self._order + "II", data, at)
        start = at + 8
        following = start + size
        if kind != _COMPRESSED:
            following += -size % 8  # up to a multiple of 8 bytes
        # A small element: its size is in the upper half, its content in the second word
        if kind >> 16:
            size = kind >> 16
            kind &= 0xFFFF
            start = at + 4
            following = at + 8
        end = start + size
        if end > len(data):
            raise ValueError(f"{len(data) - start} bytes of an element of {size}")
        return kind, data[start:end], following

    def _unfit(self, found: str, expected: str) -> TableUnfit:
        remedy = (
            "correct `columns` in the import description, or save plain matrices: "
            "save('run.mat', 'q', 'i', '-v7')"
        )
        return TableUnfit(str(self._path), found=found, expected=expected, remedy=remedy)

    def _broken(self, error: Exception) -> TableUnfit:
        if type(error) is ValueError:
            return _damaged(self._path, str(error))
        # Of other errors the text is about buffers and streams of Python.
        return _damaged(self._path, "bytes that are no variable")


def _text(data: memoryview) -> str:
    return bytes(data).split(b"\0")[0].decode("latin-1")


def _listed(arrays: dict[str, _Array], before: str = "") -> str:
    """Name up to twelve arrays with their sizes."""
    names = [f"{before}{on_one_line(name)} ({array})" for name, array in arrays.items()]
    return first_few(names, 12, separator=", ") or "none"
