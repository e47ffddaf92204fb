"""Whether the geometry of a robot has changed since its calibration,
by one run that the fit has not seen.

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
    """Name the change of the geometry that explains the error of a prediction;
    None where none does.

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
    model = replace(corrected, robot=replace(corrected.robot, declared_gravity_m_s2=None))
    slow = at_rows(corrected_dataset(data, corrections), conditioning)
    move = data.move[np.searchsorted(data.time_s, slow.time_s).clip(0, len(data.move) - 1)]
    standard = model.with_payload(
        standard_parameters(calibration, model), payload_of(calibration, data)
    )
    gains = np.array([gain.value for gain in calibration.gains])
    signals = declared_signals(
        model, slow, standard, gains, calibration.session_began_s, inertia=False
    )
    scale = np.array([_rms(row[used]) for row, used in zip(left_nm, use, strict=True)])
    weight = np.where(use, 1.0 / np.maximum(scale, np.finfo(np.float64).tiny)[:, None], 0.0)
    payload_nm = np.empty((0, *left_nm.shape))
    if data.payload is not None:
        payload_nm = np.moveaxis(model.regressor(slow.motion())[:, model.flange], 1, 0)
    # Of a closed chain the signals have the joints without a motor, too, behind those of the axes.
    velocity = signals.velocity_rad_s[: len(left_nm)]
    nuisance = _nuisance(signals.geared_torque_nm, velocity, payload_nm)
    nuisance = as_recorded(slow.rate_hz, conditioning, nuisance)
    left = _beyond(nuisance, left_nm[:, None], weight)[:, 0]
    torque_nm = model.drive_train.direction.T @ signals.motor_torque_nm
    usual_nm = _usual_error_nm(calibration, torque_nm, use)
    usual = float(np.sum((usual_nm[:, None] * weight) ** 2))
    excess = float(np.sum(left**2)) - usual
    best: GeometryDrift | None = None
    for placed in _candidates(model):
        is_suspected = placed in suspected
        if not is_suspected and not excess > 0.0:
            continue  # the run is predicted as well as what was fitted
        change_nm = placed.effect.columns(signals, placed.axis)
        columns = _beyond(nuisance, as_recorded(slow.rate_hz, conditioning, change_nm), weight)
        if is_suspected:
            least = 0.0
        else:
            least = max(LEAST_SHARE * excess, SMALLEST_SHARE * float(np.sum(left**2)))
        found = _fitted(placed, columns, left, move, excess, least)
        if found is not None and (best is None or found.explained > best.explained):
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
    own = np.stack((torque_nm, velocity, np.sign(velocity), np.ones_like(velocity)))
    each = []
    for axis in range(len(velocity)):
        for shape in own:
            each.append(np.eye(len(velocity))[axis][:, None] * shape)
    return np.concatenate((np.stack(each), payload_nm))


def _beyond(nuisance: FloatArray, columns: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted columns, shape (m, p, r), less what the nuisance explains of them."""
    weighted = (nuisance * weight).reshape(len(nuisance), -1)
    scale = np.linalg.norm(weighted, axis=1)
    basis = weighted[scale > 0.0] / scale[scale > 0.0][:, None]
    out = np.moveaxis(columns * weight[:, None], 1, 0)
    flat = out.reshape(len(out), -1)
    solution = np.linalg.lstsq(basis.T, flat.T, rcond=1e-9)[0]
    return np.moveaxis((flat - solution.T @ basis).reshape(out.shape), 0, 1)


def _usual_error_nm(calibration: Calibration, torque_nm: FloatArray, use: BoolArray) -> FloatArray:
    """Error that a calibration leaves of such torques if nothing has changed,
    by the error of its fit, shape (m,).

    Not by the held-out run's: that may be the run that is judged.
    """
    share = np.nan_to_num(np.array(calibration.relative_error_percent.axes)) / 100.0
    size_nm = np.array([_rms(row[used]) for row, used in zip(torque_nm, use, strict=True)])
    return np.asarray(share * size_nm)


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
    gram = np.einsum("mpr,mqr->pq", columns, columns)
    score = np.einsum("mpr,mr->pr", columns, left)
    if np.linalg.cond(gram) > 1e10 or not np.diag(gram).all():
        return None
    inverse = np.linalg.inv(gram)
    values = inverse @ score.sum(axis=1)
    rest = left - np.einsum("mpr,p->mr", columns, values)
    by_row = np.einsum("mpr,mr->pr", columns, rest)
    clusters = np.unique(move, return_inverse=True)[1]
    by_move = np.stack([np.bincount(clusters, weights=row) for row in by_row], axis=1)
    if len(by_move) < FEWEST_MOVES:
        return None
    spread = by_move @ inverse
    covariance = spread.T @ spread
    wald = float(values @ np.linalg.pinv(covariance) @ values)
    whole = float(np.sum(left**2))
    explained = whole - float(np.sum(rest**2))
    if explained < least or wald < CERTAIN_SIGMAS**2:
        return None
    bounds = zip(values, placed.effect.coefficients, strict=True)
    if any(not column.least <= value <= column.largest for value, column in bounds):
        return None
    share = min(1.0, explained / max(excess, explained))
    return GeometryDrift(placed, values, np.sqrt(np.diag(covariance)), share, explained)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
