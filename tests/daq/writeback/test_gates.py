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
from ident.calibration import Calibration, EncoderMisfit, Gain, GeometryCorrection, Source
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
class Scene:
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
def scene(tmp_path: Path) -> Scene:
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
    return Scene(
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


def _gain(axis: str, **changes: float) -> Callable[[Scene], Scene]:
    def broken(scene: Scene) -> Scene:
        gains = tuple(
            _changed(gain, changes) if gain.axis == axis else gain
            for gain in scene.calibration.gains
        )
        calibration = replace(scene.calibration, gains=gains)
        return replace(scene, calibration=calibration)

    return broken


def _unit(axis: str, unit: str) -> Callable[[Scene], Scene]:
    def broken(scene: Scene) -> Scene:
        gains = (
            replace(gain, unit=unit) if gain.axis == axis else gain
            for gain in scene.calibration.gains
        )
        return _calibration(gains=tuple(gains))(scene)

    return broken


def _changed(gain: Gain, changes: dict[str, float]) -> Gain:
    return replace(gain, **changes)  # type: ignore[arg-type]  # fields by name


def _nameplate(axis: str, nameplate: float) -> Callable[[Scene], Scene]:
    """The cell's, and the calibration's with it."""

    def broken(scene: Scene) -> Scene:
        axes = (
            replace(one, nameplate_gain=nameplate) if one.name == axis else one
            for one in scene.cell.axes
        )
        return _gain(axis, nameplate=nameplate)(
            replace(scene, cell=replace(scene.cell, axes=tuple(axes)))
        )

    return broken


def _payload(**changes: object) -> Callable[[Scene], Scene]:
    """Another disc in the cell file now, which has been reviewed: every digest is right."""

    def broken(scene: Scene) -> Scene:
        payloads = (replace(one, **changes) for one in scene.cell.payloads)  # type: ignore[arg-type]
        cell = replace(scene.cell, payloads=tuple(payloads))
        return replace(scene, cell=cell)

    return broken


def _calibration(**changes: object) -> Callable[[Scene], Scene]:
    return lambda scene: replace(scene, calibration=replace(scene.calibration, **changes))  # type: ignore[arg-type]


def _logs(**changes: object) -> Callable[[Scene], Scene]:
    return lambda scene: replace(scene, calibration=with_recordings(scene.calibration, **changes))


def _source(index: int, **changes: object) -> Callable[[Scene], Scene]:
    def broken(scene: Scene) -> Scene:
        sources = list(scene.calibration.sources)
        reported = sources[index].recording
        of_recording = {key: value for key, value in changes.items() if key in _RECORDING}
        rest = {key: value for key, value in changes.items() if key not in _RECORDING}
        if reported is not None and of_recording:
            rest["recording"] = replace(reported, **of_recording)  # type: ignore[arg-type]
        sources[index] = replace(sources[index], **rest)  # type: ignore[arg-type]
        calibration = replace(scene.calibration, sources=tuple(sources))
        return replace(scene, calibration=calibration)

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


def _corrected(effect: str, diagnosis: Diagnosis) -> Callable[[Scene], Scene]:
    """An effect on J3, in the place of the load friction there,
    and what the fit has said without it.
    """

    def broken(scene: Scene) -> Scene:
        first_effect = scene.calibration.effects[0]
        correction = replace(first_effect, name=effect)
        return _calibration(effects=(correction,), diagnoses=(diagnosis,))(scene)

    return broken


def _by_encoders(*, applied: bool) -> Callable[[Scene], Scene]:
    """Encoders of a closed chain that find the zero of J2 off."""
    correction = GeometryCorrection("zero", "J2", "", 0.0, 0.0349, 0.0002, "rad")
    misfit = EncoderMisfit(0.01, 0.0001, "rad", True, (correction,), applied)
    diagnoses = (diagnosis_named("zero-off", "J2"),)
    return _calibration(encoder_misfit=misfit, diagnoses=diagnoses)


def _unexplained(misfit: float, noise: float | None = 5e-6) -> Callable[[Scene], Scene]:
    """Encoders of a closed chain that miss the loops without an explanation."""
    found = EncoderMisfit(misfit, 2e-5, "rad", True, (), False, noise=noise)
    diagnoses = (diagnosis_named("geometry-off"),)
    return _calibration(encoder_misfit=found, diagnoses=diagnoses)


def _late_encoder(scene: Scene) -> Scene:
    """An encoder of a closed chain that is late:
    its diagnosis refuses, whatever the size of the misfit.
    """
    found = EncoderMisfit(
        2e-3, 5e-6, "rad", True, (), False, noise=5e-6, late_encoders="an encoder of J2"
    )
    diagnoses = (diagnosis_named("position-late", "J2"),)
    return _calibration(encoder_misfit=found, diagnoses=diagnoses)(scene)


def _diagnosed(*diagnoses: Diagnosis) -> Callable[[Scene], Scene]:
    return _calibration(diagnoses=diagnoses)


def _only(*indices: int) -> Callable[[Scene], Scene]:
    """Some of the logs; what is said of a hold-out goes with its log."""

    def broken(scene: Scene) -> Scene:
        sources = tuple(scene.calibration.sources[index] for index in indices)
        if 2 in indices:
            gone = {}
        else:
            gone = {"holdout_error_percent": None, "nameplate_holdout_error_percent": None}
        return _calibration(sources=sources, **gone)(scene)

    return broken


def _scene(**changes: object) -> Callable[[Scene], Scene]:
    return lambda scene: replace(scene, **changes)  # type: ignore[arg-type]


def _effect(scene: Scene) -> Scene:
    first_effect = scene.calibration.effects[0]
    worse = replace(first_effect, error_after_percent=6.3)
    return _calibration(effects=(worse,))(scene)


def _edited(scene: Scene) -> Scene:
    scene.controller.write_text(scene.controller.read_text() + "# seen by K.\n")
    return scene


def _edited_before_the_dry_run(scene: Scene) -> Scene:
    return replace(_edited(scene), base="0" * 64)


def _forged(scene: Scene) -> Scene:
    """Bob has signed another file of that name."""
    assert scene.file is not None
    scene.file.write_bytes(b"another calibration")
    secret_key = scene.file.parent / "Bob.key"
    sign(scene.file, secret_key, "Bob", at=NOW)
    return replace(scene, signed=())


def _another_serial_now(scene: Scene) -> Scene:
    axes = list(scene.cell.axes)
    assert axes[3].identity is not None
    identity = replace(axes[3].identity, serial=4711)
    axes[3] = replace(axes[3], identity=identity)
    cell = replace(scene.cell, axes=tuple(axes))
    return replace(scene, cell=cell)


NO_SERIALS: Callable[[Scene], Scene] = lambda scene: replace(  # noqa: E731
    scene,
    cell=replace(
        scene.cell,
        axes=tuple(
            replace(a, identity=None if a.identity is None else replace(a.identity, serial=None))
            for a in scene.cell.axes
        ),
    ),
)


def _wanted(scene: Scene) -> Scene:
    """The cell wants a hold-out."""
    policy = replace(scene.policy, holdout=HoldOut.REQUIRED)
    return replace(scene, policy=policy)


def _bounded(scene: Scene, **axes: float) -> Scene:
    policy = replace(scene.policy, max_change=axes)
    return replace(scene, policy=policy)


def _both(*steps: Callable[[Scene], Scene]) -> Callable[[Scene], Scene]:
    def broken(scene: Scene) -> Scene:
        for step in steps:
            scene = step(scene)
        return scene

    return broken


def _doubled(scene: Scene) -> Scene:
    """The loaded log once more."""
    sources = (*scene.calibration.sources, scene.calibration.sources[1])
    return _calibration(sources=sources)(scene)


def _bare(scene: Scene) -> Scene:
    """Nothing was mounted, ever."""
    return _both(
        *(_source(index, payload=None, mass_kg=None, entered_kg=None) for index in (1, 2))
    )(scene)


HELD = (3.2, 2.9, 3.5, 4.1, 5.6, 5.0)

CLOSED: tuple[tuple[Gate, str, Callable[[Scene], Scene]], ...] = (
    (Gate.CHANGE, "J2", _gain("J2", value=32.96 * 1.36)),
    (Gate.CHANGE, "J2", _gain("J2", value=32.96 * 0.64)),
    (Gate.CHANGE, "J4", lambda scene: _bounded(scene, J4=2.3)),
    (Gate.NAMEPLATE, "J5", _nameplate("J5", 10.5)),
    (Gate.SIGN, "J4", _gain("J4", value=9.21)),
    (Gate.SIGN, "J1", _nameplate("J1", -32.96)),
    (Gate.UNCERTAINTY, "J6", _gain("J6", std=0.031 * 6.79)),
    (Gate.NOT_IDENTIFIED, "J6", _gain("J6", std=0.0)),
    (Gate.NOT_FINITE, "J6", _gain("J6", std=-0.1)),
    (Gate.NOT_FINITE, "J3", _gain("J3", value=math.nan)),
    (Gate.NOT_FINITE, "J3", _gain("J3", value=math.inf)),
    (Gate.NOT_FINITE, "J3", _gain("J3", value=0.0)),
    (Gate.NOT_FINITE, "J3", _gain("J3", std=math.nan)),
    (Gate.NOT_FINITE, "J3", _gain("J3", nameplate=math.nan)),
    (
        Gate.NOT_FINITE,
        "calibration",
        _calibration(holdout_error_percent=RelativeError((1.0,), math.nan)),
    ),
    (
        Gate.NOT_FINITE,
        "calibration",
        _calibration(relative_error_percent=RelativeError((math.nan,), 3.0)),
    ),
    (
        Gate.NOT_FINITE,
        "calibration",
        _calibration(relative_error_percent=RelativeError((*HELD[:5], -1.0), 3.0)),
    ),
    (Gate.NOT_FINITE, "calibration", _calibration(holdout_error_percent=RelativeError(HELD, -3.0))),
    (Gate.NAMEPLATE, "J5", _gain("J5", nameplate=17.0)),
    (Gate.UNIT, "J5", _unit("J5", "mNm/A")),
    (Gate.CELL, "calibration", _calibration(cell="other")),
    (Gate.CONFIGURATION, "calibration", _calibration(recording_configuration_sha256="e" * 64)),
    (
        Gate.CONFIGURATION,
        "calibration",
        _calibration(configuration_sha256="e" * 64, recording_configuration_sha256=None),
    ),
    (
        Gate.ERROR,
        "calibration",
        _calibration(
            holdout_error_percent=RelativeError((26.0,) * 6, 26.0),
            nameplate_holdout_error_percent=RelativeError((30.0,) * 6, 30.0),
        ),
    ),
    (
        Gate.ERROR,
        "calibration",
        _both(_only(0, 1), _calibration(relative_error_percent=RelativeError((26.0,) * 6, 26.0))),
    ),
    (
        Gate.ERROR,
        "J6",
        _calibration(
            holdout_error_percent=RelativeError((*HELD[:5], 51.0), 3.3),
            nameplate_holdout_error_percent=RelativeError((*HELD[:5], 60.0), 4.3),
        ),
    ),
    (
        Gate.ERROR,
        "J6",
        _both(
            _only(0, 1), _calibration(relative_error_percent=RelativeError((*HELD[:5], 51.0), 3.3))
        ),
    ),
    (Gate.ERROR, "calibration", _calibration(holdout_error_percent=RelativeError(HELD[:5], 3.3))),
    (Gate.ERROR, "calibration", _calibration(holdout_error_percent=RelativeError((), 3.3))),
    (Gate.ERROR, "calibration", _calibration(relative_error_percent=RelativeError((), 3.3))),
    (
        Gate.HOLDOUT,
        "calibration",
        _calibration(nameplate_holdout_error_percent=RelativeError(HELD, 3.25)),
    ),
    (
        Gate.HOLDOUT,
        "J4",
        _calibration(
            nameplate_holdout_error_percent=RelativeError((*HELD[:3], 4.1 / 1.021, *HELD[4:]), 4.3)
        ),
    ),
    (
        Gate.HOLDOUT,
        "J4",
        _calibration(
            nameplate_holdout_error_percent=RelativeError((*HELD[:3], math.nan, *HELD[4:]), 4.3)
        ),
    ),
    (
        Gate.HOLDOUT,
        "J6",
        _calibration(nameplate_holdout_error_percent=RelativeError(HELD[:5], 4.3)),
    ),
    (Gate.HOLDOUT, "calibration", _both(_wanted, _only(0, 1))),
    (Gate.HOLDOUT, "calibration", _calibration(nameplate_holdout_error_percent=None)),
    (Gate.HOLDOUT, "calibration", _calibration(holdout_error_percent=None)),
    (
        Gate.HOLDOUT,
        "calibration",
        lambda scene: _calibration(sources=scene.calibration.sources[:2])(scene),
    ),
    (Gate.DESCRIPTION, "J2", _diagnosed(diagnosis_named("zero-off", "J2"))),
    # Corrects that of J3
    (Gate.DESCRIPTION, "J2", _corrected("zero-offset", diagnosis_named("zero-off", "J2"))),
    (Gate.DESCRIPTION, "J2", _by_encoders(applied=False)),
    (Gate.DESCRIPTION, "calibration", _unexplained(1.001e-4)),
    (Gate.DESCRIPTION, "calibration", _unexplained(1e-3, noise=None)),
    (Gate.DESCRIPTION, "J2", _late_encoder),
    (Gate.DESCRIPTION, "calibration", _diagnosed(diagnosis_named("gravity-tilted"))),
    (Gate.DESCRIPTION, "J2", _diagnosed(diagnosis_named("correction-unclear", "J2"))),
    (Gate.DESCRIPTION, "calibration", _diagnosed(diagnosis_named("gravity-turned"))),
    (Gate.DESCRIPTION, "J3", _diagnosed(diagnosis_named("position-late", "J3"))),
    (Gate.DESCRIPTION, "J3", _diagnosed(diagnosis_named("position-reversed", "J3"))),
    (
        Gate.HOLDOUT_STILL,
        "J2",
        _calibration(holdout_error_percent=RelativeError((3.2, math.nan, 3.5, 4.1, 5.6, 5.0), 3.3)),
    ),
    (Gate.EFFECT, "effect load-friction on J3", _effect),
    (Gate.SOURCES, "calibration", _calibration(sources=())),
    (Gate.SOURCES, "log loaded", _source(1, sha256="")),
    (Gate.SOURCES, "log run.mcap.part", _source(0, name="run.mcap.part")),
    (Gate.SOURCES, "log held-out", _source(2, recording=None)),
    (Gate.SOURCES, "log loaded", _source(1, serials=())),
    (Gate.SOURCES, "log loaded", _source(1, serials=tuple(range(1001, 1006)))),
    (Gate.SOURCES, "log loaded", _source(1, saturated_percent=())),
    (Gate.SOURCES, "log loaded", _source(1, saturated_percent=(0.0,) * 7)),
    (Gate.SOURCES, "log loaded", _source(1, missing=())),
    (Gate.SOURCES, "log loaded", _source(1, saturated_percent=(0.0, 0.0, -0.1, 0.0, 0.0, 0.0))),
    (Gate.SOURCES, "log loaded", _source(1, saturated_percent=(0.0, 0.0, math.nan, 0.0, 0.0, 0.0))),
    (Gate.SOURCES, "log held-out", _source(2, sha256="b" * 64)),
    (Gate.SOURCES, "log loaded", _source(1, sha256="a" * 64)),
    (
        Gate.SOURCES,
        "log other",
        _both(_doubled, _source(3, name="other", sha256="e" * 64, role="train")),
    ),
    (Gate.SOURCES, "calibration", _both(_bare, _only(0, 1))),
    (Gate.SOURCES, "calibration", _only(1)),
    (Gate.SOURCES, "calibration", _only(2)),
    (Gate.PARTIAL, "log loaded", _source(1, partial=True)),
    (Gate.PARTIAL, "log loaded", _source(1, partial=True, missing=(0, 3, 0, 0, 0, 0))),
    (Gate.LOSSY, "log loaded", _source(1, lost_cycles=1)),
    (Gate.LOSSY, "log held-out", _source(2, missing=(0, 3, 0, 0, 0, 0))),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=(NOW - 30.1 * DAY).timestamp())),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=(NOW + 1.1 * DAY).timestamp())),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=None)),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=1e300)),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=-1e13)),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=math.inf)),
    (Gate.STALE, "log unloaded", _source(0, recorded_s=math.nan)),
    (Gate.SERIAL, "axis J4", _another_serial_now),
    (Gate.SERIAL, "log loaded, axis J4", _source(1, serials=(1001, 1002, 1003, None, 1005, 1006))),
    (
        Gate.SERIAL,
        "axis J4",
        _both(NO_SERIALS, _source(1, serials=(1001, 1002, 1003, 9, 1005, 1006))),
    ),
    (
        Gate.SATURATED,
        "log loaded, axis J3",
        _source(1, saturated_percent=(0.0, 0.0, 2.1, 0.0, 0.0, 0.0)),
    ),
    (Gate.MASS, "log loaded, payload disc", _source(1, entered_kg=None)),
    (Gate.MASS, "log loaded, payload disc", _source(1, entered_kg=4.596)),
    (Gate.MASS, "log loaded, payload disc", _source(1, mass_kg=None)),
    (Gate.MASS, "payload disc", _scene(entered_kg={"disc": 4.58})),
    (Gate.MASS, "log unloaded", _source(0, mass_kg=4.59)),
    (Gate.MASS, "log held-out", _source(2, payload=None)),
    (Gate.MASS, "payload disc", _payload(mass_kg=4.60)),
    (Gate.MASS, "payload disc", _payload(name="other disc")),
    (Gate.BASE, "demo.yaml", _edited),
    (Gate.BASE, "demo.yaml", _edited_before_the_dry_run),
    (Gate.SIGNATURE, "calibration.yaml", _scene(signed=())),
    (Gate.SIGNATURE, "calibration.yaml", _scene(signed=("Ada",))),
    (Gate.SIGNATURE, "calibration.yaml", _scene(appliers=("Ada", "bob"))),
    (Gate.SIGNATURE, "calibration.yaml", _scene(signed=("Ada",), appliers=("ADA ", "root"))),
    (Gate.SIGNATURE, "calibration.yaml", _scene(signed=("Ada",), appliers=("\uff21da", "root"))),
    (Gate.SIGNATURE, "calibration.yaml", _scene(signed=("Bob",), appliers=("Ada", " bob"))),
    (Gate.SIGNATURE, "operator", _scene(appliers=("Ad\u0430", "root"))),
    (Gate.SIGNATURE, "operator", _scene(appliers=("Ada\u200b", "root"))),
    (Gate.SIGNATURE, "operator", _scene(appliers=("Ada\x1b[2K", "root"))),
    (Gate.SIGNATURE, "operator", _scene(appliers=("", "root"))),
    (Gate.SIGNATURE, "operator", _scene(appliers=("Carl", "root"))),
    (Gate.SIGNATURE, "calibration", _scene(file=None)),
    (Gate.SIGNATURE, "calibration.yaml.Bob.minisig", _forged),
)


def test_a_refusal_names_a_wrong_description_that_the_calibration_corrects(scene: Scene) -> None:
    off = diagnosis_named("zero-off", "J3")
    wrong = _both(_corrected("zero-offset", off), _calibration(cell="another"))(scene).propose()
    assert not any(refusal.gate is Gate.DESCRIPTION for refusal in wrong.refusals)
    assert (
        f"hint: the fit of this calibration found {off.found}; {off.remedy}"
    ) in wrong.error.__notes__
    plain = _calibration(cell="another")(scene).propose()
    assert not getattr(plain.error, "__notes__", [])


def test_a_calibration_that_is_fine_goes_through(scene: Scene) -> None:
    proposal = scene.propose()
    assert proposal.refusals == ()
    assert apply(proposal, NOW) is not None


@pytest.mark.parametrize(("gate", "subject", "broken"), CLOSED)
def test_each_gate_closes_alone(
    scene: Scene, tmp_path: Path, gate: Gate, subject: str, broken: Callable[[Scene], Scene]
) -> None:
    scene = broken(scene)
    before = scene.controller.read_bytes()
    proposal = scene.propose()
    gates = {refusal.gate for refusal in proposal.refusals}
    assert gates == {gate}
    assert all(subject in refusal.subject for refusal in proposal.refusals)
    audit = tmp_path / "audit.jsonl"
    with pytest.raises(CalibrationRefused) as caught:
        apply(proposal, NOW, audit=audit, who="Ada")
    assert exit_code(type(caught.value)) == 3
    for refusal in proposal.refusals:
        assert refusal.found in str(caught.value)
        assert refusal.remedy
    assert scene.controller.read_bytes() == before
    assert not list(tmp_path.glob("*.bak"))
    (entry,) = read(audit)
    expected = (AuditAction.REFUSED, "Ada", str(scene.controller))
    assert (entry.action, entry.who, entry.subject) == expected
    reported = entry.details["refusals"]
    assert isinstance(reported, list)
    assert [one["gate"] for one in reported] == [gate.value] * len(proposal.refusals)


def test_every_gate_has_such_a_test() -> None:
    gates = {gate for gate, _, _ in CLOSED}
    assert gates == set(Gate)


def test_the_table_lists_every_gate_once_with_its_description() -> None:
    assert sorted(row.gate.name for row in GATES) == sorted(gate.name for gate in Gate)
    assert all(row.text and row.remedy for row in GATES)


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
            _scene(entered_kg={"disc": 4.585}),
        ),
        _both(NO_SERIALS, _logs(serials=(None,) * 6)),
        _wanted,
        lambda scene: _bounded(scene, J4=2.32, J1=0.95),
        _calibration(configuration_sha256="e" * 64),
        _calibration(recording_configuration_sha256=None),
        _scene(appliers=("root",)),
        _scene(appliers=("Root", "root")),
        _scene(appliers=()),
        _scene(policy=ApplyPolicy(), signed=(), file=None, appliers=("Carl", "root")),
        _payload(mass_kg=4.594),
        _scene(policy=ApplyPolicy(), signed=(), file=None),
        _scene(policy=ApplyPolicy(max_age_days=None), now=NOW + 3000 * DAY),
        _both(_logs(recorded_s=None), _scene(policy=ApplyPolicy(max_age_days=None))),
    ],
)
def test_just_inside_its_bound_a_gate_is_open(scene: Scene, kept: Callable[[Scene], Scene]) -> None:
    assert kept(scene).propose().refusals == ()


@pytest.mark.parametrize("effects", [True, False])
def test_a_number_just_beyond_its_bound_is_not_written_as_the_bound(
    scene: Scene, effects: bool
) -> None:
    """And a large σ is looked for in what the model lacks first, where that was not done."""
    bound = scene.policy.max_std_percent
    absolute_gain = abs(scene.calibration.gains[0].value)
    std = 1.0001e-2 * bound * absolute_gain
    doubtful = _gain("J1", std=std)(scene)
    if not effects:
        doubtful = _calibration(effects=())(doubtful)
    (refusal,) = doubtful.propose().refusals
    assert refusal.gate is Gate.UNCERTAINTY
    assert float(refusal.found.removeprefix("σ ").removesuffix(" %")) > bound
    assert ("`drivegain residual`" in refusal.remedy) is not effects


def test_a_reviewed_change_of_a_changed_file_may_go_on(scene: Scene) -> None:
    scene = _edited(scene)
    (refusal,) = scene.propose().refusals
    digest = sha256(scene.controller.read_bytes())
    # In full: this dry run, with a gate closed, ends without the line that a write would need.
    assert (refusal.gate, refusal.remedy.endswith(f"--base {digest}")) == (Gate.BASE, True)
    base = sha256(scene.controller.read_bytes())
    changed_scene = replace(scene, base=base)
    assert changed_scene.propose().refusals == ()


def test_the_policy_moves_the_bounds(scene: Scene) -> None:
    tight = ApplyPolicy(
        max_change_percent=5.0,
        max_nameplate_percent=15.0,
        max_std_percent=0.3,
        max_saturated_percent=1.0,
        max_age_days=0.01,
    )
    refusals = replace(scene, policy=tight).propose().refusals
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


def test_an_age_below_a_day_is_reported_in_hours(scene: Scene) -> None:
    """2025-01-02 02:00 is an hour and four minutes ago."""
    max_age_days = 1 / 24
    policy = ApplyPolicy(max_age_days=max_age_days)
    hour = replace(scene, policy=policy)
    refusals = hour.propose().refusals
    reported = {(one.found, one.expected) for one in refusals}
    assert reported == {("recorded 1.1 hours ago", "recorded within the last 1 hours")}
    recorded_s = (NOW - 30.1 * DAY).timestamp()
    days = _source(0, recorded_s=recorded_s)(replace(scene, policy=ApplyPolicy()))
    assert [(one.found, one.expected) for one in days.propose().refusals] == [
        ("recorded 30.1 days ago", "recorded within the last 30 days")
    ]


@pytest.mark.parametrize("days", [3, 730])
def test_a_log_of_a_wrong_later_date_is_refused_with_the_way_out(scene: Scene, days: int) -> None:
    recorded_s = (NOW + days * DAY).timestamp()
    future = _source(0, recorded_s=recorded_s)(replace(scene, policy=ApplyPolicy()))
    (refusal,) = future.propose().refusals
    assert refusal.gate is Gate.STALE
    assert refusal.found.endswith("from now")
    assert "it keeps that date: record again and fit" in refusal.remedy


def test_a_mass_corrected_since_the_fit_is_seen_through_configuration_changed(scene: Scene) -> None:
    cell = _payload(mass_kg=5.0)(scene).cell
    request = Request(
        scene.calibration, NOW, policy=ApplyPolicy(), accepts_changed_configuration=True
    )
    target = FileTarget.of(cell, scene.controller)
    proposal = propose(target, request)
    expected = {(Gate.MASS, "fitted with 4.59 kg")}
    assert {(one.gate, one.found) for one in proposal.refusals} == expected


def test_two_names_of_one_signer_are_one_person(scene: Scene, tmp_path: Path) -> None:
    again = generate(tmp_path, "ADA")[1].line
    signers = {**scene.policy.signers, "ADA": again}
    two = replace(scene.policy, signatures=2, signers=signers)
    twice = replace(scene, policy=two, signed=("Ada", "ADA"), appliers=("root",))
    refusals = twice.propose().refusals
    gates = [one.gate for one in refusals]
    assert gates == [Gate.SIGNATURE]


def test_a_signer_s_key_that_is_none_is_refused_with_file_line_and_key(
    tmp_path: Path, scene: Scene
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
    key = scene.policy.signers["Ada"]
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


def test_two_signatures_of_others_are_two(scene: Scene) -> None:
    policy = replace(scene.policy, signatures=2)
    two = replace(scene, policy=policy)
    refusals = replace(two, signed=("Ada", "Bob")).propose().refusals
    gates = [refusal.gate for refusal in refusals]
    assert gates == [Gate.SIGNATURE]
    assert replace(two, signed=("Ada", "Bob"), appliers=("the job",)).propose().refusals == ()


def test_all_failed_checks_are_reported_at_once(scene: Scene) -> None:
    policy = ApplyPolicy(max_change_percent=5.0)
    other = replace(scene, policy=policy)
    error = _calibration(cell="other")(other).propose().error
    expected = [True] * 5 + [False]
    assert [
        axis in str(error) for axis in ("cell 'other'", "J3:", "J4:", "J5:", "J6:", "J1:")
    ] == expected


def test_a_zero_in_the_file_has_no_sign_to_keep(scene: Scene) -> None:
    changed_text = scene.controller.read_text().replace("7.68", "0.0")
    scene.controller.write_text(changed_text)
    base = sha256(scene.controller.read_bytes())
    reviewed = replace(scene, base=base)
    (refusal,) = reviewed.propose().refusals
    assert (refusal.gate, refusal.subject) == (Gate.SIGN, "J6")
    assert refusal.found == "gain 6.79, current gain 0, nameplate 7.68"


def test_an_effect_on_all_axes_is_called_so(scene: Scene) -> None:
    first_effect = scene.calibration.effects[0]
    skew = replace(first_effect, name="time-skew", axis="all axes", error_after_percent=9.0)
    (refusal,) = _calibration(effects=(skew,))(scene).propose().refusals
    assert refusal.subject == "effect time-skew on all axes"


def test_a_library_that_reports_no_gate_context_is_not_asked_for_them(scene: Scene) -> None:
    source = Source("old", "a" * 64, "fit")
    sources = (source,)
    old = replace(scene.calibration, sources=sources)
    target = FileTarget(scene.controller, KEYS)
    request = Request(old, NOW)
    assert propose(target, request).refusals == ()
    refusals = replace(scene, calibration=old).propose().refusals
    expected = {Gate.SOURCES, Gate.HOLDOUT}
    assert {one.gate for one in refusals} == expected


def test_the_demo_calibration_is_of_the_day_it_says() -> None:
    sources = recorded(demo_calibration(), RECORDED + DAY).sources
    assert all(
        source.recording is not None and source.recording.recorded_s == (RECORDED + DAY).timestamp()
        for source in sources
    )
