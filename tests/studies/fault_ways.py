"""The ways of a recording with a planted fault to a fit: arrays, a native log, an import;
and what became of it.

Layout of the two recordings: a simulated cell with two runs without load and two with the disc, of
which one has the fault; and the TX-40's real one, which has a single run and is fitted with the
nameplate gains.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import bundle, load_cell
from daq.environment import shipped_configurations
from daq.errors import DaqError
from daq.log.conversion import load_run, scaling
from daq.log.importing import import_recording
from daq.log.metadata import AxisReadback, Readback, RunInfo
from daq.log.writer import LogContent, LogWriter
from drivers.messages import CellEvent, EventKind, Sample
from ident.arrays import FloatArray
from ident.data.channel_faults import ChannelKind
from ident.data.run import Run
from ident.errors import IdentificationError
from ident.estimators.diagnosis import diagnose
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from tests.studies.direct_cell import RawRun, run_of
from tests.studies.effect_runs import IMPORT
from tests.studies.planted_faults import PlantedFault, SoundChannel

DAMAGED_RUN = 1  #: Of the simulated cell: disc-1
#: Counts of the largest current of the real arm, as a drive of 16 bits might report it
INT16_LARGEST = 2000.0
STATUS = 0x1237  #: Of a drive in operation
PERIOD_NS = 1_000_000
BEGAN_NS = 1_770_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a recording."""

    #: largest of all axes; NaN for a real robot, and where nothing was fitted
    gain_error_percent: float
    error_percent: float  #: relative error of the fit; NaN where nothing was fitted
    said: tuple[str, ...]  #: names of the refusal or of what was diagnosed
    text: str  #: first message that names the axis; empty without one

    @property
    def is_refused(self) -> bool:
        """Whether there is no fit."""
        return bool(np.isnan(self.error_percent))

    def row(self) -> str:
        """The outcome in a cell of a table."""
        words = ", ".join(self.said) or "silent"
        if self.is_refused:
            return f"refused: {words}"
        if np.isnan(self.gain_error_percent):
            gain = ""
        else:
            gain = f"gain {self.gain_error_percent:.2f} %, "
        return f"{gain}error {self.error_percent:.2f} %; {words}"


class Heard(logging.Handler):
    """Warnings of an import or of a log that is read."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())


def outcome(
    fit: Callable[[], Identification],
    axis: str,
    cell: Cell,
    true_gains: FloatArray | None,
    given: FloatArray | None,
) -> Outcome:
    """Fit, and note what became of it.

    Args:
        fit: reads the runs and fits them.
        axis: that has the fault.
        cell: of the runs.
        true_gains: shape (m,); None of a real robot.
        given: gains that are held, shape (m,).
    """
    heard = Heard()
    logger = logging.getLogger("drivegain")
    logger.addHandler(heard)
    try:
        found = fit()
    except (DaqError, IdentificationError) as error:
        return Outcome(float("nan"), float("nan"), (type(error).__name__,), str(error))
    finally:
        logger.removeHandler(heard)
    diagnoses = diagnose(found, cell.axis_names, given)
    warned = [line for line in heard.lines if axis in line]
    said = [one.name for one in diagnoses if axis in one.axes] + ["warning"] * bool(warned)
    texts = [one.text for one in diagnoses if axis in one.axes] + warned
    gain_error = float("nan")
    if true_gains is not None:
        gain_error = 100.0 * float(np.max(np.abs(found.estimate.gains / true_gains - 1.0)))
    return Outcome(
        gain_error, found.training_error.total, tuple(dict.fromkeys(said)), next(iter(texts), "")
    )


# A simulated cell


def damaged_raw(
    raw: RawRun, cell: Cell, fault: PlantedFault, axis: int
) -> tuple[FloatArray, FloatArray]:
    """Positions [counts] and currents [raw] of a run with a fault, shape (k, n) each."""
    position = raw.position_counts.astype(np.float64)
    current = raw.current_raw.astype(np.float64)
    rate_hz = 1e9 / PERIOD_NS
    counts_per_revolution = cell.axes[axis].counts_per_revolution
    turn = float(counts_per_revolution or 0)
    if fault.quantity is ChannelKind.POSITION:
        sound_channel = SoundChannel(position[:, axis], 1.0, turn, rate_hz)
        position[:, axis] = fault.plant(sound_channel)
    else:
        absolute_current = np.abs(current[:, axis])
        largest = float(np.max(absolute_current))
        current[:, axis] = fault.plant(SoundChannel(current[:, axis], 1.0, largest, rate_hz))
    return position, current


def _readback(raw: RawRun, cell: Cell) -> Readback:
    answers = zip(cell.axis_names, raw.ampere_per_unit, strict=True)
    axes = tuple(AxisReadback(name, float(scale)) for name, scale in answers)
    return Readback(axes)


def as_arrays(raw: RawRun, cell: Cell, position: FloatArray, current: FloatArray, _: Path) -> Run:
    """The run as a user of `ident` would make it."""
    readback = _readback(raw, cell)
    scale = scaling(cell, readback)
    motor_rad = position * scale.rad_per_count
    position_rad = motor_rad @ scale.to_joint.T + scale.offset_rad
    return replace(
        run_of(raw, cell), position_rad=position_rad, current_a=current * scale.current_per_unit
    )


def as_log(raw: RawRun, cell: Cell, position: FloatArray, current: FloatArray, path: Path) -> Run:
    """The run through a log as the recorder writes it."""
    readback = _readback(raw, cell)
    rate_hz = 1e9 / PERIOD_NS
    info = RunInfo(raw.name, rate_hz, raw.payload, "", "damage study", BEGAN_NS, BEGAN_NS)
    demo_path = shipped_configurations() / "cells" / "demo.yaml"
    content = LogContent.of(cell, info, bundle(demo_path), readback)
    begun_ns = BEGAN_NS + round(1e9 * raw.began_s)
    move_steps = np.diff(raw.move, prepend=-1)
    starts = np.flatnonzero(move_steps)
    joint_position = scaling(cell, readback).joint_position_of
    with LogWriter(path, content, joint_position, clock_ns=lambda: 0) as log:
        for start in starts.tolist():
            stamp_ns = begun_ns + start * PERIOD_NS
            code = int(raw.move[start])
            event = CellEvent(stamp_ns, None, EventKind.MOVE_START, code, "")
            log.event(event)
        counts = position.astype(np.int64).tolist()
        units = current.astype(np.int64).tolist()
        for cycle, (own_counts, own_units) in enumerate(zip(counts, units, strict=True)):
            stamp_ns = begun_ns + cycle * PERIOD_NS
            status = (STATUS,) * len(own_counts)
            sample = Sample(cycle, stamp_ns, tuple(own_counts), tuple(own_units), status)
            log.write(sample)
        log.conclude(valid=True)
    return load_run(path)[0]


def as_import(
    raw: RawRun, cell: Cell, position: FloatArray, current: FloatArray, path: Path
) -> Run:
    """The run through a CSV file with stamps, motor counts and currents,
    as another controller exports it.
    """
    folder = path.parent
    name = path.stem
    names = [f"q{axis}" for axis in range(1, 7)]
    columns = [f"i{axis}" for axis in range(1, 7)]
    readback = _readback(raw, cell)
    scale = scaling(cell, readback)
    stamp_us = np.rint(1e6 * (BEGAN_NS * 1e-9 + raw.began_s)) + 1000.0 * np.arange(len(position))
    rows = np.column_stack(
        (stamp_us, position * scale.rad_per_count, current * scale.current_per_unit)
    )
    with (folder / f"{name}.csv").open("w", encoding="utf-8") as file:
        file.write(",".join(["stamp", *names, *columns]) + "\n")
        fmt = ["%d"] + ["%.9f"] * 12
        np.savetxt(file, rows, fmt=fmt, delimiter=",")
    positions = ", ".join(names)
    currents = ", ".join(columns)
    changed_import = IMPORT.replace("side: joint", "side: motor")
    text = changed_import.format(
        name=name,
        cell="demo.yaml",
        positions=positions,
        currents=currents,
        payload="null" if raw.payload is None else raw.payload.name,
    )
    description = folder / f"{name}.yaml"
    description.write_text(text, encoding="utf-8")
    cell_path = shipped_configurations() / "cells" / "demo.yaml"
    import_recording(description, folder, path, software="damage study", cell_path=cell_path)
    return load_run(path)[0]


WAYS: dict[str, Callable[[RawRun, Cell, FloatArray, FloatArray, Path], Run]] = {
    "arrays": as_arrays,
    "log": as_log,
    "import": as_import,
}


def simulated_outcome(
    raw: Sequence[RawRun], true_gains: FloatArray, fault: PlantedFault | None, axis: int, way: str
) -> Outcome:
    """Fit a simulated cell of whose runs one has a fault.

    Args:
        raw: its runs.
        true_gains: shape (m,).
        fault: None for none.
        axis: that has it.
        way: of WAYS, which every run takes.
    """
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)

    def fit() -> Identification:
        with tempfile.TemporaryDirectory() as name:
            runs = []
            for number, one in enumerate(raw):
                position = one.position_counts.astype(np.float64)
                current = one.current_raw.astype(np.float64)
                if fault is not None and number == DAMAGED_RUN:
                    position, current = damaged_raw(one, cell, fault, axis)
                # An undamaged log has nothing to show: only the damaged run takes the slow ways.
                if number == DAMAGED_RUN:
                    take = WAYS[way]
                else:
                    take = as_arrays
                run = take(one, cell, position, current, Path(name) / f"{one.name}.mcap")
                runs.append(replace(run, started_s=None))
        return identify(model_of(cell), runs, cell.conditioning, axes=cell.axis_names)

    return outcome(fit, cell.axis_names[axis], cell, true_gains, None)


# The TX-40


def tx40_outcome(folder: Path, fault: PlantedFault | None, axis: int, way: str) -> Outcome:
    """Fit the real recording with a fault, its gains held.

    Args:
        folder: of the recording.
        fault: None for none.
        axis: that has it.
        way: "arrays" or "import".
    """
    shipped = shipped_configurations()
    path = shipped / "cells" / "tx40.yaml"
    cell = load_cell(path)
    position = np.loadtxt(folder / "pos_read_data.csv", delimiter=",", skiprows=1)
    current = np.loadtxt(folder / "curr_data.csv", delimiter=",", skiprows=1)
    if fault is not None and fault.quantity is ChannelKind.POSITION:
        channel = SoundChannel(position[:, axis], _count(position[:, axis]), 2.0 * np.pi, 5000.0)
        position[:, axis] = fault.plant(channel)
    elif fault is not None:
        absolute_current = np.abs(current[:, axis])
        largest = float(np.max(absolute_current))
        sound_channel = SoundChannel(current[:, axis], largest / INT16_LARGEST, largest, 5000.0)
        current[:, axis] = fault.plant(sound_channel)

    def fit() -> Identification:
        nameplate_gains = [one.nameplate_gain for one in cell.axes]
        gains = np.array(nameplate_gains)
        if way == "arrays":
            ratio_inverse = np.linalg.inv(cell.ratio)
            joint_rad = position @ ratio_inverse.T
            zero_offset_rad = [one.zero_offset_rad for one in cell.axes]
            joint_rad += np.array(zero_offset_rad)
            time_s = np.arange(len(position)) / 5000.0
            run = Run("tx40", time_s, joint_rad, current)
        else:
            description = shipped / "imports" / "tx40.yaml"
            run = _imported_tx40(position, current, description)
        return identify(
            model_of(cell), (run,), cell.conditioning, fixed_gains=gains, axes=cell.axis_names
        )

    given = np.array([one.nameplate_gain for one in cell.axes])
    return outcome(fit, cell.axis_names[axis], cell, None, given)


def _imported_tx40(position: FloatArray, current: FloatArray, description: Path) -> Run:
    header = ",".join(f"Joint_{number}" for number in range(1, 7))
    with tempfile.TemporaryDirectory() as name:
        data = Path(name)
        for file, values in (("pos_read_data.csv", position), ("curr_data.csv", current)):
            np.savetxt(data / file, values, fmt="%.5g", delimiter=",", header=header, comments="")
        log = data / "tx40.mcap"
        import_recording(description, data, log, software="damage study")
        return load_run(log)[0]


def _count(values: FloatArray) -> float:
    """Smallest change of a channel."""
    steps = np.abs(np.diff(values))
    smallest_step = np.min(steps[steps > 1e-9 * np.ptp(values)])
    return float(smallest_step)
