"""Verdicts on the gains of a planned or recorded experiment:
how well each is identifiable, through what, and why not.

A gain is identifiable in three ways, and each is judged by the deviation that it would give alone:

- gravity: the known payload's static torque in the motor's own rows, beside all unknowns there;
- inertia: the rest of the known payload's torque in the motor's own rows;
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
from ident.model.robot import Motion
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
        best = min(self.alone_percent.values())
        order = sorted(self.alone_percent.items(), key=lambda item: item[1])
        return tuple(
            source
            for source, alone in order
            if np.isfinite(alone) and alone <= SHARE_OF_BEST * best
        )

    @property
    def hidden_by(self) -> Hidden | None:
        """Why the gain is unseen, or weak by preload; None for other gains."""
        if self.known_preload_percent is None:
            known = np.inf
        else:
            known = self.known_preload_percent
        if self.verdict is Visibility.UNSEEN:
            if known <= UNSEEN_PERCENT:
                return Hidden.PRELOAD
            return Hidden.MOTION
        weakened = self.std_percent > SHARE_OF_KNOWN * known
        if self.verdict is Visibility.WEAK and weakened:
            return Hidden.PRELOAD
        return None

    def words(self, axis_name: str) -> str:
        """Describe it for a report: ``J1 is identifiable only through inertia: σ 3.1 %;
        add 5 s of … (σ 1.9 %)``.
        """
        through = " and ".join(source.value for source in self.sources)
        if not self.gravity_acts:
            shared = GainSource.COUPLING in self.sources
            through = "inertia" + (
                ", partly through parameters shared with other axes" if shared else ""
            )
        if len(self.sources) == 1 or not self.gravity_acts:
            only = "only "
        else:
            only = ""
        text = f"{axis_name} is not identifiable"
        if self.sources and np.isfinite(self.std_percent):
            std_percent = format_at_limit(self.std_percent, GOOD_PERCENT, 2, "g")
            text = f"{axis_name} is identifiable {only}through {through}: σ {std_percent} %"
        if self.hidden_by is Hidden.PRELOAD:
            text += f", {self.known_preload_percent:.2g} % if internal preload were known"
        if self.advice is None:
            return text
        improved_percent = format_at_limit(self.advice.std_percent, GOOD_PERCENT, 2, "g")
        return (
            f"{text}; add {self.advice.seconds:.0f} s of {self.advice.words} (σ "
            f"{improved_percent} %)"
        )


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
        known = self.known_preload_rank
        out = []
        if preloaded := self.hidden(Hidden.PRELOAD):
            worst = max((self.gains[axis] for axis in preloaded), key=lambda gain: gain.std_percent)
            out.append(
                f"Internal preload obscures {_named(preloaded, axis_names)}: σ up to "
                f"{worst.std_percent:.2g} %, {worst.known_preload_percent:.2g} % if it were known. "
                f"These moves determine {self.rank} of {len(self.gains)} independent directions of "
                f"the gains to {UNSEEN_PERCENT:g} %, with known preload {known}. Shift and turn "
                "the platform farther: while its pose hardly changes, preload passes for a change "
                "of the gains."
            )
        if unmoved := self.hidden(Hidden.MOTION):
            out.append(
                f"These moves do not show {_named(unmoved, axis_names)}"
                + (", nor would they if internal preload were known" if known is not None else "")
                + ": move there faster and farther, in both directions."
            )
        return tuple(out)


def _named(axes: Sequence[int], axis_names: Sequence[str]) -> str:
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
    information = np.sum([design.information_of(w, payloads) for w, payloads in whitened], axis=0)
    found = design.std_percent(information)
    without, known_rank = _with_known_preload(design, runs, whitened)
    own = _own_rows(design, runs, whitened)
    everything: tuple[int | None, ...] = (None, *range(len(design.expectation.payloads)))
    added = [
        (extra, information + design.information(extra.excitation, everything)) for extra in extras
    ]
    with_extras = [(extra, design.std_percent(sum_)) for extra, sum_ in added]
    judged = []
    for axis, std in enumerate(found.tolist()):
        blind = np.sum(
            [design.information_of(w, payloads, axis) for w, payloads in whitened], axis=0
        )
        gravity, inertia, acts = own[axis]
        alone = {
            GainSource.GRAVITY: gravity,
            GainSource.INERTIA: inertia,
            GainSource.COUPLING: float(design.std_percent(blind)[axis]),
        }
        if std <= UNSEEN_PERCENT:
            weak = Visibility.WEAK
        else:
            weak = Visibility.UNSEEN
        verdict = Visibility.GOOD if std <= GOOD_PERCENT else weak
        if verdict is Visibility.GOOD:
            advice = None
        else:
            advice = _advice(axis, std, with_extras)
        judged.append(GainVerdict(axis, std, without[axis], alone, acts, verdict, advice))
    return Identifiability(tuple(judged), design.rank(information), known_rank)


def _with_known_preload(
    design: Design, runs: Runs, whitened: Sequence[tuple[FloatArray, Sequence[int | None]]]
) -> tuple[Sequence[float | None], int | None]:
    """Deviations of the gains if internal preload were known [%], and the rank;
    None where there can be none.
    """
    if not design.expectation.model.is_redundant:
        return (None,) * len(design.expectation.gains), None
    parts = [
        design.information_of(design.with_known_preload(columns, excitation.use), payloads)
        for (excitation, _), (columns, payloads) in zip(runs, whitened, strict=True)
    ]
    information = np.sum(parts, axis=0)
    return design.std_percent(information).tolist(), design.rank(information)


def _advice(
    axis: int, std_percent: float, tried: Sequence[tuple[ExtraMoves, FloatArray]]
) -> Advice | None:
    better = [
        (float(found[axis]), index)
        for index, (_, found) in enumerate(tried)
        if found[axis] < std_percent
    ]
    if not better:
        return None
    best, index = min(better)
    return Advice(tried[index][0].words, tried[index][0].seconds, best)


def _own_rows(
    design: Design, runs: Runs, whitened: Sequence[tuple[FloatArray, Sequence[int | None]]]
) -> list[tuple[float, float, bool]]:
    """Judge gravity and inertia in each motor's own rows.

    Return for each motor the deviations that gravity and inertia of the known payload give alone
    [%], and whether gravity of any payload acts there.
    """
    count = len(design.expectation.gains)
    others: list[list[FloatArray]] = [[] for _ in range(count)]
    known: list[list[FloatArray]] = [[] for _ in range(count)]
    weights = np.zeros(count)
    wholes = np.zeros(count)
    for (excitation, _), (columns, payloads) in zip(runs, whitened, strict=True):
        motion = excitation.motion
        still = np.zeros_like(motion.position_rad)
        static = design.whitened(
            Excitation(Motion(motion.position_rad, still, still), excitation.use)
        )
        static = static[:, : design.width]
        moving = columns[:, : design.width]
        weights += np.einsum("nck,nck->n", static[:, -10:], static[:, -10:])
        wholes += np.einsum("nck,nck->n", moving[:, -10:], moving[:, -10:])
        for payload in payloads:
            place, source = design.columns(payload)
            # Columns of J for all unknowns but the gains
            rest = np.zeros((count, moving.shape[2], design.others))
            rest[:, :, place] = moving[:, source].transpose(0, 2, 1)
            if payload is None:
                mounted = np.zeros(design.width)
            else:
                mounted = design.known(payload)
            gravity = np.einsum("nck,c->nk", static, mounted)
            inertia = np.einsum("nck,c->nk", moving, mounted) - gravity
            for motor in range(count):
                others[motor].append(rest[motor])
                known[motor].append(np.stack((gravity[motor], inertia[motor]), axis=1))
    acts = (weights > 1e-12 * wholes).tolist()
    alone = [
        _beside(np.concatenate(o), np.concatenate(k)) for o, k in zip(others, known, strict=True)
    ]
    return [(gravity, inertia, act) for (gravity, inertia), act in zip(alone, acts, strict=True)]


def _beside(others: FloatArray, known: FloatArray) -> tuple[float, float]:
    """100 over the norm of each of two columns with the others projected out;
    inf where nothing is left.
    """
    norms = np.linalg.norm(others, axis=0)
    used = others[:, norms > 0.0] / norms[norms > 0.0]
    if used.shape[1]:
        left = known - used @ np.linalg.lstsq(used, known, rcond=1e-9)[0]
    else:
        left = known
    before = np.linalg.norm(known, axis=0)
    after = np.linalg.norm(left, axis=0)
    seen = after > 1e-6 * np.maximum(before.max(), 1e-300)
    with np.errstate(divide="ignore"):
        gravity, inertia = np.where(seen, 100.0 / after, np.inf).tolist()
    return gravity, inertia
