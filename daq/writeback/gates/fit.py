"""Gates of the fit: its cell and configuration, the errors on the torques, and the hold-out.

A gate is a generator of findings over a `GateContext`; `daq.writeback.gates.table` lists all of
them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from daq.config.same_cell import calibrated_robot, expected_text, found_text, robot_differences
from daq.workflow.geometry_diagnoses import LOOK_FOR, UNEXPLAINED, misfit_text
from daq.writeback.gates.gate import GateContext
from daq.writeback.request import GateFinding
from ident.calibration import Calibration
from ident.errors import CORRECTION_UNCLEAR, Diagnosis
from ident.plausible import format_at_limit

NOISE = 1.01
AXIS_NOISE = 1.02
"""Share of the nameplate's error that a calibration may have, in total and on an axis:
where the nameplate is true, the two differ by 0.1 % and 0.3 % (`tests.studies.holdout_study`).
"""
CORRECTED_BY = {
    "zero-off": "zero-offset",
    "gravity-tilted": "gravity-direction",
    "position-late": "late-position",
}
"""Diagnosis of the description, and the effect that corrects it in a calibration."""
NEVER_CORRECTED = frozenset({"gravity-turned", "position-reversed", "zero-turned"})
"""Diagnoses of a description that is so far off that nothing in a calibration corrects it."""
BY_ENCODERS = frozenset({"zero-off", "length-off", "place-off", "geometry-off"})
"""Diagnoses by encoders that miss the loops of a closed chain."""

OF_DESCRIPTION = frozenset(CORRECTED_BY) | NEVER_CORRECTED | BY_ENCODERS
"""Diagnoses that say to correct the description of the robot, and to fit again."""


def cell(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a calibration of another cell, or of another robot with the same name."""
    found = context.calibration.cell
    if context.cell is None:
        return
    if found != context.cell.name:
        yield (
            "calibration",
            f"cell {found!r}",
            f"cell {context.cell.name!r}",
            "give the cell file of that robot; if it is this one under an earlier name, record "
            "again",
        )
        return
    differences = robot_differences(context.calibration.robot, calibrated_robot(context.cell))
    if differences:
        yield (
            "calibration",
            f"one of another robot with the cell name {found!r}: {found_text(differences)}",
            f"{expected_text(differences)}, as in the cell file",
            "give the cell file of the robot that was calibrated; of a cell that was changed "
            "since, record again",
        )


def former_name(context: GateContext) -> Iterator[GateFinding]:
    """Refuse a cell file with a name that its robot had before a rename."""
    renamed = context.renamed
    if renamed is not None:
        yield (
            f"cell {renamed.old!r}",
            f"a robot that was renamed to {renamed.new!r} at {renamed.at}",
            "a cell file with its present name",
            renamed.remedy,
        )


def configuration(context: GateContext) -> Iterator[GateFinding]:
    """Refuse after a change of URDF, drive profile or cell file since the recording,
    in what a recording depends on.
    """
    if context.cell is None or context.request.accepts_changed_configuration:
        return
    if context.calibration.cell != context.cell.name:
        return  # of another cell: `cell` says so, and its remedy is another one
    found = context.calibration.recording_configuration_sha256
    expected = context.cell.recording_digest
    # A calibration of an earlier version has the digest of the whole configuration alone.
    if found is None:
        found = context.calibration.configuration_sha256
        expected = context.cell.digest
    if found != expected:
        yield (
            "calibration",
            f"recorded with cell configuration {found[:12] or 'unknown'}…",
            f"{expected[:12]}…, the cell's configuration now",
            "fit the same logs with this cell file (--cell), record again, or see what changed "
            "since and accept it with --configuration-changed",
        )


def description(context: GateContext) -> Iterator[GateFinding]:
    """Refuse gains of a robot that its fit found described wrongly (zero, mounting, time stamps,
    length of a link).

    A calibration that corrects the description itself, as `drivegain residual` does, has the right
    gains.
    """
    calibration = context.calibration
    for diagnosis in uncorrected_description(calibration):
        subject = ", ".join(diagnosis.axes) or "calibration"
        yield subject, diagnosis.found, diagnosis.expected, diagnosis.remedy


def encoders(context: GateContext) -> Iterator[GateFinding]:
    """Bound the misfit of redundant encoders that no number of the description explains."""
    misfit = context.calibration.encoder_misfit
    if misfit is None or not misfit.significant or misfit.corrections or misfit.late_encoders:
        return
    limit = 1e-3 * context.policy.max_encoder_misfit_mrad
    if not misfit.described <= limit:
        yield (
            "calibration",
            f"encoders that miss the loops by {misfit_text(misfit.described, misfit.unit)}, which "
            f"{UNEXPLAINED}",
            f"at most {misfit_text(limit, misfit.unit)} (`max_encoder_misfit_mrad`)",
            LOOK_FOR,
        )


def uncorrected_description(calibration: Calibration) -> tuple[Diagnosis, ...]:
    """Diagnoses of the robot's description that a fit has made and its calibration does not
    correct.
    """
    held_out = {source.name for source in calibration.sources if source.role == "holdout"}
    found: list[Diagnosis] = []
    for diagnosis in calibration.diagnoses:
        # What a held-out run alone shows has changed after the fit: its error is judged by another
        # gate.
        is_of_holdout = bool(diagnosis.runs) and held_out.issuperset(diagnosis.runs)
        if not is_of_holdout and _is_uncorrected(diagnosis, calibration):
            found.append(diagnosis)
    return tuple(found)


def _is_uncorrected(diagnosis: Diagnosis, calibration: Calibration) -> bool:
    """Whether a diagnosis says that the description is wrong,
    and nothing in the calibration corrects that.
    """
    if diagnosis.name in NEVER_CORRECTED:
        return True
    misfit = calibration.encoder_misfit
    if misfit is not None and diagnosis.name in BY_ENCODERS:
        return bool(misfit.corrections) and not misfit.applied
    if diagnosis.name == CORRECTION_UNCLEAR:
        return not any(effect.name in CORRECTED_BY.values() for effect in calibration.effects)
    if diagnosis.name not in CORRECTED_BY:
        return False
    for effect in calibration.effects:
        is_of_axis = not diagnosis.axes or effect.axis in diagnosis.axes
        if effect.name == CORRECTED_BY[diagnosis.name] and is_of_axis:
            return False
    return True


def finite_errors(context: GateContext) -> Iterator[GateFinding]:
    """Require relative errors that are finite and not negative."""
    if not _errors_are_finite(context.calibration):
        yield (
            "calibration",
            "a relative error that is no number, or below zero",
            "finite numbers from 0 %",
            "fit the logs again",
        )


def error(context: GateContext) -> Iterator[GateFinding]:
    """Bound the relative error of the torques, on the held-out run if there is one;
    in total, and on each axis.
    """
    calibration = context.calibration
    policy = context.policy
    if not _errors_are_finite(calibration):
        return
    trained = calibration.relative_error_percent
    held = calibration.holdout_error_percent
    judged = trained if held is None else held
    if not judged.total <= policy.max_error_percent:
        yield (
            "calibration",
            f"a relative error of {format_at_limit(judged.total, policy.max_error_percent, 1)} % "
            "of the torques",
            f"at most {policy.max_error_percent:g} %",
            "the model does not describe this robot: check drive train, roles, payload and units",
        )
    names = context.axis_names
    for name, number in zip(names, judged.axes, strict=False):
        if number > policy.max_axis_error_percent:
            percent = format_at_limit(number, policy.max_axis_error_percent, 1)
            yield (
                name,
                f"a relative error of {percent} % of this axis's torque",
                f"at most {policy.max_axis_error_percent:g} %",
                "the model does not describe this axis: check its drive train, drive, current and "
                "direction",
            )
    for count in sorted({len(one.axes) for one in (trained, held) if one is not None}):
        if count < len(names):
            yield (
                "calibration",
                f"relative errors of {count} axes",
                f"one for each of the {len(names)} axes",
                "fit the logs again",
            )


def holdout(context: GateContext) -> Iterator[GateFinding]:
    """Require a held-out error no worse than with the nameplate, in total and on each axis."""
    calibration = context.calibration
    if not _errors_are_finite(calibration):
        return
    held = calibration.holdout_error_percent
    nameplate = calibration.nameplate_holdout_error_percent
    if held is None:
        if context.policy.requires_holdout:
            yield (
                "calibration",
                "no held-out run",
                "a run that tests the gains, as the cell requires (`holdout: required`, or "
                "`by: job`)",
                "fit the logs again, with --holdout for a run that the fit does not use",
            )
        return
    if nameplate is None:
        yield (
            "calibration",
            "a hold-out that was not compared with the nameplate",
            "the error with the nameplate on the same run",
            "fit the logs again with free gains and --holdout",
        )
        return
    if not held.total <= NOISE * nameplate.total:
        yield (
            "calibration",
            f"{held.total:.2f} % of the torques of the held-out run",
            f"less than the {nameplate.total:.2f} % that the nameplate leaves",
            "the nameplate is better than this calibration: was the payload as declared in "
            "every run?",
        )
    names = context.axis_names
    missing = (math.nan,) * (len(names) - len(nameplate.axes))
    for name, left, before in zip(names, held.axes, (*nameplate.axes, *missing), strict=False):
        # NaN on the left is an axis at rest, which has its own gate; NaN of the nameplate alone is
        # no figure to beat.
        if not math.isnan(left) and not left <= AXIS_NOISE * before:
            yield (
                name,
                f"{left:.2f} % of this axis's torque in the held-out run",
                f"less than the {before:.2f} % that the nameplate leaves",
                "the nameplate is better than this gain: did the drive, or the scale of its "
                "current, change between the runs?",
            )


def holdout_log(context: GateContext) -> Iterator[GateFinding]:
    """Require an error and a log of the held-out run, or neither."""
    calibration = context.calibration
    if context.cell is None or not calibration.sources:
        return
    has_error = calibration.holdout_error_percent is not None
    if has_error != any(source.role == "holdout" for source in calibration.sources):
        if has_error:
            found = "an error on held-out data, and no log of them"
        else:
            found = "a held-out log, and no error on it"
        yield "calibration", found, "both or neither", "fit the logs again"


def holdout_motion(context: GateContext) -> Iterator[GateFinding]:
    """Require that every axis moves in the held-out run: otherwise nothing tests its gain."""
    held = context.calibration.holdout_error_percent
    for name, number in zip(context.axis_names, () if held is None else held.axes, strict=False):
        if math.isnan(number):
            yield (
                name,
                "no motion of this axis in the held-out run",
                "a run that tests every gain",
                "hold out a run in which all axes move",
            )


def effect(context: GateContext) -> Iterator[GateFinding]:
    """Require that no effect raises the error on held-out data by more than a hundredth of it."""
    for one in context.calibration.effects:
        if not one.is_harmless:
            yield (
                f"effect {one.name} on {one.axis}",
                f"{one.error_after_percent:.2f} % on held-out data with it, "
                f"{one.error_before_percent:.2f} % without",
                "an effect that does not raise it",
                "fit without this effect",
            )


def _errors_are_finite(calibration: Calibration) -> bool:
    trained = calibration.relative_error_percent
    held = calibration.holdout_error_percent
    numbers = [*trained.axes, trained.total]
    if held is not None:
        numbers += [*(number for number in held.axes if not math.isnan(number)), held.total]
    return all(0.0 <= number < math.inf for number in numbers)
