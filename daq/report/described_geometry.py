"""What the torques say of the description of the robot: the direction of gravity, and the zeros of
joints that they do not show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from daq.config.cell import robot_of
from daq.report.document import Figure, Report
from daq.workflow.diagnoses import hidden_zeros_text
from daq.workflow.fit import Fit
from daq.writeback.gates.fit import OF_DESCRIPTION
from ident.discovery.geometry_check import GeometryCheck
from ident.discovery.hidden_zeros import ZeroHiddenBy, zero_hidden_by
from ident.errors import CORRECTION_UNCLEAR, Diagnosis
from ident.estimators.turned_geometry import GRAVITY_TURNED
from ident.model.robot import Robot


class FoundGravity(Report):
    """Direction of gravity by the torques, and the declared one."""

    declared_m_s2: list[Figure]
    found_m_s2: list[Figure]
    turn_deg: Figure
    turn_std_deg: Figure
    #: Other mistakes of the description, with their axes, estimated together with it; its σ does
    #: not cover them.
    not_corrected: list[str]


class CheckedGeometry(Report):
    """What the torques say of the description of the robot."""

    gravity: FoundGravity | None
    hidden_zeros: list[str]
    #: Why each of them is hidden: by a symmetry of the arm, as the last link's, or by these moves.
    hidden_zero_causes: dict[str, ZeroHiddenBy]
    #: Two axes each, whose zeros are seen one by one, and not where both are off.
    hidden_zero_pairs: list[tuple[str, str]]


def geometry_notes(
    check: GeometryCheck | None,
    axes: Sequence[str],
    robot: Robot,
    diagnoses: Sequence[Diagnosis] = (),
    *,
    by: str = "the torques",
) -> Iterator[str]:
    """Say the direction of gravity, and the zeros that the data do not show;
    nothing where nothing was tested.

    Args:
        check: of the fit.
        axes: their names.
        robot: as declared.
        diagnoses: of the fit. Gravity is estimated without correcting what they name.
        by: what puts gravity there.
    """
    if check is None:
        return
    if check.gravity is not None:
        turn = np.degrees(check.gravity.turn_rad)
        std = np.degrees(check.gravity.turn_std_rad)
        size = f"{turn:.2f} ± {std:.2f}° from its direction in the cell file"
        others = not_corrected(diagnoses)
        if others:
            yield (
                f"With the description as it is ({', '.join(others)} not corrected), {by} "
                f"put gravity {size}. This σ does not cover {', '.join(others)}: correct that "
                "first, and fit again."
            )
        else:
            yield f"By {by}, gravity is {size}."
    hidden = hidden_zeros_text(check, axes, robot)
    if hidden:
        yield hidden


def not_corrected(diagnoses: Sequence[Diagnosis]) -> list[str]:
    """Name the mistakes of the description, other than gravity, that were estimated with it:
    `zero-off J2`.
    """
    of_others = (OF_DESCRIPTION | {CORRECTION_UNCLEAR}) - {"gravity-tilted", GRAVITY_TURNED}
    named = [one for one in diagnoses if one.name in of_others and not one.runs]
    return [" ".join((one.name, *one.axes)) for one in named]


def checked_geometry(
    check: GeometryCheck | None,
    axes: Sequence[str],
    robot: Robot,
    diagnoses: Sequence[Diagnosis] = (),
) -> CheckedGeometry | None:
    """Return what the torques say of the description of the robot;
    None where nothing was tested.
    """
    if check is None:
        return None
    gravity = None
    if check.gravity is not None:
        turn_deg = np.degrees(check.gravity.turn_rad)
        turn_std_deg = np.degrees(check.gravity.turn_std_rad)
        gravity = FoundGravity.of(
            check.gravity,
            turn_deg=turn_deg,
            turn_std_deg=turn_std_deg,
            not_corrected=not_corrected(diagnoses),
        )
    causes = {axes[axis]: zero_hidden_by(robot, axis) for axis in check.hidden_zeros}
    pairs = [(axes[first], axes[second]) for first, second in check.hidden_pairs]
    return CheckedGeometry(
        gravity=gravity,
        hidden_zeros=list(causes),
        hidden_zero_causes=causes,
        hidden_zero_pairs=pairs,
    )


def geometry_before_search(fitted: Fit, diagnoses: Sequence[Diagnosis]) -> Iterator[str]:
    """Say the notes of `geometry_notes` of the fit that a search began with."""
    yield from geometry_notes(
        fitted.description,
        fitted.cell.axis_names,
        robot_of(fitted.cell),
        diagnoses,
        by="the torques before the search",
    )
