"""Propose compliances and gaps of a flexible gear: where its resonance would lie in the band that the rows can see.

A compliance means nothing by itself: 1e-4 rad/Nm puts the resonance of a heavy link at 10 Hz and that of a wrist at
100 Hz. The dictionary therefore holds elasticity and backlash to first order, which is right far below the resonance,
and this chapter gives each axis the compliances that put the resonance of its mean inertia at some frequencies. As
these are many, they are tried on the joint itself first, and proposed only where one of them explains half of what the
gates require. For backlash, pairs of gap and compliance are tried where the residual gathers at turns of the torque,
and the neighbours of the best pair are proposed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.discovery.candidates import CandidateTrial, SearchProblem, shares_explained
from ident.discovery.gates import Gates
from ident.effects.effect import Effect
from ident.effects.signals import Signals, curvature
from ident.effects.transmission import SETTLED_S, Backlash, Elasticity, spring_torque, twist_acceleration
from ident.equations.rows import decimate_rows

Families = tuple[tuple[Effect, ...], ...]

FREQUENCIES_HZ = (6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0)
"""From below the band of the moves to far above that of the rows, 20 Hz, where the first order is right."""
DAMPING_RATIOS = (0.1, 0.25)
HALF_GAPS_RAD = (2e-4, 3.2e-4, 5e-4, 8e-4, 1.3e-3, 2e-3, 3.2e-3, 5e-3, 8e-3)
FLANKS_HZ = (15.0, 25.0, 40.0)
FLANK_DAMPING = 0.2
SCREENED = 0.5  #: Share of the gates' least share below which nothing is proposed


def propose_resonances(
    search_problem: SearchProblem, gates: Gates, kinds: Collection[type[Effect]] = (Elasticity, Backlash)
) -> Mapping[int, Families]:
    """Return a family of elasticity for each axis whose residual could hold one, and one of backlash.

    Only effects of these kinds are proposed.
    """
    makers = {Elasticity: _elastic, Backlash: _with_gap}
    proposed: dict[int, Families] = {}
    least = SCREENED * gates.smallest_share
    for axis in range(search_problem.axes):
        inertia = float(np.mean([np.mean(run.inertia(axis, axis)) for run in search_problem.runs]))
        if inertia > 0.0:
            found = (make(search_problem, axis, inertia, least) for kind, make in makers.items() if kind in kinds)
            proposed[axis] = tuple(family for family in found if family)
    return {axis: families for axis, families in proposed.items() if families}


def _elastic(search_problem: SearchProblem, axis: int, inertia: float, least: float) -> tuple[Effect, ...]:
    compliances = _compliances(inertia, FREQUENCIES_HZ)

    def bent(run: Signals) -> FloatArray:
        own = run.inertia(axis, axis)
        torque = run.link_torque(axis)
        passed = [spring_torque(torque, own, run.rate_hz, one, DAMPING_RATIOS[-1]) for one in compliances[::2]]
        return np.stack([curvature(one, run.rate_hz) for one in passed])

    if max(shares_explained(search_problem, _tried(search_problem, axis, bent))) < least:
        return ()
    return (Elasticity(), *(Elasticity(one, ratio) for ratio in DAMPING_RATIOS for one in compliances))


def _with_gap(search_problem: SearchProblem, axis: int, inertia: float, least: float) -> tuple[Effect, ...]:
    if _gathered_at_turns(search_problem, axis) < least:
        return ()
    pairs = [(gap, one) for one in _compliances(inertia, FLANKS_HZ) for gap in HALF_GAPS_RAD]
    gaps, compliances = (np.array(values) for values in zip(*pairs, strict=True))

    def bent(run: Signals) -> FloatArray:
        own = run.inertia(axis, axis)
        torque = run.gear_torque(axis)
        return twist_acceleration(torque, own, run.rate_hz, gaps, compliances, FLANK_DAMPING)

    shares = shares_explained(search_problem, _tried(search_problem, axis, bent))
    best = int(np.argmax(shares))
    if shares[best] < least:
        return ()
    flank, place = divmod(best, len(HALF_GAPS_RAD))
    near = [(flank, place + step) for step in (-1, 0, 1)] + [(flank + step, place) for step in (-1, 1)]
    chosen = [
        pairs[len(HALF_GAPS_RAD) * row + column]
        for row, column in near
        if 0 <= row < len(FLANKS_HZ) and 0 <= column < len(HALF_GAPS_RAD)
    ]
    return tuple(Backlash(0.0, gap, one, FLANK_DAMPING) for gap, one in chosen)


def _gathered_at_turns(search_problem: SearchProblem, axis: int) -> float:
    """Share of a motor's squared residual by which rows after a turn of the joint's torque exceed the others.

    Whatever a gap does, it does there; its first order follows the torque so badly that it cannot screen.
    """
    near: list[BoolArray] = []
    for run in search_problem.rows:
        turned = np.diff(np.sign(run.gear_torque(axis)), prepend=0.0) != 0.0
        near.append(np.convolve(turned, np.ones(round(SETTLED_S * run.rate_hz)))[: len(turned)] > 0.0)
    is_near, problem = np.concatenate(near), search_problem.folds.linearisation
    shares = [0.0]
    for motor in np.flatnonzero(search_problem.model.drive_train.to_motor[:, axis]):
        rows = problem.motor == motor
        square, here = problem.residual[rows] ** 2, is_near[problem.source[rows]]
        if here.any() and not here.all():
            shares.append(float(here.sum() * (square[here].mean() - square[~here].mean()) / square.sum()))
    return max(shares)


def _compliances(inertia_kg_m2: float, frequencies_hz: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(f"{1.0 / (inertia_kg_m2 * (2.0 * np.pi * hz) ** 2):.4g}") for hz in frequencies_hz)


def _tried(
    search_problem: SearchProblem, axis: int, bent: Callable[[Signals], FloatArray]
) -> tuple[CandidateTrial | None, ...]:
    """Test twists by their torque on the joint itself, −M_jj δ̈: a sixth of the work of all joints on a six-axis arm."""
    conditioning, runs = search_problem.observation.conditioning, search_problem.runs
    rows = [
        decimate_rows(data, conditioning, -run.inertia(axis, axis) * bent(run))
        for run, data in zip(runs, search_problem.datasets, strict=True)
    ]
    columns = np.concatenate(rows, axis=-1)
    torque = np.zeros((search_problem.axes, *columns.shape))
    torque[axis] = columns
    return search_problem.trials([torque[:, index : index + 1] for index in range(len(columns))])
