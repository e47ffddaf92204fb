"""One judgement of recordings for `fit`, `residual`, `validate`, `report` and `daq.fit_logs`.

`diagnose_fit` judges the logs of a fit, and `diagnose_run` a log that a calibration has not seen: a held-out one, or
one that is validated. A calibration keeps what was said of its fit, so its report and its validation say the same.

The order of the judgements, causes before their traces:

1. Each log as it is read: currents without a sign (`ident.estimators.diagnosis.require_explained_currents`).
2. What leaves no usable number (`ident.estimators.refusals.refuse_mistakes`): a payload that does not show; with fixed
   gains its weight and the signs of the currents; errors; exchanged roles; units. Where one of these refuses, or the
   estimator does not converge, its causes are looked for in the logs: the geometry, currents without a sign, exchanged
   currents.
3. The geometry of every fit (`ident.estimators.turned_geometry`): gravity, and the sense of each position. Nothing else
   is said of a fit in a wrong geometry, because all of it would be wrong.
4. What is named (`ident.estimators.diagnosis.diagnose`): gains, estimators, payloads, errors, torques, condition.
5. Currents without a sign and exchanged ones, where 4. named a trace of them, or the gains are fixed.
6. Zeros and lengths that the encoders contradict (`daq.workflow.geometry_diagnoses`), where there are more of them than
   degrees of freedom: found before any torque is looked at, and named first.
7. Small mistakes of the description (`daq.workflow.description`): zeros, mounting and late positions, by torque. They
   are named before 4. to 6., and where they are, no exchange of currents is looked for (`daq.workflow.fit.judged`).
8. Each held-out log; first whether the geometry has changed since the fit (`ident.geometry_drift`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.advice import for_command_line
from daq.config.cell import Cell, model_of, robot_of
from daq.workflow.description import drift_diagnosis
from daq.workflow.geometry_diagnoses import geometry_diagnoses
from daq.workflow.validation import Validation
from ident.arrays import BoolArray, FloatArray
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.instants import Instants, read_instants
from ident.equations.reduction import regrouped
from ident.equations.system import System
from ident.errors import (
    ChannelsExchanged,
    Diagnosis,
    EffectImpossible,
    GeometryTurned,
    ModelContradicted,
    NotConverged,
    PayloadUnseen,
)
from ident.estimators.diagnosis import (
    axis_error_diagnoses,
    diagnose,
    exchanged_channels,
    scale_diagnoses,
    unsigned_channels,
)
from ident.estimators.estimate import Identification
from ident.estimators.payload_diagnosis import payload_diagnoses
from ident.estimators.refusals import idle_joints
from ident.estimators.turned_geometry import GEOMETRY, find_turned_geometry, is_confirmed
from ident.geometry_drift import geometry_drift
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.model.urdf import read_urdf
from ident.prediction import as_calibrated, mounted_parameters, standard_parameters

if TYPE_CHECKING:  # which asks for these diagnoses
    from ident.estimators.geometry_estimate import GeometryFinding

ReadLog = Callable[[Path], tuple[Run, Cell]]  #: Reads a log, and the description of its cell

CHANNELS_AS_WIRED = "--channels-as-wired"  #: Option of `fit` and `residual` with which no exchange is looked for
TRACES_OF_CURRENTS = {"axis-error", "current-reversed", "gain-off-nameplate"}
"""Diagnoses that exchanged currents, or currents without a sign, may leave. Fixed gains need not leave any."""


@dataclass(frozen=True, slots=True)
class Recordings:
    """The logs of a fit and how it used them: they are read again where a cause is looked for."""

    logs: tuple[Path, ...]
    read: ReadLog  #: reads a log as the fit did
    gains_fixed: bool  #: the fit holds the nameplate gains
    channels_as_wired: bool = False  #: the operator says that no currents are exchanged

    def runs(self) -> Iterator[Run]:
        """One run after the other."""
        for log in self.logs:
            yield self.read(log)[0]


def diagnose_fit(
    found: Identification,
    cell: Cell,
    recordings: Recordings,
    instants: Sequence[Instants],
    geometry: GeometryFinding | None = None,
    *,
    corrected: bool = False,
) -> tuple[Diagnosis, ...]:
    """Judge a fit by the recordings that it has used.

    Args:
        found: with all effects.
        cell: description of its cell.
        recordings: of the fit.
        instants: a few rows of each; taken from the logs where there are none.
        geometry: what the encoders say of the geometry; None for a robot without redundant ones.
        corrected: the fit is one with the corrected geometry.

    Raises:
        PayloadUnseen, ModelContradicted: a mistake leaves no usable number.
        CurrentUnsigned: drives report the size of their currents only.
    """
    nameplate = nameplate_of(cell)
    turned = turned_geometry(recordings, instants, found.training_error.total)
    if turned is not None:
        return (turned,)
    effort_limit = read_urdf(cell.urdf).effort_limit[list(robot_of(cell).axis_joints)]
    # Each held-out run is judged alone, as in a validation.
    named = diagnose(replace(found, holdout=None), cell.axis_names, nameplate, effort_limit)
    diagnoses = tuple(map(_for_command_line, named))
    suspect = any(one.name in TRACES_OF_CURRENTS for one in diagnoses)
    if suspect or found.estimate.gains_fixed:
        require_right_currents(recordings, each=suspect)
    return (*geometry_diagnoses(geometry, cell, applied=corrected), *diagnoses)


def nameplate_of(cell: Cell) -> FloatArray:
    """Nameplate gain of each axis, shape (m,)."""
    return np.array([axis.nameplate_gain for axis in cell.axes])


def diagnose_run(
    calibration: Calibration,
    validation: Validation,
    model: Model,
    run: Run,
    standard: System,
    conditioning: Conditioning,
) -> tuple[Diagnosis, ...]:
    """Judge a run that the fit of a calibration has not seen: scale and sign of its currents, its payload, its errors.

    Args:
        calibration: of the cell.
        validation: what it predicts of the run, and what was measured.
        model: of the cell.
        run: as it was read.
        standard: equations of this run alone, in standard parameters (`reduce_runs`).
        conditioning: the filters.
    """
    if any(one.name in GEOMETRY for one in calibration.diagnoses):
        return ()  # it predicts in a wrong geometry
    runs = (run.name,)
    axes = [gain.axis for gain in calibration.gains]
    use = validation.use
    carried = replace(run, payload=as_calibrated(calibration, run.payload, run.name))
    data = differentiate(carried, model.drive_train, conditioning)
    left_nm = validation.measured_nm - validation.predicted_nm
    moved = geometry_drift(calibration, model, data, conditioning, left_nm, use)
    if moved is not None:
        return (drift_diagnosis(moved, model, axes, runs),)
    size = _rms(validation.measured_nm, use)
    left = _rms(left_nm, use)
    idle = idle_joints(model, size, left)
    used = use & ~idle[:, None]
    found = list(scale_diagnoses(validation.measured_nm, validation.predicted_nm, used, axes, runs))
    if run.payload is not None and not found:
        found += _payload_diagnoses(calibration, run.payload, standard)
    errors = list(map(_for_command_line, axis_error_diagnoses(size, left, idle, axes, runs)))
    if not errors and not any(one.name == "current-reversed" for one in found):
        return tuple(found)
    gains = np.array([gain.value for gain in calibration.gains])
    turned = find_turned_geometry(model, read_instants(model, (run,), conditioning), gains)
    if turned is not None:
        return (turned.diagnosis(axes, runs),)
    exchanged = exchanged_channels(model, (run,), conditioning, axes) if errors else None
    if exchanged is not None:
        return (replace(exchanged, runs=runs),)
    return tuple(found or errors)


def _for_command_line(diagnosis: Diagnosis) -> Diagnosis:
    """The same diagnosis with a remedy that names verbs and options."""
    return replace(diagnosis, remedy=for_command_line(diagnosis.remedy))


def _rms(torque_nm: FloatArray, use: BoolArray) -> FloatArray:
    """Root mean square of each axis over its rows that count, shape (m,); zero without any."""
    rows = np.maximum(use.sum(axis=1), 1)
    return np.asarray(np.sqrt(np.sum(torque_nm**2, axis=1, where=use) / rows))


def _payload_diagnoses(calibration: Calibration, payload: Payload, standard: System) -> Iterator[Diagnosis]:
    """Compare the payload of a run with that of its mounting in the calibration."""
    mounted = mounted_parameters(calibration, payload.mounting)
    unknown = tuple(
        index
        for index, parameter in enumerate(LINK_PARAMETERS)
        if parameter not in payload.known and parameter in mounted
    )
    of_payload = [mounted[LINK_PARAMETERS[index]].value for index in unknown]
    values = np.concatenate((standard_parameters(calibration, standard.model), of_payload))
    gains = np.array([gain.value for gain in calibration.gains])
    return payload_diagnoses(regrouped(standard, standard.base, (unknown,)), gains, values)


def not_repeated(stored: Iterable[Diagnosis], fresh: Iterable[Diagnosis]) -> Iterator[Diagnosis]:
    """Yield stored diagnoses, less those that were made again of each of their runs."""
    again: set[tuple[str, str, tuple[str, ...]]] = set()
    for one in fresh:
        again.update((one.name, run, one.axes) for run in one.runs)
    for one in stored:
        of_runs = {(one.name, run, one.axes) for run in one.runs}
        if not of_runs or not of_runs <= again:
            yield one


# Causes in the logs


@contextmanager
def named_causes(recordings: Recordings) -> Iterator[None]:
    """Name a wrong geometry or wrong currents where a fit is refused for what they leave.

    Raises:
        GeometryTurned: gravity or a position points elsewhere than declared.
        CurrentUnsigned, ChannelsExchanged: see `require_right_currents`.
    """
    try:
        yield
    except (ChannelsExchanged, GeometryTurned):
        raise
    except (EffectImpossible, ModelContradicted, NotConverged, PayloadUnseen):
        turned = turned_geometry(recordings, (), None)
        if turned is not None:
            raise GeometryTurned(
                ", ".join(turned.axes) or "the mounting",
                found=turned.found,
                expected=turned.expected,
                remedy=turned.remedy,
            ) from None
        require_right_currents(recordings)
        raise


def turned_geometry(
    recordings: Recordings, instants: Sequence[Instants], error_percent: float | None
) -> Diagnosis | None:
    """Another geometry that explains recordings clearly better, confirmed by a fit of all rows; None without any.

    Args:
        recordings: of the fit.
        instants: a few rows of each; taken from the logs where there are none.
        error_percent: of the fit as declared; None where it was refused.
    """
    _, cell = recordings.read(recordings.logs[0])
    model = model_of(cell)
    nameplate = nameplate_of(cell)
    rows = instants or read_instants(model, recordings.runs(), cell.conditioning)
    turned = find_turned_geometry(model, rows, nameplate)
    if turned is None or not is_confirmed(
        turned,
        model,
        recordings.runs(),
        cell.conditioning,
        nameplate,
        gains_fixed=recordings.gains_fixed,
        before_percent=error_percent,
    ):
        return None
    return turned.diagnosis(cell.axis_names)


def require_right_currents(recordings: Recordings, *, each: bool = True) -> None:
    """Refuse logs with currents without a sign, or with exchanged ones; they are read again.

    Args:
        recordings: of the fit.
        each: look for an exchange in each log alone, too.

    Raises:
        CurrentUnsigned: drives report the size of the current only.
        ChannelsExchanged: the currents of some axes are each other's.
    """
    _, cell = recordings.read(recordings.logs[0])
    runs = list(recordings.runs())
    unsigned = unsigned_channels(model_of(cell), runs, cell.conditioning, cell.axis_names)
    if unsigned is not None:
        raise unsigned
    if not recordings.channels_as_wired:
        require_own_channels(recordings, each=each)


def require_own_channels(recordings: Recordings, *, each: bool = True) -> None:
    """Refuse logs in which the currents of some axes are each other's; they are read again.

    Args:
        recordings: of the fit.
        each: look into each log alone, too: in one of several, an exchange is hidden by the others.

    Raises:
        ChannelsExchanged: they are, in all logs together or in one of them.
    """
    logs = recordings.logs
    alone = [(log,) for log in logs] if each and len(logs) > 1 else []
    for part in (logs, *alone):
        found = _exchange_in(part, recordings.read)
        if found is not None:
            where = f"log {part[0].stem}: " if part in alone else ""
            subject = f"{where}the currents of {' and '.join(found.axes)}"
            remedy = f"{found.remedy}; if they are right as they are, pass {CHANNELS_AS_WIRED}"
            raise ChannelsExchanged(subject, found=found.found, expected=found.expected, remedy=remedy)


def _exchange_in(logs: Sequence[Path], read: ReadLog) -> Diagnosis | None:
    """Whether the currents of some axes are each other's in these logs together."""
    first, declared = read(logs[0])
    runs = chain((first,), (read(log)[0] for log in logs[1:]))
    return exchanged_channels(model_of(declared), runs, declared.conditioning, declared.axis_names)
