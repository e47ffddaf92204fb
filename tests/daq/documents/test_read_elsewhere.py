"""A calibration is read without drivegain, as its how-to page says."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

from daq.documents.calibration_file import (
    CalibrationDocument,
    EffectEntry,
    GainEntry,
    save_calibration,
)
from ident.calibration import Parameter
from ident.physical.full_set import FullParameter, FullSet
from tests.daq.calibrations import demo_calibration


def _page(checkout: Path) -> str:
    return (checkout / "docs/how-to/read-a-calibration.md").read_text(encoding="utf-8")


def test_the_ten_lines_of_the_page_read_every_gain_and_parameter(
    checkout: Path, tmp_path: Path
) -> None:
    small = Parameter("Ixx2 - 0.5*Iyy2", 3e-05, 1e-6, "kg m²")
    parameters = (*demo_calibration().parameters, small)
    calibration = replace(demo_calibration(), parameters=parameters)
    save_calibration(calibration, tmp_path / "calibration.yaml")
    (code,) = re.findall(r"```python\n(.*?)```", _page(checkout), re.DOTALL)
    assert len([line for line in code.splitlines() if line]) <= 10
    checked = code + 'import sys\nassert not {"daq", "ident", "drivers"} & set(sys.modules)\n'
    done = subprocess.run(
        [sys.executable, "-X", "utf8", "-c", checked],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert lines[0] == "J1: 33.9 ± 0.14 Nm/A"
    assert lines[3] == "J4: -9.21 ± 0.037 Nm/A"
    assert lines[-1] == "Ixx2 - 0.5*Iyy2: 3e-05 ± 1e-06 kg m²"
    expected = len(calibration.gains) + len(calibration.parameters)
    assert len(lines) == expected


def test_the_page_has_every_key(checkout: Path) -> None:
    matches = re.findall(r"`(\w+)`", _page(checkout))
    written = set(matches)
    for entry in (CalibrationDocument, GainEntry, EffectEntry):
        assert set(entry.model_fields) <= written, entry.__name__
    for section in (FullSet, FullParameter):
        assert {field.name for field in fields(section)} <= written, section.__name__
