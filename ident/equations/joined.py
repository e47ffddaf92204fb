"""Two systems joined: rows that were reduced one after the other, as if all had been reduced at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.equations.reduction import MAX_CLUSTERS
from ident.equations.system import System
from ident.equations.triangles import Triangles, triangle

Cluster = tuple[FloatArray, ...]  #: The rows of each motor in one move, or their triangle


def join_systems(first: System, second: System) -> System:
    """Return the system of the rows of both.

    R of two triangles below each other is R of all their rows. The gains do not depend on the order of the two. Their σ
    does where there are very many moves: clusters are then joined with their neighbours, as in `reduce_rows`.

    Args:
        first, second: without instruments. A run that has rows in both counts as one run.

    Raises:
        ValueError: they have other unknowns or other payloads.
    """
    if first.unknowns != second.unknowns or first.payloads != second.payloads:
        raise ValueError(
            f"found unknowns {len(first.unknowns)} and {len(second.unknowns)}, payloads {first.payloads} and "
            f"{second.payloads}; expected the same in both"
        )
    new_runs = tuple(name for name in second.runs if name not in first.runs)
    runs = first.runs + new_runs
    cluster_runs = list(first.cluster_runs)
    for run, mounting in second.cluster_runs:
        index = runs.index(second.runs[run])
        cluster_runs.append((index, mounting))
    joined = replace(
        first,
        runs=runs,
        joints=_join_triangles(first.joints, second.joints),
        motors=_join_triangles(first.motors, second.motors),
        clusters=first.clusters + second.clusters,
        cluster_runs=tuple(cluster_runs),
        preload=first.preload + second.preload,
    )
    while len(joined.clusters) > 2 * MAX_CLUSTERS:
        fewer = _join_neighbours(joined)
        if len(fewer.clusters) == len(joined.clusters):
            break  # each run has one cluster
        joined = fewer
    return joined


def _join_triangles(first: Triangles, second: Triangles) -> Triangles:
    factors = []
    for upper, lower in zip(first.factors, second.factors, strict=True):
        factors.append(triangle((upper, lower), upper.shape[1]))
    return Triangles(tuple(factors), first.rows + second.rows)


def _join_neighbours(system: System) -> System:
    """Join clusters in pairs that follow each other in one run with one payload."""
    clusters: list[Cluster] = []
    cluster_runs: list[tuple[int, int]] = []
    preload: list[FloatArray] = []
    index = 0
    while index < len(system.clusters):
        run = system.cluster_runs[index]
        following = system.cluster_runs[index + 1 : index + 2]
        end = index + 1
        if following == (run,):
            end = index + 2
        clusters.append(_join_clusters(system.clusters[index:end], is_redundant=bool(system.preload)))
        cluster_runs.append(run)
        if system.preload:
            preload.append(np.concatenate(system.preload[index:end]))
        index = end
    return replace(system, clusters=tuple(clusters), cluster_runs=tuple(cluster_runs), preload=tuple(preload))


def _join_clusters(clusters: Sequence[Cluster], *, is_redundant: bool) -> Cluster:
    """One cluster of one or two; of a redundant robot with all rows, as each has a preload of its own."""
    of_motors = zip(*clusters, strict=True)
    if is_redundant:
        return tuple(np.concatenate(rows) for rows in of_motors)
    return tuple(triangle(rows, rows[0].shape[1]) for rows in of_motors)
