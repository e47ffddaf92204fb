"""From logs to a fit: one log after the other, each once, of one cell,
and the one that contradicts is named.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import LogRepeated, LogsDiffer
from daq.log.reader import LossyLogs
from daq.report.document import json_tree
from daq.report.fit import fit_report, fit_view, sigma_notes
from daq.workflow import fit as fit_module
from daq.workflow.cases import CaseFit
from daq.workflow.fit import Fit, calibration_of, fit
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.data.torque_channel import TorqueChannel
from ident.errors import DataUnfit, PayloadUnseen
from ident.estimators.estimate import RelativeError
from ident.estimators.method import Method
from tests.ident.recordings import GAINS, MOUNTED, record, tx40_truth


@dataclass(frozen=True)
class Shelf:
    """Runs by the name of a log, in the place of files."""

    cell: Cell
    runs: dict[str, Run]

    def load(
        self, path: Path, cell: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return self.runs[path.name], cell or self.cell


@pytest.fixture(scope="module")
def shelf() -> Shelf:
    """Two runs without load, two with."""
    truth = tx40_truth()
    rng = np.random.default_rng(3)
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    runs = {}
    for index in range(4):
        payload = MOUNTED if index % 2 else None
        run = record(truth, f"run{index}", rng, payload, noise_a=0.3, seconds=22.0)
        digest = f"{index:064x}"
        runs[run.name] = replace(run, digest=digest)
    undeclared = record(truth, "undeclared", rng, MOUNTED, noise_a=0.3, seconds=22.0)
    runs["undeclared"] = replace(undeclared, payload=None, digest="f" * 64)
    return Shelf(cell, runs)


def _paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


@pytest.fixture(scope="module")
def pair(shelf: Shelf) -> Fit:
    """A fit of one run without load and one with it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", shelf.load)
        return fit(_paths("run0", "run1"))


@pytest.mark.slow
def test_logs_become_sources_with_their_roles(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("run0", "run1", "run2")
    found = fit(logs, holdout=_paths("run3"))
    expected = [("run0", "fit"), ("run1", "fit"), ("run2", "fit"), ("run3", "holdout")]
    assert [(source.name, source.role) for source in found.sources] == expected  # fmt: skip
    for source in found.sources:
        payload = shelf.runs[source.name].payload
        if payload is None:
            assert source.payload is None
            assert source.mounting is None
        else:
            assert source.payload == payload.name
            assert source.mounting == payload.mounting
    assert any(source.mounting for source in found.sources)
    assert found.identification.holdout_error is not None


@pytest.mark.slow
def test_the_log_that_contradicts_the_others_is_named(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("undeclared", "run1", "run2", "run3")
    with pytest.raises(PayloadUnseen, match="without undeclared they do"):
        fit(logs)


def test_a_recording_counts_once(shelf: Shelf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("run0", "run1")
    with pytest.raises(LogRepeated):
        fit(logs, holdout=_paths("run1"))


def test_logs_of_two_configurations_are_refused(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(
        path: Path, cell: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        run, described = shelf.load(path, cell)
        return run, replace(described, digest="0" * 64) if path.name == "run1" else described

    monkeypatch.setattr(fit_module, "load_run", load)
    with pytest.raises(LogsDiffer, match="as in the first log"):
        fit(_paths("run0", "run1"))


@pytest.mark.parametrize(
    ("key", "conditioning"),
    [
        ("position_cutoff_hz", Conditioning(position_cutoff_hz=900.0)),
        ("decimation_cutoff_hz", Conditioning(decimation_cutoff_hz=900.0)),
    ],
)
def test_a_cut_off_beyond_the_sampling_rate_is_named_by_its_key(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch, key: str, conditioning: Conditioning
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("run0", "run1")
    cell = replace(shelf.cell, conditioning=conditioning)
    with pytest.raises(DataUnfit, match=f"`conditioning.{key}` of 900 Hz needs more than 2250 Hz"):
        fit(logs, cell=cell)


@pytest.mark.slow
@pytest.mark.parametrize("method", [Method.LS, Method.WLS, Method.TLS])
def test_every_method_hears_of_a_payload_that_was_not_there(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch, method: Method
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("undeclared", "run1", "run2", "run3")
    with pytest.raises(PayloadUnseen):
        fit(logs, method=method)


def moves_in(found: Fit) -> int:
    """Moves whose scatter is σ."""
    return len(found.identification.system.clusters)


@pytest.mark.slow
def test_a_sigma_of_few_moves_is_said_to_be_rough(
    shelf: Shelf, pair: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    found = pair
    moves = moves_in(found)
    (note,) = sigma_notes(found)
    (percent,) = re.findall(r"known to (\d+) % only", note)
    assert f"σ rests on {moves} moves" in note
    # The scatter of a σ that is estimated from so many normal numbers.
    rng = np.random.default_rng(1)
    numbers = rng.standard_normal((20_000, moves))
    number_std = numbers.std(axis=1, ddof=1)
    number_std_std = np.std(number_std)
    assert float(percent) == pytest.approx(100.0 * number_std_std, abs=1.0)
    (ratio,) = re.findall(r"a factor of ([\d.]+)\.", note)
    assert float(ratio) > 1.0 + 0.04 * float(percent)
    fitted = fit(_paths("run0", "run1"), method=Method.TLS)
    assert [*sigma_notes(fitted)] == []  # by a formula
    logs = _paths("run0", "run1")
    assert [*sigma_notes(fit(logs, gains_fixed=True))] == []
    monkeypatch.setattr("daq.report.fit.ROUGH_SIGMA", 1.0 / np.sqrt(2.0 * (moves - 1)))
    assert [*sigma_notes(found)] == []


@pytest.mark.slow
def test_an_axis_that_did_not_move_has_a_dash_and_no_number(
    shelf: Shelf, pair: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    created = datetime(2025, 1, 2, tzinfo=UTC)
    calibration = calibration_of(pair, created)
    axes = (1.0, float("nan"), 3.0, 4.0, 5.0, 6.0)
    rested = RelativeError(axes, 7.0)
    out = io.StringIO()
    rested_on = replace(calibration, holdout_error_percent=rested)
    console = Console(file=out, width=100)
    case_fit = CaseFit(pair, (), None)
    console.print(*fit_view(case_fit, rested_on, None), sep="\n")
    lines = out.getvalue().splitlines()
    (held_out,) = (line.split() for line in lines if line.strip().startswith("held out"))
    expected = ["held", "out", "1.00", "-", "3.00", "4.00", "5.00", "6.00", "7.00"]
    assert held_out == expected


@pytest.mark.slow
def test_the_drives_own_torque_is_shown_beside_the_gains_and_changes_none(
    shelf: Shelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A torque constant entered 4 % too large, and an axis whose drive reports no torque."""
    rng = np.random.default_rng(1)

    def load(
        path: Path, cell: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        run, described = shelf.load(path, cell)
        channels = []
        for axis, gain in enumerate(GAINS):
            rows = slice(0, 0) if axis == 5 else slice(12, -12, 12)
            current = run.current_a[rows, axis]
            torque = 1.04 * gain * current + 0.5 * rng.standard_normal(len(current))
            torque_channel = TorqueChannel(run.time_s[rows], current, current, torque)
            channels.append(torque_channel)
        return replace(run, torque_channels=tuple(channels)), described

    monkeypatch.setattr(fit_module, "load_run", shelf.load)
    logs = _paths("run0", "run1")
    without = fit(logs, holdout=_paths("run2"))
    monkeypatch.setattr(fit_module, "load_run", load)
    found = fit(_paths("run0", "run1"), holdout=_paths("run2"))
    np.testing.assert_array_equal(found.estimate.gains, without.estimate.gains)
    assert without.torque_slopes == ()
    assert found.torque_slopes[5] is None
    created = datetime(2025, 1, 2, tzinfo=UTC)
    calibration = calibration_of(found, created)
    case = CaseFit(found, (), None)
    report = fit_report(case, calibration, None)
    rows = json_tree(report)["torque_channel"]
    expected = list(found.cell.axis_names)
    assert [row["axis"] for row in rows] == expected
    assert rows[5] == {"axis": "J6", "slope": None}
    for slope, row, gain in zip(found.torque_slopes[:5], rows, GAINS, strict=False):
        assert slope is not None
        absolute_slope = abs(slope.value - 1.04 * gain)
        assert absolute_slope < 4.0 * slope.std
        absolute_ratio = abs(row["ratio"] - 1.04)
        assert absolute_ratio < 4.0 * row["ratio_std"] < 0.1
        assert slope.readings == len(range(12, 5500 - 12, 12)) * 2
    case_fit = CaseFit(without, (), None)
    assert "torque_channel" not in json_tree(fit_report(case_fit, calibration, None))
    out = io.StringIO()
    console = Console(file=out, width=80)
    console.print(*fit_view(case, calibration, None), sep="\n")
    assert "own torque against the current, not used in the fit" in out.getvalue()
