"""`import daq` is enough: its names, its weight, the lines of its docstring, and the example."""

from __future__ import annotations

import json
import runpy
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

import daq
from daq.cli.app import main
from daq.files import sha256
from tests.daq.histories import history_of
from tests.daq.jobs.made import Made
from tests.daq.jobs.rig import Rig

EXAMPLE = Path(__file__).parents[3] / "examples" / "calibrate_from_logs.py"


def test_every_name_is_there() -> None:
    for name in daq.__all__:
        assert getattr(daq, name).__doc__, name
    assert set(daq.__all__) <= set(dir(daq))
    documented = daq.__doc__ or ""
    errors = {name for name in daq.__all__ if hasattr(daq.errors, name)}
    assert [
        name for name in daq.__all__ if f"`{name}`" not in documented and name not in errors
    ] == []
    with pytest.raises(AttributeError, match=r"no attribute 'fit_log'; it exports .*fit_logs"):
        _ = daq.fit_log  # type: ignore[attr-defined]


def test_importing_it_loads_nothing() -> None:
    words = (
        "import sys, daq; print([m for m in ('numpy', 'scipy', 'yaml', 'daq.errors', 'ident') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_the_documented_lines_write_the_gains(
    whole_job: tuple[Rig, Made],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rig, made = whole_job
    for folder in ("cells", "controllers", "robots"):
        ignore = shutil.ignore_patterns("*.recalibration")
        shutil.copytree(rig.folder / folder, tmp_path / folder, ignore=ignore)
    text = (tmp_path / "cells/demo.yaml").read_text()
    document = json.loads(text)
    document["policy"]["apply"]["max_age_days"] = None  # the logs are of another day
    (tmp_path / "cells/press.yaml").write_text(json.dumps(document))
    controller = tmp_path / "controllers/demo.yaml"
    shutil.copy(before := rig.backups[0], controller)
    for name, log in zip(("bare", "loaded", "held-out"), made.logs.values(), strict=True):
        shutil.copy(log, tmp_path / f"{name}.mcap")
    monkeypatch.chdir(tmp_path)
    lines = [
        line[4:]
        for line in (daq.__doc__ or "").split("====")[0].splitlines()
        if line.startswith("    ")
    ]
    assert len(lines) <= 10
    given: dict[str, Any] = {"Path": Path, "datetime": datetime, "UTC": UTC}
    exec("\n".join(lines), given)  # noqa: S102 - the documented lines themselves are what is tested
    calibration = daq.load_calibration(Path("calibration.yaml"))
    printed = capsys.readouterr().out
    assert printed.count("±") == len(calibration.gains) == 6
    assert given["proposal"].refusals == ()
    assert controller.read_bytes() != before.read_bytes()
    # Written with audit log and history, of which nothing is missing.
    history = history_of(Path("cells/press.yaml"))
    (entry,) = history.entries
    expected = [("Ada", entry.digest)]
    assert [(event.who, event.digest) for event in history.events] == expected
    assert history.in_force(str(controller.resolve())) == sha256(
        Path("calibration.yaml").read_bytes()
    )
    assert main(["history", "cells/press.yaml", "--verify"]) == 0
    # The same numbers as the job's fit of the same logs.
    gains = [gain.value for gain in made.calibration.gains]
    assert [gain.value for gain in calibration.gains] == gains
    (validation,) = daq.validate(calibration, [Path("held-out.mcap")])
    assert calibration.holdout_error_percent is not None
    assert validation.error.total == pytest.approx(
        calibration.holdout_error_percent.total, rel=1e-3
    )


def test_the_example_calibrates(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bare, loaded, held_out = made.logs.values()
    out = tmp_path / "calibration.yaml"
    words = [str(EXAMPLE), str(bare), str(loaded), "--held-out", str(held_out), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    # Its own part is what is tested here; the fit of these logs is known.
    monkeypatch.setattr(
        daq, "fit_logs", lambda _logs, *, holdout, progress: made.calibration, raising=False
    )
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.count("±") == 6
    assert "error on the held-out runs" in printed
    assert daq.load_calibration(out).gains == made.calibration.gains


def test_the_example_names_a_log_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(tmp_path / "none.mcap")])
    with pytest.raises(SystemExit, match=r"none\.mcap"):
        runpy.run_path(str(EXAMPLE), run_name="__main__")


def test_a_log_can_be_read(made: Made) -> None:
    path = made.logs["bare-1"]
    log, (run, cell) = daq.read_log(path), daq.load_run(path)
    assert run.position_rad.shape == log.samples.position_counts.shape
    assert cell.name == "demo"
