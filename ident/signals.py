"""What an effect may depend on: motion, predicted load and predicted current, at full rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.dataset import Dataset
from ident.estimate import Estimate
from ident.model import Model
from ident.observation import Observation
from ident.payload import PAYLOAD_PARAMETERS

FloatArray = NDArray[np.float64]

CHUNK_SAMPLES = 4096


@dataclass(frozen=True, slots=True)
class Signals:
    """One run as an effect sees it; arrays are axis-first, shape (n, k).

    Torques and currents are the model's predictions, never measurements: a measured current in a regressor would put
    its noise on both sides of the equation.

    Attributes:
        rate_hz: sampling rate.
        time_s: since the start of the run, shape (k,).
        position_rad, velocity_rad_s, acceleration_rad_s2: of the joints.
        motor_position_rad: of the motors, R q.
        load_torque_nm: what links and payload ask of each joint, friction and drive chain left out.
        motor_torque_nm: what each motor must give, in joint units (g v), friction included.
        current_a: the same in the unit of the current reference.
    """

    rate_hz: float
    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    motor_position_rad: FloatArray
    load_torque_nm: FloatArray
    motor_torque_nm: FloatArray
    current_a: FloatArray


def signals(model: Model, data: Dataset, observation: Observation, estimate: Estimate) -> Signals:
    """Predict a run's torques with the declared part of an estimate.

    Args:
        model: the declared model.
        data: the run.
        observation: whose base parameters the estimate speaks of.
        estimate: gains and parameters; columns of effects, behind the base parameters, are left out.
    """
    names = tuple(column.name for column in model.columns)
    standard = np.zeros(len(names))
    independent = list(observation.base.independent)
    standard[independent] = estimate.parameters[: len(independent)]
    standard[model.flange] += _payload(data, observation, estimate)
    # A base parameter is named after its leading standard one; Ia of J1, regrouped into Izz1, thus counts as load.
    inertial = np.array([not name.startswith(("Ia", "fv", "fs", "off")) for name in names])
    load, total = [], []
    for first in range(0, len(data.time_s), CHUNK_SAMPLES):
        columns = model.regressor(data, slice(first, first + CHUNK_SAMPLES))
        load.append(np.einsum("jck,c->jk", columns, standard * inertial))
        total.append(np.einsum("jck,c->jk", columns, standard))
    motor = model.drive_train.to_motor @ np.concatenate(total, axis=1)
    return Signals(
        rate_hz=data.rate_hz,
        time_s=data.time_s - data.time_s[0],
        position_rad=data.position_rad,
        velocity_rad_s=data.velocity_rad_s,
        acceleration_rad_s2=data.acceleration_rad_s2,
        motor_position_rad=model.drive_train.ratio @ data.position_rad,
        load_torque_nm=np.concatenate(load, axis=1),
        motor_torque_nm=motor,
        current_a=motor / estimate.gains[:, None],
    )


def _payload(data: Dataset, observation: Observation, estimate: Estimate) -> FloatArray:
    inertial = np.zeros(10)
    if data.payload is None:
        return inertial
    for name, value in data.payload.known.items():
        inertial[PAYLOAD_PARAMETERS.index(name)] = value
    first = observation.robot.shape[1]
    for payload, indices in zip(observation.payloads, observation.payload_columns, strict=True):
        if payload.mounting == data.payload.mounting:
            inertial[list(indices)] = estimate.parameters[first : first + len(indices)]
        first += len(indices)
    return inertial
