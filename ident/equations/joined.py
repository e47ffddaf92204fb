"""Two systems joined, as if the rows of both had been reduced at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.equations.reduction import MAX_CLUSTERS
from ident.equations.system import System
from ident.equations.triangles import Triangles, triangle

Cluster = tuple[FloatArray, ...]  #: The rows of each motor in one move, or their triangle


def join_systems(first: System, second: System, *, continues_move: bool = False) -> System:
    """Return the system of the rows of both.

    R of two triangles below each other is R of all their rows. The gains do not depend on the order
    of the two. Their σ does where there are very many moves: clusters are then joined with their
    neighbours, as in `reduce_rows`.

    Args:
        first, second: without instruments. A run that has rows in both counts as one run.
        continues_move: the last cluster of the first and the first one of the second are parts of
            one move, which counts as one cluster: its rows are correlated.

    Raises:
        ValueError: they have other unknowns or other payloads.
    """
    if first.unknowns != second.unknowns or first.payloads != second.payloads:
        first_count = len(first.unknowns)
        second_count = len(second.unknowns)
        raise ValueError(
            f"found unknowns {first_count} and {second_count}, payloads {first.payloads} and "
            f"{second.payloads}; expected the same in both"
        )
    new_runs = tuple(name for name in second.runs if name not in first.runs)
    runs = first.runs + new_runs
    cluster_runs = list(first.cluster_runs)
    for run, mounting in second.cluster_runs:
        index = runs.index(second.runs[run])
        cluster_runs.append((index, mounting))
    joints = _join_triangles(first.joints, second.joints)
    motors = _join_triangles(first.motors, second.motors)
    joined = replace(
        first,
        runs=runs,
        joints=joints,
        motors=motors,
        clusters=first.clusters + second.clusters,
        cluster_runs=tuple(cluster_runs),
        preload=first.preload + second.preload,
    )
    last = len(first.clusters) - 1
    if continues_move:
        last_of_first = cluster_runs[last : last + 1]
        first_of_second = cluster_runs[last + 1 : last + 2]
        if last_of_first == first_of_second:
            joined = _join_pairs(joined, [last])
    while len(joined.clusters) > 2 * MAX_CLUSTERS:
        pairs = _neighbours(joined.cluster_runs)
        if not pairs:
            break  # each run has one cluster
        joined = _join_pairs(joined, pairs)
    return joined


def _join_triangles(first: Triangles, second: Triangles) -> Triangles:
    factors: list[FloatArray] = []
    for upper, lower in zip(first.factors, second.factors, strict=True):
        width = upper.shape[1]
        factors.append(triangle((upper, lower), width))
    return Triangles(tuple(factors), first.rows + second.rows)


def _neighbours(cluster_runs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the first of each pair of neighbours in one run; no cluster is in two pairs."""
    pairs: list[int] = []
    index = 0
    while index < len(cluster_runs) - 1:
        if cluster_runs[index] == cluster_runs[index + 1]:
            pairs.append(index)
            index += 1
        index += 1
    return pairs


def _join_pairs(system: System, pairs: Sequence[int]) -> System:
    """Join clusters with the ones that follow them.

    Args:
        system: with the clusters.
        pairs: index of the first cluster of each pair, ascending.
    """
    clusters: list[Cluster] = []
    cluster_runs: list[tuple[int, int]] = []
    preload: list[FloatArray] = []
    index = 0
    is_redundant = bool(system.preload)
    while index < len(system.clusters):
        cluster = system.clusters[index]
        own_preload = system.preload[index : index + 1]
        cluster_runs.append(system.cluster_runs[index])
        if index in pairs:
            following = system.clusters[index + 1]
            cluster = _join_clusters(cluster, following, is_redundant=is_redundant)
            own_preload = system.preload[index : index + 2]
            index += 1
        clusters.append(cluster)
        if own_preload:
            preload.append(np.concatenate(own_preload))
        index += 1
    return replace(
        system, clusters=tuple(clusters), cluster_runs=tuple(cluster_runs), preload=tuple(preload)
    )


def _join_clusters(first: Cluster, second: Cluster, *, is_redundant: bool) -> Cluster:
    """One cluster of two; of a redundant robot with all rows, as each has a preload of its own."""
    joined: list[FloatArray] = []
    for upper, lower in zip(first, second, strict=True):
        if is_redundant:
            joined.append(np.concatenate((upper, lower)))
        else:
            width = upper.shape[1]
            joined.append(triangle((upper, lower), width))
    return tuple(joined)
