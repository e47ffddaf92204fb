"""Axes that an abrupt stop left beyond their limits, and axes that no one would stop:
what the cell file permits.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest

from daq.cli.failure import ErrorParts
from daq.config.cell_file import load_cell
from daq.config.policy import Permission
from daq.errors import ExitCode, exit_code
from daq.log.reader import read_log
from daq.workflow.record import RECOVERY_SPEED, recovery_move
from drivers.errors import MotionRefused
from tests.daq.workflow.test_record import ELBOW, Rig

LIMIT_DEG = 133.0
COUNTS_PER_DEG = 45 * 65536 / 360.0
LIMIT = round(LIMIT_DEG * COUNTS_PER_DEG)
BEYOND = 50  #: counts


@pytest.fixture
def outside(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """The elbow some counts beyond its limit."""
    rig = Rig(checkout, tmp_path, monkeypatch, "lockstep")
    rig.bus.nodes[ELBOW - 1].position = LIMIT + BEYOND
    return rig


def permit(rig: Rig, **policy: str) -> None:
    """Write a policy into the cell file."""
    lines = "".join(f"  {key}: {value}\n" for key, value in policy.items())
    rig.cell_file.write_text(f"{rig.cell_file.read_text()}\npolicy:\n{lines}")


def refused(rig: Rig, *, unguarded: bool = True) -> ErrorParts:
    """The recording is refused, and nothing had power."""
    with pytest.raises(MotionRefused) as caught:
        rig.run(unguarded=unguarded)
    assert not rig.out.exists()
    assert not any(node.powered_cycles for node in rig.bus.nodes)
    assert exit_code(type(caught.value)) == ExitCode.USAGE
    return ErrorParts.of(caught.value)


def test_an_axis_beyond_its_limit_is_a_persons_business(outside: Rig) -> None:
    failure = refused(outside)
    assert failure.found.startswith(f"J{ELBOW} at {LIMIT + BEYOND} counts, {BEYOND} (0.0")
    assert failure.expected == "every axis within its limits"
    assert "by hand" in failure.do
    assert "`policy: {recovery_motion: allowed}`" in failure.do


@pytest.mark.slow
def test_where_the_cell_allows_it_the_axis_goes_slowly_back_and_the_run_begins(
    outside: Rig,
) -> None:
    permit(outside, recovery_motion="allowed")
    done = outside.run()
    assert done.log.valid
    assert [text for text in done.warnings if "brought back slowly" in text]
    first = outside.profiles()[0]
    declared = load_cell(outside.cell_file)
    limits = declared.axes[ELBOW - 1].limits
    scale = 57.29577951308232 * COUNTS_PER_DEG
    velocity, acceleration = struct.unpack_from("<II", first)
    assert 0 < velocity <= RECOVERY_SPEED * 1.01 * limits.velocity * scale
    assert 0 < acceleration <= RECOVERY_SPEED * 1.01 * limits.acceleration * scale
    position_counts = read_log(outside.out).samples.position_counts
    samples = position_counts[:, ELBOW - 1]
    assert samples[0] < LIMIT  # the log begins behind the return


@pytest.mark.parametrize(
    ("place_deg", "remedy"),
    [(LIMIT_DEG + 10.0, "too far for `recovery_motion`"), (-LIMIT_DEG - 10.0, "too far")],
)
def test_an_axis_far_beyond_its_limit_is_a_persons_business_all_the_same(
    outside: Rig, place_deg: float, remedy: str
) -> None:
    permit(outside, recovery_motion="allowed")
    outside.bus.nodes[ELBOW - 1].position = round(place_deg * COUNTS_PER_DEG)
    assert remedy in refused(outside).do


def test_no_motor_of_a_closed_chain_moves_alone(
    outside: Rig, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    permit(outside, recovery_motion="allowed")
    cells_folder = checkout / "configs" / "cells"
    path = cells_folder / "five-bar.yaml"
    chain = load_cell(path).chain
    assert chain is not None
    monkeypatch.setattr(
        "daq.workflow.record.recovery_move",
        lambda cell, *given: recovery_move(replace(cell, chain=chain), *given),
    )
    assert "closed chain" in refused(outside).do


def test_an_open_door_holds_the_recovery_too(outside: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    permit(outside, recovery_motion="allowed")
    monkeypatch.setattr("daq.workflow.record.bring_back", lambda *_: pytest.fail("it moved"))

    asked: list[int] = []

    def opened() -> None:
        asked.append(len(asked))
        if len(asked) == 2:  # closed before the drives were used
            raise MotionRefused("the door is open")

    with pytest.raises(MotionRefused, match="the door is open"):
        outside.run(require_released=opened)


def test_the_policy_for_jobs_moves_no_axis_of_a_person_that_no_one_would_stop(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(checkout, tmp_path, monkeypatch, "lockstep")
    permit(rig, motion="allowed", unguarded="allowed")
    failure = refused(rig, unguarded=False)
    assert "UNGUARDED: J1: no 1016h" in failure.found
    assert "pass --unguarded" in failure.do
    assert "`policy: {unguarded: allowed}`" in failure.do
    assert rig.run(unguarded=True).log.valid


def test_neither_is_part_of_what_a_recording_depends_on(outside: Rig) -> None:
    before = load_cell(outside.cell_file)
    expected = (Permission.REFUSED, Permission.REFUSED)
    assert (before.unguarded, before.recovery_motion) == expected
    permit(outside, unguarded="allowed", recovery_motion="allowed")
    after = load_cell(outside.cell_file)
    assert (after.unguarded, after.recovery_motion) == (Permission.ALLOWED, Permission.ALLOWED)
    assert after.recording_digest == before.recording_digest
