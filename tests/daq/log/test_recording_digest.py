"""Which changes of a cell's files make another recording of it, and which do not."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from daq.config.cell_file import bundle, cell_from_bundle, load_cell

CONFIGS = Path(__file__).parents[3] / "configs"
DEMO = "cells/demo.yaml"


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(CONFIGS, tmp_path / "configs"))


def _said(configs: Path, text: str) -> None:
    file = configs / DEMO
    file.write_text(file.read_text() + text)


@pytest.mark.parametrize(
    "afterwards",
    [
        "policy: {motion: allowed}\n",
        "policy: {apply: {max_age_days: 7, by: job, max_change: {J4: 2.0}}}\n",
        "history: {store: elsewhere.sqlite}\n",
        "# K. has reviewed it.\n",
    ],
)
def test_what_becomes_of_a_calibration_and_comments_make_no_other_recording(
    configs: Path, afterwards: str
) -> None:
    before = load_cell(configs / DEMO)
    _said(configs, afterwards)
    after = load_cell(configs / DEMO)
    assert after.digest != before.digest
    assert after.recording_digest == before.recording_digest


def test_nor_does_a_rated_payload(configs: Path) -> None:
    file = configs / DEMO
    before = load_cell(file)
    changed_text = file.read_text().replace("robot:\n", "robot:\n  rated_payload_kg: 8\n")
    file.write_text(changed_text)
    assert load_cell(file).recording_digest == before.recording_digest


def test_neither_do_comments_and_line_breaks_of_a_drive_profile(configs: Path) -> None:
    before = load_cell(configs / DEMO)
    profile = configs / "drives" / "generic-cia402.yaml"
    profile.write_text("# Seen.\r\n\n" + profile.read_text())
    after = load_cell(configs / DEMO)
    assert after.digest != before.digest
    assert after.recording_digest == before.recording_digest


def test_nor_does_what_a_drive_profile_names_beside_the_samples(configs: Path) -> None:
    """A profile of an earlier version has neither torque nor temperature:
    its calibrations stay valid.
    """
    before = load_cell(configs / DEMO)
    profile = configs / "drives" / "generic-cia402.yaml"
    text = profile.read_text()
    lines = text.splitlines(keepends=True)
    entry = next(line for line in lines if line.startswith("torque:"))
    changed_text = text.replace(entry, "")
    earlier, found, _ = changed_text.partition("  torque:\n")
    assert found
    profile.write_text(earlier)
    after = load_cell(configs / DEMO)
    assert after.digest != before.digest
    assert after.recording_digest == before.recording_digest


@pytest.mark.parametrize(
    ("file", "was", "becomes"),
    [
        (DEMO, "mass_kg: 4.59", "mass_kg: 4.60"),
        (DEMO, "decimation_cutoff_hz: 20.0", "decimation_cutoff_hz: 21.0"),
        (DEMO, "nameplate_gain_nm_per_a: 25.65", "nameplate_gain_nm_per_a: 25.66"),
        (DEMO, "serial: 1003", "serial: 1013"),
        ("robots/tx40.urdf", "<robot", "<!-- measured again --><robot"),
        ("drives/generic-cia402.yaml", "amplitude: rms", "amplitude: peak"),
    ],
)
def test_whatever_else_changes_is_another_recording(
    configs: Path, file: str, was: str, becomes: str
) -> None:
    files = bundle(configs / DEMO)
    before = cell_from_bundle(files)
    member = {DEMO: "cell.yaml", "robots/tx40.urdf": "robot.urdf"}.get(file, file)
    text = files[member].decode()
    assert was in text
    changed_content = text.replace(was, becomes, 1).encode()
    after = cell_from_bundle({**files, member: changed_content})
    assert after.recording_digest != before.recording_digest


def test_a_log_reports_the_same_as_the_files(configs: Path) -> None:
    _said(configs, "policy: {motion: allowed}\n")
    cell = load_cell(configs / DEMO)
    files = bundle(configs / DEMO)
    assert cell_from_bundle(files).recording_digest == cell.recording_digest
