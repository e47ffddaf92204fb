"""Currents that are late, beside a fit: of one motor, of several, or of all alike.

A late current leaves the rate of its motor's torque in the residual, and that of all currents the
rate of every motor's torque. An encoder that is late leaves nearly the same on some joints. So the
delays of all motors are fitted at once: where they are alike, the stamps of a recording are wrong,
or a filter delays every current; where they differ, each motor has a delay of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.candidates import FamilyTrials, SearchProblem
from ident.discovery.evidence import Evidence, coefficients_of, with_effects
from ident.discovery.gates import certain_delays
from ident.effects.effect import PlacedEffect, at_joints
from ident.effects.electrical import Lag, TimeSkew
from ident.effects.signals import fitted_signals, session_began_s
from ident.equations.rows import torques_at_rows

Delay = Lag | TimeSkew

ALIKE_SIGMAS = 2.5  #: Within which a delay is the common one
#: Of the common delay, within which a delay is the common one, too: filters differ a little
ALIKE_SHARE = 1.0 / 3.0
REFITS = 4  #: Refits with the filter of the delays found; see `ident.discovery.time_skew`
SETTLED = 0.1  #: Share of σ below which another refit is not worth its time


@dataclass(frozen=True, slots=True)
class LateCurrents:
    """Delays of currents, to first order."""

    effects: tuple[PlacedEffect, ...]  #: a time skew, or a lag of each motor whose current is late
    torque_nm: FloatArray  #: their columns at the joints, shape (m, p, r)
    seconds: FloatArray  #: the delays, shape (p,)
    left_out: FloatArray  #: ‖e‖² of each fold with them, shape (folds,)


def rough_torque_rates(evidence: Evidence) -> FloatArray:
    """Rate of each motor's predicted torque by differences of rows [Nm/s], shape (m, r).

    It takes no time, and misses a third of what `torque_rates` has: enough to see whether a current
    may be late.
    """
    rows = evidence.training
    predicted_nm = evidence.estimate.predicted_torque(rows)
    torque_nm = evidence.model.drive_train.to_motor @ predicted_nm
    rates = np.zeros_like(torque_nm)
    for run in np.unique(rows.run):
        own = rows.run == run
        rates[:, own] = np.gradient(torque_nm[:, own], rows.time_s[own], axis=1)
    return rates


def torque_rates(evidence: Evidence) -> FloatArray:
    """Rate of each motor's predicted torque on the rows of a fit [Nm/s], shape (m, r).

    It is built at full rate, because torque jumps where a joint turns back, and one run after the
    other, because the signals of a run are large.
    """
    began_s = session_began_s(evidence.fit_runs)
    parts: list[FloatArray] = []
    for data in evidence.fit_runs:
        signals = fitted_signals(
            evidence.model, data, evidence.training, evidence.estimate, began_s, inertia=False
        )
        rate = -TimeSkew().columns(signals, 0)[:, 0]
        parts.append(torques_at_rows(data, evidence.conditioning, rate))
    return np.concatenate(parts, axis=-1)


def delay_columns(
    problem: SearchProblem, placed: PlacedEffect, rates_nm_s: FloatArray
) -> FloatArray:
    """Torque at the joints per second of a delay [Nm/s], shape (m, 1, r).

    Args:
        problem: around the fit.
        placed: a lag or a time skew, without a filter.
        rates_nm_s: from `torque_rates`, shape (m, r).
    """
    if isinstance(placed.effect, TimeSkew):
        columns = -rates_nm_s[:, None]
    else:
        columns = -rates_nm_s[placed.axis][None]
    return at_joints(placed.effect, placed.axis, columns, problem.model.drive_train)


def try_delays(problem: SearchProblem, rates_nm_s: FloatArray) -> tuple[FamilyTrials, ...]:
    """Trials of the delay of each current alone, and of all currents alike.

    Args:
        problem: around the fit.
        rates_nm_s: from `torque_rates`, shape (m, r).
    """
    lags = [PlacedEffect(Lag(), axis) for axis in range(problem.axes)]
    placed = [*lags, PlacedEffect(TimeSkew(), 0)]
    torques = (delay_columns(problem, one, rates_nm_s) for one in placed)
    return problem.test_each(placed, torques)


def find_late_currents(
    problem: SearchProblem, tested: Sequence[FamilyTrials], rates_nm_s: FloatArray
) -> LateCurrents | None:
    """Fit the delays of all currents at once, and say which are late; None where none is certain.

    Args:
        problem: around the fit.
        tested: from `try_delays`: the delays that the model does not contain.
        rates_nm_s: from `torque_rates`, shape (m, r).
    """
    axes = [family.axis for family in tested if isinstance(family.members[0][0], Lag)]
    lags = tuple(PlacedEffect(Lag(), axis) for axis in axes)
    skews = [family for family in tested if isinstance(family.members[0][0], TimeSkew)]
    if not lags:
        return None
    of_each = [delay_columns(problem, one, rates_nm_s) for one in lags]
    columns = np.concatenate(of_each, axis=1)
    (trial,) = problem.trials([columns])
    if trial is None:
        return None
    seconds = trial.coefficients
    # Of fewer currents, nothing says that the others are late by the same time.
    are_all_tested = 2 <= len(lags) == problem.axes
    if skews and are_all_tested and _are_alike(seconds, trial.covariance):
        effect, of_skew = skews[0].members[0]
        placed = PlacedEffect(effect, skews[0].axis)
        return LateCurrents(
            effects=(placed,),
            torque_nm=delay_columns(problem, placed, rates_nm_s),
            seconds=of_skew.coefficients,
            left_out=of_skew.left_out.sum(axis=1),
        )
    late = np.flatnonzero(certain_delays(seconds, trial.deviations))
    if not len(late):
        return None
    own = columns[:, late]
    (of_late,) = problem.trials([own])
    if of_late is None:
        return None
    return LateCurrents(
        effects=tuple(lags[index] for index in late),
        torque_nm=own,
        seconds=of_late.coefficients,
        left_out=of_late.left_out.sum(axis=1),
    )


def _are_alike(seconds: FloatArray, covariance: FloatArray) -> bool:
    """Whether delays are one common delay, by the σ of each and what filters may differ by.

    Args:
        seconds: of each motor, shape (m,).
        covariance: of these, shape (m, m).
    """
    precision = np.linalg.pinv(covariance, hermitian=True)
    weights = precision.sum(axis=0) / precision.sum()
    common = float(weights @ seconds)
    # Each delay less the common one, and the σ of that.
    less_common = np.eye(len(seconds)) - weights
    differences = np.abs(less_common @ seconds)
    of_differences = less_common @ covariance @ less_common.T
    std = np.sqrt(np.diag(of_differences))
    allowed = np.maximum(ALIKE_SIGMAS * std, ALIKE_SHARE * abs(common))
    return bool(np.all(differences <= allowed))


def with_delays(
    evidence: Evidence, effects: Sequence[PlacedEffect], seconds: FloatArray
) -> Evidence:
    """Refit with delays in the model, each with the filter of second order (see `Lag`).

    Args:
        evidence: the fit without them.
        effects: the delays.
        seconds: their first values, shape (p,).

    Raises:
        NotConverged, RankDeficient: see `ident.identify`.
    """
    found = evidence
    values = seconds
    for _ in range(REFITS):
        delays = zip(effects, values.tolist(), strict=True)
        placed = [_with_filter(one, value) for one, value in delays]
        found = with_effects(evidence, (*evidence.effects, *placed))
        before = values
        fitted = [coefficients_of(found.estimate, one) for one in placed]
        values = np.concatenate([value for value, _ in fitted])
        std = np.concatenate([deviation for _, deviation in fitted])
        change = np.abs(values - before)
        if np.all(change < SETTLED * std):
            break
    return found


def _with_filter(placed: PlacedEffect, seconds: float) -> PlacedEffect:
    """A delay with its filter, T = c/2."""
    half_s = 0.5 * abs(seconds)
    settings = {"filter_s": float(f"{half_s:.4g}"), "backwards": int(seconds < 0.0)}
    return replace(placed, effect=placed.effect.with_settings(settings))
