"""From runs to an estimate: all gains and all parameters in one global step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, as_gains, require_kind, require_names, takes
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.data.run import Run, SeenRuns, require_entry, require_named, usual_conditioning
from ident.data.run_channels import RunChannels, channels_of, require_usable_channels
from ident.equations.instants import Instants, instants_of
from ident.equations.observation import Observation, observe
from ident.equations.reduction import reduce_built, regrouped, require_moved, rows_of_runs
from ident.equations.rows import Rows, rows_of
from ident.equations.system import System, require_distinct
from ident.errors import DataUnfit, IdentificationError
from ident.estimators.diagnosis import require_explained_currents
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.least_squares import ls, tls, wls
from ident.estimators.limited_currents import (
    LimitedCurrent,
    limited_currents,
    noting_limits,
    without_limited,
)
from ident.estimators.maximum_likelihood import iv, ml
from ident.estimators.method import Method
from ident.estimators.refusals import (
    idle_joints,
    joint_torques,
    require_plausible,
    require_seen_payload,
    require_signs,
    require_travel,
    require_weight,
    with_channel_causes,
    with_unit_causes,
)
from ident.model.bodies import Payload
from ident.model.model import Model


@takes(method=Method | str, keep_rows=bool | np.bool_, judge=bool | np.bool_)
def identify(
    model: Model,
    runs: Iterable[Run],
    conditioning: Conditioning | None = None,
    *,
    holdout: Iterable[Run] = (),
    method: Method | str = Method.ML,
    fixed_gains: ArrayLike | None = None,
    keep_rows: bool = False,
    judge: bool = True,
    axes: Sequence[str] | None = None,
) -> Identification:
    """Identify all gains and parameters in one global step; runs are read one after the other.

    Args:
        model: the declared model.
        runs: of the fit: without load, and with a weighed payload where the gains are free.
        conditioning: the filters; when None, those for the slowest of ``runs``
            (`Conditioning.for_rates`), which are then all read before the first is used.
        holdout: runs that the fit must not see; their payload mountings must be among those of
            ``runs``.
        method: estimator, or its name.
        fixed_gains: known gains, shape (m,).
        keep_rows: keep all runs and their rows, for a search for effects by ``ml``; otherwise no
            run is kept, and samples in which a drive gave less current than its reference are not
            looked for and stay in the fit.
        judge: refuse a fit that its data contradict; False where effects are declared that the
            model lacks here.
        axes: name of each axis in messages, shape (m,); that of its joint when None.

    Raises:
        ModelError: an argument is of another type, there is no such method, or no gain for each
            motor.
        RolesExchanged, ModelContradicted: see `require_plausible`. A reversed current only reverses
            its gain's sign.
        UnitsMistaken: an axis moves so much farther than its joint in the URDF that its positions
            are degrees or millimetres; or, as CurrentReversed, with fixed gains.
        CurrentUnsigned: see `ident.estimators.diagnosis.require_explained_currents`.
        CurrentConstant, ReadingsDamaged: see `ident.data.run_channels`.
        JointStill: a joint never moves in a run, and the fit has no usable number for that.
        DataUnfit: two runs have one name or the same samples; or see reduction.
        RankDeficient, TooFewMoves, PayloadUnseen, NotConverged: see reduction and estimators.
    """
    require_kind("model", model, Model, "write Model(robot, drive_train)")
    seen = SeenRuns()
    runs = each_run(runs, seen)
    if conditioning is None:
        runs = list(runs)
        conditioning = usual_conditioning(runs)
    require_kind("conditioning", conditioning, Conditioning, "write Conditioning()")
    method = Method(method)
    known_gains = _known_gains(fixed_gains, model)
    if axes is None:
        axes = [joint.name for joint in model.robot.axes]
    require_names("axes", axes, model.robot.axis_count)
    instants: list[Instants] = []
    channels: list[RunChannels] = []
    kept: list[BuiltRun] = []
    needs_instruments = method is Method.IV
    # `iv` refuses a redundant drive itself, which has no equation for one motor.
    builds_instruments = needs_instruments and not model.is_redundant
    # Each of these is a generator around the one before. Nothing is read before `reduce_built` asks
    # for a run, and a run passes all of them before the next one is read.
    signed = with_signed_currents(runs, model, conditioning, axes)
    built = rows_of_runs(model, signed, conditioning, instruments=builds_instruments)
    built = noting_channels(built, model, axes, channels)
    built = noting_instants(built, model, conditioning, instants)
    if keep_rows:
        built = keeping(built, kept)
    standard = reduce_built(model, built, instruments=needs_instruments)
    if not standard.runs:
        raise DataUnfit(
            "", "no run was given; expected one without load and one with a weighed payload"
        )
    require_moved(standard, axes)
    system = regrouped(standard)
    del standard  # its clusters have a column for every standard parameter: large
    with with_unit_causes(channels, model, axes), with_channel_causes(channels, axes):
        estimate = _checked_estimate(system, method, known_gains, axes, judge=judge)
    held_out = each_run(holdout, seen, system.payloads)
    signed = with_signed_currents(held_out, model, conditioning, axes)
    built = rows_of_runs(model, signed, conditioning)
    built = noting_channels(built, model, axes, [])  # refused as those of the fit, not reported
    if keep_rows:
        built = keeping(built, kept)  # behind the runs of the fit
    standard = reduce_built(model, built, payloads=system.payloads)
    holdout_system: System | None = None
    if standard.runs:
        holdout_system = regrouped(standard, system.base, system.payload_columns)
    found = Identification(
        model,
        conditioning,
        system,
        holdout_system,
        estimate,
        channels=tuple(channels),
        instants=tuple(instants),
    )
    if not keep_rows:
        return found
    datasets = tuple(data for data, _ in kept)
    rows = [rows_of_run for _, rows_of_run in kept]
    observation = observe(model, datasets, conditioning, system, rows)
    found = replace(found, gathered=(datasets, observation))
    limits = _limits_in_runs(observation, len(channels), estimate)
    if not limits:
        return found
    return _without_limited_currents(found, datasets, limits, known_gains, axes, judge=judge)


def _limits_in_runs(
    observation: Observation, run_count: int, estimate: Estimate
) -> tuple[LimitedCurrent, ...]:
    """Limits of the currents by the first runs, which are those of the fit.

    They may take samples of held-out runs out, but held-out runs decide nothing of the fit.
    """
    is_of_fit = observation.run < run_count
    return limited_currents(observation.only(is_of_fit), estimate)


def _checked_estimate(
    system: System,
    method: Method,
    fixed_gains: FloatArray | None,
    axes: Sequence[str],
    *,
    judge: bool,
) -> Estimate:
    """Run an estimator, and refuse an estimate that its data contradict.

    Args:
        system: of the fit.
        method: estimator.
        fixed_gains: known gains, shape (m,).
        axes: name of each axis.
        judge: the errors too.
    """
    require_distinct(system, gains=fixed_gains is None)
    estimate = estimate_with(method, system, fixed_gains)
    jackknifed = estimate
    if fixed_gains is None:
        # σ of the linear estimates is that of independent rows (eqs. 10, 23), which does not see
        # that moves contradict each other. The σ of ml does, as it is by leaving out moves: the
        # checks below use it, where ml has an estimate.
        if not method.is_of_currents:
            with suppress(IdentificationError):
                jackknifed = ml(system)
        require_seen_payload(jackknifed, system)
    else:
        require_weight(system, estimate)
        require_signs(system, estimate, axes)
    if judge:
        torque_sizes, residual_sizes = joint_torques(system, estimate)
        idle = idle_joints(system.model, torque_sizes, residual_sizes)
        error = estimate.relative_error(system)
        require_plausible(jackknifed, error, axes, idle)
    return estimate


def _known_gains(fixed_gains: ArrayLike | None, model: Model) -> FloatArray | None:
    """Gains that a caller holds fixed, shape (m,); None where they are free."""
    if fixed_gains is None:
        return None
    return as_gains("fixed_gains", fixed_gains, model.robot.axis_count)


def _without_limited_currents(
    found: Identification,
    datasets: Sequence[Dataset],
    limits: Sequence[LimitedCurrent],
    fixed_gains: FloatArray | None,
    axes: Sequence[str],
    *,
    judge: bool,
) -> Identification:
    """Fit again without the samples in which a drive gave less current than its reference.

    Args:
        found: the fit with all samples.
        datasets: all its runs, held-out runs last.
        limits: of its drives.
        fixed_gains: known gains, shape (m,).
        axes: name of each axis.
        judge: the errors too.

    Raises:
        DataUnfit, RankDeficient, PayloadUnseen, NotConverged: too little is left.
        IdentificationError: the data contradict the estimate, as those of the first fit might.
    """
    model = found.model
    conditioning = found.conditioning
    method = found.estimate.method
    kept = tuple(without_limited(data, limits) for data in datasets)
    rows = [tuple(rows_of(model, data, conditioning)) for data in kept]
    built = list(zip(kept, rows, strict=True))
    fit_count = len(found.channels)  # channels are of the runs of the fit alone
    standard = reduce_built(model, built[:fit_count], instruments=method is Method.IV)
    system = regrouped(standard)
    holdout = found.holdout
    if holdout is not None:
        held_out = reduce_built(model, built[fit_count:], payloads=system.payloads)
        holdout = regrouped(held_out, system.base, system.payload_columns)
    # Fewer samples may not distinguish what all of them did: the checks of the first fit hold here.
    causes = found.channels
    with with_unit_causes(causes, model, axes), with_channel_causes(causes, axes):
        estimate = _checked_estimate(system, method, fixed_gains, axes, judge=judge)
    observation = observe(model, kept, conditioning, system, rows)
    channels: list[RunChannels] = []
    for of_run, data in zip(found.channels, datasets[:fit_count], strict=True):
        channels.append(noting_limits(of_run, data, limits))
    return replace(
        found,
        system=system,
        holdout=holdout,
        estimate=estimate,
        gathered=(kept, observation),
        channels=tuple(channels),
    )


BuiltRun = tuple[Dataset, Sequence[Rows]]  #: A differentiated run and its rows, piece by piece


def noting_channels(
    built: Iterable[tuple[Dataset, Iterable[Rows]]],
    model: Model,
    axes: Sequence[str],
    noted: list[RunChannels],
) -> Iterator[tuple[Dataset, Iterable[Rows]]]:
    """Yield runs, and note the faults of their channels; refuse those that cannot be used."""
    for data, pieces in built:
        channels = channels_of(model, data)
        require_travel(channels, model, axes)
        require_usable_channels(channels, axes)
        noted.append(channels)
        yield data, pieces


def noting_instants(
    built: Iterable[tuple[Dataset, Iterable[Rows]]],
    model: Model,
    conditioning: Conditioning,
    noted: list[Instants],
) -> Iterator[tuple[Dataset, Iterable[Rows]]]:
    """Yield runs, and note a few rows of each, for hypotheses about its geometry."""
    for data, pieces in built:
        instants = instants_of(model, data, conditioning)
        if instants is not None:
            noted.append(instants)
        yield data, pieces


def keeping(
    built: Iterable[tuple[Dataset, Iterable[Rows]]], kept: list[BuiltRun]
) -> Iterator[BuiltRun]:
    """Yield runs, and keep each with all its rows."""
    for data, pieces in built:
        rows = tuple(pieces)
        kept.append((data, rows))
        yield data, rows


def each_run(
    runs: Iterable[Run], seen: SeenRuns, payloads: tuple[Payload, ...] | None = None
) -> Iterator[Run]:
    """Yield runs with a known mounting, or with any; refuse anything else.

    Args:
        runs: of a caller.
        seen: the runs so far, to which these are added.
        payloads: with the known mountings; None where any is allowed.
    """
    require_kind("runs or holdout", runs, Iterable, "give a list: [bare, loaded]")
    for run in runs:
        require_entry(run)
        require_named(run)
        seen.add(run)
        if run.payload is not None and payloads is not None:
            mountings = {known.mounting for known in payloads}
            if run.payload.mounting not in mountings:
                mounting = f"mounting {run.payload.mounting!r}, which no run of the fit carries"
                raise DataUnfit(run.name, f"held out with {mounting}: it stays unknown")
        yield run


def with_signed_currents(
    runs: Iterable[Run], model: Model, conditioning: Conditioning, axes: Sequence[str]
) -> Iterator[Run]:
    """Yield runs, and refuse one in which drives report the size of the current only.

    A run is judged after it was yielded, when the next one is asked for. It has been differentiated
    by then, which refuses what is no recording, in words that fit better.
    """
    for run in runs:
        yield run
        valid = run.valid
        if valid is not None:
            valid = np.asarray(valid, dtype=np.bool_)
        arrays = replace(
            run,
            time_s=np.asarray(run.time_s, dtype=np.float64),
            position_rad=np.asarray(run.position_rad, dtype=np.float64),
            current_a=np.asarray(run.current_a, dtype=np.float64),
            valid=valid,
        )
        require_explained_currents(arrays, model, conditioning, axes)


def estimate_with(
    method: Method, system: System, fixed_gains: FloatArray | None = None
) -> Estimate:
    """Run one estimator by its name, with the gains held at ``fixed_gains``, shape (m,), if given.

    Raises:
        DataUnfit: ``tls`` with fixed gains: it has nothing to correct then.
    """
    match method:
        case Method.LS:
            return ls(system, fixed_gains)
        case Method.WLS:
            return wls(system, fixed_gains)
        case Method.ML:
            return ml(system, fixed_gains)
        case Method.IV:
            return iv(system, fixed_gains)
        case Method.TLS:
            if fixed_gains is not None:
                raise DataUnfit(
                    ", ".join(system.runs),
                    "tls needs free gains; with fixed gains choose ls, wls, ml or iv",
                )
            return tls(system)
