"""Choose the reader of a foreign recording by its content: CSV, MATLAB or a ROS 2 bag."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace
from pathlib import Path

from daq.config.import_description import ImportDescription, Section, TemperatureColumns
from daq.errors import ConfigurationInconsistent, TableUnfit
from daq.log.bag_file import SQLITE_MAGIC, first_bytes
from daq.log.bag_table import FIELDS, read_bag
from daq.log.container import MAGIC
from daq.log.csv_table import read_csv
from daq.log.mat_table import read_mat
from daq.log.mcap_bag import ZSTD_MAGIC
from daq.log.table import Reader

_HEADS: dict[bytes, Reader] = {
    MAGIC: read_bag,
    SQLITE_MAGIC: read_bag,
    ZSTD_MAGIC: read_bag,
    b"MATLAB ": read_mat,
    b"\x89HDF\r\n": read_mat,
}
_SUFFIXES: dict[str, Reader] = {".mcap": read_bag, ".db3": read_bag, ".mat": read_mat}
_ROS_1_BAG = b"#ROSBAG V"


def reader_of(path: Path) -> Reader:
    """Return the reader of a file, or of a folder with the parts of a bag; the name decides if the content does not.

    Raises:
        TableUnfit: the content is of a format that is not read.
    """
    if path.is_dir():
        return read_bag
    head = first_bytes(path)
    if head.startswith(_ROS_1_BAG):
        raise TableUnfit(
            str(path),
            found="a ROS 1 bag",
            expected="CSV, a MATLAB file or a ROS 2 bag",
            remedy="convert it to a ROS 2 bag: `rosbags-convert`",
        )
    by_content = next((reader for start, reader in _HEADS.items() if head.startswith(start)), None)
    return by_content or _SUFFIXES.get(path.suffix.lower(), read_csv)


def with_columns(wanted: ImportDescription, data: Path, axis_names: Sequence[str]) -> ImportDescription:
    """Return a description with a column for each axis, where it names all of them at once.

    The columns of a bag may be joints; the section says which field is meant. A single column may be a whole field
    (`position`: its joints are called as the axes) or a whole matrix of a MATLAB file (`q`: a column for each axis).

    Raises:
        TableUnfit: a file is of a format that is not read, or a temperature is sought in a bag.
        ConfigurationInconsistent: torques are to be read from where the currents are.
    """
    changed: dict[str, Section] = {}
    bags = set[str]()
    for key, section in wanted.sections():
        reader = reader_of(data / section.file)
        if reader is read_bag:
            if isinstance(section, TemperatureColumns):
                raise TableUnfit(
                    str(data / section.file),
                    found="`temperature` from a ROS 2 bag",
                    expected=f"a file with temperatures; joint states have {', '.join(FIELDS)} alone",
                    remedy="leave `temperature` out of the import description, or name a CSV or MATLAB file with it",
                )
            bags.add(section.file)
            field = key if key in FIELDS else "effort"
            names = [str(column) for column in section.columns]
            if len(names) == 1 and names[0] in FIELDS:
                names = [f"{names[0]}.{axis}" for axis in axis_names]
            columns = [name if name.partition(".")[0] in FIELDS else f"{field}.{name}" for name in names]
            changed[key] = replace(section, columns=tuple(columns))
        elif reader is read_mat and len(section.columns) == 1 < len(axis_names):
            columns = [f"{section.columns[0]}.{number + 1}" for number in range(len(axis_names))]
            changed[key] = replace(section, columns=tuple(columns))
    whole = wanted.model_copy(update=changed)
    _check_torque(whole, bags)
    return whole


def _check_torque(wanted: ImportDescription, bags: Set[str]) -> None:
    """Refuse torques from the columns, or from the field of a bag, of the currents: their slope would be made up."""
    torque, current = wanted.torque, wanted.current
    if torque is None or Path(torque.file) != Path(current.file):
        return
    found, read = (
        [str(column).partition(".")[0] if torque.file in bags else column for column in section.columns]
        for section in (torque, current)
    )
    if shared := [str(column) for column in dict.fromkeys(found) if column in read]:
        raise ConfigurationInconsistent(
            f"import description {wanted.name!r}: torque.columns",
            found=f"{', '.join(shared)} of {torque.file}, which current is read from",
            expected="the controller's own torque, in columns (of a bag: in a field) of its own",
            remedy="name those columns, or leave `torque` out; no fit needs it",
        )
