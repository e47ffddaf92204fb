"""`drivegain fit --prior`: every parameter of a real robot, and URDFs that are no prior of it."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import daq.environment
from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import decode_calibration, encode_calibration, load_calibration
from daq.errors import ConfigurationInconsistent, ExitCode, UsageError
from daq.report.full_parameters import full_parameter_view
from daq.workflow.fit import Fit, fit
from daq.workflow.full_parameters import OF_CELL, full_set
from ident.estimators.method import Method
from ident.physical.full_set import FullParameter, FullSet, GainWithPrior
from tests.daq.calibrations import AXES, demo_calibration


@pytest.fixture(scope="module")
def urdf(checkout: Path) -> str:
    """The TX-40's URDF, with rough inertias."""
    robots_folder = checkout / "configs" / "robots"
    return (robots_folder / "tx40.urdf").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def fitted(real: tuple[Path, Path]) -> Fit:
    """The real TX-40 with its gains fixed."""
    logs = [real[1]]
    return fit(logs, gains_fixed=True)


def _fit(log: Path, *options: object) -> int:
    return main(["fit", str(log), "--gains", "fixed", *map(str, options)])


@pytest.mark.slow
def test_every_parameter_of_the_real_robot_has_a_value_a_sigma_and_a_basis(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, log = real
    out = tmp_path / "calibration.yaml"
    capsys.readouterr()
    assert (
        _fit(log, "--method", "ml", "--prior-tolerance", 0.2, "--out", out, "--json") == ExitCode.OK
    )
    printed = capsys.readouterr().out
    document = json.loads(printed)["full_parameters"]
    assert document["urdf"] == OF_CELL
    assert document["contradictions"] == []
    assert document["gains"] == []
    parameters = {one["name"]: one for one in document["parameters"]}
    assert len(parameters) == 87
    assert parameters["fv1"]["basis"] == "data"
    assert parameters["m1"]["basis"] == "prior"
    prior = parameters["m1"]["prior"]
    assert parameters["m1"]["value"] == pytest.approx(prior)
    std = parameters["m1"]["std"]
    assert std == pytest.approx(0.2 * parameters["m1"]["prior"])
    assert all(one["std"] > 0.0 for one in parameters.values())
    assert all(parameters[f"m{number}"]["value"] > 0.0 for number in range(1, 7))
    # The torque of the full set is that of the fit: its combinations are the base parameters,
    # within their σ.
    read = load_calibration(out)
    assert read.full_parameters is not None
    differences = []
    for base in read.parameters:
        terms = re.findall(r"(?:^|([+-]) )(?:([0-9.e+-]+)\*)?([A-Za-z]+[0-9])(?= |$)", base.name)
        value = 0.0
        for sign, size, name in terms:
            value += float(f"{sign}{size or 1.0}") * parameters[name]["value"]
        difference = value - base.value
        differences.append(difference / base.std)
    median_absolute_difference = np.median(np.abs(differences))
    assert median_absolute_difference < 1.0


@pytest.mark.slow
def test_masses_that_are_wrong_are_said(fitted: Fit, urdf: str) -> None:
    heavy = full_set(fitted, _scaled(urdf, 1.5), "heavy.urdf", 0.1)
    assert heavy.contradictions[0].startswith("by the data, the links together are 0.")
    calibration = replace(demo_calibration(), full_parameters=heavy)
    said = "\n".join(map(str, full_parameter_view(calibration, heavy)))
    assert "CHECK the prior: by the data, the links together are 0." in said
    assert "What is marked `prior` is not to be trusted" in said


@pytest.mark.slow
def test_a_robot_with_joints_that_follow_or_close_a_loop_is_refused_by_their_names(
    fitted: Fit, checkout: Path, tmp_path: Path
) -> None:
    """Before its inertias are: those of a gripper's fingers are often missing."""
    folder = tmp_path / "configs"
    shutil.copytree(checkout / "configs", folder)
    urdf = folder / "robots" / "tx40.urdf"
    follower = """<link name="finger"/><joint name="gripper" type="revolute">
      <parent link="link6"/><child link="finger"/><axis xyz="0 1 0"/>
      <limit lower="-9" upper="9" velocity="9" effort="9"/>
      <mimic joint="J5" multiplier="-0.5"/></joint></robot>"""
    text = urdf.read_text(encoding="utf-8")
    urdf.write_text(text.replace("</robot>", follower), encoding="utf-8")
    followed = load_cell(folder / "cells" / "tx40.yaml")
    five_bar = load_cell(folder / "cells" / "five-bar.yaml")
    for cell, words in (
        (followed, "joints that follow others in the URDF: gripper"),
        (five_bar, "joints of a closed chain without a motor: "),
    ):
        with pytest.raises(UsageError) as caught:
            full_set(replace(fitted, cell=cell), cell.urdf, OF_CELL, 0.1)
        assert caught.value.found.startswith(words)
        assert "each joint with a motor" in caught.value.expected
        assert "fit without --prior and --prior-tolerance" in caught.value.remedy


def _scaled(urdf: str, factor: float) -> str:
    def scaled(found: re.Match[str]) -> str:
        return f'{found[1]}="{factor * float(found[2])!r}"'

    return re.sub(r'(<mass value|i[xyz][xyz])="([^"]+)"', scaled, urdf)


def test_a_urdf_that_is_no_prior_of_this_robot_is_refused(
    fitted: Fit, urdf: str, checkout: Path
) -> None:
    robots_folder = checkout / "configs" / "robots"
    other = (robots_folder / "gantry.urdf").read_text(encoding="utf-8")
    longer = urdf.replace("0.225 0 0.035", "0.250 0 0.035")
    assert longer != urdf
    bare = re.sub(r"(?s)<inertial>.*?</inertial>", "", urdf)
    with pytest.raises(ConfigurationInconsistent, match="another robot: 5 moving joints"):
        full_set(fitted, other, "gantry.urdf", 0.1)
    with pytest.raises(ConfigurationInconsistent, match="another robot: J3; expected the 6 joints"):
        full_set(fitted, longer, "longer.urdf", 0.1)
    with pytest.raises(ConfigurationInconsistent, match="expected a URDF"):
        full_set(fitted, "<no", "no.urdf", 0.1)
    with pytest.raises(UsageError, match="no possible inertia for the links of J1, J2"):
        full_set(fitted, bare, "bare.urdf", 0.1)


def test_gains_by_an_estimator_without_sigma_by_moves_are_refused(fitted: Fit, urdf: str) -> None:
    estimate = replace(fitted.identification.estimate, method=Method.WLS, gains_fixed=False)
    identification = replace(fitted.identification, estimate=estimate)
    free = replace(fitted, identification=identification)
    with pytest.raises(UsageError, match="expected ml, whose σ comes from leaving out moves"):
        full_set(free, urdf, "arm.urdf", 0.1)


def test_options_that_leave_parameters_out_are_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = tmp_path / "none.mcap"
    assert _fit(missing, "--prior-tolerance", 0.1, "--essential", 10) == ExitCode.USAGE
    assert "--prior" in capsys.readouterr().err
    monkeypatch.setattr(daq.environment, "find_spec", lambda _: None)
    assert _fit(missing, "--prior-tolerance", 0.1) == ExitCode.CONFIGURATION
    assert "pip install 'drivegain[physical]'" in capsys.readouterr().err


def test_a_prior_that_cannot_be_read_is_refused_before_the_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "none.mcap"
    prior = tmp_path / "none.urdf"
    assert _fit(log, "--prior", prior) == ExitCode.CONFIGURATION
    assert "none.urdf" in capsys.readouterr().err
    prior.write_bytes(b"\x1f\x8b")
    assert _fit(log, "--prior", prior) == ExitCode.CONFIGURATION
    assert "none.urdf" in capsys.readouterr().err


def test_the_full_set_comes_back_from_the_file_and_older_files_have_none() -> None:
    full_parameter = FullParameter("m2", 3.4, 0.3, "kg", "prior", 0.8, 3.5, 0.35)
    parameters = (
        full_parameter,
        FullParameter("fv2", 5.5, 0.05, "Nm/(rad/s)", "data", 0.0, None, None),
    )
    gains = tuple(GainWithPrior(axis, 30.0, 0.1) for axis in AXES)
    urdf_sha256 = "a" * 64
    full = FullSet(
        urdf="arm.urdf",
        urdf_sha256=urdf_sha256,
        tolerance=0.1,
        parameters=parameters,
        gains=gains,
        bounded=False,
        chi_square=31.0,
        degrees_of_freedom=34,
        mass_ratio=None,
        mass_ratio_std=None,
        contradictions=(),
    )
    calibration = replace(demo_calibration(), full_parameters=full)
    content = encode_calibration(calibration)
    assert decode_calibration(content, "calibration.yaml").full_parameters == full
    older = yaml.safe_load(encode_calibration(demo_calibration()))
    del older["full_parameters"]
    del older["digests"]["full_parameters"]
    encoded_text = yaml.safe_dump(older).encode()
    assert decode_calibration(encoded_text, "calibration.yaml").full_parameters is None


@pytest.fixture
def without_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that fails the test: what is refused must be refused before it."""

    def no_fit(*_: object, **__: object) -> None:
        pytest.fail("the fit has begun")

    monkeypatch.setattr("daq.workflow.fit.fit", no_fit)
    monkeypatch.setattr("daq.workflow.cases.reduce_logs", no_fit)


@pytest.mark.usefixtures("without_fit")
@pytest.mark.parametrize("by", ["log", "cell"])
def test_a_prior_of_another_robot_is_refused_before_the_fit(
    by: str,
    real: tuple[Path, Path],
    checkout: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, log = real
    prior = checkout / "configs" / "robots" / "gantry.urdf"
    out = tmp_path / "calibration.yaml"
    options: list[object] = ["--prior", prior, "--out", out]
    if by == "cell":
        options += ["--cell", checkout / "configs" / "cells" / "tx40.yaml"]
    assert _fit(log, *options) == ExitCode.CONFIGURATION
    assert "another robot: 5 moving joints" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.usefixtures("without_fit")
def test_a_prior_without_inertias_is_refused_before_the_fit(
    real: tuple[Path, Path], urdf: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, log = real
    prior = tmp_path / "bare.urdf"
    bare = re.sub(r"(?s)<inertial>.*?</inertial>", "", urdf)
    prior.write_text(bare, encoding="utf-8")
    assert _fit(log, "--prior", prior, "--known", "cad") == ExitCode.USAGE
    assert "no possible inertia for the links of J1, J2" in capsys.readouterr().err


@pytest.mark.usefixtures("without_fit")
def test_an_estimator_without_sigma_by_moves_is_refused_before_the_fit(
    real: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, log = real
    arguments = ["fit", str(log), "--method", "wls", "--prior-tolerance", "0.1"]
    assert main(arguments) == ExitCode.USAGE
    assert "expected: ml, whose σ comes from leaving out moves" in capsys.readouterr().err
