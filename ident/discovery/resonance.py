"""Propose compliances and gaps of a flexible gear, with resonances that the rows can show.

A compliance means nothing by itself: 1e-4 rad/Nm puts the resonance of a heavy link at 10 Hz and
that of a wrist at 100 Hz. The dictionary therefore holds elasticity and backlash to first order,
which is right far below the resonance, and this chapter gives each axis the compliances that put
the resonance of its mean inertia at some frequencies. As these are many, they are tried on the
joint itself first, and proposed only where one of them explains half of what the gates require. For
backlash, pairs of gap and compliance are tried where the residual gathers at turns of the torque,
and the neighbours of the best pair are proposed.

What was chosen gets its form and its finer settings in `refined_gear`: the link's friction acts as
the motor moves, or holds the link by itself until the gear pushes it (`ident.effects.twist`). Where
the mass matrix of an axis contains the rotor, which does not move behind the gear, some shares of
it are tried as the rotor's inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.discovery.candidate_fits import CandidateFit
from ident.discovery.candidates import SearchProblem, shares_explained
from ident.discovery.gates import Gates
from ident.discovery.refinement import is_strictly_possible
from ident.discovery.rotor_search import axes_with_rotor_in_load, largest_rotor_inertia
from ident.effects.effect import Effect
from ident.effects.rotor import beside_rotor
from ident.effects.signals import Signals, curvature
from ident.effects.transmission import Backlash, Elasticity
from ident.effects.twist import SETTLED_S, Gears, link_of, spring_torque, twists
from ident.equations.rows import torques_at_rows

Families = tuple[tuple[Effect, ...], ...]

FREQUENCIES_HZ = (6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0)
"""From below the band of the moves to far above that of the rows, 20 Hz,
where the first order is right.
"""
DAMPING_RATIOS = (0.1, 0.25)
HALF_GAPS_RAD = (2e-4, 3.2e-4, 5e-4, 8e-4, 1.3e-3, 2e-3, 3.2e-3, 5e-3, 8e-3)
FLANKS_HZ = (15.0, 25.0, 40.0)
FLANK_DAMPING = 0.2
HELD_DAMPING = (0.1, 0.25, 0.5)  #: Damping ratios of a link that its own friction holds
NEAR_FACTORS = (0.5, 0.62, 0.79, 1.0, 1.27, 1.6, 2.0)  #: Of the compliance that was chosen
GAP_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.4)  #: Of the gap that was chosen
ROTOR_SHARES = (0.0, 0.25, 0.5, 0.75)  #: Of the largest inertia that the rotor of an axis can have
SCREENED = 0.5  #: Share of the gates' least share below which nothing is proposed


def propose_resonances(
    search_problem: SearchProblem,
    gates: Gates,
    kinds: Collection[type[Effect]] = (Elasticity, Backlash),
) -> Mapping[int, Families]:
    """Return families of elasticity and of backlash for each axis whose residual could hold one.

    Only effects of these kinds are proposed.
    """
    makers = {Elasticity: _elastic, Backlash: _with_gap}
    proposed: dict[int, Families] = {}
    least = SCREENED * gates.smallest_share
    for axis in range(search_problem.axes):
        of_runs = [np.mean(run.inertia(axis, axis)) for run in search_problem.runs]
        inertia = float(np.mean(of_runs))
        if not inertia > 0.0:
            continue
        families: list[tuple[Effect, ...]] = []
        for kind, make in makers.items():
            if kind in kinds:
                families.append(make(search_problem, axis, inertia, least))
        found = tuple(family for family in families if family)
        if found:
            proposed[axis] = found
    return proposed


def _elastic(
    search_problem: SearchProblem, axis: int, inertia: float, least: float
) -> tuple[Effect, ...]:
    """A family of elasticity; empty where no compliance explains the least share."""
    compliances = _compliances(inertia, FREQUENCIES_HZ)

    def bent(run: Signals) -> FloatArray:
        """Torque for the acceleration of the link by its bending, of every other compliance."""
        own = run.inertia(axis, axis)
        torque = run.link_torque(axis)
        bending: list[FloatArray] = []
        for compliance in compliances[::2]:
            passed = spring_torque(torque, own, run.rate_hz, compliance, DAMPING_RATIOS[-1])
            bending.append(curvature(passed, run.rate_hz))
        return -own * np.stack(bending)

    shares = shares_explained(search_problem, _tried(search_problem, axis, bent))
    if max(shares) < least:
        return ()
    family: list[Effect] = [Elasticity()]
    for ratio in DAMPING_RATIOS:
        family += (Elasticity(compliance, ratio) for compliance in compliances)
    return tuple(family)


def _with_gap(
    search_problem: SearchProblem, axis: int, inertia: float, least: float
) -> tuple[Effect, ...]:
    """The best pair of gap and compliance with its neighbours; empty where none explains enough."""
    if _gathered_at_turns(search_problem, axis) < least:
        return ()
    gears: list[Effect] = []
    for compliance in _compliances(inertia, FLANKS_HZ):
        gears += (Backlash(0.0, gap, compliance, FLANK_DAMPING) for gap in HALF_GAPS_RAD)
    shares = _explained(search_problem, axis, gears)
    best = int(np.argmax(shares))
    if shares[best] < least:
        return ()
    # A row a compliance, a column a gap.
    gaps = len(HALF_GAPS_RAD)
    row, column = divmod(best, gaps)
    family: list[Effect] = []
    for more_rows, more_columns in ((0, -1), (0, 0), (0, 1), (-1, 0), (1, 0)):
        near_row = row + more_rows
        near_column = column + more_columns
        if 0 <= near_row < len(FLANKS_HZ) and 0 <= near_column < gaps:
            family.append(gears[gaps * near_row + near_column])
    return tuple(family)


def refined_gear(search_problem: SearchProblem, effect: Effect, axis: int) -> Effect:
    """Return a gear that is not rigid in the form, and with the settings, that explain most.

    Any other effect is returned as it is. Both forms are tried: a link whose friction acts as its
    motor moves, and one that its own friction holds.

    Args:
        search_problem: around the model without the effect.
        effect: that was chosen.
        axis: index of its joint.
    """
    if not isinstance(effect, Elasticity | Backlash) or not effect.resonant_rad_nm > 0.0:
        return effect
    as_motor_moves = replace(effect, held=0, sags=1, rotor_inertia_kg_m2=0.0)
    held_by_friction: list[Effect] = []
    for rotor in _rotors(search_problem, axis):
        for ratio in HELD_DAMPING:
            held_by_friction.append(
                replace(effect, held=1, sags=1, rotor_inertia_kg_m2=rotor, damping_ratio=ratio)
            )
    forms: list[Effect] = [effect]
    for starts in ([as_motor_moves], held_by_friction):
        tried: list[Effect] = []
        shares: list[float] = []
        for start in starts:
            gears = gears_around(start)
            tried += gears
            shares += _explained(search_problem, axis, gears)
        forms.append(tried[int(np.argmax(shares))])
    fits = search_problem.fits(search_problem.torque(form, axis) for form in forms)
    falls: list[float] = []
    for tried_form, fit in zip(forms, fits, strict=True):
        fall = 0.0
        if fit is not None and is_strictly_possible(tried_form, fit):
            fall = float(fit.fall_by_motor.sum())
        falls.append(fall)
    return forms[int(np.argmax(falls))]


def gears_around(gear: Effect) -> list[Effect]:
    """Return gears that are stiffer and softer than one, and of other gaps where it has one."""
    around: list[Effect] = []
    if not isinstance(gear, Elasticity | Backlash):
        return around
    for factor in NEAR_FACTORS:
        compliance = _rounded(gear.resonant_rad_nm * factor)
        if isinstance(gear, Elasticity):
            around.append(replace(gear, resonant_rad_nm=compliance))
            continue
        for gap_factor in GAP_FACTORS:
            gap = _rounded(gear.half_gap_rad * gap_factor)
            around.append(replace(gear, resonant_rad_nm=compliance, half_gap_rad=gap))
    return around


def _rotors(search_problem: SearchProblem, axis: int) -> tuple[float, ...]:
    """Inertias to be tried for the rotor of an axis [kg m²].

    None but zero where the rotor is no part of the mass matrix.
    """
    is_known = search_problem.runs[0].rotor_inertia(axis) > 0.0
    if is_known or axis not in axes_with_rotor_in_load(search_problem.observation):
        return (0.0,)
    largest = largest_rotor_inertia(search_problem, axis)
    return tuple(float(f"{share * largest:.3g}") for share in ROTOR_SHARES)


def _explained(search_problem: SearchProblem, axis: int, gears: Sequence[Effect]) -> list[float]:
    """Share of the squared residual that gears explain on the joint itself.

    All of them have one damping, form and rotor.
    """
    common = gears[0].settings
    gaps = np.array([gear.settings.get("half_gap_rad", 0.0) for gear in gears])
    compliances = np.array([gear.settings["resonant_rad_nm"] for gear in gears])
    several = Gears(gaps, compliances, common["damping_ratio"])

    def behind(run: Signals) -> FloatArray:
        """Torque that each gear passes on, beside that of a rigid one."""
        signals = beside_rotor(run, axis, common["rotor_inertia_kg_m2"])
        link = link_of(signals, axis, held=bool(common["held"]))
        return twists(link, several).passed_nm - signals.gear_torque(axis)

    return shares_explained(search_problem, _tried(search_problem, axis, behind))


def _gathered_at_turns(search_problem: SearchProblem, axis: int) -> float:
    """Excess of a motor's squared residual in rows after a turn of the joint's torque, as a share.

    Whatever a gap does, it does there; its first order follows the torque so badly that it cannot
    screen.
    """
    near: list[BoolArray] = []
    for run in search_problem.rows:
        direction = np.sign(run.gear_torque(axis))
        turned = np.diff(direction, prepend=0.0) != 0.0
        settling = np.ones(round(SETTLED_S * run.rate_hz))
        turns_before = np.convolve(turned, settling)[: len(turned)]
        near.append(turns_before > 0.0)
    is_near = np.concatenate(near)
    problem = search_problem.folds.linearisation
    shares = [0.0]
    for motor in np.flatnonzero(search_problem.model.drive_train.to_motor[:, axis]):
        rows = problem.motor == motor
        square = problem.residual[rows] ** 2
        here = is_near[problem.source[rows]]
        if here.all() or not here.any():
            continue
        excess = square[here].mean() - square[~here].mean()
        shares.append(float(here.sum() * excess / square.sum()))
    return max(shares)


def _compliances(inertia_kg_m2: float, frequencies_hz: Sequence[float]) -> tuple[float, ...]:
    """Compliances that put the resonance of an inertia at frequencies, 1/(J ω²) [rad/Nm]."""
    compliances: list[float] = []
    for frequency_hz in frequencies_hz:
        omega_rad_s = 2.0 * np.pi * frequency_hz
        compliances.append(_rounded(1.0 / (inertia_kg_m2 * omega_rad_s**2)))
    return tuple(compliances)


def _rounded(setting: float) -> float:
    return float(f"{setting:.4g}")


def _tried(
    search_problem: SearchProblem, axis: int, added: Callable[[Signals], FloatArray]
) -> tuple[CandidateFit | None, ...]:
    """Fit gears by their torque on the joint itself: a sixth of the work of six joints."""
    conditioning = search_problem.observation.conditioning
    rows: list[FloatArray] = []
    for run, data in zip(search_problem.runs, search_problem.datasets, strict=True):
        rows.append(torques_at_rows(data, conditioning, added(run)))
    columns = np.concatenate(rows, axis=-1)
    torque = np.zeros((search_problem.axes, *columns.shape))
    torque[axis] = columns
    of_each = [torque[:, index : index + 1] for index in range(len(columns))]
    return search_problem.fits(of_each)
