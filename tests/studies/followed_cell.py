"""Runs of a simulated cell whose position loops follow a demand of their own:
the same plant and loops, without nodes.

`tests.studies.direct_cell` walks the moves through CiA 402, which takes two thirds of its time and
knows no motion but from rest to rest. Here the demand goes straight to the loops, in pieces of
constant acceleration, so that a run of 20 s takes one to two seconds of processor time, and may
have no rest at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from daq.config.cell import Cell
from daq.workflow.experiment import PlannedMove, path_of
from daq.workflow.plan import DWELL_S
from drivers.simulation.amplifier import AmplifierSet, ProfileMove, counts_per_rad
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec
from ident.arrays import FloatArray, IntArray
from ident.model.bodies import Payload
from ident.planning.limits import POSITION_MARGIN
from tests.studies.direct_cell import RawRun

PIECE = 5  #: Samples with one acceleration
APPROACH_S = 1.5  #: From rest into continuous motion; it is not recorded
SINES = 6  #: Of each joint's continuous motion
FREQUENCY_HZ = (0.08, 0.6)


@dataclass(frozen=True, slots=True)
class Demand:
    """Motion that the loops are to follow.

    Attributes:
        position_rad: of the joints at every sample, shape (k, n).
        move: number of the move of each sample, shape (k,).
        first: sample at which the recording begins.
    """

    position_rad: FloatArray
    move: IntArray
    first: int


def point_to_point(
    cell: Cell, start_rad: FloatArray, rng: np.random.Generator, duration_s: float
) -> Demand:
    """Random moves from rest to rest, as a plan begins with before any is exchanged."""
    low, high = _room(cell)
    rate_hz = _rate_hz(cell)
    here = start_rad
    positions = [start_rad[None]]
    moves = [np.zeros(1, dtype=np.int64)]
    samples = 1
    while samples < duration_s * rate_hz:
        target = tuple(float(value) for value in rng.uniform(low, high))
        velocity = float(rng.uniform(0.35, 1.0))
        acceleration = float(rng.uniform(0.4, 1.0))
        move = PlannedMove(target, velocity, acceleration, DWELL_S)
        path = path_of(cell, here, move)
        count = round((path.duration_s + DWELL_S) * rate_hz)
        positions.append(path.at(np.arange(1, count + 1) / rate_hz)[0])
        moves.append(np.full(count, len(moves), dtype=np.int64))
        here = np.array(target)
        samples = samples + count
    position_rad = np.concatenate(positions)
    stacked_moves = np.concatenate(moves)
    return Demand(position_rad, stacked_moves, 0)


def without_rest(
    cell: Cell, start_rad: FloatArray, rng: np.random.Generator, duration_s: float
) -> Demand:
    """Sum of sines for each joint within its limits:
    the joints turn back at different times, and none ever waits.
    """
    low, high = _room(cell)
    rate_hz = _rate_hz(cell)
    time_s = np.arange(round((duration_s + APPROACH_S) * rate_hz)) / rate_hz
    positions = np.empty((len(time_s), len(low)))
    for joint, axis in enumerate(cell.axes):
        frequency = rng.uniform(*FREQUENCY_HZ, SINES)
        omega = 2.0 * np.pi * frequency
        phase = rng.uniform(0.0, 2.0 * np.pi, SINES)
        size = rng.uniform(0.3, 1.0, SINES) / frequency
        angle = np.outer(time_s, omega) + phase
        way = np.sin(angle) @ size
        speed = np.cos(angle) @ (size * omega)
        push = -np.sin(angle) @ (size * omega**2)
        limits = (
            0.5 * (high - low)[joint],
            0.9 * axis.limits.velocity,
            0.6 * axis.limits.acceleration,
        )
        scale = min(
            limit / float(np.abs(one).max())
            for limit, one in zip(limits, (way, speed, push), strict=True)
        )
        positions[:, joint] = 0.5 * (low + high)[joint] + scale * way
    share = np.clip(time_s / APPROACH_S, 0.0, 1.0)[:, None]
    blend = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    position_rad = start_rad + blend * (positions - start_rad)
    move = np.zeros(len(time_s), dtype=np.int64)
    return Demand(
        position_rad,
        move,
        round(APPROACH_S * rate_hz),
    )


def follow(
    cell: Cell,
    spec: CellSpec,
    demand: Demand,
    name: str,
    payload: Payload | None,
    began_s: float = 0.0,
) -> RawRun:
    """Record a simulated cell that follows a demand.

    Args:
        cell: as declared.
        spec: its truth, with the mounted body and the seed of its noise.
        demand: from the cell's start position.
        name: of the run.
        payload: what is mounted, as declared; None without load.
        began_s: how long the cell has been on.

    Raises:
        FrictionUnsolved, SpecInvalid: from the simulated cell.
    """
    plant = Plant(spec)
    amplifiers = AmplifierSet(spec, plant)
    plant.time_s = began_s
    amplifiers.loops["enabled"] = 1
    closed = np.zeros(len(spec.axes), dtype=np.bool_)
    plant.set_brakes(closed)
    piece_s = PIECE / _rate_hz(cell)
    counts = demand.position_rad @ spec.ratio.T * counts_per_rad(spec)
    speed = np.gradient(counts[::PIECE], piece_s, axis=0)
    speed[0] = 0.0
    recorded = []
    loops = amplifiers.loops
    for sample in range((len(speed) - 1) * PIECE):
        if sample % PIECE == 0:
            speed_difference = speed[sample // PIECE + 1] - loops["demand_velocity"]
            acceleration = speed_difference / piece_s
            for motor, value in enumerate(acceleration):
                # Twice as long as it lasts: a set-point that ends would stop.
                duration_s = (2.0 * piece_s, 0.0, 0.0, 0.0)
                profile_move = ProfileMove(duration_s, (float(value), 0.0, 0.0, 0.0), 0.0)
                amplifiers.move(
                    motor,
                    profile_move,
                )
        loops["limited"] = 0
        for _ in range(spec.substeps):
            plant.step(loops["current_a"])
            amplifiers.control(plant.motor_rad)
        amplifiers.report()
        now = amplifiers.readings
        recorded.append((now.position, now.demand, now.current_demand, now.limited))
    position, asked, current, limited = (
        np.array(column) for column in zip(*recorded[demand.first :], strict=True)
    )
    ampere_per_unit = np.array([0.001 * axis.rated_current_a for axis in spec.axes])
    position_counts = position.astype(np.int32)
    demand_counts = asked.astype(np.int32)
    current_raw = current.astype(np.int16)
    return RawRun(
        name=name,
        payload=payload,
        position_counts=position_counts,
        demand_counts=demand_counts,
        current_raw=current_raw,
        limited=limited != 0,
        move=demand.move[demand.first : len(recorded)],
        ampere_per_unit=ampere_per_unit,
        began_s=began_s,
    )


def _room(cell: Cell) -> tuple[FloatArray, FloatArray]:
    positions = [axis.limits.position for axis in cell.axes]
    limits = np.array(positions)
    limit_difference = limits[:, 1] - limits[:, 0]
    margin = POSITION_MARGIN * limit_difference
    return limits[:, 0] + margin, limits[:, 1] - margin


def _rate_hz(cell: Cell) -> float:
    if cell.sync is None:
        raise ValueError(f"cell {cell.name}: no sync period")
    return 1e6 / cell.sync.period_us
