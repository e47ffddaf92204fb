"""`make first-certificate`: the commands of README's "Try it" typed at a terminal, and what they
cost: words to read, time of the machine, time of the motion.

    python -m tests.studies.first_certificate [--folder out/first-certificate]

A person needs no time here: each question is answered as soon as it is on the screen. So the time
of the session is that of the machine and of the motion. The time of the motion is that of the logs
of the session, the moves that accept the gains included.

Two counts of words are printed: those of README's section, and those on the screen from the first
command to the certificate. A progress line that is drawn again and again counts once.
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from daq.log.reader import read_log
from tests.studies.output import print_line

README = Path(__file__).parents[2] / "README.md"
SECTION = "Try it"
MASS_KG = "4.59"
LONGEST_S = 3600.0  #: Of the session
STARTED_S = 60.0  #: Until the simulated cell listens
#: What the operator answers to a question that has these words
ANSWERS = {
    "read from the scale": MASS_KG,
    "The same once more": MASS_KG,
    "Check the flange": "",
    "The robot moves now": "",
    "to write to": "yes",
}
#: Codes of a terminal: colours, moves of the cursor, titles
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b\][^\x07]*\x07|\x1b[=>]")
QUESTION = re.compile(r">>> ([^\r\n]*): $")
NUMBERS_AND_BARS = re.compile(r"(?<![A-Za-z-])-?\d[\d.:%/]*|[━╸╺]+")
REDRAWN_LINES = 8  #: So far up may a line be drawn again
MOUNT = re.compile(r"── .*: (.*) ──")


@dataclass(frozen=True, slots=True)
class TryIt:
    """README's section, as a person follows it."""

    text: str  #: all of it, with the commands
    commands: tuple[str, ...]


def try_it(readme: str) -> TryIt:
    """Return the section "Try it" of README and the commands in its block."""
    section = readme.partition(f"## {SECTION}\n")[2].partition("\n## ")[0]
    block = section.split("```")[1]
    lines = block.strip().splitlines()
    commands = tuple(line.partition("#")[0].strip() for line in lines)
    return TryIt(section.strip(), commands)


def words_of(text: str) -> int:
    """Number of words; signs alone are none."""
    return sum(any(letter.isalnum() for letter in word) for word in text.split())


def screen_of(output: str) -> str:
    """Return what a person reads of a terminal's output: of a line that was drawn again, the last
    drawing.
    """
    plain = ESCAPES.sub("", output)
    lines: list[str] = []
    before: list[list[str]] = []
    for line in plain.split("\n"):
        drawn = line.rstrip("\r").rpartition("\r")[2].rstrip()
        # A bar on several lines is drawn again by going up: the same words follow, with other
        # numbers.
        words = NUMBERS_AND_BARS.sub(" ", drawn).split()
        if words and words in before[-REDRAWN_LINES:]:
            continue
        before.append(words)
        lines.append(drawn)
    return "\n".join(lines)


@contextmanager
def simulated_cell(command: str, environment: Mapping[str, str]) -> Iterator[None]:
    """Run the first command of the section as a second terminal does."""
    with subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=dict(environment),
    ) as process:
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], STARTED_S)
            if not ready:
                raise SystemExit(f"{command}: nothing was printed within {STARTED_S:g} s")
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)


def answer_to(question: str) -> str:
    """What the operator types."""
    for words, answer in ANSWERS.items():
        if words in question:
            return answer
    raise SystemExit(f"the session asks what README does not prepare for: {question}")


def typed_session(command: str, environment: Mapping[str, str], mounted: Path) -> str:
    """Type a command at a terminal, mount and answer as the session asks; return all output.

    Raises:
        SystemExit: it did not end with 0 in its time.
    """
    operator_side, session_side = pty.openpty()
    process = subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        stdin=session_side,
        stdout=session_side,
        stderr=session_side,
        env=dict(environment),
        start_new_session=True,
    )
    os.close(session_side)
    output = ""
    answered = 0
    ends_s = time.monotonic() + LONGEST_S
    try:
        while time.monotonic() < ends_s:
            ready, _, _ = select.select([operator_side], [], [], 1.0)
            if ready:
                try:
                    piece = os.read(operator_side, 65536)
                except OSError:  # the session has closed its side
                    break
                if not piece:
                    break
                output += piece.decode("utf-8", "replace")
            plain = ESCAPES.sub("", output[answered:])
            question = QUESTION.search(plain)
            if question is None:
                continue
            wanted = MOUNT.findall(ESCAPES.sub("", output))
            body = "none"
            if wanted and "DISC" in wanted[-1]:
                body = "disc"
            mounted.write_text(f"{body}\n", encoding="utf-8")
            answered = len(output)
            os.write(operator_side, f"{answer_to(question[1])}\n".encode())
        code = process.wait(timeout=30)
    finally:
        if process.poll() is None:
            process.kill()
        os.close(operator_side)
    if code != 0:
        raise SystemExit(f"{command}: exit code {code}\n{output[-3000:]}")
    return output


def motion_s(folder: Path) -> tuple[int, float]:
    """Number of the logs below a folder, and their time together [s]."""
    logs = sorted(folder.rglob("*.mcap"))
    total_s = 0.0
    for log in logs:
        stamps_ns = read_log(log).samples.time_ns
        total_s += 1e-9 * float(stamps_ns[-1] - stamps_ns[0])
    return len(logs), total_s


def main(arguments: Sequence[str] | None = None) -> int:
    """Follow README's section, and print what it costs."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.first_certificate")
    parser.add_argument("--folder", type=Path, help="to work in; a temporary one by default")
    options = parser.parse_args(arguments)
    section = try_it(README.read_text(encoding="utf-8"))
    simulate, init, calibrate = section.commands
    environment = dict(os.environ)
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    environment["COLUMNS"] = "100"
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        mounted = Path("mounted.txt")
        mounted.write_text("none\n", encoding="utf-8")
        with simulated_cell(simulate, environment):
            began_s = time.monotonic()
            printed = subprocess.run(
                ["bash", "-c", init], env=environment, check=True, capture_output=True, text=True
            )
            output = typed_session(calibrate, environment, mounted)
            took_s = time.monotonic() - began_s
        Path("screen.txt").write_text(screen_of(output), encoding="utf-8")
        count, moved_s = motion_s(Path())
    on_screen = words_of(printed.stdout + printed.stderr) + words_of(screen_of(output))
    print_line(f"words of README's section: {words_of(section.text)}")
    print_line(f"words on the screen: {on_screen}")
    print_line(f"questions: {len(re.findall('>>> ', output))}")
    print_line(f"motion: {moved_s:.0f} s in {count} recordings")
    print_line(f"machine: {took_s:.0f} s, {took_s - moved_s:.0f} s more than the motion")
    return 0


if __name__ == "__main__":
    sys.exit(main())
