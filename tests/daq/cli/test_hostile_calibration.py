"""A calibration with the right digests and nonsense in it:
every verb that reads one refuses it, by the key.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import encode_calibration
from daq.errors import ExitCode
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from ident.estimators.estimate import RelativeError
from tests.daq.calibrations import demo_calibration

FILTER = Conditioning().document()
_demo = demo_calibration()
NONSENSE: dict[str, dict[str, Any]] = {
    "filter of zero": {"filter": {**FILTER, "position_cutoff_hz": 0.0}},
    "negative filter": {"filter": {**FILTER, "decimation_cutoff_hz": -20.0}},
    "tiny filter": {"filter": {**FILTER, "decimation_cutoff_hz": 1e-300}},
    "huge filter": {"filter": {**FILTER, "position_cutoff_hz": 1e300}},
    "filter of order 1e9": {"filter": {**FILTER, "position_order": 10**9}},
    "filter of order 0": {"filter": {**FILTER, "position_order": 0}},
    "negative standstill": {"filter": {**FILTER, "standstill_rad_s": [0.1, -1.0]}},
    "no share": {"filter": {**FILTER, "standstill_share": 0.0}},
    "rows beyond SQLite": {"rows": 2**63},
    "negative rows": {"rows": -1},
    "huge gain": {"gains": (replace(_demo.gains[0], value=1e300), *_demo.gains[1:])},
    "negative sigma": {"gains": (replace(_demo.gains[0], std=-1.0), *_demo.gains[1:])},
    "gain not a number": {"gains": (replace(_demo.gains[0], value=float("nan")), *_demo.gains[1:])},
    "infinite nameplate": {
        "gains": (replace(_demo.gains[0], nameplate=float("inf")), *_demo.gains[1:])
    },
    "negative error": {"relative_error_percent": RelativeError((-1.0,) * 6, -1.0)},
    "negative condition": {"condition": -1.0},
    "negative residual": {"current_residual": (-1.0,) * 6},
    "huge covariance": {"covariance_factor": ((1e200,),)},
}


def _key(changes: dict[str, Any]) -> str:
    return next(iter(changes))


@pytest.mark.parametrize("changes", NONSENSE.values(), ids=NONSENSE)
def test_nonsense_is_refused_by_every_verb_before_anything_is_written(
    cell_file: Path, changes: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    calibration: Calibration = replace(_demo, **{"filter": FILTER, **changes})
    path = cell_file.parent / "calibration.yaml"
    out = cell_file.parent / "out"
    path.write_bytes(encode_calibration(calibration))  # which computes the digests of this content
    controller = load_cell(cell_file).controller_path
    assert controller is not None
    before = controller.read_bytes()
    kept = sorted(cell_file.parent.iterdir())
    file = str(cell_file)
    fitted = str(path)
    verbs = [
        ["apply", file, fitted, "--yes"],
        ["history", file, "--add", fitted],
        ["certificate", fitted, "--cell", file, "--out", str(out)],
        ["validate", fitted, "no.mcap"],
        ["weigh", "no.mcap", "--calibration", fitted],
        ["contact", "no.mcap", "--calibration", fitted],
        ["monitor", file, "--calibration", fitted],
        ["export", "urdf", file, fitted, "--out", str(out)],
    ]
    for verb in verbs:
        code = main(verb)
        said = capsys.readouterr().err
        assert code == ExitCode.DATA_UNFIT, (verb, said)
        assert _key(changes) in said, (verb, said)
    assert controller.read_bytes() == before
    assert sorted(cell_file.parent.iterdir()) == kept
