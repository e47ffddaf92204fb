"""The folder of a fleet's calibrations: what stands there and is of the same logs needs no second fit."""

from __future__ import annotations

import hashlib
import json
import re
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path

from daq.atomic_file import replace_file
from daq.configuration.yaml_file import MAX_BYTES
from daq.errors import OutputExists, OutputFailed
from daq.fleet.cell_fit import Fitted, Loop
from daq.fleet.summary import Summary, summary_document, summary_from
from daq.fleet.survey import CellLogs
from daq.regular_file import read_regular
from daq.version import software

STATE_VERSION = 1
FORMAT = "drivegain-fleet-state"


@dataclass(frozen=True, slots=True)
class Shelf:
    """A calibration file a cell, and beside each a small JSON file that says what it was made of.

    Attributes:
        folder: made already.
        loop: what is wanted of every cell.
    """

    folder: Path
    loop: Loop

    def file(self, cell: CellLogs) -> Path:
        """Of a cell's calibration: its name, as far as a file may have it, and the beginning of the digest."""
        name = re.sub(r"[^\w.-]", "_", cell.cell)[:40]
        return self.folder / f"{name}-{cell.configuration_sha256[:12]}.yaml"

    def standing(self, cell: CellLogs) -> tuple[Summary, float] | None:
        """What is told of the calibration of these logs, and the seconds that it took; None where it is not there.

        The file itself is not parsed: it is the one that was written, by its digest.

        Raises:
            OutputExists: there is something that no calibration, or no note beside it, can replace.
        """
        file = self.file(cell)
        for path in (file, _state(file)):
            _check_replaceable(path)
        try:
            # No pipe is waited for, and no file of somebody else fills the memory: neither is ours.
            state = json.loads(read_regular(_state(file), MAX_BYTES))
            found = hashlib.sha256(read_regular(file, MAX_BYTES)).hexdigest()
            if (state["format"], state["inputs_sha256"], state["calibration_sha256"]) != (
                FORMAT,
                self._inputs(cell),
                found,
            ):
                return None
            return summary_from(state["summary"]), float(state["seconds"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None  # whatever it is, it is made anew

    def keep(self, cell: CellLogs, fitted: Fitted) -> Path:
        """Put a calibration there; a kill at any point leaves what stands whole, or what is made anew.

        Raises:
            OutputFailed: the file system refuses.
        """
        file = self.file(cell)
        state = {
            "format": FORMAT,
            "inputs_sha256": self._inputs(cell),
            "calibration_sha256": hashlib.sha256(fitted.content).hexdigest(),
            "seconds": fitted.seconds,
            "summary": summary_document(fitted.summary),
        }
        for path, content in ((file, fitted.content), (_state(file), json.dumps(state, indent=1).encode())):
            try:
                replace_file(path, content)
            except OSError as error:
                raise OutputFailed.of(path, error) from error
        return file

    def _inputs(self, cell: CellLogs) -> str:
        """Digest of all that decides a calibration: software, options, configuration, logs and their roles."""
        logs = [
            (role, Path(seen.log.name).name, seen.fingerprint, seen.mounting)
            for role, several in (("fit", cell.fit), ("holdout", cell.holdout))
            for seen in several
        ]
        decisive = (STATE_VERSION, software(), self.loop.value, cell.cell, cell.configuration_sha256, logs)
        return hashlib.sha256(json.dumps(decisive).encode()).hexdigest()


def open_shelf(folder: Path, loop: Loop) -> Shelf:
    """Make the folder, and see that files can be put there.

    Raises:
        OutputExists: it is no folder.
        OutputFailed: the file system refuses.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputExists(str(folder), found="a file", expected="a folder, or none", remedy="choose another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    return Shelf(folder, loop)


def _check_replaceable(path: Path) -> None:
    """Refuse a folder, and a link to a device or a pipe: a link is followed, and what it leads to would be replaced."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return  # there is nothing, or who writes it will be told
    if stat.S_ISDIR(mode):
        found = "a folder"
    elif path.is_symlink() and not stat.S_ISREG(mode):
        found = "a link to something that is no regular file"
    else:
        return
    raise OutputExists(
        str(path),
        found=found,
        expected="a file that an earlier fleet has left, or none",
        remedy="move it away, or choose another folder",
    )


def _state(file: Path) -> Path:
    return file.with_suffix(".json")
