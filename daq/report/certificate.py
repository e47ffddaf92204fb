"""The certificate of a calibration: its gains beside those in the controller, the limits, and one verdict.

The judgement is that of `drivegain apply`: the same gates, and the same test for a change beyond noise. Where the
controller was not read, the nameplate takes its place, and the limit of a change is that from the nameplate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import Enum
from typing import Literal

from daq.config.cell import Cell
from daq.config.policy import ApplyPolicy
from daq.config.same_cell import mismatch_of_calibration
from daq.errors import CalibrationRefused, DaqError
from daq.report.document import Figure, Report
from daq.report.effect_names import accepted_text, size_text
from daq.report.fit import Errors
from daq.report.gains import encoder_text, mass_texts
from daq.report.proposal import Refused
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates.gate import Gate, GateContext, Refusal
from daq.writeback.gates.table import check_gates
from daq.writeback.judgement import NOT_JUDGED, NOTHING, JudgedChange, Spread, judge, noise_note, query_history
from daq.writeback.request import Edit, GainChange, Request
from daq.writeback.target import Proposal, propose
from ident.calibration import Calibration, EncoderMisfit, PayloadMass
from ident.data.run import Recording


class CertifiedGain(Report):
    """A gain beside the one in the controller, or beside the nameplate."""

    axis: str
    key: str | None
    """in the controller's file; null where it was not read"""
    line: int | None
    old: Figure
    new: Figure
    std: float
    std_percent: Figure
    unit: str
    nameplate: float
    change_percent: Figure
    written: str | None
    allowed_percent: list[Figure]
    """limits of the change; null: none"""
    change_sigmas: Figure
    """signed as change_percent"""
    significant: bool
    verdict: str


class CertifiedEffect(Report):
    """An effect in words."""

    axis: str
    effect: str
    size: str
    error_before_percent: Figure
    error_after_percent: Figure
    ambiguity: list[str]


class EarlierCalibration(Report):
    """An earlier calibration, and the gains beside it."""

    created: str
    axes: list[CertifiedGain]
    holdout_error_percent: Errors | None


class CertificateReport(Report):
    """`certificate`: the numbers of the page."""

    format: Literal["drivegain-certificate"]
    version: Literal[1]
    cell: str
    identity: dict[str, str]
    verdict: str
    sentence: str
    controller: str | None
    controller_unread: str | None
    axes: list[CertifiedGain]
    refusals: list[Refused]
    holdout_error_percent: Errors | None
    nameplate_holdout_error_percent: Errors | None
    relative_error_percent: Errors
    payload_mass: list[PayloadMass]
    encoder_misfit: EncoderMisfit | None
    effects: list[CertifiedEffect]
    beside: EarlierCalibration | None


EARLIER = "earlier calibration"  #: What `since` compares with
_OPERATORS = frozenset({Gate.SIGNATURE, Gate.BASE})
"""Gates that an operator opens by reviewing or signing; the calibration itself is not at fault."""


class Verdict(Enum):
    """Verdict on the gains of a calibration: what may happen with them."""

    READY = "ready"  #: every check passed, and a gain differs by more than noise
    UNCHANGED = "unchanged"  #: every check passed, and no gain does
    WAITING = "waits for an operator"  #: a review or a signature is missing
    NOT_COMPARED = "not compared"  #: every check passed that needs no controller
    REFUSED = "refused"  #: a check failed


@dataclass(frozen=True, slots=True)
class Comparison:
    """Gains beside those that are in the controller, or beside the nameplate where it was not read."""

    changes: tuple[GainChange, ...]  #: one an axis
    refusals: tuple[Refusal, ...]  #: failed checks
    policy: ApplyPolicy  #: limits
    known: Spread = NOTHING  #: σ of the gains in the controller, by the history
    edit: FileEdit | None = None  #: planned change of the controller's file; None where it was not read
    unread: str = ""  #: why it was not read
    command: str = ""  #: that shows the change and, with --yes, writes it

    @classmethod
    def of(cls, proposal: Proposal[FileEdit], policy: ApplyPolicy, known: Spread = NOTHING) -> Comparison:
        """Comparison with a controller's file, as `apply` would change it."""
        return cls(proposal.edit.changes, proposal.refusals, policy, known, proposal.edit)

    def allowed_percent(self, change: GainChange) -> tuple[float, float]:
        """Limits of the change of a gain [% of the one in the controller]; infinite where it has none."""
        if not change.old or not math.isfinite(change.old):
            return -math.inf, math.inf
        nameplate = change.nameplate / change.old
        bound = self.policy.max_nameplate_percent
        ends = [100.0 * (nameplate * (1.0 + sign * bound / 100.0) - 1.0) for sign in (-1.0, 1.0)]
        if self.edit is not None:
            most = self.policy.max_change_percent
            if (absolute := self.policy.max_change.get(change.axis)) is not None:
                most = min(most, abs(100.0 * absolute / change.old))
            ends = [max(min(ends), -most), min(max(ends), most)]
        return min(ends), max(ends)


def without_controller(calibration: Calibration, unread: str, now: datetime, cell: Cell | None = None) -> Comparison:
    """Compare with the nameplate, and check the gates that need no controller.

    Args:
        calibration: whose gains are judged.
        unread: why the controller was not read.
        now: wall-clock time, for the age of the logs.
        cell: from the logs, None where there is none; then the default limits hold.
    """
    changes = _changes_from({gain.axis: gain.nameplate for gain in calibration.gains}, calibration)
    edit = Edit(subject="", before=b"", after=b"", changes=changes)
    refusals = check_gates(GateContext(Request(calibration, now), edit, cell))
    return Comparison(
        changes,
        tuple(refusal for refusal in refusals if refusal.gate not in {Gate.CHANGE, *_OPERATORS}),
        ApplyPolicy() if cell is None else cell.apply,
        unread=unread,
    )


def _changes_from(old: Mapping[str, float], calibration: Calibration) -> tuple[GainChange, ...]:
    """Return the changes of the gains from others, by axis, that are in no file."""
    return tuple(GainChange.of(gain, "", 0, old[gain.axis], (gain.value, "")) for gain in calibration.gains)


def compare(cell: Cell, request: Request, command: str = "") -> Comparison:
    """Compare a calibration with the controller's file of a cell, as `apply` would; reads only.

    Without a file that can be read the gains are compared with the nameplate, and the reason is kept.

    Args:
        cell: from its file.
        request: calibration to judge.
        command: that shows the change; see `Comparison`.

    Raises:
        CalibrationRefused: it is of another cell.
    """
    mismatch = mismatch_of_calibration(request.calibration, cell)
    if mismatch is not None:
        raise CalibrationRefused(
            f"calibration of cell {request.calibration.cell!r}",
            found=mismatch.found,
            expected=mismatch.expected,
            remedy="give the cell that was calibrated",
        )
    if cell.controller is not None and not cell.controller.gains:
        places = zip(cell.axis_names, cell.controller.objects, strict=True)
        listed = ", ".join(f"{axis} {entry.parameter}" for axis, entry in places)
        unread = f"The drives hold the gains ({listed}), and this page does not open the bus: `{command} --drives`."
        return without_controller(request.calibration, unread, request.now, cell)
    try:
        proposal = propose(FileTarget.of(cell), request)
    except DaqError as error:
        return without_controller(request.calibration, f"The controller was not read: {error}.", request.now, cell)
    known = query_history(cell, proposal.edit.subject, request, proposal.edit.changes)
    return replace(Comparison.of(proposal, cell.apply, known), command=command)


@dataclass(frozen=True, slots=True)
class AxisRow:
    """One gain of the certificate."""

    change: GainChange  #: gain in the controller, or nameplate, and identified one with its σ
    allowed_percent: tuple[float, float]  #: limits of the change
    judged: JudgedChange  #: NaN where it cannot be judged
    refusals: tuple[Refusal, ...]  #: failed checks of this axis

    def words(self, place: str) -> str:
        """Verdict in words; `place` has the other gain: the controller or the nameplate."""
        if self.refusals:
            return "; ".join(f"refused: {refusal.found}" for refusal in self.refusals)
        return f"differs from the {place}" if self.significant else "same within noise"

    @property
    def significant(self) -> bool:
        """Whether the change is more than noise."""
        return self.judged.significant


@dataclass(frozen=True, slots=True)
class Certificate:
    """All that the first page shows."""

    calibration: Calibration
    comparison: Comparison
    rows: tuple[AxisRow, ...]  #: one an axis
    earlier: Calibration | None = None  #: another calibration of the cell to compare with
    #: Change from the earlier calibration, judged with the σ of both, one an axis; empty without one.
    since: tuple[AxisRow, ...] = ()

    @property
    def place(self) -> str:
        """Name of the gains that these are compared with."""
        return "nameplate" if self.comparison.edit is None else "controller"

    @property
    def note(self) -> str:
        """Meaning of a difference beyond noise, as `apply` states it."""
        old = "the nameplate" if self.comparison.edit is None else "the number in the controller"
        return noise_note(self.comparison.changes, self.comparison.known, old)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole calibration."""
        gates = {refusal.gate for refusal in self.comparison.refusals}
        if gates - _OPERATORS:
            return Verdict.REFUSED
        if self.comparison.edit is None:
            return Verdict.NOT_COMPARED
        if not any(row.significant for row in self.rows):
            return Verdict.UNCHANGED
        return Verdict.WAITING if gates else Verdict.READY

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        refusals = self.comparison.refusals
        differing = [row for row in self.rows if row.significant]
        most = max(differing, key=lambda row: abs(row.change.change_percent), default=None)
        furthest = "" if most is None else f"{most.change.axis} by {most.change.change_percent:+.1f} %"
        every = len(differing) == len(self.rows)
        count = f"all {len(self.rows)} gains" if every else f"{len(differing)} of {len(self.rows)} gains"
        match self.verdict:
            case Verdict.REFUSED if self.calibration.gains_fixed:
                return "Must not be written: the gains were held fixed (`--gains fixed`), so there is nothing to write."
            case Verdict.REFUSED:
                failed = [refusal for refusal in refusals if refusal.gate not in _OPERATORS]
                more = "" if len(failed) == 1 else f" (and {len(failed) - 1} more, below)"
                one = failed[0]
                return f"Must not be written: {one.subject}: {one.found}, expected {one.expected}{more}."
            case Verdict.UNCHANGED:
                return "Nothing to change: no gain differs from the one in the controller by more than noise."
            case Verdict.WAITING:
                return f"Waits for an operator: {count} change, most {furthest}; {refusals[0].remedy}."
            case Verdict.READY:
                return f"Ready to be written: {count} change by more than noise, most {furthest}; every check passed."
        differ = f"{count} differ from the nameplate by more than noise, most {furthest}"
        return f"Identified, not compared with a controller: {differ if differing else 'all agree with the nameplate'}."


def certify(calibration: Calibration, comparison: Comparison, earlier: Calibration | None = None) -> Certificate:
    """Judge a calibration.

    Args:
        calibration: with its evidence.
        comparison: with the controller or the nameplate.
        earlier: another calibration of the same cell to compare with; None for none.

    Raises:
        CalibrationRefused: one of the two has not one error for each gain, or the earlier one is of another cell or of
            other axes.
    """
    _require_whole(calibration)
    since: tuple[AxisRow, ...] = ()
    if earlier is not None:
        _require_whole(earlier)
        _require_same(calibration, earlier)
        changes = _changes_from({gain.axis: gain.value for gain in earlier.gains}, calibration)
        known = Spread({gain.axis: gain.std for gain in earlier.gains})
        since = _rows(replace(comparison, changes=changes, refusals=(), known=known))
    return Certificate(calibration, comparison, _rows(comparison), earlier, since)


def _rows(comparison: Comparison) -> tuple[AxisRow, ...]:
    judged, _ = judge(comparison.changes, comparison.known)
    return tuple(
        AxisRow(
            change,
            comparison.allowed_percent(change),
            judged.get(change.axis, NOT_JUDGED),
            tuple(refusal for refusal in comparison.refusals if refusal.subject == change.axis),
        )
        for change in comparison.changes
    )


def _require_same(calibration: Calibration, earlier: Calibration) -> None:
    axes, others = ({gain.axis for gain in one.gains} for one in (calibration, earlier))
    if calibration.cell != earlier.cell or axes != others:
        raise CalibrationRefused(
            "--beside",
            found=f"cell {earlier.cell!r} with axes {', '.join(sorted(others))}",
            expected=f"cell {calibration.cell!r} with axes {', '.join(sorted(axes))}",
            remedy="give an earlier calibration of the same cell",
        )


def _require_whole(calibration: Calibration) -> None:
    count = len(calibration.gains)
    known = (
        calibration.relative_error_percent,
        calibration.holdout_error_percent,
        calibration.nameplate_holdout_error_percent,
    )
    for error in known:
        if error is not None and not 0 < count == len(error.axes):
            raise CalibrationRefused(
                f"calibration of cell {calibration.cell!r}",
                found=f"{count} gains and relative errors of {len(error.axes)} axes",
                expected="at least one gain, and one error for each",
                remedy="fit the logs again",
            )


def identity(calibration: Calibration) -> dict[str, str]:
    """Drives, operator, payload, dates, encoders and software as texts by their names; what is missing is said.

    Encoders are there where the robot has more of them than degrees of freedom.
    """
    recordings = [source.recording for source in calibration.sources if source.recording is not None]
    operators = sorted({one.operator for one in recordings if one.operator})
    payloads = "; ".join(payload_texts(calibration))
    if payloads and not calibration.gains_fixed:
        # No residual shows a wrong mass: it must be on the sheet that a person signs.
        influences = "; ".join(mass_texts(calibration.payload_mass))
        # Calibrations of earlier versions do not say more.
        known = influences or "a wrong mass changes every gain, by the same share where nothing else of it is known"
        payloads = f"{payloads}; {known}"
    names = {
        "Serial numbers": _serials(calibration, recordings),
        "Operator": ", ".join(operators) or "not known: the recordings name none",
        "Payload": payloads or "none: every run was recorded without load",
        "Recorded": _period([one.recorded_s for one in recordings if one.recorded_s is not None]),
    }
    if calibration.encoder_misfit is not None:
        names["Encoders"] = encoder_text(calibration.encoder_misfit)
    names["Fitted"] = f"{_minute(calibration.created)}, {calibration.software or 'software not known'}"
    return names


def payload_texts(calibration: Calibration) -> Iterator[str]:
    """The mass of each payload as it was entered twice: in the cell file, and from the scale at each recording."""
    mounted: dict[tuple[str, float | None], list[float]] = {}
    for source in calibration.sources:
        if source.payload is not None:
            entered = None if source.recording is None else source.recording.entered_kg
            masses = mounted.setdefault((source.payload, source.mass_kg), [])
            if entered is not None and entered not in masses:
                masses.append(entered)
    for (name, declared), masses in mounted.items():
        entry = "no mass in the cell file" if declared is None else f"{declared:g} kg in the cell file"
        scale = "not weighed a second time"
        if masses:
            scale = f"{' and '.join(f'{one:g}' for one in masses)} kg on the scale"
        yield f"{name}: {entry}, {scale}"


def _period(times_s: Sequence[float]) -> str:
    """Write the time between the first and the last recording to the minute, in UTC."""
    if not times_s:
        return "not known: the logs have no time of day"
    first, last = (datetime.fromtimestamp(one, UTC).strftime("%Y-%m-%d %H:%M") for one in (min(times_s), max(times_s)))
    if first == last:
        return f"{first} UTC"
    same_day = first[:10] == last[:10]
    return f"{first} to {last[11:] if same_day else last} UTC"


def _serials(calibration: Calibration, recordings: Sequence[Recording]) -> str:
    found = []
    for index, gain in enumerate(calibration.gains):
        serials = dict.fromkeys(one.serials[index] for one in recordings if index < len(one.serials))
        known = [str(serial) for serial in serials if serial is not None]
        if known:
            found.append(f"{gain.axis} {' and '.join(known)}")
    return ", ".join(found) or "not known: the drives reported none"


def _minute(iso: str) -> str:
    """Write an ISO 8601 time to the minute, in UTC; any other text as it is."""
    try:
        return datetime.fromisoformat(iso).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return iso or "time not known"


def certificate_report(certificate: Certificate) -> CertificateReport:
    """Return the numbers of the page."""
    calibration, comparison = certificate.calibration, certificate.comparison
    edit = comparison.edit
    beside = None
    if certificate.earlier is not None:
        since = [_certified_gain(row, EARLIER) for row in certificate.since]
        beside = EarlierCalibration.of(certificate.earlier, axes=since)
    return CertificateReport.of(
        certificate,
        comparison,
        calibration,
        format="drivegain-certificate",
        version=1,
        identity=identity(calibration),
        controller=None if edit is None else str(edit.file),
        controller_unread=comparison.unread or None,
        axes=[_certified_gain(row, certificate.place) for row in certificate.rows],
        effects=[
            CertifiedEffect.of(one, effect=accepted_text(one, calibration), size=size_text(one, calibration))
            for one in calibration.effects
        ],
        beside=beside,
    )


def _certified_gain(row: AxisRow, place: str) -> CertifiedGain:
    change = row.change
    return CertifiedGain.of(
        change,
        row,
        key=change.key or None,
        line=change.line or None,
        written=change.spelling or None,
        change_sigmas=row.judged.sigmas,
        verdict=row.words(place),
    )
