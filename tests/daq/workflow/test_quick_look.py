"""Gains after a move: from the samples of the feed, with what is missing before there are any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.config.cell import Cell, model_of
from daq.log.feed import RunFacts, packet_dtype
from daq.workflow.quick_look import BlockMove, GainsSoFar, RunSoFar
from drivers.messages import CellEvent, EventKind
from ident.data.run import Run
from tests.ident.pieces import with_noise
from tests.ident.recordings import GAINS, Truth, record, tx40_truth

CELLS = Path(__file__).parents[3] / "configs" / "cells"
RATE_HZ = 500.0
TARGET_PERCENT = 0.5
COUNT_RAD = 1e-6
RAW_A = 1e-4
PLACE = BlockMove("block-2-loaded", 3, 14)


@pytest.fixture(scope="module")
def nothing(cell: Cell) -> GainsSoFar:
    """Before the first block."""
    return GainsSoFar.of(cell, "disc", TARGET_PERCENT)


@pytest.fixture(scope="module")
def blocks(cell: Cell, nothing: GainsSoFar) -> tuple[Run, ...]:
    """Bare and loaded blocks in turn, with noise."""
    truth: Truth = replace(tx40_truth(), model=model_of(cell))
    rng = np.random.default_rng(4)
    disc = nothing.experiment.payload.payload
    made = []
    for number, payload in enumerate((None, disc, disc), 1):
        clean = record(truth, f"block-{number}", rng, payload, seconds=16.0, rate_hz=RATE_HZ)
        made.append(with_noise(clean, rng))
    return tuple(made)


def _facts(cell: Cell, payload: str | None) -> RunFacts:
    count = len(cell.axes)
    identity = np.eye(count).tolist()
    rad_per_count = [COUNT_RAD] * count
    current_per_unit = [RAW_A] * count
    offset_rad = [0.0] * count
    return RunFacts(
        run_id="id",
        log="block.mcap",
        axes=cell.axis_names,
        rate_hz=RATE_HZ,
        moves=3,
        rad_per_count=rad_per_count,
        current_per_unit=current_per_unit,
        to_joint=identity,
        offset_rad=offset_rad,
        payload=payload,
        bus_load={},
    )


def _rows(cell: Cell, run: Run) -> NDArray[np.void]:
    """The samples of a run as the feed sends them."""
    rows = np.zeros(len(run.time_s), packet_dtype(len(cell.axes)))
    rows["cycle"] = 40 + np.arange(len(rows))
    rows["time_ns"] = np.rint(1e9 * run.time_s).astype(np.int64)
    rows["position_counts"] = np.rint(run.position_rad / COUNT_RAD)
    rows["current_raw"] = np.rint(run.current_a / RAW_A)
    return rows


def _start(number: int, time_s: float) -> CellEvent:
    time_ns = round(1e9 * time_s)
    return CellEvent(time_ns, None, EventKind.MOVE_START, number, "")


def test_the_samples_of_the_feed_are_a_run_in_si(
    cell: Cell, nothing: GainsSoFar, blocks: tuple[Run, ...]
) -> None:
    loaded = blocks[1]
    rows = _rows(cell, loaded)
    rows["missing"][7] = 0b100  # J3 did not answer
    facts = _facts(cell, "disc")
    so_far = RunSoFar(cell, facts, "block-2-loaded")
    assert so_far.run() is None
    so_far.take_event(_start(0, 0.0))
    so_far.take(rows[:100])
    so_far.take_event(_start(1, 0.5))
    so_far.take(rows[100:])
    found = so_far.run()
    assert found is not None
    assert so_far.is_whole
    assert found.payload == nothing.experiment.payload.payload
    np.testing.assert_allclose(found.time_s, loaded.time_s, atol=1e-12)
    np.testing.assert_allclose(found.position_rad, loaded.position_rad, atol=COUNT_RAD)
    np.testing.assert_allclose(found.current_a, loaded.current_a, atol=RAW_A)
    assert found.move is not None
    assert found.valid is not None
    expected = [0] * 250 + [1] * (len(rows) - 250)
    assert found.move.tolist() == expected
    assert np.argwhere(~found.valid).tolist() == [[7, 2]]


@pytest.mark.parametrize("lost", [50, 100], ids=["within a packet", "between two packets"])
def test_a_cycle_that_is_missing_is_noticed(cell: Cell, blocks: tuple[Run, ...], lost: int) -> None:
    rows = np.delete(_rows(cell, blocks[0]), lost)
    facts = _facts(cell, None)
    so_far = RunSoFar(cell, facts, "block-1-bare")
    so_far.take(rows[:100])
    so_far.take(rows[100:200])
    assert not so_far.is_whole


def test_there_are_no_figures_before_both_kinds_of_block_and_half_a_minute(
    nothing: GainsSoFar, blocks: tuple[Run, ...]
) -> None:
    bare, loaded, _ = blocks
    after_bare = nothing.with_run(bare).with_motion(bare)
    first = after_bare.look(PLACE, {})
    assert not first.gains
    assert "no block with DISC" in first.missing
    missing = nothing.with_run(loaded).with_motion(loaded).look(PLACE, {}).missing
    assert "a block without DISC" in missing
    short = replace(after_bare.with_run(loaded).with_motion(loaded), motion_s=29.0)
    assert not short.look(PLACE, {}).gains
    assert "30 s of motion" in short.look(PLACE, {}).missing
    assert short.look(PLACE, {}).motion_s == 29.0


@pytest.mark.slow
def test_after_a_move_each_gain_is_beside_its_target_with_the_worst_first(
    nothing: GainsSoFar, blocks: tuple[Run, ...]
) -> None:
    bare, loaded, _ = blocks
    look = (
        nothing.with_run(bare)
        .with_motion(bare)
        .with_run(loaded)
        .with_motion(loaded)
        .look(PLACE, {})
    )
    assert look.missing == ""
    expected = [TARGET_PERCENT] * len(GAINS)
    target_percent = [gain.target_percent for gain in look.gains]
    assert target_percent == expected
    ratios = [gain.ratio for gain in look.gains]
    assert ratios == sorted(ratios, reverse=True)
    by_axis = {gain.axis: gain for gain in look.gains}
    axis_names = nothing.experiment.cell.axis_names
    for axis, truth in zip(axis_names, GAINS, strict=True):
        found = by_axis[axis]
        difference = abs(found.value - truth)
        assert difference < 5.0 * 0.01 * found.std_percent * abs(truth), axis
    # σ falls as 1/√time.
    assert look.left_s == pytest.approx(look.motion_s * (ratios[0] ** 2 - 1.0))
    assert look.why
    worst = look.gains[0].axis
    known = nothing.with_run(bare).with_motion(bare).with_run(loaded).with_motion(loaded)
    why = known.look(PLACE, {worst: "its current is noisy"}).why
    assert why == "its current is noisy"


@pytest.mark.slow
def test_the_time_left_counts_the_mounting_with_less_motion_twice(
    nothing: GainsSoFar, blocks: tuple[Run, ...]
) -> None:
    """After a short part of the first loaded block, the long bare blocks do not make the rest
    long: σ falls with the loaded motion.
    """
    bare, loaded, _ = blocks
    samples = 6000
    part = replace(
        loaded,
        time_s=loaded.time_s[:samples],
        position_rad=loaded.position_rad[:samples],
        current_a=loaded.current_a[:samples],
    )
    known = nothing.with_run(bare).with_motion(bare).with_run(part).with_motion(part)
    part_s = float(part.time_s[-1])
    look = replace(known, honest_s=0.0).look(PLACE, {})
    ratio = look.gains[0].ratio
    assert ratio > 1.0
    assert look.left_s == pytest.approx(2.0 * part_s * (ratio**2 - 1.0))


@pytest.mark.slow
def test_sigma_goes_on_from_that_of_the_estimator(
    nothing: GainsSoFar, blocks: tuple[Run, ...]
) -> None:
    """An effect that the search has found is noise to the quick estimate:
    its own σ would be several times as large.
    """
    bare, loaded, again = blocks
    known = nothing.with_run(bare).with_motion(bare).with_run(loaded).with_motion(loaded)
    quick = known.fit.gains().std_percent
    assert quick is not None
    judged = quick * np.array([1.0, 1.0, 0.2, 1.0, 1.0, 1.0])
    continued = known.in_proportion(judged)
    names = nothing.experiment.cell.axis_names
    gains = continued.look(PLACE, {}).gains
    shown = {gain.axis: gain.std_percent for gain in gains}
    assert [shown[name] for name in names] == pytest.approx(judged.tolist())
    raw = {
        gain.axis: gain.std_percent
        for gain in known.with_run(again).with_motion(again).look(PLACE, {}).gains
    }
    later = continued.with_run(again).with_motion(again).look(PLACE, {})
    assert {gain.axis: gain.std_percent for gain in later.gains} == pytest.approx(
        {**raw, "J3": 0.2 * raw["J3"]}
    )
    assert nothing.in_proportion(judged).scale is None


@pytest.mark.slow
def test_sigma_falls_while_a_block_grows(nothing: GainsSoFar, blocks: tuple[Run, ...]) -> None:
    bare, loaded, again = blocks
    known = nothing.with_run(bare).with_motion(bare).with_run(loaded).with_motion(loaded)
    before = known.look(PLACE, {})
    growing = known
    looks = []
    for samples in (3000, 8000):
        part = replace(
            again,
            time_s=again.time_s[:samples],
            position_rad=again.position_rad[:samples],
            current_a=again.current_a[:samples],
        )
        growing = growing.with_run(part, is_complete=False)
        looks.append(growing.with_motion(part).look(PLACE, {}))
    assert looks[0].motion_s < looks[1].motion_s
    mean = []
    for look in (before, *looks):
        std_percent = [gain.std_percent for gain in look.gains]
        mean.append(np.mean(std_percent))
    assert mean[2] < mean[0]
