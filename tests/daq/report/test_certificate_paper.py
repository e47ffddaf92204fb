"""The certificate on paper: one page of A4 and of Letter with everything that a person signs."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from playwright.sync_api import Browser, sync_playwright

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.errors import ExitCode
from daq.files import sha256
from daq.report.certificate import Origin, Verdict, certify
from daq.report.certificate_page import certificate_page
from daq.report.comparison import compare
from daq.report.html import folded, paragraph
from daq.report.svg import ranking
from daq.writeback.request import Request
from ident.calibration import AcceptedEffect, Calibration, Parameter, PayloadMass, Source
from ident.effects.effect import PlacedEffect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth
from ident.errors import Diagnosis
from tests.daq.calibrations import calibration_for, demo_recording

CHROMIUM = os.environ.get("DRIVEGAIN_CHROMIUM", "")
needs_browser = [
    pytest.mark.browser,
    pytest.mark.skipif(
        not CHROMIUM, reason="DRIVEGAIN_CHROMIUM names no browser; `make test-console` does"
    ),
]
PAPERS = ("A4", "Letter")
STATES = ("ready", "written", "refused", "not compared")
SESSION = "20260105T060000Z"
COMMAND = (
    "drivegain apply press-4/cells/press-4.yaml recalibration/20260105T060000Z/calibration.yaml"
)
CONSEQUENCE = (
    "With the effects the gain of J3 is 1.2 ± 0.1 % smaller, that of J2 is the same within noise."
)


@pytest.fixture
def cell_file(tmp_path: Path, checkout: Path) -> Path:
    """A copy of the demo cell whose controller may be written."""
    configs = Path(shutil.copytree(checkout / "configs", tmp_path / "configs"))
    return configs / "cells" / "demo.yaml"


def full_calibration(cell_file: Path) -> Calibration:
    """A calibration of six axes with as much as one has:
    three effects, five logs, a finding, a weighed payload.
    """
    made = load_calibration(calibration_for(cell_file))
    effect = Smooth(Abscissa.POSITION, lower=-2.4, upper=1.5)
    placed = PlacedEffect(effect, 1)
    weights = tuple(
        Parameter(one.name, 0.1 * k - 0.3, 0.02, one.unit) for k, one in enumerate(placed.columns)
    )
    settings = dict(placed.effect.settings)
    smooth = AcceptedEffect(placed.effect.name, "J2", settings, weights, 5.0, 3.0)
    of_load = made.effects[0]
    at = datetime.fromisoformat(made.created) - timedelta(hours=1)
    bare = []
    for name in ("bare-1", "bare-2"):
        bare.append(Source(name, sha256(name.encode()), "fit", recording=demo_recording(at=at)))
    loaded = [
        Source(name, sha256(name.encode()), role, False, "disc", 4.59, demo_recording(4.59, at))
        for name, role in (("loaded-1", "fit"), ("loaded-2", "fit"), ("held-out", "holdout"))
    ]
    slopes = [gain.value / 4.59 for gain in made.gains]
    payload_mass = (PayloadMass.of("disc", 4.59, slopes, made.gains).weighed_to(0.005),)
    diagnosis = Diagnosis(
        "torque-above-limit",
        ("loaded-1",),
        ("J5",),
        found="a torque of 21.4 Nm of the load on J5 in loaded-1",
        expected="at most 20 Nm, as the URDF allows",
        remedy="check the mass of the payload and the limits in the URDF",
    )
    diagnoses = (diagnosis,)
    effects = (of_load, smooth, replace(of_load, axis="J5"))
    parameters = (*made.parameters, *weights)
    sources = (*bare, *loaded)
    return replace(
        made,
        effects=effects,
        parameters=parameters,
        sources=sources,
        payload_mass=payload_mass,
        diagnoses=diagnoses,
    )


def page_of(state: str, cell_file: Path) -> str:
    """The page of a calibration in one of STATES."""
    calibration = full_calibration(cell_file)
    if state == "refused":
        gains = tuple(replace(gain, std=0.2 * abs(gain.value)) for gain in calibration.gains)
        calibration = replace(calibration, gains=gains)
    file = cell_file.with_name("calibration.yaml")
    save_calibration(calibration, file)
    if state == "written":
        written = [
            "apply",
            str(cell_file),
            str(file),
            "--yes",
            "--by",
            "A. Miller",
            "--payload-mass",
            "disc=4.59",
        ]
        assert main(written) == ExitCode.OK
    if state == "not compared":
        controllers_folder = cell_file.parents[1] / "controllers"
        (controllers_folder / "demo.yaml").unlink()
    now = datetime.now(UTC)
    request = Request(calibration, now, file=file, content=file.read_bytes())
    compared = compare(load_cell(cell_file), request, COMMAND)
    origin = Origin(sha256(request.signed), SESSION)
    certificate = certify(calibration, compared, origin=origin)
    expected = {
        "ready": Verdict.READY,
        "written": Verdict.UNCHANGED,
        "refused": Verdict.REFUSED,
        "not compared": Verdict.NOT_COMPARED,
    }
    assert certificate.verdict is expected[state], certificate.sentence
    details = [folded("What was found", paragraph("A detail. " * 400)) for _ in range(3)]
    return certificate_page(certificate, CONSEQUENCE, details)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium."""
    with sync_playwright() as playwright:
        # A container's root may not make the namespaces of the browser's sandbox; it opens our own
        # pages alone.
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


def count_pages(document: bytes) -> int:
    """Number of pages of a PDF, whose page objects Chromium does not compress."""
    return len(re.findall(rb"/Type\s*/Page\b(?!s)", document))


class TestInTheBrowser:
    """What Chromium prints."""

    pytestmark = needs_browser

    @pytest.mark.parametrize("state", STATES)
    def test_it_is_one_page_of_each_paper(
        self, state: str, cell_file: Path, browser: Browser
    ) -> None:
        page = browser.new_page()
        page.set_content(page_of(state, cell_file))
        pages = {paper: count_pages(page.pdf(format=paper)) for paper in PAPERS}
        assert pages == dict.fromkeys(PAPERS, 1)
        # A section that the reader has opened follows on sheets of its own.
        page.evaluate("document.querySelector('details').open = true")
        document = page.pdf(format="A4")
        assert count_pages(document) > 1
        page.close()

    def test_paper_shows_digests_and_lines_to_sign_and_the_screen_does_not(
        self, cell_file: Path, browser: Browser
    ) -> None:
        page = browser.new_page()
        page.set_content(page_of("ready", cell_file))
        for medium in ("print", "screen"):
            page.emulate_media(media=medium)
            on_paper = medium == "print"
            assert page.locator(".sign").is_visible() is on_paper
            assert page.locator("section.paper").is_visible() is on_paper
            assert page.locator(".details").is_visible() is not on_paper
            assert page.locator(".sheet .screen").is_visible() is not on_paper
        page.close()

    @pytest.mark.parametrize("width", [390, 1280])
    def test_no_screen_scrolls_sideways(
        self, width: int, cell_file: Path, browser: Browser
    ) -> None:
        page = browser.new_page(viewport={"width": width, "height": 844})
        page.set_content(page_of("written", cell_file))
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.close()

    def test_no_grid_line_crosses_a_name_of_a_ranking(self, browser: Browser) -> None:
        names = [
            "J3: a gravity compensator, or another torque that repeats with the joint",
            "J1: a spring",
        ]
        page = browser.new_page(viewport={"width": 376, "height": 844})
        rows = [(name, 10.0, "full") for name in names]
        page.set_content(ranking(rows, "Candidates", "unit"))
        crossed = page.evaluate(CROSSED)
        page.close()
        assert crossed == []


CROSSED = """() => {
    const boxes = (kind) => [...document.querySelectorAll(kind)].map((one) => [one, one.getBoundingClientRect()]);
    return boxes("text").flatMap(([text, a]) => boxes("line").filter(([, b]) =>
        a.left < b.right && b.left < a.right && a.top + 2 < b.bottom && b.top < a.bottom - 2
    ).map(() => text.textContent));
}"""  # noqa: E501
"""Texts of a drawing whose box a line crosses;
the height of a box has room above and below the letters.
"""


def test_the_sheet_has_every_digest_and_three_lines_to_sign(cell_file: Path) -> None:
    text = page_of("ready", cell_file)
    calibration = full_calibration(cell_file)
    sheet = text.partition('<main class="sheet">')[2].partition("</main>")[0]
    on_paper = sheet.partition('<section class="paper">')[2]
    digests = [source.sha256 for source in calibration.sources]
    assert len(set(digests)) == 5
    for digest in (*digests, calibration.configuration_sha256):
        assert on_paper.count(digest) == 1
    assert ">held-out (held out)</dt>" in on_paper
    matches = re.findall("<span>(Name|Date|Signature)</span>", on_paper)
    assert matches == [
        "Name",
        "Date",
        "Signature",
    ]


def test_the_style_names_no_paper(cell_file: Path) -> None:
    """A page that names A4 is cut or shrunk on Letter."""
    style = page_of("ready", cell_file).partition("<style>")[2].partition("</style>")[0]
    rules = re.findall(r"@page\s*{([^}]*)}", style)
    assert len(rules) == 1
    assert "size" not in rules[0]
    assert ".paper { display: none; }" in style.partition("@media print {\n")[0]
    assert ".paper { display: block; }" in style.rpartition("@media print {\n")[2]
