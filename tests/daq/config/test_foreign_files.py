"""A packed file, a workbook or a database in the place of a text is named, with what to do."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import sqlite3
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

from daq.config.cell_file import load_cell
from daq.config.foreign_files import ForeignKind, foreign_kind
from daq.config.urdf_text import urdf_text
from daq.errors import ConfigurationInconsistent, DaqError, LogForeign, YamlInvalid
from daq.log.reader import read_log

TEXT = b"name: press\n" * 20


def _zipped(text: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("sheet.xml", text)
    return stream.getvalue()


def _database(text: bytes) -> bytes:
    connection = sqlite3.connect(":memory:")
    connection.execute("create table messages (data blob)")
    connection.execute("insert into messages values (?)", (text,))
    connection.commit()
    content = connection.serialize()
    connection.close()
    return content


MAKERS: dict[ForeignKind, Callable[[bytes], bytes]] = {
    ForeignKind.GZIP: gzip.compress,
    ForeignKind.BZIP2: bz2.compress,
    ForeignKind.XZ: lzma.compress,
    ForeignKind.ZSTD: zstandard.compress,
    ForeignKind.ZIP: _zipped,
    ForeignKind.SQLITE: _database,
    # Those that no library here writes begin as their specifications say.
    ForeignKind.WORKBOOK: lambda text: bytes.fromhex("d0cf11e0a1b11ae1") + text,
    ForeignKind.PARQUET: lambda text: b"PAR1" + text + b"PAR1",
    ForeignKind.ROS_1_BAG: lambda text: b"#ROSBAG V2.0\n" + text,
}
READERS: dict[str, Callable[[Path], object]] = {
    "cell.yaml": load_cell,
    "arm.urdf": lambda path: urdf_text(path.read_bytes(), path.name),
    "run.mcap": read_log,
}


@pytest.mark.parametrize("kind", ForeignKind)
def test_a_kind_is_recognised_by_its_first_bytes(kind: ForeignKind) -> None:
    assert foreign_kind(MAKERS[kind](TEXT)) is kind
    assert kind.remedy


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ForeignKind)
def test_a_file_of_a_kind_is_named_by_every_reader(
    tmp_path: Path, kind: ForeignKind, name: str
) -> None:
    path = tmp_path / name
    path.write_bytes(MAKERS[kind](TEXT))
    with pytest.raises(DaqError) as refused:
        READERS[name](path)
    assert isinstance(refused.value, YamlInvalid | ConfigurationInconsistent | LogForeign)
    assert refused.value.found == kind.value
    assert refused.value.remedy == kind.remedy


@pytest.mark.parametrize("text", [b"", b"name: demo\n", b"t,q1\n0,1\n", b"<robot/>", b"PK: 1\n"])
def test_a_text_is_no_foreign_file(text: bytes) -> None:
    assert foreign_kind(text) is None
