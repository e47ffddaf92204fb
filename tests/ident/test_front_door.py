"""`import ident` is enough: its names, its weight, the lines of its docstring, and the examples."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ident

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def example() -> SimpleNamespace:
    """Names of the first example."""
    return SimpleNamespace(**runpy.run_path(str(EXAMPLES / "gains_from_arrays.py")))


def test_every_name_is_there() -> None:
    assert sorted(ident.__all__) == ident.__all__
    for name in ident.__all__:
        assert getattr(ident, name).__name__ == name
    assert set(ident.__all__) <= set(dir(ident))
    misspelt = "identfy"
    with pytest.raises(AttributeError, match=r"no attribute 'identfy'; it exports .*identify"):
        getattr(ident, misspelt)


def test_every_error_has_one_root() -> None:
    assert issubclass(ident.DataUnfit, ident.IdentificationError)


def test_importing_it_brings_nothing_along() -> None:
    words = "import sys, ident; print([m for m in ('numpy', 'scipy', 'ident.model') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_from_arrays_to_gains_in_ten_lines(example: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [line[4:] for line in (ident.__doc__ or "").splitlines() if line.startswith("    ")]
    assert len(lines) <= 10
    model = ident.Model(ident.robot_from_urdf(example.URDF), ident.DriveTrain(np.diag(example.GEAR_RATIOS)))
    bare, loaded = (example.record(model, "x", payload, seed) for seed, payload in enumerate((None, example.DISC)))
    given = {
        "np": np,
        "urdf_text": example.URDF,
        "gear_ratios": example.GEAR_RATIOS,
        **{name: getattr(bare, name) for name in ("time_s", "position_rad", "current_a")},
        **{f"{name}_2": getattr(loaded, name) for name in ("time_s", "position_rad", "current_a")},
    }
    exec("\n".join(lines), given)  # noqa: S102 - the documented lines themselves are what is tested
    found = given["found"]
    assert isinstance(found, ident.Identification)
    error = np.abs(found.estimate.gains - example.TRUE_GAINS_NM_A)
    assert np.all(error < 4.0 * found.estimate.gains_std)
    assert capsys.readouterr().out.count("[") == 2


def test_the_example_finds_the_gains(example: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    found = example.main()
    assert np.all(np.abs(found.estimate.gains - example.TRUE_GAINS_NM_A) < 4.0 * found.estimate.gains_std)
    assert capsys.readouterr().out.count("±") == 3


def test_the_calibration_predicts_a_run_that_the_fit_has_not_seen(example: SimpleNamespace) -> None:
    found = example.main()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), example.NAMEPLATE_NM_A)
    run = example.record(found.model, "another", example.DISC, 9)
    data = ident.differentiate(run, found.model.drive_train, found.conditioning)
    predicted = ident.predict_current(calibration, found.model, data)
    rest = (predicted - data.current_a)[data.moving.all(axis=1)]
    assert predicted.shape == data.current_a.shape == (len(run.time_s) - 2, 3)
    # The noise of the recording is 0.05 A; filtering the positions changes the direction of dry friction for a moment.
    assert np.all(np.sqrt(np.mean(rest**2, axis=0)) < 0.08)
    assert np.all(np.sqrt(np.mean(data.current_a**2, axis=0)) > 0.3)


def test_a_calibration_needs_one_name_an_axis(example: SimpleNamespace) -> None:
    with pytest.raises(ident.ModelError, match="2 axis names, 3 nameplate gains and 2 units for 3 identified"):
        ident.calibration_of(example.main(), ("J1", "J2"), example.NAMEPLATE_NM_A)


def test_currents_are_predicted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / "predict_current.py"), run_name="__main__")
    out = capsys.readouterr().out
    bare, loaded = (line for line in out.splitlines() if "largest currents" in line)
    # Raising the disc costs motor 2 at least its weight at a hand's breadth.
    ampere = [float(line.split("currents ")[1].split(", ")[1].removesuffix(" A")) for line in (bare, loaded)]
    assert ampere[1] > ampere[0] + 0.2
