"""A fit that grows: the same as one of all rows at once, in any order,
and honest about what nothing fixes yet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.data.run import Run
from ident.equations import joined as joined_module
from ident.equations.joined import join_systems
from ident.equations.reduction import reduce_runs, regrouped
from ident.errors import DataUnfit
from ident.estimators.growing import GrowingFit
from ident.estimators.maximum_likelihood import ml
from ident.estimators.quick import QuickGains, Unknown, quick_gains
from ident.model.bodies import Payload
from tests.ident.closed_recordings import MOUNTED as BODY
from tests.ident.closed_recordings import recorded
from tests.ident.mechanisms import PLANAR
from tests.ident.pieces import first_samples, noisy_pieces
from tests.ident.recordings import CONDITIONING, MOUNTED, FloatArray, Truth
from tests.ident.weighed import RATE_HZ

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])
"""For the arm of three axes."""
MOVE_SAMPLES = 275  #: From one target of `tests.ident.recordings.positions` to the next
LONG_SAMPLES = 11 * MOVE_SAMPLES


@pytest.fixture(scope="module")
def pieces(small_truth: Truth) -> tuple[Run, ...]:
    """Eight short recordings of the arm of three axes."""
    return noisy_pieces(small_truth, 5)


@pytest.fixture(scope="module")
def at_once(small_truth: Truth, pieces: tuple[Run, ...]) -> QuickGains:
    """The gains of all rows in one reduction."""
    standard = reduce_runs(small_truth.model, pieces, SMALL)
    return quick_gains(standard)


@pytest.fixture(scope="module")
def long_runs(small_truth: Truth) -> tuple[Run, ...]:
    """One longer recording without load and one with it."""
    return noisy_pieces(small_truth, 6, count=2, seconds=LONG_SAMPLES / RATE_HZ)


@pytest.fixture(scope="module")
def whole(small_truth: Truth, long_runs: tuple[Run, ...]) -> GrowingFit:
    """Both, each read once at its end."""
    return _grown(small_truth, long_runs)


@pytest.fixture(scope="module")
def labelled(long_runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """Both, with the number of the move of each sample:
    targets change every MOVE_SAMPLES, joints rest halfway.
    """
    move = (np.arange(LONG_SAMPLES) + MOVE_SAMPLES // 2) // MOVE_SAMPLES
    return tuple(replace(run, move=move) for run in long_runs)


@pytest.fixture(scope="module")
def labelled_whole(small_truth: Truth, labelled: tuple[Run, ...]) -> GrowingFit:
    """The same, each read once at its end."""
    return _grown(small_truth, labelled)


def _empty(truth: Truth) -> GrowingFit:
    return GrowingFit(truth.model, SMALL, (MOUNTED,))


def _grown(truth: Truth, runs: tuple[Run, ...]) -> GrowingFit:
    fit = _empty(truth)
    for run in runs:
        fit = fit.with_run(run)
    return fit


def _gains(found: QuickGains) -> FloatArray:
    assert found.gains is not None, found.unknown
    return found.gains


def _std(found: QuickGains) -> FloatArray:
    assert found.gains_std is not None, found.unknown
    return found.gains_std


def _is_unknown(found: QuickGains, reason: Unknown, axes: tuple[int, ...] = ()) -> bool:
    return (
        found.gains is None
        and found.gains_std is None
        and (found.unknown, found.axes) == (reason, axes)
    )


# The same as all rows at once


@pytest.mark.slow
@settings(deadline=None, max_examples=12)
@given(order=st.permutations(range(8)))
def test_pieces_in_any_order_give_the_gains_of_all_rows_at_once(
    small_truth: Truth, pieces: tuple[Run, ...], at_once: QuickGains, order: list[int]
) -> None:
    runs = tuple(pieces[index] for index in order)
    found = _grown(small_truth, runs).gains()
    assert _gains(found) == pytest.approx(_gains(at_once), rel=1e-9)
    # Blocks of correlated neighbours depend on the order of the runs.
    assert _std(found) == pytest.approx(_std(at_once), rel=0.3)


@pytest.mark.slow
@settings(deadline=None, max_examples=12)
@given(lengths=st.lists(st.integers(3, LONG_SAMPLES - 1), max_size=6))
def test_runs_that_were_folded_in_while_they_grew_are_the_whole_runs(
    small_truth: Truth, long_runs: tuple[Run, ...], whole: GrowingFit, lengths: list[int]
) -> None:
    """At any moments: borders change nothing of the size of σ,
    and no row is lost or counted twice.
    """
    fit = _empty(small_truth)
    for run in long_runs:
        for length in sorted(lengths):
            fit = fit.with_run_so_far(first_samples(run, length))
        fit = fit.with_run(run)
    assert fit.standard is not None
    assert whole.standard is not None
    expected = [run.rows for run in whole.runs]
    assert [run.rows for run in fit.runs] == expected
    rows = fit.standard.joints.rows.tolist()
    rows_expected = whole.standard.joints.rows.tolist()
    assert rows == rows_expected
    assert _gains(fit.gains()) == pytest.approx(_gains(whole.gains()), rel=1e-8)
    # Long motion is cut into stretches of two seconds, elsewhere for each look.
    assert _std(fit.gains()) == pytest.approx(_std(whole.gains()), rel=0.3)


@pytest.mark.slow
@settings(deadline=None, max_examples=8)
@given(lengths=st.lists(st.integers(3, LONG_SAMPLES - 1), max_size=6))
def test_a_move_that_a_look_divides_counts_once(
    small_truth: Truth, labelled: tuple[Run, ...], labelled_whole: GrowingFit, lengths: list[int]
) -> None:
    fit = _empty(small_truth)
    for run in labelled:
        assert run.move is not None
        for length in sorted(lengths):
            part = replace(first_samples(run, length), move=run.move[:length])
            fit = fit.with_run_so_far(part)
        fit = fit.with_run(run)
    assert fit.move_count == labelled_whole.move_count
    assert _std(fit.gains()) == pytest.approx(_std(labelled_whole.gains()), rel=1e-6)


def test_rows_near_the_border_wait_and_are_then_those_of_the_whole_run(
    small_truth: Truth, long_runs: tuple[Run, ...]
) -> None:
    run = long_runs[0]
    whole = _empty(small_truth).with_run(run)
    so_far = _empty(small_truth).with_run_so_far(run)
    assert so_far.standard is not None
    assert whole.standard is not None
    waiting = whole.runs[0].rows - so_far.runs[0].rows
    expected = round(0.2 / 0.02)
    assert waiting == expected
    ended = so_far.with_run(run)
    assert ended.runs[0].rows == whole.runs[0].rows
    assert ended.standard is not None
    for one, other in zip(
        ended.standard.joints.factors, whole.standard.joints.factors, strict=True
    ):
        scale = np.abs(other).max()
        assert one.T @ one / scale**2 == pytest.approx(other.T @ other / scale**2, abs=1e-8)


def test_clusters_of_very_many_moves_are_joined_and_say_the_same(
    small_truth: Truth,
    pieces: tuple[Run, ...],
    at_once: QuickGains,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(joined_module, "MAX_CLUSTERS", 8)
    fit = _grown(small_truth, pieces)
    assert fit.move_count <= 16
    assert _gains(fit.gains()) == pytest.approx(_gains(at_once), rel=1e-9)
    assert _std(fit.gains()) == pytest.approx(_std(at_once), rel=0.6)


def test_the_grown_equations_serve_maximum_likelihood(
    small_truth: Truth, pieces: tuple[Run, ...]
) -> None:
    system = _grown(small_truth, pieces).system()
    grown = ml(system)
    standard = reduce_runs(small_truth.model, pieces, SMALL)
    whole = ml(regrouped(standard))
    assert grown.gains == pytest.approx(whole.gains, rel=1e-9)
    assert grown.gains_std == pytest.approx(whole.gains_std, rel=1e-6)


@pytest.mark.slow
def test_a_redundant_robot_grows_too() -> None:
    made = recorded(PLANAR, noise_a=0.02)
    fit = GrowingFit(made.model, made.conditioning, (BODY,))
    for run in made.runs:
        fit = fit.with_run(run)
    whole = reduce_runs(made.model, made.runs, made.conditioning)
    assert fit.standard is not None
    assert len(fit.standard.preload) == len(whole.preload)
    assert _gains(fit.gains()) == pytest.approx(_gains(quick_gains(whole)), rel=1e-9)
    assert _gains(fit.gains()) == pytest.approx(PLANAR.gains, rel=0.1)


# What is not known yet


@pytest.mark.slow
@settings(deadline=None, max_examples=8)
@given(chosen=st.sets(st.sampled_from((0, 3, 4, 7)), min_size=1))
def test_without_a_payload_the_gains_are_unknown_however_much_is_recorded(
    small_truth: Truth, pieces: tuple[Run, ...], chosen: set[int]
) -> None:
    runs = tuple(pieces[index] for index in chosen)
    found = _grown(small_truth, runs).gains()
    assert _is_unknown(found, Unknown.NO_PAYLOAD)
    assert found.std_percent is None


def test_with_a_payload_alone_the_gains_are_unknown(
    small_truth: Truth, pieces: tuple[Run, ...]
) -> None:
    found = _grown(small_truth, pieces[1:3]).gains()
    assert _is_unknown(found, Unknown.NOT_DISTINGUISHED)


def test_an_axis_that_rests_is_named(small_truth: Truth, pieces: tuple[Run, ...]) -> None:
    resting = []
    for run in pieces[:2]:
        position = run.position_rad.copy()
        position[:, 1] = 0.3
        resting.append(replace(run, position_rad=position))
    found = _grown(small_truth, tuple(resting)).gains()
    assert _is_unknown(found, Unknown.NO_MOTION, (1,))
    assert _is_unknown(_empty(small_truth).gains(), Unknown.NO_MOTION)


def test_a_dead_current_is_named(small_truth: Truth, pieces: tuple[Run, ...]) -> None:
    dead = []
    for run in pieces[:4]:
        current = run.current_a.copy()
        current[:, 2] = 0.0
        dead.append(replace(run, current_a=current))
    gains = _grown(small_truth, tuple(dead)).gains()
    assert _is_unknown(gains, Unknown.NO_CURRENT, (2,))


def test_a_few_moves_are_too_few_for_an_error_bar(small_truth: Truth) -> None:
    runs = noisy_pieces(small_truth, 5, count=2, seconds=2.5)
    fit = _grown(small_truth, runs)
    assert fit.move_count < 8
    assert _is_unknown(fit.gains(), Unknown.FEW_MOVES)


def test_a_payload_that_was_not_mounted_does_not_show(
    small_truth: Truth, pieces: tuple[Run, ...]
) -> None:
    bare = tuple(pieces[index] for index in (0, 3, 4, 7))
    said_to_be_loaded = tuple(
        replace(run, name=f"{run.name}, again", payload=MOUNTED) for run in bare[:2]
    )
    runs = (*bare[2:], *said_to_be_loaded)
    found = _grown(small_truth, runs).gains()
    assert _is_unknown(found, Unknown.PAYLOAD_UNSEEN)


# What is refused


def test_a_run_is_in_the_fit_once(small_truth: Truth, pieces: tuple[Run, ...]) -> None:
    fit = _empty(small_truth).with_run_so_far(first_samples(pieces[0], 900)).with_run(pieces[0])
    with pytest.raises(DataUnfit, match="in this fit already"):
        fit.with_run(pieces[0])
    with pytest.raises(DataUnfit, match="in this fit already"):
        fit.with_run_so_far(pieces[0])


def test_a_payload_that_was_not_announced_is_refused(
    small_truth: Truth, pieces: tuple[Run, ...]
) -> None:
    payload = Payload("plate", "b", {"m": 2.0})
    other = replace(pieces[1], payload=payload)
    with pytest.raises(DataUnfit, match="name all payloads"):
        _empty(small_truth).with_run(other)


@pytest.mark.parametrize("samples", [2, 20, 400])
def test_a_run_that_is_too_short_waits_and_is_refused_when_it_ends(
    small_truth: Truth, pieces: tuple[Run, ...], samples: int
) -> None:
    short = first_samples(pieces[0], samples)
    with pytest.raises(DataUnfit):
        _empty(small_truth).with_run(short)
    if samples > 2:
        standard = _empty(small_truth).with_run_so_far(short).standard
        assert standard is None


def test_systems_of_other_payloads_are_not_joined(
    small_truth: Truth, pieces: tuple[Run, ...]
) -> None:
    bare = reduce_runs(small_truth.model, pieces[:1], SMALL)
    loaded = reduce_runs(small_truth.model, pieces[1:2], SMALL)
    with pytest.raises(ValueError, match="expected the same in both"):
        join_systems(bare, loaded)
