"""How long a job waits for axes that a killed recorder left with power."""

from __future__ import annotations

from typing import cast

import pytest

from daq.jobs.context import STOP_S, _wait
from drivers.canopen.network import CanopenNetwork

GUARD_MS = 1500
POWERED = 0x0237
WITHOUT_POWER = 0x0250


class _Link:
    """A bus with a clock of its own, which moves while somebody waits."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000

    def clock(self) -> int:
        return self.now_ns

    def wait(self, seconds: float) -> None:
        self.now_ns += round(1e9 * seconds)


class _Drives:
    """Two drives, of which the second loses its power at some time."""

    axes = ("J1", "J2")
    guard_ms = GUARD_MS

    def __init__(self, powered_s: float) -> None:
        self.link = _Link()
        self.began_ns = self.link.now_ns
        self.powered_s = powered_s

    @property
    def waited_s(self) -> float:
        elapsed_ns = self.link.now_ns - self.began_ns
        return 1e-9 * elapsed_ns

    def statuswords(self) -> tuple[int, int]:
        if self.waited_s < self.powered_s:
            return (WITHOUT_POWER, POWERED)
        return (WITHOUT_POWER, WITHOUT_POWER)


def _left_after_wait(drives: _Drives) -> tuple[tuple[object, int], ...]:
    network = cast(CanopenNetwork, drives)
    left = _wait(network, (("J2", POWERED),))  # type: ignore[arg-type]
    return cast(tuple[tuple[object, int], ...], left)


def test_a_job_waits_for_the_guard_and_for_the_stop_after_it() -> None:
    drives = _Drives(powered_s=1e9)
    assert _left_after_wait(drives) == (("J2", POWERED),)
    expected = 1e-3 * GUARD_MS + STOP_S
    assert drives.waited_s == pytest.approx(expected, abs=0.2)


def test_a_job_goes_on_as_soon_as_no_axis_has_power() -> None:
    drives = _Drives(powered_s=2.0)
    assert _left_after_wait(drives) == ()
    assert drives.waited_s == pytest.approx(2.0, abs=0.2)
