"""The report of `residual`: it needs no other file, escapes what files say,
and its numbers are those of the rows.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from io import StringIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.table import Table

from daq.cli.app import main
from daq.cli.fit import check_report
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import as_document, load_calibration, save_calibration
from daq.environment import shipped_configurations
from daq.errors import EffectsRefuted, ExitCode, OutputFailed, UsageError, counted
from daq.report import residual_page as residual_page_module
from daq.report.document import json_text
from daq.report.effect_names import WORDS, effect_text, named_size, other_axis, variable_text
from daq.report.fit import coefficients
from daq.report.html import html_page, paragraph, table
from daq.report.plots import draw_fit
from daq.report.residual import (
    Headline,
    SentenceScreen,
    _effect_sentence,
    _gear_sentence,
    _hardly_shown_text,
    candidate_rows,
    error_change_text,
    gains_sentence,
    headline_of,
    residual_view,
    statistical_sentences,
    summary,
    turns_view,
)
from daq.report.residual_document import ResidualReport, residual_report
from daq.report.residual_page import DOCUMENT, PAGE, residual_page, save_report
from daq.report.text import Sentence, break_lines
from daq.workflow import fit as fit_module
from daq.workflow.fit import Fit, calibration_of, fit
from ident.calibration import AcceptedEffect, Calibration, Parameter
from ident.discovery import before_after as before_after_module
from ident.discovery.before_after import (
    Account,
    BeforeAfter,
    GainShift,
    RelativeErrors,
    account,
)
from ident.discovery.error_change import ErrorChange, PairedChange
from ident.discovery.evidence import with_effects
from ident.discovery.few_moves import RECORD, what_to_record
from ident.discovery.gear_loss import GearLoss
from ident.discovery.joining import SetAside
from ident.discovery.loop import Step
from ident.discovery.noise_floor import FloorSource, MotorNoiseFloor
from ident.discovery.search import Finding
from ident.discovery.time_skew import CurrentDelay
from ident.effects.dictionary import EFFECTS, GEOMETRY
from ident.effects.effect import PlacedEffect, Reported
from ident.effects.electrical import Saturation
from ident.effects.friction import Coupling, LoadFriction
from ident.effects.geometry_corrections import GravityDirection, ZeroOffset
from ident.effects.position import Spring
from ident.effects.signals import Abscissa
from ident.effects.transmission import InertialCoupling
from ident.effects.unnamed import Periodic, Smooth
from ident.errors import Diagnosis
from ident.estimators.estimate import RelativeError
from ident.model.model import Column
from ident.planning.gain_verdict import Advice, GainSource, GainVerdict, Visibility
from tests.daq.workflow.test_fit import Shelf
from tests.ident.recordings import GAINS, MOUNTED, record, tx40_truth

CREATED = datetime(2025, 1, 2, tzinfo=UTC)
SPRING = PlacedEffect(Spring(), 2)
NAMES = ("run0", "run1", "run2", "run3")
RESIDUAL = ("residual", *NAMES[:3], "--holdout", NAMES[3])
HOSTILE = '<script>alert("$x$")</script>&<img src=http://example.org/x>'
VOID = {"meta", "img", "br", "link"}
# Tags and attributes that would load another file.
LOADING_TAGS = {
    "script",
    "link",
    "iframe",
    "object",
    "embed",
    "base",
    "form",
    "a",
}
LOADING_ATTRIBUTES = ("src", "href", "srcset", "action", "data", "poster")


def finding(
    placed: PlacedEffect, *, passed: bool = True, rivals: tuple[PlacedEffect, ...] = ()
) -> Finding:
    coefficients = np.ones(len(placed.effect.coefficients))
    deviations = np.ones(len(placed.effect.coefficients))
    error_fall = 1.0 / 3.0
    left_out_fall = 100.0 if passed else 3.0
    fold_errors = np.ones(8)
    return Finding(
        effect=placed.effect,
        axis=placed.axis,
        coefficients=coefficients,
        deviations=deviations,
        probability=0.001,
        folds_better=1.0,
        explained=0.4,
        error_before_percent=9.0,
        error_after_percent=6.0,
        error_fall=error_fall,
        left_out_fall=left_out_fall,
        passed=passed,
        fold_errors=fold_errors,
        ambiguity=rivals,
    )


@dataclass(frozen=True)
class Closed:
    """A fit whose loop was closed by hand: a spring on J3 that is there."""

    fitted: Fit
    account: Account

    def page(self) -> str:
        calibration = calibration_of(self.fitted, CREATED)
        return residual_page(self.fitted, self.account, calibration)

    def document(self) -> dict[str, Any]:
        text = json_text(self.report())
        document: dict[str, Any] = json.loads(text)
        return document

    def report(self) -> ResidualReport:
        calibration = calibration_of(self.fitted, CREATED)
        return residual_report(self.fitted, self.account, calibration)

    def headline(self) -> tuple[str, ...]:
        """Sentences of `residual` before a calibration has effects."""
        return headline_of(self.fitted, self.account, ()).sentences()

    def summary(self) -> tuple[str, ...]:
        """Sentences of `residual --verbose` before a calibration has effects."""
        return summary(self.fitted, self.account, ())

    def with_account(self, **changes: Any) -> Closed:
        account = replace(self.account, **changes)
        return Closed(self.fitted, account)

    def with_fitted(self, **changes: Any) -> Closed:
        fitted = replace(self.fitted, **changes)
        return Closed(fitted, self.account)

    def with_last_step(self, **changes: Any) -> Closed:
        *before, last = self.fitted.steps
        changed = replace(last, **changes)
        return self.with_fitted(steps=(*before, changed))


def texts_with(words: str, texts: Iterable[str]) -> list[str]:
    return [text for text in texts if words in text]


def texts_starting(words: str, texts: Iterable[str]) -> list[str]:
    return [text for text in texts if text.startswith(words)]


def sentence_texts(parts: Iterable[RenderableType]) -> list[str]:
    return [part.text for part in parts if isinstance(part, Sentence)]


@pytest.fixture(scope="module")
def shelf() -> Shelf:
    """Three runs to fit and one to hold out, all with a spring on J3."""
    truth = tx40_truth()
    rng = np.random.default_rng(3)
    runs = {}
    for index, name in enumerate(NAMES):
        payload = MOUNTED if index % 2 else None
        run = record(truth, name, rng, payload, noise_a=0.3, seconds=22.0)
        current = run.current_a.copy()
        spring_nm = 4.0 * run.position_rad[:, 2]
        current[:, 2] += spring_nm / GAINS[2]
        digest = f"{index:064x}"
        runs[name] = replace(run, current_a=current, digest=digest)
    path = shipped_configurations() / "cells" / "demo.yaml"
    return Shelf(load_cell(path), runs)


@pytest.fixture(scope="module")
def shelved(shelf: Shelf) -> Iterator[Shelf]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", shelf.load)
        yield shelf


@pytest.fixture(scope="module")
def closed(shelved: Shelf) -> Closed:
    logs = [Path(name) for name in NAMES[:3]]
    holdout = [Path(NAMES[3])]
    fitted = fit(logs, holdout=holdout)
    start = fitted.evidence()
    after = with_effects(start, (SPRING,))
    rival = PlacedEffect(LoadFriction(0), 1)
    limits_nm = np.array([0.5, 1.25, 0.25, 0.1, 0.2, 0.05])
    accepted = finding(SPRING, rivals=(rival,))
    rejected = finding(rival, passed=False)
    structure = finding(PlacedEffect(Periodic(0), 3), passed=False)
    first = Step((accepted, rejected), (), limits_nm, accepted, after)
    last = Step((rejected,), (structure,), limits_nm, None, after)
    steps = (first, last)
    changed_fitted = replace(fitted, steps=steps)
    return Closed(changed_fitted, account(start, steps))


@pytest.mark.slow
def test_an_axis_that_rests_in_the_held_out_runs_has_the_error_of_moves_left_out(
    closed: Closed,
) -> None:
    """‖e‖/‖v‖ of nothing is no number."""

    def resting(errors: RelativeErrors) -> RelativeErrors:
        assert errors.holdout is not None
        axes = list(errors.holdout.axes)
        axes[SPRING.axis] = math.nan
        holdout = RelativeError(tuple(axes), errors.holdout.total)
        return replace(errors, holdout=holdout)

    turns: list[BeforeAfter | None] = []
    for turn in closed.account.turns:
        if turn is None:
            turns.append(None)
            continue
        before = resting(turn.before)
        after = resting(turn.after)
        turns.append(replace(turn, before=before, after=after))
    changed = closed.with_account(turns=tuple(turns))

    (found,) = texts_with("J3 has", changed.headline())

    assert "nan" not in found
    assert "on moves left out in turn" in found


@pytest.mark.slow
def test_a_search_says_what_the_torques_say_of_the_description(closed: Closed) -> None:
    """The gravity of the fit before the search, in `--verbose`, on the page and under --json."""
    check = closed.fitted.description
    assert check is not None
    assert check.gravity is not None
    turn_deg = np.degrees(check.gravity.turn_rad)
    std_deg = np.degrees(check.gravity.turn_std_rad)
    angle = f"{turn_deg:.2f} ± {std_deg:.2f}°"
    said = f"By the torques before the search, gravity is {angle}"

    calibration = calibration_of(closed.fitted, CREATED)
    shown = residual_view(closed.fitted, closed.account, calibration, verbose=True)
    sentences = [str(part) for part in shown if isinstance(part, Sentence)]
    (sentence,) = texts_with(said, sentences)
    assert "from its direction in the cell file" in sentence

    assert said in closed.page()

    gravity = closed.document()["geometry"]["gravity"]
    close_to_turn = pytest.approx(turn_deg, rel=1e-6)
    close_to_std = pytest.approx(std_deg, rel=1e-6)
    assert gravity["turn_deg"] == close_to_turn
    assert gravity["turn_std_deg"] == close_to_std


def test_gravity_is_placed_on_all_axes_in_the_document(closed: Closed) -> None:
    first, last = closed.fitted.steps
    placed = PlacedEffect(GravityDirection(), 0)
    findings = (*first.findings, finding(placed, passed=False))
    tried = replace(first, findings=findings)
    changed = closed.with_fitted(steps=(tried, last))

    document = changed.document()

    first_turn = document["turns"][0]
    found = first_turn["findings"][-1]
    assert found["effect"] == "gravity-direction"
    assert found["axis"] == "all axes"


@dataclass(frozen=True)
class Element:
    """A tag with its attributes."""

    tag: str
    attributes: dict[str, str | None]


class Reader(HTMLParser):
    """Takes a page apart; unbalanced tags fail at once."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[Element] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(self.texts)


@pytest.fixture(scope="module")
def whole_page(closed: Closed) -> str:
    """Its page with all pictures."""
    return closed.page()


@pytest.fixture(scope="module")
def shown(whole_page: str) -> Reader:
    """Its page, taken apart."""
    return Reader(whole_page)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without drawings, for tests of the words."""
    for name in ("draw_effect", "draw_torques", "plot_ranking"):
        monkeypatch.setattr(residual_page_module, name, lambda *_, **__: "")


def test_the_page_is_self_contained(shown: Reader) -> None:
    page = shown
    tags = {element.tag for element in page.elements}
    assert not tags & LOADING_TAGS
    for element in page.elements:
        assert not texts_starting("on", element.attributes)
        for name in LOADING_ATTRIBUTES:
            value = element.attributes.get(name)
            assert value is None
    style = texts_starting("\n:root", page.texts)[0]
    assert "url(" not in style
    assert "@import" not in style
    assert "img" not in tags
    drawings = [element for element in page.elements if element.tag == "svg"]
    assert all(drawing.attributes["aria-label"] for drawing in drawings)
    # Changes and errors, four of the effect, torques of six axes, gains, two rounds.
    assert len(drawings) == 2 + 4 + 6 + 1 + 2


def test_the_page_says_the_outcome_first(closed: Closed, shown: Reader) -> None:
    reported = closed.account.total
    assert reported.before.holdout is not None
    assert reported.after.holdout is not None
    before = reported.before.holdout.axes[2]
    after = reported.after.holdout.axes[2]
    page = shown

    first = texts_starting("J3 has a spring: the error", page.texts)[0]
    fall = f"from {before:.1f} to {after:.1f} % ("
    assert first.startswith(f"J3 has a spring: the error of J3 on held-out runs falls {fall}")
    sentence_place = page.texts.index(first)
    table_place = page.texts.index("Errors without and with the effects")
    assert sentence_place < table_place
    assert (
        "These data cannot distinguish it from: J2: friction that grows with the load."
    ) in page.text
    assert "1.2 Nm on J2" in page.text
    in_sample = reported.before.in_sample
    cross_validated = reported.after.cross_validated
    holdout = reported.after.holdout
    for error in (in_sample, cross_validated, holdout):
        assert f"{error.total:.2f}" in page.texts
    assert "scales all gains alike" in page.text


def test_an_effect_that_hardly_lowers_the_error_is_called_small(closed: Closed) -> None:
    (turn, *others) = closed.account.turns
    assert turn is not None
    assert turn.before.holdout is not None
    before = turn.before.holdout
    axes = tuple(0.95 * error for error in before.axes)
    nearly = replace(before, axes=axes)
    changed_after = replace(turn.after, holdout=nearly)
    small = replace(turn, after=changed_after)
    changed = closed.with_account(turns=(small, *others))

    sentences = changed.summary()
    start = "J3 has a spring, a small effect: the error of J3 on held-out"
    assert texts_starting(start, sentences)

    sentences = closed.summary()
    assert not texts_with("a small effect", sentences)


def test_what_files_say_is_escaped(closed: Closed) -> None:
    fitted = closed.fitted
    axes = []
    for axis in fitted.cell.axes:
        name = f"{axis.name}{HOSTILE}"
        axes.append(replace(axis, name=name))
    after = fitted.steps[-1].after
    datasets = tuple(replace(data, name=HOSTILE) for data in after.datasets)
    steps = []
    for step in fitted.steps:
        changed_after = replace(step.after, datasets=datasets)
        steps.append(replace(step, after=changed_after))
    sources = []
    for source in fitted.sources:
        sources.append(replace(source, name=HOSTILE, partial=True))
    cell = replace(fitted.cell, name=HOSTILE, axes=tuple(axes))
    hostile = closed.with_fitted(
        cell=cell,
        sources=tuple(sources),
        steps=tuple(steps),
    )

    text = hostile.page()

    assert "<script" not in text
    page = Reader(text)
    for element in page.elements:
        address = element.attributes.get("src") or "data:"
        assert address.startswith("data:")
    assert f"Cell {HOSTILE}" in page.texts


def test_the_document_has_the_numbers_of_the_rows(closed: Closed) -> None:
    reported = closed.account.total
    document = closed.document()

    reported_errors = {"before": reported.before, "after": reported.after}
    for key, errors in reported_errors.items():
        section = document[key]
        in_sample = section["relative_error_percent"]
        assert in_sample["axes"] == pytest.approx(errors.in_sample.axes)
        cross_validated = section["cross_validated_error_percent"]
        assert cross_validated["total"] == pytest.approx(errors.cross_validated.total)
        assert errors.holdout is not None
        holdout = section["holdout_error_percent"]
        assert holdout["axes"] == pytest.approx(errors.holdout.axes)
        assert section["left_out_runs"] is None

    gains = closed.fitted.identification.estimate.gains
    last_step = closed.fitted.steps[-1]
    final = last_step.after.estimate
    for motor, change in enumerate(document["gain_changes"]):
        axis_name = f"J{motor + 1}"
        gain_before = gains[motor]
        gain_after = final.gains[motor]
        gain_std = final.gains_std[motor]
        assert change["axis"] == axis_name
        assert change["before"] == pytest.approx(gain_before)
        assert change["after"] == pytest.approx(gain_after)
        assert change["after_std"] == pytest.approx(gain_std)

    first, last = document["turns"]
    (added,) = first["added"]
    assert added["effect"] == "spring"
    assert added["axis"] == "J3"
    stiffness = added["coefficients"][0]
    column = SPRING.columns[0]
    unknown_names = [unknown.name for unknown in final.unknowns]
    index = unknown_names.index(column.name)
    value = final.parameters[index]
    std = final.parameters_std[index]
    assert stiffness["value"] == pytest.approx(value)
    assert stiffness["std"] == pytest.approx(std)
    assert stiffness["unit"] == column.unit
    assert first["accepted"]["ambiguity"] == ["load-friction on J2"]
    rejected = first["findings"][1]
    assert rejected["ambiguity"] is None

    assert last["accepted"] is None
    assert last["added"] == []
    assert last["before"] is None
    first_structure = last["structures"][0]
    assert first_structure["effect"] == "periodic-motor-angle"
    second_limit = last["detection_limits"][1]
    assert second_limit == {"axis": "J2", "rms": 1.25, "unit": "Nm"}


def test_a_correction_of_the_description_is_shown_by_the_error_of_all_axes(closed: Closed) -> None:
    turn = closed.account.turns[0]
    assert turn is not None
    assert turn.before.holdout is not None
    assert turn.after.holdout is not None
    placed = PlacedEffect(ZeroOffset(), 1)
    step = closed.fitted.steps[0]
    sentence = _effect_sentence(closed.fitted, closed.account, turn, placed, step)
    before_percent = turn.before.holdout.total
    after_percent = turn.after.holdout.total
    change = error_change_text(before_percent, after_percent)
    assert sentence == (
        f"J2 has a zero that is off: the error of all axes on held-out runs {change}."
    )


def test_what_the_choice_of_effects_adds_to_sigma_is_said_where_it_counts(closed: Closed) -> None:
    """On J2 it is half of σ, on the others a tenth."""
    shares = (0.1, 0.5, 0.1, 0.1, 0.1, 0.1)
    gains = []
    for gain, share in zip(closed.account.total.gains, shares, strict=True):
        choice_std = share * gain.after_std
        gains.append(replace(gain, choice_std=choice_std))
    total = replace(closed.account.total, gains=tuple(gains))
    changed = closed.with_account(total=total)

    sentence = "σ of the gains includes the choice of the effects (squares add): 50 % of it on J2."
    assert sentence in changed.summary()
    sentences_before = closed.summary()
    assert not texts_with("choice of the effects", sentences_before)

    undecided = changed.with_last_step(left_open=(SPRING,))
    more = (
        f"{sentence} spring on J3 is not in the model and may be true: σ holds what that "
        "would move."
    )
    assert more in undecided.summary()

    document = changed.document()
    second_change = document["gain_changes"][1]
    assert second_change["choice_std"] == gains[1].choice_std


def test_the_document_is_complete_and_described(closed: Closed, checkout: Path) -> None:
    document = closed.document()
    first_turn = document["turns"][0]
    finding = first_turn["findings"][0]
    turn = document["turns"][0]
    reference_folder = checkout / "docs" / "reference"
    described = (reference_folder / "residual-json.md").read_text(encoding="utf-8")
    floors = document["noise_floor"]
    first_gain_change = document["gain_changes"][0]
    first_motor = floors["motors"][0]
    named = (
        document,
        turn,
        finding,
        document["before"],
        first_gain_change,
        floors,
        first_motor,
    )
    for key in set(chain.from_iterable(named)):
        assert f"`{key}`" in described, key
    position_cutoff_hz = document["filter"]["position_cutoff_hz"]
    assert position_cutoff_hz == closed.fitted.cell.conditioning.position_cutoff_hz
    before = set(document["before"])
    after = set(document["after"])
    assert before == after == set(turn["before"])
    text = json_text(closed.report())
    read_report = ResidualReport.model_validate_json(text, strict=False)
    assert read_report == closed.report()


def test_the_document_has_the_calibration_as_its_file_has_it(closed: Closed) -> None:
    calibration = as_document(calibration_of(closed.fitted, CREATED))
    document = closed.document()
    keys = list(calibration)
    first_keys = list(document)[: len(keys)]
    assert first_keys == keys
    section = {key: document[key] for key in keys}
    assert json.dumps(section) == json.dumps(calibration)


def test_what_to_check_comes_first(closed: Closed) -> None:
    odd = Diagnosis(
        "payload-differs",
        ("loaded-2",),
        (),
        "a body",
        "another",
        "was it turned?",
    )
    document = closed.with_fitted(diagnoses=(odd,)).document()
    sentence = "CHECK loaded-2: found a body; expected another; was it turned? (payload-differs)."
    assert document["summary"][0] == sentence
    first_diagnose = document["diagnoses"][0]
    assert first_diagnose["runs"] == ["loaded-2"]


def test_a_noise_floor_above_the_error_of_the_model_is_reported_with_its_cause(
    closed: Closed,
) -> None:
    left_a = [float(left) for left in closed.account.left_a]
    standstill = FloorSource.STANDSTILL
    moves = FloorSource.REPEATED_MOVES
    first_floor = MotorNoiseFloor(4.0 * left_a[0], standstill, 20, 100.0)
    second_floor = MotorNoiseFloor(2.0 * left_a[1], moves, 20, 100.0)
    bound = MotorNoiseFloor(0.9 * left_a[2], moves, 12, 100.0, is_bound=True)
    fourth_floor = MotorNoiseFloor(0.9 * left_a[3], standstill, 12, 100.0)
    floors = (first_floor, second_floor, bound, fourth_floor, None, None)
    refuted = closed.with_account(floors=floors)

    first, second = texts_with("no noise floor", refuted.summary())

    assert first.startswith(
        "J1 has no noise floor: its current at standstill scatters 4.0 times as much as"
    )
    assert second.startswith(
        "J2 has no noise floor: its current between repeated moves scatters 2.0 times"
    )
    motors = refuted.document()["noise_floor"]["motors"]
    are_refuted = [motor and motor["refuted"] for motor in motors]
    assert are_refuted == [True, True, False, False, None, None]
    third = motors[2]
    assert third["least"] == bound.least_a
    assert motors[3]["least"] is None
    dwells = [motor["dwells"] for motor in motors[:3]]
    assert dwells == [20, None, None]
    assert third["source"] == "repeated moves"
    assert third["pairs"] == 12
    assert third["left"] == pytest.approx(left_a[2])


def test_a_time_skew_is_stated_only_where_instruments_confirm_it(closed: Closed) -> None:
    """Least squares are certain of −3 ms in each of these."""
    biased = CurrentDelay(
        4e-5, 6e-5, fit_seconds=-3e-3, fit_std=4e-4, confirmed=False, is_in_model=False
    )
    confirmed = replace(biased, seconds=-2e-3, confirmed=True)
    sentence = "Currents were sampled 2.00 ± 0.06 ms before the positions, the same on every axis"
    for skew in (None, biased, confirmed):
        stated = skew is confirmed
        changed = closed.with_account(skew=skew)

        sentences = changed.summary()
        assert bool(texts_starting(sentence, sentences)) is stated
        assert bool(texts_with("Currents were sampled", sentences)) is stated
        in_ms = texts_with(" ms", sentences)
        assert texts_with("3.0", in_ms) == []

        shown = changed.headline()
        naming_skew = texts_with("skew", shown) + texts_with("sampled", shown)
        assert bool(naming_skew) is stated

        document = changed.document()
        stated_skew = {"seconds": -2e-3, "std": 6e-5} if stated else None
        assert document["time_skew"] == stated_skew
        tested = document["time_skew_by_instruments"]
        assert (tested is None) == (skew is None)
        if skew is not None:
            assert tested == asdict(skew)

    unknown = closed.with_account(skew=None)
    sentences = statistical_sentences(unknown.fitted, unknown.account)
    assert texts_starting("A time skew between currents and positions is not known", sentences)

    unconfirmed = closed.with_account(skew=biased)
    sentences = statistical_sentences(unconfirmed.fitted, unconfirmed.account)
    end = "is not confirmed: instruments from the demanded motion give 0.04 ± 0.06 ms."
    assert any(text.endswith(end) for text in sentences)


@dataclass(frozen=True)
class Screen:
    """Lines of a terminal."""

    text: str

    @property
    def lines(self) -> list[str]:
        return self.text.splitlines()


def _on_screen(parts: Iterable[RenderableType], columns: int) -> Screen:
    out = StringIO()
    console = Console(
        file=out,
        width=columns,
        soft_wrap=True,
        highlight=False,
        markup=False,
        force_terminal=True,
        color_system=None,
    )
    for part in parts:
        console.print(part)
    return Screen(out.getvalue())


def _with_three_effects(closed: Closed) -> Closed:
    """Two more effects with every kind of sentence:
    diagnoses, a skew, a refutation, findings that did not join.
    """
    first, last = closed.fitted.steps
    (turn, _) = closed.account.turns
    assert turn is not None
    load_friction = PlacedEffect(LoadFriction(0), 1)
    smooth = PlacedEffect(Smooth(Abscissa.POSITION), 4)
    after = replace(first.after, effects=(SPRING, load_friction, smooth))

    steps = [replace(first, after=after)]
    turns = [turn]
    for placed in (load_friction, smooth):
        accepted = finding(placed, rivals=(SPRING, load_friction))
        step = replace(first, accepted=accepted, findings=(accepted,), after=after)
        steps.append(step)
        turns.append(replace(turn, added=(placed,)))

    asides = []
    for axis in range(6):
        placed = PlacedEffect(LoadFriction(0), axis)
        asides.append(SetAside(finding(placed), moved=((3, 2.91),)))
    placed = PlacedEffect(LoadFriction(0), 3)
    failed = finding(placed, passed=False)
    refused = replace(failed, refusals=("coefficient is -1 ± 0.1",))
    ending = replace(
        last,
        after=after,
        set_aside=tuple(asides),
        findings=(refused,),
    )
    steps.append(ending)

    gains_before = closed.account.total.gains
    gains = tuple(replace(gain, significant=True) for gain in gains_before)
    skew = CurrentDelay(
        -2e-3, 6e-5, fit_seconds=-3e-3, fit_std=4e-4, confirmed=True, is_in_model=False
    )
    total = replace(closed.account.total, gains=gains)
    holdout_change = _holdout_change(1.3)
    account = replace(
        closed.account,
        turns=(*turns, None),
        total=total,
        holdout_change=holdout_change,
        skew=skew,
    )
    odd = Diagnosis(
        "payload-differs",
        ("loaded-2",),
        (),
        "a body",
        "another",
        "was it turned?",
    )
    fitted = replace(closed.fitted, steps=tuple(steps), diagnoses=(odd,))
    return Closed(fitted, account)


def _holdout_change(rise: float) -> ErrorChange:
    """Change of the whole error on 20 held-out blocks, with a σ of one, and of no motor."""
    total = PairedChange(rise, 1.0, 20)
    unchanged = PairedChange(0.0, 0.0, 0)
    return ErrorChange(total, (unchanged,) * 3, np.ones(3))


def _calibrated(made: Closed, effects: int) -> Calibration:
    fitted = replace(made.fitted, steps=())
    calibration = calibration_of(fitted, CREATED)
    ambiguity = ("load-friction on J2",) * 5
    worse = AcceptedEffect("spring", "J3", {}, (), 2.98, 3.11, ambiguity)
    accepted = (worse,) * effects
    return replace(calibration, effects=accepted, diagnoses=made.fitted.diagnoses)


OUTCOMES = (
    "CHECK loaded-2",
    "J3 has a spring",
    "J2 has friction",
    "J5 has a torque",
    "Currents were sampled",
)
STATISTICS = (
    "Turn 1",
    "Detection limit",
    "Not added",
    "failed a check",
    "may have",
    "scales all",
)


@pytest.mark.parametrize("columns", [80, 120])
def test_what_is_printed_fits_one_screen_and_breaks_no_word(closed: Closed, columns: int) -> None:
    made = _with_three_effects(closed)
    calibration = _calibrated(made, 3)
    parts = residual_view(made.fitted, made.account, calibration)
    screen = _on_screen(parts, columns)
    # Calibration, report and the next command follow, a line each.
    assert len(screen.lines) <= 40 - 3
    widths = [cell_len(line) for line in screen.lines]
    assert max(widths) <= columns

    # What does not fit a narrow screen is counted; what is there has the words of a wide one.
    parts = residual_view(made.fitted, made.account, calibration)
    wide_screen = _on_screen(parts, 10_000)
    wide_words = wide_screen.text.split()
    shown = [line for line in screen.lines if "sentences more:" not in line]
    shown_words = " ".join(shown).split()
    remaining = iter(wide_words)
    assert all(word in remaining for word in shown_words)
    some_are_counted = "sentences more:" in screen.text
    assert some_are_counted == (shown_words != wide_words)

    for words in OUTCOMES:
        assert words in wide_screen.text
    for gain in calibration.gains:
        assert f"{gain.std_percent:.2f}" in screen.text
        assert f"{gain.change_percent:+.1f}" in screen.text
    for words in STATISTICS:
        assert words not in screen.text


def one_spaced(text: str) -> str:
    """The words of a text, one space between them."""
    return " ".join(text.split())


@pytest.mark.usefixtures("undrawn")
def test_the_report_has_every_sentence_and_number_of_the_verbose_output(closed: Closed) -> None:
    made = _with_three_effects(closed)
    calibration = _calibrated(made, 3)
    page = Reader(residual_page(made.fitted, made.account, calibration))
    text = one_spaced(page.text)
    view = residual_view(made.fitted, made.account, calibration, verbose=True)
    parts = list(view)

    verbose_texts = sentence_texts(parts)
    sentences = [one_spaced(sentence.replace("`", "")) for sentence in verbose_texts]
    assert len(sentences) > 15
    # A command in a sentence is an element of its own on the page.
    changed_text = text.replace(" .", ".")
    joined = one_spaced(changed_text.replace(" ,", ","))
    missing = [one for one in sentences if one not in joined and one not in text]
    assert missing == []

    listed = {one_spaced(one) for one in page.texts}
    tables = [part for part in parts if isinstance(part, Table)]
    expected = len(made.fitted.steps) + 2
    assert len(tables) == expected
    for table_ in tables[:-1]:
        cells = []
        for column in table_.columns:
            for cell in (column.header, *column.cells):
                cells.append(str(cell))
        missing = [cell for cell in cells if cell and cell not in listed]
        assert missing == []

    # The verbose output has what the screen has.
    shown = residual_view(made.fitted, made.account, calibration)
    short = sentence_texts(shown)[:-1]
    assert set(short) <= set(verbose_texts)


@pytest.mark.slow
def test_the_dependence_on_the_mass_is_in_the_documents_and_in_a_sentence(
    closed: Closed, tmp_path: Path
) -> None:
    cell = closed.fitted.cell
    payloads = tuple(replace(one, mass_tolerance_kg=0.0459) for one in cell.payloads)
    weighed_cell = replace(cell, payloads=payloads)
    weighed = replace(closed.fitted, cell=weighed_cell)
    calibration = calibration_of(weighed, CREATED)
    (payload,) = residual_report(weighed, closed.account, calibration).payload_mass
    assert payload.tolerance_kg == 0.0459
    for one, gain in zip(payload.gains, calibration.gains, strict=True):
        assert one.percent_per_percent == pytest.approx(1.0, abs=0.01)
        gain_per_kg = gain.value / payload.mass_kg
        gain_tolerance = abs(one.per_kg) * 0.0459
        assert one.per_kg == pytest.approx(gain_per_kg, rel=0.01)
        assert one.tolerance_std == pytest.approx(gain_tolerance)
    verbose = residual_view(weighed, closed.account, calibration, verbose=True)
    sentences = sentence_texts(verbose)
    assert texts_with("which is ± 1 % of every gain, not included in σ", sentences)
    # The file has it, and one of an earlier version is read without.
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    assert load_calibration(path).payload_mass == calibration.payload_mass
    earlier = yaml.safe_load(path.read_text(encoding="utf-8"))
    del earlier["payload_mass"], earlier["digests"]["payload_mass"]
    text = yaml.safe_dump(earlier, sort_keys=False, allow_unicode=True)
    path.write_text(text, encoding="utf-8")
    assert load_calibration(path).payload_mass == ()


def test_the_summary_says_what_the_effects_change(closed: Closed) -> None:
    same = unchanged_gains(closed)
    total = replace(closed.account.total, gains=tuple(same))
    unchanged = closed.with_account(total=total)
    sentence = "With and without the effects, the gains are the same within noise."
    assert sentence in unchanged.summary()

    first = replace(closed.account.total.gains[0], significant=True)
    total = replace(closed.account.total, gains=(first, *same[1:]))
    changed = closed.with_account(total=total)
    sentence = (
        "The effects change gains by more than noise (probability below 1 % among all axes): "
        f"J1 by {first.change_percent:+.1f} % of the gain without them."
    )
    assert sentence in changed.summary()


def unchanged_gains(closed: Closed) -> list[GainShift]:
    """Its gains as if the effects changed none of them."""
    gains = []
    for gain in closed.account.total.gains:
        gains.append(replace(gain, after=gain.before, significant=False))
    return gains


@pytest.mark.parametrize(
    ("percent", "std_percent", "said"),
    [
        (-13.5, 4.3, "the largest difference is -13.5 ± 4.3 % of the gain of J5 without them."),
        (0.3, 0.1, "the largest difference is +0.30 ± 0.10 % of the gain of J5 without them."),
        (1.0, 0.8, "the largest difference is +1.00 ± 0.80 % of the gain of J5 without them."),
        (0.3, 0.2, ""),
    ],
    ids=[
        "just missed among six axes",
        "beyond its own noise",
        "above the target of the cell",
        "within noise",
    ],
)
def test_a_gain_that_differs_is_not_called_the_same(
    closed: Closed, percent: float, std_percent: float, said: str
) -> None:
    shifts = unchanged_gains(closed)
    before = shifts[4].before
    after = before * (1.0 + 0.01 * percent)
    change_std = 0.01 * std_percent * abs(before)
    shifts[4] = replace(shifts[4], after=after, change_std=change_std)
    total = replace(closed.account.total, gains=tuple(shifts))
    changed = replace(closed.account, total=total)
    assert closed.fitted.cell.target_sigma_percent == 0.5
    sentence = gains_sentence(closed.fitted, changed)
    assert ("the same within noise" in sentence) == (not said)
    assert sentence.endswith(said)


def test_what_the_fit_has_checked_is_taken_up_where_the_effects_explain_it(closed: Closed) -> None:
    large = Diagnosis(
        "axis-error", (), ("J3",), "an error of 2.1 in 8 Nm (or N), 26.6 %", "3 to 15 %", "look"
    )
    other = replace(large, axes=("J5",))
    zero = Diagnosis(
        "zero-turned", (), ("J2",), "the zero of J2 off by about +35 deg", "another", "add it"
    )
    corrected = Diagnosis(
        "zero-off", (), ("J2",), "the zero of J2 off by +35.0 ± 0.1°", "another", "add it"
    )
    diagnoses_before = (large, other, zero)
    diagnoses = (other, corrected)
    changed = closed.with_fitted(diagnoses_before=diagnoses_before, diagnoses=diagnoses)

    (said,) = texts_starting("Without the effects", changed.headline())

    assert said.startswith(
        "Without the effects, the fit said CHECK J3: an error of 2.1 in 8 Nm (or N), 26.6 % "
        "(axis-error). With them it does not: the error of the current of J3 on held-out runs "
        "falls from"
    )


def test_an_estimate_of_the_noise_is_said_where_it_has_no_lower_limit(closed: Closed) -> None:
    nan = math.nan
    unknown = RelativeError((nan,) * 6, nan)
    estimate = RelativeError((nan, nan, 1.7, nan, nan, nan), nan)
    without_limit = closed.with_account(least_holdout_floor=unknown, least_floor=unknown)

    judged = without_limit.with_account(holdout_floor=estimate)
    (sentence,) = texts_starting("J3 has", judged.headline())
    assert sentence.endswith("(noise leaves 1.7 %, an estimate).")

    judged = without_limit.with_account(holdout_floor=unknown)
    (sentence,) = texts_starting("J3 has", judged.headline())
    assert sentence.endswith("(noise floor not known).")


def test_a_correction_that_the_error_hardly_shows_has_its_own_sigma_and_the_axis_that_shows_it(
    closed: Closed,
) -> None:
    turn = closed.account.turns[0]
    assert turn is not None
    axes = (3.2, 2.0, 3.0, 3.0, 3.0, 3.0)
    errors = RelativeError(axes, 3.12)
    before = replace(turn.before, holdout=errors)
    holdout = RelativeError((3.0, 2.0, 3.0, 3.0, 3.0, 3.0), 3.09)
    after = replace(turn.after, holdout=holdout)
    small = replace(turn, before=before, after=after)
    placed = PlacedEffect(ZeroOffset(), 1)
    first_step = closed.fitted.steps[0]
    sentence = _effect_sentence(
        closed.fitted,
        closed.account,
        small,
        placed,
        first_step,
    )
    assert sentence == (
        "J2 has a zero that is off: it hardly shows in the error of all axes on held-out runs, "
        "3.12 % without it and 3.09 % with it; most in that of J1, 3.20 and 3.00 %."
    )
    spring = closed.fitted.steps[0].after
    (size,) = coefficients(spring, SPRING)
    step = closed.fitted.steps[0]
    text = _hardly_shown_text(closed.fitted, SPRING, step, errors, errors, "here")
    sigmas = abs(size.value / size.std)
    assert text.startswith(f", by {sigmas:.0f} σ: it hardly shows")


def test_the_moves_that_would_help_are_named_after_a_search_too(closed: Closed) -> None:
    advice = Advice("moves with the payload", 60.0, 0.8)
    alone_percent = {GainSource.GRAVITY: 2.4}
    weak = GainVerdict(4, 2.4, None, alone_percent, True, Visibility.WEAK, advice)
    uncertain = closed.with_fitted(uncertain=(weak,))
    (said,) = texts_starting("Excitation: J5", uncertain.headline())
    assert "add 60 s of moves with the payload (σ 0.8 %)" in said

    sentences = closed.headline()
    assert not texts_starting("Excitation", sentences)


def test_the_kind_of_the_errors_is_said_where_several_motors_act_on_a_joint(closed: Closed) -> None:
    (said,) = texts_with("motors' currents", closed.summary())
    assert said.endswith("differ where several motors act on a joint (J5).")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_silence_is_reported_with_its_size(closed: Closed) -> None:
    start = closed.fitted.evidence()
    silent_step = replace(closed.fitted.steps[-1], after=start)
    silent_fit = replace(closed.fitted, steps=(silent_step,))
    silent = Closed(silent_fit, account(start, silent_fit.steps))
    outcome, limits, *_ = silent.summary()
    assert outcome.startswith("No structure found")
    assert "1.2 Nm on J2" in limits
    assert "no common clock: a warm-up over the session cannot be seen" in limits

    timed = []
    for index, data in enumerate(start.datasets):
        timed.append(replace(data, started_s=100.0 * index))
    clocked_start = replace(start, datasets=tuple(timed))
    clocked = silent.with_last_step(after=clocked_start)
    sentences = clocked.summary()
    assert texts_with("clock", sentences) == []

    nothing_tried = silent.with_last_step(findings=(), structures=())
    page = Reader(nothing_tried.page())
    assert "No structure found" in page.text
    assert "No candidate could be tried." in page.text


def test_a_strong_candidate_that_failed_a_check_is_named_with_it(closed: Closed) -> None:
    placed = PlacedEffect(LoadFriction(0), 1)
    failed = finding(placed, passed=False)
    strong = replace(failed, explained=0.4, refusals=("coefficient is -1 ± 0.1",))
    weak = replace(strong, axis=2, explained=0.1)
    changed = closed.with_last_step(findings=(weak, strong))

    sentences = texts_with("failed a check", changed.summary())

    assert sentences == [
        "J2: friction that grows with the load would explain 40 % of the squared residual, but "
        "failed a check: coefficient is -1 ± 0.1. The cause may be another one."
    ]


def test_a_first_candidate_that_physics_alone_refuses_is_named_however_little_it_explains(
    closed: Closed,
) -> None:
    why = "coefficient is -1 ± 0.1 ; physics allows no less than 0"
    placed = PlacedEffect(LoadFriction(0), 1)
    failed = finding(placed, passed=False)
    refused = replace(failed, explained=0.1, refusals=(why,), impossible=why)
    second = replace(refused, effect=Spring())
    noise = replace(
        refused,
        axis=2,
        refusals=("noise makes one as strong with p = 0.400", why),
    )

    # Without --verbose, too.
    changed = closed.with_last_step(findings=(refused, second, noise))
    (sentence,) = texts_with("impossible", changed.headline())
    assert sentence == (
        "J2: friction that grows with the load ranks first on this axis, but its sign or size is "
        f"impossible: {why}. The cause may be another one."
    )

    explaining_much = replace(refused, explained=0.4)
    changed = closed.with_last_step(findings=(explaining_much,))
    sentences = texts_with(why, changed.summary())
    assert len(sentences) == 1


def test_a_candidate_that_was_not_tested_has_no_probability(closed: Closed) -> None:
    why = (
        "it rests on two moves, too few to test it: record more moves with a large current of "
        "this axis"
    )
    placed = PlacedEffect(LoadFriction(0), 1)
    failed = finding(placed, passed=False)
    untested = replace(failed, probability=None, explained=0.4, refusals=(why,))
    changed = closed.with_last_step(findings=(untested,))

    last_step = changed.fitted.steps[-1]
    row = next(candidate_rows(changed.fitted, last_step, 1))
    assert row[2] == "–"

    (sentence,) = texts_with(why, changed.summary())
    assert "p =" not in sentence

    calibration = calibration_of(closed.fitted, CREATED)
    report = residual_report(changed.fitted, changed.account, calibration)
    findings = report.turns[-1].findings
    assert findings[0].probability is None


def test_a_small_candidate_on_few_moves_is_named_with_what_to_record(closed: Closed) -> None:
    two_moves_only = np.zeros((20, 1, 1))
    two_moves_only[:2] = 1.0
    why = what_to_record(Saturation(), two_moves_only, None)
    placed = PlacedEffect(Saturation(), 1)
    small = finding(placed, passed=False)
    untested = replace(small, explained=0.01, refusals=(why,), too_few_moves=why)
    weaker = replace(untested, effect=Spring())
    impossible = replace(
        untested, axis=2, impossible="coefficient is -1 ± 0.1; physics allows no less than 0"
    )
    no_help = replace(untested, axis=3, left_out_fall=-1.0)
    few_folds = replace(untested, axis=4, folds_better=0.5)
    tiny = replace(untested, axis=5, explained=0.001)
    findings = (untested, weaker, impossible, no_help, few_folds, tiny)
    changed = closed.with_last_step(findings=findings)

    (sentence,) = texts_with("rests on", changed.summary())

    effect = effect_text(Saturation(), ())
    moves = RECORD[Abscissa.CURRENT]
    assert sentence == (
        f"These moves do not tell whether J2 has {effect}: it rests on two "
        f"moves, too few to test it: record more {moves}."
    )


def test_a_name_that_structure_refutes_is_reported_with_what_it_depends_on(closed: Closed) -> None:
    effect = Smooth(Abscissa.POSITION)
    term = PlacedEffect(effect, 1)
    placed = PlacedEffect(LoadFriction(0), 1)
    name = finding(placed)
    moved = ((3, 2.91),)
    refuted = SetAside(name, "{rival} explains clearly more", term, moved)
    axis_names = [f"J{axis}" for axis in range(1, 7)]
    reason = refuted.reason(axis_names)
    assert reason == (
        "it would move the gain of J4 by 2.9 σ, and smooth-position on J2 explains clearly more"
    )
    changed = closed.with_last_step(set_aside=(refuted,))
    sentences = changed.summary()
    assert (
        "J2: what looks like friction that grows with the load depends clearly more on the joint "
        "position, and was not added: it would move the gain of J4 by 2.9 σ."
    ) in sentences


@pytest.mark.usefixtures("undrawn")
def test_what_did_not_join_is_reported_with_the_reason(closed: Closed) -> None:
    first, last = closed.fitted.steps
    effect = Smooth(Abscissa.LOAD)
    placed = PlacedEffect(effect, 1)
    unnamed = SetAside(finding(placed), moved=((3, 2.91),))
    load_friction = PlacedEffect(LoadFriction(0), 1)
    replaced = SetAside(finding(load_friction), "{rival} explains more", SPRING)
    changed_first = replace(first, set_aside=(replaced, unnamed))
    changed_last = replace(last, set_aside=(unnamed,))
    changed = closed.with_fitted(steps=(changed_first, changed_last))

    sentences = changed.summary()
    of_unnamed = texts_with(
        "and was not added: it has no name, and would move the gain of J4 by 2.9 σ", sentences
    )
    assert len(of_unnamed) == 1
    assert texts_with("J2 may have friction that grows with the load: it would", sentences)
    assert texts_with("added: spring on J3 explains more.", sentences)

    turns = changed.document()["turns"]
    set_aside = turns[1]["set_aside"]
    assert set_aside[0]["reason"].endswith("the gain of J4 by 2.9 σ")

    page = Reader(changed.page())
    assert (
        "Not added to J2: a torque that depends on the load torque and that no named effect "
        "explains: it has no name" in page.text
    )


def read_document(folder: Path) -> Any:
    text = (folder / DOCUMENT).read_text(encoding="utf-8")
    return json.loads(text)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_effects_that_held_out_runs_refute_are_not_written(
    closed: Closed,
    shelved: Shelf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    del shelved
    out = tmp_path / "calibration.yaml"
    folder = tmp_path / "report"
    change = _holdout_change(5.0)
    monkeypatch.setattr(
        before_after_module,
        "compare_on_holdout",
        lambda *_: change,
    )
    monkeypatch.setattr(fit_module, "compare_on_holdout", lambda *_: change)
    for name in ("fit", "close_loop"):
        monkeypatch.setattr(fit_module, name, lambda *_, **__: closed.fitted)
    command = [*RESIDUAL, "--out", str(out), "--report", str(folder)]
    assert main(command) == ExitCode.DATA_UNFIT
    message = capsys.readouterr().err
    assert "spring on J3" in message
    assert "--accept-worse-holdout" in message
    assert not out.exists()
    text = (folder / PAGE).read_text(encoding="utf-8")
    assert "no calibration was written" in text
    assert main([*command, "--accept-worse-holdout"]) == ExitCode.OK
    assert "because --accept-worse-holdout was given" in capsys.readouterr().out
    assert out.exists()
    document = read_document(folder)
    assert document["worse_holdout"] is True
    with pytest.raises(EffectsRefuted, match="20 independent blocks of moves"):
        fit_module.check_holdout(closed.fitted)


def test_effects_that_the_cell_declares_are_in_both_models_of_the_comparison(
    closed: Closed, monkeypatch: pytest.MonkeyPatch
) -> None:
    change = _holdout_change(5.0)
    monkeypatch.setattr(fit_module, "compare_on_holdout", lambda *_: change)
    last = closed.fitted.steps[-1]
    assert last.after.effects
    steps = (replace(last, declared=True),)
    changed_fitted = replace(closed.fitted, steps=steps)
    fit_module.check_holdout(changed_fitted)
    fitted = replace(closed.fitted, steps=(last,))
    with pytest.raises(EffectsRefuted):
        fit_module.check_holdout(fitted)


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--json",)])
def test_what_was_found_is_printed_although_the_disk_is_full(
    closed: Closed,
    shelved: Shelf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
) -> None:
    del shelved

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for name in ("fit", "close_loop"):
        monkeypatch.setattr(fit_module, name, lambda *_, **__: closed.fitted)
    monkeypatch.setattr(os, "fsync", full)
    out = tmp_path / "calibration.yaml"
    command = [*RESIDUAL, "--out", str(out), *options]

    assert main(command) == ExitCode.UNEXPECTED

    text, message = capsys.readouterr()
    assert "J3 has a spring" in text
    assert "Written" not in text
    assert "no space left" in message.lower()
    assert not list(tmp_path.iterdir())


def test_a_rise_within_noise_is_said_with_what_apply_will_refuse(closed: Closed) -> None:
    worse = AcceptedEffect("spring", "J3", {}, (), 2.98, 3.11)
    change = _holdout_change(1.3)
    changed_account = replace(closed.account, holdout_change=change)
    sentences = summary(closed.fitted, changed_account, (worse,))
    (total,) = texts_starting("All axes together", sentences)
    assert total.endswith(", within its noise (1.3 σ): the effects are kept, but not confirmed.")
    (refused,) = texts_starting("`apply` refuses", sentences)
    assert (
        "with spring on J3: on data that the fit did not use, the torque error is 3.11 % with "
        "it, 2.98 %"
    ) in refused

    better = replace(worse, error_after_percent=2.97)
    change = _holdout_change(-1.0)
    lower = replace(closed.account, holdout_change=change)
    sentences = summary(closed.fitted, lower, (better,))
    assert not texts_with("within its noise", sentences)
    assert not texts_with("`apply` refuses", sentences)


def test_the_candidate_that_was_added_is_listed_wherever_it_ranks(closed: Closed) -> None:
    first = closed.fitted.steps[0]
    places = [PlacedEffect(LoadFriction(0), axis) for axis in range(6)]
    rivals = [finding(placed, passed=False) for placed in places]
    findings = (*rivals * 3, first.findings[0])
    late = replace(first, findings=findings, structures=())
    fitted = replace(closed.fitted, steps=(late,))
    (table, *_) = turns_view(fitted)
    assert isinstance(table, Table)
    cells = list(table.columns[0].cells)
    assert cells[-1] == "spring"
    last_column = table.columns[-1]
    last_cell = list(last_column.cells)[-1]
    assert last_cell == "pass"
    assert table.row_count == 7


def test_what_rises_is_not_said_to_fall() -> None:
    assert error_change_text(6.94, 2.8) == "falls from 6.9 to 2.8 %"
    assert error_change_text(2.8, 6.9) == "rises from 2.8 to 6.9 %"
    assert error_change_text(2.39, 2.34) == "falls slightly, from 2.4 to 2.3 %"
    assert error_change_text(2.34, 2.39) == "rises from 2.3 to 2.4 %"
    assert error_change_text(2.4, 2.1) == "falls from 2.4 to 2.1 %"
    assert error_change_text(2.81, 2.79) == "stays at 2.8 %"


def test_a_zero_is_read_in_degrees_and_a_slide_in_metres() -> None:
    offset_rad = -math.radians(2.0)
    std_rad = math.radians(0.04)
    turned = Parameter("zero-offset offset 3", offset_rad, std_rad, "rad")
    text = named_size(ZeroOffset(), (turned,))
    assert text == "offset -2.000 ± 0.040°, to be added to its position"

    moved = Parameter("zero-offset offset 1", 0.003, 0.0001, "m")
    text = named_size(ZeroOffset(), (moved,))
    assert text == "offset 0.00300 ± 0.00010 m, to be added to its position"


@dataclass(frozen=True, slots=True)
class OfOthers(Spring):
    """An effect of one's own, whose coefficients have names and units of the dictionary's."""

    name = "of-others"
    coefficients = (Column("cosine", "s"), Column("sine", "Nm/Nm"))  # type: ignore[assignment]


class OneAmplitude(OfOthers):
    """The same, which declares that they are of one angle."""

    __slots__ = ()
    reported = Reported.AMPLITUDE


def test_coefficients_are_given_as_their_class_says_and_not_by_name_or_unit() -> None:
    parameter = Parameter("c", 3.0, 0.1, "s")
    found = (parameter, Parameter("d", 4.0, 0.1, "Nm/Nm"))
    assert named_size(OfOthers(), found) == "cosine 3.00 ± 0.10 s, sine 4.00 ± 0.10 Nm/Nm"
    assert named_size(OneAmplitude(), found) == "amplitude 5.00 ± 0.10 s"


def test_effects_are_called_by_words_and_axes_by_names() -> None:
    axes = ("base", "arm", "wrist")
    effect = Coupling(3, 1)
    assert PlacedEffect(effect, 0).name_among(axes) == "coupling on base with wrist"
    coupling = Coupling(3, 1)
    assert effect_text(coupling, axes) == "friction shared with wrist"
    term = Smooth(Abscissa.OTHER_VELOCITY, other_axis=2)
    assert effect_text(term, axes) == (
        "a torque that depends on the velocity of arm and that no named effect explains"
    )
    assert variable_text(InertialCoupling(3), axes) == "the acceleration of wrist"
    assert other_axis(Spring()) is None
    families = (*EFFECTS, *GEOMETRY)
    family_names = {family[0].name for family in families}
    assert set(WORDS) <= family_names


def test_a_folder_that_holds_something_else_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_report(None)
    folder_folder = tmp_path / "new" / "folder"
    check_report(folder_folder)
    assert (tmp_path / "new" / "folder").is_dir()
    for name in (PAGE, DOCUMENT):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("the user's own", encoding="utf-8")
        with pytest.raises(UsageError, match=name):
            check_report(folder)
        # The logs are not read: they do not exist.
        exit_code = main(["residual", "no.mcap", "--report", str(folder)])
        assert exit_code == ExitCode.USAGE
        assert name in capsys.readouterr().err
        text = (folder / name).read_text(encoding="utf-8")
        assert text == "the user's own"
    occupied = tmp_path / "file"
    occupied.write_text("", encoding="utf-8")
    with pytest.raises(UsageError, match="found a file of that name; expected a folder"):
        check_report(occupied)


def test_a_folder_that_takes_no_file_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    # As a file system says it to everybody but root, who may write anywhere.
    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    exit_code = main(["residual", "no.mcap", "--report", str(tmp_path)])
    assert exit_code == ExitCode.UNEXPECTED
    assert "permission denied" in capsys.readouterr().err
    monkeypatch.undo()
    check_report(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "unseen", ["\x1b", "\u202e", "\u2066", "\u200b", "\x00", "\x85", "\u2028", "\ud800"]
)
def test_what_is_not_seen_is_spelt_out(unseen: str) -> None:
    header = [unseen] * 2
    row = [unseen] * 2
    body = [paragraph(unseen), table(unseen, header, [row])]
    title = f"a{unseen}b"
    text = html_page(title, body)
    assert unseen not in text
    code = f"{ord(unseen):04x}"
    assert f"<title>a\\u{code}b</title>" in text
    text.encode()


def test_what_is_seen_stays_as_it_is() -> None:
    assert (
        paragraph("‖ρ‖/‖Y‖ ± σ, 3 µm, 机械手, naïve\nnext")
        == "<p>‖ρ‖/‖Y‖ ± σ, 3 µm, 机械手, naïve\nnext</p>"
    )


def contents(folder: Path) -> dict[str, bytes]:
    """Its files by their names."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_disk_that_fails_leaves_the_old_report(
    closed: Closed, whole_page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibration = calibration_of(closed.fitted, CREATED)
    save_report(closed.fitted, closed.account, calibration, tmp_path)
    old = contents(tmp_path)
    assert set(old) == {PAGE, DOCUMENT}
    assert old[PAGE].decode() == whole_page  # drawn a second time
    check_report(tmp_path)
    monkeypatch.setattr(
        residual_page_module,
        "residual_page",
        lambda *_: whole_page,
    )
    save_report(closed.fitted, closed.account, calibration, tmp_path)
    assert contents(tmp_path) == old

    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(
        residual_page_module,
        "residual_page",
        lambda *_: "another page",
    )
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputFailed, match="no space"):
        save_report(closed.fitted, closed.account, calibration, tmp_path)
    assert contents(tmp_path) == old


def test_a_disk_that_fails_leaves_the_old_pictures(
    closed: Closed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "torques.svg"
    old.write_bytes(b"the old one")

    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    calibration = calibration_of(closed.fitted, CREATED)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(OSError, match="No space"):
            draw_fit(closed.fitted, calibration, None, tmp_path)
    assert old.read_bytes() == b"the old one"
    assert list(tmp_path.iterdir()) == [old]
    draw_fit(closed.fitted, calibration, None, tmp_path)
    pictures = {path.name for path in tmp_path.iterdir()}
    assert pictures == {"torques.svg", "gains.png", "residual-J3-spring.svg"}


@pytest.mark.slow
def test_the_verb_writes_the_report_and_says_the_same(
    shelved: Shelf, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "report"
    command = [*RESIDUAL, "--report", str(folder), "--verbose"]
    assert main(command) == ExitCode.OK
    text, progress = capsys.readouterr()
    assert "adding spring on J3" in progress

    document = read_document(folder)
    assert document["format"] == "drivegain-residual"
    assert document["version"] == 1
    first_keys = list(document)[:3]
    assert first_keys == ["format", "version", "cell"]

    assert "axis 3" not in text
    assert "J3 has a spring" in text
    for sentence in document["summary"]:
        assert sentence in text

    rows = {}
    for line in text.splitlines():
        if ", " in line[:30]:
            name, *values = line.rsplit(maxsplit=7)
            rows[name.strip()] = values
    key_of_row = {"fit": "relative_error_percent", "held out": "holdout_error_percent"}
    for name, key in key_of_row.items():
        for when in ("before", "after"):
            error = document[when][key]
            percents = [*error["axes"], error["total"]]
            row = rows[f"{name}, {when}"]
            printed = [float(value) for value in row]
            assert printed == pytest.approx(percents, abs=0.005)

    assert "scales all gains alike" in text
    expected = f"Written: {folder}/ (certificate: {folder}/report.html)"
    last_line = text.splitlines()[-1]
    assert last_line == expected
    noise_floor = document["noise_floor"]["relative_error_percent"]
    total = noise_floor["total"]
    assert total is None or math.isfinite(total)
    Reader((folder / PAGE).read_text(encoding="utf-8"))


def test_a_gain_that_carries_the_efficiency_of_its_gear_is_named(closed: Closed) -> None:
    one_sided = GearLoss(
        motoring_rows=0.9,
        motoring_torque=0.97,
        loss=0.01,
        loss_std=0.04,
    )
    both = GearLoss(
        motoring_rows=0.5,
        motoring_torque=0.52,
        loss=0.01,
        loss_std=0.04,
    )
    text = next(_gear_sentence("J3", one_sided, in_model=False))
    assert text.startswith(
        "The gain of J3 includes the efficiency of its gear: the motor drives in 97 %"
    )
    assert "loss of up to 8.0 % would not show, and would change the gain by 7.5 %" in text
    assert not list(_gear_sentence("J3", both, in_model=False))
    found = GearLoss(
        motoring_rows=0.5,
        motoring_torque=0.5,
        loss=0.2,
        loss_std=0.01,
    )
    text = next(_gear_sentence("J3", found, in_model=True))
    assert "efficiency of 81.6 %" in text
    assert "2.06 % larger" in text

    listed = closed.document()["gear_loss"]
    axes = [gear["axis"] for gear in listed]
    assert axes == list(closed.fitted.cell.axis_names)
    for gear in listed:
        assert 0.0 < gear["motoring_torque"] < 1.0


def sentences_of(subject: str) -> st.SearchStrategy[tuple[str, ...]]:
    """Sentences of any length, each another."""

    def sentences(lengths: list[int]) -> tuple[str, ...]:
        texts = []
        for number, length in enumerate(lengths):
            words = " word" * length
            texts.append(f"{subject} {number}{words}.")
        return tuple(texts)

    word_count = st.integers(0, 60)
    return st.lists(word_count, max_size=8).map(sentences)


@given(
    checks=sentences_of("check"),
    effects=sentences_of("effect"),
    judged=sentences_of("judged"),
    refused=sentences_of("refused"),
    ending=sentences_of("ending"),
    room=st.integers(10, 30),
)
@pytest.mark.parametrize("width", [80, 120, None])
def test_whatever_was_found_a_search_prints_one_screen(
    checks: tuple[str, ...],
    effects: tuple[str, ...],
    judged: tuple[str, ...],
    refused: tuple[str, ...],
    ending: tuple[str, ...],
    room: int,
    width: int | None,
) -> None:
    together = "All axes together: the error falls."
    found = Headline(
        checks=checks,
        effects=effects,
        together=together,
        judged=judged,
        impossible=("J2: a spring ranks first on this axis, but its sign is impossible.",),
        refused=refused,
        gains=("The gains are the same.",),
        explained=(),
        to_record=(),
        ending=ending,
    )

    screen = SentenceScreen(found, room)
    shown = [part.text for part in screen.chosen(width)]

    assert together in shown
    lines = []
    for text in shown:
        broken = text if width is None else break_lines(text, width)
        lines += broken.split("\n")
    assert len(lines) <= room + 1  # the last one counts the others

    everything = list(found.sentences())
    printed = [text for text in shown if text in everything]
    in_order = [text for text in everything if text in printed]
    assert printed == in_order
    missing = len(everything) - len(printed)
    if missing:
        assert shown[-1].startswith(counted(missing, "sentence"))
    else:
        assert shown == everything
