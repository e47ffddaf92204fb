"""Verdict on each gain: how well it is identifiable, through what, and which moves would improve it.

A gain is identifiable in three ways, and each is judged by the deviation that it would give alone:

- gravity: the known payload's static torque in the motor's own rows, beside all unknowns there;
- inertia: the rest of the known payload's torque in the motor's own rows;
- coupling: parameters that its rows share with those of other axes, whose gains are known by their own means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.model.kinematics import Motion
from ident.planning.excitation import Design, Excitation

GOOD_PERCENT = 1.0  #: Largest standard deviation of a good gain: drives are sold with gains known to some percent
UNSEEN_PERCENT = 10.0  #: Standard deviation above which the nameplate is the better source
SHARE_OF_BEST = 3.0  #: A source counts when it alone gives at most so many times the deviation of the best one


class Source(Enum):
    """Source of information about a gain."""

    GRAVITY = "gravity"
    INERTIA = "inertia"
    COUPLING = "coupling with other axes"


class Verdict(Enum):
    """How well a gain is identifiable."""

    GOOD = "good"
    WEAK = "weak"
    UNSEEN = "unseen"


@dataclass(frozen=True, slots=True, eq=False)
class ExtraMoves:
    """Moves that could be added to an experiment, made once without load and once with each payload."""

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
    std_percent: float  #: predicted standard deviation [% of the gain]; inf where it is not identifiable
    alone_percent: dict[Source, float]  #: standard deviation that each source would give alone [%]
    gravity_acts: bool  #: whether gravity of any body on the last link acts on this axis
    verdict: Verdict  #: good, weak or unseen
    advice: Advice | None  #: for a gain that is not good; None where no extra moves were offered or none helps

    @property
    def sources(self) -> tuple[Source, ...]:
        """Sources of information, the best first; empty for a gain that is not identifiable."""
        best = min(self.alone_percent.values())
        order = sorted(self.alone_percent.items(), key=lambda item: item[1])
        return tuple(source for source, alone in order if np.isfinite(alone) and alone <= SHARE_OF_BEST * best)

    def words(self, axis_name: str) -> str:
        """Describe it for a report: ``J1 is identifiable only through inertia: σ 3.1 %; add 5 s of … (σ 1.9 %)``."""
        through = " and ".join(source.value for source in self.sources)
        if not self.gravity_acts:
            shared = Source.COUPLING in self.sources
            through = "inertia" + (", partly through parameters shared with other axes" if shared else "")
        only = "only " if len(self.sources) == 1 or not self.gravity_acts else ""
        text = f"{axis_name} is not identifiable"
        if self.sources and np.isfinite(self.std_percent):
            text = f"{axis_name} is identifiable {only}through {through}: σ {self.std_percent:.2g} %"
        if self.advice is None:
            return text
        return f"{text}; add {self.advice.seconds:.0f} s of {self.advice.words} (σ {self.advice.std_percent:.2g} %)"


Runs = Sequence[tuple[Excitation, Sequence[int | None]]]
"""Motions, each with the payload of every repetition: an index into ``Expectation.payloads``, or None."""


def verdicts(design: Design, runs: Runs, extras: Sequence[ExtraMoves] = ()) -> tuple[GainVerdict, ...]:
    """Judge every gain of a planned or recorded experiment.

    Args:
        design: unknowns, expected parameters and gains, noise. After a fit: its gains, parameters and residuals.
        runs: for a plan ``[(excitation, (None, 0))]``, its moves without and with the payload; for recorded runs one
            pair each, ``(excitation, (None,))`` or ``(excitation, (payload,))``.
        extras: moves that could be added; for each gain that is not good the best of them is named.

    Returns:
        one verdict an axis, in their order.
    """
    whitened = [(design.whitened(excitation), payloads) for excitation, payloads in runs]
    information = np.sum([design.information_of(w, payloads) for w, payloads in whitened], axis=0)
    found = design.std_percent(information)
    own = _own_rows(design, runs, whitened)
    everything: tuple[int | None, ...] = (None, *range(len(design.expectation.payloads)))
    added = [(extra, information + design.information(extra.excitation, everything)) for extra in extras]
    with_extras = [(extra, design.std_percent(sum_)) for extra, sum_ in added]
    judged = []
    for axis, std in enumerate(found.tolist()):
        blind = np.sum([design.information_of(w, payloads, axis) for w, payloads in whitened], axis=0)
        gravity, inertia, acts = own[axis]
        alone = {
            Source.GRAVITY: gravity,
            Source.INERTIA: inertia,
            Source.COUPLING: float(design.std_percent(blind)[axis]),
        }
        weak = Verdict.WEAK if std <= UNSEEN_PERCENT else Verdict.UNSEEN
        verdict = Verdict.GOOD if std <= GOOD_PERCENT else weak
        advice = None if verdict is Verdict.GOOD else _advice(axis, std, with_extras)
        judged.append(GainVerdict(axis, std, alone, acts, verdict, advice))
    return tuple(judged)


def _advice(axis: int, std_percent: float, tried: Sequence[tuple[ExtraMoves, FloatArray]]) -> Advice | None:
    better = [(float(found[axis]), index) for index, (_, found) in enumerate(tried) if found[axis] < std_percent]
    if not better:
        return None
    best, index = min(better)
    return Advice(tried[index][0].words, tried[index][0].seconds, best)


def _own_rows(
    design: Design, runs: Runs, whitened: Sequence[tuple[FloatArray, Sequence[int | None]]]
) -> list[tuple[float, float, bool]]:
    """Judge gravity and inertia in each motor's own rows.

    Return for each motor the deviations that gravity and inertia of the known payload give alone [%], and whether
    gravity of any body on the last link acts there.
    """
    count = len(design.expectation.gains)
    others: list[list[FloatArray]] = [[] for _ in range(count)]
    known: list[list[FloatArray]] = [[] for _ in range(count)]
    weights, wholes = np.zeros(count), np.zeros(count)
    for (excitation, _), (columns, payloads) in zip(runs, whitened, strict=True):
        motion = excitation.motion
        still = np.zeros_like(motion.position_rad)
        static = design.whitened(Excitation(Motion(motion.position_rad, still, still), excitation.use))
        weights += np.einsum("nck,nck->n", static[:, -10:], static[:, -10:])
        wholes += np.einsum("nck,nck->n", columns[:, -10:], columns[:, -10:])
        for payload in payloads:
            rest = design.others_of(columns, payload)
            mounted = np.zeros(columns.shape[1]) if payload is None else design.known(payload)
            gravity = np.einsum("nck,c->nk", static, mounted)
            inertia = np.einsum("nck,c->nk", columns, mounted) - gravity
            for motor in range(count):
                others[motor].append(rest[motor])
                known[motor].append(np.stack((gravity[motor], inertia[motor]), axis=1))
    acts = (weights > 1e-12 * wholes).tolist()
    alone = [_beside(np.concatenate(o), np.concatenate(k)) for o, k in zip(others, known, strict=True)]
    return [(gravity, inertia, act) for (gravity, inertia), act in zip(alone, acts, strict=True)]


def _beside(others: FloatArray, known: FloatArray) -> tuple[float, float]:
    """100 over the norm of each of two columns with the others projected out; inf where nothing is left."""
    norms = np.linalg.norm(others, axis=0)
    used = others[:, norms > 0.0] / norms[norms > 0.0]
    left = known - used @ np.linalg.lstsq(used, known, rcond=1e-9)[0] if used.shape[1] else known
    before, after = np.linalg.norm(known, axis=0), np.linalg.norm(left, axis=0)
    seen = after > 1e-6 * np.maximum(before.max(), 1e-300)
    with np.errstate(divide="ignore"):
        gravity, inertia = np.where(seen, 100.0 / after, np.inf).tolist()
    return gravity, inertia
