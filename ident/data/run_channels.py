"""Faults of single channels of a run: a joint that never moves, a current that is constant,
readings that are none.

Each is plain in the channel itself. In the equations of a fit it looks like something else, such as
a payload that was not mounted, so it is named from the channels before a cause is looked for there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.data.channel_faults import ChannelFault
from ident.data.dataset import Dataset
from ident.data.fault_text import fault_diagnosis, require_usable
from ident.data.held import HeldChannels
from ident.errors import CurrentConstant, Diagnosis, JointStill
from ident.model.robot import JointKind

if TYPE_CHECKING:
    from ident.model.model import Model

STILL_RANGE = {JointKind.REVOLUTE: 1e-3, JointKind.PRISMATIC: 1e-4}
"""Range below which a joint has not moved, whatever its speed [rad or m]:
an encoder's last count may flicker.
"""
#: Least share of a run in which a joint that moves is above its standstill speed
LEAST_MOVING = 0.01
LEAST_SAMPLES = 20  #: Samples of a moving motor that show a constant current


@dataclass(frozen=True, slots=True, eq=False)
class RunChannels:
    """What each channel of a run shows without any equation."""

    run: str  #: name of the run
    mounting: str | None  #: of the payload; None without load
    still: BoolArray  #: joints that never move, shape (m,)
    #: from the smallest to the largest position of each joint [rad or m], shape (m,)
    range: FloatArray
    constant_current: BoolArray  #: motors that move with a current of one value, shape (m,)
    #: Share of the samples of each moving motor in which its current is clipped, shape (m,).
    clipped_percent: FloatArray
    held: HeldChannels | None  #: readings that were held; None where none was
    faults: tuple[ChannelFault, ...]  #: readings that are none (`ident.data.channel_faults`)
    #: Share of the samples of each moving motor in which its drive gave less than the reference,
    #: shape (m,).
    limited_percent: FloatArray
    #: current that the torque of such a motor shows at most; NaN for others, shape (m,)
    torque_limits: FloatArray
    #: largest current of each motor by size, in the unit of the currents, shape (m,)
    limits: FloatArray


def channels_of(model: Model, data: Dataset) -> RunChannels:
    """Look at the channels of a run.

    Args:
        model: the declared model.
        data: a differentiated run.
    """
    axes = model.robot.axes
    count = len(axes)
    smallest_range = np.array([STILL_RANGE[joint.kind] for joint in axes])
    range_ = np.ptp(data.position_rad, axis=0)
    moving_share = np.mean(data.moving, axis=0)
    still = (range_ <= smallest_range) | (moving_share < LEAST_MOVING)
    clipped = data.clipped
    if clipped is None:
        clipped = np.zeros_like(data.valid)
    usable = data.motor_moving & (data.valid | clipped)
    usable_counts = np.maximum(np.count_nonzero(usable, axis=0), 1)
    clipped_percent = 100.0 * np.count_nonzero(clipped, axis=0) / usable_counts
    limits = np.max(np.abs(data.current_a), axis=0, where=usable, initial=0.0)
    is_constant = np.zeros(count, dtype=np.bool_)
    for motor in range(count):
        own = data.current_a[usable[:, motor], motor]
        if len(own) >= LEAST_SAMPLES and not still[motor]:
            is_constant[motor] = np.ptp(own) == 0.0
    mounting = None
    if data.payload is not None:
        mounting = data.payload.mounting
    return RunChannels(
        run=data.name,
        mounting=mounting,
        still=still,
        range=range_,
        constant_current=is_constant,
        clipped_percent=clipped_percent,
        held=data.held,
        faults=data.faults,
        limited_percent=np.zeros(count),
        torque_limits=np.full(count, np.nan),
        limits=limits,
    )


def require_usable_channels(run: RunChannels, axes: Sequence[str]) -> None:
    """Refuse a run of which a channel cannot be used.

    Raises:
        ReadingsDamaged: readings are none, and nothing mends them.
        CurrentConstant: a motor moves, and its current has one value.
    """
    require_usable(run.run, run.faults, axes)
    constant = np.flatnonzero(run.constant_current).tolist()
    if constant:
        names = tuple(axes[axis] for axis in constant)
        first_value = float(run.limits[constant[0]])
        raise CurrentConstant(run.run, names, first_value)


def clip_diagnoses(runs: Sequence[RunChannels], axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Name currents that a limit has clipped; their samples were left out."""
    for run in runs:
        for axis in np.flatnonzero(run.clipped_percent > 0.0).tolist():
            yield _clip_diagnosis(run, axis, axes[axis])


def limit_diagnoses(runs: Sequence[RunChannels], axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Name drives that gave less current than their reference asked for;
    these samples were left out.
    """
    for run in runs:
        for axis in np.flatnonzero(run.limited_percent > 0.0).tolist():
            yield Diagnosis(
                "current-limited",
                (run.run,),
                (axes[axis],),
                f"a current reference of up to {run.limits[axis]:.4g}, of which the torque shows "
                f"at most {run.torque_limits[axis]:.3g}; {run.limited_percent[axis]:.2g} % of the "
                "samples were left out",
                "a drive that gives the current that its reference asks for",
                "raise the limit of the current in the drive, or record slower moves or with a "
                "lighter payload",
            )


def _clip_diagnosis(run: RunChannels, axis: int, name: str) -> Diagnosis:
    """Name the current of an axis that a limit has clipped."""
    return Diagnosis(
        "current-clipped",
        (run.run,),
        (name,),
        f"a current that is clipped at {run.limits[axis]:.4g} in {run.clipped_percent[axis]:.2g} % "
        "of the samples; they were left out",
        "a current that follows the torque at every moment",
        "record slower moves or with a lighter payload, or raise the limit of the current in the "
        "drive or in what recorded it",
    )


def fault_diagnoses(runs: Sequence[RunChannels], axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Name readings that are none; they were filled in, or left out."""
    for run in runs:
        for fault in run.faults:
            yield fault_diagnosis(run.run, fault, axes[fault.axis])


def held_diagnoses(runs: Sequence[RunChannels], axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Name channels whose readings were held; what was held was filled in."""
    for run in runs:
        held = run.held
        if held is None:
            continue
        if held.position_share.any():
            yield _held_diagnosis(
                run.run, "positions", axes, held.position_share, held.position_hold_s
            )
        if held.current_share.any():
            yield _held_diagnosis(
                run.run, "currents", axes, held.current_share, held.current_hold_s
            )


def _held_diagnosis(
    run: str, quantity: str, axes: Sequence[str], share: FloatArray, hold_s: FloatArray
) -> Diagnosis:
    """Name readings of some axes that were held."""
    affected = np.flatnonzero(share).tolist()
    percent = 100.0 * float(np.max(share))
    typical_ms = 1e3 * float(np.median(hold_s[affected]))
    names = tuple(axes[axis] for axis in affected)
    return Diagnosis(
        "readings-held",
        (run,),
        names,
        f"{quantity} that repeat the reading before while the robot moves, in up to {percent:.0f} "
        f"% of the samples, for some {typical_ms:.3g} ms; what lies between two new readings was "
        "filled in",
        "a new reading in every sample",
        "record at the rate at which the controller answers, or let it answer at the rate of the "
        "recording; noise of a current between the readings is lost, and makes the error larger",
    )


def missing_joint(runs: Sequence[RunChannels], axes: Sequence[str]) -> JointStill | None:
    """Return the error for a joint that never moves in any run of one mounting,
    while there are runs of others.
    """
    mountings = list(dict.fromkeys(run.mounting for run in runs))
    if len(mountings) < 2:
        return None
    for mounting in mountings:
        own = [run for run in runs if run.mounting == mounting]
        still = np.all([run.still for run in own], axis=0)
        if np.any(still):
            found = _still_text(own, still, axes)
            return JointStill(_names(own), _still_axes(still, axes), found)
    return None


def still_joint(runs: Sequence[RunChannels], axes: Sequence[str]) -> JointStill | None:
    """Return the error for runs in which a joint never moves, where the fit contradicts itself.

    Args:
        runs: of the fit.
        axes: name of each axis.
    """
    own = [run for run in runs if np.any(run.still)]
    if not own:
        return None
    still = np.any([run.still for run in own], axis=0)
    found = f"{_still_text(own, still, axes)}, and a fit that contradicts itself"
    return JointStill(_names(own), _still_axes(still, axes), found)


def still_diagnoses(runs: Sequence[RunChannels], axes: Sequence[str]) -> tuple[Diagnosis, ...]:
    """Name joints that never move in a run."""
    found: list[Diagnosis] = []
    for run in runs:
        if np.any(run.still):
            names = _still_axes(run.still, axes)
            error = JointStill(run.run, names, _still_text((run,), run.still, axes))
            found.append(
                Diagnosis(
                    "joint-still", (run.run,), names, error.found, error.expected, error.remedy
                )
            )
    return tuple(found)


def _names(runs: Sequence[RunChannels]) -> str:
    """Names of runs, for a message."""
    return ", ".join(run.run for run in runs)


def _still_axes(still: BoolArray, axes: Sequence[str]) -> tuple[str, ...]:
    """Names of the joints that never move."""
    indices = np.flatnonzero(still).tolist()
    return tuple(axes[axis] for axis in indices)


def _still_text(runs: Sequence[RunChannels], still: BoolArray, axes: Sequence[str]) -> str:
    """Say how still the joints are."""
    names = _still_axes(still, axes)
    verb = "never move"
    if len(names) == 1:
        verb = "never moves"
    largest_range = max(float(np.max(run.range[still])) for run in runs)
    how = "no motion is above the standstill speed"
    if largest_range == 0.0:
        how = "the position is constant"
    return f"{' and '.join(names)} {verb}: {how}"
