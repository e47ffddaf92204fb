"""The closed loop in sentences, tables and JSON:
the effects that were added, and what they changed.

docs/reference/residual-json.md describes the keys of the document.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table

from daq.errors import counted, first_few
from daq.report.described_geometry import geometry_before_search
from daq.report.effect_names import effect_text, size_text, variable_text
from daq.report.fit import coefficients, error_table, identifiability_notes, sigma_notes
from daq.report.gains import diagnosis_texts, gain_table, partial_note, with_deviation
from daq.report.split_names import names_by_split
from daq.report.text import Sentence, break_lines, plain_table
from daq.workflow.fit import Fit
from daq.writeback.gates.fit import OF_DESCRIPTION
from ident.calibration import AcceptedEffect, Calibration
from ident.discovery.before_after import Account, BeforeAfter, GainShift, RelativeErrors
from ident.discovery.effect_verdict import Judgement
from ident.discovery.gates import runs_to_leave_out
from ident.discovery.gear_loss import CERTAIN, GearLoss, gear_losses, is_gear_loss
from ident.discovery.loop import MAX_EFFECTS, Step
from ident.discovery.noise_floor import FloorSource
from ident.discovery.search import Finding
from ident.discovery.time_skew import CurrentDelay
from ident.drift.change import FALSE_ALARM
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import is_correction
from ident.effects.signals import session_began_s
from ident.effects.unnamed import is_unnamed
from ident.estimators.estimate import RelativeError

_LISTED_CANDIDATES = 6  #: For each turn; the JSON has them all
_LISTED_RIVALS = 3  #: For each effect
MUCH = 0.2
"""Share of the squared residual from which on a candidate that failed a check is named."""
LITTLE = 0.005
"""Share of the squared residual from which on a candidate is named that too few moves show."""
MOST = 0.75  #: Share of the folds on which a candidate that few moves show must lower the error
SLIGHT = 0.1  #: Share of an error; an effect that lowers it by less is said to be small

WHEN = ("before", "after")


def residual_view(
    fitted: Fit, account: Account, calibration: Calibration, *, verbose: bool = False
) -> Iterator[RenderableType]:
    """One screen: what was found, and the gains;
    if verbose, all that the report says of the search, too.
    """
    yield from (Sentence(note, "bold") for note in partial_note(calibration))
    if verbose:
        yield from turns_view(fitted)
        yield from map(Sentence, effect_sizes(calibration))
    sentences = headline_of(fitted, account, calibration.effects)
    if verbose:
        yield from sentences.parts()
    else:
        gain_lines = len(calibration.gains)
        free_lines = SCREEN_LINES - gain_lines - AROUND_SENTENCES
        yield SentenceScreen(sentences, max(free_lines, FEWEST_SENTENCE_LINES))
    statistics = (
        *statistical_sentences(fitted, account),
        *geometry_before_search(fitted, calibration.diagnoses),
        *identifiability_notes(fitted, calibration.payload_mass),
    )
    if verbose:
        yield from map(Sentence, statistics)
        yield ""
        yield before_after_table(account, fitted.cell.axis_names)
    yield ""
    heading = "Drive gains"
    if calibration.effects:
        heading = "Drive gains with the effects"
    yield gain_table(calibration.gains, title=f"{heading}; change % is from the nameplate")
    yield from map(Sentence, sigma_notes(fitted))
    if not verbose:
        yield Sentence(
            "The report (`--report FOLDER`) and `--verbose` have the search, the errors, and "
            f"{counted(len(statistics), 'sentence')} on what these data can and cannot show."
        )


SCREEN_LINES = 40  #: Largest number of lines of a search on a terminal, whatever was found
AROUND_SENTENCES = 17
"""Lines of a terminal of 80 columns besides the sentences and the gains: remarks on the logs, files
replaced and written, heading of the table and empty lines, how well σ is known, what `--verbose`
has, and the next step.
"""
FEWEST_SENTENCE_LINES = 10  #: Of a robot with so many axes that their gains alone fill a screen


@dataclass(frozen=True, slots=True)
class Headline:
    """What a search found, in sentences."""

    #: what is wrong with the recordings or the description, and must be looked at first
    checks: tuple[str, ...]
    effects: tuple[str, ...]  #: each accepted effect with its error before and after
    together: str  #: error of all axes
    judged: tuple[str, ...]  #: effects that held-out runs do not confirm
    #: what explains the rest of an axis best, with a sign or size that cannot be
    impossible: tuple[str, ...]
    refused: tuple[str, ...]  #: effects with which `apply` refuses the calibration
    gains: tuple[str, ...]  #: whether gains have changed
    explained: tuple[str, ...]  #: what the fit before the search named, and the search does not
    to_record: tuple[str, ...]  #: which moves would make uncertain gains better
    ending: tuple[str, ...]  #: time skew, and the verdict of held-out runs

    def sentences(self) -> tuple[str, ...]:
        """Return all of them, in the order in which they are read."""
        in_order = (
            *self.checks,
            *self.effects,
            *self.explained,
            self.together,
            *self.judged,
            *self.impossible,
            *self.refused,
            *self.gains,
            *self.to_record,
            *self.ending,
        )
        # There is no sentence on gains that are held.
        return tuple(sentence for sentence in in_order if sentence)

    def parts(self) -> Iterator[Sentence]:
        """Yield all of them as parts of a view, the checks in bold."""
        for sentence in self.sentences():
            style = "bold" if sentence in self.checks else ""
            yield Sentence(sentence, style)

    def by_weight(self) -> tuple[str, ...]:
        """Return them in the order in which a screen gets them:
        what decides on the calibration comes first.
        """
        first_check = self.checks[:1]
        other_checks = self.checks[1:]
        ordered = (
            self.together,
            *self.refused,
            *first_check,
            *self.ending,
            *self.judged,
            *other_checks,
            *self.effects,
            *self.impossible,
            *self.explained,
            *self.gains,
            *self.to_record,
        )
        return tuple(sentence for sentence in ordered if sentence)


@dataclass(frozen=True, slots=True)
class SentenceScreen:
    """The sentences of a search that fit one screen; the last line counts those that do not."""

    headline: Headline
    room: int  #: lines for them

    def chosen(self, width: int | None) -> tuple[Sentence, ...]:
        """Return the sentences that fit, in their order.

        Args:
            width: columns of the terminal; None of a pipe or file, where a sentence is a line.
        """
        lines_left = self.room
        fitting: set[str] = set()
        for sentence in self.headline.by_weight():
            lines = 1
            if width is not None:
                lines = break_lines(sentence, width).count("\n") + 1
            # The first sentence is shown on any screen.
            if lines <= lines_left or not fitting:
                fitting.add(sentence)
                lines_left -= lines
        parts = tuple(self.headline.parts())
        shown = tuple(part for part in parts if part.text in fitting)
        if len(shown) == len(parts):
            return shown
        more = counted(len(parts) - len(shown), "sentence")
        return (*shown, Sentence(f"{more} more: `--verbose` prints them, and the report has them."))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render as many as fit the terminal."""
        width = options.max_width if console.is_terminal else None
        yield from self.chosen(width)


def effect_sizes(calibration: Calibration) -> Iterator[str]:
    """Yield the name of each effect as in files and commands, its size ± σ,
    and what these data cannot distinguish from it.
    """
    for effect in calibration.effects:
        sentence = f"{effect.axis}: {effect.name}: {size_text(effect, calibration)}"
        rivals = first_few(effect.ambiguity, _LISTED_RIVALS, separator=", ")
        if rivals:
            sentence += f"; not distinguishable from {rivals}"
        yield sentence


def turns_view(fitted: Fit) -> Iterator[RenderableType]:
    """Candidates of each turn of the loop, and the one that was added."""
    declared = list(declared_sentences(fitted))
    yield from map(Sentence, declared)
    for number, step in enumerate(searched_steps(fitted), start=1):
        if number > 1 or declared:
            yield ""
        title = f"Turn {number}: {CANDIDATES}"
        table = plain_table(CANDIDATE_HEADINGS, title=title)
        for row in candidate_rows(fitted, step, _LISTED_CANDIDATES):
            table.add_row(*row)
        yield table
        yield from map(Sentence, turn_sentences(fitted, step))
    yield ""


UNTESTED = "–"  #: In the place of a probability: it rests on too few moves for a test
CANDIDATES = "best candidates on left-out moves, before the refit"
CANDIDATE_HEADINGS = ("effect", "axis", "p", "folds", "explains", "left-out error", "gates")


def searched_steps(fitted: Fit) -> tuple[Step, ...]:
    """Turns of the search, without the steps of effects that the cell declares."""
    return tuple(step for step in fitted.steps if not step.declared)


def candidate_rows(fitted: Fit, step: Step, count: int) -> Iterator[tuple[str, ...]]:
    """Yield the best named candidates of a turn under CANDIDATE_HEADINGS,
    the added one among them.
    """
    for finding in step.ranked(count):
        probability = UNTESTED
        if finding.probability is not None:
            probability = f"{finding.probability:.3f}"
        verdict = "no"
        if finding.passed:
            verdict = "pass"
        yield (
            finding.effect.name,
            fitted.cell.place_names[finding.axis],
            probability,
            f"{100 * finding.folds_better:.0f} %",
            f"{100 * finding.explained:.1f} %",
            f"{finding.error_before_percent:.2f} → {finding.error_after_percent:.2f} %",
            verdict,
        )


def declared_sentences(fitted: Fit) -> Iterator[str]:
    """Name the effects that the cell file declares."""
    for step in fitted.steps:
        if step.declared and step.accepted is not None:
            name = step.accepted.placed.name_among(fitted.cell.place_names)
            yield f"Declared in the cell file: {name}."


def turn_sentences(fitted: Fit, step: Step) -> Iterator[str]:
    """Say what a turn of the search added, and what it refused and why."""
    places = fitted.cell.place_names
    for rejected in step.set_aside:
        finding = rejected.finding
        name = effect_text(finding.effect, places)
        yield f"Not added to {places[finding.axis]}: {name}: {rejected.reason(places)}."
    added = step.accepted
    if added is None:
        yield "No candidate passes every gate; nothing is added."
    else:
        yield f"Added to {places[added.axis]}: {effect_text(added.effect, places)}."


def before_after_table(account: Account, axes: tuple[str, ...]) -> Table:
    """Relative error of each axis before and after, and what noise alone would leave."""
    return error_table("Relative error of the motor currents by ml [%]", axes, error_rows(account))


def summary(fitted: Fit, account: Account, effects: Sequence[AcceptedEffect]) -> tuple[str, ...]:
    """Summarise in sentences: what `residual` prints, then what it prints with `--verbose`.

    Args:
        fitted: with the turns of the loop.
        account: of these turns.
        effects: of the calibration, with the errors that the gate of an effect compares.
    """
    headline = headline_of(fitted, account, effects).sentences()
    return (*headline, *statistical_sentences(fitted, account))


def headline_of(fitted: Fit, account: Account, effects: Sequence[AcceptedEffect]) -> Headline:
    """Say what to check first, each accepted effect, all axes together, the gains,
    and what held-out runs refute.

    The arguments are those of `summary`. The diagnoses come first, a sentence each.
    """
    in_model = fitted.steps[-1].after.effects
    checks = list(diagnosis_texts(fitted.diagnoses))
    if any(is_correction(placed) for placed in in_model):
        # Its gains are right, although the cell file is not yet.
        checks.append(
            "The model corrects the description of the robot: gains and errors below are those of "
            "the corrected one. Correct the cell file all the same, and fit again."
        )
    effect_sentences = _effect_sentences(fitted, account)
    judged = tuple(verdict_sentences(fitted))
    to_record = []
    for gain in fitted.uncertain:
        axis = fitted.cell.axis_names[gain.axis]
        to_record.append(f"Excitation: {gain.words(axis)}.")
    refused: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()
    if effect_sentences:
        refused = tuple(_refused_by_apply(effects))
        gains = (gains_sentence(fitted, account),)  # an empty one for held gains
    return Headline(
        checks=tuple(checks),
        effects=effect_sentences,
        together=_together_sentence(
            account, has_effects=bool(effect_sentences), is_judged=bool(judged)
        ),
        judged=judged,
        impossible=_impossible_sentences(fitted),
        refused=refused,
        gains=gains,
        explained=tuple(_explained_checks(fitted, account)),
        to_record=tuple(to_record),
        ending=(*_skew_sentence(account.skew), *_holdout_verdict(fitted, account)),
    )


def _effect_sentences(fitted: Fit, account: Account) -> tuple[str, ...]:
    """Return a sentence for each effect that a turn has added and the last model still has."""
    in_model = fitted.steps[-1].after.effects
    sentences = []
    for step, turn in zip(fitted.steps, account.turns, strict=True):
        if step.accepted is None or turn is None:
            continue
        for placed in turn.added:
            if placed in in_model:
                sentences.append(_effect_sentence(fitted, account, turn, placed, step))
    return tuple(sentences)


def _together_sentence(account: Account, *, has_effects: bool, is_judged: bool) -> str:
    """Return the error of all axes together, and how much of it noise leaves.

    Args:
        account: of the search.
        has_effects: whether the model has effects of the search.
        is_judged: whether effects were found that held-out runs do not confirm.
    """
    before, _ = _strictest_error(account.total.before)
    after, where = _strictest_error(account.total.after)
    noise = ""
    noise_text = _noise_text(account)
    if noise_text != UNKNOWN_NOISE:
        noise = f" ({noise_text})"
    if has_effects:
        change = error_change_text(before.total, after.total)
        return f"All axes together: the error {where} {change}{noise}{_rise_within_noise(account)}."
    if is_judged:
        outcome = "No effect is confirmed"
    else:
        outcome = "No structure found"
    return f"{outcome}: the error {where} is {after.total:.1f} %{noise}."


def _explained_checks(fitted: Fit, account: Account) -> Iterator[str]:
    """Yield what the fit before the search has named and the fit with the effects does not,
    with the errors of its axes.
    """
    still_named = {(diagnosis.name, diagnosis.axes) for diagnosis in fitted.diagnoses}
    # Axes of which the fit with the effects says that their description is wrong: what the earlier
    # fit said of it is the same mistake under another name.
    described_wrong: set[str] = set()
    for diagnosis in fitted.diagnoses:
        if diagnosis.name in OF_DESCRIPTION:
            described_wrong.update(diagnosis.axes)
    for earlier in fitted.diagnoses_before:
        if (earlier.name, earlier.axes) in still_named:
            continue
        if earlier.name in OF_DESCRIPTION and not described_wrong.isdisjoint(earlier.axes):
            continue
        subject = ", ".join((*earlier.runs, *earlier.axes)) or "the fit"
        changes: list[str] = []
        for axis in earlier.axes:
            place = fitted.cell.axis_names.index(axis)
            before, where = _strictest_error(account.total.before, place)
            after, _ = _strictest_error(account.total.after, place)
            change = error_change_text(before.at(place), after.at(place))
            changes.append(f"the error of the current of {axis} {where} {change}")
        errors = ""
        if changes:
            errors = f": {'; '.join(changes)}"
        check = f"CHECK {subject}: {earlier.found} ({earlier.name})"
        yield f"Without the effects, the fit said {check}. With them it does not{errors}."


def verdict_sentences(fitted: Fit) -> Iterator[str]:
    """Name the effects that were found and that held-out runs do not confirm,
    with the errors that show it.
    """
    for verdict in fitted.steps[-1].verdicts:
        if verdict.judgement is Judgement.CONFIRMED and verdict.written:
            continue
        name = verdict.placed.name_among(fitted.cell.place_names)
        evidence = f"{verdict.reason}; {verdict.error_text()}"
        if verdict.judgement is Judgement.REFUTED:
            yield (
                f"Held-out runs refute {name}: {evidence}. It was found in the runs of the fit, "
                "and is not written."
            )
        elif verdict.judgement is Judgement.CONFIRMED:
            yield (
                f"Held-out runs confirm {name}, but it is not written: after other effects have "
                "left, its σ no longer shows it, or it left together with them."
            )
        elif verdict.written:
            yield f"Undecided, and written because of --write-undecided: {name}: {evidence}."
        else:
            yield (
                f"Undecided, and not written: {name}: {evidence}. Hold out more moves, or pass "
                "--write-undecided to `drivegain residual`."
            )


def statistical_sentences(fitted: Fit, account: Account) -> tuple[str, ...]:
    """Return what was not added and why, what would have been detected,
    and what the noise and the gears hide.
    """
    last = fitted.steps[-1]
    sentences: list[str] = []
    for step in fitted.steps:
        sentences += _rejected_sentences(fitted, step)
    sentences += _choice_sentence(fitted, account)
    sentences.append(_end_of_search(fitted))
    sentences += _unconfirmed_skew(account.skew)
    sentences += _failed_checks(fitted)
    sentences += _on_few_moves(fitted)
    sentences += gear_sentences(fitted)
    sentences += floor_sentences(account, fitted.cell.axis_names)
    sentences += kinds_of_error(fitted)
    is_judged_on_runs = bool(last.verdicts) or bool(runs_to_leave_out(last.after.training))
    if last.after.effects and not is_judged_on_runs:
        sentences.append(
            "The effects were tested on moves of the same recordings only, kept out of the fit in "
            "turn. Record two runs without load and two with each payload: whole runs can then be "
            "kept out, which is a stricter test."
        )
    return tuple(sentences)


def _rise_within_noise(account: Account) -> str:
    """Say of a rise of the held-out error that it is within its noise;
    empty for a fall, or a rise by more.
    """
    change = account.holdout_change
    if change is None or change.total.rise <= 0.0 or change.is_harm:
        return ""
    size = ""
    if change.total.std:
        size = f" ({change.total.sigmas:.1f} σ)"
    return f", within its noise{size}: the effects are kept, but not confirmed"


def _refused_by_apply(effects: Sequence[AcceptedEffect]) -> Iterator[str]:
    """Name the effects with which `apply` refuses a calibration
    (`daq.writeback.gates.fit.effect`).
    """
    errors_by_name: list[tuple[str, str]] = []
    for effect in effects:
        if not effect.is_harmless:
            errors = (
                f"{effect.error_after_percent:.2f} % with it, "
                f"{effect.error_before_percent:.2f} % without"
            )
            errors_by_name.append((f"{effect.name} on {effect.axis}", errors))
    if not errors_by_name:
        return
    first_name, first_errors = errors_by_name[0]
    others = ""
    for name, errors in errors_by_name[1:]:
        others += f"; {name}: {errors}"
    yield (
        f"`apply` refuses a calibration with {first_name}: on data that the fit did not use, the "
        f"torque error is {first_errors}{others}. Record more runs for the fit, or take `drivegain "
        "fit`, which adds no effects."
    )


NOTABLE_SIGMAS = 2.5
"""Difference of a gain, in its σ, from which on it is said,
although noise may make it on one of all axes.
"""


def gains_sentence(fitted: Fit, account: Account) -> str:
    """Say which gains the effects change by more than noise, else the largest difference;
    empty for held gains.
    """
    if fitted.estimate.gains_fixed:
        return ""
    names = fitted.cell.axis_names
    shifts = dict(zip(names, account.total.gains, strict=True))
    changed = []
    for axis, shift in shifts.items():
        if shift.significant:
            changed.append(f"{axis} by {shift.change_percent:+.1f} %")
    among_all = f"more than noise (probability below {100 * FALSE_ALARM:g} % among all axes)"
    if changed:
        return (
            f"The effects change gains by {among_all}: {', '.join(changed)} of the gain "
            "without them."
        )
    notable = {}
    for axis, shift in shifts.items():
        if _is_notable(shift, fitted.cell.target_sigma_percent):
            notable[axis] = abs(shift.change_percent)
    if not notable:
        return "With and without the effects, the gains are the same within noise."
    axis = max(notable, key=notable.__getitem__)
    largest = shifts[axis]
    size = with_deviation(largest.change_percent, largest.change_std_percent, sign="+")
    return (
        f"The effects change no gain by {among_all}; the largest difference is {size} % of the "
        f"gain of {axis} without them."
    )


def _is_notable(change: GainShift, target_percent: float) -> bool:
    """Whether the difference of a gain is large:
    in its own σ, or for the σ that the cell asks of its gains.
    """
    is_beyond_sigma = abs(change.change_percent) > NOTABLE_SIGMAS * change.change_std_percent
    return is_beyond_sigma or abs(change.change_percent) > target_percent


def _choice_sentence(fitted: Fit, account: Account) -> Iterator[str]:
    """Say which part of σ comes from the choice of effects,
    where it is a third of σ or more (σ is then 6 % larger).
    """
    shares = []
    for axis, shift in zip(fitted.cell.axis_names, account.total.gains, strict=True):
        if 3.0 * shift.choice_std >= shift.after_std > 0.0:
            percent = 100.0 * shift.choice_std / shift.after_std
            shares.append(f"{percent:.0f} % of it on {axis}")
    if shares:
        listed = ", ".join(shares)
        yield (
            "σ of the gains includes the choice of the effects (squares add): "
            f"{listed}.{_left_open_text(fitted)}"
        )


def _left_open_text(fitted: Fit) -> str:
    """Name the effects that are not in the model and may be true; empty without any."""
    names = [placed.name_among(fitted.cell.place_names) for placed in fitted.steps[-1].left_open]
    if not names:
        return ""
    verb = "are"
    if len(names) == 1:
        verb = "is"
    return (
        f" {', '.join(names)} {verb} not in the model and may be true: σ holds what that "
        "would move."
    )


def _rejected_sentences(fitted: Fit, step: Step) -> Iterator[str]:
    """Sentences on findings that did not join the model, where the last model still lacks them."""
    places = fitted.cell.place_names
    last = fitted.steps[-1]
    for rejected in step.set_aside:
        finding = rejected.finding
        rival = rejected.rival
        axis = finding.placed.axis_name(places)
        effect = effect_text(finding.effect, places)
        # Of an earlier turn, a finding is named where its rival is in the last model, and where it
        # has a name itself.
        is_rival_in_model = rival is not None and rival in last.after.effects
        is_replaced = is_rival_in_model and not is_unnamed(finding.effect)
        if rival is not None and rejected.moved and step is last:
            yield (
                f"{axis}: what looks like {effect} depends clearly more "
                f"on {variable_text(rival.effect, places)}, and was not added: it would move "
                f"{rejected.moved_text(places)}."
            )
        elif step is last or is_replaced:
            yield (
                f"{axis} may have {effect}: it would change the error "
                f"of moves left out from {finding.error_before_percent:.1f} to "
                f"{finding.error_after_percent:.1f} %, and was not added: "
                f"{rejected.reason(places)}."
            )


def _impossible_firsts(fitted: Fit) -> tuple[Finding, ...]:
    """Return the first candidate of each axis in the last turn,
    where an impossible sign or size is the only check that it failed.
    """
    first_by_axis: dict[int, Finding] = {}
    for finding in fitted.steps[-1].findings:
        first_by_axis.setdefault(finding.axis, finding)
    impossible = []
    for finding in first_by_axis.values():
        if finding.impossible and finding.refusals == (finding.impossible,):
            impossible.append(finding)
    return tuple(impossible)


def _impossible_sentences(fitted: Fit) -> tuple[str, ...]:
    """Say which effects rank first and cannot be: something else is there that looks like them."""
    axes = fitted.cell.place_names
    sentences: list[str] = []
    for finding in _impossible_firsts(fitted):
        name = finding.placed.axis_name(axes)
        sentences.append(
            f"{name}: {effect_text(finding.effect, axes)} ranks first on this axis, but its sign "
            f"or size is impossible: {finding.impossible}. The cause may be another one."
        )
    return tuple(sentences)


def _failed_checks(fitted: Fit) -> Iterator[str]:
    """Sentences on candidates that failed a check: of each axis the strongest, where it would
    explain much of the residual.
    """
    places = fitted.cell.place_names
    last = fitted.steps[-1]
    # Other sentences name these, with the reason.
    reported = [rejected.finding.placed for rejected in last.set_aside]
    reported += [finding.placed for finding in _impossible_firsts(fitted)]
    strongest_by_axis: dict[int, Finding] = {}
    for finding in last.findings:
        explains_much = finding.explained >= MUCH
        if not explains_much or not finding.refusals or finding.placed in reported:
            continue
        strongest = strongest_by_axis.get(finding.axis)
        if strongest is None or finding.explained > strongest.explained:
            strongest_by_axis[finding.axis] = finding
    for finding in strongest_by_axis.values():
        name = finding.placed.axis_name(places)
        yield (
            f"{name}: {effect_text(finding.effect, places)} would explain "
            f"{100.0 * finding.explained:.0f} % of the squared residual, but failed a check: "
            f"{'; '.join(finding.refusals)}. The cause may be another one."
        )


def _on_few_moves(fitted: Fit) -> Iterator[str]:
    """Name, for each axis, the best candidate that too few moves show, and say what to record."""
    best_by_axis: dict[int, Finding] = {}
    for finding in fitted.steps[-1].findings:
        # `_failed_checks` names a large one with all that it failed.
        is_of_size = LITTLE <= finding.explained < MUCH
        helps = finding.left_out_fall > 0.0 and finding.folds_better >= MOST
        is_possible = not finding.impossible
        if finding.too_few_moves and is_of_size and helps and is_possible:
            best_by_axis.setdefault(finding.axis, finding)  # the findings are ranked
    places = fitted.cell.place_names
    for finding in best_by_axis.values():
        name = finding.placed.axis_name(places)
        effect = effect_text(finding.effect, places)
        yield f"These moves do not tell whether {name} has {effect}: {finding.too_few_moves}."


def kinds_of_error(fitted: Fit) -> Iterator[str]:
    """Say which errors are those of currents, where they differ from those of the joints'
    torques.
    """
    ratio = fitted.identification.model.drive_train.ratio
    # A row of the ratio is a motor, a column a joint.
    motors_of_joints = np.count_nonzero(ratio, axis=0)
    coupled = []
    for name, motors in zip(fitted.cell.axis_names, motors_of_joints, strict=True):
        if motors > 1:
            coupled.append(name)
    if coupled:
        yield (
            "The errors of a search are those of the motors' currents. `fit`, `validate` and the "
            "certificate have those of the joints' torques, which differ where several motors act "
            f"on a joint ({', '.join(coupled)})."
        )


_FLOOR_CAUSES = {
    FloorSource.STANDSTILL: (
        "at standstill",
        "a brake that takes the load over, dither, an axis that hunts, or axes that move meanwhile",
    ),
    FloorSource.REPEATED_MOVES: (
        "between repeated moves",
        "warm-up, or moves that are not quite the same",
    ),
}
"""When a noise was measured, and what else than noise may be in it."""


def floor_sentences(account: Account, axes: Sequence[str]) -> Iterator[str]:
    """Name the axes whose noise estimate is far above what the model leaves,
    and possible causes.
    """
    for axis, floor, left_a in zip(axes, account.floors, account.left_a, strict=True):
        if floor is not None and floor.is_refuted(left_a):
            when, causes = _FLOOR_CAUSES[floor.source]
            yield (
                f"{axis} has no noise floor: its current {when} scatters "
                f"{floor.noise_a / left_a:.1f} times as much as the model's error in motion. "
                f"Possible causes: {causes}."
            )


def _holdout_verdict(fitted: Fit, account: Account) -> Iterator[str]:
    """Say of effects that harm the held-out runs whether they were accepted all the same."""
    if account.holdout_change is None or not account.holdout_change.is_harm:
        return
    if fitted.accept_worse_holdout:
        yield (
            "The effects raise the error of the held-out runs by more than its noise. They were "
            "accepted all the same, because --accept-worse-holdout was given."
        )
    else:
        yield (
            "The effects raise the error of the held-out runs by more than its noise: no "
            "calibration was written."
        )


def _skew_sentence(skew: CurrentDelay | None) -> Iterator[str]:
    """State a time skew that instruments confirm; nothing where they do not, or do not exist."""
    if skew is None or not skew.confirmed:
        return
    side = "before"
    if skew.seconds > 0.0:
        side = "after"
    in_model_text = "it was not added to the model"
    if skew.is_in_model:
        in_model_text = "it is among the effects"
    delay_ms = 1e3 * abs(skew.seconds)
    std_ms = 1e3 * skew.std
    yield (
        f"Currents were sampled {delay_ms:.2f} ± {std_ms:.2f} ms {side} the positions, the same on "
        f"every axis ({in_model_text}). Tenths of a millisecond are a filter of the drive, several "
        "milliseconds a fault of the recording: check its stamps."
    )


def _unconfirmed_skew(skew: CurrentDelay | None) -> Iterator[str]:
    """Say why no time skew is stated."""
    if skew is None:
        yield (
            "A time skew between currents and positions is not known: it needs instruments, so "
            "point-to-point moves and one motor for each degree of freedom, and data that show it "
            "next to the model."
        )
    elif not skew.confirmed:
        yield (
            "A time skew between currents and positions is not confirmed: instruments from the "
            f"demanded motion give {1e3 * skew.seconds:.2f} ± {1e3 * skew.std:.2f} ms."
        )


def gear_sentences(fitted: Fit) -> Iterator[str]:
    """Say which gains carry the efficiency of their gear,
    and what a loss in the model means for its gain.
    """
    if fitted.estimate.gains_fixed:
        return
    last = fitted.steps[-1]
    in_model = {placed.axis for placed in last.after.effects if is_gear_loss(placed.effect)}
    for axis, (name, gear) in enumerate(
        zip(fitted.cell.axis_names, gear_losses(last), strict=True)
    ):
        yield from _gear_sentence(name, gear, in_model=axis in in_model)


def _gear_sentence(name: str, gear: GearLoss, *, in_model: bool) -> Iterator[str]:
    """Say what is known of the efficiency of one gear; nothing where that is not known."""
    if in_model and gear.efficiency is not None and gear.gain_factor is not None:
        yield (
            f"If motor and load lose the same share, the gear of {name} has an efficiency of "
            f"{100.0 * gear.efficiency:.1f} %. The gain of its motor is then "
            f"{100.0 * (gear.gain_factor - 1.0):.2f} % larger than the identified one, which no "
            "residual can show."
        )
    elif gear.gain_carries_it and gear.hidden_shift is not None and gear.loss_std is not None:
        if gear.lean > 0.0:
            side = "motor"
            share = gear.motoring_torque
        else:
            side = "load"
            share = 1.0 - gear.motoring_torque
        yield (
            f"The gain of {name} includes the efficiency of its gear: the {side} drives in "
            f"{100.0 * share:.0f} % of the squared load torque. A loss of up to "
            f"{100.0 * CERTAIN * gear.loss_std:.1f} % would not show, and would change the gain by "
            f"{100.0 * gear.hidden_shift:.1f} %."
        )


def errors_by_data(errors: RelativeErrors) -> dict[str, RelativeError | None]:
    """Return the errors of one model, by the data that they are measured on."""
    left_out = errors.left_out_runs
    return {
        "fit": errors.in_sample,
        "moves left out": errors.cross_validated,
        "runs left out": None if left_out is None else left_out.together,
        "held out": errors.holdout,
    }


def error_rows(account: Account) -> dict[str, RelativeError]:
    """Return the errors [%] by their names and the data they are measured on;
    those that are not known are left out.
    """
    after = errors_by_data(account.total.after)
    rows: dict[str, RelativeError | None] = {}
    for data, before in errors_by_data(account.total.before).items():
        rows[f"{data}, before"] = before
        rows[f"{data}, after"] = after[data]
    rows["noise, estimate"] = account.floor
    rows["noise, estimate, held out"] = account.holdout_floor
    rows["noise, at least"] = account.least_floor
    rows["noise, at least, held out"] = account.least_holdout_floor
    measured = {name: error for name, error in rows.items() if error is not None}
    # A floor may be there, and be known of no axis.
    return {name: error for name, error in measured.items() if any(map(math.isfinite, error.axes))}


def _strictest_error(errors: RelativeErrors, place: int | None = None) -> tuple[RelativeError, str]:
    """Return the most independent error, and the data it is measured on.

    Args:
        errors: of one model.
        place: of the axis that the error must be known of: one that rests in the held-out runs has
            none there.
    """
    holdout = errors.holdout
    if holdout is not None and (place is None or math.isfinite(holdout.at(place))):
        return holdout, "on held-out runs"
    left_out_runs = errors.left_out_runs
    if left_out_runs is not None and left_out_runs.together is not None:
        return left_out_runs.together, "on runs left out in turn"
    return errors.cross_validated, "on moves left out in turn"


def error_change_text(before_percent: float, after_percent: float) -> str:
    """Describe the change of an error: `falls slightly, from 2.4 to 2.3 %`."""
    before = f"{before_percent:.1f}"
    after = f"{after_percent:.1f}"
    if before == after:
        return f"stays at {after} %"
    change = "falls"
    if after_percent > before_percent:
        change = "rises"
    if before_percent * (1.0 - SLIGHT) < after_percent < before_percent:
        change += " slightly,"
    return f"{change} from {before} to {after} %"


def _effect_sentence(
    fitted: Fit, account: Account, turn: BeforeAfter, placed: PlacedEffect, step: Step
) -> str:
    """Say what an effect is, and how the errors fall that it is judged by.

    Args:
        fitted: with the turns of the search.
        account: of these turns.
        turn: the errors before and after the turn that added the effect.
        placed: the effect.
        step: the turn.
    """
    places = fitted.cell.place_names
    name = places[placed.axis]
    effect = effect_text(placed.effect, places)
    doubt = doubted_name(step, placed, places)
    if doubt:
        effect = f"a torque that depends on {variable_text(placed.effect, places)} ({doubt})"
    place = None
    subject = "The recording"
    if placed.effect.has_axis:
        place = placed.axis
        subject = name
    before, where = _strictest_error(turn.before, place)
    after, _ = _strictest_error(turn.after, place)
    if is_correction(placed):
        # A correction moves the torque of every motor: they judge it together.
        if f"{before.total:.1f}" == f"{after.total:.1f}":
            shown = _hardly_shown_text(fitted, placed, step, before, after, where)
            return f"{subject} has {effect}{shown}."
        change = error_change_text(before.total, after.total)
        return f"{subject} has {effect}: the error of all axes {where} {change}."
    if place is None:
        change = error_change_text(before.total, after.total)
        return f"{subject} has {effect}: the error {where} {change}."
    return (
        f"{name} has {effect}{_size_remarks(placed, step, before, after)}: the error of "
        f"{_judged_by(fitted, placed)} {where} "
        f"{error_change_text(before.at(place), after.at(place))} ({_noise_text(account, place)})."
    )


def _judged_by(fitted: Fit, placed: PlacedEffect) -> str:
    """Return whose error an effect is judged by: its axis; all axes at a joint without a motor."""
    if placed.axis < len(fitted.cell.axes):
        return fitted.cell.place_names[placed.axis]
    return "all axes"


def _size_remarks(
    placed: PlacedEffect, step: Step, before: RelativeError, after: RelativeError
) -> str:
    """Return what is said of the size of an effect on an axis; empty where nothing is."""
    remarks = ""
    accepted = step.accepted
    if is_unnamed(placed.effect) and accepted is not None and accepted.share_of_excess is not None:
        percent = 100.0 * accepted.share_of_excess
        remarks += f" (about {percent:.0f} % of the residual beyond noise)"
    without_it = before.at(placed.axis)
    with_it = after.at(placed.axis)
    if without_it * (1.0 - SLIGHT) < with_it <= without_it:
        remarks += ", a small effect"
    return remarks


def _hardly_shown_text(
    fitted: Fit,
    placed: PlacedEffect,
    step: Step,
    before: RelativeError,
    after: RelativeError,
    where: str,
) -> str:
    """Say of a correction that the error of all axes hardly shows:
    its own σ, and the axis that shows it most.
    """
    final = fitted.steps[-1].after
    fit_with_it = final if placed in final.effects else step.after
    sigmas_of_coefficients = []
    for coefficient in coefficients(fit_with_it, placed):
        if coefficient.std > 0.0:
            sigmas_of_coefficients.append(coefficient.value / coefficient.std)
    sigmas = math.hypot(*sigmas_of_coefficients)
    certain = ""
    if sigmas:
        certain = f", by {sigmas:.0f} σ"
    text = (
        f"{certain}: it hardly shows in the error of all axes {where}, {before.total:.2f} % "
        f"without it and {after.total:.2f} % with it"
    )
    names = fitted.cell.axis_names
    falls = {}
    for name, before_percent, after_percent in zip(names, before.axes, after.axes, strict=True):
        fall = 1.0 - after_percent / before_percent
        if fall > 0.0:
            falls[name] = fall
    if not falls:
        return text
    axis = max(falls, key=falls.__getitem__)
    place = names.index(axis)
    return f"{text}; most in that of {axis}, {before.at(place):.2f} and {after.at(place):.2f} %"


def doubted_name(step: Step, placed: PlacedEffect, axes: Sequence[str]) -> str:
    """Say what splits of the data call an effect that a turn added;
    empty where all of them call it the same.
    """
    names = names_by_split(step)
    if len(names) < 2 or step.accepted is None or placed.axis != step.accepted.axis:
        return ""
    names_with_counts = []
    for name in names:
        names_with_counts.append(f"{name.placed.name_among(axes)} ({name.splits} of {name.of})")
    return f"parts of the moves call it {' or '.join(names_with_counts)}"


def _noise_text(account: Account, place: int | None = None) -> str:
    """Say how much of an error noise leaves, to stand in brackets:
    its lower limit, else the estimate.

    Both are on the rows that `_strictest_error` is measured on.

    Args:
        account: of the search.
        place: of the axis; None for all together.
    """
    least = account.least_floor
    estimate = account.floor
    if account.least_holdout_floor is not None and account.holdout_floor is not None:
        least = account.least_holdout_floor
        estimate = account.holdout_floor
    if place is None:
        least_percent = least.total
        estimate_percent = estimate.total
    else:
        least_percent = least.at(place)
        estimate_percent = estimate.at(place)
    if math.isfinite(least_percent):
        return f"noise leaves at least {least_percent:.1f} %"
    if math.isfinite(estimate_percent):
        return f"noise leaves {estimate_percent:.1f} %, an estimate"
    return UNKNOWN_NOISE


UNKNOWN_NOISE = "noise floor not known"


def _end_of_search(fitted: Fit) -> str:
    """Say that the search ended too early, or which effects it would have found."""
    last = fitted.steps[-1]
    if last.accepted is not None:
        return (
            f"The search ended after {MAX_EFFECTS} effects with more to find: check the declared "
            "model first (drive train, payload, channels)."
        )
    axis_limits = []
    for axis, limit in zip(fitted.cell.axes, last.limits_nm, strict=True):
        axis_limits.append(f"{limit:.2g} {axis.unit.force} on {axis.name}")
    limits = ", ".join(axis_limits)
    ended = ""
    if last.ended:
        ended = f"The search ended early: {last.ended}. "
    fit_runs = last.after.fit_runs
    has_no_clock = len(fit_runs) > 1 and session_began_s(fit_runs) is None
    unseen = ""
    if has_no_clock:
        unseen = " The runs have no common clock: a warm-up over the session cannot be seen."
    return (
        f"{ended}Detection limit of an effect that the declared model cannot imitate, root mean "
        f"square in motion: {limits}.{unseen}"
    )
