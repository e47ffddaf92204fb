"""Output of `make setup` while pip works, and the interpreter of the environment that it makes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from runpy import run_path
from typing import Any

import pytest

SAID = """\
Looking in links: /opt/wheels
Ignoring colorama: markers 'sys_platform == "win32"' don't match your environment
Collecting numpy==2.4.6 (from -r requirements.lock (line 7))
  Downloading numpy-2.4.6-cp311-cp311-manylinux_2_27_x86_64.manylinux_2_28_x86_64.whl (16.2 MB)
Collecting can==4.5 (from -r requirements.lock (line 9))
  Using cached can-4.5-py3-none-any.whl (300 kB)
Processing /opt/wheels/cmeel_qhull-8.0.2.1-1-py3-none-manylinux_2_28_x86_64.whl (from -r requirements.lock (line 12))
Requirement already satisfied: pip==25.0 in ./lib (from -r requirements.lock (line 14)) (25.0)
"""  # noqa: E501


@pytest.fixture
def set_up(checkout: Path) -> dict[str, Any]:
    set_up_path = checkout / ".ci" / "set_up.py"
    return run_path(str(set_up_path))


def test_it_is_said_how_many_packages_of_how_many(set_up: dict[str, Any]) -> None:
    progress = set_up["Progress"](5)
    for line in SAID.splitlines(keepends=True):
        progress = progress.heard(line)
    expected = ["numpy 2.4.6", "can 4.5", "cmeel_qhull 8.0.2.1", "pip 25.0"]
    assert list(progress.fetched) == expected
    assert progress.words(0) == "fetched 4 of 4 packages, 16 MB: pip 25.0"
    progress = progress.heard("Installing collected packages: numpy, can, cmeel_qhull\n")
    assert progress.words(2) == "unpacked 2 of 3 packages"


def test_the_lock_is_counted_with_what_other_machines_need(
    set_up: dict[str, Any], checkout: Path
) -> None:
    lock = (checkout / "requirements.lock").read_text()
    assert set_up["packages_in"](lock) == sum(
        not line.startswith((" ", "#")) for line in lock.splitlines()
    )


def test_what_pip_complains_of_is_shown(checkout: Path, tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text(f"no-such-package==1.0 --hash=sha256:{64 * '0'}\n")
    env = {**os.environ, "PIP_NO_INDEX": "1"}
    set_up_path = checkout / ".ci" / "set_up.py"
    done = subprocess.run(
        [sys.executable, set_up_path, lock],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "ERROR: No matching distribution found for no-such-package==1.0" in done.stderr


INTERPRETER = """\
#!/bin/sh
case "$1 $2" in
    "-c import sys; sys.exit"*) ;;
    "-c "*) echo {version} ;;
    "-m venv") mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
esac
"""
"""An interpreter that makes an environment of itself, and installs nothing into it."""


@pytest.fixture
def makefile(checkout: Path, tmp_path: Path) -> Path:
    """A folder with the Makefile, and the interpreters one and two."""
    for name in ("Makefile", "pyproject.toml", "requirements.lock"):
        shutil.copy(checkout / name, tmp_path)
    for version in ("one", "two"):
        file = tmp_path / version
        file.write_text(INTERPRETER.format(version=version))
        file.chmod(0o755)
    return tmp_path


def set_up_with(
    folder: Path, *arguments: str, environment: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run `make setup`; environment is the PYTHON of the environment variables."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if name not in {"PYTHON", "MAKEFLAGS", "MAKELEVEL"}
    }
    if environment is not None:
        variables["PYTHON"] = environment
    command = ["make", "setup", *arguments]
    return subprocess.run(
        command, cwd=folder, env=variables, capture_output=True, text=True, check=False
    )


def interpreter_of(environment: Path) -> str:
    """Return which interpreter an environment was made by."""
    python_folder = environment / "bin" / "python"
    said = subprocess.run(
        [python_folder, "-c", "which"], capture_output=True, text=True, check=True
    )
    return said.stdout.strip()


def test_an_environment_of_another_interpreter_is_made_again(makefile: Path) -> None:
    environment = makefile / ".venv"
    assert set_up_with(makefile, "PYTHON=./one").returncode == 0
    (environment / "of-one").touch()
    assert set_up_with(makefile, "PYTHON=./one").stdout.count("setting up") == 0
    assert (environment / "of-one").exists()
    done = set_up_with(makefile, environment="./two")
    assert done.returncode == 0
    assert ".venv is of another interpreter than ./two and is made again" in done.stdout
    assert interpreter_of(environment) == "two"
    assert not (environment / "of-one").exists()


def test_an_environment_stays_where_no_interpreter_is_named(makefile: Path) -> None:
    set_up_with(makefile, "PYTHON=./two")
    assert "setting up" not in set_up_with(makefile).stdout
    environment = makefile / ".venv"
    assert interpreter_of(environment) == "two"


def test_an_interpreter_that_does_not_run_destroys_no_environment(makefile: Path) -> None:
    set_up_with(makefile, "PYTHON=./one")
    done = set_up_with(makefile, "PYTHON=./three")
    assert done.returncode != 0
    assert "drivegain needs Python 3.11 or later" in done.stderr
    environment = makefile / ".venv"
    assert interpreter_of(environment) == "one"


def test_another_environment_leaves_the_usual_one_as_it_is(makefile: Path) -> None:
    set_up_with(makefile, "PYTHON=./one")
    assert set_up_with(makefile, "PYTHON=./two", "VENV=out/venv-two").returncode == 0
    environment = makefile / "out" / "venv-two"
    assert interpreter_of(environment) == "two"
    assert interpreter_of(makefile / ".venv") == "one"
