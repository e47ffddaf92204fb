"""Evidence of how a log was recorded: written at the recording, carried by the calibration,
there for the gates.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import as_document, decode_calibration, encode_calibration
from daq.environment import shipped_configurations
from daq.errors import ExitCode, UsageError
from daq.log.conversion import load_run
from daq.log.metadata import run_from_record, run_record
from daq.log.reader import LossyLogs, read_log
from daq.workflow import fit as fit_module
from daq.workflow.fit import Fit, LogLoader, calibration_of, close_loop, fit
from daq.workflow.plan import load_plan
from daq.workflow.record import Clocks, RecordingRequest, record
from daq.workflow.safeguards import check_entered_mass
from daq.writeback.gates.gate import Gate, GateContext
from daq.writeback.gates.table import check_gates
from daq.writeback.request import Edit, Request
from ident.calibration import Calibration
from ident.data.run import Recording, Run
from ident.discovery.evidence import with_effects
from ident.discovery.loop import find_effects
from ident.effects.effect import ALL_AXES, PlacedEffect
from ident.effects.electrical import Lag, TimeSkew
from ident.effects.friction import Stribeck
from ident.equations.rows import decimate_rows
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.prediction import predict_torque
from tests.daq.logs import DISC, START_NS, content, demo_content, samples, write
from tests.daq.workflow.test_record import WALL_NS, Rig
from tests.ident.recordings import GAINS, MOUNTED, tx40_truth
from tests.ident.recordings import record as invented

NOW = datetime(2025, 1, 2, tzinfo=UTC)
LIMIT = 0x1237 | 0x0800
"""Statusword with bit 11, internal limit active (CiA 402)."""


@given(
    entered=st.none() | st.floats(1e-6, 1e6),
    digest=st.none() | st.text("0123456789abcdef", min_size=64, max_size=64),
)
def test_metadata_carries_second_weighing_and_controller(
    entered: float | None, digest: str | None
) -> None:
    run = replace(content(6, DISC).run, entered_kg=entered, controller_sha256=digest)
    assert run_from_record(run_record(run)) == run


def test_logs_of_earlier_versions_report_neither() -> None:
    info = content(6, DISC).run
    record_of = run_record(info)
    del record_of["payload_entered_kg"], record_of["controller_sha256"]
    run = run_from_record(record_of)
    assert (run.entered_kg, run.controller_sha256) == (None, None)


@pytest.mark.parametrize("entered", ["0", "-1", "nan", "inf", "heavy"])
def test_a_mass_that_is_none_is_no_metadata(entered: str) -> None:
    info = content(6, DISC).run
    with pytest.raises(ValueError):
        run_from_record({**run_record(info), "payload_entered_kg": entered})


def test_a_run_knows_how_its_log_came_to_be(tmp_path: Path, checkout: Path) -> None:
    start = demo_content(checkout, DISC)
    controller_sha256 = "c" * 64
    changed_run = replace(start.run, entered_kg=4.592, controller_sha256=controller_sha256)
    start = replace(start, run=changed_run)
    rows = samples([[0] * 6] * 100)
    statusword = (0x1237, LIMIT, 0x1237, 0x1237, 0x1237, 0x1237)
    rows[7] = replace(rows[7], statusword=statusword)
    a_path = tmp_path / "a.mcap"
    path = write(a_path, start, rows)
    run, _ = load_run(path)
    saturated_percent = (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    serials = (7,) * 6
    missing = (0,) * 6
    recorded_s = START_NS * 1e-9
    expected = Recording(
        recorded_s=recorded_s,
        entered_kg=4.592,
        serials=serials,
        saturated_percent=saturated_percent,
        lost_cycles=0,
        missing=missing,
        controller_sha256="c" * 64,
        operator="Ada",
    )
    assert run.recording == expected
    undated = replace(start, run=replace(start.run, started_wall_ns=0))
    imported_path = tmp_path / "imported.mcap"
    run, _ = load_run(write(imported_path, undated, rows))
    assert run.recording is not None
    assert run.recording.recorded_s is None


def test_a_source_carries_payload_and_recording(tmp_path: Path, checkout: Path) -> None:
    turning = []
    for k in range(50):
        turning.append([100 * k + axis for axis in range(6)])
    path = tmp_path / "bare.mcap"
    bare = write(path, demo_content(checkout), samples(turning))
    loaded_path = tmp_path / "loaded.mcap"
    loaded = write(loaded_path, demo_content(checkout, DISC), samples(turning[::-1]))
    reading = LogLoader.of([bare, loaded], None)
    runs = list(reading.runs([bare, loaded], "fit"))
    first, second = reading.sources
    expected = (None, None, runs[0].recording)
    assert (first.payload, first.mass_kg, first.recording) == expected
    assert (second.payload, second.mass_kg, second.recording) == ("disc", 4.59, runs[1].recording)
    assert second.recording is not None


@pytest.fixture(scope="module")
def truth_runs() -> dict[str, Run]:
    """Two runs without load, two with, one of them to be held out."""
    truth = tx40_truth()
    rng = np.random.default_rng(3)
    names = ("bare-1", "loaded-1", "bare-2", "loaded-2", "held-out")
    made = [
        invented(
            truth,
            name,
            rng,
            MOUNTED if name.startswith(("loaded", "held-out")) else None,
            noise_a=0.3,
            seconds=22.0,
        )
        for name in names
    ]
    return {run.name: replace(run, digest=f"{index:064x}") for index, run in enumerate(made)}


@pytest.mark.slow
@pytest.mark.parametrize("nameplate_is_true", [False, True])
def test_a_hold_out_is_distinguished_better_than_by_a_wrong_nameplate_and_no_worse_than_by_a_true_one(  # noqa: E501
    truth_runs: dict[str, Run], monkeypatch: pytest.MonkeyPatch, nameplate_is_true: bool
) -> None:
    demo_path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(demo_path)
    if nameplate_is_true:
        axes = (
            replace(axis, nameplate_gain=float(g)) for axis, g in zip(cell.axes, GAINS, strict=True)
        )
        cell = replace(cell, axes=tuple(axes))

    def load(
        path: Path, _cell: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return truth_runs[path.name], cell

    monkeypatch.setattr(fit_module, "load_run", load)
    logs = [Path(name) for name in ("bare-1", "loaded-1", "bare-2", "loaded-2")]
    holdout = [Path("held-out")]
    fitted = fit(logs, holdout=holdout)
    created = datetime(2025, 1, 2, tzinfo=UTC)
    found = calibration_of(fitted, created)
    held = found.holdout_error_percent
    nameplate = found.nameplate_holdout_error_percent
    assert held is not None
    assert nameplate is not None
    ratio = held.total / nameplate.total
    assert (0.99 < ratio < 1.005) if nameplate_is_true else (ratio < 0.97)
    assert all(math.isfinite(axis) for axis in nameplate.axes)
    assert decode_calibration(encode_calibration(found), "c.yaml") == found
    assert as_document(found)["nameplate_holdout_error_percent"] is not None
    assert found.recording_configuration_sha256 == cell.recording_digest
    assert _refused(found) == []


def _sticking(run: Run) -> Run:
    """With low-speed friction in axis 2 that the declared model lacks."""
    position_rad_gradient = np.gradient(run.position_rad[:, 1])
    speed = position_rad_gradient * run.rate_hz
    added = np.zeros_like(run.current_a)
    added[:, 1] = 5.0 * np.sign(speed) * np.exp(-((speed / 0.35) ** 2)) / GAINS[1]
    current_a = run.current_a + added
    return replace(run, current_a=current_a)


@pytest.fixture(scope="module")
def with_effect(truth_runs: dict[str, Run]) -> Fit:
    """A loop that has found that friction, on a cell whose nameplate is some per cent off."""
    runs = {name: _sticking(run) for name, run in truth_runs.items()}
    demo_path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(demo_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], cell))
        families = ((Stribeck(0.3),),)
        patch.setattr(fit_module, "find_effects", partial(find_effects, families=families))
        logs = [Path(name) for name in tuple(runs)[:4]]
        holdout = [Path("held-out")]
        start = fit(logs, holdout=holdout)
        found = close_loop(start, 0)
    assert [(placed.effect.name, placed.axis) for placed in _effects(found)] == [("stribeck", 1)]
    return found


def _effects(fitted: Fit) -> tuple[PlacedEffect, ...]:
    return fitted.steps[-1].after.effects


def _with_gains(fitted: Fit, factors: tuple[float, ...]) -> Calibration:
    """Return the calibration of other gains, all the rest refitted to them,
    as if they had been identified.
    """
    after = fitted.steps[-1].after
    system = after.training.system()
    fixed_gains = after.estimate.gains * np.array(factors)
    other = estimate_with(Method.ML, system, fixed_gains)
    other = replace(other, gains_fixed=False, covariance=after.estimate.covariance)
    last_step = fitted.steps[-1]
    changed_after = replace(after, estimate=other)
    step = replace(last_step, after=changed_after)
    steps = (*fitted.steps[:-1], step)
    changed_fitted = replace(fitted, steps=steps)
    return calibration_of(changed_fitted, NOW)


def _refused(calibration: Calibration) -> list[tuple[Gate, str]]:
    edit = Edit(subject="", before=b"", after=b"")
    request = Request(calibration, NOW)
    context = GateContext(request, edit)
    # The runs were generated and not recorded: they have no digests.
    return [(one.gate, one.subject) for one in check_gates(context) if one.gate is not Gate.SOURCES]


@pytest.mark.slow
def test_what_an_effect_reports_is_not_credited_to_the_gains(with_effect: Fit) -> None:
    """The nameplate is compared in the same model:
    with its own gains a calibration is no better than it is.
    """
    nameplate_gains = [axis.nameplate_gain for axis in with_effect.cell.axes]
    nameplate = np.array(nameplate_gains)
    gains = with_effect.estimate.gains
    factors = tuple(nameplate / gains)
    same = _with_gains(with_effect, factors)
    held = same.holdout_error_percent
    compared = same.nameplate_holdout_error_percent
    assert held is not None
    assert compared is not None
    assert held.axes == pytest.approx(compared.axes, rel=1e-6)
    assert held.total == pytest.approx(compared.total, rel=1e-6)
    bare = with_effect.identification.holdout_error
    assert bare is not None
    assert held.axes[1] < 0.97 * bare.axes[1]


@pytest.mark.slow
def test_one_wrong_gain_among_good_ones_is_refused_in_spite_of_an_effect(with_effect: Fit) -> None:
    calibration = calibration_of(with_effect, NOW)
    assert _refused(calibration) == []
    factors = (1.0,) * 6
    assert _refused(_with_gains(with_effect, factors)) == []
    found = _refused(_with_gains(with_effect, (1.0, 1.0, 1.0, 0.7, 1.0, 1.0)))
    assert (Gate.HOLDOUT, "J4") in found
    gates = {gate for gate, _ in found}
    assert gates == {Gate.HOLDOUT}


@pytest.mark.slow
def test_without_a_hold_out_or_with_fixed_gains_there_is_nothing_to_compare(
    truth_runs: dict[str, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    demo_path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(demo_path)
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (truth_runs[path.name], cell))
    logs = [Path("bare-1"), Path("loaded-1")]
    now = datetime(2025, 1, 2, tzinfo=UTC)
    calibration = calibration_of(fit(logs), now)
    assert calibration.nameplate_holdout_error_percent is None
    holdout = [Path("held-out")]
    fixed = fit(logs, holdout=holdout, gains_fixed=True)
    assert calibration_of(fixed, now).nameplate_holdout_error_percent is None


def test_an_effect_on_all_motors_is_not_called_the_first_axis_s(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    assert ALL_AXES not in cell.axis_names
    placed_effect = PlacedEffect(TimeSkew(), 0)
    assert placed_effect.axis_name(cell.axis_names) == ALL_AXES
    assert PlacedEffect(Lag(), 0).axis_name(cell.axis_names) == "J1"


@pytest.mark.slow
def test_a_delay_of_all_axes_is_predicted_from_the_file(with_effect: Fit) -> None:
    first = with_effect.steps[0]
    assert first.accepted is not None
    effects = (PlacedEffect(TimeSkew(), 0),)
    delayed = with_effects(first.after, effects)
    accepted = replace(first.accepted, effect=TimeSkew(), axis=0)
    step = replace(first, accepted=accepted, after=delayed)
    changed_with_effect = replace(with_effect, steps=(step,))
    made = calibration_of(changed_with_effect, NOW)
    assert [effect.axis for effect in made.effects] == [ALL_AXES]
    read = decode_calibration(encode_calibration(made), "c.yaml")
    data = delayed.datasets[0]
    torque = decimate_rows(data, delayed.conditioning, predict_torque(read, delayed.model, data).T)
    fitted = delayed.estimate.predicted_torque(delayed.training)[:, : torque.shape[1]]
    torque_difference = np.abs(torque - fitted)
    largest_torque_difference = np.max(torque_difference)
    largest_absolute_fitted = np.max(np.abs(fitted))
    assert largest_torque_difference < 1e-3 * largest_absolute_fitted


@pytest.mark.parametrize("entered", [4.584, 4.596, 9.0, 0.1])
def test_a_mass_off_the_cell_s_is_refused_before_anything_is_asked_of_the_bus(
    entered: float, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(checkout, tmp_path, monkeypatch, "lockstep")
    declared = load_cell(rig.cell_file)
    plan = load_plan(rig.plan, declared)
    request = RecordingRequest(
        rig.cell_file,
        declared,
        plan,
        rig.out,
        payload=DISC,
        operator="Ada",
        granted_by="the test",
        run_id="1",
        entered_kg=entered,
    )
    with pytest.raises(UsageError, match=r"4\.59 kg within 0\.005 kg"):
        record(request)
    assert not rig.bus.sent
    command = [
        "record",
        str(rig.cell_file),
        str(rig.plan),
        "--out",
        str(rig.out),
        "--enable-motion",
    ]
    assert main([*command, "--payload", "disc", "--mass", str(entered)]) == ExitCode.USAGE
    assert not rig.bus.sent
    assert not rig.out.exists()


def test_the_log_has_the_second_weighing_and_the_controller_s_digest(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(checkout, tmp_path, monkeypatch, "lockstep")
    changed_text = rig.cell_file.read_text().replace("../controllers/demo.yaml", "controller.yaml")
    rig.cell_file.write_text(changed_text)
    (tmp_path / "controller.yaml").write_bytes(b"drives: {}\n")
    declared = load_cell(rig.cell_file)
    plan = load_plan(rig.plan, declared)
    request = RecordingRequest(
        rig.cell_file,
        declared,
        plan,
        rig.out,
        payload=DISC,
        operator="Ada",
        granted_by="the test",
        run_id="1",
        entered_kg=4.595,
        unguarded=True,  # the scripted drives have no 1016h
    )
    clocks = Clocks(lambda: WALL_NS, rig.bus.clock)
    record(request, clocks=clocks)
    run = read_log(rig.out).head.run
    assert run.entered_kg == 4.595
    expected = hashlib.sha256(b"drives: {}\n").hexdigest()
    assert run.controller_sha256 == expected


def test_a_mass_needs_a_payload(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    check_entered_mass(cell, None, None)
    check_entered_mass(cell, DISC, None)
    check_entered_mass(cell, DISC, 4.59)
    with pytest.raises(UsageError, match="no payload"):
        check_entered_mass(cell, None, 4.59)
