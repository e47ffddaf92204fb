"""The page in Chromium beside whole recordings of the simulated cell:
what it shows is what the log holds.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from playwright.sync_api import Browser, FloatRect, Page, Request, sync_playwright

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import save_calibration
from daq.documents.session_state import Block, GainSoFar, GuidedState, Progress, RecordedRun
from daq.errors import ExitCode
from daq.jobs.position import sessions_folder
from daq.jobs.session import Session, save, sessions
from daq.log.conversion import scaling
from daq.log.feed import Feed, QuickGain, QuickLook
from daq.log.reader import Log, read_log
from daq.log.salvage import salvage
from drivers.messages import EventKind
from ident.arrays import FloatArray
from tests.daq.console.feeds import TOKEN, Recording, arrivals, predicting_calibration, served

CHROMIUM = os.environ.get("DRIVEGAIN_CHROMIUM", "")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        not CHROMIUM, reason="DRIVEGAIN_CHROMIUM names no browser; `make test-console` does"
    ),
]
DRIVEGAIN = (sys.executable, "-m", "daq")
FAULTS = """\
faults:
  - {fault: lost, axis: J2, at_s: 1.5, cycles: 1}
  - {fault: emergency, axis: J3, at_s: 4.0, emcy_code: 0x7305}
"""
SHORT_S = "8"  #: Duration of a plan that a recording comes to the end of
#: Of one that is stopped: a simulated cell moves faster than a real one, and a browser may be slow
LONG_S = "240"
HEARD_S = 60.0  #: Time for the page to show what is awaited; longer than a busy machine needs


def until(page: Page, condition: str) -> None:
    """Wait in the page for a condition of its script;
    the browser's own waiting would need `unsafe-eval`.
    """
    wait_ms = 1e3 * HEARD_S
    found = page.evaluate(f"""() => new Promise((resolve) => {{
        const end = performance.now() + {wait_ms};
        const look = () => {{
            const met = Boolean({condition});
            if (met || performance.now() > end) resolve(met); else setTimeout(look, 20);
        }};
        look();
    }})""")
    if not found:
        body = page.inner_text("body")
        pytest.fail(f"not within {HEARD_S:g} s: {condition}\n{body}")


def text_of(element: str) -> str:
    """The text of an element of the page, in its script."""
    return f"document.getElementById('{element}').textContent"


def note_complaints(page: Page, complaints: list[str]) -> None:
    """Collect what a page writes to the browser's console, and its errors."""
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))


def plan_command(cell_file: Path, out: Path, duration_s: str) -> list[str]:
    """Arguments that plan moves without improving them."""
    return [
        "plan",
        str(cell_file),
        "--out",
        str(out),
        "--duration",
        duration_s,
        "--exchanges",
        "0",
    ]


def paragraph(stream: IO[str]) -> list[str]:
    """The next lines of a command, up to an empty line."""
    return list(iter(stream.readline, "\n"))


class Rig:
    """A simulated cell with its console, and a browser."""

    def __init__(
        self,
        folder: Path,
        checkout: Path,
        browser: Browser,
        stack: ExitStack,
        faults: str,
        duration_s: str,
        simulated: Sequence[str] = ("clean",),
    ) -> None:
        self.folder = folder
        self.checkout = checkout
        self.stack = stack
        faults_file = folder / "faults.yaml"
        faults_file.write_text(faults, encoding="utf-8")
        shutil.copytree(checkout / "configs", folder / "configs")
        cells_folder = folder / "configs" / "cells"
        self.cell_file = cells_folder / "demo.yaml"
        options = ["--port", "0"]
        if faults:
            options += ["--faults", str(faults_file)]
        simulation = self.start("simulate", *simulated, *options)
        assert simulation.stdout is not None
        first = paragraph(simulation.stdout)
        lines = first + paragraph(simulation.stdout)
        bus_line = lines.index("bus:\n")
        bus = "".join(lines[bus_line:])
        text = self.cell_file.read_text(encoding="utf-8")
        simulated_text = re.sub(r"bus:\n.*?(?=axes:)", bus, text, flags=re.DOTALL)
        self.cell_file.write_text(simulated_text, encoding="utf-8")
        self.cell = load_cell(self.cell_file)
        self.plan = folder / "plan.yaml"
        self.log = folder / "run.mcap"
        planned = plan_command(self.cell_file, self.plan, duration_s)
        assert main(planned) == ExitCode.OK
        calibration = folder / "calibration.yaml"
        save_calibration(predicting_calibration(), calibration)
        arguments = [str(self.cell_file), "--calibration", str(calibration)]
        self.console = self.start("console", *arguments)
        assert self.console.stdout is not None
        greeting = self.console.stdout.readline()
        matches = re.findall(r"http\S+", greeting)
        self.address = matches[0]
        self.refused: list[str] = []
        self.page = self.opened(browser, width=1280, height=1000)

    def opened(self, browser: Browser, width: int, height: int) -> Page:
        """Open the page, and collect the complaints of its browser."""
        page = browser.new_page(viewport={"width": width, "height": height})
        self.stack.callback(page.close)
        note_complaints(page, self.refused)
        page.on("request", self._note_foreign)
        page.goto(self.address)
        until(page, "window.drivegain.status !== null")
        return page

    def _note_foreign(self, request: Request) -> None:
        if not request.url.startswith((self.address, "data:")):
            self.refused.append(request.url)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command; it is interrupted at the end of the test."""
        process = subprocess.Popen(
            [*DRIVEGAIN, *arguments],
            cwd=self.checkout,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.stack.enter_context(process)
        self.stack.callback(process.send_signal, signal.SIGINT)
        return process

    def record(self) -> subprocess.Popen[str]:
        """Begin a recording."""
        return self.start(
            "record",
            str(self.cell_file),
            str(self.plan),
            "--out",
            str(self.log),
            "--enable-motion",
        )

    def kept(self) -> Log:
        """The log, or what was saved of it."""
        if self.log.exists():
            return read_log(self.log)
        saved = self.folder / "saved.mcap"
        damaged = self.log.with_name(f"{self.log.name}.part")
        salvage(damaged, saved)
        return read_log(saved)

    def shown(self) -> dict[str, Any]:
        """The page's data, once its run has ended."""
        until(self.page, "window.drivegain.status.phase === 'ended' && window.drivegain.run")
        return dict(self.page.evaluate("window.drivegain"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium without a window."""
    with sync_playwright() as playwright:
        # A container's root may not make the namespaces of the browser's sandbox; it opens our own
        # page alone.
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextmanager
def rig(
    folder: Path, checkout: Path, browser: Browser, faults: str = "", duration_s: str = SHORT_S
) -> Iterator[Rig]:
    """Run cell and console until the block ends."""
    with ExitStack() as stack:
        yield Rig(folder, checkout, browser, stack, faults, duration_s)


def test_a_recording_with_a_fault_is_shown_as_its_log_holds_it(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser, FAULTS) as made:
        recorder = made.record()
        output, _ = recorder.communicate(timeout=120)
        assert recorder.returncode == ExitCode.DEVICE_FAULT, output
        shown = made.shown()
        log = made.kept()
        _counts_are_those_of(log, shown["status"])
        _points_are_those_of(log, made.cell, shown)
        _events_are_those_of(log, made.cell, shown["events"])
        body = made.page.inner_text("body")
        for words in (
            "7305h",
            "check the plugs and cables of encoder",
            "The axes are stopped",
            "ended early",
        ):
            assert words in body, words
        assert "INVALID" not in body  # it never came to an end that could be judged
        for figure in ("Bus load", "Sample rate"):  # of a run that has ended there is none
            assert figure not in body
        assert "–\n" not in made.page.inner_text("#figures")
        _events_can_be_seen(made.page)
        _pictures(made, browser, checkout)
        assert made.refused == []


def _counts_are_those_of(log: Log, status: dict[str, Any]) -> None:
    missing = sum(log.statistics.missing)
    assert status["samples"] == len(log.samples.cycle)
    assert status["missing"] == missing
    assert missing > 0
    assert status["lost"] == log.statistics.lost_cycles
    assert status["dropped"] == 0
    states = [axis["state"] for axis in status["axes"]]
    assert states.count("OPERATION ENABLED") == 0


def _points_are_those_of(log: Log, cell: Cell, shown: dict[str, Any]) -> None:
    """Every twentieth cycle of 1 kHz, with the values of the log."""
    of_page = log.samples.cycle % 20 == 0
    scale = scaling(cell, log.head.readback)
    unit = np.array([axis.unit.si for axis in cell.axes])
    position = scale.joint_position(log.samples.position_counts) / unit
    current = log.samples.current_raw * scale.current_per_unit
    points = np.array(shown["points"])
    time_s = points[:, 0]
    shown_position = points[:, 1:7]
    shown_current = points[:, 7:]
    count = np.count_nonzero(of_page)
    assert count > 100
    assert len(points) == count
    assert shown["received"] == count
    np.testing.assert_allclose(shown_position, position[of_page], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(shown_current, current[of_page], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(time_s), 0.02, atol=1e-6)


def _events_are_those_of(log: Log, cell: Cell, events: list[dict[str, Any]]) -> None:
    """In words and with the remedy."""
    assert len(events) == len(log.events)
    for event, logged in zip(events, log.events, strict=True):
        in_page = event["text"]
        if event["axis"] is not None:
            in_page = f"{event['axis']}: {in_page}"
        plain = re.sub(r"^(J\d)(?: \(node \d+\))?: ", r"\1: ", logged.text)
        behind_axis = plain.partition(": ")[2]
        assert in_page.endswith(behind_axis) or plain in in_page
    kinds = [event["kind"] for event in events]
    emergency = events[kinds.index(EventKind.EMCY.value)]
    assert emergency["axis"] == cell.axis_names[2]


def test_the_button_stops_the_axes_and_the_page_says_so(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser, duration_s=LONG_S) as made:
        recorder = made.record()
        until(made.page, "window.drivegain.points.length > 20")
        made.page.click("#stop")
        output, _ = recorder.communicate(timeout=120)
        assert recorder.returncode == ExitCode.INTERRUPTED, output
        assert "axes stopped" in output
        until(
            made.page,
            "document.querySelector('#stopped').textContent.includes('its axes are stopped')",
        )
        shown = made.shown()
        log = made.kept()
        samples = shown["status"]["samples"]
        assert samples == len(log.samples.cycle)
        assert shown["status"]["end"]["axes_stopped"]
        assert made.page.is_disabled("#stop")
        # Predicted where the arm moves; this calibration is the declared model, so only its being
        # there is checked.
        currents: list[float | None] = []
        for row in shown["rows"]:
            currents.extend(row[1:7])
        predicted = [current for current in currents if current is not None]
        assert currents == [] or predicted
        assert made.refused == []


def test_a_page_of_another_site_reads_nothing_and_stops_nothing(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser) as made:
        other = browser.new_page()
        evil = "http://evil.example/"
        content = "<p>evil</p>"
        other.route(evil, lambda route: route.fulfill(body=content, content_type="text/html"))
        other.goto(evil)
        for method in ("GET", "POST"):
            fetched = f"fetch('{made.address}stop', {{method: '{method}'}})"
            outcome = other.evaluate(f"{fetched}.then(() => 'read', () => 'refused')")
            assert outcome == "refused"
        other.close()
        assert made.page.evaluate("window.drivegain.status.stop") is None
        injected = (
            "document.body.append(Object.assign(document.createElement('script'), {text: "
            "'window.evil = 1'}))"
        )
        made.page.evaluate(injected)
        assert made.page.evaluate("window.evil") is None
        assert any("Content Security Policy" in text for text in made.refused)


def _image(page: Page, point: list[float]) -> FloatArray:
    """Where a point of the cell is in the preview: to the right, down, and how near."""
    see_and_near = f"(([see, near]) => [...see({point}), near({point})])"
    return np.array(page.evaluate(f"{see_and_near}(camera(400, 400))"))


def test_a_preview_is_a_right_handed_view_from_above(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    cells_folder = checkout / "configs" / "cells"
    cell = cells_folder / "demo.yaml"
    preview = tmp_path / "plan.html"
    planned = plan_command(cell, tmp_path / "plan.yaml", "8")
    arguments = [*planned, "--preview", str(preview)]
    assert main(arguments) == ExitCode.OK
    page = browser.new_page(viewport={"width": 1000, "height": 1300})
    faults: list[str] = []
    note_complaints(page, faults)
    page.goto(preview.as_uri())
    for button in ("From above", "Along y", "Along x", "3-D", "+"):
        page.click(f"button:text-is('{button}')")
        origin = _image(page, [0, 0, 0])
        unit_vectors = np.eye(3, dtype=int).tolist()
        images = [_image(page, vector) - origin for vector in unit_vectors]
        scale = page.evaluate("camera(400, 400)[2]")
        # Right, up, and towards the viewer are a right-handed frame, so the images of x, y, z must
        # be one as well.
        to_viewer = np.array([1 / scale, -1 / scale, 1.0])
        axes = np.stack(images) * to_viewer
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        axes_determinant = np.linalg.det(axes)
        assert axes_determinant == pytest.approx(1.0)
        assert axes[2, 2] >= -1e-9  # seen from the side or from above, never from below
    console_folder = checkout / "out" / "console"
    path = console_folder / "preview.png"
    page.screenshot(path=path, full_page=True)
    page.close()
    assert faults == []


def _events_can_be_seen(page: Page) -> None:
    """No line of the events is cut: a few are shown, and a button has the others."""
    count = page.evaluate("document.querySelectorAll('#events li').length")
    visible = (
        "[...document.querySelectorAll('#events li')].filter((one) => one.checkVisibility()).length"
    )
    assert page.evaluate(visible) == 8
    assert count > 8
    list_ = "document.querySelector('#events')"
    assert page.evaluate(f"{list_}.scrollHeight <= {list_}.clientHeight")
    assert page.inner_text("#more-events") == f"Show all {count}"
    page.click("#more-events")
    assert page.evaluate(visible) == count
    assert page.evaluate(f"{list_}.scrollHeight <= {list_}.clientHeight")
    page.click("#more-events")
    assert page.evaluate(visible) == 8
    page.evaluate("window.scrollTo(0, 0)")


SHOW_FIRST_AXIS = """(share) => {
    const position = -170 + share * 340;
    const status = {axes: [{state: "FAULT", position: position, current: 0}]};
    window.drivegain.showAxis(0, status);
    const card = document.querySelector("#axes article");
    return [card.querySelector(".values").textContent,
            card.querySelector(".bar").classList.contains("near")];
}"""
"""Shows J1 at a share of its range; returns its text, and whether its bar is red."""


@dataclass(frozen=True)
class BarCase:
    """What the card of an axis says where it is."""

    share: float
    words: str
    is_red: bool


BAR_CASES = (
    BarCase(-0.01, "below its lower limit, ", True),
    BarCase(0.01, "near its lower limit, ", True),
    BarCase(0.5, "", False),
    BarCase(0.99, "near its upper limit, ", True),
    BarCase(1.01, "above its upper limit, ", True),
)


def test_a_bar_is_red_for_a_reason(tmp_path: Path, checkout: Path, browser: Browser) -> None:
    with rig(tmp_path, checkout, browser) as made:
        for case in BAR_CASES:
            text, is_red = made.page.evaluate(SHOW_FIRST_AXIS, case.share)
            behind_position = text.partition(" deg, ")[2]
            words = behind_position.partition("current")[0]
            assert words == case.words
            assert is_red is case.is_red


def test_a_simulated_cell_shows_the_rate_of_its_own_time(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser, duration_s=LONG_S) as made:
        made.record()
        until(made.page, "window.drivegain.points.length > 20")
        until(made.page, "window.drivegain.status.rate_hz > 0")
        figures = made.page.inner_text("#figures")
        assert "1000 Hz, simulated" in figures
        assert "none: simulated" in figures
        made.page.click("#stop")
        made.shown()


def _pictures(made: Rig, browser: Browser, checkout: Path) -> None:
    """Screenshots for people, in out/, and that nothing is wider than a phone."""
    out = checkout / "out" / "console"
    out.mkdir(parents=True, exist_ok=True)
    clip: FloatRect = {"x": 0, "y": 0, "width": 1280, "height": 1240}
    path = out / "desktop.png"
    made.page.screenshot(path=path, clip=clip, full_page=True)
    phone = made.opened(browser, width=390, height=844)
    phone.emulate_media(color_scheme="dark")
    until(phone, "window.drivegain.points.length > 100")
    phone.wait_for_timeout(500)
    phone_path = out / "phone.png"
    phone.screenshot(path=phone_path, full_page=True)
    for width in (390, 320):
        phone.set_viewport_size({"width": width, "height": 844})
        assert phone.evaluate("document.documentElement.scrollWidth") <= width
        # No column is behind the edge of its table.
        until(phone, "document.querySelector('.table')")
        assert phone.evaluate(
            "[...document.querySelectorAll('.table')].every((one) => one.scrollWidth <= "
            "one.clientWidth)"
        )
        # A number is on one line with its per cent sign.
        lines = phone.evaluate(
            """[...document.querySelectorAll('.table td')].filter((one) => one.textContent.endsWith('%')).map((one) => {
                const range = document.createRange();
                range.selectNodeContents(one);
                return range.getClientRects().length;
            })"""  # noqa: E501
        )
        assert lines and set(lines) == {1}


def _made_block(number: int, role: str) -> Block:
    payload = None
    mass_kg = None
    if role != "bare":
        payload = "disc"
        mass_kg = 4.59
    return Block(
        name=f"block-{number}-{role}",
        payload=payload,
        mass_kg=mass_kg,
        holdout=role == "held-out",
        plan=f"plan-{number}.yaml",
    )


def _made_run(name: str) -> RecordedRun:
    return RecordedRun(
        name=name,
        sha256="",
        attempts=1,
        samples=1,
        lost_cycles=0,
        missing=(),
    )


def _made_gain(axis: str, unit: str) -> GainSoFar:
    return GainSoFar(
        axis=axis,
        unit=unit,
        value=10.0,
        std_percent=0.9,
        target_percent=0.5,
    )


def _state_after_three_blocks(cell: Cell, folder: Path) -> None:
    """A session of `calibrate` that waits for its fourth block."""
    roles = ("bare", "loaded", "held-out", "loaded")
    blocks = tuple(_made_block(number, role) for number, role in enumerate(roles, 1))
    runs = tuple(_made_run(block.name) for block in blocks)
    gains = tuple(_made_gain(axis.name, axis.gain_unit) for axis in cell.axes)
    std_percent = (0.9,) * len(gains)
    progress = Progress(blocks=3, motion_s=60.0, fitted_s=40.0, std_percent=std_percent)
    began = "2026-01-05T02:00:00+00:00"
    state = GuidedState(
        session=folder.name,
        cell=cell.name,
        configuration_sha256="",
        began=began,
        attempt_began=began,
        blocks=blocks,
        runs=runs[:3],
        gains=gains,
        judged_blocks=3,
        progress=(progress,),
    )
    folder.mkdir(parents=True)
    save(Session(folder, state))


def test_the_session_shows_the_gains_after_each_move(
    browser: Browser, cell: Cell, cell_file: Path
) -> None:
    folder = sessions_folder(cell_file) / "20260105T020000Z"
    _state_after_three_blocks(cell, folder)
    gains = []
    for axis in cell.axes:
        gains.append(QuickGain(axis.name, axis.gain_unit, 10.0, 0.8, 0.5))
    look = QuickLook(
        "block-4-loaded",
        1,
        9,
        44.0,
        gains=gains,
        why="it needs more moves",
        left_s=69.0,
    )
    feed = Feed(cell_file)
    accepted = arrivals(feed)
    with ExitStack() as stack:
        console = stack.enter_context(served(cell_file, cell))
        stack.enter_context(feed)
        context = stack.enter_context(browser.new_context())
        page = context.new_page()
        address = f"http://127.0.0.1:{console.port}/{TOKEN}/"
        page.goto(address)
        until(page, f"{text_of('next-step')}.startsWith('DISC')")
        # A console is connected before the feed accepts it: what is published in between is for
        # nobody.
        assert accepted.wait(HEARD_S)
        log = folder / "block-4-loaded.mcap"
        recording = Recording(feed, cell, log)
        for number in (1, 2):
            motion_s = 40.0 + 4.0 * number
            changed_look = replace(look, move=number, motion_s=motion_s)
            feed.look(changed_look)
            recording.run(50)
            until(page, f"{text_of('outlook')}.includes('after move {number} of 9')")
        assert page.inner_text("#next-step") == "The robot moves: block-4-loaded"
        outlook = page.inner_text("#outlook")
        assert "J1 is worst (it needs more moves): about 69 s left" in outlook
        # One point of the block that was judged and two of moves since, for each axis.
        axis_count = len(cell.axes)
        points = page.locator("#precision circle")
        quick_points = page.locator("#precision circle.quick")
        assert points.count() == 3 * axis_count
        assert quick_points.count() == 2 * axis_count
        feed.finish()
        until(page, f"{text_of('next-step')}.startsWith('DISC')")


BLOCK_S = "10"
TARGET_PERCENT = "1.5"


class Technician:
    """Answers `drivegain calibrate`, and changes what is mounted on the simulated cell."""

    def __init__(self, command: subprocess.Popen[bytes], mounted: Path) -> None:
        self.command = command
        self.mounted = mounted
        self.said = ""
        self.answers = {
            "Mass of": "4.59",
            "The same once more": "4.59",
            "Type yes": "yes",
        }

    def asked(self) -> str | None:
        """The next question; None at the end of the command."""
        assert self.command.stderr is not None
        while not self._ends_with_question():
            received = os.read(self.command.stderr.fileno(), 65536)
            if not received:
                return None
            self.said += received.decode()
        question = self.said.rpartition("\n>>> ")[2]
        return question.removesuffix(": ")

    def _ends_with_question(self) -> bool:
        last_line = self.said.rpartition("\n")[2]
        return last_line.startswith(">>> ") and last_line.endswith(": ")

    def asked_for(self) -> str:
        """What the last heading asks for: `NOTHING on the flange`."""
        matches = re.findall(r"── \S+: (.+) ──", self.said)
        heading = matches[-1]
        return str(heading)

    def mount(self) -> None:
        """Mount what the last heading asks for."""
        if self.asked_for().startswith("NOTHING"):
            body = "none"
        else:
            body = "disc"
        self.mounted.write_text(f"{body}\n", encoding="utf-8")

    def answer(self, question: str) -> None:
        """Answer a question, with Enter where it asks for nothing else."""
        given = ""
        for begin, text in self.answers.items():
            if question.startswith(begin):
                given = text
        self.said += "\n"
        assert self.command.stdin is not None
        line = f"{given}\n"
        self.command.stdin.write(line.encode())
        self.command.stdin.flush()


def newest_state(cell_file: Path, cell: Cell) -> GuidedState:
    """State of the newest session, as its file has it."""
    newest = sessions(sessions_folder(cell_file), cell.name)[-1]
    state = newest.state
    assert isinstance(state, GuidedState)
    return state


def test_a_whole_session_is_shown_as_its_files_hold_it(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    mounted = tmp_path / "mounted.txt"
    mounted.write_text("none\n", encoding="utf-8")
    simulated = ("demo", "--payload-from", str(mounted))
    with ExitStack() as stack:
        made = Rig(tmp_path, checkout, browser, stack, "", SHORT_S, simulated)
        page = made.page
        arguments = (
            "calibrate",
            str(made.cell_file),
            "--enable-motion",
            "--block",
            BLOCK_S,
            "--target",
            TARGET_PERCENT,
        )
        command = subprocess.Popen(
            [*DRIVEGAIN, *arguments],
            cwd=checkout,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        stack.enter_context(command)
        stack.callback(command.kill)
        technician = Technician(command, mounted)
        while (question := technician.asked()) is not None:
            if "press Enter" in question and "cell" in question:
                step = technician.asked_for()
                until(page, f"{text_of('next-step')}.startsWith('{step}')")
                technician.mount()
                _precision_is_that_of(page, newest_state(made.cell_file, made.cell))
            elif question.startswith("Type yes"):
                until(page, f"{text_of('next-step')}.includes('type yes')")
            technician.answer(question)
        assert command.stdout is not None
        ending = command.stdout.read().decode()
        exit_code = command.wait(timeout=60)
        assert exit_code == ExitCode.OK, technician.said + ending
        until(page, f"{text_of('stage')}.startsWith('Stage: ended')")
        state = newest_state(made.cell_file, made.cell)
        assert state.acceptance is not None
        outlook = page.inner_text("#outlook")
        assert f"Accepted: {state.acceptance.remark}" in outlook
        stage = page.inner_text("#stage")
        for run in state.runs:
            assert run.name in stage
        _precision_is_that_of(page, state)
        console_folder = checkout / "out" / "console"
        console_folder.mkdir(parents=True, exist_ok=True)
        path = checkout / "out" / "console" / "session.png"
        page.screenshot(path=path, full_page=True)
        assert made.refused == []


def _precision_is_that_of(page: Page, state: GuidedState) -> None:
    """The picture has σ of each gain after each judged block, and the last of each in words."""
    if not state.progress:
        return
    judged_blocks = len(state.progress)
    until(page, f"window.drivegain.guided?.precision?.progress.length === {judged_blocks}")
    points = page.locator("#precision circle:not(.quick)")
    quick_points = page.locator("#precision circle.quick")
    assert points.count() == judged_blocks * len(state.gains)
    if quick_points.count() > 0:
        return
    labels = page.locator("#precision text").all_text_contents()
    last = state.progress[-1]
    for gain, std_percent in zip(state.gains, last.std_percent, strict=True):
        label = f"{gain.axis} {std_percent:.2f} %"
        assert label in labels
