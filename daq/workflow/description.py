"""What a fit says of the description of its robot: zeros, mounting and late positions, as diagnoses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence, coefficients_of
from ident.discovery.geometry_check import GeometryCheck, check_geometry
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import GravityDirection, LatePosition, ZeroOffset, is_correction, turned_gravity
from ident.errors import Diagnosis, TooFewMoves
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.geometry_drift import GeometryDrift
from ident.model.model import Model
from ident.model.robot import JointKind

CHECKED_BYTES = 150_000_000
"""Largest size of all logs of a fit whose rows are kept for the test: some ten minutes of six axes at 1 kHz."""


def is_checked(logs: Sequence[Path]) -> bool:
    """Whether logs are small enough to keep their rows."""
    return sum(log.stat().st_size for log in logs if log.is_file()) <= CHECKED_BYTES


def geometry_beside(evidence: Evidence, seed: int) -> GeometryCheck | None:
    """Test the geometry beside a fit by any estimator; None with too few moves.

    Args:
        evidence: the rows behind the fit.
        seed: of the bootstrap.
    """
    if evidence.estimate.method is not Method.ML:
        fixed = evidence.estimate.gains if evidence.estimate.gains_fixed else None
        by_ml = estimate_with(Method.ML, evidence.training.system(), fixed)
        evidence = replace(evidence, estimate=by_ml)
    try:
        return check_geometry(evidence, np.random.default_rng(seed))
    except TooFewMoves:
        return None


def check_diagnoses(check: GeometryCheck, cell: Cell, model: Model) -> tuple[Diagnosis, ...]:
    """Diagnoses of a check beside a fit.

    Args:
        check: of the fit.
        cell: whose description it is.
        model: as declared.
    """
    found = check.mistake
    if found is None:
        return ()
    placed = PlacedEffect(found.effect, found.axis)
    return tuple(_diagnosis(placed, found.coefficients, found.deviations, cell, model))


def correction_diagnoses(evidence: Evidence, cell: Cell) -> tuple[Diagnosis, ...]:
    """Diagnoses of the corrections that a search has made.

    Args:
        evidence: with its effects.
        cell: whose description it is.
    """
    if evidence.uncorrected is None:
        return ()
    found: list[Diagnosis] = []
    for placed in evidence.effects:
        if is_correction(placed):
            values, deviations = coefficients_of(evidence.estimate, placed)
            found += _diagnosis(placed, values, deviations, cell, evidence.uncorrected.model)
    return tuple(found)


def drift_diagnosis(drift: GeometryDrift, model: Model, axes: Sequence[str], runs: Sequence[str]) -> Diagnosis:
    """Diagnosis of a geometry that has changed since a calibration.

    Args:
        drift: by a run that the fit has not seen.
        model: as declared.
        axes: names of its axes.
        runs: name of the run.
    """
    placed = drift.placed
    name = axes[placed.axis]
    values = drift.values
    deviations = drift.deviations
    share = f"it explains {100.0 * drift.share:.0f} % of what the error is larger than in the fit"
    match placed.effect:
        case ZeroOffset():
            unit, scale, _ = _zero_unit(model, placed.axis)
            size = f"{scale * values[0]:+.2f} ± {scale * deviations[0]:.2f} {unit}"
            return Diagnosis(
                name="zero-off",
                runs=tuple(runs),
                axes=(name,),
                found=f"the zero of {name} off by {size} since the calibration; {share}",
                expected="the zero of the calibration",
                remedy="reference the axis again, or calibrate anew",
            )
        case LatePosition():
            size = f"{1e3 * values[0]:+.2f} ± {1e3 * deviations[0]:.2f} ms"
            return Diagnosis(
                name="position-late",
                runs=tuple(runs),
                axes=(name,),
                found=f"the position of {name} late by {size} more than in the calibration; {share}",
                expected="positions and currents of one moment",
                remedy="look for what delays this encoder alone",
            )
        case _:
            angle = float(np.degrees(np.linalg.norm(values)))
            std = float(np.degrees(np.linalg.norm(values * deviations) / np.linalg.norm(values)))
            return Diagnosis(
                name="gravity-tilted",
                runs=tuple(runs),
                axes=(),
                found=f"gravity turned by {angle:.2f} ± {std:.2f}° since the calibration; {share}",
                expected="the mounting of the calibration",
                remedy="level the base as it was, or correct `gravity_m_s2` in the cell file and calibrate anew",
            )


def _diagnosis(
    placed: PlacedEffect, values: FloatArray, deviations: FloatArray, cell: Cell, model: Model
) -> list[Diagnosis]:
    """The diagnosis of one correction; none of an effect that is no correction."""
    name = cell.place_names[placed.axis]
    match placed.effect:
        case ZeroOffset():
            unit, scale, key = _zero_unit(model, placed.axis)
            offset = f"{scale * values[0]:+.2f} ± {scale * deviations[0]:.2f} {unit}"
            entered = scale * (cell.axes[placed.axis].zero_offset_rad + values[0])
            return [
                Diagnosis(
                    name="zero-off",
                    runs=(),
                    axes=(name,),
                    found=f"the zero of {name} off by {offset}",
                    expected="positions whose zero is that of the URDF",
                    remedy=f"correct `{key}` of {name} in the cell file to {entered:.2f}, or the zero in the "
                    "controller, and fit again",
                )
            ]
        case GravityDirection():
            declared = model.robot.gravity_m_s2
            turned = turned_gravity(declared, values.tolist())
            angle = np.degrees(np.linalg.norm(values))
            std = np.degrees(np.linalg.norm(values * deviations) / max(float(np.linalg.norm(values)), 1e-12))
            return [
                Diagnosis(
                    name="gravity-tilted",
                    runs=(),
                    axes=(),
                    found=f"gravity along {vector_text(turned)}, turned by {angle:.2f} ± {std:.2f}°",
                    expected=f"{vector_text(declared)}, as the cell file says",
                    remedy=f"write `gravity_m_s2: {vector_text(turned)}` in the cell file, or level the base and "
                    "record again; then fit again",
                )
            ]
        case LatePosition():
            delay = f"{1e3 * abs(values[0]):.2f} ± {1e3 * deviations[0]:.2f} ms"
            late = "late" if values[0] > 0.0 else "early"
            return [
                Diagnosis(
                    name="position-late",
                    runs=(),
                    axes=(name,),
                    found=f"the position of {name} {late} by {delay}",
                    expected="positions and currents of one moment",
                    remedy="look for what delays this encoder alone: a filter, a slower channel, another time stamp "
                    "than that of the other axes",
                )
            ]
        case _:
            return []


def _zero_unit(model: Model, axis: int) -> tuple[str, float, str]:
    """Unit of an axis' zero, how many of it are in a radian or metre, and the key of the cell file."""
    if model.robot.axes[axis].kind is JointKind.PRISMATIC:
        return "mm", 1e3, "zero_offset_mm"
    return "°", float(np.degrees(1.0)), "zero_offset_deg"


def vector_text(vector: FloatArray) -> str:
    """A vector as a cell file has it: `[0.00, 0.34, -9.80]`."""
    return f"[{', '.join(f'{entry:.2f}' for entry in vector)}]"


def hidden_zeros_text(check: GeometryCheck | None, axes: Sequence[str]) -> str:
    """Which zeros the data cannot show; empty where they show all, or were not asked."""
    if check is None or not check.hidden_zeros:
        return ""
    names = [axes[axis] for axis in check.hidden_zeros]
    subject = "The zeros of" if len(names) > 1 else "The zero of"
    return (
        f"{subject} {' and '.join(names)} cannot be seen here: about a vertical axis, or behind the last joint, "
        "another zero makes nearly the same torques."
    )
