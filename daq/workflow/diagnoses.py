"""One judgement of recordings for `fit`, `residual`, `validate`, `report` and `daq.fit_logs`.

`diagnose_fit` judges the logs of a fit, and `diagnose_run` of `daq.workflow.validate` a log that a
calibration has not seen: a held-out one, or one that is validated. A calibration keeps what was
said of its fit, so its report and its validation say the same.

The order of the judgements, causes before their traces:

1. Each log as it is read: currents without a sign
   (`ident.estimators.diagnosis.require_explained_currents`).
2. What leaves no usable number (`ident.estimators.refusals.refuse_mistakes`): a payload that does
   not show; with fixed gains its weight and the signs of the currents; errors; exchanged roles;
   units. Where one of these refuses, or the estimator does not converge, its causes are looked for
   in the logs: the geometry, currents without a sign, exchanged currents.
3. The geometry of every fit (`ident.estimators.turned_geometry`): gravity, and the sense of each
   position. Nothing else is said of a fit in a wrong geometry, because all of it would be wrong.
4. What is named (`ident.estimators.diagnosis.diagnose`): gains, estimators, payloads, errors,
   torques, condition.
5. Currents without a sign and exchanged ones, where 4. named a trace of them, or the gains are
   fixed.
6. Zeros and lengths that the encoders contradict (`daq.workflow.geometry_diagnoses`), where there
   are more of them than degrees of freedom: found before any torque is looked at, and named first.
7. Small mistakes of the description: zeros, mounting and late positions, by torque. With a fit
   they are those of `check_diagnoses`; after a search, those that it corrects
   (`correction_diagnoses`), those that held-out runs leave undecided or that it has set aside
   (`open_correction_diagnoses`), and what the check reports besides its model. Several that the
   moves do not distinguish are one, `CORRECTION_UNCLEAR`. They are named before 4. to 6., and
   where they are, no exchange of currents is looked for (`daq.workflow.fit.judged`).
8. Each held-out log; first whether the geometry has changed since the fit (`ident.geometry_drift`).

Currents that are late, one of them or all alike, are named with 7., but they hide no exchange of
currents.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.advice import for_command_line
from daq.config.cell import Cell, model_of, robot_of
from daq.workflow.geometry_diagnoses import geometry_diagnoses
from daq.workflow.zero_text import DEGREES, MILLIMETRES, zero_off_text, zero_remedy
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.current_filter import CurrentFilter
from ident.discovery.effect_verdict import Judgement
from ident.discovery.evidence import Evidence, coefficients_of
from ident.discovery.gates import in_noise
from ident.discovery.geometry_check import GeometryCheck, check_geometry
from ident.discovery.hidden_zeros import ZeroHiddenBy, zero_hidden_by
from ident.discovery.loop import Step
from ident.discovery.search import Finding
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.electrical import Lag, TimeSkew
from ident.effects.geometry_corrections import (
    GravityDirection,
    LatePosition,
    ZeroOffset,
    is_correction,
    turned_gravity,
    turned_gravity_std,
)
from ident.equations.instants import Instants, read_instants
from ident.equations.system import System
from ident.errors import (
    CORRECTION_UNCLEAR,
    ChannelsExchanged,
    Diagnosis,
    EffectImpossible,
    GeometryTurned,
    ModelContradicted,
    NotConverged,
    PayloadUnseen,
    RankDeficient,
    TooFewMoves,
)
from ident.estimators.diagnosis import (
    ChannelTriangles,
    channel_triangles,
    diagnose,
    exchange_shown_by,
    explain_channels,
    unsigned_channels,
)
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.geometry_estimate import GeometryFinding
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.estimators.turned_geometry import GEOMETRY, find_turned_geometry, fits_better
from ident.geometry_drift import GeometryDrift
from ident.model.model import Model
from ident.model.robot import JointKind, Robot
from ident.model.suggested_gravity import suggested_gravity
from ident.model.urdf import read_urdf

ReadLog = Callable[[Path], tuple[Run, Cell]]  #: Reads a log, and the description of its cell

#: Option of `fit` and `residual` with which no exchange is looked for
CHANNELS_AS_WIRED = "--channels-as-wired"
TRACES_OF_CURRENTS = {"axis-error", "current-reversed", "gain-off-nameplate"}
"""Diagnoses that exchanged currents, or currents without a sign, may leave.

Fixed gains need not leave any.
"""


@dataclass(frozen=True, slots=True)
class Recordings:
    """The logs of a fit and how it used them: they are read again where a cause is looked for."""

    logs: tuple[Path, ...]
    read: ReadLog  #: reads a log as the fit did
    gains_fixed: bool  #: the fit holds the nameplate gains
    channels_as_wired: bool = False  #: the operator says that no currents are exchanged
    described: Cell | None = None  #: the cell of the logs; None where they were not read yet

    @property
    def cell(self) -> Cell:
        """The cell of the logs; that of the first one where they were not read yet."""
        return self.described or self.read(self.logs[0])[1]

    def runs(self) -> Iterator[Run]:
        """One run after the other."""
        for log in self.logs:
            yield self.read(log)[0]


def diagnose_fit(
    found: Identification,
    cell: Cell,
    recordings: Recordings,
    geometry: GeometryFinding | None = None,
    *,
    corrected: bool = False,
) -> tuple[Diagnosis, ...]:
    """Judge a fit in a right geometry by the recordings that it has used;
    `turned_geometry` is asked before.

    Args:
        found: with all effects.
        cell: description of its cell.
        recordings: of the fit.
        geometry: what the encoders say of the geometry; None for a robot without redundant ones.
        corrected: the fit is one with the corrected geometry.

    Raises:
        PayloadUnseen, ModelContradicted: a mistake leaves no usable number.
        CurrentUnsigned: drives report the size of their currents only.
    """
    nameplate = nameplate_of(cell)
    effort_limit = read_urdf(cell.urdf).effort_limit[list(robot_of(cell).axis_joints)]
    # Each held-out run is judged alone, as in a validation.
    named = diagnose(replace(found, holdout=None), cell.axis_names, nameplate, effort_limit)
    diagnoses = tuple(map(with_verbs, named))
    suspect = any(one.name in TRACES_OF_CURRENTS for one in diagnoses)
    if suspect or found.estimate.gains_fixed:
        require_right_currents(recordings, each=suspect)
    return (*geometry_diagnoses(geometry, cell, applied=corrected), *diagnoses)


def current_filter_diagnoses(found: CurrentFilter | None) -> tuple[Diagnosis, ...]:
    """Name a low-pass that the currents went through before they were recorded; empty without."""
    if found is None:
        return ()
    diagnosis = Diagnosis(
        name="currents-filtered",
        runs=(),
        axes=(),
        found=f"currents that went through {found.describe()}, and positions that did not",
        expected="currents as the drives report them",
        remedy="the torques of the model went through the same filter, so that gains and effects "
        "are those of the arm; record unfiltered currents: friction where a joint turns back, and "
        "whatever else is fast, can hardly be seen in these",
    )
    return (diagnosis,)


def nameplate_of(cell: Cell) -> FloatArray:
    """Nameplate gain of each axis, shape (m,)."""
    return np.array([axis.nameplate_gain for axis in cell.axes])


def with_verbs(diagnosis: Diagnosis) -> Diagnosis:
    """The same diagnosis with a remedy that names verbs and options."""
    return replace(diagnosis, remedy=for_command_line(diagnosis.remedy))


# Causes in the logs


@contextmanager
def named_causes(recordings: Recordings) -> Iterator[None]:
    """Name a wrong geometry or wrong currents where a fit is refused for what they leave.

    Raises:
        GeometryTurned: gravity or a position points elsewhere than declared.
        CurrentUnsigned, ChannelsExchanged: see `require_right_currents`.
    """
    try:
        yield
    except (ChannelsExchanged, GeometryTurned):
        raise
    except (EffectImpossible, ModelContradicted, NotConverged, PayloadUnseen):
        turned = turned_geometry(recordings, (), None)
        if turned is not None:
            raise _as_error(turned) from None
        require_right_currents(recordings)
        raise


def geometry_refusal(diagnoses: Sequence[Diagnosis]) -> GeometryTurned | None:
    """Return the error for gains that mean nothing, because their fit is one in a wrong geometry;
    None for others.

    What is said of a held-out run alone leaves the gains of the others as they are.

    Args:
        diagnoses: of a fit and of its held-out runs.
    """
    for one in diagnoses:
        if one.name in GEOMETRY and not one.runs:
            return _as_error(one)
    return None


def _as_error(turned: Diagnosis) -> GeometryTurned:
    """Return the error that says the same as a diagnosis of the geometry."""
    return GeometryTurned(
        ", ".join(turned.axes) or "the mounting",
        found=turned.found,
        expected=turned.expected,
        remedy=turned.remedy,
    )


def turned_geometry(
    recordings: Recordings,
    instants: Sequence[Instants],
    error_percent: float | None,
    corrected: Model | None = None,
) -> Diagnosis | None:
    """Another geometry that explains recordings clearly better, confirmed by a fit of all rows;
    None without any.

    Args:
        recordings: of the fit.
        instants: a few rows of each; taken from the logs where there are none.
        error_percent: of the fit as declared; None where it was refused.
        corrected: model of the fit, as a search has corrected it. Where no other geometry explains
            the recordings better than this one, the search has named what is wrong, with σ.
    """
    cell = recordings.cell
    model = model_of(cell)
    nameplate = nameplate_of(cell)
    rows = instants or read_instants(model, recordings.runs(), cell.conditioning)
    if corrected is not None and find_turned_geometry(corrected, rows, nameplate) is None:
        return None
    turned = find_turned_geometry(model, rows, nameplate)
    if turned is None or not fits_better(
        turned,
        model,
        recordings.runs(),
        cell.conditioning,
        nameplate,
        gains_fixed=recordings.gains_fixed,
        before_percent=error_percent,
    ):
        return None
    return turned.diagnosis(cell.axis_names)


def require_right_currents(recordings: Recordings, *, each: bool = True) -> None:
    """Refuse logs with currents without a sign, or with exchanged ones;
    they are read again, each once.

    Args:
        recordings: of the fit.
        each: look for an exchange in each log alone, too: in one of several, it is hidden by the
            others.

    Raises:
        CurrentUnsigned: drives report the size of the current only.
        ChannelsExchanged: the currents of some axes are each other's, in all logs together or in
            one of them.
    """
    cell = recordings.cell
    model = model_of(cell)
    runs = list(recordings.runs())
    unsigned = unsigned_channels(model, runs, cell.conditioning, cell.axis_names)
    if unsigned is not None:
        raise unsigned
    # Internal preload is in every current of a redundant robot
    if recordings.channels_as_wired or model.is_redundant:
        return
    reduced = [channel_triangles(model, run, cell.conditioning) for run in runs]
    _require_own_channels(reduced, "the currents", cell)
    if each and len(reduced) > 1:
        for log, alone in zip(recordings.logs, reduced, strict=True):
            _require_own_channels([alone], f"log {log.stem}: the currents", cell)


def _require_own_channels(runs: Sequence[ChannelTriangles], currents: str, cell: Cell) -> None:
    """Refuse runs in which the currents of some axes are each other's.

    Args:
        runs: taken together.
        currents: what the message calls their currents.
        cell: of the runs.
    """
    found = exchange_shown_by(explain_channels(runs), cell.axis_names)
    if found is None:
        return
    raise ChannelsExchanged(
        f"{currents} of {' and '.join(found.axes)}",
        found=found.found,
        expected=found.expected,
        remedy=f"{found.remedy}; if they are right as they are, pass {CHANNELS_AS_WIRED}",
    )


# The description against the torques

CHECKED_BYTES = 150_000_000
"""Largest size of all logs of a fit whose rows are kept for the test:
some ten minutes of six axes at 1 kHz.
"""


def is_checked(logs: Sequence[Path]) -> bool:
    """Whether logs are small enough to keep their rows."""
    return sum(log.stat().st_size for log in logs if log.is_file()) <= CHECKED_BYTES


def geometry_beside(evidence: Evidence, seed: int) -> GeometryCheck | None:
    """Test the geometry of a fit by any estimator;
    None with too few moves, or where ``ml`` fits nothing.

    Args:
        evidence: the rows of the fit.
        seed: of the bootstrap.
    """
    try:
        if evidence.estimate.method is not Method.ML:
            evidence = replace(
                evidence, estimate=by_likelihood(evidence.estimate, evidence.training.system())
            )
        return check_geometry(evidence, np.random.default_rng(seed))
    except (NotConverged, RankDeficient, TooFewMoves):
        return None


def by_likelihood(estimate: Estimate, system: System) -> Estimate:
    """Return the estimate of a system by ``ml``, in whose terms candidates are judged,
    or itself if it is by ``ml``.
    """
    if estimate.method is Method.ML:
        return estimate
    return estimate_with(Method.ML, system, estimate.fixed_gains)


def check_diagnoses(check: GeometryCheck, cell: Cell, model: Model) -> tuple[Diagnosis, ...]:
    """Diagnoses of the check of a fit.

    Args:
        check: of the fit.
        cell: whose description it is.
        model: as declared.
    """
    diagnoses: list[Diagnosis] = []
    for found in check.mistakes:
        placed = found.placed
        diagnosis = _finding_diagnosis(found, cell, model)
        diagnoses.append(_beside_alike(diagnosis, placed, check, cell, model))
    return tuple(diagnoses)


def correction_diagnoses(
    evidence: Evidence, cell: Cell, check: GeometryCheck | None = None
) -> tuple[Diagnosis, ...]:
    """Diagnoses of the corrections that a search has made,
    and of the late currents that it has found.

    Args:
        evidence: with its effects.
        cell: whose description it is.
        check: of the fit before the search; None where nothing was tested.
    """
    given = evidence.uncorrected or evidence
    found: list[Diagnosis] = []
    for placed in evidence.effects[evidence.declared :]:
        if type(placed.effect) in DIAGNOSED_AS:
            values, deviations = coefficients_of(evidence.estimate, placed)
            diagnosis = _correction_diagnosis(placed, values, deviations, cell, given.model)
            if check is not None and not _is_settled(placed, check, evidence):
                diagnosis = _beside_alike(diagnosis, placed, check, cell, given.model)
            found.append(diagnosis)
    return tuple(found)


def _is_settled(placed: PlacedEffect, check: GeometryCheck, evidence: Evidence) -> bool:
    """Whether a model has a correction together with one of those that the fit could not
    distinguish from it.
    """
    for alike in check.alike:
        if alike.contain(placed):
            return all(found.placed in evidence.effects for found in alike.findings)
    return False


def open_correction_diagnoses(
    steps: Sequence[Step], cell: Cell, check: GeometryCheck | None = None
) -> tuple[Diagnosis, ...]:
    """Diagnoses of corrections that a search has found and that are not in its model,
    although nothing refutes them.

    Held-out runs have left them undecided, or the search has set them aside. The description may be
    wrong by them, and the gains are those of a robot as it is described.

    Args:
        steps: of the search, with the verdicts of held-out runs.
        cell: whose description it is.
        check: of the fit; None where nothing was tested.
    """
    if not steps:
        return ()
    last = steps[-1]
    model = (last.after.uncorrected or last.after).model
    found: list[Diagnosis] = []
    for verdict in last.verdicts:
        placed = verdict.placed
        is_undecided = verdict.judgement is Judgement.UNDECIDED and not verdict.written
        if is_undecided and is_correction(placed):
            values, deviations = _values_in_search(steps, placed)
            why = f"held-out runs do not decide it: {verdict.reason}"
            found.append(_open_correction(placed, values, deviations, why, cell, model, check))
    for aside in last.set_aside:
        finding = aside.finding
        placed = finding.placed
        # What left by its own σ may be zero; so may what is not significant as it was found.
        is_known = placed in last.after.effects or placed in last.left_open
        covariance = np.diag(finding.deviations**2)
        may_be_zero = bool(in_noise(finding.coefficients, covariance))
        if is_correction(placed) and not is_known and not may_be_zero:
            why = aside.reason(cell.place_names)
            found.append(
                _open_correction(
                    placed, finding.coefficients, finding.deviations, why, cell, model, check
                )
            )
    return tuple(found)


def _values_in_search(steps: Sequence[Step], placed: PlacedEffect) -> tuple[FloatArray, FloatArray]:
    """Coefficients of an effect, and σ, in the last model that had it;
    as it was found where none is left.
    """
    for step in reversed(steps):
        if placed in step.after.effects:
            return coefficients_of(step.after.estimate, placed)
    for step in reversed(steps):
        found = step.accepted
        if found is not None and found.placed == placed:
            return found.coefficients, found.deviations
    raise ValueError(
        f"no step of the search has {placed.effect.name}; expected the steps that its verdict is of"
    )


def _open_correction(
    placed: PlacedEffect,
    values: FloatArray,
    deviations: FloatArray,
    why: str,
    cell: Cell,
    model: Model,
    check: GeometryCheck | None,
) -> Diagnosis:
    """Diagnosis of a correction that is not in the model, with the reason why it is not."""
    diagnosis = _correction_diagnosis(placed, values, deviations, cell, model)
    if check is not None:
        diagnosis = _beside_alike(diagnosis, placed, check, cell, model)
    return replace(
        diagnosis, found=f"{diagnosis.found}; the gains are without this correction ({why})"
    )


def _finding_diagnosis(found: Finding, cell: Cell, model: Model) -> Diagnosis:
    """Diagnosis of a correction that a test has found."""
    placed = found.placed
    return _correction_diagnosis(placed, found.coefficients, found.deviations, cell, model)


def _beside_alike(
    diagnosis: Diagnosis, placed: PlacedEffect, check: GeometryCheck, cell: Cell, model: Model
) -> Diagnosis:
    """The same diagnosis, with the corrections that the moves do not tell apart from its own,
    and what to record.

    Args:
        diagnosis: of one correction.
        placed: this correction.
        check: of the fit.
        cell: whose description it is.
        model: as declared.
    """
    alike = next((one for one in check.alike if one.contain(placed)), None)
    if alike is None:
        return diagnosis
    other_findings = [one for one in alike.findings if one.placed != placed]
    named = (diagnosis, *(_finding_diagnosis(one, cell, model) for one in other_findings))
    found = " or ".join(one.found for one in named)
    expected = dict.fromkeys(one.expected for one in named)
    axes: dict[str, None] = {}
    for one in named:
        axes |= dict.fromkeys(one.axes)
    wanted = "moves at other speeds and in other poses"
    if alike.axes_to_move:
        names = " and ".join(cell.place_names[axis] for axis in alike.axes_to_move)
        verb = "turns" if len(alike.axes_to_move) == 1 else "turn"
        wanted = f"moves in which {names} {verb} further"
    return replace(
        diagnosis,
        name=CORRECTION_UNCLEAR,
        axes=tuple(axes),
        found=f"either {found}: these moves do not tell them apart",
        expected=" and ".join(expected),
        remedy=f"record {wanted}, and fit them together with these; or measure which of them is "
        "wrong; correct nothing in the cell file before that",
    )


def drift_diagnosis(
    drift: GeometryDrift,
    model: Model,
    axes: Sequence[str],
    runs: Sequence[str],
    *,
    is_given: bool = False,
) -> Diagnosis:
    """Diagnosis of a geometry that has changed since a calibration.

    Args:
        drift: by a run that the fit has not seen.
        model: as declared.
        axes: names of its axes.
        runs: name of the run.
        is_given: a description that was given changes this number of the log's own one.
    """
    placed = drift.placed
    name = axes[placed.axis]
    match placed.effect:
        case ZeroOffset():
            zero = _zero_text(placed.axis, name, drift.values, drift.deviations, model)
            found = f"{zero} since the calibration"
            expected = "the zero of the calibration"
            remedy = "reference the axis again, or calibrate anew"
        case LatePosition():
            late_ms = 1e3 * drift.values[0]
            std_ms = 1e3 * drift.deviations[0]
            size = f"{late_ms:+.2f} ± {std_ms:.2f} ms"
            found = f"the position of {name} late by {size} more than in the calibration"
            expected = ONE_MOMENT
            remedy = "look for what delays this encoder alone"
        case _:
            found = (
                f"gravity turned by {_turn_text(drift.values, drift.deviations)} since the "
                "calibration"
            )
            expected = "the mounting of the calibration"
            remedy = (
                "level the base as it was, or correct `gravity_m_s2` in the cell file and "
                "calibrate anew"
            )
    found += (
        f"; it explains {100.0 * drift.share:.0f} % of what the error is larger than in the fit"
    )
    if is_given:
        remedy = (
            "the given cell file has another number here than the description in the log: correct "
            f"the cell file, or if it is right, {remedy}"
        )
    return _diagnosis_of(placed, name, runs, found, expected, remedy)


ONE_MOMENT = "positions and currents of one moment"  #: Expected of the positions of every axis
DIAGNOSED_AS: dict[type[Effect], str] = {
    ZeroOffset: "zero-off",
    LatePosition: "position-late",
    GravityDirection: "gravity-tilted",
    Lag: "current-late",
    TimeSkew: "time-skew",
}
"""Diagnosis of a wrong description, or of currents that are late,
by the effect that corrects it.
"""
HIDING_EXCHANGES = frozenset({"zero-off", "position-late", "gravity-tilted", CORRECTION_UNCLEAR})
"""Those of a wrong description, which may look like exchanged currents."""
FIT_AGAIN = "then fit the same logs again, with the corrected file as `--cell`"
#: No torque of a serial arm tells a length from a zero and the gains
OR_A_LENGTH = (
    "where the zero is known to be right, measure the lengths of the links in the URDF: a wrong "
    "one looks like this"
)
SMALL_DELAY = "tenths of a millisecond are a filter of the drive, several milliseconds are a fault"
INTO_THE_MODEL = "the search of `drivegain residual` takes the delay into the model"


def _diagnosis_of(
    placed: PlacedEffect, name: str, runs: Sequence[str], found: str, expected: str, remedy: str
) -> Diagnosis:
    """Diagnosis of a wrong description, by the correction that it needs."""
    axes = (name,) if placed.effect.has_axis else ()
    return Diagnosis(DIAGNOSED_AS[type(placed.effect)], tuple(runs), axes, found, expected, remedy)


def _correction_diagnosis(
    placed: PlacedEffect, values: FloatArray, deviations: FloatArray, cell: Cell, model: Model
) -> Diagnosis:
    """Diagnosis of one correction."""
    name = cell.place_names[placed.axis]
    match placed.effect:
        case ZeroOffset():
            unit, scale = _zero_unit(model, placed.axis)
            described = scale * cell.axes[placed.axis].zero_offset_rad
            found = _zero_text(placed.axis, name, values, deviations, model)
            expected = "positions whose zero is that of the URDF"
            remedy = zero_remedy(name, scale * values[0], scale * deviations[0], unit, described)
            remedy += f"; {FIT_AGAIN}"
            if not model.robot.closures:
                remedy += f"; {OR_A_LENGTH}"
        case LatePosition():
            found = f"the position of {name} {_late_text(values, deviations)}"
            expected = ONE_MOMENT
            remedy = (
                "look for what delays this encoder alone: a filter, a slower channel, another time "
                "stamp than that of the other axes"
            )
        case Lag():
            found = f"the current of {name} {_late_text(values, deviations)}"
            expected = ONE_MOMENT
            remedy = (
                "look for what delays this current alone: a filter of its drive, a slower channel, "
                f"another time stamp than that of the other axes; {SMALL_DELAY}; {INTO_THE_MODEL}"
            )
        case TimeSkew():
            found = (
                f"all currents {_late_text(values, deviations)} relative to the positions, the "
                "same on every axis"
            )
            expected = ONE_MOMENT
            remedy = (
                "no single encoder or drive is late: check how positions and currents are stamped "
                "(two messages of one cycle, two clocks, a filter that every drive has) and record "
                f"again; {SMALL_DELAY} of the recording; {INTO_THE_MODEL}"
            )
        case _:
            declared = model.robot.gravity_m_s2
            found_m_s2 = turned_gravity(declared, values.tolist())
            std_m_s2 = turned_gravity_std(declared, found_m_s2, deviations.tolist())
            turned = vector_text(suggested_gravity(found_m_s2, std_m_s2))
            found = f"gravity along {turned}, turned by {_turn_text(values, deviations)}"
            expected = f"{vector_text(declared)}, as the cell file says"
            remedy = (
                f"write `gravity_m_s2: {turned}` in the cell file, or level the base and "
                f"record again; {FIT_AGAIN}"
            )
    return _diagnosis_of(placed, name, (), found, expected, remedy)


def _zero_unit(model: Model, axis: int) -> tuple[str, float]:
    """Unit of an axis' zero, and how many of it are in a radian or metre."""
    if model.robot.axes[axis].kind is JointKind.PRISMATIC:
        return MILLIMETRES, 1e3
    return DEGREES, float(np.degrees(1.0))


def _zero_text(
    axis: int, name: str, values: FloatArray, deviations: FloatArray, model: Model
) -> str:
    """Say how far a zero is off, with σ."""
    unit, scale = _zero_unit(model, axis)
    return zero_off_text(name, scale * values[0], scale * deviations[0], unit)


def _late_text(values: FloatArray, deviations: FloatArray) -> str:
    """By how much something is late or early, with σ."""
    late = "late" if values[0] > 0.0 else "early"
    size_ms = 1e3 * abs(values[0])
    std_ms = 1e3 * deviations[0]
    return f"{late} by {size_ms:.2f} ± {std_ms:.2f} ms"


def _turn_text(values: FloatArray, deviations: FloatArray) -> str:
    """Angle of a turn of gravity with σ."""
    angle = float(np.linalg.norm(values))
    std = float(np.linalg.norm(values * deviations)) / max(angle, 1e-12)
    angle_deg = np.degrees(angle)
    std_deg = np.degrees(std)
    return f"{angle_deg:.2f} ± {std_deg:.2f}°"


def vector_text(vector: FloatArray) -> str:
    """A vector as a cell file has it, `[0.000, 0.340, -9.804]`:
    of gravity, a digit of the last place is 0.006°.
    """
    rounded = np.round(vector, 3) + 0.0  # no minus before a zero
    entries = ", ".join(f"{entry:.3f}" for entry in rounded)
    return f"[{entries}]"


WHY_HIDDEN = {
    ZeroHiddenBy.SYMMETRY: "another one turns or shifts the whole arm, and no torque "
    "depends on that",
    ZeroHiddenBy.LAST_LINK: "no joint is behind it, and another one makes the same torques as "
    "another body there",
    ZeroHiddenBy.MOVES: "these moves do not show it",
}
"""Why the zero of a joint is not seen, in words."""


def hidden_zeros_text(check: GeometryCheck | None, axes: Sequence[str], robot: Robot) -> str:
    """Which zeros the data do not show, alone or two together, and why;
    empty where they show all, or were not asked.

    Args:
        check: of the fit.
        axes: their names.
        robot: as declared.
    """
    if check is None:
        return ""
    said: list[str] = []
    hidden: dict[ZeroHiddenBy, list[str]] = {}
    for axis in check.hidden_zeros:
        hidden.setdefault(zero_hidden_by(robot, axis), []).append(axes[axis])
    parts = []
    for cause in ZeroHiddenBy:
        if cause in hidden:
            names = ", ".join(hidden[cause])
            parts.append(f"of {names}: {WHY_HIDDEN[cause]}")
    if parts:
        causes = "; ".join(parts)
        said.append(f"Zeros that are not seen here: {causes}.")
    if check.hidden_pairs:
        pairs = [f"{axes[first]} with {axes[second]}" for first, second in check.hidden_pairs]
        listed = ", ".join(pairs)
        said.append(f"Not seen here where both zeros are off, one against the other: {listed}.")
    return " ".join(said)
