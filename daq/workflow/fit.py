"""From logs to a calibration."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path

import numpy as np

from daq.arguments import (
    A_FLAG,
    A_FUNCTION,
    A_LIST,
    A_MOMENT,
    A_WHOLE_NUMBER,
    PATHS,
    checks_arguments,
    of_kind,
    optional,
)
from daq.config.cell import Cell, model_of
from daq.config.effects import place_effect
from daq.config.policy import DEFAULT_APPLY_POLICY
from daq.config.same_cell import calibrated_robot
from daq.config.yaml_file import Fault
from daq.environment import software
from daq.errors import (
    ConfigurationInconsistent,
    EffectsRefuted,
    LogRepeated,
    LogsDiffer,
    UsageError,
)
from daq.log.conversion import load_run
from daq.log.reader import LossyLogs
from daq.workflow.diagnoses import (
    HIDING_EXCHANGES,
    Recordings,
    by_likelihood,
    check_diagnoses,
    correction_diagnoses,
    current_filter_diagnoses,
    diagnose_fit,
    geometry_beside,
    is_checked,
    named_causes,
    nameplate_of,
    open_correction_diagnoses,
    turned_geometry,
)
from daq.workflow.geometry_diagnoses import encoder_misfit_of
from daq.workflow.validate import Corrections, diagnose_log, with_described
from ident.arrays import FloatArray
from ident.calibration import Calibration, Source
from ident.calibration import calibration_of as identified_calibration
from ident.data.run import Run, content_digest
from ident.data.torque_channel import TorqueChannel, TorqueSlope, torque_slope
from ident.discovery.acceptance import accept_on_holdout
from ident.discovery.before_after import compare_on_holdout, error_on
from ident.discovery.current_filter import CurrentFilter, find_current_filter
from ident.discovery.declared import impossible_declared, with_declared
from ident.discovery.evidence import Evidence, gather, with_effects, without_effects
from ident.discovery.geometry_check import GeometryCheck
from ident.discovery.geometry_covariance import (
    evidence_with_geometry,
    geometry_covariance,
    with_geometry_covariance,
)
from ident.discovery.loop import Step, find_effects
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.friction import TemperatureFriction
from ident.errors import Diagnosis, EffectImpossible, IdentificationError, PayloadUnseen
from ident.estimators.comparison import EstimatorComparison, try_estimators
from ident.estimators.estimate import Estimate, Identification, RelativeError, of_squares
from ident.estimators.geometry_estimate import (
    GeometryFinding,
    Positions,
    estimate_geometry,
    thinned,
)
from ident.estimators.identify import estimate_with, identify
from ident.estimators.least_squares import tls
from ident.estimators.method import Method
from ident.estimators.refusals import require_plausible
from ident.estimators.turned_geometry import GEOMETRY
from ident.model.geometry import model_with_geometry
from ident.model.model import Model
from ident.planning.gain_verdict import GainVerdict


@dataclass(frozen=True, slots=True)
class Fit:
    """An identification with its cell and logs."""

    cell: Cell  #: as the logs describe it
    logs: tuple[Path, ...]  #: of the fit; they are read again where rows are needed
    holdout: tuple[Path, ...]  #: held out of the fit; read again likewise
    sources: tuple[Source, ...]  #: all of these, with digests and roles
    identification: Identification  #: the estimate without effects
    #: A step for each effect that the cell declares, then the turns of the loop; empty without
    #: either.
    steps: tuple[Step, ...]
    #: the paper's total least squares on the same equations, None with fixed gains
    paper: Estimate | None
    lossy: LossyLogs = LossyLogs.REFUSED  #: how logs with losses were handled
    #: description that replaces the one in the logs; None where that is used
    given_cell: Cell | None = None
    #: of the fit, with effects of the last one, and of each held-out log
    diagnoses: tuple[Diagnosis, ...] = ()
    is_holdout_judged: bool = False  #: whether the diagnoses are those of held-out logs, too
    #: Slope of each axis's own torque over its current, with the gains; empty where no log has
    #: such torques.
    torque_slopes: tuple[TorqueSlope | None, ...] = ()
    #: The operator takes all effects that were found, also what held-out runs would refute: these
    #: judge none of them.
    accept_worse_holdout: bool = False
    #: zeros, mounting and clocks by torque; None where it was not tested
    description: GeometryCheck | None = None
    channels_as_wired: bool = False  #: the operator says that no currents are exchanged
    #: What the encoders say of the geometry; None for a robot without redundant ones.
    geometry: GeometryFinding | None = None
    #: Covariance that the corrected geometry adds to gains and parameters; None where the described
    #: one was used.
    geometry_covariance: FloatArray | None = None
    #: of the fit before a search; empty where none was made
    diagnoses_before: tuple[Diagnosis, ...] = ()
    #: Low-pass that the currents went through before they were recorded, as the data show it; the
    #: fit is one with it. None where they show none, or where it was not looked for.
    current_filter: CurrentFilter | None = None
    #: Verdicts on the gains that are not known well enough; empty where all are, and before they
    #: are made.
    uncertain: tuple[GainVerdict, ...] = ()

    @property
    def is_corrected(self) -> bool:
        """Whether the identification is one with a corrected geometry."""
        return self.geometry_covariance is not None

    @property
    def estimate(self) -> Estimate:
        """Estimate with all declared and accepted effects."""
        if self.steps:
            return self.steps[-1].after.estimate
        return self.identification.estimate

    @property
    def final(self) -> Identification:
        """Identification with all accepted effects; their rows are reduced anew at each call."""
        if self.steps:
            return self.steps[-1].after.identification
        return self.identification

    def read(self, log: Path) -> tuple[Run, Cell]:
        """Read a log as the fit did, with the description of its cell."""
        return load_run(log, self.given_cell, self.lossy)

    @property
    def recordings(self) -> Recordings:
        """The logs of the fit, for what is looked for in them."""
        gains_fixed = self.identification.estimate.gains_fixed
        return Recordings(
            self.logs,
            self.read,
            gains_fixed,
            self.channels_as_wired,
            described=self.cell,
        )

    def evidence(self) -> Evidence:
        """The rows of the identification, without effects;
        the logs are read again unless it has kept them.
        """
        if self.identification.gathered is not None:
            return gather(self.identification)
        return gather(self.identification, self.runs(self.logs), self.runs(self.holdout))

    def runs(self, logs: Sequence[Path]) -> Iterator[Run]:
        """Read logs again, one after the other, with the description that the fit used."""
        for log in logs:
            yield load_run(log, self.cell, self.lossy)[0]


class Undecided(Enum):
    """Which effects join the model although held-out logs do not confirm them."""

    LEFT_OUT = "left out"  #: none
    JOIN = "join"  #: those that held-out logs do not refute either
    ALL_JOIN = "all join"  #: all: held-out logs judge none of them

    @classmethod
    def of(cls, *, write: bool, ignore_holdout: bool) -> Undecided:
        """Choose by what the operator asks for:
        to write undecided effects, or all whatever held-out logs say.
        """
        if ignore_holdout:
            return cls.ALL_JOIN
        return cls.JOIN if write else cls.LEFT_OUT


class LogLoader:
    """Logs of one cell, read one after the other, and their sources."""

    def __init__(
        self, first: dict[Path, Run], cell: Cell, read: Callable[[Path], tuple[Run, Cell]]
    ) -> None:
        self.cell = cell
        self.sources: list[Source] = []
        self._first = first  #: read already
        self._read = read
        self._seen: dict[bytes | None, Path] = {}
        self._torques: list[tuple[TorqueChannel, ...]] = []
        self._positions: list[Positions] = []
        self._corrections = Corrections()

    @classmethod
    def of(
        cls, logs: Sequence[Path], cell: Cell | None, lossy: LossyLogs = LossyLogs.REFUSED
    ) -> LogLoader:
        """Begin with the first log, whose cell is that of all unless another description is given.

        Raises:
            DataError, ConfigurationError: it cannot be used.
        """
        run, declared = load_run(logs[0], cell, lossy)
        return cls({logs[0]: run}, declared, lambda log: load_run(log, cell, lossy))

    def runs(self, logs: Sequence[Path], role: str) -> Iterator[Run]:
        """One run after the other; the first log is not read twice.

        Raises:
            LogsDiffer: a log is of another cell or configuration than the first one.
            LogRepeated: a recording was given twice: it would count twice, or be held out of
                nothing.
        """
        for log in logs:
            if log in self._first:
                run = self._first.pop(log)
                cell = self.cell
            else:
                run, cell = self._read(log)
            if cell.digest != self.cell.digest:
                digest = cell.digest[:12]
                expected_digest = self.cell.digest[:12]
                raise LogsDiffer(
                    str(log),
                    found=f"cell {cell.name!r}, configuration {digest}",
                    expected=f"cell {self.cell.name!r}, configuration {expected_digest}, as "
                    "in the first log",
                    remedy="fit logs of one cell and one configuration, or name the right one "
                    "with --cell",
                )
            self._corrections.note(log, run)
            # By its samples: a file that was rewritten is the same recording still.
            content = content_digest(run)
            if content in self._seen:
                first_log = self._seen[content]
                raise LogRepeated(
                    str(log),
                    found=f"the same recording as {first_log}",
                    expected="every recording once, in the fit or held out",
                    remedy="name other logs",
                )
            self._seen[content] = log
            if run.torque_channels and role == "fit":
                self._torques.append(run.torque_channels)
            if self.cell.chain is not None and role == "fit":
                self._positions.append(thinned(run))
            self.sources.append(_source_of(run, role))
            yield run

    def torque_slopes(self) -> tuple[TorqueSlope | None, ...]:
        """Slope of each axis's own torque over the runs of the fit; empty without such torques."""
        by_axis = zip(*self._torques, strict=True)
        return tuple(torque_slope(channels) for channels in by_axis)

    def geometry(self, model: Model) -> GeometryFinding | None:
        """What the encoders of the runs of the fit say of the geometry of a model.

        Raises:
            ModelError: the encoders contradict each other so much that no pose fits them.
        """
        if self._positions:
            return estimate_geometry(model, self._positions)
        return None


def _source_of(run: Run, role: str) -> Source:
    """The entry of a calibration that names the log of a run."""
    source = Source(run.name, run.digest, role, run.partial, recording=run.recording)
    if run.payload is None:
        return source
    return replace(
        source,
        payload=run.payload.name,
        mass_kg=run.payload.known.get("m"),
        mounting=run.payload.mounting,
    )


_LOG = logging.getLogger("drivegain")
BOOTSTRAP_SEED = 0  #: Of the significance tests, so that the same logs get the same verdicts


@checks_arguments(
    logs=PATHS,
    holdout=PATHS,
    cell=optional(of_kind(Cell)),
    effects=A_FLAG,
    created=optional(A_MOMENT),
    progress=A_FUNCTION,
    own_effects=A_LIST,
)
def fit_logs(
    logs: Sequence[Path | str],
    *,
    holdout: Sequence[Path | str] = (),
    cell: Cell | None = None,
    effects: bool = True,
    created: datetime | None = None,
    progress: Callable[[str], None] = lambda _: None,
    own_effects: Sequence[Effect] = (),
) -> Calibration:
    """Identify the gains from logs, detect and add missing effects, and return the calibration.

    Args:
        logs: at least one run without load and one with a weighed payload.
        holdout: held-out logs, on which the errors are reported.
        cell: corrected description of the same cell, which replaces the one in the logs.
        effects: detect effects that the declared model lacks, and refit with those that pass.
        created: time stamp of the calibration, with its time zone; now when None.
        progress: receives a line for each step.
        own_effects: effects that no installed package has, tried together with the others
            (`ident.Effect`).

    Raises:
        UsageError: an argument is of another type.
        DataError: a log cannot be read, its samples cannot be used, or held-out runs refute the
            effects found.
        ConfigurationError: the description of the cell is inconsistent.
        ident.IdentificationError: the runs do not identify the gains.
    """
    fitted = fit(
        logs,
        holdout=holdout,
        cell=cell,
        keep_rows=effects,
        judge_holdout=not effects,
    )
    if effects:
        fitted = close_loop(fitted, BOOTSTRAP_SEED, progress, own_effects=own_effects)
        check_holdout(fitted)
    return calibration_of(fitted, created or datetime.now(UTC))


@checks_arguments(
    logs=PATHS,
    holdout=PATHS,
    method=optional(of_kind(Method)),
    gains_fixed=A_FLAG,
    cell=optional(of_kind(Cell)),
    lossy=of_kind(LossyLogs),
    keep_rows=A_FLAG,
    channels_as_wired=A_FLAG,
    judge_holdout=A_FLAG,
)
def fit(
    logs: Sequence[Path | str],
    *,
    holdout: Sequence[Path | str] = (),
    method: Method | None = None,
    gains_fixed: bool = False,
    cell: Cell | None = None,
    lossy: LossyLogs = LossyLogs.REFUSED,
    keep_rows: bool = False,
    channels_as_wired: bool = False,
    judge_holdout: bool = True,
) -> Fit:
    """Identify gains and parameters.

    Args:
        logs: without load and with a weighed payload; any, where the gains are fixed.
        holdout: logs that the fit must not see.
        method: estimator; ``ml``, or with fixed gains the classical IDIM-WLS, when None.
        gains_fixed: hold the gains at their nameplate values.
        cell: corrected description of the same cell, which replaces the one in the logs.
        lossy: how to handle logs with losses.
        keep_rows: keep all rows for a search for effects, which then need not read the logs again.
        channels_as_wired: do not look for exchanged currents.
        judge_holdout: say what is wrong with held-out logs; a search that follows does it with the
            final model.

    Raises:
        UsageError: an argument is of another type.
        DataError, ConfigurationError, IdentificationError: see daq/errors.py and ident/errors.py.
    """

    recorded = [Path(log) for log in logs]
    held_out = [Path(log) for log in holdout]

    def attempt(
        used: Sequence[Path],
        unseen: Sequence[Path],
        method: Method,
        current_filter: CurrentFilter | None = None,
    ) -> Fit:
        reading = LogLoader.of(used, cell, lossy)
        declared = reading.cell
        if current_filter is not None:
            conditioning = current_filter.applied_to(declared.conditioning)
            declared = replace(declared, conditioning=conditioning)
        effects = declared_effects(declared)
        if method is Method.IV:
            refuse_effects(declared, "--method iv")
        model = model_of(declared)
        fixed_gains = nameplate_of(declared) if gains_fixed else None
        needs_rows = keep_rows or bool(effects) or is_checked((*used, *unseen))
        result = identify(
            model,
            reading.runs(used, "fit"),
            declared.conditioning,
            holdout=reading.runs(unseen, "holdout"),
            method=method,
            fixed_gains=fixed_gains,
            keep_rows=needs_rows,
            judge=not effects,
            axes=declared.axis_names,
        )
        steps = with_effects_of_cell(result, effects, declared.place_names)
        if result.gathered is not None and current_filter is None:
            found = find_current_filter(steps[-1].after if steps else gather(result))
            if found is not None:
                return attempt(used, unseen, method, found)
        last = steps[-1].after.identification if steps else result
        paper = None if gains_fixed else tls(last.system)
        return Fit(
            cell=declared,
            logs=tuple(used),
            holdout=tuple(unseen),
            sources=tuple(reading.sources),
            identification=result,
            steps=steps,
            paper=paper,
            lossy=lossy,
            given_cell=cell,
            torque_slopes=reading.torque_slopes(),
            channels_as_wired=channels_as_wired,
            geometry=reading.geometry(model),
            current_filter=current_filter,
        )

    chosen = method or (Method.WLS if gains_fixed else Method.ML)
    recordings = Recordings(
        tuple(recorded), lambda log: load_run(log, cell, lossy), gains_fixed, channels_as_wired
    )
    try:
        with named_causes(recordings):
            judged_fit = _with_diagnoses(attempt(recorded, held_out, chosen))
            if judge_holdout:
                return _with_holdout_judged(judged_fit)
            return judged_fit
    except PayloadUnseen as error:
        hint = contradicting_log(recorded, lambda rest: attempt(rest, (), Method.ML))
        raise PayloadUnseen(error.std_percent, error.runs, hint) from error


def contradicting_log(logs: Sequence[Path], fit_of: Callable[[Sequence[Path]], Fit]) -> str:
    """Name the log without which the payload is seen; empty where there is none."""
    for log in logs:
        try:
            rest = fit_of([other for other in logs if other != log]).estimate
        except IdentificationError:
            continue
        shares = rest.gains_std / np.abs(rest.gains)
        std = 100.0 * float(np.max(shares))
        return (
            f"without {log} they do (σ at most {std:.1f} %): was the payload of that run "
            "declared as it was?"
        )
    return ""


def judged(fitted: Fit) -> Fit:
    """Return a fit with all that is said of its recordings, or refuse it:
    `daq.workflow.diagnoses` has the order.

    Raises:
        IdentificationError: a mistake leaves no number that can be used.
    """
    return _with_holdout_judged(_with_diagnoses(fitted))


def _with_diagnoses(fitted: Fit) -> Fit:
    """Return a fit with what is said of the logs that it used, or refuse it;
    held-out logs are not judged yet.
    """
    turned = _turned_geometry_of(fitted)
    # Nothing else is said, and the description was tested in a wrong geometry
    if turned is not None:
        return replace(fitted, description=None, diagnoses=(turned,), is_holdout_judged=False)
    fitted = with_description(fitted)
    of_description = description_diagnoses(fitted)
    recordings = fitted.recordings
    # What is wrong with the description must not be blamed on the wiring.
    if any(one.name in HIDING_EXCHANGES for one in of_description):
        recordings = replace(recordings, channels_as_wired=True)
    of_fit = diagnose_fit(
        fitted.final,
        fitted.cell,
        recordings,
        fitted.geometry,
        corrected=fitted.is_corrected,
    )
    named = (*of_description, *current_filter_diagnoses(fitted.current_filter), *of_fit)
    return replace(fitted, diagnoses=named, is_holdout_judged=False)


def _turned_geometry_of(fitted: Fit) -> Diagnosis | None:
    """Another geometry that explains the logs of a fit clearly better; None without any.

    What a search adds does not turn the geometry, so that the answer of the fit before it holds
    where that is no.
    """
    has_searched = any(not step.declared for step in fitted.steps)
    was_turned = any(one.name in GEOMETRY for one in fitted.diagnoses_before)
    if has_searched and not was_turned:
        return None
    final = fitted.final
    return turned_geometry(
        fitted.recordings,
        fitted.identification.instants,
        final.training_error.total,
        final.model,
    )


def _with_holdout_judged(fitted: Fit) -> Fit:
    """Return a fit with what is said of its held-out logs after what is said of the others,
    unless it has that.
    """
    if fitted.is_holdout_judged:
        return fitted
    calibration = replace(_calibration(fitted), diagnoses=fitted.diagnoses)
    of_holdout: list[Diagnosis] = []
    for log in fitted.holdout:
        run, described = fitted.read(log)
        of_holdout += diagnose_log(calibration, log, run, described)
    return replace(fitted, diagnoses=(*fitted.diagnoses, *of_holdout), is_holdout_judged=True)


def with_description(fitted: Fit) -> Fit:
    """Test the declared geometry of a fit that has kept its rows, unless it was tested before.

    A search tests it again in each of its turns: gravity and the zeros that are hidden stay those
    of the fit before it.
    """
    if fitted.description is not None or fitted.identification.gathered is None:
        return fitted
    if fitted.steps:
        evidence = fitted.steps[-1].after
    else:
        evidence = fitted.evidence()
    return replace(fitted, description=geometry_beside(evidence, BOOTSTRAP_SEED))


def _with_description_after_search(closed: Fit) -> Fit:
    """Keep the mistakes that the fit before a search has named,
    unless the search has explained them.

    They are explained by corrections, or by effects with which the same test names them no more.
    """
    description = closed.description
    if description is None or not description.mistakes:
        return closed
    after = closed.steps[-1].after
    # Of a delay, the setting of its filter is fitted: the same effect has another one in the model.
    corrected = {(placed.effect.name, placed.axis) for placed in after.effects}
    if all((mistake.effect.name, mistake.axis) in corrected for mistake in description.mistakes):
        return replace(closed, description=replace(description, mistakes=()))
    if len(after.effects) == after.declared:  # the model is the one with which they were named
        return closed
    beside = geometry_beside(after, BOOTSTRAP_SEED)
    if beside is None:
        return replace(closed, description=replace(description, mistakes=()))
    # Gravity and hidden zeros stay those of the fit, and what it did not tell apart from a
    # correction that the search has made. Mistakes and their company are those of the final model.
    unclear = [alike for alike in description.alike if any(map(alike.contain, after.effects))]
    alike = (*unclear, *beside.alike)
    kept = replace(
        beside,
        gravity=description.gravity,
        hidden_zeros=description.hidden_zeros,
        hidden_pairs=description.hidden_pairs,
        alike=alike,
    )
    return replace(closed, description=kept)


def description_diagnoses(fitted: Fit) -> tuple[Diagnosis, ...]:
    """Name what is wrong with the declared geometry,
    by the search of a fit and by the test with it.

    The same mistake of the same axis is said once.
    """
    found: list[Diagnosis] = []
    has_searched = any(not step.declared for step in fitted.steps)
    if has_searched:
        last = fitted.steps[-1]
        found += correction_diagnoses(last.after, fitted.cell, fitted.description)
        found += open_correction_diagnoses(fitted.steps, fitted.cell, fitted.description)
    if fitted.description is not None:
        found += check_diagnoses(fitted.description, fitted.cell, fitted.identification.model)
    first: dict[tuple[str, tuple[str, ...]], Diagnosis] = {}
    for one in found:
        first.setdefault((one.name, one.axes), one)
    return tuple(first.values())


def compare_estimators(
    fitted: Fit, progress: Callable[[str], None] = lambda _: None
) -> EstimatorComparison:
    """Every estimator on the logs of a fit, which are read again for each filter.

    Raises:
        UsageError: its gains were held fixed, or the cell declares effects.
    """
    if fitted.estimate.gains_fixed:
        raise UsageError(
            "--compare",
            found="--gains fixed",
            expected="free gains: it is their estimators that differ",
            remedy="leave out one of the two",
        )
    refuse_effects(fitted.cell, "--compare")
    found = fitted.identification
    return try_estimators(
        found.model,
        lambda: fitted.runs(fitted.logs),
        found.conditioning,
        progress,
    )


DOUBTFUL_PERCENT = DEFAULT_APPLY_POLICY.max_error_percent  #: In total


@checks_arguments(
    start=of_kind(Fit),
    seed=A_WHOLE_NUMBER,
    progress=A_FUNCTION,
    undecided=of_kind(Undecided),
    own_effects=A_LIST,
)
def close_loop(
    start: Fit,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
    undecided: Undecided = Undecided.LEFT_OUT,
    own_effects: Sequence[Effect] = (),
) -> Fit:
    """Detect and add missing effects: refit with every effect that passes the gates and that
    held-out logs confirm.

    Args:
        start: of method ``ml``; another one is refitted by ``ml``, in whose terms candidates are
            judged.
        seed: of the bootstrap.
        progress: receives a line for each step.
        undecided: whether effects that held-out logs neither confirm nor refute join; all that were
            found join where `Undecided.ALL_JOIN` overrides the held-out logs.
        own_effects: effects that no installed package has, tried together with the others.

    Raises:
        IdentificationError: a refit failed.
    """
    described = start.estimate
    start = replace(_with_geometry_of_encoders(start), diagnoses_before=start.diagnoses)
    known = start.steps  # with what the cell declares
    evidence = known[-1].after if known else start.evidence()
    cold = [data.name for data in evidence.fit_runs if data.temperature_c is None]
    if 0 < len(cold) < len(evidence.fit_runs):
        _LOG.warning(
            "%s without temperatures: %s is not looked for",
            ", ".join(cold),
            TemperatureFriction.name,
        )
    before = start.identification
    by_ml = by_likelihood(before.estimate, before.system)
    if by_ml is not before.estimate:
        before = replace(before, estimate=by_ml)
        if known:
            evidence = with_declared_again(evidence, by_ml)
        else:
            evidence = replace(evidence, estimate=by_ml)
    rng = np.random.default_rng(seed)
    places = start.cell.place_names
    check = start.description
    # The check of the fit has not compared its mistakes with the effects of an argument: it is made
    # again.
    if check is None or own_effects:
        named = None
    else:
        named = check.certain_mistakes
    steps = find_effects(
        evidence, rng, progress=progress, axes=places, mistakes=named, own_effects=own_effects
    )
    if undecided is not Undecided.ALL_JOIN:
        join = undecided is Undecided.JOIN
        steps = accept_on_holdout(
            evidence, steps, rng=rng, write_undecided=join, progress=progress, axes=places
        )
    closed = _with_uncertain_geometry(replace(start, identification=before, steps=(*known, *steps)))
    closed = _with_description_after_search(closed)
    with named_causes(closed.recordings):
        wrong = impossible_declared(closed.steps[-1].after, places)
        if wrong:  # the fit hoped for a correction of the geometry, and the search made none
            raise EffectImpossible(f"the declared {wrong}")
        if closed.estimate is described and not open_correction_diagnoses(
            closed.steps, closed.cell
        ):
            return _with_holdout_judged(closed)
        return judged(closed)


def _with_uncertain_geometry(found: Fit) -> Fit:
    """Add the uncertainty of the corrected geometry to estimates that have none of it;
    the same fit without one.
    """
    covariance = found.geometry_covariance
    if covariance is None:
        return found
    unknowns = found.identification.estimate.unknowns
    identification = with_geometry_covariance(found.identification, covariance)
    steps = []
    for step in found.steps:
        evidence = evidence_with_geometry(step.after, covariance, unknowns)
        steps.append(replace(step, after=evidence))
    return replace(found, identification=identification, steps=tuple(steps))


def _with_geometry_of_encoders(start: Fit) -> Fit:
    """Identify again with the geometry of the encoders,
    and leave its uncertainty to be added after a search.
    """
    finding = start.geometry
    if finding is None or not finding.corrections:
        return start
    cell = start.cell
    model = model_of(cell)
    effects = declared_effects(cell)
    described = start.identification.estimate
    fitted_runs = (start.read(log)[0] for log in start.logs)
    holdout_runs = (start.read(log)[0] for log in start.holdout)
    changed_model = model_with_geometry(model, finding.changes)
    result = identify(
        changed_model,
        fitted_runs,
        cell.conditioning,
        holdout=holdout_runs,
        method=described.method,
        fixed_gains=described.fixed_gains,
        keep_rows=True,
        judge=not effects,
        axes=cell.axis_names,
    )
    covariance = geometry_covariance(result, model, finding)
    steps = with_effects_of_cell(result, effects, cell.place_names)
    last = steps[-1].after.identification if steps else result
    paper = None if described.gains_fixed else tls(last.system)
    return replace(
        start,
        identification=result,
        steps=steps,
        paper=paper,
        geometry_covariance=covariance,
        description=None,  # it was tested in the described geometry
    )


def check_holdout(fitted: Fit) -> None:
    """Refuse effects that raise the error of held-out runs by more than its noise,
    in total or of a motor.

    `close_loop` has taken out what held-out runs refute, by the same comparison; this refuses a fit
    that was made in another way. Effects that the cell declares are in both models that are
    compared.

    Raises:
        EffectsRefuted: they do, and the operator has not accepted it.
    """
    if not fitted.steps or fitted.accept_worse_holdout:
        return
    after = fitted.steps[-1].after
    declared = [step.after for step in fitted.steps if step.declared]
    if declared:
        before = declared[-1]
    else:
        before = without_effects(after, fitted.identification.estimate)
    if before.holdout is None or after.holdout is None or after.effects == before.effects:
        return
    change = compare_on_holdout(before, before, after)
    harm = change.harm("held-out runs")
    if not harm:
        return
    weights_nm_a = before.estimate.gains
    first = error_on(before.holdout, before.estimate).relative(weights_nm_a).total
    last = error_on(after.holdout, after.estimate).relative(weights_nm_a).total
    unseen = after.datasets[len(after.fit_runs) :]
    cold = [one.name for one in unseen if one.temperature_c is None]
    effect_names = {placed.effect.name for placed in after.effects}
    added = after.effects[after.declared :]
    names = [placed.name_among(fitted.cell.place_names) for placed in added]
    blocks = change.total.blocks
    found = f"an error of held-out runs of {last:.2f} %, {first:.2f} % without"
    if cold and TemperatureFriction.name in effect_names:
        runs = ", ".join(cold)
        found += f"; {runs} has no temperature, on which an effect depends"
    raise EffectsRefuted(
        ", ".join(names),
        found=found,
        expected=f"no rise by more than its noise over their {blocks} independent blocks of moves; "
        f"{harm}",
        remedy="no calibration was written: take `drivegain fit`, which adds no effects, or record "
        "more runs for the fit (or pass --accept-worse-holdout to `drivegain residual`)",
    )


@checks_arguments(fitted=of_kind(Fit), created=A_MOMENT)
def calibration_of(fitted: Fit, created: datetime) -> Calibration:
    """Make the calibration of a fit.

    Args:
        fitted: with or without effects.
        created: when, with its time zone.
    """
    predicting = _calibration(fitted)
    tolerance_kg = {payload.name: payload.mass_tolerance_kg for payload in fitted.cell.payloads}
    influences = (
        one.weighed_to(tolerance_kg.get(one.payload, 0.0)) for one in predicting.payload_mass
    )
    nameplate_error = _nameplate_error(fitted)
    created_text = created.isoformat(timespec="seconds")
    return replace(
        predicting,
        payload_mass=tuple(influences),
        created=created_text,
        software=software(),
        nameplate_holdout_error_percent=nameplate_error,
        diagnoses=fitted.diagnoses,
    )


def _calibration(fitted: Fit) -> Calibration:
    """Make what a calibration predicts with."""
    cell = fitted.cell
    nameplates = [axis.nameplate_gain for axis in cell.axes]
    units = [axis.gain_unit for axis in cell.axes]
    found = identified_calibration(
        fitted.identification,
        cell.axis_names,
        nameplates,
        units=units,
        robot=cell.name,
        steps=fitted.steps,
    )
    misfit = encoder_misfit_of(fitted.geometry, cell, applied=fitted.is_corrected)
    return replace(
        with_described(found, cell),
        sources=fitted.sources,
        configuration_sha256=cell.digest,
        recording_configuration_sha256=cell.recording_digest,
        encoder_misfit=misfit,
        robot=calibrated_robot(cell),
    )


def _nameplate_error(fitted: Fit) -> RelativeError | None:
    """Hold-out error with the nameplate gains: same model, effects included, parameters refitted.

    Without the effects, their share would be credited to the gains. The total weighs the axes by
    ‖Y_j‖ of the calibration, because smaller gains alone would lower it otherwise.
    """
    final = fitted.final
    unseen = final.holdout
    if unseen is None or final.estimate.gains_fixed:
        return None
    # TLS estimates gains and cannot hold them: ML takes its place.
    method = Method.ML if final.estimate.method is Method.TLS else final.estimate.method
    try:
        held = estimate_with(method, final.system, nameplate_of(fitted.cell))
    except (IdentificationError, np.linalg.LinAlgError):
        return None
    axes = held.relative_error(unseen).axes
    not_gains = np.zeros(len(held.parameters) + 1)
    gains = np.concatenate((final.estimate.gains, not_gains))
    size = unseen.joints.square_sum(gains)
    moved = size > 0.0
    share = np.array(axes) / 100.0
    left = np.where(moved, (share) ** 2 * size, 0.0)
    return RelativeError(axes, of_squares(size, left).total)


# Effects that a cell file declares: a counterbalance that the robot is known to have needs no
# search.


def declared_effects(cell: Cell) -> tuple[PlacedEffect, ...]:
    """Return the effects that a cell declares, where no setting is given with those of the
    dictionary's first member.

    Raises:
        ConfigurationInconsistent: there is no such effect, or it has no such setting, on this axis.
    """
    robot = model_of(cell).robot
    placed = []
    for declared in cell.effects:
        found = place_effect(declared.name, declared.axis, declared.settings, robot)
        if isinstance(found, Fault):
            place = cell.place_names[declared.axis]
            raise ConfigurationInconsistent(
                f"effects of cell {cell.name!r}: {declared.name} on {place}",
                found=found.found,
                expected=found.expected,
                remedy="correct the cell file",
            )
        placed.append(found)
    return tuple(placed)


def refuse_effects(cell: Cell, option: str) -> None:
    """Refuse a way of fitting that leaves out what the cell declares.

    Raises:
        UsageError: the cell declares effects.
    """
    if cell.effects:
        placed = [f"{effect.name} on {cell.place_names[effect.axis]}" for effect in cell.effects]
        names = ", ".join(placed)
        raise UsageError(
            option,
            found=f"a cell that declares effects: {names}",
            expected="a cell without effects: this way of fitting leaves them out",
            remedy="fit without the option, or name a cell file without `effects` with --cell",
        )


def with_effects_of_cell(
    start: Identification, effects: tuple[PlacedEffect, ...], axes: Sequence[str]
) -> tuple[Step, ...]:
    """Add the effects that a cell declares; settings are fitted by ``ml``,
    then all by the method that was asked for.

    There is no step without effects.

    Raises:
        IdentificationError: a refit failed, or the model with the effects contradicts the data.
    """
    if not effects:
        return ()
    estimate = start.estimate
    by_ml = by_likelihood(estimate, start.system)
    evidence = replace(gather(start), estimate=by_ml)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    steps = with_declared(
        evidence,
        effects,
        rng,
        axes=axes,
    )
    after = steps[-1].after
    if estimate.method is not Method.ML:
        after = with_declared_again(after, estimate)
        last = replace(steps[-1], after=after)
        steps = (*steps[:-1], last)
    error = after.estimate.relative_error(after.identification.system)
    require_plausible(after.estimate, error, axes[: len(estimate.gains)])
    return steps


def with_declared_again(evidence: Evidence, estimate: Estimate) -> Evidence:
    """Fit the same data and effects by the estimator, and with the gains,
    of an estimate without effects.
    """
    refitted = with_effects(without_effects(evidence, estimate), evidence.effects)
    return replace(refitted, declared=evidence.declared)
