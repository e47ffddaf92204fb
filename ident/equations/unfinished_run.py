"""Rows of a recording that still goes on: each is made once, as soon as no later sample changes it.

A row depends on samples before and after its own instant: on those in the window of the decimator,
and through the zero-phase low-pass of the positions on those around them. So the newest rows of a
recording wait for further samples, and the samples before a new row are filtered again with it.
What is left of the border is then below 1e-7 of the signal: the impulse response of the low-pass
decays as exp(−2π sin(π/2N) f t) for order N and cut-off f (Oppenheim & Schafer, Discrete-Time
Signal Processing, §7.2), with N = 4 by a factor of 1e8 in SETTLED_PERIODS/f.

Where no standstill speed is declared, it is derived from the new part alone
(`ident.data.dataset.standstill_speed`), and the rows may differ from those of the same run read at
its end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from ident.arrays import BoolArray
from ident.data.conditioning import Conditioning, current_rows
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.equations.rows import Rows, row_filter, row_masks, rows_of
from ident.errors import DataUnfit
from ident.model.model import Model

#: Periods of the position filter's cut-off after which a border no longer shows
SETTLED_PERIODS = 8.0
SHORTEST_S = 2.01
"""Shortest part that is filtered, and a window of the decimator:
`differentiate` refuses less than 2 s.
"""


@dataclass(frozen=True, slots=True)
class RunProgress:
    """How far a run was made into rows."""

    name: str  #: of the run
    #: Sampling rate when it began. It decides the number of taps of the decimator, and stays: later
    #: samples change the mean rate in its last digits, and 82.5 samples are rounded up or down.
    rate_hz: float
    rows: int  #: number of rows made of it, from its beginning
    is_complete: bool  #: no sample of it follows


@dataclass(frozen=True, slots=True)
class NewRows:
    """Rows that a run has given since the last call."""

    progress: RunProgress  #: with these rows
    #: Part of the run that the rows come from, and the rows piece by piece; None where no new row
    #: counts.
    built: tuple[Dataset, tuple[Rows, ...]] | None
    continues_move: bool = False  #: the first of them belong to the move of the last ones before


def new_rows(
    model: Model,
    run: Run,
    conditioning: Conditioning,
    before: RunProgress | None,
    *,
    is_complete: bool,
) -> NewRows:
    """Build the rows of a run that were not made before and that no later sample changes.

    Args:
        model: the declared model.
        run: the samples so far, from the first one on.
        conditioning: the filters.
        before: of the same run; None where it begins.
        is_complete: no sample follows, so the last rows need not wait.

    Raises:
        DataUnfit: see `differentiate`. An unfinished run that is too short is no error: it gives no
            rows yet.
    """
    samples = len(run.time_s)
    if before is None:
        if samples < 3:
            raise DataUnfit(
                run.name, f"{samples} samples; expected at least 3, for a sampling rate"
            )
        before = RunProgress(run.name, run.rate_hz, rows=0, is_complete=False)
    filter_ = current_rows(before.rate_hz, conditioning)
    settled = ceil(SETTLED_PERIODS * before.rate_hz / conditioning.position_cutoff_hz)
    shortest = ceil(SHORTEST_S * before.rate_hz) + len(filter_.taps)
    if samples < shortest and not is_complete:
        return NewRows(before, None)
    waiting = settled
    if is_complete:
        waiting = 0
    # Central differences leave the first and the last sample out.
    end = filter_.rows(samples - 2 - waiting)
    if end <= before.rows and before.rows:
        return NewRows(replace(before, is_complete=is_complete), None)
    with_context = before.rows - ceil(settled / filter_.factor)
    long_enough = (samples - shortest) // filter_.factor
    first = max(min(with_context, long_enough), 0)
    part = _samples_from(run, first * filter_.factor)
    data = differentiate(part, model.drive_train, conditioning)
    data = replace(data, rate_hz=before.rate_hz)
    row_filter(data, conditioning)  # refuses a run that is too short for it
    use, motor_use = row_masks(model, data, conditioning)
    rows = np.arange(first, first + use.shape[1])
    is_new = (rows >= before.rows) & (rows < end)
    progress = replace(before, rows=end, is_complete=is_complete)
    if not np.any(use & is_new):
        return NewRows(progress, None)  # every joint rests
    pieces = _only_new(model, data, conditioning, is_new)
    move = data.move[filter_.centres(len(data.time_s))]
    counts = motor_use.any(axis=0)
    moves_before = move[counts & (rows < before.rows)]
    moves_now = move[counts & is_new]
    continues_move = False
    if len(moves_before) and len(moves_now):
        continues_move = bool(moves_before[-1] == moves_now[0])
    return NewRows(progress, (data, pieces), continues_move)


def _samples_from(run: Run, first: int) -> Run:
    """Return a run without its first samples."""
    later = slice(first, None)
    part = replace(
        run,
        time_s=run.time_s[later],
        position_rad=run.position_rad[later],
        current_a=run.current_a[later],
    )
    if run.move is not None:
        part = replace(part, move=run.move[later])
    if run.valid is not None:
        part = replace(part, valid=run.valid[later])
    if run.temperature_c is not None:
        part = replace(part, temperature_c=run.temperature_c[later])
    return part


def _only_new(
    model: Model, data: Dataset, conditioning: Conditioning, is_new: BoolArray
) -> tuple[Rows, ...]:
    """Build the rows of a part, in which only the new ones count."""
    pieces = []
    first = 0
    for rows in rows_of(model, data, conditioning):
        end = first + len(rows.time_s)
        counts = is_new[first:end]
        use = rows.use & counts
        motor_use = rows.motor_use & counts
        pieces.append(replace(rows, use=use, motor_use=motor_use))
        first = end
    return tuple(pieces)
