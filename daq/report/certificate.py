"""The certificate of a calibration: its gains compared with the current ones, the limits and a
verdict.

The judgement is that of `drivegain apply`: the same gates, and the same test for a change beyond
noise.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from statistics import fmean
from typing import Literal

from daq.config.same_cell import expected_text, found_text, robot_differences
from daq.documents.calibration_file import encode_calibration
from daq.errors import CalibrationRefused
from daq.files import sha256
from daq.ledger.fold import Event, RecordedAcceptance, WriteAction
from daq.ledger.ledger import MAY_LACK, StandingState
from daq.report.comparison import OPERATORS, Comparison, before_write, changes_from
from daq.report.document import Figure, Report
from daq.report.effect_names import accepted_text, size_text
from daq.report.fit import Errors
from daq.report.gains import encoder_text, mass_texts
from daq.report.proposal import Refused
from daq.report.text import minute_text
from daq.writeback.gates.gate import Gate, Refusal
from daq.writeback.judgement import NOT_JUDGED, HistoryFigures, JudgedChange, judge, noise_note
from daq.writeback.request import GainChange, GainOrigin
from ident.calibration import Calibration, EncoderMisfit, PayloadMass
from ident.data.run import Recording


class CertifiedGain(Report):
    """A gain compared with the current one, or with the nameplate."""

    axis: str
    key: str | None
    """in the controller's file; null where it was not read"""
    line: int | None
    old: Figure
    """current gain, or the nameplate where the controller was not read;
    of `beside`, the earlier calibration's gain
    """
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
    """An earlier calibration, and the gains compared with it."""

    created: str
    axes: list[CertifiedGain]
    holdout_error_percent: Errors | None


class StatusEvent(Report):
    """A write, a rollback, or new moves with the gains."""

    at: str
    who: str


class StatusWrite(StatusEvent):
    """A write, or a rollback that restored these gains."""

    target: str
    """the controller's file, or the drives"""


class StatusAcceptance(StatusEvent):
    """Result of new moves with these gains."""

    accepted: bool
    remark: str
    """what was found"""
    undo: str
    """command that undoes the write; empty where they were accepted"""


class CertificateStatus(Report):
    """State of a calibration by the audit log of its cell,
    and by the controller's file where it was read.
    """

    state: str
    """written, accepted, not accepted, replaced, not written, or not known"""
    text: str
    """the same as a sentence"""
    as_of: str | None
    """when the audit log was read; null where it was not"""
    write: StatusWrite | None
    """last write of these gains; null where there was none"""
    ended: StatusEvent | None
    """write or rollback that put other gains in their place; null where there was none"""
    acceptance: StatusAcceptance | None
    """result of the last new moves with these gains; null where there were none"""


class CertificateReport(Report):
    """`certificate`: the numbers of the page."""

    format: Literal["drivegain-certificate"]
    version: Literal[1]
    id: str
    """first digits of sha256"""
    sha256: str
    """of the calibration's file"""
    session: str | None
    """that made the calibration; null where it was made without one"""
    status: CertificateStatus
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


FIT_ROLE = "fit"  #: Of a source
BALANCED_PLACES = 0.5  #: Between the mean places of bare and of loaded runs in their order

_CLAUSE_END = re.compile(r"[;:] |, with ")
_ID_DIGITS = 12  #: As history and audit log shorten a digest


class Verdict(Enum):
    """Verdict on the gains of a calibration: what may happen with them."""

    READY = "ready"  #: every check passed, and a gain differs by more than noise
    UNCHANGED = "unchanged"  #: every check passed, and no gain does
    WAITING = "waits for an operator"  #: a review or a signature is missing
    NOT_COMPARED = "not compared"  #: every check passed that needs no controller
    REFUSED = "refused"  #: a check failed


@dataclass(frozen=True, slots=True)
class AxisRow:
    """One gain of the certificate."""

    change: GainChange  #: identified gain with its σ, and the one that it is compared with
    allowed_percent: tuple[float, float]  #: limits of the change
    judged: JudgedChange  #: NaN where it cannot be judged
    refusals: tuple[Refusal, ...]  #: failed checks of this axis

    @property
    def words(self) -> str:
        """Verdict in words."""
        if self.refusals:
            return "; ".join(f"refused: {found_in_short(refusal)}" for refusal in self.refusals)
        if self.significant:
            return f"differs from the {self.change.compared_with.value}"
        return "same within noise"

    @property
    def significant(self) -> bool:
        """Whether the change is more than noise."""
        return self.judged.significant


@dataclass(frozen=True, slots=True)
class Origin:
    """File and session that a calibration comes from."""

    sha256: str  #: of the calibration's file
    session: str | None = None  #: name of the session that made it; None where there was none

    @classmethod
    def of(cls, calibration: Calibration, session: str | None = None) -> Origin:
        """Origin of a calibration that is in the file as drivegain writes it."""
        return cls(sha256(encode_calibration(calibration)), session)

    @property
    def id(self) -> str:
        """Short name of the calibration's file, the same each time."""
        return self.sha256[:_ID_DIGITS]


@dataclass(frozen=True, slots=True)
class Certificate:
    """All that the first page shows."""

    calibration: Calibration
    comparison: Comparison
    origin: Origin
    #: change from the current gain or the nameplate, one an axis
    proposed_rows: tuple[AxisRow, ...]
    #: Comparison with the gains before the write that is in force; None where there are none.
    before_write: Comparison | None = None
    written_rows: tuple[AxisRow, ...] = ()  #: change by that write, one an axis; empty without it
    earlier: Calibration | None = None  #: another calibration of the cell to compare with
    #: Change from the earlier calibration, judged with the σ of both, one an axis; empty without
    #: one.
    rows_since_earlier: tuple[AxisRow, ...] = ()

    @property
    def shown_rows(self) -> tuple[AxisRow, ...]:
        """Change of each gain as the page shows it: by the write, once the gains are written."""
        return self.written_rows or self.proposed_rows

    @property
    def compared_with(self) -> str:
        """Word for the gains that `shown_rows` compares with, the same on every axis."""
        return self.shown_rows[0].change.compared_with.value

    @property
    def note(self) -> str:
        """Meaning of a difference beyond noise, as `apply` states it."""
        comparison = self.before_write or self.comparison
        return noise_note(comparison.changes, comparison.known)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole calibration."""
        gates = {refusal.gate for refusal in self.comparison.refusals}
        if gates - OPERATORS:
            return Verdict.REFUSED
        if self.comparison.edit is None:
            return Verdict.NOT_COMPARED
        if not any(row.significant for row in self.proposed_rows):
            return Verdict.UNCHANGED
        if gates:
            return Verdict.WAITING
        return Verdict.READY

    @property
    def sentence(self) -> str:
        """The verdict in one sentence, and what to check first;
        of gains that are in force, who has written them.
        """
        check = check_text(self.calibration)
        # A refusal says itself what is wrong.
        if not check or self.verdict is Verdict.REFUSED:
            return self._verdict_sentence
        return f"{self._verdict_sentence} {check}"

    @property
    def _verdict_sentence(self) -> str:
        """The verdict by gains and checks."""
        differing = [row for row in self.shown_rows if row.significant]
        most = max(differing, key=lambda row: abs(row.change.change_percent), default=None)
        furthest = ""
        if most is not None:
            furthest = f"{most.change.axis} most, by {most.change.change_percent:+.1f} %"
        total = len(self.shown_rows)
        count = f"all {total} gains"
        if len(differing) != total:
            count = f"{len(differing)} of {total} gains"
        write = self.comparison.in_force
        if write is not None:
            return self._written_sentence(write, f"{count} changed by more than noise, {furthest}")
        match self.verdict:
            case Verdict.REFUSED:
                return f"Must not be written: {self._reason}."
            case Verdict.UNCHANGED:
                return (
                    "Nothing to change: no gain differs from the current gain by more than noise."
                )
            case Verdict.WAITING:
                remedy = self.comparison.refusals[0].remedy
                return f"Waits for an operator: {count} change, {furthest}. To do: {remedy}."
            case Verdict.READY:
                return (
                    f"Ready to be written: {count} change by more than noise, {furthest}. Every "
                    "check passed."
                )
        compared = "all agree with the nameplate"
        if differing:
            compared = f"{count} differ from the nameplate by more than noise, {furthest}"
        return f"Identified, not compared with a controller: {compared}."

    @property
    def contradicted(self) -> str:
        """What new moves with the written gains have found wrong; empty where nothing is."""
        acceptance = self.comparison.standing.acceptance
        if acceptance is None or acceptance.accepted:
            return ""
        return acceptance.remark or "the audit log does not say how"

    @property
    def _failed(self) -> list[Refusal]:
        """Failed checks that no operator can open."""
        return [refusal for refusal in self.comparison.refusals if refusal.gate not in OPERATORS]

    @property
    def _reason(self) -> str:
        """Why the calibration is refused."""
        if self.calibration.gains_fixed:
            return "the gains were held fixed (`--gains fixed`), so there is nothing to write"
        first, *others = self._failed
        more = ""
        if others:
            more = f" (and {len(others)} more, below)"
        return f"{first.subject}: {found_in_short(first)}, expected {first.expected}{more}"

    def _written_sentence(self, write: Event, changed: str) -> str:
        """Say who has written the gains, how they changed,
        and which check would refuse them today.
        """
        text = write_text(write)
        sentence = f"{text[0].upper()}{text[1:]}"
        if any(row.significant for row in self.written_rows):
            sentence += f": {changed}"
        if self.contradicted:
            sentence += f". New moves contradict them: {self.contradicted}"
        if self._failed:
            sentence += f". Today a check refuses them: {self._reason}"
        return f"{sentence}."


def check_text(calibration: Calibration) -> str:
    """Name what is to be checked first, in one sentence; empty where nothing is."""
    if not calibration.diagnoses:
        return ""
    first, *others = calibration.diagnoses
    more = ""
    if others:
        more = f" (and {len(others)} more)"
    return f"But CHECK {first.subject}: {finding_in_short(first.found)}{more}."


def found_in_short(refusal: Refusal) -> str:
    """Return what a check has found; of a wrong description the first clause,
    because a CHECK has all of it.
    """
    if refusal.gate is Gate.DESCRIPTION:
        return finding_in_short(refusal.found)
    return refusal.found


def finding_in_short(found: str) -> str:
    """Return the first clause of what a diagnosis has found."""
    first, *_ = _CLAUSE_END.split(found, maxsplit=1)
    return first


def certify(
    calibration: Calibration,
    comparison: Comparison,
    earlier: Calibration | None = None,
    origin: Origin | None = None,
) -> Certificate:
    """Judge a calibration.

    Args:
        calibration: with its evidence.
        comparison: with the controller or the nameplate.
        earlier: another calibration of the same cell to compare with; None for none.
        origin: of the calibration; None for one without a session, in a file as drivegain writes
            it.

    Raises:
        CalibrationRefused: one of the two has not one error for each gain, or the earlier one is of
            another cell or of other axes.
    """
    _require_whole(calibration)
    rows_since_earlier: tuple[AxisRow, ...] = ()
    if earlier is not None:
        _require_whole(earlier)
        _require_same(calibration, earlier)
        gains = {gain.axis: gain.value for gain in earlier.gains}
        changes = changes_from(gains, GainOrigin.EARLIER, calibration)
        known = HistoryFigures({gain.axis: gain.std for gain in earlier.gains})
        with_earlier = replace(comparison, changes=changes, refusals=(), known=known)
        rows_since_earlier = _rows(with_earlier)
    origin = origin or Origin.of(calibration)
    previous = before_write(comparison, origin.sha256)
    written_rows: tuple[AxisRow, ...] = ()
    if previous is not None:
        written_rows = _rows(previous)
    return Certificate(
        calibration=calibration,
        comparison=comparison,
        origin=origin,
        proposed_rows=_rows(comparison),
        before_write=previous,
        written_rows=written_rows,
        earlier=earlier,
        rows_since_earlier=rows_since_earlier,
    )


def _rows(comparison: Comparison) -> tuple[AxisRow, ...]:
    judged, _ = judge(comparison.changes, comparison.known)
    rows = []
    for change in comparison.changes:
        allowed_percent = comparison.allowed_percent(change)
        drift = judged.get(change.axis, NOT_JUDGED)
        refusals = tuple(
            refusal for refusal in comparison.refusals if refusal.subject == change.axis
        )
        rows.append(AxisRow(change, allowed_percent, drift, refusals))
    return tuple(rows)


def _require_same(calibration: Calibration, earlier: Calibration) -> None:
    axes = {gain.axis for gain in calibration.gains}
    others = {gain.axis for gain in earlier.gains}
    if calibration.cell != earlier.cell or axes != others:
        expected = f"cell {calibration.cell!r} with axes {', '.join(sorted(axes))}"
        raise CalibrationRefused(
            "--beside",
            found=f"cell {earlier.cell!r} with axes {', '.join(sorted(others))}",
            expected=expected,
            remedy="give an earlier calibration of the same cell",
        )
    differences = robot_differences(earlier.robot, calibration.robot)
    if differences:
        raise CalibrationRefused(
            "--beside",
            found=f"another robot with the cell name {earlier.cell!r}: {found_text(differences)}",
            expected=f"{expected_text(differences)}, as in the calibration of this page",
            remedy="give an earlier calibration of the same robot",
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


def certificate_report(certificate: Certificate) -> CertificateReport:
    """Return the numbers of the page."""
    calibration = certificate.calibration
    comparison = certificate.comparison
    edit = comparison.edit
    beside = None
    if certificate.earlier is not None:
        axes = [_certified_gain(row) for row in certificate.rows_since_earlier]
        beside = EarlierCalibration.of(certificate.earlier, axes=axes)
    effects = []
    for effect in calibration.effects:
        words = accepted_text(effect, calibration)
        size = size_text(effect, calibration)
        effects.append(CertifiedEffect.of(effect, effect=words, size=size))
    controller = None
    if edit is not None:
        controller = str(edit.file)
    return CertificateReport.of(
        certificate,
        certificate.origin,
        comparison,
        calibration,
        format="drivegain-certificate",
        version=1,
        status=certificate_status(comparison),
        identity=identity(calibration),
        controller=controller,
        controller_unread=comparison.unread or None,
        axes=[_certified_gain(row) for row in certificate.proposed_rows],
        effects=effects,
        beside=beside,
    )


def _certified_gain(row: AxisRow) -> CertifiedGain:
    change = row.change
    return CertifiedGain.of(
        change,
        row,
        key=change.key or None,
        line=change.line or None,
        old=change.compared_gain,
        nameplate=change.nameplate_gain,
        written=change.spelling or None,
        change_sigmas=row.judged.sigmas,
        verdict=row.words,
    )


_VERBS = {WriteAction.APPLIED: "written", WriteAction.ROLLED_BACK: "restored by a rollback"}
_ENDS = {WriteAction.APPLIED: "replaced by other gains", WriteAction.ROLLED_BACK: "rolled back"}


def certificate_status(comparison: Comparison) -> CertificateStatus:
    """Return the status for the document of the certificate."""
    state = _state(comparison)
    text = status_text(comparison)
    return CertificateStatus.of(comparison.standing, state=state.value, text=text)


def _state(comparison: Comparison) -> StandingState:
    if comparison.changed_by_hand:
        return StandingState.REPLACED
    return comparison.standing.state


def status_text(comparison: Comparison) -> str:
    """Return the status in words."""
    standing = comparison.standing
    if standing.as_of is None:
        return f"not known: {standing.unknown}"
    parts = ["not written"]
    if standing.write is not None:
        parts = [write_text(standing.write)]
    if standing.ended is not None:
        ended = standing.ended
        parts.append(f"{_ENDS[ended.action]} on {_when(ended.at)} by {ended.who}")
    elif comparison.changed_by_hand:
        parts.append("the file has other gains now")
    if standing.acceptance is not None:
        parts.append(
            _acceptance_text(standing.acceptance, is_in_place=comparison.in_force is not None)
        )
    if standing.history.may_lack:
        parts.append(MAY_LACK)
    return f"{'; '.join(parts)} (as of {_when(standing.as_of)})"


def _acceptance_text(acceptance: RecordedAcceptance, *, is_in_place: bool) -> str:
    """Say when new moves accepted the gains;
    otherwise what failed, and how to undo the write if it is in place.
    """
    if acceptance.accepted:
        return f"accepted on {_when(acceptance.at)} by {acceptance.who}"
    text = f"NOT ACCEPTED on {_when(acceptance.at)} by {acceptance.who}"
    if acceptance.remark:
        text += f": {acceptance.remark}"
    if is_in_place and acceptance.undo:
        text += f"; to undo the write: {acceptance.undo}"
    return text


def write_text(write: Event) -> str:
    """Say when a write was made, by whom and where."""
    place = "the drives"
    target = Path(write.target)
    if target.is_absolute():
        place = target.name
    return f"{_VERBS[write.action]} on {_when(write.at)} by {write.who} to {place}"


def _when(at: datetime) -> str:
    return minute_text(at.isoformat())


def identity(calibration: Calibration) -> dict[str, str]:
    """Drives, operator, payload, dates, encoders and software as texts by their names;
    what is missing is said.

    Encoders are there where the robot has more of them than degrees of freedom.
    """
    recordings = [
        source.recording for source in calibration.sources if source.recording is not None
    ]
    operators = sorted({one.operator for one in recordings if one.operator})
    payloads = "; ".join(payload_texts(calibration))
    if payloads and not calibration.gains_fixed:
        # No residual shows a wrong mass: it must be on the sheet that a person signs.
        influences = "; ".join(mass_texts(calibration.payload_mass))
        # Calibrations of earlier versions do not say more.
        known = influences or (
            "a wrong mass changes every gain, by the same share where nothing else of it is known"
        )
        payloads = f"{payloads}; {known}"
    period = _period([one.recorded_s for one in recordings if one.recorded_s is not None])
    names = {
        "Serial numbers": _serials(calibration, recordings),
        "Operator": ", ".join(operators) or "not known: the recordings name none",
        "Payload": payloads or "none: every run was recorded without load",
        "Recorded": period,
    }
    order = order_text(calibration)
    if order:
        names["Order of runs"] = order
    if calibration.encoder_misfit is not None:
        names["Encoders"] = encoder_text(calibration.encoder_misfit)
    names["Fitted"] = (
        f"{minute_text(calibration.created)}, {calibration.software or 'software not known'}"
    )
    return names


def order_text(calibration: Calibration) -> str:
    """In which order bare and loaded runs of the fit were recorded,
    and what that does to slow changes.

    Empty where a time is not known, or all runs are of one kind. The means of their places in the
    order are compared: friction that changes evenly from run to run is the same for both kinds
    where these are equal. With friction by payload the order does not matter.
    """
    timed: list[tuple[float, bool]] = []
    for source in calibration.sources:
        if source.role != FIT_ROLE:
            continue
        if source.recording is None or source.recording.recorded_s is None:
            return ""
        timed.append((source.recording.recorded_s, source.payload is not None))
    is_loaded = [loaded for _, loaded in sorted(timed)]
    loaded_places = [place for place, loaded in enumerate(is_loaded) if loaded]
    bare_places = [place for place, loaded in enumerate(is_loaded) if not loaded]
    if not loaded_places or not bare_places:
        return ""
    listed = ", ".join("loaded" if loaded else "bare" for loaded in is_loaded)
    by_payload = [
        parameter for parameter in calibration.parameters if parameter.is_payload_friction
    ]
    if sum(parameter.name.startswith("fs") for parameter in by_payload) >= len(calibration.gains):
        return f"{listed}; friction by payload: its change between them moves no gain"
    later = fmean(loaded_places) - fmean(bare_places)
    if abs(later) <= BALANCED_PLACES:
        return f"{listed}; so an even warm-up moves no gain"
    last = "bare"
    if later > 0.0:
        last = "loaded"
    return f"{listed}; {last} runs come later, so a warm-up moves the gains"


def payload_texts(calibration: Calibration) -> Iterator[str]:
    """The mass of each payload as it was entered twice:
    in the cell file, and from the scale at each recording.
    """
    mounted: dict[tuple[str, float | None], list[float]] = {}
    for source in calibration.sources:
        if source.payload is not None:
            entered = None
            if source.recording is not None:
                entered = source.recording.entered_kg
            masses = mounted.setdefault((source.payload, source.mass_kg), [])
            if entered is not None and entered not in masses:
                masses.append(entered)
    for (name, declared), masses in mounted.items():
        entry = f"{declared:g} kg in the cell file"
        if declared is None:
            entry = "no mass in the cell file"
        scale = "not weighed a second time"
        if masses:
            scale = f"{' and '.join(f'{one:g}' for one in masses)} kg on the scale"
        yield f"{name}: {entry}, {scale}"


def _period(times_s: Sequence[float]) -> str:
    """Write the time between the first and the last recording to the minute, in UTC."""
    if not times_s:
        return "not known: the logs have no time of day"
    first = f"{datetime.fromtimestamp(min(times_s), UTC):%Y-%m-%d %H:%M}"
    last = f"{datetime.fromtimestamp(max(times_s), UTC):%Y-%m-%d %H:%M}"
    if first == last:
        return f"{first} UTC"
    same_day = first[:10] == last[:10]
    return f"{first} to {last[11:] if same_day else last} UTC"


def _serials(calibration: Calibration, recordings: Sequence[Recording]) -> str:
    found = []
    for index, gain in enumerate(calibration.gains):
        serials = dict.fromkeys(
            one.serials[index] for one in recordings if index < len(one.serials)
        )
        known = [str(serial) for serial in serials if serial is not None]
        if known:
            found.append(f"{gain.axis} {' and '.join(known)}")
    return ", ".join(found) or "not known: the drives reported none"
