"""How `tests.vcan.run` finds a kernel for its command; this part needs no CAN."""

from __future__ import annotations

import sys

import pytest

from tests.vcan import run

LEAVE_WITH_7 = (sys.executable, "-c", "raise SystemExit(7)")


def test_where_the_interface_is_the_command_runs_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "INTERFACE", "lo")
    assert run.main(LEAVE_WITH_7) == 7


def test_without_a_kernel_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "INTERFACE", "no-such-interface")
    monkeypatch.setattr("shutil.which", lambda _name: None)
    assert run.main(LEAVE_WITH_7) == run.FAILED
    assert "user-mode-linux iproute2" in capsys.readouterr().err


def test_without_a_command_it_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main(()) == run.FAILED
    assert "python -m tests.vcan.run COMMAND" in capsys.readouterr().err
