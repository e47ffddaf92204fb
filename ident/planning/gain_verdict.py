"""Verdicts on the gains of a planned or recorded experiment:
how well each is identifiable, through what, and why not.

A gain is identifiable in three ways, and each is judged by the deviation that it would give alone:

- gravity: the known payload's static torque in the motor's rows, independent of all unknowns there;
- inertia: the rest of the known payload's torque in the motor's rows;
- coupling: parameters that its rows share with those of other axes, whose gains are known by their
  own means.

Motors of a redundant drive can work against each other, and this internal preload is taken out of
every row (ident/equations/currents.py). The same rows are judged once more as if it were known: a
gain that they would show then is hidden by preload, and one that they would not show either needs
other moves. While the pose hardly changes, an unknown preload can pass for a change of the gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.model.bodies import LINK_PARAMETERS
from ident.model.robot import at_rest
from ident.planning.excitation import UNSEEN_PERCENT, Design, Excitation
from ident.plausible import format_at_limit

#: Largest standard deviation of a good gain: drives are sold with gains known to some percent
GOOD_PERCENT = 1.0
#: A source counts when it alone gives at most so many times the deviation of the best one
SHARE_OF_BEST = 3.0
SHARE_OF_KNOWN = 2.0
"""Preload hides a weak gain whose deviation is more than so many times that with known preload:
three quarters of its variance come from taking the preload out.
"""
#: Square of gravity's torque on an axis, as a share of that of all torque; less is rounding
SMALLEST_GRAVITY = 1e-12


class GainSource(Enum):
    """Source of information about a gain."""

    GRAVITY = "gravity"
    INERTIA = "inertia"
    COUPLING = "coupling with other axes"


class Visibility(Enum):
    """How well a gain is identifiable."""

    GOOD = "good"
    WEAK = "weak"
    UNSEEN = "unseen"


class Hidden(Enum):
    """Why a gain is not identified well."""

    PRELOAD = "preload"  #: the same moves would show it if internal preload were known
    MOTION = "motion"  #: they would not show it then either


@dataclass(frozen=True, slots=True, eq=False)
class ExtraMoves:
    """Moves that could be added to an experiment,
    made once without load and once with each payload.
    """

    words: str  #: description, to follow "add": ``fast moves of J1 with the arm stretched``
    seconds: float  #: their duration, once
    excitation: Excitation  #: their rows


@dataclass(frozen=True, slots=True)
class Advice:
    """Extra moves that improve a gain most, and its deviation with them [%]."""

    words: str
    seconds: float
    std_percent: float


@dataclass(frozen=True, slots=True)
class GainVerdict:
    """Verdict on one gain."""

    axis: int  #: index from 0
    #: predicted standard deviation [% of the gain]; inf where it is not identifiable
    std_percent: float
    #: The same if internal preload were known; None of a drive without redundant motors, which has
    #: none [%].
    known_preload_percent: float | None
    #: standard deviation that each source would give alone [%]
    alone_percent: dict[GainSource, float]
    gravity_acts: bool  #: whether gravity of any payload acts on this axis
    verdict: Visibility  #: good, weak or unseen
    #: for a gain that is not good; None where no extra moves were offered or none helps
    advice: Advice | None

    @property
    def sources(self) -> tuple[GainSource, ...]:
        """Sources of information, the best first; empty for a gain that is not identifiable."""
        order = sorted(self.alone_percent.items(), key=lambda item: item[1])
        _, best_percent = order[0]
        largest_percent = SHARE_OF_BEST * best_percent
        sources: list[GainSource] = []
        for source, alone_percent in order:
            if np.isfinite(alone_percent) and alone_percent <= largest_percent:
                sources.append(source)
        return tuple(sources)

    @property
    def hidden_by(self) -> Hidden | None:
        """Why the gain is unseen, or weak by preload; None for other gains."""
        known_percent = np.inf
        if self.known_preload_percent is not None:
            known_percent = self.known_preload_percent
        if self.verdict is Visibility.UNSEEN:
            if known_percent <= UNSEEN_PERCENT:
                return Hidden.PRELOAD
            return Hidden.MOTION
        is_weakened = self.std_percent > SHARE_OF_KNOWN * known_percent
        if self.verdict is Visibility.WEAK and is_weakened:
            return Hidden.PRELOAD
        return None

    def words(self, axis_name: str) -> str:
        """Describe it for a report: ``J1 is identifiable only through inertia: σ 3.1 %;
        add 5 s of … (σ 1.9 %)``.
        """
        text = f"{axis_name} is not identifiable"
        if self.sources and np.isfinite(self.std_percent):
            std_percent = format_at_limit(self.std_percent, GOOD_PERCENT, 2, "g")
            text = f"{axis_name} is identifiable {self._through()}: σ {std_percent} %"
        if self.hidden_by is Hidden.PRELOAD:
            text += f", {self.known_preload_percent:.2g} % if internal preload were known"
        if self.advice is None:
            return text
        improved_percent = format_at_limit(self.advice.std_percent, GOOD_PERCENT, 2, "g")
        return (
            f"{text}; add {self.advice.seconds:.0f} s of {self.advice.words} (σ "
            f"{improved_percent} %)"
        )

    def _through(self) -> str:
        """Sources for a sentence: ``only through gravity``."""
        if not self.gravity_acts:
            text = "only through inertia"
            if GainSource.COUPLING in self.sources:
                text += ", partly through parameters shared with other axes"
            return text
        names = " and ".join(source.value for source in self.sources)
        if len(self.sources) == 1:
            return f"only through {names}"
        return f"through {names}"


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Verdicts on all gains of an experiment, and how many independent directions of them it
    determines.
    """

    gains: tuple[GainVerdict, ...]  #: one an axis, in their order
    rank: int  #: directions of the n gains known to UNSEEN_PERCENT; see `Design.rank`
    #: the same if internal preload were known; None where there can be none
    known_preload_rank: int | None

    def hidden(self, by: Hidden) -> tuple[int, ...]:
        """Axes whose gains are hidden for this reason."""
        return tuple(gain.axis for gain in self.gains if gain.hidden_by is by)

    def sentences(self, axis_names: Sequence[str]) -> tuple[str, ...]:
        """Name the axes whose gains are hidden, by what, and what to do;
        empty where there are none.
        """
        known_rank = self.known_preload_rank
        sentences: list[str] = []
        by_preload = self.hidden(Hidden.PRELOAD)
        if by_preload:
            hidden_gains = [self.gains[axis] for axis in by_preload]
            worst = max(hidden_gains, key=lambda gain: gain.std_percent)
            sentences.append(
                f"Internal preload obscures {_named(by_preload, axis_names)}: σ up to "
                f"{worst.std_percent:.2g} %, {worst.known_preload_percent:.2g} % if it were known. "
                f"These moves determine {self.rank} of {len(self.gains)} independent directions of "
                f"the gains to {UNSEEN_PERCENT:g} %, with known preload {known_rank}. Shift and "
                "turn the platform farther: while its pose hardly changes, preload passes for a "
                "change of the gains."
            )
        by_motion = self.hidden(Hidden.MOTION)
        if by_motion:
            even_then = ""
            if known_rank is not None:
                even_then = ", nor would they if internal preload were known"
            sentences.append(
                f"These moves do not show {_named(by_motion, axis_names)}{even_then}: move there "
                "faster and farther, in both directions."
            )
        return tuple(sentences)


def _named(axes: Sequence[int], axis_names: Sequence[str]) -> str:
    """Gains of some axes, for a sentence."""
    names = [axis_names[axis] for axis in axes]
    if len(names) == 1:
        return f"the gain of {names[0]}"
    return f"the gains of {', '.join(names[:-1])} and {names[-1]}"


Runs = Sequence[tuple[Excitation, Sequence[int | None]]]
"""Motions, each with the payload of every repetition:
an index into ``Expectation.payloads``, or None.
"""


def verdicts(design: Design, runs: Runs, extras: Sequence[ExtraMoves] = ()) -> Identifiability:
    """Judge every gain of a planned or recorded experiment.

    Args:
        design: unknowns, expected parameters and gains, noise. After a fit: its gains, parameters
            and residuals.
        runs: for a plan ``[(excitation, (None, 0))]``, its moves without and with the payload; for
            recorded runs one pair each, ``(excitation, (None,))`` or ``(excitation, (payload,))``.
        extras: moves that could be added; for each gain that is not good the best of them is named.

    Returns:
        one verdict an axis, and the rank.
    """
    whitened = [(design.whitened(excitation), payloads) for excitation, payloads in runs]
    information = _information(design, whitened)
    std_percent = design.std_percent(information)
    known_preload_percent, known_rank = _with_known_preload(design, runs, whitened)
    own_rows = _own_rows(design, runs, whitened)
    with_extras = _std_with_extras(design, information, extras)
    judged: list[GainVerdict] = []
    for axis, own_percent in enumerate(std_percent.tolist()):
        blind = _information(design, whitened, axis)
        coupling_percent = design.std_percent(blind)[axis]
        own = own_rows[axis]
        alone_percent = {
            GainSource.GRAVITY: own.gravity_percent,
            GainSource.INERTIA: own.inertia_percent,
            GainSource.COUPLING: float(coupling_percent),
        }
        verdict = _visibility(own_percent)
        advice = None
        if verdict is not Visibility.GOOD:
            advice = _advice(axis, own_percent, with_extras)
        judged.append(
            GainVerdict(
                axis=axis,
                std_percent=own_percent,
                known_preload_percent=known_preload_percent[axis],
                alone_percent=alone_percent,
                gravity_acts=own.gravity_acts,
                verdict=verdict,
                advice=advice,
            )
        )
    return Identifiability(tuple(judged), design.rank(information), known_rank)


Whitened = Sequence[tuple[FloatArray, Sequence[int | None]]]
"""Columns of motions (`Design.whitened`), each with the payload of every repetition."""


def _information(design: Design, whitened: Whitened, blind: int | None = None) -> FloatArray:
    """Information of all motions, shape (p, p); see `Design.information_of`."""
    parts = [design.information_of(columns, payloads, blind) for columns, payloads in whitened]
    return np.asarray(np.sum(parts, axis=0))


def _visibility(std_percent: float) -> Visibility:
    """How well a gain with this deviation is identifiable."""
    if std_percent <= GOOD_PERCENT:
        return Visibility.GOOD
    if std_percent <= UNSEEN_PERCENT:
        return Visibility.WEAK
    return Visibility.UNSEEN


def _std_with_extras(
    design: Design, information: FloatArray, extras: Sequence[ExtraMoves]
) -> list[tuple[ExtraMoves, FloatArray]]:
    """Deviations of all gains with each of some extra moves [%],
    made without load and with every payload.
    """
    every_payload: tuple[int | None, ...] = (None, *range(len(design.expectation.payloads)))
    tried: list[tuple[ExtraMoves, FloatArray]] = []
    for extra in extras:
        added = design.information(extra.excitation, every_payload)
        tried.append((extra, design.std_percent(information + added)))
    return tried


def _with_known_preload(
    design: Design, runs: Runs, whitened: Whitened
) -> tuple[Sequence[float | None], int | None]:
    """Deviations of the gains if internal preload were known [%], and the rank;
    None where there can be none.
    """
    if not design.expectation.model.is_redundant:
        return (None,) * len(design.expectation.gains), None
    known: list[tuple[FloatArray, Sequence[int | None]]] = []
    for (excitation, _), (columns, payloads) in zip(runs, whitened, strict=True):
        known.append((design.with_known_preload(columns, excitation.use), payloads))
    information = _information(design, known)
    return design.std_percent(information).tolist(), design.rank(information)


def _advice(
    axis: int, std_percent: float, tried: Sequence[tuple[ExtraMoves, FloatArray]]
) -> Advice | None:
    """The extra moves that lower a deviation most; None where none does. Of equals, the first."""
    best_percent = std_percent
    best: ExtraMoves | None = None
    for extra, found_percent in tried:
        own_percent = float(found_percent[axis])
        if own_percent < best_percent:
            best_percent = own_percent
            best = extra
    if best is None:
        return None
    return Advice(best.words, best.seconds, best_percent)


@dataclass(frozen=True, slots=True)
class _OwnRows:
    """What a motor's rows show of its gain."""

    gravity_percent: float  #: deviation that the known payload's gravity gives alone [%]
    inertia_percent: float  #: the same of its inertia [%]
    gravity_acts: bool  #: whether gravity of any payload acts there


def _own_rows(design: Design, runs: Runs, whitened: Whitened) -> list[_OwnRows]:
    """Judge gravity and inertia of the known payload in the rows of each motor."""
    count = len(design.expectation.gains)
    width = design.width
    flange = slice(width - len(LINK_PARAMETERS), width)
    unknown_columns: list[FloatArray] = []
    known_columns: list[FloatArray] = []
    static_squares = np.zeros(count)
    moving_squares = np.zeros(count)
    for (excitation, _), (columns, payloads) in zip(runs, whitened, strict=True):
        still = Excitation(at_rest(excitation.motion.position_rad), excitation.use)
        static = design.whitened(still)[:, :width]
        moving = columns[:, :width]
        static_squares += _square_sums(static[:, flange])
        moving_squares += _square_sums(moving[:, flange])
        for payload in payloads:
            unknowns, source = design.columns(payload)
            # columns of J for all unknowns but the gains
            others = np.zeros((count, moving.shape[2], design.others))
            others[:, :, unknowns] = moving[:, source].transpose(0, 2, 1)
            mounted = np.zeros(width)
            if payload is not None:
                mounted = design.known(payload)
            gravity = np.einsum("nck,c->nk", static, mounted)
            inertia = np.einsum("nck,c->nk", moving, mounted) - gravity
            unknown_columns.append(others)
            known_columns.append(np.stack((gravity, inertia), axis=2))
    gravity_acts = static_squares > SMALLEST_GRAVITY * moving_squares
    judged: list[_OwnRows] = []
    for motor, acts in enumerate(gravity_acts.tolist()):
        unknown = np.concatenate([part[motor] for part in unknown_columns])
        known = np.concatenate([part[motor] for part in known_columns])
        gravity_percent, inertia_percent = _percent_alone(unknown, known)
        judged.append(_OwnRows(gravity_percent, inertia_percent, acts))
    return judged


def _square_sums(columns: FloatArray) -> FloatArray:
    """Σ over the columns c and rows k of each motor n, shape (n, c, k) → (n,)."""
    return np.asarray(np.einsum("nck,nck->n", columns, columns))


def _percent_alone(others: FloatArray, known: FloatArray) -> tuple[float, float]:
    """100 over the norm of each of two columns with the others projected out;
    inf where nothing is left.
    """
    norms = np.linalg.norm(others, axis=0)
    is_nonzero = norms > 0.0
    used = others[:, is_nonzero] / norms[is_nonzero]
    independent = known
    if used.shape[1]:
        coefficients, *_ = np.linalg.lstsq(used, known, rcond=1e-9)
        independent = known - used @ coefficients
    size = np.linalg.norm(known, axis=0)
    independent_size = np.linalg.norm(independent, axis=0)
    smallest = 1e-6 * np.maximum(size.max(), 1e-300)
    with np.errstate(divide="ignore"):
        percent = np.where(independent_size > smallest, 100.0 / independent_size, np.inf)
    gravity_percent, inertia_percent = percent.tolist()
    return gravity_percent, inertia_percent
