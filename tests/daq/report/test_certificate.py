"""The certificate: the verdict is that of the gates, its numbers are on the page,
and files cannot put code there.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import encode_calibration, load_calibration, save_calibration
from daq.documents.session_state import Fitted, JobState
from daq.errors import CalibrationRefused, ExitCode
from daq.files import sha256
from daq.jobs.session import Session, save, session_of
from daq.ledger.audit import AuditAction
from daq.ledger.ledger import record_session
from daq.report.certificate import (
    Certificate,
    Origin,
    Verdict,
    certificate_report,
    certify,
    order_text,
)
from daq.report.certificate_page import certificate_page
from daq.report.comparison import compare, without_controller
from daq.report.document import json_tree
from daq.report.effect_names import curve_of, named_size, size_text
from daq.report.gains import with_deviation
from daq.writeback.gates.gate import Gate
from daq.writeback.request import Request
from ident.calibration import AcceptedEffect, Calibration, Parameter, PayloadMass, Source
from ident.effects.effect import PlacedEffect
from ident.effects.friction import LoadFriction
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth
from ident.errors import Diagnosis
from tests.daq.calibrations import (
    IDENTIFIED,
    NAMEPLATE,
    RECORDED,
    calibration_for,
    demo_calibration,
    demo_recording,
    with_recordings,
)
from tests.daq.command_line import run_verb

NOW = RECORDED + timedelta(hours=1)
HOSTILE = '<script>alert("x")</script>&<img src=http://example.org/x>'


class Reader(HTMLParser):
    """Takes a page apart; unbalanced tags fail at once."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, _ in attrs:
            assert name not in {"src", "href"}
            assert not name.startswith("on")
        self.tags.append(tag)
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def _with_smooth() -> Calibration:
    """A term without a name on J2: its torque is that of the B-splines alone."""
    smooth = Smooth(Abscissa.POSITION, lower=-2.38838, upper=1.5)
    placed = PlacedEffect(smooth, 1)
    found = []
    for k, column in enumerate(placed.columns):
        coefficient = Parameter(column.name, 0.1 * k - 0.3, 0.02, column.unit)
        found.append(coefficient)
    settings = dict(placed.effect.settings)
    effect = AcceptedEffect(placed.effect.name, "J2", settings, tuple(found), 5.0, 3.0)
    made = demo_calibration()
    parameters = (*made.parameters, *found)
    return replace(made, effects=(effect,), parameters=parameters)


def _certified(calibration: Calibration) -> Certificate:
    """The certificate of a calibration that no controller is compared with."""
    comparison = without_controller(calibration, "", NOW)
    return certify(calibration, comparison)


def _page(calibration: Calibration, earlier: Calibration | None = None) -> str:
    comparison = without_controller(calibration, "not read", NOW)
    certificate = certify(calibration, comparison, earlier)
    return certificate_page(certificate)


def _texts(calibration: Calibration, earlier: Calibration | None = None) -> list[str]:
    """Texts of the page."""
    page = Reader(_page(calibration, earlier))
    return page.texts


def _texts_of(certificate: Certificate) -> list[str]:
    """Texts of the page of a certificate."""
    page = Reader(certificate_page(certificate))
    return page.texts


def _texts_with(start: str, texts: list[str]) -> list[str]:
    """Those that start so."""
    return [text for text in texts if text.startswith(start)]


def _printed_document(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The JSON document that was printed."""
    printed = capsys.readouterr().out
    document: dict[str, Any] = json.loads(printed)
    return document


def _with_first_gain(calibration: Calibration, **changes: Any) -> Calibration:
    """The calibration with changes of the gain of J1."""
    first, *others = calibration.gains
    changed = replace(first, **changes)
    return replace(calibration, gains=(changed, *others))


def test_every_number_of_the_document_is_on_the_page() -> None:
    calibration = demo_calibration()
    comparison = without_controller(calibration, "not read", NOW)
    certificate = certify(calibration, comparison)
    text = certificate_page(certificate)
    report = certificate_report(certificate)
    page = Reader(text)
    active_tags = {"script", "link", "iframe", "object", "a", "img"}
    assert active_tags.isdisjoint(page.tags)
    assert "http" not in text.replace("http-equiv", "")
    assert f"• {report.sentence}" in page.texts
    for gain, axis in zip(calibration.gains, report.axes, strict=True):
        identified = f"{with_deviation(gain.value, gain.std)} {gain.unit}"
        assert f"{axis.old:.5g}" in page.texts
        assert identified in page.texts
        assert axis.verdict in page.texts
        assert axis.change_percent == pytest.approx(gain.change_percent)
    before = report.nameplate_holdout_error_percent
    after = report.holdout_error_percent
    assert before is not None
    assert after is not None
    expected = f"{before.total:.2f} → {after.total:.2f}"
    assert expected in page.texts
    for first, second in zip(before.axes, after.axes, strict=True):
        expected = f"{first:.2f} → {second:.2f}"
        assert expected in page.texts
    for value in report.identity.values():
        assert value in page.texts


def test_the_mass_is_shown_as_it_was_entered_twice_and_what_is_missing_is_said() -> None:
    calibration = with_recordings(demo_calibration(), operator="Ada")
    texts = _texts(calibration)
    entered = "disc: 4.59 kg in the cell file, 4.592 and 4.588 kg on the scale"
    assert (
        f"{entered}; a wrong mass changes every gain, by the same share where nothing else of "
        "it is known"
    ) in texts
    assert "Ada" in texts
    bare = replace(calibration, sources=(), holdout_error_percent=None, effects=())
    texts = _texts(bare)
    assert "not known: the recordings name none" in texts
    without_held_out = [text for text in texts if "No run was held out" in text]
    assert without_held_out != []
    assert "The calibration holds no effect beyond the declared model." in texts


def test_the_dependence_of_the_gains_on_the_mass_is_on_the_sheet_and_in_the_details() -> None:
    calibration = with_recordings(demo_calibration(), operator="Ada")
    gains = calibration.gains
    per_kg = [gain.value / 4.59 for gain in gains]
    payload = PayloadMass.of("disc", 4.59, per_kg, gains).weighed_to(0.0459)
    in_proportion = replace(calibration, payload_mass=(payload,))
    texts = _texts(in_proportion)
    sheet = _texts_with("disc: 4.59 kg in the cell file", texts)[0]
    assert "if the mass of disc is wrong by 1 %, every gain is wrong by 1 %" in sheet
    assert "4.59 kg ± 0.0459 kg, which is ± 1 % of every gain, not included in σ" in sheet
    assert "Dependence of the gains on the payload's mass" in texts
    expected = f"{per_kg[0]:.4g}"
    assert expected in texts
    # With the drawing known too, each gain has a number.
    shares = np.linspace(0.1, 0.6, len(gains))
    slopes = [share * slope for share, slope in zip(shares, per_kg, strict=True)]
    payload = PayloadMass.of("disc", 4.59, slopes, gains).weighed_to(0.0459)
    drawn = replace(calibration, payload_mass=(payload,))
    sheet = _texts_with("disc: 4.59 kg in the cell file", _texts(drawn))[0]
    expected = f"the gains are wrong by: {gains[0].axis} 0.10 %, "
    assert expected in sheet
    assert "which is at most ± 0.6 % of every gain, not included in σ" in sheet
    certificate = _certified(drawn)
    report = json_tree(certificate_report(certificate))
    (found,) = report["payload_mass"]
    assert found["payload"] == "disc"
    assert found["mass_kg"] == 4.59
    assert found["tolerance_kg"] == 0.0459
    for one, gain, share, slope in zip(found["gains"], gains, shares, slopes, strict=True):
        assert one["axis"] == gain.axis
        assert one["percent_per_percent"] == pytest.approx(share)
        assert one["per_kg"] == pytest.approx(slope)
        tolerance_std = 0.01 * share * abs(gain.value)
        assert one["tolerance_std"] == pytest.approx(tolerance_std)


def test_what_files_say_is_escaped() -> None:
    made = demo_calibration()
    gains = [replace(gain, axis=f"{gain.axis}{HOSTILE}") for gain in made.gains]
    calibration = replace(made, cell=HOSTILE, gains=tuple(gains), software=HOSTILE)
    hostile = with_recordings(calibration, operator=HOSTILE)
    text = _page(hostile)
    assert "<script" not in text
    texts = Reader(text).texts
    assert f"Cell {HOSTILE}" in texts


def test_a_calibration_of_the_library_has_no_program_and_no_time() -> None:
    calibration = replace(demo_calibration(), created="", software="")
    text = " ".join(_page(calibration).split())
    assert "made time not known by software not known." in text


def test_a_term_without_a_name_is_its_curve() -> None:
    calibration = _with_smooth()
    accepted = calibration.effects[0]
    curve = curve_of(accepted, calibration)
    assert curve is not None
    assert curve.half_nm is None
    assert curve.x[0] == -2.38838
    assert curve.x[-1] == 1.5
    # The shapes leave out the constant, whose B-spline weights are all one: the weights of the
    # curve sum to zero.
    placed = Smooth(Abscissa.POSITION, lower=-2.38838, upper=1.5)
    shapes = placed.shapes(curve.x).T
    weights, *_ = np.linalg.lstsq(shapes, curve.torque_nm, rcond=None)
    coefficients = [one.value for one in accepted.coefficients]
    assert weights == pytest.approx(coefficients)

    text = _page(calibration)
    _, _, body = text.partition("</style>")
    for internal in ("lower", "upper", "other_axis", "signed", "part 7", "2.38838"):
        assert internal not in body
    joined = " ".join(Reader(text).texts)
    assert size_text(accepted, calibration) in joined


def test_a_loss_beside_a_rotor_shows_the_inertia_of_the_rotor() -> None:
    """The setting and the coefficient that remains of it are one number to a reader:
    J + d/c ± σ_d/c.
    """
    loss = Parameter("c", 0.1, 0.001, "Nm/Nm")
    rest = Parameter("d", 0.002, 0.004, "kg m²")
    effect = LoadFriction(0, 0.58, 1)
    text = named_size(effect, (loss, rest))
    share = f"{with_deviation(10.0, 0.1)} % of the load torque"
    inertia = f"{with_deviation(0.6, 0.04)} kg m²"
    assert text == f"{share}, with a rotor of {inertia}"
    without_rotor = named_size(LoadFriction(0), (loss,))
    assert without_rotor == share


def test_the_curve_of_a_sliding_axis_is_a_force_over_metres() -> None:
    made = _with_smooth()
    gains = list(made.gains)
    gains[1] = replace(gains[1], unit="N/A")
    assert gains[1].axis == "J2"
    sliding = replace(made, gains=tuple(gains))
    texts = _texts(sliding)
    assert "force [N]" in texts
    assert "joint position [m]" in texts
    in_newton = [
        text for text in texts if " N. Error of the predicted torque of J2 on data" in text
    ]
    assert in_newton != []
    assert "torque [Nm]" in _texts(made)


def test_checks_that_failed_alike_are_one_entry_with_its_remedy() -> None:
    calibration = demo_calibration()
    gains = [replace(one, std=0.2 * abs(one.value)) for one in calibration.gains]
    vague = replace(calibration, gains=tuple(gains))
    texts = _texts(vague)
    (entry,) = _texts_with("J1, J2, J3, J4, J5, J6: found σ 20.00 %", texts)
    assert calibration.effects
    assert "residual" not in entry
    assert entry.endswith("record longer or more exciting moves, or a heavier payload.")


def test_the_verdict_is_that_of_the_gates() -> None:
    calibration = demo_calibration()
    certificate = _certified(calibration)
    assert certificate.verdict is Verdict.NOT_COMPARED
    vague = _with_first_gain(calibration, std=5.0)
    refused = _certified(vague)
    assert refused.verdict is Verdict.REFUSED
    assert refused.sentence.startswith("Must not be written: J1: σ 14.75 %, expected at most 3 %")
    assert "refused: σ 14.75 %" in _texts_of(refused)


ZERO_OFF = Diagnosis(
    "zero-off",
    (),
    ("J2",),
    "the zero of J2 off by +2.00 ± 0.05 °; explained as well by J3",
    "the URDF's",
    "correct it",
)
REVERSED = Diagnosis(
    "position-reversed",
    (),
    ("J2",),
    "a position that counts the other way: so read, it leaves 3 %",
    "its axis",
    "turn",
)


def _certified_without_refusals(calibration: Calibration) -> Certificate:
    """The certificate of a calibration that no gate refuses."""
    comparison = without_controller(calibration, "", NOW)
    let_through = replace(comparison, refusals=())
    return certify(calibration, let_through)


def test_the_verdict_names_what_is_to_be_checked() -> None:
    calibration = replace(demo_calibration(), diagnoses=(ZERO_OFF,))
    certificate = _certified_without_refusals(calibration)
    assert certificate.verdict is Verdict.NOT_COMPARED
    assert certificate.sentence.endswith(" But CHECK J2: the zero of J2 off by +2.00 ± 0.05 °.")
    assert "verdict act" in certificate_page(certificate)
    both = replace(calibration, diagnoses=(ZERO_OFF, REVERSED))
    certificate = _certified_without_refusals(both)
    assert certificate.sentence.endswith("± 0.05 ° (and 1 more).")


def test_a_wrong_description_that_refuses_a_write_is_said_once() -> None:
    calibration = replace(demo_calibration(), diagnoses=(REVERSED,))
    certificate = _certified(calibration)
    assert certificate.sentence == (
        "Must not be written: J2: a position that counts the other way, expected its axis."
    )
    assert certificate_page(certificate).count("so read, it leaves 3 %") == 1


def test_without_a_controller_no_message_names_a_current_gain() -> None:
    calibration = demo_calibration()
    first = calibration.gains[0]
    reversed_first = _with_first_gain(calibration, value=-first.value)
    certificate = _certified(reversed_first)
    (sign,) = (one for one in certificate.comparison.refusals if one.gate is Gate.SIGN)
    assert sign.found == "gain -33.9, nameplate 32.96"
    assert "current gain" not in certificate_page(certificate)


def test_gains_that_were_held_are_the_first_reason() -> None:
    calibration = demo_calibration()
    gains = [replace(one, value=one.nameplate, std=0.0) for one in calibration.gains]
    worse_effect = replace(calibration.effects[0], error_after_percent=6.2)
    worse = replace(calibration, gains=tuple(gains), effects=(worse_effect,))
    certificate = _certified(worse)
    assert certificate.sentence == (
        "Must not be written: the gains were held fixed (`--gains fixed`), so there is nothing "
        "to write."
    )
    first_refusal = certificate.comparison.refusals[0]
    assert first_refusal.gate is Gate.NOT_IDENTIFIED


def test_a_page_beside_an_earlier_one_shows_what_changed() -> None:
    calibration = demo_calibration()
    first = calibration.gains[0]
    smaller = _with_first_gain(calibration, value=0.9 * first.value)
    earlier = replace(smaller, effects=())
    texts = _texts(calibration, earlier)
    assert texts.count("differs from the earlier calibration") == 1
    assert "+11.1" in texts
    assert _texts_with("New: J3 has friction that grows with the load", texts) != []
    changed_earlier = replace(earlier, cell="other")
    with pytest.raises(CalibrationRefused, match="of the same cell"):
        _page(calibration, changed_earlier)


def test_the_verb_writes_one_page_and_never_over_another_file(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "calibration.yaml"
    page = tmp_path / "calibration.html"
    save_calibration(demo_calibration(), file)
    cells_folder = checkout / "configs" / "cells"
    cell = str(cells_folder / "demo.yaml")
    code = run_verb("certificate", file, "--cell", cell, "--beside", file, "--json")
    assert code == ExitCode.OK
    document = _printed_document(capsys)
    # The configuration of the demo cell is not the one that the calibration names.
    assert document["verdict"] == "refused"
    expected = [f"drives.J{number}.gain" for number in range(1, 7)]
    keys = [axis["key"] for axis in document["axes"]]
    assert keys == expected
    # J4 went from -11.52 to -9.21: its size decreased. The current gain is no calibration's.
    first_sigmas = document["axes"][0]["change_sigmas"]
    fourth_sigmas = document["axes"][3]["change_sigmas"]
    assert fourth_sigmas < 0.0 < first_sigmas
    texts = Reader(page.read_text(encoding="utf-8")).texts
    assert (
        "More than noise: the probability that noise alone makes such a change, on any axis, is "
        "below 1 %; the current gain is taken as exact on all axes."
    ) in texts
    # Of gains that must not be written the page does not show what would be.
    written = {axis["written"] for axis in document["axes"]}
    assert written.isdisjoint(texts)
    for text in texts:
        assert "would be written" not in text
    assert run_verb("certificate", file, "--json") == ExitCode.OK
    unread = _printed_document(capsys)["axes"]
    for axis in unread:
        assert axis["key"] is None
        assert axis["line"] is None
    assert "the nameplate is taken as exact on all axes." in page.read_text(encoding="utf-8")
    page.write_text("the user's own", encoding="utf-8")
    assert run_verb("certificate", file) == ExitCode.USAGE
    assert page.read_text(encoding="utf-8") == "the user's own"


@pytest.mark.parametrize("count", [0, 3, 5])
def test_a_calibration_without_an_error_for_each_gain_is_refused(count: int) -> None:
    made = demo_calibration()
    torn = replace(made, gains=made.gains[:count])
    compared = without_controller(made, "unread", NOW)
    for judged, earlier in ((torn, None), (made, torn)):
        with pytest.raises(CalibrationRefused, match="one error for each"):
            certify(judged, compared, earlier)


@pytest.fixture
def cell_file(tmp_path: Path, checkout: Path) -> Path:
    """A copy of the demo cell whose controller may be written."""
    configs = Path(shutil.copytree(checkout / "configs", tmp_path / "configs"))
    return configs / "cells" / "demo.yaml"


def _certificate(cell_file: Path, calibration_file: Path, **changes: object) -> Certificate:
    content = calibration_file.read_bytes()
    calibration = replace(load_calibration(calibration_file), **changes)  # type: ignore[arg-type]
    now = datetime.now(UTC)
    request = Request(calibration, now, file=calibration_file, content=content)
    compared = compare(load_cell(cell_file), request)
    origin = Origin(sha256(content))
    return certify(calibration, compared, origin=origin)


def _apply(cell_file: Path, calibration_file: Path) -> None:
    words = ["apply", str(cell_file), str(calibration_file), "--yes", "--by", "A. Miller"]
    assert main(words) == ExitCode.OK


def _document(certificate: Certificate) -> dict[str, Any]:
    return json_tree(certificate_report(certificate))


def test_a_certificate_has_the_same_id_each_time_and_another_calibration_another_one(
    tmp_path: Path,
) -> None:
    calibration = demo_calibration()
    other = replace(calibration, created="2025-01-02T03:04:06+00:00")
    file = tmp_path / "calibration.yaml"
    save_calibration(calibration, file)
    origin = Origin.of(calibration).id
    assert Origin.of(calibration).id == origin
    assert Origin.of(other).id != origin
    assert sha256(file.read_bytes()).startswith(origin)
    assert len(origin) == 12
    certificate = _certified(calibration)
    document = _document(certificate)
    assert document["id"] == origin
    expected = sha256(encode_calibration(calibration))
    assert document["sha256"] == expected
    assert f"Calibration certificate {origin}" in _texts_of(certificate)


def test_gains_that_are_not_written_may_be_written_and_what_would_be_is_shown(
    cell_file: Path,
) -> None:
    certificate = _certificate(cell_file, calibration_for(cell_file))
    assert certificate.verdict is Verdict.READY
    document = _document(certificate)
    assert document["status"]["state"] == "not written"
    assert document["status"]["write"] is None
    assert document["status"]["acceptance"] is None
    texts = _texts_of(certificate)
    assert "What would be written into controllers/demo.yaml" in texts
    written = {axis["written"] for axis in document["axes"]}
    assert written <= set(texts)
    assert _texts_with("not written (as of ", texts) != []


def test_gains_that_were_written_are_shown_as_written_beside_the_previous_ones(
    cell_file: Path,
) -> None:
    controllers_folder = cell_file.parents[1] / "controllers"
    controller = controllers_folder / "demo.yaml"
    text = controller.read_text(encoding="utf-8")
    commented = text.replace(
        "# Nm at the joint per A", "# Nm at the joint per A, from the data sheet"
    )
    controller.write_text(commented, encoding="utf-8")
    calibration_file = calibration_for(cell_file)
    ready = _certificate(cell_file, calibration_file)
    _apply(cell_file, calibration_file)
    certificate = _certificate(cell_file, calibration_file)
    document = _document(certificate)
    status = document["status"]
    assert status["state"] == "written"
    assert status["write"]["who"].startswith("A. Miller")
    demo_path = cell_file.parents[1] / "controllers" / "demo.yaml"
    expected = str(demo_path)
    assert status["write"]["target"] == expected
    assert status["ended"] is None
    assert document["sentence"].startswith("Written on ")
    assert "by A. Miller" in document["sentence"]
    assert "J4 most, by -20.1 %" in document["sentence"]
    # In JSON the gains are compared with the current gains.
    assert document["verdict"] == "unchanged"
    old_gains = [axis["old"] for axis in document["axes"]]
    assert old_gains == pytest.approx(IDENTIFIED, rel=1e-4)
    texts = _texts_of(certificate)
    nameplates = {f"{old:.5g}" for old in NAMEPLATE}
    assert nameplates <= set(texts)
    assert "What was written into controllers/demo.yaml" in texts
    for text in texts:
        assert "would be written" not in text
        assert "Ready" not in text
    assert texts.count("differs from the previous gain") == 6
    judged = [row.judged for row in certificate.shown_rows]
    assert judged == [row.judged for row in ready.proposed_rows]
    # The comments of this controller file say where the earlier gains came from.
    comment = "J1: “Nm at the joint per A, from the data sheet”"
    with_comment = [text for text in texts if comment in text]
    assert with_comment != []


def test_a_write_that_was_rolled_back_is_not_in_force(cell_file: Path) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    assert run_verb("rollback", cell_file, "--by", "B. Ode") == ExitCode.OK
    certificate = _certificate(cell_file, calibration_file)
    document = _document(certificate)
    assert document["status"]["state"] == "replaced"
    ended = document["status"]["ended"]
    assert ended["who"].startswith("B. Ode")
    assert "; rolled back on " in document["status"]["text"]
    assert not document["sentence"].startswith("Written")
    texts = _texts_of(certificate)
    assert "What would be written into controllers/demo.yaml" in texts


def test_a_file_that_was_changed_by_hand_after_the_write_is_noticed(cell_file: Path) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    controllers_folder = cell_file.parents[1] / "controllers"
    controller = controllers_folder / "demo.yaml"
    text = controller.read_text(encoding="utf-8")
    changed_text = text.replace("gain: 33.9", "gain: 34.9", 1)
    controller.write_text(changed_text, encoding="utf-8")
    document = _document(_certificate(cell_file, calibration_file))
    assert document["status"]["state"] == "replaced"
    assert "; the file has other gains now (as of " in document["status"]["text"]
    assert not document["sentence"].startswith("Written")


def test_a_written_calibration_that_a_check_would_refuse_today_says_both(cell_file: Path) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    policy = "\npolicy: {apply: {max_std_percent: 0.1}}\n"
    text = cell_file.read_text(encoding="utf-8")
    cell_file.write_text(text + policy, encoding="utf-8")
    certificate = _certificate(cell_file, calibration_file)
    assert certificate.verdict is Verdict.REFUSED
    assert certificate.sentence.startswith("Written on ")
    assert (
        ". Today a check refuses them: J1: σ 0.40 %, expected at most 0.1 % (and 5 more, below)."
    ) in (certificate.sentence)


def _recorded_in_order(payloads: str) -> tuple[Source, ...]:
    """Runs of the fit, `b` without load and `l` with it,
    given to it in another order than they were recorded in.
    """
    sources: list[Source] = []
    for place, kind in enumerate(payloads):
        recorded_s = 1.7e9 + 60.0 * place
        recording = replace(demo_recording(), recorded_s=recorded_s)
        payload = None
        if kind == "l":
            payload = "disc"
        source = Source(f"r{place}", f"{place:064x}", "fit", payload=payload, recording=recording)
        sources.append(source)
    return tuple(reversed(sources))


@pytest.mark.parametrize(
    ("payloads", "said"),
    [
        ("bllb", "bare, loaded, loaded, bare; so an even warm-up moves no gain"),
        ("bllbbl", "bare, loaded, loaded, bare, bare, loaded; so an even warm-up moves no gain"),
        ("bl", "bare, loaded; loaded runs come later, so a warm-up moves the gains"),
        ("llb", "loaded, loaded, bare; bare runs come later, so a warm-up moves the gains"),
        ("bb", ""),
    ],
)
def test_the_order_of_runs_says_whether_a_warm_up_moves_the_gains(payloads: str, said: str) -> None:
    calibration = replace(demo_calibration(), sources=_recorded_in_order(payloads))
    assert order_text(calibration) == said


def test_with_friction_by_payload_no_order_of_runs_moves_the_gains() -> None:
    declared = demo_calibration()
    by_payload = [Parameter(f"fs{axis}_loaded", -0.4, 0.1, "Nm") for axis in range(1, 7)]
    parameters = (*declared.parameters, *by_payload)
    calibration = replace(declared, sources=_recorded_in_order("bbll"), parameters=parameters)
    said = "bare, bare, loaded, loaded; friction by payload: its change between them moves no gain"
    assert order_text(calibration) == said
    lacking = replace(calibration, parameters=calibration.parameters[:-1])
    assert "so a warm-up moves the gains" in order_text(lacking)


def test_an_order_that_no_clock_tells_is_not_said() -> None:
    first, *others = _recorded_in_order("bllb")
    unknown = replace(first, recording=None)
    calibration = replace(demo_calibration(), sources=(unknown, *others))
    assert order_text(calibration) == ""


def test_an_accepted_calibration_says_when_and_by_whom(cell_file: Path) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    calibration_sha256 = sha256(calibration_file.read_bytes())
    details = {
        "session": "x",
        "cell": "demo",
        "calibration_sha256": calibration_sha256,
    }
    audit = cell_file.with_name("demo.audit.jsonl")
    record_session(
        audit, AuditAction.ACCEPTED, at=NOW, who="A. Miller", subject="x", details=details
    )
    certificate = _certificate(cell_file, calibration_file)
    status = _document(certificate)["status"]
    assert status["state"] == "accepted"
    expected = {
        "at": NOW.isoformat(),
        "who": "A. Miller",
        "accepted": True,
        "remark": "",
        "undo": "",
    }
    assert status["acceptance"] == expected
    assert "; accepted on 2025-01-02 03:00 UTC by A. Miller (as of " in status["text"]


def test_a_calibration_that_new_moves_contradict_says_what_failed_and_how_to_undo_it(
    cell_file: Path,
) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    details = {
        "session": "x",
        "cell": "demo",
        "calibration_sha256": sha256(calibration_file.read_bytes()),
        "remark": "J4 is 25 % off",
        "undo": "drivegain rollback demo.yaml",
    }
    audit = cell_file.with_name("demo.audit.jsonl")
    record_session(
        audit, AuditAction.NOT_ACCEPTED, at=NOW, who="A. Miller", subject="x", details=details
    )
    certificate = _certificate(cell_file, calibration_file)
    status = _document(certificate)["status"]
    assert status["state"] == "not accepted"
    assert "; NOT ACCEPTED on 2025-01-02 03:00 UTC by A. Miller: J4 is 25 % off" in status["text"]
    assert "to undo the write: drivegain rollback demo.yaml" in status["text"]
    assert certificate.sentence.endswith(". New moves contradict them: J4 is 25 % off.")
    page = certificate_page(certificate)
    assert "To undo the write: <code>drivegain rollback demo.yaml</code>" in page


def test_a_name_in_the_audit_log_commands_neither_a_terminal_nor_a_page(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration_file = calibration_for(cell_file)
    _apply(cell_file, calibration_file)
    who = f"\x1b[2J{HOSTILE}"
    details = {
        "session": "x",
        "cell": "demo",
        "calibration_sha256": sha256(calibration_file.read_bytes()),
    }
    audit = cell_file.with_name("demo.audit.jsonl")
    record_session(audit, AuditAction.ACCEPTED, at=NOW, who=who, subject="x", details=details)
    capsys.readouterr()
    status = main(["certificate", str(calibration_file), "--cell", str(cell_file)])
    assert status == ExitCode.OK
    said = capsys.readouterr().out
    assert "accepted on 2025-01-02 03:00 UTC by \\x1b[2J" in said
    assert "\x1b" not in said
    page = calibration_file.with_suffix(".html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "\x1b" not in page


def test_without_a_cell_the_status_is_not_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), file)
    assert run_verb("certificate", file, "--json") == ExitCode.OK
    document = _printed_document(capsys)
    assert document["status"]["state"] == "not known"
    assert document["status"]["as_of"] is None
    assert "--cell CELL" in document["status"]["text"]
    assert document["session"] is None


def test_a_calibration_in_a_session_names_it_and_another_one_in_its_folder_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "20250102T030000Z"
    folder.mkdir()
    file = folder / "calibration.yaml"
    save_calibration(demo_calibration(), file)
    digest = sha256(file.read_bytes())
    at = NOW.isoformat()
    fitted = Fitted(calibration_sha256=digest, sentences=())
    state = JobState(
        session=folder.name,
        cell="demo",
        configuration_sha256="c",
        plans_sha256="p",
        began=at,
        attempt_began=at,
        fitted=fitted,
    )
    save(Session(folder, state))
    assert session_of(file, digest) == folder.name
    session = session_of(file, "0" * 64)
    assert session is None
    calibration = tmp_path / "calibration.yaml"
    assert session_of(calibration, digest) is None
    assert run_verb("certificate", file, "--json") == ExitCode.OK
    document = _printed_document(capsys)
    assert document["session"] == folder.name
    text = file.with_suffix(".html").read_text(encoding="utf-8")
    assert folder.name in Reader(text).texts


@pytest.mark.parametrize("name", ["page.pdf", "page.htm", "page.html.txt"])
def test_a_name_of_another_format_is_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), file)
    out = tmp_path / name
    assert main(["certificate", str(file), "--out", str(out)]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "expected: a name that ends in .html" in said
    assert "saves it as a PDF" in said
    assert not out.exists()
    for other in ("page.HTML", "page"):
        out = tmp_path / other
        assert main(["certificate", str(file), "--out", str(out)]) == ExitCode.OK


def test_the_earlier_name_of_the_verb_writes_the_same_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), file)
    found = []
    for verb in ("certificate", "report"):
        page = tmp_path / f"{verb}.html"
        assert run_verb(verb, file, "--out", page, "--json") == ExitCode.OK
        printed = capsys.readouterr().out
        found.append((page.read_bytes(), printed))
    assert found[0] == found[1]
