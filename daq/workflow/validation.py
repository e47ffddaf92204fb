"""A run under a calibration: what was measured beside what the calibration predicts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.estimators.estimate import RelativeError, relative_error


class DataUse(Enum):
    """Whether a calibration has met a log, by the log's digest."""

    FIT = "seen by the fit"
    HOLDOUT = "held out"
    NEW = "not seen"


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """One run under a calibration; arrays are joint-first, decimated rows last."""

    log: Path  #: where the run was read
    run: str  #: its name
    digest: str  #: of the log (sha256, hex)
    data_use: DataUse  #: whether the fit has seen it
    same_configuration: bool  #: the log carries the cell configuration that the calibration was made with
    partial: bool  #: the log was salvaged from a recording that never finished
    time_s: FloatArray  #: of each row, since the start of the run, shape (r,)
    measured_nm: FloatArray  #: V g with the calibration's gains, shape (n, r)
    predicted_nm: FloatArray  #: what the calibration says the joints need, shape (n, r)
    use: BoolArray  #: rows of each joint that count, shape (n, r)

    @property
    def error(self) -> RelativeError:
        """‖ρ‖/‖Y‖ of each axis and in total [%]."""
        return relative_error(self.measured_nm, self.predicted_nm, self.use)

    @property
    def is_judged(self) -> bool:
        """Whether the fit has used the run and judged it, all of its runs together."""
        return self.data_use is DataUse.FIT and self.same_configuration

    @property
    def rows(self) -> int:
        """Equations that count, of all joints."""
        return int(np.count_nonzero(self.use))
