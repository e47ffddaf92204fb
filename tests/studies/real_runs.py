"""Recordings of real robots for the studies, as runs: they are no part of the repository.

$DRIVEGAIN_DATA names their folder, ../shared/data beside the checkout by default. None has a
payload, so all gains are held at their nameplate values.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from daq.cli.app import main as drivegain
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.log.conversion import load_run
from ident.arrays import FloatArray, IntArray
from ident.data.run import Run

SHARED = Path(__file__).parents[3] / "shared" / "data"
KR300_RUNS = ("A", "B", "C")
UR10_TYPE = "sensor_msgs/msg/JointState"
UR10_PERIOD_S = 0.008
"""Its stamps are multiples of it to a nanosecond."""
UR10_FIT_SHARE = 0.6  #: Of its run, from the beginning; the rest is held out


@dataclass(frozen=True, slots=True)
class Recording:
    """Runs of one robot, and how they are cut.

    Attributes:
        name: in the tables.
        cell: as declared.
        runs: without load.
        stretch_s: length of the pieces that a split by region deals out [s]: some windows of the
            row filter.
        stretches_are_moves: they are in the split so far, too: moves of the usual length would be
            too few.
        parts: of a split as it was made so far.
        part_of: the part of each sample of each run in that split, shape (k,) each.
        left_out_whole: a run that the split so far leaves out as a whole; splits by region are of
            the others. Or empty.
    """

    name: str
    cell: Cell
    runs: tuple[Run, ...]
    stretch_s: float
    stretches_are_moves: bool
    parts: int
    part_of: tuple[IntArray, ...]
    left_out_whole: str = ""

    @property
    def gains(self) -> FloatArray:
        """Nameplate gains, shape (m,)."""
        nameplate_gains = [axis.nameplate_gain for axis in self.cell.axes]
        return np.array(nameplate_gains)


def data_folder() -> Path:
    """Folder of the recordings."""
    return Path(os.environ.get("DRIVEGAIN_DATA", SHARED))


def stretches(run: Run, stretch_s: float) -> IntArray:
    """Number of the stretch of each sample of a run, shape (k,)."""
    since_s = run.time_s - run.time_s[0]
    return np.asarray(np.floor(since_s / stretch_s + 1e-9), dtype=np.int64)


def tx40(folder: Path) -> Recording:
    """The TX-40: 9 s at 5 kHz; so far every fourth block of 0.5 s was left out."""
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "tx40.mcap"
        description = shipped_configurations() / "imports" / "tx40.yaml"
        drivegain(["import", str(description), "--data", str(folder / "tx40"), "--out", str(log)])
        run, cell = load_run(log)
    block_s = 0.5
    parts = 4
    part_of = (stretches(run, block_s) % parts,)
    return Recording("tx40", cell, (run,), block_s, True, parts, part_of)


def kr300(folder: Path, left_out: str) -> Recording:
    """The KR300: three runs of 20 s at 250 Hz; so far one of them was left out."""
    path = folder / "kr300" / "kr300-cell.yaml"
    cell = load_cell(path)
    runs = []
    for name in KR300_RUNS:
        table = np.loadtxt(folder / "kr300" / f"kr300_{name}.csv", delimiter=",")
        position_rad = np.deg2rad(table[:, 1:7])
        runs.append(Run(name, table[:, 0], position_rad, table[:, 7:13]))
    part_of = tuple(np.full(len(run.time_s), int(run.name != left_out)) for run in runs)
    return Recording(f"kr300-{left_out}", cell, tuple(runs), 1.0, False, 1, part_of, left_out)


def ur10(folder: Path) -> Recording:
    """The UR10: 27.5 s at 125 Hz from a ROS 2 bag; so far its last 40 % were left out."""
    path = folder / "ur10" / "ur10-cell.yaml"
    cell = load_cell(path)
    types = get_typestore(Stores.ROS2_HUMBLE)
    bag = folder / "ur10" / "ur10_exciting_trajectory.db3"
    with closing(sqlite3.connect(f"file:{bag}?mode=ro", uri=True)) as database:
        lines = database.execute("SELECT data FROM messages ORDER BY timestamp").fetchall()
    states: list[Any] = [types.deserialize_cdr(data, UR10_TYPE) for (data,) in lines]
    order = [states[0].name.index(axis) for axis in cell.axis_names]
    positions = [state.position for state in states]
    position = np.array(positions, dtype=np.float64)[:, order]
    efforts = [state.effort for state in states]
    effort = np.array(efforts, dtype=np.float64)[:, order]
    time_s = UR10_PERIOD_S * np.arange(len(states), dtype=np.float64)
    run = Run("ur10", time_s, position, effort)
    is_fit = np.arange(len(states)) < int(UR10_FIT_SHARE * len(states))
    part_of = (is_fit.astype(np.int64),)
    return Recording("ur10", cell, (run,), 1.0, False, 1, part_of)


RECORDINGS: dict[str, Callable[[Path], Recording]] = {
    "tx40": tx40,
    "kr300-A": lambda folder: kr300(folder, "A"),
    "kr300-B": lambda folder: kr300(folder, "B"),
    "kr300-C": lambda folder: kr300(folder, "C"),
    "ur10": ur10,
}
"""By name; the KR300's by the run that is left out."""
