"""How the loops of a simulated amplifier are tuned: one rule from what the motor turns, for any robot."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.drive_train import reduction
from drivers.simulated.plant import Plant
from drivers.simulated.spec import CellSpec

FloatArray = NDArray[np.float64]

VELOCITY_BANDWIDTH_RAD_S = 220.0
"""Of the closed velocity loop at the tuned inertia; low enough for a few-fold lighter axis to stay stable at 4 kHz."""

POSITION_BANDWIDTH_RAD_S = VELOCITY_BANDWIDTH_RAD_S / 4.0
INTEGRAL_BANDWIDTH_RAD_S = VELOCITY_BANDWIDTH_RAD_S / 5.0

VELOCITY_FILTER_S = 0.0008
"""Of the differenced encoder: one count a substep is a coarse velocity."""

POSTURES = 3
"""Positions tried for each joint."""


@dataclass(frozen=True, slots=True)
class LoopTuning:
    """Of the loops of n axes, in the drives' own units (motor counts and ampere).

    Attributes:
        counts_per_rad: motor counts per radian of the rotor, shape (n,).
        inertia_a_s2: current per motor acceleration [A per count/s²], signed as the axis is wired, shape (n,).
        position_1_s, velocity_1_s, integral_1_s: loop bandwidths.
        filter_s: time constant of the velocity filter.
    """

    counts_per_rad: FloatArray
    inertia_a_s2: FloatArray
    position_1_s: float = POSITION_BANDWIDTH_RAD_S
    velocity_1_s: float = VELOCITY_BANDWIDTH_RAD_S
    integral_1_s: float = INTEGRAL_BANDWIDTH_RAD_S
    filter_s: float = VELOCITY_FILTER_S


def tuned(spec: CellSpec, plant: Plant) -> LoopTuning:
    """Tune to the geometric mean of the smallest and largest inertia that each motor meets over the postures.

    Args:
        spec: the cell.
        plant: of that cell, for its inertias.
    """
    counts_per_rad = np.array([axis.counts_per_revolution for axis in spec.axes]) / (2.0 * np.pi)
    # The first joint's position changes no inertia; of long chains the joints behind the seventh stay where they are.
    swept = range(1, min(len(spec.axes), 7))
    tried = plant.postures(spec.start_rad, POSTURES)
    inertias = []
    for posture in itertools.product(*(tried[joint] for joint in swept)):
        position = spec.start_rad.copy()
        position[list(swept)] = posture
        inertias.append(plant.motor_inertia_at(position))
    inertia = np.sqrt(np.min(inertias, axis=0) * np.max(inertias, axis=0))
    gain = np.array([axis.gain_nm_per_a for axis in spec.axes])
    # Joint-side rad/s² of a motor is its own over N; g/N keeps the sign of gear and wiring together.
    return LoopTuning(counts_per_rad, inertia / (gain * reduction(spec.ratio) * counts_per_rad))
