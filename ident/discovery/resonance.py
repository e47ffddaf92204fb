"""Propose compliances and gaps of a flexible gear: where its resonance would lie in the band that the rows can see.

A compliance means nothing by itself: 1e-4 rad/Nm puts the resonance of a heavy link at 10 Hz and that of a wrist at
100 Hz. The dictionary therefore holds elasticity and backlash to first order, which is right far below the resonance,
and this chapter gives each axis the compliances that put the resonance of its mean inertia at some frequencies. As
these are many, they are tried on the joint itself first, and proposed only where one of them explains half of what the
gates require. For backlash, pairs of gap and compliance are tried where the residual gathers at turns of the torque,
and the neighbours of the best pair are proposed.

Each is proposed in two forms: the link's friction acts as the motor moves, or holds the link by itself until the gear
pushes it (`ident.effects.twist`). Where the mass matrix of an axis contains the rotor, which does not move behind the
gear, some shares of it are tried as the rotor's inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.discovery.candidates import CandidateTrial, SearchProblem, shares_explained
from ident.discovery.gates import Gates
from ident.discovery.rotor_search import axes_with_rotor_in_load, largest_inertia
from ident.effects.effect import Effect
from ident.effects.rotor import beside_rotor
from ident.effects.signals import Signals, curvature
from ident.effects.transmission import Backlash, Elasticity
from ident.effects.twist import SETTLED_S, Gears, link_of, spring_torque, twists
from ident.equations.rows import decimate_rows

Families = tuple[tuple[Effect, ...], ...]

FREQUENCIES_HZ = (6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0)
"""From below the band of the moves to far above that of the rows, 20 Hz, where the first order is right."""
DAMPING_RATIOS = (0.1, 0.25)
HALF_GAPS_RAD = (2e-4, 3.2e-4, 5e-4, 8e-4, 1.3e-3, 2e-3, 3.2e-3, 5e-3, 8e-3)
FLANKS_HZ = (15.0, 25.0, 40.0)
FLANK_DAMPING = 0.2
HELD_DAMPING = (0.25, 0.1, 0.5)
"""Damping ratios of links that their friction holds; all springs and gaps are tried with the first."""
FLANK_FACTORS = (0.62, 0.79, 1.0, 1.27, 1.6)
"""Of the compliance of the best flank; those of neighbours in the list are 2.7."""
NEAR_FACTORS = (0.72, 0.85, 1.0, 1.18, 1.4)  #: Of the compliance of the best spring: its neighbours in the list are 1.8
ROTOR_SHARES = (0.0, 0.25, 0.5, 0.75)  #: Of the largest inertia that the rotor of an axis can have
SCREENED = 0.5  #: Share of the gates' least share below which nothing is proposed


@dataclass(frozen=True, slots=True)
class Tried:
    """A gear that is tried on a joint."""

    effect: Elasticity | Backlash  #: with the setting of the gear
    frequency: int  #: place of its resonance in the list of frequencies
    share: float  #: that it explains, of a motor's squared residual


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
        return -own * np.stack([curvature(one, run.rate_hz) for one in passed])

    if max(shares_explained(search_problem, _tried(search_problem, axis, bent))) < least:
        return ()
    plain = [Elasticity(one, ratio) for ratio in DAMPING_RATIOS for one in compliances]
    return (Elasticity(), *plain, *_held_springs(search_problem, axis, inertia))


def _held_springs(search_problem: SearchProblem, axis: int, inertia: float) -> list[Effect]:
    """Springs behind which friction holds the link: the best compliance, damping and rotor, and its neighbours."""
    tried: list[Tried] = []
    for rotor in _rotors(search_problem, axis):
        coarse = [Elasticity(one, HELD_DAMPING[0], 1, rotor) for one in _compliances(inertia - rotor, FREQUENCIES_HZ)]
        best = max(_explained(search_problem, axis, coarse, range(len(coarse))), key=lambda one: one.share)
        near = [_rounded(best.effect.resonant_rad_nm * factor) for factor in NEAR_FACTORS]
        for ratio in HELD_DAMPING:
            fine = [Elasticity(compliance, ratio, 1, rotor) for compliance in near]
            tried += _explained(search_problem, axis, fine, range(len(fine)))
    best = max(tried, key=lambda one: one.share)
    return [one.effect for one in tried if _differs_in_compliance(one, best)]


def _differs_in_compliance(one: Tried, best: Tried) -> bool:
    """Whether a spring is the best one, or its neighbour with the same damping and rotor."""
    alike = best.effect.with_settings({"resonant_rad_nm": one.effect.resonant_rad_nm})
    return alike == one.effect and abs(one.frequency - best.frequency) <= 1


def _with_gap(search_problem: SearchProblem, axis: int, inertia: float, least: float) -> tuple[Effect, ...]:
    if _gathered_at_turns(search_problem, axis) < least:
        return ()
    chosen: list[Effect] = []
    for held in (0, 1):
        tried: list[Tried] = []
        for rotor in _rotors(search_problem, axis) if held else (0.0,):
            pairs = [
                (frequency, Backlash(0.0, gap, compliance, FLANK_DAMPING, held, rotor))
                for frequency, compliance in enumerate(_compliances(inertia - rotor, FLANKS_HZ))
                for gap in HALF_GAPS_RAD
            ]
            gears = [gear for _, gear in pairs]
            tried += _explained(search_problem, axis, gears, [frequency for frequency, _ in pairs])
        best = max(tried, key=lambda one: one.share)
        if best.share < least:
            continue
        fine: list[Tried] = []
        for ratio in HELD_DAMPING if held else (FLANK_DAMPING,):
            fine += _explained(search_problem, axis, *_around(best, ratio))
        chosen += _beside(max(fine, key=lambda one: one.share), fine)
    return tuple(chosen)


def _around(best: Tried, damping_ratio: float) -> tuple[list[Elasticity | Backlash], list[int]]:
    """Gaps as large as the best and its neighbours, with stiffer and softer flanks, and the place of each flank."""
    size = HALF_GAPS_RAD.index(best.effect.settings["half_gap_rad"])
    gears: list[Elasticity | Backlash] = []
    places: list[int] = []
    for place, factor in enumerate(FLANK_FACTORS):
        compliance = _rounded(best.effect.resonant_rad_nm * factor)
        for gap in HALF_GAPS_RAD[max(size - 1, 0) : size + 2]:
            gears.append(
                best.effect.with_settings(
                    {"half_gap_rad": gap, "resonant_rad_nm": compliance, "damping_ratio": damping_ratio}
                )
            )
            places.append(place)
    return gears, places


def _beside(best: Tried, tried: Sequence[Tried]) -> list[Effect]:
    """The best gap, its neighbours in size, and those with a stiffer and a softer flank; all with its damping."""
    size = HALF_GAPS_RAD.index(best.effect.settings["half_gap_rad"])
    beside: list[Effect] = []
    for one in tried:
        if one.effect.damping_ratio != best.effect.damping_ratio:
            continue
        sizes_away = abs(HALF_GAPS_RAD.index(one.effect.settings["half_gap_rad"]) - size)
        flanks_away = abs(one.frequency - best.frequency)
        if sizes_away + flanks_away <= 1:
            beside.append(one.effect)
    return beside


def _rotors(search_problem: SearchProblem, axis: int) -> tuple[float, ...]:
    """Inertias to be tried for the rotor of an axis [kg m²]: none where it is no part of the mass matrix."""
    is_known = search_problem.runs[0].rotor_inertia(axis) > 0.0
    if is_known or axis not in axes_with_rotor_in_load(search_problem.observation):
        return (0.0,)
    largest = largest_inertia(search_problem, axis)
    return tuple(float(f"{share * largest:.3g}") for share in ROTOR_SHARES)


def _explained(
    search_problem: SearchProblem, axis: int, gears: Sequence[Elasticity | Backlash], frequencies: Sequence[int]
) -> list[Tried]:
    """Share of the squared residual that gears explain on the joint itself; all have one damping, form and rotor."""
    first = gears[0]
    gaps = np.array([gear.settings.get("half_gap_rad", 0.0) for gear in gears])
    compliances = np.array([gear.resonant_rad_nm for gear in gears])
    several = Gears(gaps, compliances, first.damping_ratio)

    def behind(run: Signals) -> FloatArray:
        signals = beside_rotor(run, axis, first.rotor_inertia_kg_m2)
        found = twists(link_of(signals, axis, held=bool(first.held)), several)
        return found.passed_nm - signals.gear_torque(axis)

    shares = shares_explained(search_problem, _tried(search_problem, axis, behind))
    return [Tried(*one) for one in zip(gears, frequencies, shares, strict=True)]


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
    return tuple(_rounded(1.0 / (inertia_kg_m2 * (2.0 * np.pi * hz) ** 2)) for hz in frequencies_hz)


def _rounded(compliance_rad_nm: float) -> float:
    return float(f"{compliance_rad_nm:.4g}")


def _tried(
    search_problem: SearchProblem, axis: int, added: Callable[[Signals], FloatArray]
) -> tuple[CandidateTrial | None, ...]:
    """Test gears by their torque on the joint itself: a sixth of the work of all joints on a six-axis arm."""
    conditioning, runs = search_problem.observation.conditioning, search_problem.runs
    rows = [
        decimate_rows(data, conditioning, added(run)) for run, data in zip(runs, search_problem.datasets, strict=True)
    ]
    columns = np.concatenate(rows, axis=-1)
    torque = np.zeros((search_problem.axes, *columns.shape))
    torque[axis] = columns
    return search_problem.trials([torque[:, index : index + 1] for index in range(len(columns))])
