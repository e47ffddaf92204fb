"""The current that a calibration predicts of the samples as they come,
with its band and the residual.

The filters are those of the fit, applied to the last samples: a low-pass without phase and central
differences for the positions, one decimator for predicted and measured current. A row is given once
all samples of its window are there, some 0.4 s later. At standstill, by the rule of the fit, there
is none: stiction hides any current below it.

The console draws the rows; `drivegain monitor` judges an axis by the last RECENT_S in which it
moved, and points it out if more than half of them are outside the band. A single row is outside
often enough: at each reversal the model's friction errs.

*Band.* Twice the root mean square of what the calibration left of the motor's current on its
held-out run (of the fit, without one). It is the size that residuals had, not a limit for alarms,
and as large for slow moves as for fast ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.errors import DaqError
from daq.log.feed import RunFacts
from daq.workflow.validate import (
    check_cell,
    conditioning_of,
    on_cell,
    unpredictable,
    warn_without_temperature,
)
from ident.arrays import FloatArray, IntArray
from ident.calibration import Calibration
from ident.data.conditioning import central_differences, current_rows, low_pass, torque_rows
from ident.data.dataset import moving_samples, planned
from ident.equations.rows import row_masks
from ident.errors import IdentificationError
from ident.model.bodies import Payload
from ident.model.robot import Motion
from ident.prediction import as_calibrated, measured_current, predict_current

#: Of a window, where the low-pass is not yet what it is over a whole run (to 2·10⁻⁵ at 40 Hz)
EDGE_S = 0.15
#: Samples that are predicted at once: each prediction costs 2 ms, and most of it is not for the
#: samples
STEP_S = 0.2
RECENT_S = 10.0  #: Of motion whose rows are judged together
LEAST_S = 2.0  #: Of motion before they are judged
#: Of the speed limit, where the calibration's filter has no standstill speeds
STANDSTILL_SHARE_OF_LIMIT = 0.01
LIVE = "the live motion"  #: Its name in errors and warnings


@dataclass(frozen=True, slots=True, eq=False)
class PredictedRows:
    """Decimated rows; NaN for a motor that is at standstill."""

    cycle: IntArray  #: number of the sample at the centre of the window, shape (r,)
    predicted: FloatArray  #: current reference [unit of the gains' current], shape (r, n)
    residual: FloatArray  #: measured minus predicted, both filtered, shape (r, n)
    band: FloatArray  #: half the band of each motor, shape (n,); inf where the calibration has none


@dataclass(frozen=True, slots=True)
class RecentCurrent:
    """Current of one motor lately [unit of the gains' current]."""

    #: filtered, at the last row; None at standstill, or where the scale is unknown
    measured: float | None
    predicted: float | None  #: at the same moment; None at standstill
    band: float | None  #: half the band; None where the calibration has none
    residual_rms: float | None  #: over the last RECENT_S of motion; None without any
    outside_share: float  #: share of these rows whose residual is outside the band
    conspicuous: bool  #: more than half of at least LEAST_S of motion are


class Recent:
    """Keeps the residual of each motor over the last RECENT_S in which it moved."""

    def __init__(self, rows_hz: float) -> None:
        self._kept = round(RECENT_S * rows_hz)
        self._least = LEAST_S * rows_hz
        self._last: PredictedRows | None = None
        self._moving: list[FloatArray] = []

    def add(self, rows: PredictedRows) -> None:
        """Take the newest rows."""
        new = [column[np.isfinite(column)] for column in rows.residual.T]
        old = self._moving or [np.zeros(0)] * len(new)
        all_moving = map(np.concatenate, zip(old, new, strict=True))
        self._moving = [moving[-self._kept :] for moving in all_moving]
        self._last = rows

    def axes(self) -> list[RecentCurrent]:
        """Return the current of each motor; empty without rows."""
        if self._last is None:
            return []
        currents = []
        for index, moving in enumerate(self._moving):
            predicted = float(self._last.predicted[-1][index])
            residual = float(self._last.residual[-1][index])
            band = float(self._last.band[index])
            share = 0.0
            residual_rms = None
            if len(moving):
                share = float(np.mean(np.abs(moving) > band))
                residual_rms = float(np.sqrt(np.mean(moving**2)))
            current = RecentCurrent(
                measured=_finite(predicted + residual),
                predicted=_finite(predicted),
                band=_finite(band),
                residual_rms=residual_rms,
                outside_share=share,
                conspicuous=share > 0.5 and len(moving) >= self._least,
            )
            currents.append(current)
        return currents


def _finite(value: float) -> float | None:
    """Return a number, None for one that is unknown (NaN or infinite)."""
    return value if math.isfinite(value) else None


class Predictor:
    """Predicts one run; the samples come in order, in blocks of any length."""

    def __init__(
        self, calibration: Calibration, cell: Cell, payload: Payload | None, rate_hz: float
    ) -> None:
        """Check that the calibration knows the cell and what is mounted.

        Raises:
            CalibrationUnreadable, LogsDiffer: see `daq.workflow.validate`.
            DataUnfit: the calibration was given another mass of this payload.
            ModelError: the model of the cell is not that of the calibration.
        """
        check_cell(calibration, cell.folder or Path(cell.name), cell)
        #: Why nothing is predicted, empty if it is
        self.problem = unpredictable(calibration, payload)
        self._payload = as_calibrated(calibration, payload, LIVE)
        warn_without_temperature(calibration, LIVE, None)
        self._calibration, self._model = on_cell(calibration, cell)
        self._conditioning = conditioning_of(calibration)
        self._rate_hz = rate_hz
        self._filter = current_rows(rate_hz, self._conditioning)
        self._torque_filter = torque_rows(rate_hz, self._conditioning)
        edge = round(EDGE_S * rate_hz)
        self.rows_hz = rate_hz / self._filter.factor
        self._step = max(1, round(STEP_S * rate_hz))
        self._margin = self._filter.half + -(-edge // self._filter.factor) * self._filter.factor
        limits = [STANDSTILL_SHARE_OF_LIMIT * axis.limits.velocity for axis in cell.axes]
        self._still = np.array(self._conditioning.standstill_rad_s or limits)
        # Calibrations of earlier versions do not say what they left
        self._band = np.full(len(cell.axes), np.inf)
        if calibration.current_residual is not None:
            self._band = 2.0 * np.array(calibration.current_residual)
        self._cycle = -1
        self._position = np.zeros((0, 0))
        self._current = np.zeros((0, 0))

    def take(
        self, cycle: IntArray, position_rad: FloatArray, current: FloatArray
    ) -> list[PredictedRows]:
        """Take samples in their order; returns the rows that are complete now.

        Args:
            cycle: of each sample, shape (k,); a gap begins a new window.
            position_rad: joint positions [rad; m of a prismatic joint], shape (k, n).
            current: of the motors, shape (k, n).

        Raises:
            IdentificationError: the calibration cannot predict this motion.
        """
        gaps = np.flatnonzero(np.diff(cycle) != 1) + 1
        edges = [0, *gaps.tolist(), len(cycle)]
        complete = []
        for begin, end in pairwise(edges):
            if end <= begin:
                continue
            rows = self._take(int(cycle[begin]), position_rad[begin:end], current[begin:end])
            if rows is not None:
                complete.append(rows)
        return complete

    def _take(
        self, cycle: int, position_rad: FloatArray, current: FloatArray
    ) -> PredictedRows | None:
        following = self._cycle + len(self._position)
        if cycle != following or not len(self._position):
            self._cycle = cycle
            self._position = position_rad
            self._current = current
        else:
            self._position = np.concatenate((self._position, position_rad))
            self._current = np.concatenate((self._current, current))
        usable = len(self._position) - 2 - 2 * self._margin
        if self.problem or usable < self._step:
            return None
        found = self._predict()
        # The next window begins so that its first whole row follows the last one of this.
        next_row = found.cycle[-1] + self._filter.factor
        done = next_row - self._cycle - 1 - self._margin
        self._cycle += done
        self._position = self._position[done:]
        self._current = self._current[done:]
        return found

    def _predict(self) -> PredictedRows:
        rate_hz = self._rate_hz
        settings = self._conditioning
        raw = np.ascontiguousarray(self._position.T)
        smooth = low_pass(raw, rate_hz, settings.position_cutoff_hz, settings.position_order)
        position, velocity, acceleration = central_differences(smooth, rate_hz)
        motion = Motion(position.T, velocity.T, acceleration.T)
        # A recorded motion: what the calibration corrects of recordings, as a late position, is
        # wrong with it too.
        data = replace(planned(motion, rate_hz, self._payload), is_planned=False)
        current = self._current[1:-1]
        predicted_a = predict_current(self._calibration, self._model, data)
        measured_a = measured_current(self._calibration, self._model, current, motion)
        predicted = self._torque_filter(predicted_a.T)
        measured = self._filter(measured_a.T)
        count = position.shape[1]
        centres = self._filter.centres(count)
        whole = (centres >= self._margin) & (centres < count - self._margin)
        moving, motor_moving = moving_samples(velocity, self._still, self._model.drive_train)
        data = replace(data, moving=moving.T, motor_moving=motor_moving.T)
        _, use = row_masks(self._model, data, settings)
        predicted = np.where(use[:, whole], predicted[:, whole], np.nan)
        residual = measured[:, whole] - predicted
        cycle = self._cycle + 1 + centres[whole]
        return PredictedRows(cycle, predicted.T, residual.T, self._band)


def predictor_of(
    calibration: Calibration, cell: Cell, run: RunFacts
) -> tuple[Predictor | None, str]:
    """Return the predictor of a run, and why it predicts nothing, empty if it does."""
    if run.axes != cell.axis_names:
        return None, "no prediction: the run has other axes than the cell file"
    payloads = {declared.name: declared.payload for declared in reversed(cell.payloads)}
    payload = None if run.payload is None else payloads.get(run.payload)
    try:
        passed_hz = conditioning_of(calibration).position_cutoff_hz
        if run.rate_hz < 2.0 * passed_hz:
            return None, (
                f"no prediction: {run.rate_hz:.3g} positions a second are too few for velocity and "
                f"acceleration; the fit's filter passes {passed_hz:g} Hz"
            )
        found = Predictor(calibration, cell, payload, run.rate_hz)
    except (DaqError, IdentificationError) as error:
        return None, f"no prediction: {error}"
    return found, found.problem
