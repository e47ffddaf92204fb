"""What `residual` says of effects that held-out runs do not confirm, and which ones it writes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from daq.report.residual import verdict_sentences
from daq.report.residual_document import _verdict
from daq.workflow.fit import Fit, Undecided
from ident.calibration import AcceptedEffect
from ident.discovery.effect_verdict import EffectVerdict, Judgement
from ident.discovery.error_change import ErrorChange, PairedChange
from ident.effects.effect import PlacedEffect
from ident.effects.position import Spring
from ident.estimators.estimate import RelativeError

AXES = ("J1", "J2")
NO_CHANGE = ErrorChange(PairedChange(-1.0, 1.0, 9), (PairedChange(-1.0, 1.0, 9),) * 2, np.ones(2))


def _judged(judgement: Judgement, *, written: bool) -> EffectVerdict:
    before = RelativeError((3.0, 4.0), 3.5)
    after = RelativeError((3.0, 3.9), 3.4)
    placed = PlacedEffect(Spring(), 1)
    return EffectVerdict(placed, judgement, "because", NO_CHANGE, before, after, written=written)


def _said(verdict: EffectVerdict) -> list[str]:
    """The sentences of a fit, of which only the verdicts and the names of the axes count."""
    steps = (SimpleNamespace(verdicts=(verdict,)),)
    cell = SimpleNamespace(place_names=AXES)
    fitted = SimpleNamespace(steps=steps, cell=cell)
    return list(verdict_sentences(cast(Fit, fitted)))


@pytest.mark.parametrize(
    ("judgement", "written", "words"),
    [
        (Judgement.UNDECIDED, False, "Undecided, and not written: spring on J2: because; 3.50 %"),
        (
            Judgement.UNDECIDED,
            True,
            "Undecided, and written because of --write-undecided: spring on J2",
        ),
        (Judgement.REFUTED, False, "Held-out runs refute spring on J2: because; 3.50 %"),
        (Judgement.CONFIRMED, False, "Held-out runs confirm spring on J2, but"),
    ],
)
def test_what_is_not_confirmed_is_named_with_both_errors(
    judgement: Judgement, written: bool, words: str
) -> None:
    verdict = _judged(judgement, written=written)
    (sentence,) = _said(verdict)
    assert sentence.startswith(words)


def test_nothing_is_said_of_a_confirmed_effect_that_is_written() -> None:
    verdict = _judged(Judgement.CONFIRMED, written=True)
    assert _said(verdict) == []


def test_the_document_has_the_verdict() -> None:
    verdict = _judged(Judgement.UNDECIDED, written=False)
    entry = _verdict(verdict, AXES)
    expected = ("spring", "J2", "undecided", False, 9)
    assert (entry.effect, entry.axis, entry.judgement, entry.written, entry.blocks) == expected


@pytest.mark.parametrize(
    ("after", "harmless"), [(5.76, True), (5.81, True), (5.83, False), (4.0, True)]
)
def test_the_write_back_refuses_no_effect_for_less_than_a_hundredth(
    after: float, harmless: bool
) -> None:
    accepted_effect = AcceptedEffect("spring", "J2", {}, (), 5.76, after)
    assert accepted_effect.is_harmless == harmless


def test_the_options_choose_what_joins() -> None:
    assert Undecided.of(write=False, ignore_holdout=False) is Undecided.LEFT_OUT
    assert Undecided.of(write=True, ignore_holdout=False) is Undecided.JOIN
    assert Undecided.of(write=True, ignore_holdout=True) is Undecided.ALL_JOIN
