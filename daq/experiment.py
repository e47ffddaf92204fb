"""The experiment that a plan is for: the same moves once without load and once with the weighed payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell, WeighedPayload
from daq.configuration.cell_model import model_of
from daq.errors import ConfigurationInconsistent
from daq.scene import CheckedScene, scene_of
from drivers.trapezoid import Trapezoid, synchronised
from ident.conditioning import decimator
from ident.excitation import Design, Excitation, Expectation, effective_noise, visible
from ident.motion import Motion
from ident.nominal import nominal_links, nominal_parameters, nominal_payload, nominal_torque_limits

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NOISE_SHARE = 0.006
"""Standard deviation of a row's residual, as a share of the motor's current at its torque limit: some 4 % of the rms
current of a lively plan, which is what a good fit leaves (docs/estimators.md)."""
LAG_ONE = 0.67
"""Correlation of the residual from row to row, as measured on real recordings."""
RUNS: tuple[int | None, ...] = (None, 0)
"""What is mounted while the moves are made: nothing, then the payload."""


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """What is needed to judge moves before they are made.

    Attributes:
        cell: of the arm.
        design: unknowns and information.
        scene: what must keep apart.
        payload: that will be mounted.
        row_s: time between two rows of the observation [s].
        edge_s: how long after a standstill rows begin to count [s].
        remarks: what was assumed, in words.
    """

    cell: Cell
    design: Design
    scene: CheckedScene
    payload: WeighedPayload
    row_s: float
    edge_s: float
    remarks: tuple[str, ...]

    def excitation(self, paths: Sequence[Trapezoid], thinning: int = 1) -> tuple[Excitation, tuple[slice, ...]]:
        """Rows of several moves, one after the other, and which of them belong to which move.

        Args:
            paths: the moves.
            thinning: takes every so manieth row only.
        """
        period = self.row_s * thinning
        times = [np.arange(0.5 * period, path.duration_s, period) for path in paths]
        parts = [path.at(time) for path, time in zip(paths, times, strict=True)]
        motion = Motion(*(np.concatenate([part[kind] for part in parts]).T for kind in range(3)))
        use = np.concatenate([self._use(path, time) for path, time in zip(paths, times, strict=True)], axis=1)
        ends = np.cumsum([len(time) for time in times])
        slices = tuple(slice(end - len(time), end) for end, time in zip(ends.tolist(), times, strict=True))
        return Excitation(motion, use), slices

    def informations(self, paths: Sequence[Trapezoid], thinning: int = 1) -> list[FloatArray]:
        """Of each move, made once without load and once with the payload, all from one regressor."""
        if not paths:
            return []
        excitation, slices = self.excitation(paths, thinning)
        whitened = self.design.whitened(excitation)
        return [thinning * self.design.information_of(whitened[:, :, part], RUNS) for part in slices]

    def _use(self, path: Trapezoid, time_s: FloatArray) -> BoolArray:
        """Rows of each motor that count; the same rule as ident/rows.py, for moves that start and end at rest."""
        train = self.design.expectation.model.drive_train
        # On a trapezoid a joint is slowest at the ends of a row's window.
        early, late = (np.abs(path.at(time_s + shift)[1].T) for shift in (-self.edge_s, self.edge_s))
        standstill = np.array(self.cell.conditioning.standstill_rad_s or (0.0,) * len(early))[:, None]
        moving = (np.minimum(early, late) > standstill) if standstill.any() else np.minimum(early, late) > 0.0
        slowest = np.minimum(*(np.abs(train.direction @ path.at(time_s + s)[1].T) for s in (-self.edge_s, self.edge_s)))
        turned = slowest > standstill
        needed = (np.abs(train.to_motor) > 0) | (np.abs(train.direction) > 0)
        return np.stack([moving[needed[motor]].all(axis=0) & turned[motor] for motor in range(len(moving))])


def experiment_of(cell: Cell, payload: str | None = None) -> Experiment:
    """What is expected of a cell's arm: inertias of the URDF, stated guesses for the rest, nameplate gains.

    Args:
        cell: with a payload.
        payload: name of it, None for the first.

    Raises:
        ConfigurationInconsistent: the cell declares no payload, or none of that name.
    """
    mounted = _payload(cell, payload)
    model = model_of(cell)
    expected = nominal_payload(model.robot, mounted.drawn)
    velocity = np.array([axis.limits.velocity for axis in cell.axes])
    acceleration = np.array([axis.limits.acceleration for axis in cell.axes])
    lively = _lively(cell, velocity, acceleration)
    links, from_urdf = nominal_links(model.robot, cell.urdf)
    loaded = links.copy()
    loaded[-1] += expected.parameters
    torque = nominal_torque_limits(model, cell.urdf, loaded, lively)
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    noise = NOISE_SHARE * (np.abs(model.drive_train.to_motor) * torque).max(axis=1) / np.abs(gains)
    expectation = Expectation(
        model=model,
        gains=gains,
        parameters=nominal_parameters(model, links, torque, velocity, acceleration),
        payloads=(expected,),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    scene = scene_of(cell, model.robot, mounted.mass_kg)
    remarks = (
        f"payload {mounted.name}, {mounted.mass_kg:g} kg" + ("" if from_urdf else "; link masses guessed"),
        f"noise {100 * NOISE_SHARE:g} % of the current at each motor's torque limit, correlation {LAG_ONE:g} from row "
        "to row",
        *scene.remarks,
    )
    period, edge = _rows(cell)
    return Experiment(cell, Design(expectation, visible(model, lively)), scene, mounted, period, edge, remarks)


def _payload(cell: Cell, name: str | None) -> WeighedPayload:
    found = [payload for payload in cell.payloads if name in (None, payload.name)]
    if not found:
        names = ", ".join(payload.name for payload in cell.payloads) or "none"
        raise ConfigurationInconsistent(
            f"payloads of cell {cell.name!r}",
            found=names,
            expected="a weighed payload" if name is None else repr(name),
            remedy="gains show only beside a known mass: weigh a body and declare it under `payloads`",
        )
    return found[0]


def _lively(cell: Cell, velocity: FloatArray, acceleration: FloatArray) -> Motion:
    """Random moves as fast as the limits allow: which parameters there are does not depend on a plan's seed."""
    rng = np.random.default_rng(0)
    lower, upper = np.array([axis.limits.position for axis in cell.axes]).T
    targets = rng.uniform(lower, upper, (40, len(lower)))
    parts = []
    for start, end in pairwise(targets):
        path = synchronised(start, end, velocity, acceleration)
        parts.append(path.at(np.linspace(0.02, 0.98, 24) * path.duration_s))
    return Motion(*(np.concatenate([part[kind] for part in parts]).T for kind in range(3)))


def _rows(cell: Cell) -> tuple[float, float]:
    """Time between rows, and how far from a standstill a row's filter window must be for it to count [s]."""
    conditioning = cell.conditioning
    rate_hz = 1000.0
    filter_ = decimator(rate_hz, conditioning.decimation_cutoff_hz)
    weight = np.cumsum(np.abs(filter_.taps)) / np.abs(filter_.taps).sum()
    inside = int(np.searchsorted(weight, conditioning.standstill_share))
    return filter_.factor / rate_hz, max(filter_.half - inside, 0) / rate_hz
