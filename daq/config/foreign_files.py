"""Files of other programs, recognised by their first bytes: a packed file, a workbook, a database.

They are given in the place of texts and logs. A message names them, and says what to do with them.
"""

from __future__ import annotations

from enum import Enum


class ForeignKind(Enum):
    """Kind of a foreign file, as a message names it."""

    GZIP = "a file packed by gzip"
    BZIP2 = "a file packed by bzip2"
    XZ = "a file packed by xz"
    ZSTD = "a file packed by zstd"
    ZIP = "a ZIP archive, as a workbook (.xlsx) is"
    WORKBOOK = "a workbook of Excel (.xls)"
    PARQUET = "a Parquet file"
    SQLITE = "an SQLite database, as a ROS 2 bag (.db3) is"
    ROS_1_BAG = "a ROS 1 bag"

    @property
    def remedy(self) -> str:
        """What to do with a file of this kind in the place of another."""
        return _REMEDIES[self]


_MAGIC = {
    b"\x1f\x8b": ForeignKind.GZIP,
    b"BZh91AY&SY": ForeignKind.BZIP2,
    b"\xfd7zXZ\x00": ForeignKind.XZ,
    b"\x28\xb5\x2f\xfd": ForeignKind.ZSTD,
    b"PK\x03\x04": ForeignKind.ZIP,
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": ForeignKind.WORKBOOK,
    b"PAR1": ForeignKind.PARQUET,
    b"SQLite format 3\x00": ForeignKind.SQLITE,
    b"#ROSBAG V": ForeignKind.ROS_1_BAG,
}
"""First bytes by the specification of each format."""
HEAD_BYTES = max(map(len, _MAGIC))  #: Bytes that are enough to recognise each kind
_EXPORT = "export its table as CSV, or give the right file"
_BAG = "give the right file; `drivegain import` reads bags that an import description names"
_REMEDIES = {
    ForeignKind.GZIP: "unpack it (`gunzip --keep FILE`), and give what is in it",
    ForeignKind.BZIP2: "unpack it (`bunzip2 --keep FILE`), and give what is in it",
    ForeignKind.XZ: "unpack it (`unxz --keep FILE`), and give what is in it",
    ForeignKind.ZSTD: "unpack it (`unzstd FILE`), and give what is in it",
    ForeignKind.ZIP: "unpack an archive, or export the table of a workbook as CSV, and give that",
    ForeignKind.WORKBOOK: _EXPORT,
    ForeignKind.PARQUET: _EXPORT,
    ForeignKind.SQLITE: _BAG,
    ForeignKind.ROS_1_BAG: _BAG,
}


def foreign_kind(content: bytes) -> ForeignKind | None:
    """Return the kind of a foreign file; None for any other file.

    Args:
        content: of the file, at least its first HEAD_BYTES.
    """
    for magic, kind in _MAGIC.items():
        if content.startswith(magic):
            return kind
    return None
