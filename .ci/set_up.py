"""Install the locked packages into the environment of this Python, and show how far it is.

On a terminal one line changes in place; in the log of a continuous integration there is a line every ten seconds.

    .venv/bin/python .ci/set_up.py requirements.lock
"""  # noqa: E501

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import sysconfig
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

LINE_EVERY_S = 10.0
"""In a log; a terminal is redrawn at every change."""
TICK_S = 0.5
_LOCAL_ARCHIVE = re.compile(r"Processing .*?([^/\\]+?)-([^-/\\]+)[^/\\]*\.(?:whl|tar\.gz)")


@dataclass(frozen=True)
class Progress:
    """How far pip is, by what it has said.

    Attributes:
        expected: packages of the lock that this machine needs.
        fetched: packages found so far, newest last.
        megabytes: of their archives.
        unpacking: number of packages that are being unpacked; 0 before that begins.
    """

    expected: int
    fetched: tuple[str, ...] = ()
    megabytes: float = 0.0
    unpacking: int = 0

    def heard(self, line: str) -> Progress:
        """Return the progress after one more line of pip's output."""
        if line.startswith("Ignoring "):  # a package for another system or another Python
            return replace(self, expected=self.expected - 1)
        if found := re.match(r"(?:Collecting|Requirement already satisfied:) ([^ ;]+)", line):
            return replace(self, fetched=(*self.fetched, found[1].replace("==", " ")))
        if found := _LOCAL_ARCHIVE.match(line):
            return replace(self, fetched=(*self.fetched, f"{found[1]} {found[2]}"))
        if found := re.match(r"\s+(?:Downloading|Using cached) .*\(([0-9.]+) ([kM])B\)", line):
            return replace(
                self,
                megabytes=self.megabytes + float(found[1]) / (1000.0 if found[2] == "k" else 1.0),
            )
        if line.startswith("Installing collected packages:"):
            return replace(self, unpacking=line.count(",") + 1)
        return self

    def words(self, unpacked: int) -> str:
        """Return the progress as a person reads it; unpacked is the number of packages in place."""
        if self.unpacking:
            return f"unpacked {min(unpacked, self.unpacking)} of {self.unpacking} packages"
        size = f", {self.megabytes:.0f} MB" if self.megabytes else ""
        newest = f": {self.fetched[-1]}" if self.fetched else ""
        return f"fetched {len(self.fetched)} of {self.expected} packages{size}{newest}"


def packages_in(lock: str) -> int:
    """Return the number of requirements in the text of a lock, those for other machines included."""  # noqa: E501
    return len(re.findall(r"^[^\s#]+==", lock, re.MULTILINE))


def install(lock: Path) -> int:
    """Install a lock; pip's exit code. What pip complains of is shown where it fails."""
    site = Path(sysconfig.get_path("purelib"))
    before = set(site.glob("*.dist-info"))
    # Byte code is compiled when a module is used: to compile all of it would double the time.
    command = [sys.executable, "-m", "pip", "install", "--no-compile", "--progress-bar", "off"]
    pip = subprocess.Popen(
        [*command, "--require-hashes", "--requirement", str(lock)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"},
    )
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    reader = threading.Thread(target=_read, args=(pip, lines), daemon=True)
    reader.start()
    progress, output, show = Progress(packages_in(lock.read_text())), [], _Display()
    while reader.is_alive() or not lines.empty():
        with suppress(queue.Empty):
            output.append(lines.get(timeout=TICK_S))
            progress = progress.heard(output[-1])
        if lines.empty():
            show(progress.words(len(set(site.glob("*.dist-info")) - before)))
    if code := pip.wait():
        show.end("")
        sys.stderr.write(
            "".join(line for line in output if line.startswith(("ERROR", "    ")))
            or "".join(output[-20:])
        )
        return code
    show.end(f"{progress.unpacking} packages installed")
    return 0


class _Display:
    """One line that is redrawn on a terminal; in a log, a line every LINE_EVERY_S."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._shown = ""
        self._shown_at = time.monotonic()

    def __call__(self, words: str) -> None:
        if words == self._shown or not (
            self._terminal or time.monotonic() - self._shown_at >= LINE_EVERY_S
        ):
            return
        sys.stdout.write(f"\r\033[K  {words}" if self._terminal else f"  {words}\n")
        sys.stdout.flush()
        self._shown, self._shown_at = words, time.monotonic()

    def end(self, words: str) -> None:
        """Leave these words, or nothing, in place of the line."""
        sys.stdout.write(("\r\033[K" if self._terminal else "") + (f"  {words}\n" if words else ""))
        sys.stdout.flush()


def _read(pip: subprocess.Popen[str], lines: queue.SimpleQueue[str]) -> None:
    for line in pip.stdout or ():
        lines.put(line)


if __name__ == "__main__":
    sys.exit(install(Path(sys.argv[1])))
