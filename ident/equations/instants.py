"""A few rows of a recording: a motion and the currents that made it,
for hypotheses about the model itself.

A hypothesis that changes the geometry needs columns of its own. Some hundred rows of a run are
enough to see a gross mistake, and cost little to build again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray, as_array, require_kind
from ident.data.conditioning import Conditioning, current_rows
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.equations.rows import row_masks
from ident.model.model import Model
from ident.model.robot import Motion, each_state

ROWS_OF_RUN = 450  #: Rows taken of a run


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """Evenly spaced rows of a run, decimated as those of a fit."""

    motion: Motion  #: of the axes, shape (k, m)
    current_a: FloatArray  #: of the motors, shape (m, k)
    use: BoolArray  #: rows of each motor that count, shape (m, k)
    move: IntArray  #: number of each row's move within the run, shape (k,)
    mounting: str | None  #: of the payload; None without load

    def require_axes(self, count: int) -> None:
        """Refuse rows that are not of so many axes.

        Raises:
            ModelError: for a field of another type or shape.
        """
        remedy = "give `Identification.instants`"
        require_kind("motion of the instants", self.motion, Motion, remedy)
        if self.mounting is not None:
            require_kind("mounting of the instants", self.mounting, str, remedy)
        position_rad = as_array("position_rad of the instants", self.motion.position_rad)
        rows = len(np.atleast_1d(position_rad))
        expected = {
            "position_rad": (position_rad, (rows, count)),
            "current_a": (self.current_a, (count, rows)),
            "use": (self.use, (count, rows)),
            "move": (self.move, (rows,)),
        }
        for name, (values, shape) in expected.items():
            as_array(f"{name} of the instants", values, shape, remedy)

    def every(self, step: int) -> Instants:
        """Every so many of the rows."""
        motion = each_state(self.motion, lambda states: np.ascontiguousarray(states[::step]))
        return Instants(
            motion=motion,
            current_a=self.current_a[:, ::step],
            use=self.use[:, ::step],
            move=self.move[::step],
            mounting=self.mounting,
        )


def instants_of(model: Model, data: Dataset, conditioning: Conditioning) -> Instants | None:
    """Take evenly spaced rows of a run; None where the run is too short to decimate,
    or no row counts.

    The motion is filtered in place of the columns: it is slow enough for that where no number of a
    fit depends on it.

    Args:
        model: the declared model.
        data: a differentiated run.
        conditioning: the filters.
    """
    filter_ = current_rows(data.rate_hz, conditioning)
    samples = len(data.time_s)
    count = filter_.rows(samples)
    if count < 1:
        return None
    _, motor_use = row_masks(model, data, conditioning)
    step = ceil(count / ROWS_OF_RUN)
    use = motor_use[:, ::step]
    if not use.any():
        return None

    def at_every_row(states: FloatArray) -> FloatArray:
        """Decimate a state of the axes to every so many of the rows, time first."""
        rows = filter_(states.T)
        return np.ascontiguousarray(rows[:, ::step].T)

    motion = each_state(data.motion(), at_every_row)
    current_a = filter_(data.current_a.T)
    move = data.move[filter_.centres(samples)]
    mounting = None
    if data.payload is not None:
        mounting = data.payload.mounting
    return Instants(
        motion=motion,
        current_a=current_a[:, ::step],
        use=use,
        move=move[::step],
        mounting=mounting,
    )


def read_instants(
    model: Model, runs: Iterable[Run], conditioning: Conditioning
) -> tuple[Instants, ...]:
    """Take rows of runs, which are read one after the other; arguments as for `instants_of`.

    Raises:
        DataUnfit: as of `ident.data.dataset.differentiate`.
    """
    found = list[Instants]()
    for run in runs:
        data = differentiate(run, model.drive_train, conditioning)
        instants = instants_of(model, data, conditioning)
        if instants is not None:
            found.append(instants)
    return tuple(found)
