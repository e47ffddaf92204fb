"""The filtered, decimated columns of W_tot = [V | −W | −W_uL | −W_kL χ_kL] (paper eq. 17), with names and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident.base_parameters import BaseParameters, base_parameters
from ident.conditioning import Conditioning
from ident.dataset import Dataset
from ident.drive_train import DriveTrain
from ident.errors import DataUnfit, RankDeficient
from ident.link import LINK_PARAMETERS, LINK_UNITS
from ident.model import Column, Model
from ident.payload import Payload
from ident.rows import chunks, row_filter, row_masks

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Observation:
    """Rows of several runs, before any scaling; arrays are joint-first and time-last.

    Attributes:
        drive_train: R.
        columns: name and unit of the b columns of W: base parameters, then effects.
        base: how the base parameters were regrouped.
        current: decimated current references of the motors [A], shape (n, r).
        robot: W, torque at each joint per unit of each column, shape (n, b, r).
        flange: the last link's ten columns; a payload's are these where it was mounted, shape (n, 10, r).
        use: rows of each joint that count: moving and valid, shape (n, r).
        motor_use: rows of each motor that count: all joints it turns with, and itself, moving, shape (n, r).
        time_s: of each row, since the start of its run, shape (r,).
        run: index of each row's run, shape (r,).
        move: number of each row's move, unique over all runs, shape (r,).
        mounting: index into payloads, −1 without load, shape (r,).
        payloads: one for each mounting.
        payload_columns: for each mounting, its unknown parameters that these data see, as indices of
            LINK_PARAMETERS.
        runs: names of the runs.
        conditioning: the filters these rows went through.
    """

    drive_train: DriveTrain
    columns: tuple[Column, ...]
    base: BaseParameters
    current: FloatArray
    robot: FloatArray
    flange: FloatArray
    use: BoolArray
    motor_use: BoolArray
    time_s: FloatArray
    run: IntArray
    move: IntArray
    mounting: IntArray
    payloads: tuple[Payload, ...]
    payload_columns: tuple[tuple[int, ...], ...]
    runs: tuple[str, ...]
    conditioning: Conditioning

    @property
    def joint_count(self) -> int:
        """n."""
        return int(self.current.shape[0])

    @property
    def unknowns(self) -> tuple[Column, ...]:
        """χ, then χ_uL of each mounting: name and unit of everything linear that is estimated beside the gains."""
        return self.columns + tuple(
            Column(f"{LINK_PARAMETERS[index]}:{payload.mounting}", LINK_UNITS[index])
            for payload, indices in zip(self.payloads, self.payload_columns, strict=True)
            for index in indices
        )

    def linear(self, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """[W | W_uL] of some rows, shape (n, p, rows)."""
        parts = [self.robot[:, :, rows]]
        for index, indices in enumerate(self.payload_columns):
            parts.append(self.flange[:, list(indices)][:, :, rows] * (self.mounting[rows] == index))
        return np.concatenate(parts, axis=1)

    def known(self, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """W_kL χ_kL of some rows: the joint torque of what is known of the payloads [Nm], shape (n, rows)."""
        weights = np.zeros((len(self.payloads) + 1, 10))
        for index, payload in enumerate(self.payloads):
            for name, value in payload.known.items():
                weights[index, LINK_PARAMETERS.index(name)] = value
        return np.asarray(np.einsum("jpr,rp->jr", self.flange[:, :, rows], weights[self.mounting[rows]]))

    def motor_torque(self) -> tuple[FloatArray, FloatArray]:
        """The model's torque as each motor must give it, T τ (DriveTrain): linear part (n, p, r), known part (n, r)."""
        to_motor, linear = self.drive_train.to_motor, self.linear()
        mixed = (to_motor @ linear.reshape(len(to_motor), -1)).reshape(linear.shape)
        return mixed, to_motor @ self.known()

    def torque(self, gains: FloatArray, rows: BoolArray | slice = slice(None)) -> FloatArray:
        """Y = V g: joint torque from the measured current references (eq. 4 through R) [Nm], shape (n, rows)."""
        return self.drive_train.direction.T @ (gains[:, None] * self.current[:, rows])

    def only(self, rows: BoolArray) -> Observation:
        """The same observation with other rows left out."""
        return replace(
            self,
            current=self.current[:, rows],
            robot=self.robot[:, :, rows],
            flange=self.flange[:, :, rows],
            use=self.use[:, rows],
            motor_use=self.motor_use[:, rows],
            time_s=self.time_s[rows],
            run=self.run[rows],
            move=self.move[rows],
            mounting=self.mounting[rows],
        )

    def extended(self, columns: tuple[Column, ...], torque: FloatArray) -> Observation:
        """The same observation with further columns of W, shape (n, extra, r) [Nm per unit]."""
        return replace(self, columns=self.columns + columns, robot=np.concatenate((self.robot, torque), axis=1))


def observe(model: Model, datasets: Sequence[Dataset], conditioning: Conditioning) -> Observation:
    """Build the observation of several runs.

    Args:
        model: the declared model.
        datasets: differentiated runs; a mounting that several share has one set of unknowns.
        conditioning: the filters; every column and the currents go through the same decimation.

    Raises:
        DataUnfit: a run leaves no usable row, or a joint never moves.
        RankDeficient: payload and robot cannot be told apart (only loaded runs).
    """
    payloads = _mountings(datasets)
    parts = [_decimated(model, data, conditioning) for data in datasets]
    standard, current, use, motor_use, time, move, run, mounting = [], [], [], [], [], [], [], []
    first_move = 0
    for index, (data, part) in enumerate(zip(datasets, parts, strict=True)):
        if not part.use.any():
            raise DataUnfit(data.name, "no row is left after the standstill and validity masks; did the robot move?")
        standard.append(part.standard)
        current.append(part.current)
        use.append(part.use)
        motor_use.append(part.motor_use)
        time.append(part.time_s)
        move.append(part.move - int(part.move.min()) + first_move)
        first_move = int(move[-1].max()) + 1
        run.append(np.full(part.use.shape[1], index, dtype=np.int64))
        name = None if data.payload is None else data.payload.mounting
        names = [payload.mounting for payload in payloads]
        mounting.append(np.full(part.use.shape[1], -1 if name is None else names.index(name), dtype=np.int64))
    columns = np.concatenate(standard, axis=2)
    used = np.concatenate(use, axis=1)
    for joint, rows in enumerate(used):
        if not rows.any():
            raise DataUnfit(
                datasets[0].name, f"joint {joint + 1} never moves faster than its standstill speed in any run"
            )
    base = base_parameters(_triangle(columns, used), tuple(column.name for column in model.columns))
    observation = Observation(
        drive_train=model.drive_train,
        columns=tuple(
            Column(name, model.columns[index].unit) for name, index in zip(base.names, base.independent, strict=True)
        ),
        base=base,
        current=np.concatenate(current, axis=1),
        robot=np.ascontiguousarray(columns[:, list(base.independent)]),
        flange=np.ascontiguousarray(columns[:, model.flange]),
        use=used,
        motor_use=np.concatenate(motor_use, axis=1),
        time_s=np.concatenate(time),
        run=np.concatenate(run),
        move=np.concatenate(move),
        mounting=np.concatenate(mounting),
        payloads=payloads,
        payload_columns=(),
        runs=tuple(data.name for data in datasets),
        conditioning=conditioning,
    )
    return _with_payloads(observation)


@dataclass(frozen=True, slots=True)
class _Part:
    standard: FloatArray
    current: FloatArray
    use: BoolArray
    motor_use: BoolArray
    time_s: FloatArray
    move: IntArray


def _decimated(model: Model, data: Dataset, conditioning: Conditioning) -> _Part:
    filter_ = row_filter(data, conditioning)
    samples = len(data.time_s)
    pieces = [filter_(model.regressor(data.motion(part))) for part in chunks(filter_, samples)]
    use, motor_use = row_masks(model.drive_train, data, conditioning)
    centres = filter_.centres(samples)
    time_s = data.time_s[centres] - data.time_s[0]
    return _Part(np.concatenate(pieces, axis=2), filter_(data.current_a), use, motor_use, time_s, data.move[centres])


def _mountings(datasets: Sequence[Dataset]) -> tuple[Payload, ...]:
    found: dict[str, Payload] = {}
    for data in datasets:
        if data.payload is not None:
            other = found.setdefault(data.payload.mounting, data.payload)
            if other != data.payload:
                raise DataUnfit(
                    data.name,
                    f"mounting {data.payload.mounting!r} carries {data.payload} here and {other} in another run; "
                    "give each way of mounting a name of its own",
                )
    return tuple(found.values())


def _triangle(columns: FloatArray, use: BoolArray) -> FloatArray:
    """R of the QR factorisation of all used rows, joint by joint (TSQR)."""
    triangles = [np.linalg.qr(columns[joint][:, use[joint]].T, mode="r") for joint in range(len(use))]
    return np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))


def _with_payloads(observation: Observation) -> Observation:
    chosen: list[tuple[int, ...]] = []
    for index, payload in enumerate(observation.payloads):
        rows = observation.mounting == index
        triangle = _triangle(observation.flange[:, :, rows], observation.use[:, rows])
        unknown = tuple(i for i, name in enumerate(LINK_PARAMETERS) if name not in payload.known)
        names = tuple(LINK_PARAMETERS[i] for i in unknown)
        seen = base_parameters(triangle[:, list(unknown)], names) if unknown else None
        chosen.append(tuple(unknown[i] for i in seen.independent) if seen else ())
    return replace(observation, payload_columns=tuple(chosen))


def require_distinct(observation: Observation, *, gains: bool) -> None:
    """Refuse rows that cannot tell their unknowns apart.

    Args:
        observation: rows of the fit.
        gains: whether the gains are unknown too.

    Raises:
        RankDeficient: [W | W_uL | W_kL χ_kL] has dependent columns, as when every run carries the payload, or a
            motor's current is constant zero.
    """
    parts = [observation.linear()]
    names = tuple(column.name for column in observation.unknowns)
    if observation.payloads:
        parts.append(observation.known()[:, None])
        names += ("known payload",)
    lost = _dependent(np.concatenate(parts, axis=1), observation.use, names)
    if lost:
        raise RankDeficient("payload and robot cannot be told apart: record the same robot without load too", lost)
    if gains:
        for motor, current in enumerate(observation.current):
            if not np.any(current[observation.motor_use[motor]]):
                name = f"gain {motor + 1}"
                raise RankDeficient(
                    f"the current of motor {motor + 1} is zero throughout: is its channel connected?", (name,)
                )


def _dependent(columns: FloatArray, use: BoolArray, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the columns that the ones before them can make up."""
    independent = base_parameters(_triangle(columns, use), names).independent
    return tuple(name for index, name in enumerate(names) if index not in independent)
