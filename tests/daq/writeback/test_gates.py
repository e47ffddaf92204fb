"""Every gate closes for its own reason, and alone:
one thing is broken of a calibration that passes all of them.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.cell_schema import PolicyModel
from daq.config.policy import AppliedBy, ApplyPolicy, HoldOut
from daq.documents.calibration_file import encode_calibration
from daq.errors import CalibrationRefused, ConfigurationInconsistent, exit_code
from daq.files import sha256
from daq.ledger.audit import AuditAction, read
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates import fit as fit_gates
from daq.writeback.gates.gate import Gate
from daq.writeback.gates.table import GATES
from daq.writeback.request import Request
from daq.writeback.signature import generate, sign
from daq.writeback.target import Proposal, apply, propose
from ident.calibration import Calibration, EncoderMisfit, GeometryCorrection, Source
from ident.errors import Diagnosis
from ident.estimators.estimate import RelativeError
from tests.daq.calibrations import (
    AXES,
    KEYS,
    RECORDED,
    demo_calibration,
    demo_recording,
    recorded,
    with_recordings,
)

CONFIGS = Path(__file__).parents[3] / "configs"
NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
DAY = timedelta(days=1)


@dataclass(frozen=True)
class ProposalInputs:
    """All that a proposal is made of; every gate is open."""

    calibration: Calibration
    cell: Cell
    controller: Path
    policy: ApplyPolicy
    now: datetime
    entered_kg: dict[str, float]
    base: str | None
    appliers: tuple[str, ...]
    file: Path | None
    signed: tuple[str, ...]

    def propose(self) -> Proposal[FileEdit]:
        """Sign, and work out the change."""
        content = encode_calibration(self.calibration)
        if self.file is not None:
            self.file.write_bytes(content)
            for name in self.signed:
                secret_key = self.file.parent / f"{name}.key"
                sign(self.file, secret_key, name, at=NOW)
        request = Request(
            self.calibration,
            self.now,
            policy=self.policy,
            entered_kg=self.entered_kg,
            base=self.base,
            appliers=self.appliers,
            file=self.file,
            content=content,
        )
        target = FileTarget.of(self.cell, self.controller)
        return propose(target, request)


@pytest.fixture
def inputs(tmp_path: Path) -> ProposalInputs:
    """A calibration of the demo cell that Ada applies and Bob has signed."""
    controller = tmp_path / "demo.yaml"
    demo_path = CONFIGS / "controllers" / "demo.yaml"
    shutil.copyfile(demo_path, controller)
    path = CONFIGS / "cells" / "demo.yaml"
    cell = load_cell(path)
    keys = {name: generate(tmp_path, name)[1].line for name in ("Ada", "Bob")}
    calibration = with_recordings(
        demo_calibration(), controller_sha256=sha256(controller.read_bytes())
    )
    changed_calibration = replace(
        calibration,
        configuration_sha256=cell.digest,
        recording_configuration_sha256=cell.recording_digest,
    )
    policy = ApplyPolicy(signatures=1, signers=keys)
    file = tmp_path / "calibration.yaml"
    return ProposalInputs(
        calibration=changed_calibration,
        cell=cell,
        controller=controller,
        policy=policy,
        now=NOW,
        entered_kg={},
        base=None,
        appliers=("Ada", "root"),
        file=file,
        signed=("Bob",),
    )


Change = Callable[[ProposalInputs], ProposalInputs]


def _gain(axis: str, **changes: Any) -> Change:
    def broken(inputs: ProposalInputs) -> ProposalInputs:
        gains = list(inputs.calibration.gains)
        index = AXES.index(axis)
        gains[index] = replace(gains[index], **changes)
        return _calibration(gains=tuple(gains))(inputs)

    return broken


def _unit(axis: str, unit: str) -> Change:
    def broken(inputs: ProposalInputs) -> ProposalInputs:
        gains = list(inputs.calibration.gains)
        index = AXES.index(axis)
        gains[index] = replace(gains[index], unit=unit)
        return _calibration(gains=tuple(gains))(inputs)

    return broken


def _nameplate(axis: str, nameplate: float) -> Change:
    """The cell's, and the calibration's with it."""

    def broken(inputs: ProposalInputs) -> ProposalInputs:
        axes = list(inputs.cell.axes)
        index = AXES.index(axis)
        axes[index] = replace(axes[index], nameplate_gain=nameplate)
        cell = replace(inputs.cell, axes=tuple(axes))
        of_cell = replace(inputs, cell=cell)
        return _gain(axis, nameplate=nameplate)(of_cell)

    return broken


def _payload(**changes: Any) -> Change:
    """Another disc in the cell file now, which has been reviewed: every digest is right."""

    def broken(inputs: ProposalInputs) -> ProposalInputs:
        (disc,) = inputs.cell.payloads
        other_disc = replace(disc, **changes)
        cell = replace(inputs.cell, payloads=(other_disc,))
        return replace(inputs, cell=cell)

    return broken


def _calibration(**changes: Any) -> Change:
    def broken(inputs: ProposalInputs) -> ProposalInputs:
        calibration = replace(inputs.calibration, **changes)
        return replace(inputs, calibration=calibration)

    return broken


def _fit_error(axes: tuple[float, ...], overall: float) -> Change:
    return _calibration(relative_error_percent=RelativeError(axes, overall))


def _holdout_error(axes: tuple[float, ...], overall: float) -> Change:
    return _calibration(holdout_error_percent=RelativeError(axes, overall))


def _nameplate_holdout_error(axes: tuple[float, ...], overall: float) -> Change:
    return _calibration(nameplate_holdout_error_percent=RelativeError(axes, overall))


def _logs(**changes: Any) -> Change:
    def broken(inputs: ProposalInputs) -> ProposalInputs:
        calibration = with_recordings(inputs.calibration, **changes)
        return replace(inputs, calibration=calibration)

    return broken


def _source(index: int, **changes: Any) -> Change:
    """A change of one log, or of how it was recorded."""

    def broken(inputs: ProposalInputs) -> ProposalInputs:
        sources = list(inputs.calibration.sources)
        recording = sources[index].recording
        of_recording: dict[str, Any] = {}
        of_source: dict[str, Any] = {}
        for key, value in changes.items():
            if key in _RECORDING:
                of_recording[key] = value
            else:
                of_source[key] = value
        if recording is not None and of_recording:
            of_source["recording"] = replace(recording, **of_recording)
        sources[index] = replace(sources[index], **of_source)
        return _calibration(sources=tuple(sources))(inputs)

    return broken


_RECORDING = set(type(demo_recording()).__slots__)


def diagnosis_named(name: str, *axes: str, runs: tuple[str, ...] = ()) -> Diagnosis:
    """What a fit says of a description that is wrong."""
    return Diagnosis(
        name,
        runs,
        axes,
        "the zero of J2 off by +2.00 ± 0.05 °",
        "the URDF's",
        "correct it, and fit again",
    )


def _corrected(effect: str, diagnosis: Diagnosis) -> Change:
    """An effect on J3, in the place of the load friction there,
    and what the fit has said without it.
    """

    def broken(inputs: ProposalInputs) -> ProposalInputs:
        first_effect = inputs.calibration.effects[0]
        correction = replace(first_effect, name=effect)
        return _calibration(effects=(correction,), diagnoses=(diagnosis,))(inputs)

    return broken


def _by_encoders(*, applied: bool) -> Change:
    """Encoders of a closed chain that find the zero of J2 off."""
    correction = GeometryCorrection("zero", "J2", "", 0.0, 0.0349, 0.0002, "rad")
    misfit = EncoderMisfit(0.01, 0.0001, "rad", True, (correction,), applied)
    diagnoses = (diagnosis_named("zero-off", "J2"),)
    return _calibration(encoder_misfit=misfit, diagnoses=diagnoses)


UNEXPLAINED = EncoderMisfit(1e-4, 2e-5, "rad", True, (), False, noise=5e-6)


def _unexplained(misfit: float, noise: float | None = 5e-6) -> Change:
    """Encoders of a closed chain that miss the loops without an explanation."""
    found = replace(UNEXPLAINED, described=misfit, noise=noise)
    diagnoses = (diagnosis_named("geometry-off"),)
    return _calibration(encoder_misfit=found, diagnoses=diagnoses)


def _late_encoder(inputs: ProposalInputs) -> ProposalInputs:
    """An encoder of a closed chain that is late:
    its diagnosis refuses, whatever the size of the misfit.
    """
    found = replace(UNEXPLAINED, described=2e-3, left=5e-6, late_encoders="an encoder of J2")
    diagnoses = (diagnosis_named("position-late", "J2"),)
    return _calibration(encoder_misfit=found, diagnoses=diagnoses)(inputs)


def _diagnosed(*diagnoses: Diagnosis) -> Change:
    return _calibration(diagnoses=diagnoses)


def _only(*indices: int) -> Change:
    """Some of the logs; what is said of a hold-out goes with its log."""

    def broken(inputs: ProposalInputs) -> ProposalInputs:
        all_sources = inputs.calibration.sources
        sources = tuple(all_sources[index] for index in indices)
        if 2 in indices:
            return _calibration(sources=sources)(inputs)
        return _calibration(
            sources=sources, holdout_error_percent=None, nameplate_holdout_error_percent=None
        )(inputs)

    return broken


def _inputs(**changes: Any) -> Change:
    return lambda inputs: replace(inputs, **changes)


def _effect(inputs: ProposalInputs) -> ProposalInputs:
    first_effect = inputs.calibration.effects[0]
    worse = replace(first_effect, error_after_percent=6.3)
    return _calibration(effects=(worse,))(inputs)


def _edited(inputs: ProposalInputs) -> ProposalInputs:
    text = inputs.controller.read_text()
    inputs.controller.write_text(text + "# seen by K.\n")
    return inputs


def _edited_before_the_dry_run(inputs: ProposalInputs) -> ProposalInputs:
    return replace(_edited(inputs), base="0" * 64)


def _forged(inputs: ProposalInputs) -> ProposalInputs:
    """Bob has signed another file of that name."""
    assert inputs.file is not None
    inputs.file.write_bytes(b"another calibration")
    secret_key = inputs.file.parent / "Bob.key"
    sign(inputs.file, secret_key, "Bob", at=NOW)
    return replace(inputs, signed=())


def _another_serial_now(inputs: ProposalInputs) -> ProposalInputs:
    axes = list(inputs.cell.axes)
    assert axes[3].identity is not None
    identity = replace(axes[3].identity, serial=4711)
    axes[3] = replace(axes[3], identity=identity)
    cell = replace(inputs.cell, axes=tuple(axes))
    return replace(inputs, cell=cell)


def _without_serials(inputs: ProposalInputs) -> ProposalInputs:
    """The cell knows no serial of a drive."""
    axes = []
    for axis in inputs.cell.axes:
        if axis.identity is None:
            axes.append(axis)
            continue
        identity = replace(axis.identity, serial=None)
        axes.append(replace(axis, identity=identity))
    cell = replace(inputs.cell, axes=tuple(axes))
    return replace(inputs, cell=cell)


def _wanted(inputs: ProposalInputs) -> ProposalInputs:
    """The cell wants a hold-out."""
    policy = replace(inputs.policy, holdout=HoldOut.REQUIRED)
    return replace(inputs, policy=policy)


def _bounded(inputs: ProposalInputs, **axes: float) -> ProposalInputs:
    policy = replace(inputs.policy, max_change=axes)
    return replace(inputs, policy=policy)


def _both(*steps: Callable[[ProposalInputs], ProposalInputs]) -> Change:
    def broken(inputs: ProposalInputs) -> ProposalInputs:
        for step in steps:
            inputs = step(inputs)
        return inputs

    return broken


def _doubled(inputs: ProposalInputs) -> ProposalInputs:
    """The loaded log once more."""
    sources = inputs.calibration.sources
    loaded = sources[1]
    return _calibration(sources=(*sources, loaded))(inputs)


def _without_payload(inputs: ProposalInputs) -> ProposalInputs:
    """Nothing was mounted, ever."""
    for index in (1, 2):
        inputs = _source(index, payload=None, mass_kg=None, entered_kg=None)(inputs)
    return inputs


def _recorded(after: timedelta) -> Change:
    """The unloaded log was recorded at another time."""
    recorded_s = (NOW + after).timestamp()
    return _source(0, recorded_s=recorded_s)


def _without_holdout_log(inputs: ProposalInputs) -> ProposalInputs:
    """The errors of the hold-out are there, its log is not."""
    sources = inputs.calibration.sources[:2]
    return _calibration(sources=sources)(inputs)


HELD = (3.2, 2.9, 3.5, 4.1, 5.6, 5.0)
"""Errors of the axes that were predicted of the held-out log [%]."""

TESTED_GATES: set[Gate] = set()


def _refused_by(gate: Gate, *cases: tuple[str, Change]) -> pytest.MarkDecorator:
    """Parametrize a test with changes that one gate refuses, and with the subject that it names."""
    TESTED_GATES.add(gate)
    parameters = [(gate, subject, change) for subject, change in cases]
    return pytest.mark.parametrize(("gate", "subject", "change"), parameters)


def _assert_refused(inputs: ProposalInputs, gate: Gate, subject: str, change: Change) -> None:
    """One gate closes, and no other; nothing is written but the audit log."""
    inputs = change(inputs)
    before = inputs.controller.read_bytes()
    proposal = inputs.propose()
    gates = {refusal.gate for refusal in proposal.refusals}
    assert gates == {gate}
    for refusal in proposal.refusals:
        assert subject in refusal.subject
    folder = inputs.controller.parent
    audit = folder / "audit.jsonl"
    with pytest.raises(CalibrationRefused) as caught:
        apply(proposal, NOW, audit=audit, who="Ada")
    assert exit_code(type(caught.value)) == 3
    for refusal in proposal.refusals:
        assert refusal.found in str(caught.value)
        assert refusal.remedy
    assert inputs.controller.read_bytes() == before
    assert not list(folder.glob("*.bak"))
    (entry,) = read(audit)
    assert entry.action is AuditAction.REFUSED
    assert entry.who == "Ada"
    assert entry.subject == str(inputs.controller)
    reported = entry.details["refusals"]
    assert isinstance(reported, list)
    assert len(reported) == len(proposal.refusals)
    for one in reported:
        assert one["gate"] == gate.value


def test_a_refusal_names_a_wrong_description_that_the_calibration_corrects(
    inputs: ProposalInputs,
) -> None:
    off = diagnosis_named("zero-off", "J3")
    corrected = _corrected("zero-offset", off)
    of_another_cell = _calibration(cell="another")
    wrong = _both(corrected, of_another_cell)(inputs).propose()
    refused_gates = [refusal.gate for refusal in wrong.refusals]
    assert Gate.DESCRIPTION not in refused_gates
    hint = f"hint: the fit of this calibration found {off.found}; {off.remedy}"
    assert hint in wrong.error.__notes__
    plain = of_another_cell(inputs).propose()
    assert not getattr(plain.error, "__notes__", [])


def test_a_calibration_that_is_fine_goes_through(inputs: ProposalInputs) -> None:
    proposal = inputs.propose()
    assert proposal.refusals == ()
    assert apply(proposal, NOW) is not None


@_refused_by(
    Gate.CHANGE,
    ("J2", _gain("J2", value=32.96 * 1.36)),
    ("J2", _gain("J2", value=32.96 * 0.64)),
    ("J4", lambda inputs: _bounded(inputs, J4=2.3)),
)
def test_the_change_gate_closes_on_a_gain_far_from_the_current_one(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.NAMEPLATE,
    ("J5", _nameplate("J5", 10.5)),
    ("J5", _gain("J5", nameplate=17.0)),
)
def test_the_nameplate_gate_closes_on_a_gain_far_from_the_data_sheet(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.SIGN,
    ("J4", _gain("J4", value=9.21)),
    ("J1", _nameplate("J1", -32.96)),
)
def test_the_sign_gate_closes_on_a_gain_of_the_other_sign(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.UNCERTAINTY,
    ("J6", _gain("J6", std=0.031 * 6.79)),
)
def test_the_uncertainty_gate_closes_on_a_large_std(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.NOT_IDENTIFIED,
    ("J6", _gain("J6", std=0.0)),
)
def test_the_not_identified_gate_closes_on_a_std_of_zero(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.NOT_FINITE,
    ("J6", _gain("J6", std=-0.1)),
    ("J3", _gain("J3", value=math.nan)),
    ("J3", _gain("J3", value=math.inf)),
    ("J3", _gain("J3", value=0.0)),
    ("J3", _gain("J3", std=math.nan)),
    ("J3", _gain("J3", nameplate=math.nan)),
    ("calibration", _holdout_error((1.0,), math.nan)),
    ("calibration", _fit_error((math.nan,), 3.0)),
    ("calibration", _fit_error((*HELD[:5], -1.0), 3.0)),
    ("calibration", _holdout_error(HELD, -3.0)),
)
def test_the_not_finite_gate_closes_on_a_number_that_is_none(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.UNIT,
    ("J5", _unit("J5", "mNm/A")),
)
def test_the_unit_gate_closes_on_another_unit(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.CELL,
    ("calibration", _calibration(cell="other")),
)
def test_the_cell_gate_closes_on_another_cell(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.CONFIGURATION,
    ("calibration", _calibration(recording_configuration_sha256="e" * 64)),
    (
        "calibration",
        _calibration(configuration_sha256="e" * 64, recording_configuration_sha256=None),
    ),
)
def test_the_configuration_gate_closes_on_another_digest(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.ERROR,
    (
        "calibration",
        _both(_holdout_error((26.0,) * 6, 26.0), _nameplate_holdout_error((30.0,) * 6, 30.0)),
    ),
    ("calibration", _both(_only(0, 1), _fit_error((26.0,) * 6, 26.0))),
    (
        "J6",
        _both(
            _holdout_error((*HELD[:5], 51.0), 3.3), _nameplate_holdout_error((*HELD[:5], 60.0), 4.3)
        ),
    ),
    ("J6", _both(_only(0, 1), _fit_error((*HELD[:5], 51.0), 3.3))),
    ("calibration", _holdout_error(HELD[:5], 3.3)),
    ("calibration", _holdout_error((), 3.3)),
    ("calibration", _fit_error((), 3.3)),
)
def test_the_error_gate_closes_on_a_large_or_missing_error(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.HOLDOUT,
    ("calibration", _nameplate_holdout_error(HELD, 3.25)),
    ("J4", _nameplate_holdout_error((*HELD[:3], 4.1 / 1.021, *HELD[4:]), 4.3)),
    ("J4", _nameplate_holdout_error((*HELD[:3], math.nan, *HELD[4:]), 4.3)),
    ("J6", _nameplate_holdout_error(HELD[:5], 4.3)),
    ("calibration", _both(_wanted, _only(0, 1))),
    ("calibration", _calibration(nameplate_holdout_error_percent=None)),
    ("calibration", _calibration(holdout_error_percent=None)),
    ("calibration", _without_holdout_log),
)
def test_the_holdout_gate_closes_where_the_nameplate_predicts_as_well_or_nothing_was_predicted(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.DESCRIPTION,
    ("J2", _diagnosed(diagnosis_named("zero-off", "J2"))),
    # Corrects that of J3
    ("J2", _corrected("zero-offset", diagnosis_named("zero-off", "J2"))),
    ("J2", _by_encoders(applied=False)),
    ("calibration", _unexplained(1.001e-4)),
    ("calibration", _unexplained(1e-3, noise=None)),
    ("J2", _late_encoder),
    ("calibration", _diagnosed(diagnosis_named("gravity-tilted"))),
    ("J2", _diagnosed(diagnosis_named("correction-unclear", "J2"))),
    ("calibration", _diagnosed(diagnosis_named("gravity-turned"))),
    ("J3", _diagnosed(diagnosis_named("position-late", "J3"))),
    ("J3", _diagnosed(diagnosis_named("position-reversed", "J3"))),
)
def test_the_description_gate_closes_on_a_diagnosis_that_nothing_corrects(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.HOLDOUT_STILL,
    ("J2", _holdout_error((3.2, math.nan, 3.5, 4.1, 5.6, 5.0), 3.3)),
)
def test_the_holdout_still_gate_closes_on_an_axis_that_did_not_move(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.EFFECT,
    ("effect load-friction on J3", _effect),
)
def test_the_effect_gate_closes_on_an_effect_that_makes_the_error_larger(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.SOURCES,
    ("calibration", _calibration(sources=())),
    ("log loaded", _source(1, sha256="")),
    ("log run.mcap.part", _source(0, name="run.mcap.part")),
    ("log held-out", _source(2, recording=None)),
    ("log loaded", _source(1, serials=())),
    ("log loaded", _source(1, serials=tuple(range(1001, 1006)))),
    ("log loaded", _source(1, saturated_percent=())),
    ("log loaded", _source(1, saturated_percent=(0.0,) * 7)),
    ("log loaded", _source(1, missing=())),
    ("log loaded", _source(1, saturated_percent=(0.0, 0.0, -0.1, 0.0, 0.0, 0.0))),
    ("log loaded", _source(1, saturated_percent=(0.0, 0.0, math.nan, 0.0, 0.0, 0.0))),
    ("log held-out", _source(2, sha256="b" * 64)),
    ("log loaded", _source(1, sha256="a" * 64)),
    ("log other", _both(_doubled, _source(3, name="other", sha256="e" * 64, role="train"))),
    ("calibration", _both(_without_payload, _only(0, 1))),
    ("calibration", _only(1)),
    ("calibration", _only(2)),
)
def test_the_sources_gate_closes_on_logs_that_do_not_support_a_calibration(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.PARTIAL,
    ("log loaded", _source(1, partial=True)),
    ("log loaded", _source(1, partial=True, missing=(0, 3, 0, 0, 0, 0))),
)
def test_the_partial_gate_closes_on_an_unfinished_log(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.LOSSY,
    ("log loaded", _source(1, lost_cycles=1)),
    ("log held-out", _source(2, missing=(0, 3, 0, 0, 0, 0))),
)
def test_the_lossy_gate_closes_on_lost_cycles_or_samples(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.STALE,
    ("log unloaded", _recorded(-30.1 * DAY)),
    ("log unloaded", _recorded(1.1 * DAY)),
    ("log unloaded", _source(0, recorded_s=None)),
    ("log unloaded", _source(0, recorded_s=1e300)),
    ("log unloaded", _source(0, recorded_s=-1e13)),
    ("log unloaded", _source(0, recorded_s=math.inf)),
    ("log unloaded", _source(0, recorded_s=math.nan)),
)
def test_the_stale_gate_closes_on_an_old_future_or_unknown_time(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.SERIAL,
    ("axis J4", _another_serial_now),
    ("log loaded, axis J4", _source(1, serials=(1001, 1002, 1003, None, 1005, 1006))),
    ("axis J4", _both(_without_serials, _source(1, serials=(1001, 1002, 1003, 9, 1005, 1006)))),
)
def test_the_serial_gate_closes_on_a_drive_of_another_serial(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.SATURATED,
    ("log loaded, axis J3", _source(1, saturated_percent=(0.0, 0.0, 2.1, 0.0, 0.0, 0.0))),
)
def test_the_saturated_gate_closes_on_saturated_samples(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.MASS,
    ("log loaded, payload disc", _source(1, entered_kg=None)),
    ("log loaded, payload disc", _source(1, entered_kg=4.596)),
    ("log loaded, payload disc", _source(1, mass_kg=None)),
    ("payload disc", _inputs(entered_kg={"disc": 4.58})),
    ("log unloaded", _source(0, mass_kg=4.59)),
    ("log held-out", _source(2, payload=None)),
    ("payload disc", _payload(mass_kg=4.60)),
    ("payload disc", _payload(name="other disc")),
)
def test_the_mass_gate_closes_on_a_mass_that_is_not_the_declared_one(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.BASE,
    ("demo.yaml", _edited),
    ("demo.yaml", _edited_before_the_dry_run),
)
def test_the_base_gate_closes_on_an_edited_controller_file(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


@_refused_by(
    Gate.SIGNATURE,
    ("calibration.yaml", _inputs(signed=())),
    ("calibration.yaml", _inputs(signed=("Ada",))),
    ("calibration.yaml", _inputs(appliers=("Ada", "bob"))),
    ("calibration.yaml", _inputs(signed=("Ada",), appliers=("ADA ", "root"))),
    ("calibration.yaml", _inputs(signed=("Ada",), appliers=("\uff21da", "root"))),
    ("calibration.yaml", _inputs(signed=("Bob",), appliers=("Ada", " bob"))),
    ("operator", _inputs(appliers=("Ad\u0430", "root"))),
    ("operator", _inputs(appliers=("Ada\u200b", "root"))),
    ("operator", _inputs(appliers=("Ada\x1b[2K", "root"))),
    ("operator", _inputs(appliers=("", "root"))),
    ("operator", _inputs(appliers=("Carl", "root"))),
    ("calibration", _inputs(file=None)),
    ("calibration.yaml.Bob.minisig", _forged),
)
def test_the_signature_gate_closes_without_the_signature_of_another_person(
    inputs: ProposalInputs, gate: Gate, subject: str, change: Change
) -> None:
    _assert_refused(inputs, gate, subject, change)


def test_every_gate_has_a_test_that_closes_it() -> None:
    assert set(Gate) == TESTED_GATES


def test_the_table_lists_every_gate_once_with_its_description() -> None:
    listed = [row.gate.name for row in GATES]
    assert sorted(listed) == sorted(gate.name for gate in Gate)
    for row in GATES:
        assert row.text
        assert row.remedy


@pytest.mark.parametrize(
    "kept",
    [
        _gain("J2", value=32.96 * 1.349),
        _gain("J2", value=32.96 * 0.651),
        _nameplate("J5", 11.0),
        _gain("J6", std=0.0299 * 6.79),
        _only(0, 1),
        _calibration(nameplate_holdout_error_percent=RelativeError(HELD, 3.3 / fit_gates.NOISE)),
        _calibration(
            nameplate_holdout_error_percent=RelativeError(
                tuple(axis / fit_gates.AXIS_NOISE for axis in HELD), 3.3
            )
        ),
        _calibration(
            holdout_error_percent=RelativeError((*HELD[:5], 49.9), 3.3),
            nameplate_holdout_error_percent=RelativeError((*HELD[:5], 49.9), 3.3),
        ),
        _calibration(effects=()),
        _unexplained(1e-4),
        _corrected("zero-offset", diagnosis_named("zero-off", "J3")),
        _corrected("gravity-direction", diagnosis_named("gravity-tilted")),
        _corrected("gravity-direction", diagnosis_named("correction-unclear", "J3")),
        _corrected("late-position", diagnosis_named("position-late", "J3")),
        _diagnosed(diagnosis_named("zero-off", "J2", runs=("held-out",))),
        _diagnosed(diagnosis_named("gain-off-nameplate", "J2")),
        _by_encoders(applied=True),
        _source(0, recorded_s=(NOW - 29.9 * DAY).timestamp()),
        _source(0, recorded_s=(NOW + 0.9 * DAY).timestamp()),
        _logs(saturated_percent=(2.0,) * 6),
        _logs(controller_sha256=None),
        _source(1, entered_kg=4.595),
        _both(
            _source(1, entered_kg=None),
            _source(2, entered_kg=None),
            _inputs(entered_kg={"disc": 4.585}),
        ),
        _both(_without_serials, _logs(serials=(None,) * 6)),
        _wanted,
        lambda inputs: _bounded(inputs, J4=2.32, J1=0.95),
        _calibration(configuration_sha256="e" * 64),
        _calibration(recording_configuration_sha256=None),
        _inputs(appliers=("root",)),
        _inputs(appliers=("Root", "root")),
        _inputs(appliers=()),
        _inputs(policy=ApplyPolicy(), signed=(), file=None, appliers=("Carl", "root")),
        _payload(mass_kg=4.594),
        _inputs(policy=ApplyPolicy(), signed=(), file=None),
        _inputs(policy=ApplyPolicy(max_age_days=None), now=NOW + 3000 * DAY),
        _both(_logs(recorded_s=None), _inputs(policy=ApplyPolicy(max_age_days=None))),
    ],
)
def test_just_inside_its_bound_a_gate_is_open(inputs: ProposalInputs, kept: Change) -> None:
    assert kept(inputs).propose().refusals == ()


@pytest.mark.parametrize("effects", [True, False])
def test_a_number_just_beyond_its_bound_is_not_written_as_the_bound(
    inputs: ProposalInputs, effects: bool
) -> None:
    """And a large σ is looked for in what the model lacks first, where that was not done."""
    bound = inputs.policy.max_std_percent
    absolute_gain = abs(inputs.calibration.gains[0].value)
    std = 1.0001e-2 * bound * absolute_gain
    doubtful = _gain("J1", std=std)(inputs)
    if not effects:
        doubtful = _calibration(effects=())(doubtful)
    (refusal,) = doubtful.propose().refusals
    assert refusal.gate is Gate.UNCERTAINTY
    assert float(refusal.found.removeprefix("σ ").removesuffix(" %")) > bound
    assert ("`drivegain residual`" in refusal.remedy) is not effects


def test_a_reviewed_change_of_a_changed_file_may_go_on(inputs: ProposalInputs) -> None:
    inputs = _edited(inputs)
    (refusal,) = inputs.propose().refusals
    digest = sha256(inputs.controller.read_bytes())
    # In full: this dry run, with a gate closed, ends without the line that a write would need.
    assert (refusal.gate, refusal.remedy.endswith(f"--base {digest}")) == (Gate.BASE, True)
    base = sha256(inputs.controller.read_bytes())
    changed_scene = replace(inputs, base=base)
    assert changed_scene.propose().refusals == ()


def test_the_policy_moves_the_bounds(inputs: ProposalInputs) -> None:
    tight = ApplyPolicy(
        max_change_percent=5.0,
        max_nameplate_percent=15.0,
        max_std_percent=0.3,
        max_saturated_percent=1.0,
        max_age_days=0.01,
    )
    refusals = replace(inputs, policy=tight).propose().refusals
    gates = [(refusal.gate, refusal.subject) for refusal in refusals]
    expected = ["J3", "J4", "J5", "J6"]
    assert [axis for gate, axis in gates if gate is Gate.CHANGE] == expected
    assert [axis for gate, axis in gates if gate is Gate.NAMEPLATE] == ["J4"]
    assert [axis for gate, axis in gates if gate is Gate.UNCERTAINTY] == list(AXES)
    assert len([axis for gate, axis in gates if gate is Gate.SATURATED]) == 3
    assert len([axis for gate, axis in gates if gate is Gate.STALE]) == 3


@pytest.mark.parametrize(
    ("section", "wanted"),
    [
        ({}, False),
        ({"holdout": "required"}, True),
        ({"by": "job"}, True),
        ({"by": "job", "holdout": "required"}, True),
    ],
)
def test_a_job_that_applies_by_itself_wants_a_hold_out(
    section: dict[str, str], wanted: bool
) -> None:
    text = json.dumps({"apply": section})
    policy = PolicyModel.model_validate_json(text).apply
    applied_by = AppliedBy(section.get("by", "person"))
    expected = (wanted, applied_by)
    assert (policy.requires_holdout, policy.by) == expected
    with pytest.raises(ValueError, match="holdout: required"):
        PolicyModel.model_validate_json('{"apply": {"by": "job", "holdout": "optional"}}')


def test_a_bound_of_an_axis_that_is_not_there_is_refused_with_its_line(tmp_path: Path) -> None:
    cells_folder = shutil.copytree(CONFIGS, tmp_path / "configs") / "cells"
    cell = cells_folder / "demo.yaml"
    text = cell.read_text()
    assert "policy:" not in text
    cell.write_text(text + "policy: {apply: {max_change: {J4: 2.0}}}\n")
    max_change = load_cell(cell).apply.max_change
    assert max_change == {"J4": 2.0}
    cell.write_text(text + "policy:\n  apply:\n    max_change:\n      j4: 2.0\n")
    line = len(cell.read_text().splitlines())
    with pytest.raises(
        ConfigurationInconsistent,
        match=rf":{line}: policy\.apply\.max_change\.j4: "
        r"found axis 'j4'",
    ):
        load_cell(cell)


def test_an_age_below_a_day_is_reported_in_hours(inputs: ProposalInputs) -> None:
    """2025-01-02 02:00 is an hour and four minutes ago."""
    max_age_days = 1 / 24
    policy = ApplyPolicy(max_age_days=max_age_days)
    hour = replace(inputs, policy=policy)
    refusals = hour.propose().refusals
    reported = {(one.found, one.expected) for one in refusals}
    assert reported == {("recorded 1.1 hours ago", "recorded within the last 1 hours")}
    recorded_s = (NOW - 30.1 * DAY).timestamp()
    days = _source(0, recorded_s=recorded_s)(replace(inputs, policy=ApplyPolicy()))
    assert [(one.found, one.expected) for one in days.propose().refusals] == [
        ("recorded 30.1 days ago", "recorded within the last 30 days")
    ]
    recorded_s = (NOW - 30.002 * DAY).timestamp()
    days = _source(0, recorded_s=recorded_s)(replace(inputs, policy=ApplyPolicy()))
    (just_too_old,) = days.propose().refusals
    assert just_too_old.found == "recorded 30.002 days ago"


@pytest.mark.parametrize("days", [3, 730])
def test_a_log_of_a_wrong_later_date_is_refused_with_the_way_out(
    inputs: ProposalInputs, days: int
) -> None:
    recorded_s = (NOW + days * DAY).timestamp()
    future = _source(0, recorded_s=recorded_s)(replace(inputs, policy=ApplyPolicy()))
    (refusal,) = future.propose().refusals
    assert refusal.gate is Gate.STALE
    assert refusal.found.endswith("from now")
    assert "it keeps that date: record again and fit" in refusal.remedy


def test_a_mass_corrected_since_the_fit_is_seen_through_configuration_changed(
    inputs: ProposalInputs,
) -> None:
    cell = _payload(mass_kg=5.0)(inputs).cell
    request = Request(
        inputs.calibration, NOW, policy=ApplyPolicy(), accepts_changed_configuration=True
    )
    target = FileTarget.of(cell, inputs.controller)
    proposal = propose(target, request)
    expected = {(Gate.MASS, "fitted with 4.59 kg")}
    assert {(one.gate, one.found) for one in proposal.refusals} == expected


def test_two_names_of_one_signer_are_one_person(inputs: ProposalInputs, tmp_path: Path) -> None:
    again = generate(tmp_path, "ADA")[1].line
    signers = {**inputs.policy.signers, "ADA": again}
    two = replace(inputs.policy, signatures=2, signers=signers)
    twice = replace(inputs, policy=two, signed=("Ada", "ADA"), appliers=("root",))
    refusals = twice.propose().refusals
    gates = [one.gate for one in refusals]
    assert gates == [Gate.SIGNATURE]


def test_a_signer_s_key_that_is_none_is_refused_with_file_line_and_key(
    tmp_path: Path, inputs: ProposalInputs
) -> None:
    cells_folder = shutil.copytree(CONFIGS, tmp_path / "configs") / "cells"
    cell = cells_folder / "demo.yaml"
    text = cell.read_text()
    line = len(text.splitlines()) + 4
    head = text + "policy:\n  apply:\n    signers:\n"
    cell.write_text(f"{head}      Ada: RWQnonsense\n")
    with pytest.raises(
        ConfigurationInconsistent,
        match=rf"demo\.yaml:{line}: "
        r"policy\.apply\.signers\.Ada: found",
    ):
        load_cell(cell)
    key = inputs.policy.signers["Ada"]
    cell.write_text(f"{head}      Ada: {key}\n      Bob: {key}\n")
    with pytest.raises(
        ConfigurationInconsistent,
        match=rf":{line + 1}: "
        r"policy\.apply\.signers\.Bob: "
        r".*key of Ada",
    ):
        load_cell(cell)
    cell.write_text(f"{head}      Ada: {key}\n")
    signers = load_cell(cell).apply.signers
    assert signers == {"Ada": key}


def test_two_signatures_of_others_are_two(inputs: ProposalInputs) -> None:
    policy = replace(inputs.policy, signatures=2)
    two = replace(inputs, policy=policy)
    refusals = replace(two, signed=("Ada", "Bob")).propose().refusals
    gates = [refusal.gate for refusal in refusals]
    assert gates == [Gate.SIGNATURE]
    assert replace(two, signed=("Ada", "Bob"), appliers=("the job",)).propose().refusals == ()


def test_all_failed_checks_are_reported_at_once(inputs: ProposalInputs) -> None:
    policy = ApplyPolicy(max_change_percent=5.0)
    other = replace(inputs, policy=policy)
    error = _calibration(cell="other")(other).propose().error
    expected = [True] * 5 + [False]
    assert [
        axis in str(error) for axis in ("cell 'other'", "J3:", "J4:", "J5:", "J6:", "J1:")
    ] == expected


def test_a_zero_in_the_file_has_no_sign_to_keep(inputs: ProposalInputs) -> None:
    changed_text = inputs.controller.read_text().replace("7.68", "0.0")
    inputs.controller.write_text(changed_text)
    base = sha256(inputs.controller.read_bytes())
    reviewed = replace(inputs, base=base)
    (refusal,) = reviewed.propose().refusals
    assert (refusal.gate, refusal.subject) == (Gate.SIGN, "J6")
    assert refusal.found == "a current gain of 0"
    assert "enter the nameplate there first" in refusal.remedy


def test_an_effect_on_all_axes_is_called_so(inputs: ProposalInputs) -> None:
    first_effect = inputs.calibration.effects[0]
    skew = replace(first_effect, name="time-skew", axis="all axes", error_after_percent=9.0)
    (refusal,) = _calibration(effects=(skew,))(inputs).propose().refusals
    assert refusal.subject == "effect time-skew on all axes"


def test_a_library_that_reports_no_gate_context_is_not_asked_for_them(
    inputs: ProposalInputs,
) -> None:
    source = Source("old", "a" * 64, "fit")
    sources = (source,)
    old = replace(inputs.calibration, sources=sources)
    target = FileTarget(inputs.controller, KEYS)
    request = Request(old, NOW)
    assert propose(target, request).refusals == ()
    refusals = replace(inputs, calibration=old).propose().refusals
    expected = {Gate.SOURCES, Gate.HOLDOUT}
    assert {one.gate for one in refusals} == expected


def test_the_demo_calibration_is_of_the_day_it_says() -> None:
    sources = recorded(demo_calibration(), RECORDED + DAY).sources
    assert all(
        source.recording is not None and source.recording.recorded_s == (RECORDED + DAY).timestamp()
        for source in sources
    )
