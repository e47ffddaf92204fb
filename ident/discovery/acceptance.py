"""Which effects held-out runs confirm: the others leave, one by one,
and the rest is fitted again after each.

`accept_on_holdout` is the entry, after `ident.discovery.loop.find_effects`, which has not seen
these runs. The burden of proof is on the effect:

1. every effect is taken out of the model in turn, everything else is refitted, and both models
   predict the held-out runs; `judge_change` compares their errors on every motor;
2. of what is refuted, the worst leaves, the rest is fitted and judged again: beside it, others may
   have seemed harmful;
3. then of what is undecided, the least certain leaves likewise, because two effects of which either
   does the work seem useless, each beside the other;
4. what is left must together lower the held-out error of the model without effects, and raise it on
   no motor; else all of it leaves.

Effects that the cell declares are not judged: it is known that they are there.

What left undecided may be true, and σ of the gains contains what it would move
(`ident.discovery.choice`). What is left must pass the gates of the search again
(`ident.discovery.loop.end_search`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import require_entries, require_flag, require_progress, takes
from ident.discovery.before_after import compare_on_holdout, error_on
from ident.discovery.candidates import ColumnCache
from ident.discovery.effect_verdict import EffectVerdict, Judgement, judge_change
from ident.discovery.evidence import Evidence, place_names, with_effects
from ident.discovery.gates import Gates, require_gates
from ident.discovery.joining import FIT_ERRORS, JointFit, linearised
from ident.discovery.loop import Step, end_search
from ident.effects.effect import GearSide, PlacedEffect
from ident.effects.geometry_corrections import is_correction
from ident.estimators.estimate import RelativeError
from ident.estimators.identify import estimate_with
from ident.model.model import DriveTrain


@takes(
    start=Evidence,
    steps=Sequence,
    gates=Gates | None,
    rng=np.random.Generator | None,
)
def accept_on_holdout(
    start: Evidence,
    steps: Sequence[Step],
    *,
    gates: Gates | None = None,
    rng: np.random.Generator | None = None,
    write_undecided: bool = False,
    progress: Callable[[str], None] = lambda _: None,
    axes: Sequence[str] = (),
) -> tuple[Step, ...]:
    """Take out of the last model what held-out runs do not confirm.

    The command line does this before it writes a calibration; `calibration_of` takes the steps that
    this returns.

    Args:
        start: the model that the search began with, with the effects that the cell declares. It
            holds the held-out runs (`gather(..., holdout=...)`).
        steps: of `find_effects`, from there.
        gates: limits of the search.
        rng: of the bootstrap, by which what is left is tested again; one with the seed 0 when None.
        write_undecided: keep effects that held-out runs neither confirm nor refute.
        progress: called with a description of each step.
        axes: their names in it; those of the robot's joints when empty.

    Returns:
        the same steps; the last one has the model with what is left, and the verdicts. The steps as
        they are where nothing was found, or nothing was held out.

    Raises:
        NotConverged, RankDeficient: see `ident.identify`.
    """
    require_entries("steps", steps, Step, "give the result of ident.find_effects")
    require_progress(progress)
    require_flag("write_undecided", write_undecided)
    gates = gates or Gates()
    require_gates(gates)
    names = place_names(start.model, axes)
    if not steps or start.holdout is None:
        return tuple(steps)
    found = steps[-1].after
    if len(found.effects) == found.declared:
        return tuple(steps)
    verdicts: dict[PlacedEffect, EffectVerdict] = {}
    bootstrap = rng or np.random.default_rng(0)
    last = steps[-1]
    to_judge = found
    while True:
        kept = _judged(
            start,
            to_judge,
            verdicts,
            write_undecided=write_undecided,
            progress=progress,
            names=names,
        )
        if kept.effects != last.after.effects:
            undecided = _undecided(found, kept, verdicts)
            model = _fitted_again(start, found, kept)
            last = _ended_again(steps, last, model, gates, bootstrap, undecided)
        # What no longer passes in this fit has left: the effects beside it are judged again.
        is_pruned = len(last.after.effects) < len(kept.effects)
        if not is_pruned:
            break
        to_judge = last.after
    written = last.after.effects
    ordered: list[EffectVerdict] = []
    for placed in found.effects:
        if placed in verdicts:
            verdict = replace(verdicts[placed], written=placed in written)
            ordered.append(verdict)
    return (*steps[:-1], replace(last, verdicts=tuple(ordered)))


def _fitted_again(start: Evidence, found: Evidence, kept: Evidence) -> JointFit:
    """The model of the search refitted with the effects that are kept alone; where nothing can be
    fitted without one that leaves, the model without effects.
    """
    if kept is start:
        refitted = start
    else:
        refitted = with_effects(found, kept.effects)
    return linearised(refitted, ColumnCache())


def _ended_again(
    steps: Sequence[Step],
    last: Step,
    model: JointFit,
    gates: Gates,
    rng: np.random.Generator,
    undecided: Sequence[PlacedEffect],
) -> Step:
    """The end of the search with fewer effects: what fails its gates now leaves, too.

    Args:
        steps: of the search.
        last: the end before, of the search or of an earlier call.
        model: with the effects that are left.
        gates: of the search.
        rng: of the bootstrap.
        undecided: effects that have left and may be true.
    """
    left_open = tuple(dict.fromkeys((*last.left_open, *undecided)))
    # Each end begins with what the search has set aside; earlier calls have set aside more.
    aside_by_earlier = last.set_aside[len(steps[-1].set_aside) :]
    ended = end_search(steps, model, gates, rng=rng, left_open=left_open)
    return replace(ended, set_aside=(*ended.set_aside, *aside_by_earlier))


def _undecided(
    found: Evidence, left: Evidence, verdicts: Mapping[PlacedEffect, EffectVerdict]
) -> tuple[PlacedEffect, ...]:
    """Effects that a search has found, and that left although held-out runs do not refute them."""
    undecided: list[PlacedEffect] = []
    for placed in found.effects:
        if placed not in verdicts or placed in left.effects:
            continue
        if verdicts[placed].judgement is Judgement.UNDECIDED:
            undecided.append(placed)
    return tuple(undecided)


def _judged(
    start: Evidence,
    found: Evidence,
    verdicts: dict[PlacedEffect, EffectVerdict],
    *,
    write_undecided: bool,
    progress: Callable[[str], None],
    names: Sequence[str],
) -> Evidence:
    """The model with those effects that held-out runs confirm.

    `verdicts` is given what they say of each.
    """
    current = found
    while len(current.effects) > current.declared:
        searched = current.effects[current.declared :]
        if len(searched) == 1:
            progress("judging 1 effect on held-out runs")
        else:
            progress(f"judging {len(searched)} effects on held-out runs")
        judged = [_verdict(start, current, placed) for placed in searched]
        verdicts |= {one.placed: one for one in judged}
        leaving = _leaving(judged, write_undecided=write_undecided)
        if leaving is None:
            break
        name = leaving.placed.name_among(names)
        progress(f"{name} leaves: {leaving.reason}")
        if leaving.is_needed:
            reason = f"nothing can be fitted without {name}, which leaves: {leaving.reason}"
            for one in judged:
                if one.placed != leaving.placed:
                    undecided = replace(one, judgement=Judgement.UNDECIDED, reason=reason)
                    verdicts[one.placed] = undecided
            return start
        current = _without(current, leaving.placed)
    left = current.effects[current.declared :]
    if not left:
        return current
    why = _loses(start, current)
    if not why:
        return current
    progress(f"the effects together leave: {why}")
    reason = f"together with the other effects: {why}"
    for placed in left:
        verdicts[placed] = replace(verdicts[placed], judgement=Judgement.REFUTED, reason=reason)
    return start


def _verdict(start: Evidence, current: Evidence, placed: PlacedEffect) -> EffectVerdict:
    """Judge an effect beside the others; all together where they cannot be fitted without it."""
    is_needed = False
    try:
        without = _without(current, placed)
    except FIT_ERRORS:
        without = start
        is_needed = True
    change = compare_on_holdout(start, without, current)
    motor = _own_motor(placed, current.model.drive_train)
    judgement, reason = judge_change(change, motor)
    return EffectVerdict(
        placed=placed,
        judgement=judgement,
        reason=reason,
        change=change,
        before=_torque_error(without),
        after=_torque_error(current),
        is_needed=is_needed,
    )


def _own_motor(placed: PlacedEffect, drive_train: DriveTrain) -> int | None:
    """Index of the motor whose error an effect must lower; None where it is no single one.

    Motors may be numbered in another order than the joints that they turn.
    """
    # A correction of the description changes all motors: that its own falls is no more than
    # friction there does.
    if not placed.effect.has_axis or is_correction(placed):
        return None
    if placed.effect.side is GearSide.MOTOR:
        return placed.axis
    joints = drive_train.joints
    if placed.axis not in joints:
        return None
    return joints.index(placed.axis)


def _leaving(judged: Sequence[EffectVerdict], *, write_undecided: bool) -> EffectVerdict | None:
    """The worst of what is refuted; else the least certain that is undecided and not written."""
    refuted = [one for one in judged if one.judgement is Judgement.REFUTED]
    if refuted:
        return max(refuted, key=lambda one: one.change.largest_sigmas)
    undecided = [one for one in judged if one.judgement is Judgement.UNDECIDED]
    if undecided and not write_undecided:
        return max(undecided, key=lambda one: one.change.total.sigmas)
    return None


def _loses(start: Evidence, end: Evidence) -> str:
    """Why effects together are no better on held-out runs than none; empty where they are."""
    harm = compare_on_holdout(start, start, end).harm("held-out runs")
    if harm:
        return harm
    if start.holdout is None or end.holdout is None:
        return ""
    weights_nm_a = start.estimate.gains
    before = error_on(start.holdout, start.estimate).relative(weights_nm_a).total
    after = error_on(end.holdout, end.estimate).relative(weights_nm_a).total
    if after < before:
        return ""
    return f"the error on held-out runs is {after:.2f} % with them, {before:.2f} % without"


def _without(evidence: Evidence, left_out: PlacedEffect) -> Evidence:
    """Refit without one effect, the columns of the others as they are.

    These hold the load and the current that the model with it predicts, so that the comparison
    shows the effect alone.
    """
    others = tuple(placed for placed in evidence.effects if placed != left_out)
    if is_correction(left_out):
        # The description is what it was without it, and with it all columns
        return with_effects(evidence, others)
    names = {column.name for column in left_out.columns}
    bare = len(evidence.rows_without_effects.columns)
    added = evidence.training.columns[bare:]
    stays = np.array([column.name not in names for column in added], dtype=np.bool_)
    staying = [column for column in added if column.name not in names]
    first = evidence.training
    columns = (*first.columns[:bare], *staying)
    training = replace(first, columns=columns, effects=first.effects[:, stays])
    holdout = evidence.holdout
    if holdout is not None:
        holdout = replace(holdout, columns=training.columns, effects=holdout.effects[:, stays])
    with_all = evidence.estimate
    estimate = estimate_with(with_all.method, training.system(), with_all.fixed_gains)
    return replace(evidence, training=training, holdout=holdout, effects=others, estimate=estimate)


def _torque_error(evidence: Evidence) -> RelativeError:
    error = evidence.holdout_error
    if error is None:
        raise ValueError("two models can be compared on held-out rows only if runs were held out")
    return error
