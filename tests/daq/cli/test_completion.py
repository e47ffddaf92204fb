"""Shell completion, by pressing the tabulator in a real bash."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.cli.app import VERBS

HANGS_S = 60.0  #: Without a byte from the shell


class Shell:
    """A bash on a terminal of its own, in which `drivegain` can be completed."""

    def __init__(self, folder: Path, checkout: Path) -> None:
        script = folder / "drivegain"
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m daq "$@"\n', encoding="utf-8")
        script.chmod(0o755)
        environment = {
            **os.environ,
            **{
                "PATH": f"{folder}:{os.environ['PATH']}",
                "PYTHONPATH": str(checkout),
                "PS1": "READY ",
                "TERM": "dumb",
            },
        }
        self.terminal, inner = pty.openpty()
        self.process = subprocess.Popen(
            ["bash", "--norc", "--noprofile", "-i"],
            cwd=folder,
            env=environment,
            stdin=inner,
            stdout=inner,
            stderr=inner,
            start_new_session=True,
        )
        os.close(inner)

    def type(self, text: str, until: str) -> str:
        """Type a text and read until a pattern appears."""
        os.write(self.terminal, text.encode())
        heard = ""
        while re.search(until, heard) is None:
            if not select.select([self.terminal], [], [], HANGS_S)[0]:
                pytest.fail(f"after {text!r} the shell says only {heard!r}")
            heard += os.read(self.terminal, 4096).decode(errors="replace")
        return heard

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()
        os.close(self.terminal)


@pytest.fixture
def shell(tmp_path: Path, checkout: Path) -> Iterator[Shell]:
    """Closed at the end."""
    made = Shell(tmp_path, checkout)
    yield made
    made.close()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_verbs_options_and_names_of_files(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "lathe.yaml").touch()
    shell.type("bind 'set enable-bracketed-paste off'; bind 'set bell-style none'\n", "READY $")
    # The shell is found by the process that asks; detection is not what is tested.
    shell.type("export _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION=1\n", "READY $")
    shell.type('eval "$(drivegain --show-completion bash)"; echo "do""ne"\n', "done\r?\n.*READY $")
    shell.type("drivegain mon\t", "monitor ")
    shell.type("lat\t", r"lathe\.yaml ")
    shell.type("--inter\t", "--interval ")
    # An earlier name of a verb has the options of the verb.
    shell.type("\x15drivegain report --besi\t", "--beside ")


@pytest.mark.slow
@pytest.mark.parametrize("shell_name", ["bash", "zsh", "fish"])
def test_each_shell_has_its_script_and_every_verb(shell_name: str, checkout: Path) -> None:
    run = [sys.executable, "-m", "daq"]
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
    }
    script = subprocess.run(
        [*run, "--show-completion", shell_name],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    assert "drivegain" in script.stdout
    asked = {
        **environment,
        **{
            "_DRIVEGAIN_COMPLETE": f"complete_{shell_name}",
            "COMP_WORDS": "drivegain ",
            "COMP_CWORD": "1",
        },
        **{"_TYPER_COMPLETE_ARGS": "drivegain ", "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }
    completed = subprocess.run(run, capture_output=True, text=True, env=asked, check=True)
    found = completed.stdout
    matches = re.findall(r"^\W*([a-z-]+)", found.replace("_arguments '*: :((", ""), re.MULTILINE)
    assert set(matches) >= {verb.name for verb in VERBS}
