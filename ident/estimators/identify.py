"""From runs to an estimate: all gains and all parameters in one global step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.equations.reduction import reduce_runs
from ident.equations.system import System, require_distinct
from ident.errors import DataUnfit, ModelError, NotConverged, PayloadUnseen, RankDeficient, TooFewMoves
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.least_squares import ls, tls, wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.model.bodies import Payload
from ident.model.model import Column, Model

LARGEST_STD = 0.1
"""Relative σ of every gain at once. Twenty short moves give 0.02; a payload in the wrong runs 0.25 and more."""


@dataclass(frozen=True, slots=True)
class Identification:
    """An estimate with the equations it rests on, and those that it has not seen.

    Attributes:
        model: the declared model.
        conditioning: the filters.
        system: of the fit.
        holdout: of the runs that were held out, with the unknowns of the fit; None without any.
        estimate: from ``system`` alone.
    """

    model: Model
    conditioning: Conditioning
    system: System
    holdout: System | None
    estimate: Estimate

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of W: base parameters, then effects."""
        return self.system.columns

    @property
    def training_error(self) -> RelativeError:
        """On the rows of the fit [%]."""
        return self.estimate.relative_error(self.system)

    @property
    def holdout_error(self) -> RelativeError | None:
        """On the rows that the fit has not seen [%]."""
        return None if self.holdout is None else self.estimate.relative_error(self.holdout)


def identify(
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning,
    *,
    holdout: Iterable[Run] = (),
    method: Method = Method.ML,
    fixed_gains: FloatArray | None = None,
) -> Identification:
    """Identify all gains and parameters in one global step; runs are read one after the other and none is kept.

    Args:
        model: the declared model.
        runs: of the fit: without load, and with a weighed payload where the gains are free.
        conditioning: the filters.
        holdout: runs that the fit must not see; their payload mountings must be among those of ``runs``.
        method: estimator.
        fixed_gains: known gains, shape (n,).

    Raises:
        ModelError: the fixed gains are not one for each motor.
        DataUnfit, RankDeficient, TooFewMoves, PayloadUnseen, NotConverged: see reduction and estimators.
    """
    if fixed_gains is not None:
        fixed_gains = np.asarray(fixed_gains, dtype=np.float64)
        if fixed_gains.shape != (model.robot.joint_count,):
            raise ModelError(f"fixed_gains has shape {fixed_gains.shape}; expected ({model.robot.joint_count},)")
    reduction = reduce_runs(model, runs, conditioning)
    system = reduction.system(reduction.base(), reduction.payload_columns())
    require_distinct(system, gains=fixed_gains is None)
    estimate = estimate_with(method, system, fixed_gains)
    if fixed_gains is None:
        judged = estimate
        # The deviations of the linear estimates are those of independent rows (eqs. 10, 23) and do not see that moves
        # contradict each other; ml's do, where it has an estimate.
        with suppress(DataUnfit, NotConverged, RankDeficient, TooFewMoves):
            judged = estimate if method is Method.ML else ml(system)
        require_seen_payload(judged, system)
    rest = reduce_runs(model, _mounted_among(holdout, system.payloads), conditioning, payloads=system.payloads)
    unseen = rest.system(system.base, system.payload_columns) if rest.runs else None
    return Identification(model, conditioning, system, unseen, estimate)


def require_seen_payload(estimate: Estimate, system: System) -> None:
    """Refuse gains if the data do not fix their common scale.

    The weight of the payload fixes it. If a run is declared loaded but was not, or the other way round, its moves
    disagree with the others about the scale, and σ of all gains grows together.

    Raises:
        PayloadUnseen: every gain is uncertain by more than LARGEST_STD.
    """
    relative = estimate.gains_std / np.abs(estimate.gains)
    if float(np.min(relative)) > LARGEST_STD:
        raise PayloadUnseen(tuple(float(100.0 * value) for value in relative), system.runs)


def _mounted_among(runs: Iterable[Run], payloads: tuple[Payload, ...]) -> Iterator[Run]:
    known = {payload.mounting for payload in payloads}
    for run in runs:
        if run.payload is not None and run.payload.mounting not in known:
            mounting = f"mounting {run.payload.mounting!r}"
            raise DataUnfit(run.name, f"held out with {mounting}, which no run of the fit carries: it stays unknown")
        yield run


def estimate_with(method: Method, system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Run one estimator by its name.

    Raises:
        DataUnfit: ``tls`` with fixed gains: it has nothing to correct then.
    """
    if method is Method.LS:
        return ls(system, fixed_gains)
    if method is Method.WLS:
        return wls(system, fixed_gains)
    if method is Method.ML:
        return ml(system, fixed_gains)
    if fixed_gains is not None:
        raise DataUnfit(", ".join(system.runs), "tls needs free gains; with fixed gains choose ls, wls or ml")
    return tls(system)
