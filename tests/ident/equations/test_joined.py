"""Systems that are joined hold the rows of both: pair by pair, move by move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.data.run import Run
from ident.equations import joined as joined_module
from ident.equations.joined import join_systems
from ident.equations.reduction import reduce_runs
from ident.equations.system import System
from tests.ident.pieces import noisy_pieces
from tests.ident.recordings import CONDITIONING, Truth

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])


@pytest.fixture(scope="module")
def pieces(small_truth: Truth) -> tuple[Run, ...]:
    """Two runs without load, of a few moves each."""
    four = noisy_pieces(small_truth, 5, count=4, seconds=2.6)
    return (four[0], four[3])


@pytest.fixture(scope="module")
def halves(small_truth: Truth, pieces: tuple[Run, ...]) -> tuple[System, System]:
    first = reduce_runs(small_truth.model, pieces[:1], SMALL)
    second = reduce_runs(small_truth.model, pieces[1:], SMALL)
    return first, second


@pytest.fixture(scope="module")
def at_once(small_truth: Truth, pieces: tuple[Run, ...]) -> System:
    return reduce_runs(small_truth.model, pieces, SMALL)


def gram(rows: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> list[float]:
    return list(np.asarray(rows.T @ rows).ravel())


def _of_moves(system: System, *sizes: int) -> System:
    """A system of the first run with moves of so many rows, of two runs in turn."""
    rng = np.random.default_rng(1)
    clusters = []
    for size in sizes:
        clusters.append(tuple(rng.normal(size=(size, 4)) for _ in range(3)))
    return replace(
        system,
        runs=("a", "b"),
        clusters=tuple(clusters),
        cluster_runs=((0, 0),) * len(sizes),
        preload=(),
    )


def test_rows_of_both_are_in_the_triangles_and_counted(
    halves: tuple[System, System], at_once: System
) -> None:
    found = join_systems(*halves)
    for own, whole in (
        (found.joints, at_once.joints),
        (found.motors, at_once.motors),
    ):
        assert own.rows.tolist() == whole.rows.tolist()
        for one, other in zip(own.factors, whole.factors, strict=True):
            product = one.T @ one
            assert_allclose(product, other.T @ other, atol=1e-9 * np.abs(product).max())


def test_runs_and_moves_of_the_second_follow_those_of_the_first(
    halves: tuple[System, System], at_once: System
) -> None:
    found = join_systems(*halves)
    first, second = halves
    assert found.runs == at_once.runs == first.runs + second.runs
    assert found.cluster_runs == (
        *first.cluster_runs,
        *((1, mounting) for _, mounting in second.cluster_runs),
    )
    assert len(found.clusters) == len(first.clusters) + len(second.clusters)
    assert found.clusters[len(first.clusters)] is second.clusters[0]


def test_a_run_in_both_is_one_run(halves: tuple[System, System]) -> None:
    first, _ = halves
    twice = join_systems(first, first)
    assert twice.runs == first.runs
    assert twice.cluster_runs == first.cluster_runs * 2


def test_a_move_that_goes_on_is_one_cluster_of_all_its_rows(halves: tuple[System, System]) -> None:
    first = _of_moves(halves[0], 9, 8)
    second = _of_moves(halves[0], 7, 6)
    apart = join_systems(first, second)
    together = join_systems(first, second, continues_move=True)
    assert len(apart.clusters) == 4
    assert len(together.clusters) == len(together.cluster_runs) == 3
    for motor in range(3):
        both = np.concatenate((first.clusters[1][motor], second.clusters[0][motor]))
        assert gram(together.clusters[1][motor]) == pytest.approx(gram(both))
        assert together.clusters[0][motor] is first.clusters[0][motor]
        assert together.clusters[2][motor] is second.clusters[1][motor]


def test_a_move_of_another_run_does_not_go_on(halves: tuple[System, System]) -> None:
    first = _of_moves(halves[0], 9, 8)
    second = replace(_of_moves(halves[0], 7), cluster_runs=((1, 0),))
    assert len(join_systems(first, second, continues_move=True).clusters) == 3


@pytest.mark.parametrize(("moves", "left"), [(4, 4), (5, 3), (6, 3)])
def test_neighbours_are_joined_once_there_are_more_than_twice_the_most(
    halves: tuple[System, System], monkeypatch: pytest.MonkeyPatch, moves: int, left: int
) -> None:
    monkeypatch.setattr(joined_module, "MAX_CLUSTERS", 2)
    first = _of_moves(halves[0], 5)
    second = _of_moves(halves[0], *[6] * (moves - 1))
    found = join_systems(first, second)
    assert len(found.clusters) == len(found.cluster_runs) == left
    rows = np.concatenate([own[0] for own in (*first.clusters, *second.clusters)])
    joined = np.concatenate([own[0] for own in found.clusters])
    assert gram(joined) == pytest.approx(gram(rows))
    if left == 3:
        pair = np.concatenate((first.clusters[0][0], second.clusters[0][0]))
        assert gram(found.clusters[0][0]) == pytest.approx(gram(pair))


def test_moves_of_different_runs_are_never_joined(
    halves: tuple[System, System], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(joined_module, "MAX_CLUSTERS", 1)
    first = _of_moves(halves[0], 5, 6)
    second = replace(_of_moves(halves[0], 7, 8), cluster_runs=((1, 0), (1, 1)))
    found = join_systems(first, second)
    # Of run "a" two moves are one; those of run "b" have another mounting each.
    assert found.cluster_runs == ((0, 0), (1, 0), (1, 1))


def test_moves_of_a_redundant_robot_keep_all_rows_and_their_preload(
    halves: tuple[System, System],
) -> None:
    rng = np.random.default_rng(3)

    def redundant(*sizes: int) -> System:
        plain = _of_moves(halves[0], *sizes)
        preload = tuple(rng.normal(size=(size, 3, 1)) for size in sizes)
        return replace(plain, preload=preload)

    first = redundant(9, 8)
    second = redundant(7, 6)
    found = join_systems(first, second, continues_move=True)
    both = np.concatenate((first.clusters[1][2], second.clusters[0][2]))
    assert_allclose(found.clusters[1][2], both)
    assert [len(own) for own in found.preload] == [9, 15, 6]
    assert_allclose(found.preload[1], np.concatenate((first.preload[1], second.preload[0])))


def test_systems_of_other_unknowns_are_refused_with_both_numbers(
    halves: tuple[System, System],
) -> None:
    first, second = halves
    count = len(first.unknowns)
    fewer = second.holding({0: 0.0})
    with pytest.raises(ValueError, match=f"found unknowns {count} and {count - 1}, payloads"):
        join_systems(first, fewer)
