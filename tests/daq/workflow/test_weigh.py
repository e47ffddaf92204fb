"""`weigh` and `contact` on the log of a real robot, and what they print."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console, RenderableType

from daq.cli import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.errors import ExitCode
from daq.report.weighing_views import contact_report, contact_view, weigh_report, weighed_view
from daq.workflow.validate import warn_of_fitted
from daq.workflow.weigh import Weighed
from ident.calibration import AcceptedEffect, Parameter
from ident.contact import Band, ExternalTorque
from ident.data.run import Run
from ident.estimators.estimate import RelativeError
from ident.model.bodies import LINK_PARAMETERS
from ident.weighing import Help, Scale, WeighedBody
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import DISC, demo_content, samples, write

FloatArray = NDArray[np.float64]


def _demo(checkout: Path) -> Cell:
    return load_cell(checkout / "configs/cells/demo.yaml")


def _five_bar(checkout: Path) -> Cell:
    return load_cell(checkout / "configs/cells/five-bar.yaml")


def _one_line(text: str) -> str:
    """A printed text without its line breaks."""
    return " ".join(text.split())


@pytest.mark.slow
def test_a_real_robot_that_touched_nothing(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = real
    pictures = tmp_path / "new"
    options = ["--calibration", str(file), "--pictures", str(pictures)]
    assert main(["contact", str(log), *options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["band_from_this_log"]
    axes = [axis["axis"] for axis in found["axes"]]
    assert axes == ["J1", "J2", "J3", "J4", "J5", "J6"]
    for axis in found["axes"]:
        assert 0.0 < axis["band"] < axis["threshold"]
    assert found["contacts"] == []
    picture = Path(found["picture"]).read_bytes()
    assert picture.startswith(b"\x89PNG")


def test_a_log_is_not_its_own_quiet_motion(
    real: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = map(str, real)
    arguments = ["contact", log, "--calibration", file, "--quiet", log]
    assert main(arguments) == ExitCode.DATA_UNFIT
    assert "the same log twice" in capsys.readouterr().err


def test_quiet_motion_that_the_fit_has_seen_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    calibration = demo_calibration()
    rest = np.zeros((4, 6))
    time_s = np.arange(4.0)
    seen = Run("seen", time_s, rest, rest, digest="a" * 64)
    held_out = Run("held", time_s, rest, rest, digest="d" * 64)
    assert warn_of_fitted(calibration, [held_out], "no matter") == ()
    assert caplog.messages == []
    assert warn_of_fitted(calibration, [seen, held_out], "no proof") == ("seen",)
    assert caplog.messages == ["seen was part of the fit: no proof"]


@pytest.mark.slow
def test_a_real_flange_without_a_body_weighs_nothing(
    real: tuple[Path, Path], capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    file, log = map(str, real)
    arguments = ["weigh", log, "--calibration", file]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert text.startswith("No body shows: the mass is within two σ of nothing.\n")
    assert "centre" not in text
    behind_name = text.partition("mass  ")[2]
    mass_and_std = behind_name.split("kg")[0]
    mass, std = map(float, mass_and_std.split("±"))
    three_sigma = 3.0 * std
    assert abs(mass) < three_sigma < 0.3
    assert caplog.messages[0].startswith("tx40 was part of the fit: the agreement proves nothing")
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["part_of_the_fit"] == ["tx40"]


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["weigh", "contact"])
def test_a_cell_that_was_corrected_since_is_not_corrected_twice_unsaid(
    real: tuple[Path, Path], tmp_path: Path, verb: str, caplog: pytest.LogCaptureFixture
) -> None:
    file, log = real
    calibration = load_calibration(file)
    zero = Parameter("zero-offset offset 2", 0.001, 0.0002, "rad")
    axis = calibration.gains[1].axis
    corrected = AcceptedEffect("zero-offset", axis, {}, (zero,), 6.1, 3.4)
    for digest, warned in ((calibration.configuration_sha256, 0), ("e" * 64, 1)):
        changed = replace(calibration, effects=(corrected,), configuration_sha256=digest)
        known = tmp_path / f"{digest[:4]}.yaml"
        save_calibration(changed, known)
        caplog.clear()
        assert main([verb, str(log), "--calibration", str(known)]) == ExitCode.OK
        other_description = "another description of the cell than the fit"
        texts = [text for text in caplog.messages if other_description in text]
        assert len(texts) == warned
        for text in texts:
            assert f"zero-offset on {axis}" in text


@pytest.mark.slow
def test_a_calibration_comes_first_or_as_an_option(
    real: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = map(str, real)
    calibration_first = [file, log]
    as_option = [log, "--calibration", file]
    as_word = [f"--calibration={file}", log]
    for verb in ("weigh", "validate"):
        printed = []
        for words in (calibration_first, as_option, as_word):
            assert main([verb, *words, "--json"]) == ExitCode.OK
            printed.append(capsys.readouterr().out)
        assert printed[0] == printed[1]
        assert printed[1] == printed[2]


@pytest.mark.slow
def test_a_log_that_declares_a_payload_is_not_bare(
    real: tuple[Path, Path], checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, _ = real
    calibration = load_calibration(file)
    gains = []
    for index, gain in enumerate(calibration.gains):
        gains.append(replace(gain, axis=f"J{index + 1}"))
    of_demo = replace(calibration, cell="demo", gains=tuple(gains))
    calibration_file = tmp_path / "calibration.yaml"
    save_calibration(of_demo, calibration_file)
    known = ["--calibration", str(calibration_file)]
    time = np.arange(2500)[:, None] / 200.0
    phase_rad = time + np.arange(6)
    angle = np.rint(20000.0 * np.sin(phase_rad)).astype(int)
    other_angle = angle + 1
    log = str(tmp_path / "a.mcap")
    bare = str(tmp_path / "b.mcap")
    write(Path(log), demo_content(checkout, DISC), samples(angle.tolist()))
    write(Path(bare), demo_content(checkout), samples(other_angle.tolist()))

    assert main(["weigh", log, "--bare", log, *known]) == 4
    assert "found:    payload 'disc'" in capsys.readouterr().err
    assert main(["weigh", log, log, *known]) == 4
    assert "found:    the same log twice" in capsys.readouterr().err
    for logs, mixed in (([bare, log], log), ([log, bare], bare)):
        assert main(["weigh", *logs, *known]) == 4
        said = capsys.readouterr().err
        assert f"error:    {mixed}" in said
        assert "payload 'disc' in mounting 'flange-a'" in said
        assert "no load" in said
        assert "--bare" in said
    assert main(["contact", log, *known]) == 4
    assert "nothing is known of mounting 'flange-a'" in capsys.readouterr().err


def _text(parts: Iterable[RenderableType], width: int = 160) -> str:
    console = Console(width=width, file=StringIO())
    with console.capture() as printed:
        for part in parts:
            console.print(part)
    return printed.get()


def _weighed(
    cell: Cell, values: FloatArray, std: FloatArray, *, has_covariance: bool = True
) -> Weighed:
    """A body that was weighed once, by a calibration with its covariance or without."""
    covariance = np.diag(std**2)
    axes = (2.0,) * len(cell.axes)
    error = RelativeError(axes, 2.0)
    scale = Scale.__new__(Scale)
    body = WeighedBody(values, covariance, covariance, has_covariance, 20, error, scale)
    logs = (Path("a.mcap"),)
    return Weighed(cell, logs, (), body, (), 5.0)


def test_a_weighed_body_is_shown_with_what_would_help(checkout: Path) -> None:
    ten = np.array([0.07, -0.02, 0.02, 0.07, 0.03, 0.05, -0.24, -0.25, np.nan, 4.6])
    std = np.where(np.isnan(ten), np.nan, 0.01)
    helped = Help("mz", "fast moves of all axes", 5.0, 0.004)
    weighed = _weighed(_demo(checkout), ten, std, has_covariance=False)
    found = replace(weighed, help=(helped,), declared_kg=4.59)
    text = _text(weighed_view(found))
    assert "4.600 ± 0.010" in text
    assert "+0.22 %" in text
    assert "mz: add 5 s of fast moves of all axes (σ 0.004)" in text
    assert "no covariance" in text
    assert "tolerance" not in text
    narrow = _text(weighed_view(found), width=80)
    assert re.search(r"Ixx +0\.070 ± 0\.010 +kg m² +yes", narrow)
    assert "…" not in narrow

    report = weigh_report(found)
    assert report.mass_kg.value == 4.6
    assert report.mass_kg.std == pytest.approx(0.01)
    names = [one.name for one in report.parameters]
    assert names == list(LINK_PARAMETERS)
    with_help = [one.name for one in report.parameters if one.add is not None]
    assert with_help == ["mz"]
    not_identifiable = [one.name for one in report.parameters if not one.identifiable]
    assert not_identifiable == ["mz"]
    assert report.mass_std_of_reference_kg == 0.0

    reference = np.full((10, 10), 1e-6)
    uncertain_body = replace(found.body, reference_covariance=reference)
    tolerant = replace(found, body=uncertain_body)
    tolerant_text = _one_line(_text(weighed_view(tolerant)))
    assert "with the tolerance of the calibration's payload mass" in tolerant_text
    mass_std_of_reference_kg = weigh_report(tolerant).mass_std_of_reference_kg
    assert mass_std_of_reference_kg == pytest.approx(0.001)

    small_values = np.full(10, 0.001)
    small_body = replace(found.body, values=small_values)
    nothing = replace(found, body=small_body, declared_kg=None)
    assert "No body shows" in _text(weighed_view(nothing))


def test_the_centre_is_shown_in_the_platforms_frame_too(checkout: Path) -> None:
    """The plate of the five-bar is 450 mm from its joint;
    a planar robot shows Izz, two first moments and the mass.
    """
    ten = np.full(10, np.nan)
    ten[5:8] = (1.0, 2.16, 0.15)
    ten[9] = 5.0
    std = np.where(np.isnan(ten), np.nan, 0.02)
    std[5] = 0.2
    found = _weighed(_five_bar(checkout), ten, std)
    text = _text(weighed_view(found))
    assert re.search(r"centre x +432\.0 ± 4\.4 +mm", text)
    assert re.search(r"centre x in plate +-18\.0 ± 4\.4 +mm", text)
    assert "Not identifiable with a σ: it is more than 10 % of the value" in text
    in_platform = weigh_report(found).centre_in_platform_m
    assert in_platform is not None
    x, y, z = in_platform.value
    assert x == pytest.approx(-0.018)
    assert y == pytest.approx(0.03)
    assert z is None

    serial = replace(found, cell=_demo(checkout))
    assert weigh_report(serial).centre_in_platform_m is None
    serial_text = _text(weighed_view(serial))
    before_frame = serial_text.partition("In the frame")[0]
    assert " in " not in before_frame


def test_a_platform_that_only_translates_shows_a_mass_alone(checkout: Path) -> None:
    ten = np.full(10, np.nan)
    ten[9] = 5.0
    std = np.where(np.isnan(ten), np.nan, 0.02)
    weighed = _weighed(_five_bar(checkout), ten, std)
    lines = _text(weighed_view(weighed)).splitlines()
    assert lines[0].strip() == "Body on the platform"
    assert "The platform does not turn in these moves: centre and inertia cannot be seen." in lines
    for line in lines:
        assert not line.startswith(("centre", "Ixx", "parameter"))


def _band(threshold: FloatArray, correlation_s: FloatArray, quiet_s: FloatArray) -> Band:
    """A band of ±2 Nm on six axes."""
    one = np.ones(6)
    knots = np.ones((6, 4))
    return Band(knots, 2.0 * one, threshold, correlation_s, quiet_s, 1.0)


def test_contacts_are_listed(checkout: Path) -> None:
    cell = _demo(checkout)
    one = np.ones(6)
    even = np.ones((6, 500))
    threshold = np.full(6, 5.0)
    threshold[5] = np.nan
    band = _band(threshold, 0.05 * one, 40.0 * one)
    torque = 0.5 * even
    torque[2, 100:140] = -9.0
    time_s = np.linspace(0.0, 9.98, 500)
    found = ExternalTorque(time_s, torque, even, even > 0.0, band, True, 1)
    text = _text(contact_view(found, cell))
    assert "J3" in text
    assert "1.80" in text
    assert "this log less 1 stretch that is far out" in text
    assert "J6 not judged: 40 s of quiet motion have too few separate peaks; record longer." in text
    report = contact_report(found, cell, Path("a.mcap"), None)
    (contact,) = report.contacts
    assert contact.axis == "J3"
    assert contact.peak == -9.0
    assert contact.peak_over_threshold == 1.8
    assert contact.start_s == pytest.approx(2.0)
    assert contact.end_s == pytest.approx(2.78)
    (not_judged,) = report.not_judged
    assert not_judged.axis == "J6"


def test_no_contact_is_said_of_judged_axes_alone(checkout: Path) -> None:
    cell = _demo(checkout)
    one = np.ones(6)
    even = np.ones((6, 500))
    threshold = np.array([5.0, np.nan, np.nan, 5.0, 5.0, 5.0])
    correlation_s = np.where(np.arange(6) == 1, 1.5, 0.02)
    quiet_s = np.array([40.0, 11.0, 8.0, 40.0, 40.0, 40.0])
    band = _band(threshold, correlation_s, quiet_s)
    use = even > 0.0
    use[3] = False
    time_s = np.linspace(0.0, 9.98, 500)
    found = ExternalTorque(time_s, even, even, use, band, False, 0)
    text = _text(contact_view(found, cell))
    assert "No contact on J1, J5, J6." in text
    assert "J2 not judged: its residual stays on one side for 1.5 s at a time" in text
    assert "J3 not judged: 8 s of quiet motion have too few separate peaks; record longer." in text
    assert "J4 not judged: it does not move in this log." in text
    report = contact_report(found, cell, Path("a.mcap"), None)
    not_judged = [entry.axis for entry in report.not_judged]
    assert not_judged == ["J2", "J3", "J4"]
    no_use = np.zeros_like(use)
    blind = replace(found, use=no_use)
    assert "No contact" not in _text(contact_view(blind, cell))
    known_band = replace(band, threshold=5.0 * one)
    judged = replace(found, use=even > 0.0, band=known_band)
    assert "No contact.\n" in _text(contact_view(judged, cell))
