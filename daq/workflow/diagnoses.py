"""One judgement of recordings for `fit`, `residual`, `validate`, `report` and `daq.fit_logs`.

`diagnose_fit` judges the logs of a fit, and `diagnose_run` a log that a calibration has not seen: a held-out one, or
one that is validated. A calibration keeps what was said of its fit, so its report and its validation say the same.

The order of the judgements, causes before their traces:

1. Each log as it is read: currents without a sign (`ident.estimators.diagnosis.require_explained_currents`).
2. What leaves no usable number (`ident.estimators.refusals.refuse_mistakes`): a payload that does not show; with fixed
   gains its weight and the signs of the currents; errors; exchanged roles; units. Where one of these refuses, or the
   estimator does not converge, its causes are looked for in the logs: currents without a sign, exchanged currents.
3. What is named (`ident.estimators.diagnosis.diagnose`): gains, estimators, payloads, errors, torques, condition.
4. The same causes, where 3. named a trace of them, or the gains are fixed.
5. Zeros and lengths that the encoders contradict (`daq.workflow.geometry`), where there are more of them than degrees
   of freedom: found before any torque is looked at, and named first.
6. Each held-out log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.config.cell import Cell, model_of, robot_of
from daq.workflow.geometry import geometry_diagnoses
from ident.arrays import BoolArray, FloatArray
from ident.calibration import Calibration
from ident.data.run import Run
from ident.equations.reduction import Reduction
from ident.errors import ChannelsExchanged, Diagnosis, ModelContradicted, NotConverged, PayloadUnseen
from ident.estimators.diagnosis import (
    axis_error_diagnoses,
    diagnose,
    exchanged_channels,
    scale_diagnoses,
    unsigned_channels,
)
from ident.estimators.identify import Identification
from ident.estimators.payload_diagnosis import payload_diagnoses
from ident.estimators.refusals import idle_joints
from ident.model.base import BaseParameters
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.model.urdf import read_urdf
from ident.prediction import mounted_parameters, standard_parameters

if TYPE_CHECKING:  # which asks for these diagnoses
    from daq.workflow.validate import Validation
    from ident.estimators.geometry import GeometryFinding

ReadLog = Callable[[Path], tuple[Run, Cell]]  #: Reads a log, and the description of its cell

TRACES_OF_CURRENTS = {"axis-error", "current-reversed", "gain-off-nameplate"}
"""Diagnoses that exchanged currents, or currents without a sign, may leave. Fixed gains need not leave any."""


def diagnose_fit(
    found: Identification,
    cell: Cell,
    logs: Sequence[Path],
    read: ReadLog,
    geometry: GeometryFinding | None = None,
    *,
    corrected: bool = False,
) -> tuple[Diagnosis, ...]:
    """Judge a fit by the recordings that it has used.

    Args:
        found: with all effects.
        cell: description of its cell.
        logs: of the fit; read again where exchanged currents, or currents without a sign, are looked for.
        read: reads a log as the fit did.
        geometry: what the encoders say of the geometry; None for a robot without redundant ones.
        corrected: the fit is one with the corrected geometry.

    Raises:
        PayloadUnseen, ModelContradicted: a mistake leaves no usable number.
        CurrentUnsigned: drives report the size of their currents only.
    """
    nameplate = np.array([axis.nameplate_gain for axis in cell.axes])
    effort_limit = read_urdf(cell.urdf).effort_limit[list(robot_of(cell).axis_joints)]
    # Each held-out run is judged alone, as in a validation.
    diagnoses = diagnose(replace(found, holdout=None), cell.axis_names, nameplate, effort_limit)
    suspect = any(one.name in TRACES_OF_CURRENTS for one in diagnoses)
    if suspect or found.estimate.gains_fixed:
        require_right_currents(logs, read, each=suspect)
    return (*geometry_diagnoses(geometry, cell, applied=corrected), *diagnoses)


def diagnose_run(
    calibration: Calibration, validation: Validation, model: Model, run: Run, reduction: Reduction
) -> tuple[Diagnosis, ...]:
    """Judge a run that the fit of a calibration has not seen: scale and sign of its currents, its payload, its errors.

    Args:
        calibration: of the cell.
        validation: what it predicts of the run, and what was measured.
        model: of the cell.
        run: as it was read.
        reduction: of this run alone.
    """
    runs = (run.name,)
    axes = [gain.axis for gain in calibration.gains]
    use = validation.use
    size = _rms(validation.measured_nm, use)
    left = _rms(validation.measured_nm - validation.predicted_nm, use)
    idle = idle_joints(model, size, left)
    used = use & ~idle[:, None]
    found = list(scale_diagnoses(validation.measured_nm, validation.predicted_nm, used, axes, runs))
    if run.payload is not None and not found:
        found += _payload_diagnoses(calibration, run.payload, model, reduction)
    errors = list(axis_error_diagnoses(size, left, idle, axes, runs))
    exchanged = exchanged_channels(model, (run,), reduction.conditioning, axes) if errors else None
    if exchanged is not None:
        return (replace(exchanged, runs=runs),)
    return tuple(found or errors)


def _rms(torque_nm: FloatArray, use: BoolArray) -> FloatArray:
    """Root mean square of each axis over its rows that count, shape (m,); zero without any."""
    rows = np.maximum(use.sum(axis=1), 1)
    return np.asarray(np.sqrt(np.sum(torque_nm**2, axis=1, where=use) / rows))


def _payload_diagnoses(
    calibration: Calibration, payload: Payload, model: Model, reduction: Reduction
) -> Iterator[Diagnosis]:
    """Compare the payload of a run with that of its mounting in the calibration."""
    mounted = mounted_parameters(calibration, payload.mounting)
    unknown = tuple(
        index
        for index, parameter in enumerate(LINK_PARAMETERS)
        if parameter not in payload.known and parameter in mounted
    )
    names = tuple(column.name for column in model.columns)
    every = BaseParameters(tuple(range(len(names))), np.eye(len(names)), names)
    of_payload = [mounted[LINK_PARAMETERS[index]].value for index in unknown]
    values = np.concatenate((standard_parameters(calibration, model), of_payload))
    gains = np.array([gain.value for gain in calibration.gains])
    return payload_diagnoses(reduction.system(every, (unknown,)), gains, values)


def not_repeated(stored: Iterable[Diagnosis], fresh: Iterable[Diagnosis]) -> Iterator[Diagnosis]:
    """Yield stored diagnoses, less those that were made again of each of their runs."""
    again: set[tuple[str, str, tuple[str, ...]]] = set()
    for one in fresh:
        again.update((one.name, run, one.axes) for run in one.runs)
    for one in stored:
        of_runs = {(one.name, run, one.axes) for run in one.runs}
        if not of_runs or not of_runs <= again:
            yield one


# Currents as the cause


@contextmanager
def currents_as_cause(logs: Sequence[Path], read: ReadLog) -> Iterator[None]:
    """Name wrong currents where a fit is refused for what they leave; arguments as for `diagnose_fit`.

    Raises:
        CurrentUnsigned, ChannelsExchanged: see `require_right_currents`.
    """
    try:
        yield
    except ChannelsExchanged:
        raise
    except (ModelContradicted, NotConverged, PayloadUnseen):
        require_right_currents(logs, read)
        raise


def require_right_currents(logs: Sequence[Path], read: ReadLog, *, each: bool = True) -> None:
    """Refuse logs with currents without a sign, or with exchanged ones; they are read again.

    Args:
        logs, read: as for `diagnose_fit`.
        each: look for an exchange in each log alone, too.

    Raises:
        CurrentUnsigned: drives report the size of the current only.
        ChannelsExchanged: the currents of some axes are each other's.
    """
    _, cell = read(logs[0])
    runs = [read(log)[0] for log in logs]
    unsigned = unsigned_channels(model_of(cell), runs, cell.conditioning, cell.axis_names)
    if unsigned is not None:
        raise unsigned
    require_own_channels(logs, read, each=each)


def require_own_channels(logs: Sequence[Path], read: ReadLog, *, each: bool = True) -> None:
    """Refuse logs in which the currents of some axes are each other's; they are read again.

    Args:
        logs, read: as for `diagnose_fit`.
        each: look into each log alone, too: in one of several, an exchange is hidden by the others.

    Raises:
        ChannelsExchanged: they are, in all logs together or in one of them.
    """
    alone = [(log,) for log in logs] if each and len(logs) > 1 else []
    for part in (tuple(logs), *alone):
        found = _exchange_in(part, read)
        if found is not None:
            where = f"log {part[0].stem}: " if part in alone else ""
            subject = f"{where}the currents of {' and '.join(found.axes)}"
            raise ChannelsExchanged(subject, found=found.found, expected=found.expected, remedy=found.remedy)


def _exchange_in(logs: Sequence[Path], read: ReadLog) -> Diagnosis | None:
    """Whether the currents of some axes are each other's in these logs together."""
    first, declared = read(logs[0])
    runs = chain((first,), (read(log)[0] for log in logs[1:]))
    return exchanged_channels(model_of(declared), runs, declared.conditioning, declared.axis_names)
