"""Refresh the pictures of the documentation from real commands: `make screenshots`.

Pages are drawn by Chromium (`make browser`); the console's is that of `make test-console`. Terminal pictures are the
output of commands on the simulated cell, as SVG without a remote font. Plots and certificate are those of `make demo`.
A history needs months, so that of the plot is drawn: twenty weekly calibrations, J4 falling from the eleventh on.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import drawings
from PIL import Image
from playwright.sync_api import sync_playwright
from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

from tests.daq.histories import fill, ledger_of

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
DRIVEGAIN = Path(sys.executable).with_name("drivegain")
COLUMNS = 100
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def main() -> int:
    """Refresh all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--demo", type=Path, default=ROOT / "out" / "demo", help="what `make demo` left"
    )
    demo = parser.parse_args().demo.resolve()
    PICTURES.mkdir(exist_ok=True)
    (PICTURES / "house.svg").write_text(drawings.house(), encoding="utf-8")
    (PICTURES / "one-sample.svg").write_text(drawings.one_sample(), encoding="utf-8")
    (PICTURES / "mechanisms.svg").write_text(drawings.mechanisms(), encoding="utf-8")
    _webp(demo / "gains.png", "gains", width=1000)
    _webp(ROOT / "out" / "console" / "desktop.png", "console", width=1000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _terminals(folder, demo)
        _pages(folder, demo)
        _history(folder)
    for picture in sorted(PICTURES.iterdir()):
        sys.stdout.write(f"{picture.stat().st_size / 1000:7.1f} kB  {picture.relative_to(ROOT)}\n")
    return 0


def _terminals(folder: Path, demo: Path) -> None:
    cell = "press-4/cells/press-4.yaml"
    (folder / "mounted.txt").write_text("none\n", encoding="utf-8")
    _run("init press-4 --simulated", folder)
    with _simulated_cell(folder):
        _terminal("scan", f"scan {cell}", folder)
    _terminal("plan", f"plan {cell} --out plan.yaml --duration 14", folder)
    _run(f"plan {cell} --out same.yaml --duration 14 --preview preview.html", folder)
    (folder / "calibration.yaml").symlink_to(demo / "calibration.yaml")
    (folder / "configs").symlink_to(ROOT / "configs")
    _terminal("apply", "apply configs/cells/demo.yaml calibration.yaml", folder, _short_diff)


def _short_diff(lines: list[str]) -> list[str]:
    """The table, the first two changes of the diff, and the last lines."""
    begin = next(number for number, line in enumerate(lines) if "@@" in line)
    return [*lines[: begin + 5], "  …", *lines[-2:]]


def _pages(folder: Path, demo: Path) -> None:
    """The first sheet of report.html, the residual of its effect, and the preview of a plan half-way."""
    shots = (
        ("report", demo / "report" / "report.html", "main", ""),
        ("residual", next(demo.glob("residual-*.svg")), "svg", ""),
        ("preview", folder / "preview.html", "body", "at = last / 2; draw()"),
    )
    with sync_playwright() as playwright:
        # A container's root may not make the namespaces of the browser's sandbox; it opens our own pages alone.
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 920, "height": 1000}, device_scale_factor=1.5)
        for name, source, part, script in shots:
            page.goto(source.as_uri())
            page.evaluate(script)
            page.locator(part).first.screenshot(path=folder / f"{name}.png")
            _webp(folder / f"{name}.png", name, width=820)
        browser.close()


def _history(folder: Path) -> None:
    """A drawn history of the simulated cell, plotted by the command."""
    cell = folder / "press-4" / "cells" / "press-4.yaml"
    text = cell.read_text(encoding="utf-8").replace("name: press-4", "name: demo", 1)
    cell.write_text(text, encoding="utf-8")
    fill(
        ledger_of(cell), 20, lambda week: (1.0, 1.0, 1.0, 1.0 - 0.006 * max(0, week - 10), 1.0, 1.0)
    )
    _run(["history", str(cell), "--axis", "J4", "--plot", "history.png"], folder)
    _webp(folder / "history.png", "history", width=1100)


@contextmanager
def _simulated_cell(folder: Path) -> Iterator[None]:
    """`drivegain simulate` in a process of its own, from its first line on."""
    command = [str(DRIVEGAIN), "simulate", "demo", "--payload-from", "mounted.txt"]
    with subprocess.Popen(
        command, cwd=folder, env=_environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        if process.stdout is None or not process.stdout.readline():
            raise RuntimeError("the simulated cell did not start")
        try:
            yield
        finally:
            process.terminate()
            process.communicate()


def _environment() -> dict[str, str]:
    return os.environ | {"COLUMNS": str(COLUMNS), "FORCE_COLOR": "1", "PYTHONPATH": str(ROOT)}


def _run(arguments: str | list[str], folder: Path) -> str:
    """Standard output of a command that must succeed."""
    words = arguments.split() if isinstance(arguments, str) else arguments
    done = subprocess.run(
        [DRIVEGAIN, *words],
        cwd=folder,
        env=_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(
            f"drivegain {' '.join(words)} ended with {done.returncode}:\n{done.stderr}"
        )
    return done.stdout


def _terminal(
    name: str, arguments: str, folder: Path, shorten: Callable[[list[str]], list[str]] = list
) -> None:
    """A picture of a command and its output."""
    lines = shorten(_run(arguments, folder).rstrip("\n").split("\n"))
    console = Console(
        record=True,
        width=COLUMNS,
        file=io.StringIO(),
        force_terminal=True,
        color_system="truecolor",
    )
    console.print(Text("$ ", "bold green") + Text(f"drivegain {arguments}", "bold"))
    console.print(Text.from_ansi("\n".join(lines)))
    # Rich's template loads its font from the network, and names its maker's site.
    template = re.sub(
        r"@font-face \{\{.*?\}\}\s*|<!--.*?-->\s*", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL
    )
    svg = console.export_svg(title="drivegain", theme=MONOKAI, code_format=template, unique_id=name)
    (PICTURES / f"{name}.svg").write_text(
        svg.replace("Fira Code", "DejaVu Sans Mono"), encoding="utf-8"
    )


def _webp(source: Path, name: str, width: int) -> None:
    """A plot, scaled down."""
    picture = Image.open(source).convert("RGB")
    height = round(picture.height * width / picture.width)
    picture.resize((width, height), Image.Resampling.LANCZOS).save(
        PICTURES / f"{name}.webp", quality=70, method=6
    )


if __name__ == "__main__":
    sys.exit(main())
