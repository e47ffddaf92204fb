"""From runs to an estimate: all gains and all parameters in one global step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, as_array, require_kind
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.data.run import Run
from ident.equations.reduction import reduce_runs
from ident.equations.rows import Observation, observe
from ident.equations.system import System, require_distinct
from ident.errors import DataUnfit, IdentificationError, ModelContradicted, ModelError, PayloadUnseen, RolesExchanged
from ident.estimators.diagnosis import idle_joints, joint_torques, require_signs, require_weight
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.least_squares import ls, tls, wls
from ident.estimators.maximum_likelihood import iv, ml
from ident.estimators.method import Method
from ident.model.bodies import Payload
from ident.model.model import Model

LARGEST_STD = 0.1
"""Relative σ of every gain at once. Twenty short moves give 0.02; a payload in the wrong runs 0.25 and more."""
LEAST_WEIGHT = 1e-3
"""Share of the known payload's torque in a joint's, where it is largest. In a recording it is 0.1 and more."""
LARGEST_TOTAL_PERCENT = 50.0
LARGEST_AXIS_PERCENT = 100.0
LARGEST_UNKNOWN_PERCENT = 25.0
"""Largest relative errors of a fit. A robot with every effect undeclared stays below 15 in total and 40 on an axis; a
model that explains nothing leaves 100. The last is of an axis whose gain is smaller than its own σ."""
COLLAPSED_GAIN = 1e-6  #: Share of the largest gain: no two drives differ as much, and the error of nothing is small


@dataclass(frozen=True, slots=True)
class Identification:
    """An estimate with the equations it rests on, and those that it has not seen."""

    model: Model  #: the declared model
    conditioning: Conditioning  #: the filters
    system: System  #: of the fit
    holdout: System | None  #: of the runs that were held out, with the unknowns of the fit; None without any
    estimate: Estimate  #: from ``system`` alone
    #: All runs, held-out runs last, and their rows; none unless they were asked for.
    gathered: tuple[tuple[Dataset, ...], Observation] | None = None

    @property
    def training_error(self) -> RelativeError:
        """Relative error on the rows of the fit [%]."""
        return self.estimate.relative_error(self.system)

    @property
    def holdout_error(self) -> RelativeError | None:
        """Relative error on held-out rows [%]; None without any."""
        return None if self.holdout is None else self.estimate.relative_error(self.holdout)

    @property
    def current_residual(self) -> tuple[float, ...] | None:
        """Root mean square of what is left of each motor's current, as `Calibration.current_residual`.

        None where a motor has no rows.
        """
        left = np.full(len(self.estimate.gains), np.nan)
        for system in (self.system, self.holdout):
            if system is not None:
                seen = system.motors.rows > 0
                size = system.currents.noise(self.estimate.gains, self.estimate.parameters)
                left[seen] = size[seen]
        return tuple(float(f"{one:.6g}") for one in left) if np.isfinite(left).all() else None


def identify(
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning,
    *,
    holdout: Iterable[Run] = (),
    method: Method | str = Method.ML,
    fixed_gains: FloatArray | None = None,
    keep_rows: bool = False,
    judge: bool = True,
    axes: Sequence[str] | None = None,
) -> Identification:
    """Identify all gains and parameters in one global step; runs are read one after the other.

    Args:
        model: the declared model.
        runs: of the fit: without load, and with a weighed payload where the gains are free.
        conditioning: the filters.
        holdout: runs that the fit must not see; their payload mountings must be among those of ``runs``.
        method: estimator, or its name.
        fixed_gains: known gains, shape (m,).
        keep_rows: keep all runs and their rows, for a search for effects by ``ml``; otherwise no run is kept.
        judge: refuse a fit that its data contradict; False where effects are declared that the model lacks here.
        axes: name of each axis in messages, shape (m,); that of its joint when None.

    Raises:
        ModelError: an argument is of another type, there is no such method, or no gain for each motor.
        RolesExchanged, ModelContradicted: see `require_plausible`. A reversed current only reverses its gain's sign.
        UnitsMistaken, CurrentReversed: with fixed gains.
        DataUnfit, RankDeficient, TooFewMoves, PayloadUnseen, NotConverged: see reduction and estimators.
    """
    require_kind("model", model, Model, "write Model(robot, drive_train)")
    require_kind("conditioning", conditioning, Conditioning, "write Conditioning()")
    method = Method(method)
    if fixed_gains is not None:
        fixed_gains = as_array("fixed_gains", fixed_gains, (model.robot.axis_count,), "one per motor")
        if not fixed_gains.all():
            raise ModelError(f"fixed_gains is {fixed_gains.tolist()}; expected no zero: such a motor moves nothing")
    reduction = reduce_runs(model, each_run(runs), conditioning, instruments=method is Method.IV, keep_rows=keep_rows)
    if not reduction.runs:
        raise DataUnfit("", "no run was given; expected one without load and one with a weighed payload")
    system = reduction.system(reduction.base(), reduction.payload_columns())
    require_distinct(system, gains=fixed_gains is None)
    estimate = estimate_with(method, system, fixed_gains)
    jackknifed = estimate
    if fixed_gains is None:
        # The deviations of the linear estimates are those of independent rows (eqs. 10, 23) and do not see that moves
        # contradict each other; ml's do, where it has an estimate.
        with suppress(IdentificationError):
            jackknifed = estimate if method.is_of_currents else ml(system)
        require_seen_payload(jackknifed, system)
    axes = axes or [joint.name for joint in model.robot.axes]
    if fixed_gains is not None:
        require_weight(system, estimate)
        require_signs(system, estimate, axes)
    if judge:
        idle = idle_joints(model, *joint_torques(system, estimate))
        require_plausible(jackknifed, estimate.relative_error(system), axes, idle)
    rest = reduce_runs(
        model, each_run(holdout, system.payloads), conditioning, payloads=system.payloads, keep_rows=keep_rows
    )
    unseen = rest.system(system.base, system.payload_columns) if rest.runs else None
    found = Identification(model, conditioning, system, unseen, estimate)
    if not keep_rows:
        return found
    kept = (*reduction.kept, *rest.kept)
    return replace(found, gathered=(tuple(run.data for run in kept), observe(model, kept, conditioning, system)))


def require_seen_payload(estimate: Estimate, system: System) -> None:
    """Refuse gains if the data do not fix their common scale.

    The weight of the payload fixes it. If a run is declared loaded but was not, or the other way round, its moves
    disagree with the others about the scale, and σ of all gains grows together. Gains beside which that weight is
    nothing have no scale, however small their σ.

    Raises:
        PayloadUnseen: every gain is uncertain by more than LARGEST_STD, or the weight is below LEAST_WEIGHT.
    """
    relative, rows = estimate.gains_std / np.abs(estimate.gains), system.joints.factors
    torque = [LEAST_WEIGHT * np.linalg.norm(factor[:, : len(relative)] @ estimate.gains) for factor in rows]
    weightless = all(np.linalg.norm(factor[:, -1]) < least for factor, least in zip(rows, torque, strict=True))
    if weightless or not float(np.min(relative)) <= LARGEST_STD:
        raise PayloadUnseen(tuple(float(100.0 * value) for value in relative), system.runs)


def require_plausible(
    estimate: Estimate, error: RelativeError, axes: Sequence[str], idle: BoolArray | None = None
) -> None:
    """Refuse a fit whose model contradicts its data: no number of it can be believed, however small its σ.

    The payload's weight sets the sign of all gains. Taken from the wrong runs it reverses them, and all torques with
    them: the residual stays the same, but the dry friction of every joint then drives the robot.

    Args:
        estimate: with σ of its gains.
        error: of the fit.
        axes: name of each axis.
        idle: of `idle_joints`: a relative error of nothing is nothing, where the gain is known; none when None.

    Raises:
        ModelContradicted: the relative error is above one of the LARGEST_..._PERCENT, or a gain has collapsed.
        RolesExchanged: dry friction is negative on every joint, on most of them by more than five σ.
    """
    unknown = estimate.gains_std > np.abs(estimate.gains)
    excess = np.array(error.axes) / np.where(unknown, LARGEST_UNKNOWN_PERCENT, LARGEST_AXIS_PERCENT)
    if idle is not None:
        excess[idle & ~unknown] = 0.0
    size = np.abs(estimate.gains)
    excess[size < COLLAPSED_GAIN * size.max()] = np.inf
    worst = 0 if np.isnan(excess).all() else int(np.nanargmax(excess))
    if not (error.total <= LARGEST_TOTAL_PERCENT and excess[worst] <= 1.0):
        raise ModelContradicted(
            "the fit",
            found=f"a relative error of {error.total:.3g} % in total, {error.axes[worst]:.3g} % on axis {axes[worst]}, "
            f"with a gain of {estimate.gains[worst]:.3g} ± {estimate.gains_std[worst]:.2g}",
            expected=f"some 3 to 15 %, below {LARGEST_TOTAL_PERCENT:g} % and on every axis {LARGEST_AXIS_PERCENT:g} %, "
            f"{LARGEST_UNKNOWN_PERCENT:g} % where a gain is smaller than its σ",
            remedy="look for what contradicts the model: two channels exchanged or one reversed, a wrong drive train, "
            "gravity or URDF, positions not in rad, a payload or drawing that is not of the body that was mounted",
        )
    parameters = zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    dry = [(one.name, v, std) for one, v, std in parameters if one.name.startswith("fs") and one.name[2:].isdigit()]
    if dry and all(v < 0.0 for _, v, _ in dry) and np.median([v + 5.0 * std for _, v, std in dry]) < 0.0:
        raise RolesExchanged(
            "the dry friction of all joints",
            found=", ".join(f"{name} = {v:.3g} ± {std:.2g}" for name, v, std in dry),
            expected="above 0, because friction takes energy",
            remedy="were the payload's run and the run without load exchanged? do fixed gains have the right sign?",
        )


def each_run(runs: Iterable[Run], payloads: tuple[Payload, ...] | None = None) -> Iterator[Run]:
    """Yield runs with a known mounting, or with any; refuse anything else."""
    require_kind("runs or holdout", runs, Iterable, "give a list: [bare, loaded]")
    for run in runs:
        require_kind("an entry of the runs", run, Run, "write Run(name, time_s, position_rad, current_a)")
        if run.payload is not None:
            require_kind(f"payload of {run.name!r}", run.payload, Payload, "write Payload(name, mounting, known)")
            if payloads is not None and run.payload.mounting not in (known.mounting for known in payloads):
                mounting = f"mounting {run.payload.mounting!r}, which no run of the fit carries"
                raise DataUnfit(run.name, f"held out with {mounting}: it stays unknown")
        yield run


def estimate_with(method: Method, system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Run one estimator by its name.

    Raises:
        DataUnfit: ``tls`` with fixed gains: it has nothing to correct then.
    """
    if method is Method.TLS:
        if fixed_gains is not None:
            raise DataUnfit(", ".join(system.runs), "tls needs free gains; with fixed gains choose ls, wls, ml or iv")
        return tls(system)
    return {Method.LS: ls, Method.WLS: wls, Method.ML: ml, Method.IV: iv}[method](system, fixed_gains)
