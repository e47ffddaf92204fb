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
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

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
from tests.daq.console.feeds import TOKEN, Recording, arrivals, predicting_calibration, served

CHROMIUM = os.environ.get("DRIVEGAIN_CHROMIUM", "")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        not CHROMIUM, reason="DRIVEGAIN_CHROMIUM names no browser; `make test-console` does"
    ),
]
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
    found = page.evaluate(f"""() => new Promise((resolve) => {{
        const end = performance.now() + {1e3 * HEARD_S};
        const look = () => {{
            const met = Boolean({condition});
            if (met || performance.now() > end) resolve(met); else setTimeout(look, 20);
        }};
        look();
    }})""")
    assert found, f"not within {HEARD_S:g} s: {condition}\n{page.inner_text('body')}"


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
        (folder / "faults.yaml").write_text(faults, encoding="utf-8")
        shutil.copytree(checkout / "configs", folder / "configs")
        cells_folder = folder / "configs" / "cells"
        self.cell_file = cells_folder / "demo.yaml"
        given = ("--faults", str(folder / "faults.yaml")) if faults else ()
        simulation = self.start("simulate", *simulated, "--port", "0", *given)
        assert simulation.stdout is not None
        lines = list(iter(simulation.stdout.readline, "\n")) + list(
            iter(simulation.stdout.readline, "\n")
        )
        text = self.cell_file.read_text(encoding="utf-8")
        bus = "".join(lines[lines.index("bus:\n") :])
        self.cell_file.write_text(
            re.sub(r"bus:\n.*?(?=axes:)", bus, text, flags=re.DOTALL), encoding="utf-8"
        )
        self.cell = load_cell(self.cell_file)
        self.plan = folder / "plan.yaml"
        self.log = folder / "run.mcap"
        planned = [
            "plan",
            str(self.cell_file),
            "--out",
            str(self.plan),
            "--duration",
            duration_s,
            "--exchanges",
            "0",
        ]
        assert main(planned) == ExitCode.OK
        calibration = folder / "calibration.yaml"
        save_calibration(predicting_calibration(), calibration)
        self.console = self.start("console", str(self.cell_file), "--calibration", str(calibration))
        assert self.console.stdout is not None
        matches = re.findall(r"http\S+", self.console.stdout.readline())
        self.address = matches[0]
        self.refused: list[str] = []
        self.page = self.opened(browser, width=1280, height=1000)

    def opened(self, browser: Browser, width: int, height: int) -> Page:
        """Open the page; what its browser complains of is kept."""
        page = browser.new_page(viewport={"width": width, "height": height})
        self.stack.callback(page.close)
        page.on("console", lambda message: self.refused.append(message.text))
        page.on("pageerror", lambda error: self.refused.append(str(error)))
        page.on("request", self._note_foreign)
        page.goto(self.address)
        until(page, "window.drivegain.status !== null")
        return page

    def _note_foreign(self, asked: Request) -> None:
        if not asked.url.startswith((self.address, "data:")):
            self.refused.append(asked.url)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command; it is interrupted at the end of the test."""
        process = subprocess.Popen(
            [sys.executable, "-m", "daq", *arguments],
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
            "record", str(self.cell_file), str(self.plan), "--out", str(self.log), "--enable-motion"
        )

    def kept(self) -> Log:
        """The log, or what was saved of it."""
        if self.log.exists():
            return read_log(self.log)
        saved = self.folder / "saved.mcap"
        damaged = self.log.with_name(self.log.name + ".part")
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
        status = shown["status"]
        assert status["samples"] == len(log.samples.cycle)
        assert status["missing"] == sum(log.statistics.missing) > 0
        expected = (log.statistics.lost_cycles, 0)
        assert (status["lost"], status["dropped"]) == expected
        states = [axis["state"] for axis in status["axes"]]
        assert states.count("OPERATION ENABLED") == 0
        # The points: every twentieth cycle of 1 kHz, with the values of the log.
        of_page = log.samples.cycle % 20 == 0
        scale = scaling(made.cell, log.head.readback)
        unit = np.array([axis.unit.si for axis in made.cell.axes])
        position = scale.joint_position(log.samples.position_counts) / unit
        current = log.samples.current_raw * scale.current_per_unit
        points = np.array(shown["points"])
        assert len(points) == shown["received"] == np.count_nonzero(of_page) > 100
        np.testing.assert_allclose(points[:, 1:7], position[of_page], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(points[:, 7:], current[of_page], rtol=0.0, atol=1e-12)
        points_steps = np.diff(points[:, 0])
        np.testing.assert_allclose(points_steps, 0.02, atol=1e-6)
        # The events, in words and with the remedy.
        texts = [event.text for event in log.events]
        names = made.cell.axis_names
        in_page = [event["text"] if event["axis"] is None else f"{event['axis']}: {event['text']}"
                   for event in shown["events"]]  # fmt: skip
        plain = [re.sub(r"^(J\d)(?: \(node \d+\))?: ", r"\1: ", text) for text in texts]
        assert len(shown["events"]) == len(log.events)
        assert all(
            one.endswith(other.partition(": ")[2]) or other in one
            for one, other in zip(in_page, plain, strict=True)
        )
        emergency = next(
            event for event in shown["events"] if event["kind"] == EventKind.EMCY.value
        )
        assert emergency["axis"] == names[2]
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
        currents = list(chain.from_iterable(row[1:7] for row in shown["rows"]))
        assert currents == [] or any(current is not None for current in currents)
        assert made.refused == []


def test_a_page_of_another_site_reads_nothing_and_stops_nothing(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser) as made:
        other = browser.new_page()
        other.route(
            "http://evil.example/",
            lambda route: route.fulfill(body="<p>evil</p>", content_type="text/html"),
        )
        other.goto("http://evil.example/")
        for method in ("GET", "POST"):
            asked = (
                f"fetch('{made.address}stop', {{method: '{method}'}}).then(() => 'read', () => "
                "'refused')"
            )
            assert other.evaluate(asked) == "refused"
        other.close()
        assert made.page.evaluate("window.drivegain.status.stop") is None
        injected = (
            "document.body.append(Object.assign(document.createElement('script'), {text: "
            "'window.evil = 1'}))"
        )
        made.page.evaluate(injected)
        assert made.page.evaluate("window.evil") is None
        assert any("Content Security Policy" in text for text in made.refused)


def test_a_preview_is_a_right_handed_view_from_above(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    cells_folder = checkout / "configs" / "cells"
    cell = cells_folder / "demo.yaml"
    preview = tmp_path / "plan.html"
    planned = [
        "plan",
        str(cell),
        "--out",
        str(tmp_path / "plan.yaml"),
        "--duration",
        "8",
        "--exchanges",
        "0",
    ]
    assert main([*planned, "--preview", str(preview)]) == ExitCode.OK
    page = browser.new_page(viewport={"width": 1000, "height": 1300})
    faults: list[str] = []
    page.on("console", lambda message: faults.append(message.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(preview.as_uri())
    for button in ("From above", "Along y", "Along x", "3-D", "+"):
        page.click(f"button:text-is('{button}')")
        origin, x, y, z = (
            np.array(
                page.evaluate(
                    f"(([see, near]) => [...see({point}), near({point})])(camera(400, 400))"
                )
            )
            for point in ("[0, 0, 0]", "[1, 0, 0]", "[0, 1, 0]", "[0, 0, 1]")
        )
        scale = page.evaluate("camera(400, 400)[2]")
        # Right, up, and towards the viewer are a right-handed frame, so the images of x, y, z must
        # be one as well.
        origins = [one - origin for one in (x, y, z)]
        stacked_origins = np.stack(origins)
        axes = stacked_origins * np.array([1 / scale, -1 / scale, 1.0])
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
    assert page.evaluate(visible) == 8 < count
    list_ = "document.querySelector('#events')"
    assert page.evaluate(f"{list_}.scrollHeight <= {list_}.clientHeight")
    assert page.inner_text("#more-events") == f"Show all {count}"
    page.click("#more-events")
    assert page.evaluate(visible) == count
    assert page.evaluate(f"{list_}.scrollHeight <= {list_}.clientHeight")
    page.click("#more-events")
    assert page.evaluate(visible) == 8
    page.evaluate("window.scrollTo(0, 0)")


def test_a_bar_is_red_for_a_reason(tmp_path: Path, checkout: Path, browser: Browser) -> None:
    with rig(tmp_path, checkout, browser) as made:
        texts = {
            share: made.page.evaluate(
                """(share) => {
                    const status = {axes: [{state: "FAULT", position: -170 + share * 340, current: 0}]};
                    window.drivegain.showAxis(0, status);
                    const card = document.querySelector("#axes article");
                    return [card.querySelector(".values").textContent,
                            card.querySelector(".bar").classList.contains("near")];
                }""",  # noqa: E501
                share,
            )
            for share in (-0.01, 0.01, 0.5, 0.99, 1.01)
        }
    said = {
        share: text.partition(" deg, ")[2].partition("current")[0]
        for share, (text, _) in texts.items()
    }
    expected = {
        -0.01: "below its lower limit, ",
        0.01: "near its lower limit, ",
        0.5: "",
        0.99: "near its upper limit, ",
        1.01: "above its upper limit, ",
    }
    assert said == expected
    assert [red for _, red in texts.values()] == [True, True, False, True, True]


def test_a_simulated_cell_shows_the_rate_of_its_own_time(
    tmp_path: Path, checkout: Path, browser: Browser
) -> None:
    with rig(tmp_path, checkout, browser, duration_s=LONG_S) as made:
        made.record()
        until(
            made.page, "window.drivegain.points.length > 20 && window.drivegain.status.rate_hz > 0"
        )
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


def _state_after_three_blocks(cell: Cell, folder: Path) -> None:
    """A session of `calibrate` that waits for its fourth block."""
    roles = ("bare", "loaded", "held-out", "loaded")
    blocks = tuple(
        Block(
            name=f"block-{number}-{role}",
            payload=None if role == "bare" else "disc",
            mass_kg=None if role == "bare" else 4.59,
            holdout=role == "held-out",
            plan=f"plan-{number}.yaml",
        )
        for number, role in enumerate(roles, 1)
    )
    runs = tuple(
        RecordedRun(name=block.name, sha256="", attempts=1, samples=1, lost_cycles=0, missing=())
        for block in blocks
    )
    gains = tuple(
        GainSoFar(
            axis=axis.name, unit=axis.gain_unit, value=10.0, std_percent=0.9, target_percent=0.5
        )
        for axis in cell.axes
    )
    std_percent = (0.9,) * len(gains)
    progress = Progress(blocks=3, motion_s=60.0, fitted_s=40.0, std_percent=std_percent)
    state = GuidedState(
        session=folder.name,
        cell=cell.name,
        configuration_sha256="",
        began="2026-01-05T02:00:00+00:00",
        attempt_began="2026-01-05T02:00:00+00:00",
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
    gains = [QuickGain(axis.name, axis.gain_unit, 10.0, 0.8, 0.5) for axis in cell.axes]
    look = QuickLook(
        "block-4-loaded", 1, 9, 44.0, gains=gains, why="it needs more moves", left_s=69.0
    )
    feed = Feed(cell_file)
    accepted = arrivals(feed)
    with served(cell_file, cell) as console, feed, browser.new_context() as context:
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{console.port}/{TOKEN}/")
        until(page, "document.getElementById('next-step').textContent.startsWith('DISC')")
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
            condition = (
                "document.getElementById('outlook').textContent.includes('after move "
                f"{number} of 9')"
            )
            until(
                page,
                condition,
            )
        assert page.inner_text("#next-step") == "The robot moves: block-4-loaded"
        assert "J1 is worst (it needs more moves): about 69 s left" in page.inner_text("#outlook")
        # One point of the block that was judged and two of moves since, for each axis.
        assert page.locator("#precision circle").count() == 3 * len(cell.axes)
        assert page.locator("#precision circle.quick").count() == 2 * len(cell.axes)
        feed.finish()
        until(page, "document.getElementById('next-step').textContent.startsWith('DISC')")


BLOCK_S = "10"
TARGET_PERCENT = "1.5"


class Technician:
    """Answers `drivegain calibrate`, and changes what is mounted on the simulated cell."""

    def __init__(self, command: subprocess.Popen[bytes], mounted: Path) -> None:
        self.command = command
        self.mounted = mounted
        self.said = ""
        self.answers = {"Mass of": "4.59", "The same once more": "4.59", "Type yes": "yes"}

    def asked(self) -> str | None:
        """The next question; None at the end of the command."""
        assert self.command.stderr is not None
        while not self.said.rpartition("\n")[2].startswith(">>> ") or not self.said.endswith(": "):
            heard = os.read(self.command.stderr.fileno(), 65536)
            if not heard:
                return None
            self.said += heard.decode()
        return self.said.rpartition("\n>>> ")[2].removesuffix(": ")

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
        given = next(
            (text for begin, text in self.answers.items() if question.startswith(begin)), ""
        )
        self.said += "\n"
        assert self.command.stdin is not None
        self.command.stdin.write(f"{given}\n".encode())
        self.command.stdin.flush()


def newest_state(cell_file: Path, cell: Cell) -> GuidedState:
    """State of the newest session, as its file has it."""
    state = sessions(sessions_folder(cell_file), cell.name)[-1].state
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
        options = ("--enable-motion", "--block", BLOCK_S, "--target", TARGET_PERCENT)
        command = subprocess.Popen(
            [sys.executable, "-m", "daq", "calibrate", str(made.cell_file), *options],
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
                next_step = "document.getElementById('next-step').textContent"
                until(page, f"{next_step}.startsWith('{step}')")
                technician.mount()
                _precision_is_that_of(page, newest_state(made.cell_file, made.cell))
            elif question.startswith("Type yes"):
                until(page, "document.getElementById('next-step').textContent.includes('type yes')")
            technician.answer(question)
        assert command.stdout is not None
        ending = command.stdout.read().decode()
        assert command.wait(timeout=60) == ExitCode.OK, technician.said + ending
        until(page, "document.getElementById('stage').textContent.startsWith('Stage: ended')")
        state = newest_state(made.cell_file, made.cell)
        assert state.acceptance is not None
        assert f"Accepted: {state.acceptance.remark}" in page.inner_text("#outlook")
        for run in state.runs:
            assert run.name in page.inner_text("#stage")
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
    condition = f"window.drivegain.guided?.precision?.progress.length === {len(state.progress)}"
    until(page, condition)
    assert page.locator("#precision circle:not(.quick)").count() == len(state.progress) * len(
        state.gains
    )
    labels = page.locator("#precision text").all_text_contents()
    if page.locator("#precision circle.quick").count() == 0:
        for gain, std_percent in zip(state.gains, state.progress[-1].std_percent, strict=True):
            assert f"{gain.axis} {std_percent:.2f} %" in labels
