"""A calibration put to the test: what it predicts of a run, compared with what was measured,
under the filter of the fit.

Several calibrations are compared on runs that they may never have seen (paper §4.3, Tables 5 to 8).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np

from daq.arguments import PATHS, checks_arguments, of_kind, optional
from daq.config.cell import Cell, model_of
from daq.config.same_cell import GRAVITY as GRAVITY_SECTION
from daq.config.same_cell import differing_zeros, require_cell_of
from daq.errors import CalibrationUnreadable, LogsDiffer
from daq.log.conversion import load_run
from daq.workflow.diagnoses import DIAGNOSED_AS, drift_diagnosis, with_verbs
from daq.workflow.geometry_diagnoses import calibrated_model
from ident.arrays import BoolArray, FloatArray
from ident.calibration import AcceptedEffect, Calibration
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.data.run_channels import (
    channels_of,
    clip_diagnoses,
    fault_diagnoses,
    require_usable_channels,
    still_diagnoses,
)
from ident.effects.dictionary import GEOMETRY as CORRECTION_FAMILIES
from ident.effects.effect import PlacedEffect
from ident.effects.friction import TemperatureFriction
from ident.effects.geometry_corrections import (
    GravityDirection,
    ZeroOffset,
    turn_between,
    turned_gravity,
)
from ident.effects.signals import REFERENCE_C
from ident.equations.instants import read_instants
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.rows import row_filter, row_masks, torques_at_rows
from ident.equations.system import System
from ident.errors import DataUnfit, Diagnosis, IdentificationError, ModelError
from ident.estimators.diagnosis import axis_error_diagnoses, exchanged_channels, scale_diagnoses
from ident.estimators.estimate import RelativeError, relative_error
from ident.estimators.least_squares import wls
from ident.estimators.payload_diagnosis import payload_diagnoses
from ident.estimators.refusals import idle_joints
from ident.estimators.turned_geometry import GEOMETRY, find_turned_geometry
from ident.geometry_drift import geometry_drift
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.prediction import (
    as_calibrated,
    fitted_model,
    measured_torque,
    mounted_parameters,
    other_body,
    placed_effect,
    predict_torque,
    standard_parameters,
)
from ident.weighing import RowsToWeigh, rows_to_weigh, weigh_rows

_LOG = logging.getLogger("drivegain")

CORRECTIONS = frozenset(family[0].name for family in CORRECTION_FAMILIES)
"""Names of effects that correct the description."""


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
    #: the log carries the cell configuration that the calibration was made with
    same_configuration: bool
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


@checks_arguments(calibration=of_kind(Calibration), logs=PATHS, cell=optional(of_kind(Cell)))
def validate(
    calibration: Calibration, logs: Sequence[Path | str], cell: Cell | None = None
) -> tuple[Validation, ...]:
    """Predict every log with a calibration.

    Args:
        calibration: with the filter of its fit.
        logs: of the calibration's cell, at any date.
        cell: corrected description of the same cell, which replaces the one in the logs.

    Raises:
        UsageError: an argument is of another type.
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell.
        CalibrationUnreadable: the calibration does not say its filter.
        IdentificationError: the calibration cannot speak of this run: unknown mounting, effect or
            parameter.
    """
    conditioning_of(calibration)  # refuses a calibration without a filter before any log is read
    validations: list[Validation] = []
    corrections = Corrections()
    for log in map(Path, logs):
        run, described = load_run(log, cell)
        corrections.note(log, run)
        check_cell(calibration, log, described)
        warn_without_temperature(calibration, run.name, run.temperature_c)
        validations.append(predicted(calibration, described, log, run))
    return tuple(validations)


def together(validations: Sequence[Validation]) -> RelativeError:
    """‖ρ‖/‖Y‖ over the rows of several runs [%];
    of the logs of the fit, it is the fit's own figure.
    """
    measured_nm = [validation.measured_nm for validation in validations]
    predicted_nm = [validation.predicted_nm for validation in validations]
    use = [validation.use for validation in validations]
    return relative_error(
        np.concatenate(measured_nm, axis=1),
        np.concatenate(predicted_nm, axis=1),
        np.concatenate(use, axis=1),
    )


def conditioning_of(calibration: Calibration) -> Conditioning:
    """The filters of the fit: a relative error may be compared under the same ones only.

    Raises:
        CalibrationUnreadable: they are not all there.
    """
    try:
        return calibration.conditioning
    except ModelError as error:
        numbers = sorted(Conditioning().document().keys() - {"standstill_rad_s"})
        settings = [f"{name}: {value}" for name, value in calibration.filter.items()]
        wanted = ", ".join(numbers)
        raise CalibrationUnreadable(
            f"calibration of cell {calibration.cell!r}, filter",
            found=", ".join(settings) or "nothing",
            expected=f"a list standstill_rad_s and numbers {wanted}",
            remedy="fit the logs again with this drivegain",
        ) from error


def check_cell(calibration: Calibration, log: Path, cell: Cell) -> None:
    """Refuse a log of another cell.

    Raises:
        LogsDiffer: it is one.
    """
    require_cell_of(
        calibration,
        cell,
        LogsDiffer,
        str(log),
        remedy="give logs of that cell, or the calibration of this one",
    )


def unpredictable(calibration: Calibration, payload: Payload | None) -> str:
    """Why a calibration says nothing of a run with this payload; empty where it does."""
    if payload is None:
        return ""
    known = other_body(calibration, payload)
    if known:
        return (
            f"payload {payload.name!r} is not predicted: on mounting {payload.mounting!r} the "
            f"calibration knows {known}"
        )
    if set(payload.known) == set(LINK_PARAMETERS):
        return ""
    if "m" not in payload.known:
        return f"payload {payload.name!r} is not predicted: the log leaves its mass open"
    if not mounted_parameters(calibration, payload.mounting):
        return (
            f"payload {payload.name!r} is not predicted: nothing is known of mounting "
            f"{payload.mounting!r}"
        )
    return ""


def predicted(calibration: Calibration, described: Cell, log: Path, run: Run) -> Validation:
    """One run under one calibration.

    Args:
        calibration: of the cell.
        described: the cell, as the log or another description has it.
        log: where the run was read.
        run: as it was read.

    Raises:
        CalibrationUnreadable: the calibration does not say its filter.
        IdentificationError: the calibration cannot speak of this run.
    """
    conditioning = conditioning_of(calibration)
    calibration, model = on_cell(calibration, described)
    warn_of_corrections(calibration, run.name, described.digest)
    run = replace(run, payload=as_calibrated(calibration, run.payload, run.name))
    data = differentiate(run, model.drive_train, conditioning)
    filter_ = row_filter(data, conditioning)
    use, _ = row_masks(model, data, conditioning)
    if not use.any():
        raise DataUnfit(
            data.name, "no row is left after the standstill and validity masks; did the robot move?"
        )
    centres = filter_.centres(len(data.time_s))
    torque_nm = measured_torque(calibration, model, data.current_a, data.motion())
    predicted_nm = predict_torque(calibration, model, data)
    return Validation(
        log=log,
        run=run.name,
        digest=run.digest,
        data_use=data_use(calibration, run),
        same_configuration=described.digest == calibration.configuration_sha256,
        partial=run.partial,
        time_s=data.time_s[centres] - data.time_s[0],
        measured_nm=filter_(torque_nm.T),
        predicted_nm=torques_at_rows(data, conditioning, predicted_nm.T),
        use=use,
    )


def data_use(calibration: Calibration, run: Run) -> DataUse:
    """Whether a calibration has met a run."""
    roles = {source.role for source in calibration.sources if source.sha256 == run.digest}
    if "fit" in roles:
        return DataUse.FIT
    return DataUse.HOLDOUT if "holdout" in roles else DataUse.NEW


def warn_of_fitted(
    calibration: Calibration, runs: Sequence[Run], consequence: str
) -> tuple[str, ...]:
    """Warn of runs that the fit has seen, and name them."""
    seen = tuple(run.name for run in runs if data_use(calibration, run) is DataUse.FIT)
    if seen:
        verb = "were" if len(seen) > 1 else "was"
        _LOG.warning(
            "%s %s part of the fit: %s",
            ", ".join(seen),
            verb,
            consequence,
        )
    return seen


def warn_of_corrections(calibration: Calibration, name: str, configuration_sha256: str) -> None:
    """Warn of a run with another description of the cell than the fit,
    where the calibration corrects the description.

    A zero that was corrected in the cell file since would be corrected twice.
    """
    if configuration_sha256 == calibration.configuration_sha256:
        return
    # What a calibration knows of the description of its fit, `on_cell` has compared.
    unknown = [
        one for one in calibration.effects if one.name in CORRECTIONS and one.described is None
    ]
    corrected = [f"{one.name} on {one.axis}" for one in unknown]
    if corrected:
        _LOG.warning(
            "%s has another description of the cell than the fit, which the calibration corrects "
            "(%s): if the cell file was corrected since, calibrate anew",
            name,
            ", ".join(corrected),
        )


def warn_without_temperature(
    calibration: Calibration, name: str, temperature_c: FloatArray | None
) -> None:
    """Warn of a run without the temperatures, shape (k, n),
    that an effect of the calibration depends on.
    """
    axes = [gain.axis for gain in calibration.gains]
    for effect in calibration.effects:
        # Without such an axis, the prediction refuses the effect.
        if effect.name != TemperatureFriction.name or effect.axis not in axes:
            continue
        if temperature_c is None or np.isnan(temperature_c[:, axes.index(effect.axis)]).any():
            _LOG.warning(
                "%s has no temperature of %s: its friction is predicted at %g °C",
                name,
                effect.axis,
                REFERENCE_C,
            )


NAMEPLATE_LABEL = "manufacturer"  #: Label of the nameplate gains, a key of documents that stays


@dataclass(frozen=True, slots=True)
class Mass:
    """A payload's mass found with one set of gains."""

    mass_kg: float  #: found [kg]
    std_percent: float  #: σ from the scatter of the moves, the gains taken as exact [% of the mass]
    std_with_gains_percent: float  #: the same with the errors of the calibration
    error_percent: float | None  #: |found − weighed|/weighed [%], None where it was not weighed


@dataclass(frozen=True, slots=True)
class CheckedRun:
    """One run under every calibration."""

    log: Path  #: where it was read
    run: str  #: its name
    #: Of its weighted observation matrix, None where the run alone does not show the base
    #: parameters.
    condition: float | None
    #: ‖ρ‖/‖Y‖ by label of the calibration; calibrations that cannot predict the run are not in it.
    errors: dict[str, RelativeError]
    left_out: str  #: why some of them cannot, empty where all can
    seen_by: tuple[str, ...]  #: labels of calibrations whose fit has seen it


@dataclass(frozen=True, slots=True)
class WeighedRun:
    """One loaded run, and the mass of its payload by label of the gains."""

    log: Path
    run: str
    payload: Payload
    weighed_kg: float | None
    masses: dict[str, Mass | str]  #: or why there is none


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """All figures of the tables of §4.3."""

    axes: tuple[str, ...]  #: their names
    calibrations: dict[str, Calibration]  #: by label
    runs: tuple[CheckedRun, ...]  #: in the order of the logs
    weighed: tuple[WeighedRun, ...]  #: those with a payload
    with_bare_runs: bool  #: the payloads were found together with the robot, from runs without load
    #: of the first calibration, for the runs that it can predict
    validations: tuple[Validation, ...]
    diagnoses: tuple[Diagnosis, ...]  #: of these runs under the first calibration, and of its fit


def cross_validate(
    calibrations: Mapping[str, Calibration], logs: Sequence[Path], cell: Cell | None = None
) -> CrossValidation:
    """Test calibrations on logs; each log is read once.

    Args:
        calibrations: by label, made under one filter; the first one is what is being validated.
        logs: of their cell, without load or with any payload.
        cell: corrected description of the same cell, which replaces the one in the logs.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell, or a calibration was made under another filter.
        IdentificationError: a calibration contradicts the cell or a run.
    """
    first = next(iter(calibrations))
    conditioning = _common_conditioning(calibrations)
    runs = []
    bare = []
    loaded = []
    validations = []
    diagnoses: list[Diagnosis] = []
    corrections = Corrections()
    for log in logs:
        run, described = load_run(log, cell)
        corrections.note(log, run)
        first_own, model = on_cell(calibrations[first], described)
        found, reasons = _predictions(calibrations, described, log, run)
        if first in found:
            validations.append(found[first])
        condition = None
        standard = None
        with suppress(IdentificationError):
            standard = _standard_system(first_own, model, run, conditioning)
            condition = _condition(calibrations[first], standard)
        if standard is not None and first in found and not found[first].is_judged:
            suspected = replaced_geometry(first_own, run, described)
            diagnoses += diagnose_run(
                first_own, found[first], model, run, standard, conditioning, suspected
            )
        if run.payload is not None:
            # From the log, else from the cell, since a body weighs the same anywhere.
            kg = run.payload.known.get("m", _declared_mass(described, run.payload.name))
            loaded.append((log, run, run.payload, kg))
        elif standard is not None:
            bare.append(run)
        errors = {label: validation.error for label, validation in found.items()}
        seen_by = [label for label, v in found.items() if v.data_use is DataUse.FIT]
        runs.append(
            CheckedRun(
                log=log,
                run=run.name,
                condition=condition,
                errors=errors,
                left_out=_left_out(reasons, len(calibrations)),
                seen_by=tuple(seen_by),
            )
        )
    of_cell_now = {}
    for label, calibration in calibrations.items():
        of_cell_now[label], _ = on_cell(calibration, described)
    weighed = []
    for log, run, payload, kg in loaded:
        rows: RowsToWeigh | str
        try:
            rows = rows_to_weigh(model, (run,), conditioning, bare=bare)
        except IdentificationError as error:
            rows = str(error)
        masses = _masses(of_cell_now, rows, kg)
        weighed.append(WeighedRun(log, log.stem, payload, kg, masses))
    stored = not_repeated(not_corrected_since(calibrations[first], described), diagnoses)
    axes = tuple(gain.axis for gain in calibrations[first].gains)
    return CrossValidation(
        axes=axes,
        calibrations=dict(calibrations),
        runs=tuple(runs),
        weighed=tuple(weighed),
        with_bare_runs=bool(bare),
        validations=tuple(validations),
        diagnoses=(*diagnoses, *stored),
    )


def _common_conditioning(calibrations: Mapping[str, Calibration]) -> Conditioning:
    """Return the conditioning that all calibrations were made with.

    Raises:
        LogsDiffer: one was made with another.
    """
    first, *others = calibrations
    conditioning = conditioning_of(calibrations[first])
    for label in others:
        calibration = calibrations[label]
        if conditioning_of(calibration) != conditioning:
            raise LogsDiffer(
                f"calibration {label}",
                found=f"the filter {calibration.filter}",
                expected=f"that of {first}: {calibrations[first].filter}",
                remedy="a relative error can be compared under one filter only: fit both with one "
                "cell file",
            )
    return conditioning


def _predictions(
    calibrations: Mapping[str, Calibration], described: Cell, log: Path, run: Run
) -> tuple[dict[str, Validation], dict[str, list[str]]]:
    """Return what each calibration predicts of a run, and why the others predict nothing,
    by label and by reason.
    """
    found: dict[str, Validation] = {}
    reasons: dict[str, list[str]] = {}
    for label, calibration in calibrations.items():
        check_cell(calibration, log, described)
        warn_without_temperature(calibration, run.name, run.temperature_c)
        reason = unpredictable(calibration, run.payload)
        if reason:
            reasons.setdefault(reason, []).append(label)
        else:
            found[label] = predicted(calibration, described, log, run)
    return found, reasons


def _declared_mass(cell: Cell, payload: str) -> float | None:
    """Return the mass of a payload by the cell file; None where it does not have it."""
    for body in cell.payloads:
        if body.name == payload:
            return body.mass_kg
    return None


def _left_out(reasons: Mapping[str, Sequence[str]], count: int) -> str:
    """Say why calibrations were not checked, naming them where they are not all of them."""
    texts = []
    for reason, labels in reasons.items():
        if len(labels) < count:
            names = ", ".join(labels)
            texts.append(f"{reason} ({names})")
        else:
            texts.append(reason)
    return "; ".join(texts)


def _standard_system(
    calibration: Calibration, model: Model, run: Run, conditioning: Conditioning
) -> System:
    """Equations of one run in standard parameters,
    of the description as the calibration corrects it.
    """
    return reduce_runs(fitted_model(calibration, model), (run,), conditioning)


def _condition(calibration: Calibration, standard: System) -> float:
    """Condition of the weighted observation matrix of a run."""
    # A payload without columns of its own is part of the link that carries it.
    system = regrouped(standard, payload_columns=((),) * len(standard.payloads))
    return wls(system, _gains(calibration)).condition


def diagnose_log(
    calibration: Calibration, log: Path, run: Run, described: Cell
) -> tuple[Diagnosis, ...]:
    """Judge a log that the fit of a calibration has not seen, as `cross_validate` does.

    Args:
        calibration: of the cell.
        log: where the run was read.
        run: as it was read.
        described: the cell, as the log or another description has it.
    """
    if unpredictable(calibration, run.payload):
        return ()
    validation = predicted(calibration, described, log, run)
    calibration, model = on_cell(calibration, described)
    conditioning = conditioning_of(calibration)
    with suppress(IdentificationError):
        standard = _standard_system(calibration, model, run, conditioning)
        suspected = replaced_geometry(calibration, run, described)
        return diagnose_run(calibration, validation, model, run, standard, conditioning, suspected)
    return ()


def _masses(
    calibrations: Mapping[str, Calibration], rows: RowsToWeigh | str, kg: float | None
) -> dict[str, Mass | str]:
    first = next(iter(calibrations.values()))
    nameplate = [gain.nameplate for gain in first.gains]
    sets = dict(calibrations)
    has_nameplate = any(_gains(one).tolist() == nameplate for one in sets.values())
    if isinstance(rows, RowsToWeigh) and rows.bare and not has_nameplate:
        entered = tuple(replace(gain, value=gain.nameplate, std=0.0) for gain in first.gains)
        sets = {NAMEPLATE_LABEL: replace(first, gains=entered, covariance_factor=None), **sets}
    masses: dict[str, Mass | str] = {}
    for label, calibration in sets.items():
        if isinstance(rows, str):
            masses[label] = rows
            continue
        try:
            found = weigh_rows(calibration, rows)
        except IdentificationError as error:
            masses[label] = str(error)
            continue
        mass = found.mass_kg
        if np.isnan(mass):
            masses[label] = (
                "these moves do not distinguish the payload's mass from its other parameters"
            )
            continue
        std_kg = float(np.sqrt(found.moves_covariance[-1, -1]))
        error_percent = None if kg is None else 100.0 * abs(mass - kg) / kg
        masses[label] = Mass(
            mass_kg=mass,
            std_percent=100.0 * std_kg / abs(mass),
            std_with_gains_percent=100.0 * found.mass_std_kg / abs(mass),
            error_percent=error_percent,
        )
    return masses


def _gains(calibration: Calibration) -> FloatArray:
    return np.array([gain.value for gain in calibration.gains])


def diagnose_run(
    calibration: Calibration,
    validation: Validation,
    model: Model,
    run: Run,
    standard: System,
    conditioning: Conditioning,
    suspected: Sequence[PlacedEffect] = (),
) -> tuple[Diagnosis, ...]:
    """Judge a run that the fit of a calibration has not seen:
    scale and sign of its currents, its payload, its errors.

    Args:
        calibration: of the cell.
        validation: what it predicts of the run, and what was measured.
        model: of the cell.
        run: as it was read.
        standard: equations of this run alone, in standard parameters (`reduce_runs`).
        conditioning: the filters.
        suspected: of `replaced_geometry`.

    Raises:
        CurrentConstant: a motor moves, and its current has one value.
        ReadingsDamaged: readings are none, and nothing mends them.
    """
    if any(one.name in GEOMETRY for one in calibration.diagnoses):
        return ()  # it predicts in a wrong geometry
    runs = (run.name,)
    axes = [gain.axis for gain in calibration.gains]
    use = validation.use
    carried = replace(run, payload=as_calibrated(calibration, run.payload, run.name))
    data = differentiate(carried, model.drive_train, conditioning)
    left_nm = validation.measured_nm - validation.predicted_nm
    moved = geometry_drift(calibration, model, data, conditioning, left_nm, use, suspected)
    if moved is not None:
        return (drift_diagnosis(moved, model, axes, runs, is_given=moved.placed in suspected),)
    size = _rms(validation.measured_nm, use)
    left = _rms(left_nm, use)
    idle = idle_joints(model, size, left)
    used = use & ~idle[:, None]
    channels = (channels_of(model, data),)
    require_usable_channels(channels[0], axes)
    damaged = tuple(fault_diagnoses(channels, axes))
    of_channels = (*still_diagnoses(channels, axes), *damaged, *clip_diagnoses(channels, axes))
    found = list(scale_diagnoses(validation.measured_nm, validation.predicted_nm, used, axes, runs))
    if run.payload is not None and not found:
        found += _payload_diagnoses(calibration, run.payload, standard)
    errors = list(map(with_verbs, axis_error_diagnoses(size, left, idle, axes, runs)))
    is_right = not errors and not any(one.name == "current-reversed" for one in found)
    if is_right or of_channels:  # a fault of a channel is the cause of the others
        return (*of_channels, *(found or errors))
    turned = find_turned_geometry(
        model, read_instants(model, (run,), conditioning), _gains(calibration)
    )
    if turned is not None:
        return (turned.diagnosis(axes, runs),)
    if errors:
        exchanged = exchanged_channels(model, (run,), conditioning, axes)
    else:
        exchanged = None
    if exchanged is not None:
        return (replace(exchanged, runs=runs),)
    return tuple(found or errors)


def replaced_geometry(
    calibration: Calibration, run: Run, described: Cell
) -> tuple[PlacedEffect, ...]:
    """Return the corrections of zeros and gravity that a given description makes in that of a log.

    There are none where the calibration was made with the given description: it predicts in the
    same geometry.

    Args:
        calibration: that predicts.
        run: as it was read.
        described: the given description.
    """
    if (
        run.recording is None
        or described.recording_digest == calibration.recording_configuration_sha256
    ):
        return ()
    sections = run.recording.corrected
    axes = described.axis_names
    replaced = [PlacedEffect(ZeroOffset(), axes.index(name)) for name in differing_zeros(sections)]
    if GRAVITY_SECTION in sections:
        replaced.append(PlacedEffect(GravityDirection(), 0))
    return tuple(replaced)


def _rms(torque_nm: FloatArray, use: BoolArray) -> FloatArray:
    """Root mean square of each axis over its rows that count, shape (m,); zero without any."""
    rows = np.maximum(use.sum(axis=1), 1)
    square = np.sum(torque_nm**2, axis=1, where=use)
    return np.asarray(np.sqrt(square / rows))


def _payload_diagnoses(
    calibration: Calibration, payload: Payload, standard: System
) -> Iterator[Diagnosis]:
    """Compare the payload of a run with that of its mounting in the calibration."""
    mounted = mounted_parameters(calibration, payload.mounting)
    unknown = []
    of_payload = []
    for index, parameter in enumerate(LINK_PARAMETERS):
        if parameter not in payload.known and parameter in mounted:
            unknown.append(index)
            of_payload.append(mounted[parameter].value)
    of_links = standard_parameters(calibration, standard.model)
    values = np.concatenate((of_links, of_payload))
    system = regrouped(standard, standard.base, (tuple(unknown),))
    return payload_diagnoses(system, _gains(calibration), values)


def not_repeated(stored: Iterable[Diagnosis], fresh: Iterable[Diagnosis]) -> Iterator[Diagnosis]:
    """Yield stored diagnoses, less those that were made again of each of their runs."""
    again: set[tuple[str, str, tuple[str, ...]]] = set()
    for one in fresh:
        again.update((one.name, run, one.axes) for run in one.runs)
    for one in stored:
        of_runs = {(one.name, run, one.axes) for run in one.runs}
        if not of_runs or not of_runs <= again:
            yield one


# A search corrects what the cell file says of zeros and of the mounting
# (`ident.effects.geometry_corrections`), and tells the operator to correct the cell file. Once that
# is done, a calibration of before must not correct the same number again: it keeps how the number
# was described, and what is left to correct is the difference.


def with_described(calibration: Calibration, cell: Cell) -> Calibration:
    """Keep with each correction how its fit found the number described.

    Args:
        calibration: of a fit.
        cell: that the fit was made with.
    """
    effects: list[AcceptedEffect] = []
    for accepted in calibration.effects:
        kept = accepted
        if accepted.name in CORRECTIONS:
            placed, _ = placed_effect(accepted, calibration)
            kept = replace(accepted, described=_described(placed, cell))
        effects.append(kept)
    return replace(calibration, effects=tuple(effects))


def on_cell(calibration: Calibration, cell: Cell) -> tuple[Calibration, Model]:
    """A calibration with the corrections that a cell still needs,
    and the model with which it predicts.

    Args:
        calibration: of the cell, at any date.
        cell: as it is described now.

    Raises:
        EffectRefused: the calibration holds an effect that does not exist.
        ModelError: the robot is described otherwise than at the fit.
    """
    effects = tuple(_remaining(accepted, calibration, cell) for accepted in calibration.effects)
    return replace(calibration, effects=effects), calibrated_model(calibration, cell)


def _remaining(accepted: AcceptedEffect, calibration: Calibration, cell: Cell) -> AcceptedEffect:
    """An effect with what is left of it to correct."""
    if accepted.described is None:
        return accepted
    placed, values = placed_effect(accepted, calibration)
    now = _described(placed, cell)
    if now is None or now == accepted.described:
        return accepted
    then = np.array(accepted.described)
    match placed.effect:
        case ZeroOffset():
            left = values - (np.array(now) - then)
        case GravityDirection():
            left = turn_between(np.array(now), turned_gravity(then, values.tolist()))
        case _:
            return accepted
    names = [column.name for column in placed.columns]
    by_name = dict(zip(names, left, strict=True))
    coefficients = tuple(
        replace(one, value=float(by_name[one.name])) for one in accepted.coefficients
    )
    return replace(accepted, coefficients=coefficients)


#: Of a correction: what is left of it after the cell file was corrected is its own noise
SAME_SIGMAS = 3.0


def not_corrected_since(calibration: Calibration, cell: Cell) -> tuple[Diagnosis, ...]:
    """Diagnoses of a calibration, less those of numbers that the cell file has right since.

    Args:
        calibration: of the cell, at any date.
        cell: as it is described now.
    """
    corrected: set[tuple[str, str | None]] = set()
    for accepted in calibration.effects:
        placed, _ = placed_effect(accepted, calibration)
        if accepted.described is None or _described(placed, cell) in {None, accepted.described}:
            continue
        left = _remaining(accepted, calibration, cell)
        if all(abs(one.value) <= SAME_SIGMAS * one.std for one in left.coefficients):
            axis = accepted.axis if placed.effect.has_axis else None
            corrected.add((DIAGNOSED_AS[type(placed.effect)], axis))
    return tuple(
        one
        for one in calibration.diagnoses
        if (one.name, next(iter(one.axes), None)) not in corrected
    )


def _described(placed: PlacedEffect, cell: Cell) -> tuple[float, ...] | None:
    """The number that a correction corrects, as a cell describes it;
    None of a correction of recordings.
    """
    match placed.effect:
        case ZeroOffset():
            return (float(cell.axes[placed.axis].zero_offset_rad),)
        case GravityDirection():
            gravity: FloatArray = model_of(cell).robot.gravity_m_s2
            return tuple(float(one) for one in gravity)
        case _:
            return None


class Corrections:
    """The corrections that were said; logs that carry one description share one line."""

    def __init__(self) -> None:
        self._said: set[tuple[str, ...]] = set()

    def note(self, log: Path, run: Run) -> None:
        """Say what the given description corrects in a log,
        unless an earlier log of the command had the same.
        """
        recording = run.recording
        if recording is None or not recording.corrected or recording.corrected in self._said:
            return
        self._said.add(recording.corrected)
        _LOG.warning(
            "%s: the given description of the cell replaces the one in the log; they differ in %s",
            log,
            ", ".join(recording.corrected),
        )
