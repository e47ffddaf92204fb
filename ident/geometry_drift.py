"""Whether a robot's geometry has changed since its calibration, by one run it has not seen.

An encoder that lost its zero, or a base that was moved, leaves a part of the prediction's error
that is the derivative of the whole arm's torque (`ident.effects.geometry_corrections`). Friction
and gains change with temperature and wear, so what they explain is left out of the comparison: on
each axis the predicted torque, its speed, the direction of motion and a constant. So is what
another payload, or another way of mounting it, explains.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning, as_recorded
from ident.data.dataset import Dataset
from ident.effects.dictionary import GEOMETRY
from ident.effects.effect import PlacedEffect, is_placeable
from ident.effects.geometry_corrections import corrected_dataset
from ident.effects.signals import declared_signals
from ident.equations.rows import at_rows
from ident.model.model import Model
from ident.prediction import corrections_of, fitted_model, payload_of, standard_parameters

#: Of the squared error beyond that of the fit, friction and gains, that it must explain
LEAST_SHARE = 0.5
SMALLEST_SHARE = 0.03  #: Of the whole squared error that it must explain: less is not worth a word
CERTAIN_SIGMAS = 6.0  #: By which it must differ from zero: several are tried
FEWEST_MOVES = 8  #: Of the scatter that σ comes from


@dataclass(frozen=True, slots=True)
class GeometryDrift:
    """A change of the geometry since the calibration."""

    placed: PlacedEffect  #: the correction, on its axis
    values: FloatArray  #: of its coefficients, shape (p,)
    deviations: FloatArray  #: their σ by the scatter of moves, shape (p,)
    #: of the squared error that it explains, beyond what the fit leaves and friction and gains
    #: explain
    share: float
    explained: float  #: squared error that it explains, each axis weighted by its own error


def geometry_drift(
    calibration: Calibration,
    model: Model,
    data: Dataset,
    conditioning: Conditioning,
    left_nm: FloatArray,
    use: BoolArray,
    suspected: Collection[PlacedEffect] = (),
) -> GeometryDrift | None:
    """Name the change of the geometry that explains the error of a prediction; None without one.

    Of several, it is the one that explains most.

    Args:
        calibration: that predicts.
        model: the declared model.
        data: the run, differentiated.
        conditioning: the filters of the rows.
        left_nm: measured less predicted torque at the rows [Nm or N], shape (m, r).
        use: rows of each axis that count, shape (m, r).
        suspected: corrections of numbers that are known to differ from those of the run's own
            description. They need not explain most of the error: they are few, and named
            beforehand.
    """
    if model.is_redundant:
        return None  # internal preload hides a part of the torque
    corrections = corrections_of(calibration)
    # What has changed since is counted from the corrected gravity, not from the declared one.
    corrected = fitted_model(calibration, model)
    robot = replace(corrected.robot, declared_gravity_m_s2=None)
    model = replace(corrected, robot=robot)
    slow = at_rows(corrected_dataset(data, corrections), conditioning)
    nearest = np.searchsorted(data.time_s, slow.time_s)
    move = data.move[nearest.clip(0, len(data.move) - 1)]
    body = payload_of(calibration, data)
    standard = model.with_payload(standard_parameters(calibration, model), body)
    gains = np.array([gain.value for gain in calibration.gains])
    signals = declared_signals(
        model, slow, standard, gains, calibration.session_began_s, inertia=False
    )
    tiny = np.finfo(np.float64).tiny
    error_nm = np.maximum(_rms_of_axes(left_nm, use), tiny)
    weight = np.where(use, 1.0 / error_nm[:, None], 0.0)
    payload_nm = np.empty((0, *left_nm.shape))
    if data.payload is not None:
        regressor = model.regressor(slow.motion())
        payload_nm = np.moveaxis(regressor[:, model.flange], 1, 0)
    # Of a closed chain the signals have the joints without a motor, too, after those of the axes.
    velocity = signals.velocity_rad_s[: len(left_nm)]
    nuisance = _nuisance(signals.geared_torque_nm, velocity, payload_nm)
    nuisance = as_recorded(slow.rate_hz, conditioning, nuisance)
    left = _beyond(nuisance, left_nm[:, None], weight)[:, 0]
    torque_nm = model.drive_train.direction.T @ signals.motor_torque_nm
    usual_nm = _usual_error_nm(calibration, torque_nm, use)
    weighted_usual = usual_nm[:, None] * weight
    usual = float(np.sum(weighted_usual**2))
    whole = float(np.sum(left**2))
    excess = whole - usual
    best: GeometryDrift | None = None
    for placed in _candidates(model):
        least = max(LEAST_SHARE * excess, SMALLEST_SHARE * whole)
        if placed in suspected:
            least = 0.0
        elif not excess > 0.0:
            continue  # the run is predicted as well as what was fitted
        change_nm = placed.effect.columns(signals, placed.axis)
        columns_nm = as_recorded(slow.rate_hz, conditioning, change_nm)
        columns = _beyond(nuisance, columns_nm, weight)
        found = _fitted(placed, columns, left, move, excess, least)
        if found is None:
            continue
        if best is None or found.explained > best.explained:
            best = found
    return best


def _candidates(model: Model) -> Iterator[PlacedEffect]:
    for (effect,) in GEOMETRY:
        for axis in range(model.robot.axis_count):
            if is_placeable(effect, axis, model.robot):
                yield PlacedEffect(effect, axis)


def _nuisance(torque_nm: FloatArray, velocity: FloatArray, payload_nm: FloatArray) -> FloatArray:
    """What may have changed without a change of the geometry, shape (4 m + p, m, r).

    Args:
        torque_nm: of each axis, shape (m, r): a gain.
        velocity: of each axis, shape (m, r): friction and offset.
        payload_nm: columns of the mounted payload, shape (p, m, r); none without load.
    """
    direction = np.sign(velocity)
    constant = np.ones_like(velocity)
    of_each_axis: list[FloatArray] = []
    for axis_mask in np.eye(len(velocity)):
        for signal in (torque_nm, velocity, direction, constant):
            of_each_axis.append(axis_mask[:, None] * signal)
    return np.concatenate((np.stack(of_each_axis), payload_nm))


def _beyond(nuisance: FloatArray, columns: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted columns, shape (m, p, r), less what the nuisance explains of them."""
    weighted_nuisance = (nuisance * weight).reshape(len(nuisance), -1)
    size = np.linalg.norm(weighted_nuisance, axis=1)
    is_seen = size > 0.0
    basis = weighted_nuisance[is_seen] / size[is_seen][:, None]
    weighted = np.moveaxis(columns * weight[:, None], 1, 0)
    flat = weighted.reshape(len(weighted), -1)
    solution = np.linalg.lstsq(basis.T, flat.T, rcond=1e-9)[0]
    left = flat - solution.T @ basis
    return np.moveaxis(left.reshape(weighted.shape), 0, 1)


def _usual_error_nm(calibration: Calibration, torque_nm: FloatArray, use: BoolArray) -> FloatArray:
    """Error of such torques by the calibration's fit, if nothing has changed, shape (m,).

    Not by the held-out run: that may be the run that is judged.
    """
    error_percent = np.array(calibration.relative_error_percent.axes)
    share = np.nan_to_num(error_percent) / 100.0
    return np.asarray(share * _rms_of_axes(torque_nm, use))


def _fitted(
    placed: PlacedEffect,
    columns: FloatArray,
    left: FloatArray,
    move: IntArray,
    excess: float,
    least: float,
) -> GeometryDrift | None:
    """Least squares of one correction, with σ by moves; None where it is not certain enough.

    Args:
        placed: the correction.
        columns: its weighted columns, shape (m, p, r).
        left: the weighted error, shape (m, r).
        move: number of each row's move, shape (r,).
        excess: squared error beyond that of the fit.
        least: squared error that it must explain.
    """
    # Normal equations: XᵀX over axes and rows, Xᵀe row by row
    gram = np.einsum("mpr,mqr->pq", columns, columns)
    score = np.einsum("mpr,mr->pr", columns, left)
    has_columns = np.diag(gram).all()
    if not has_columns or np.linalg.cond(gram) > 1e10:
        return None
    inverse = np.linalg.inv(gram)
    values = inverse @ score.sum(axis=1)
    rest = left - np.einsum("mpr,p->mr", columns, values)
    # σ by the scatter of the moves: (XᵀX)⁻¹ Σ_c s_c s_cᵀ (XᵀX)⁻¹, s_c the score of a move
    rest_score = np.einsum("mpr,mr->pr", columns, rest)
    _, cluster_of_row = np.unique(move, return_inverse=True)
    by_parameter = [np.bincount(cluster_of_row, weights=row) for row in rest_score]
    by_move = np.stack(by_parameter, axis=1)
    if len(by_move) < FEWEST_MOVES:
        return None
    shift_of_move = by_move @ inverse
    covariance = shift_of_move.T @ shift_of_move
    wald = float(values @ np.linalg.pinv(covariance) @ values)
    whole = float(np.sum(left**2))
    explained = whole - float(np.sum(rest**2))
    if explained < least or wald < CERTAIN_SIGMAS**2:
        return None
    for value, column in zip(values, placed.effect.coefficients, strict=True):
        if not column.least <= value <= column.largest:
            return None
    share = min(1.0, explained / max(excess, explained))
    std = np.sqrt(np.diag(covariance))
    return GeometryDrift(placed, values, std, share, explained)


def _rms_of_axes(values: FloatArray, use: BoolArray) -> FloatArray:
    """Root mean square of each axis over the rows that count, shape (m,); 0 without any."""
    rms: list[float] = []
    for row, used in zip(values, use, strict=True):
        size = 0.0
        if used.any():
            size = float(np.sqrt(np.mean(row[used] ** 2)))
        rms.append(size)
    return np.array(rms)
