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
    headline,
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
from ident.discovery.before_after import Account, RelativeErrors, account
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
HOSTILE = '<script>alert("$x$")</script>&<img src=http://example.org/x>'
VOID = {"meta", "img", "br", "link"}


def finding(
    placed: PlacedEffect, *, passed: bool = True, rivals: tuple[PlacedEffect, ...] = ()
) -> Finding:
    deviations = np.ones(len(placed.effect.coefficients))
    error_fall = 1.0 / 3.0
    fold_errors = np.ones(8)
    return Finding(
        effect=placed.effect,
        axis=placed.axis,
        coefficients=np.ones(len(placed.effect.coefficients)),
        deviations=deviations,
        probability=0.001,
        folds_better=1.0,
        explained=0.4,
        error_before_percent=9.0,
        error_after_percent=6.0,
        error_fall=error_fall,
        left_out_fall=100.0 if passed else 3.0,
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
        document: dict[str, Any] = json.loads(json_text(self.report()))
        return document

    def report(self) -> ResidualReport:
        calibration = calibration_of(self.fitted, CREATED)
        return residual_report(self.fitted, self.account, calibration)


@pytest.fixture(scope="module")
def shelf() -> Shelf:
    """Three runs to fit and one to hold out, all with a spring on J3."""
    truth = tx40_truth()
    rng = np.random.default_rng(3)
    runs = {}
    for index, name in enumerate(NAMES):
        run = record(truth, name, rng, MOUNTED if index % 2 else None, noise_a=0.3, seconds=22.0)
        current = run.current_a.copy()
        current[:, 2] += 4.0 * run.position_rad[:, 2] / GAINS[2]
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
    findings = (finding(SPRING, rivals=(rival,)), finding(rival, passed=False))
    first = Step(
        findings,
        (),
        limits_nm,
        finding(SPRING),
        after,
    )
    accepted = first.findings[0]
    first = replace(first, accepted=accepted)
    last = Step(
        (finding(rival, passed=False),),
        (finding(PlacedEffect(Periodic(0), 3), passed=False),),
        limits_nm,
        None,
        after,
    )
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
        axes = tuple(
            math.nan if axis == SPRING.axis else error
            for axis, error in enumerate(errors.holdout.axes)
        )
        holdout = RelativeError(axes, errors.holdout.total)
        return replace(errors, holdout=holdout)

    turns = tuple(
        None
        if turn is None
        else replace(turn, before=resting(turn.before), after=resting(turn.after))
        for turn in closed.account.turns
    )
    changed_account = replace(closed.account, turns=turns)
    (found,) = (text for text in headline(closed.fitted, changed_account, ()) if "J3 has" in text)
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
    said = f"By the torques before the search, gravity is {turn_deg:.2f} ± {std_deg:.2f}°"
    calibration = calibration_of(closed.fitted, CREATED)
    shown = residual_view(closed.fitted, closed.account, calibration, verbose=True)
    (sentence,) = (part for part in shown if isinstance(part, Sentence) and said in str(part))
    assert "from its direction in the cell file" in str(sentence)
    assert said in closed.page()
    gravity = closed.document()["geometry"]["gravity"]
    assert gravity["turn_deg"] == pytest.approx(turn_deg, rel=1e-6)
    assert gravity["turn_std_deg"] == pytest.approx(std_deg, rel=1e-6)


def test_gravity_is_placed_on_all_axes_in_the_document(closed: Closed) -> None:
    first, last = closed.fitted.steps
    placed = PlacedEffect(GravityDirection(), 0)
    findings = (*first.findings, finding(placed, passed=False))
    tried = replace(
        first,
        findings=findings,
    )
    fitted = replace(closed.fitted, steps=(tried, last))
    document = replace(closed, fitted=fitted).document()
    first_turn = document["turns"][0]
    found = first_turn["findings"][-1]
    assert (found["effect"], found["axis"]) == ("gravity-direction", "all axes")


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
    assert not tags & {"script", "link", "iframe", "object", "embed", "base", "form", "a"}
    for element in page.elements:
        assert not any(name.startswith("on") for name in element.attributes)
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            value = element.attributes.get(name)
            assert value is None
    style = page.texts[[text.startswith("\n:root") for text in page.texts].index(True)]
    assert "url(" not in style
    assert "@import" not in style
    assert "img" not in tags
    drawings = [element for element in page.elements if element.tag == "svg"]
    assert all(drawing.attributes["aria-label"] for drawing in drawings)
    # Changes and errors, four of the effect, torques of six axes, gains, two rounds.
    expected = 2 + 4 + 6 + 1 + 2
    assert len(drawings) == expected


def test_the_page_says_the_outcome_first(closed: Closed, shown: Reader) -> None:
    reported = closed.account.total
    assert reported.before.holdout is not None
    assert reported.after.holdout is not None
    before = reported.before.holdout.axes[2]
    after = reported.after.holdout.axes[2]
    page = shown
    first = next(text for text in page.texts if text.startswith("J3 has a spring: the error"))
    assert first.startswith(
        f"J3 has a spring: the error of J3 on held-out runs falls from {before:.1f} to "
        f"{after:.1f} % ("
    )
    assert page.texts.index(first) < page.texts.index("Errors without and with the effects")
    assert (
        "These data cannot distinguish it from: J2: friction that grows with the load."
    ) in page.text
    assert "1.2 Nm on J2" in page.text
    for error in (
        reported.before.in_sample,
        reported.after.cross_validated,
        reported.after.holdout,
    ):
        assert f"{error.total:.2f}" in page.texts
    assert "scales all gains alike" in page.text


def test_an_effect_that_hardly_lowers_the_error_is_called_small(closed: Closed) -> None:
    (turn, *others) = closed.account.turns
    assert turn is not None
    assert turn.before.holdout is not None
    axes = tuple(0.95 * error for error in turn.before.holdout.axes)
    nearly = replace(turn.before.holdout, axes=axes)
    changed_after = replace(turn.after, holdout=nearly)
    small = replace(turn, after=changed_after)
    turns = (small, *others)
    changed_account = replace(closed.account, turns=turns)
    sentences = summary(closed.fitted, changed_account, ())
    assert any(
        one.startswith("J3 has a spring, a small effect: the error of J3 on held-out")
        for one in sentences
    )
    assert not any("a small effect" in one for one in summary(closed.fitted, closed.account, ()))


def test_what_files_say_is_escaped(closed: Closed) -> None:
    fitted = closed.fitted
    axes = tuple(replace(axis, name=f"{axis.name}{HOSTILE}") for axis in fitted.cell.axes)
    after = fitted.steps[-1].after
    datasets = tuple(replace(data, name=HOSTILE) for data in after.datasets)
    steps = tuple(
        replace(step, after=replace(step.after, datasets=datasets)) for step in fitted.steps
    )
    sources = tuple(replace(source, name=HOSTILE, partial=True) for source in fitted.sources)
    cell = replace(fitted.cell, name=HOSTILE, axes=axes)
    hostile = replace(
        fitted,
        cell=cell,
        sources=sources,
        steps=steps,
    )
    text = Closed(hostile, closed.account).page()
    assert "<script" not in text
    page = Reader(text)
    assert all(
        (element.attributes.get("src") or "data:").startswith("data:") for element in page.elements
    )
    assert f"Cell {HOSTILE}" in page.texts


def test_the_document_has_the_numbers_of_the_rows(closed: Closed) -> None:
    reported = closed.account.total
    document = closed.document()
    for key, errors in (("before", reported.before), ("after", reported.after)):
        axes = document[key]["relative_error_percent"]["axes"]
        assert axes == pytest.approx(errors.in_sample.axes)
        total = document[key]["cross_validated_error_percent"]["total"]
        assert total == pytest.approx(errors.cross_validated.total)
        assert errors.holdout is not None
        holdout_error_percent = document[key]["holdout_error_percent"]
        assert holdout_error_percent["axes"] == pytest.approx(errors.holdout.axes)
        assert document[key]["left_out_runs"] is None
    last_step = closed.fitted.steps[-1]
    final = last_step.after.estimate
    for motor, change in enumerate(document["gain_changes"]):
        expected = f"J{motor + 1}"
        assert change["axis"] == expected
        gains = closed.fitted.identification.estimate.gains
        assert change["before"] == pytest.approx(gains[motor])
        assert change["after"] == pytest.approx(final.gains[motor])
        assert change["after_std"] == pytest.approx(final.gains_std[motor])
    first, last = document["turns"]
    (added,) = first["added"]
    assert (added["effect"], added["axis"]) == ("spring", "J3")
    stiffness = added["coefficients"][0]
    index = [column.name for column in final.unknowns].index(SPRING.columns[0].name)
    assert stiffness["value"] == pytest.approx(final.parameters[index])
    assert stiffness["std"] == pytest.approx(final.parameters_std[index])
    unit = SPRING.columns[0].unit
    assert stiffness["unit"] == unit
    assert first["accepted"]["ambiguity"] == ["load-friction on J2"]
    ambiguity = first["findings"][1]["ambiguity"]
    assert ambiguity is None
    assert (last["accepted"], last["added"], last["before"]) == (None, [], None)
    first_structure = last["structures"][0]
    assert first_structure["effect"] == "periodic-motor-angle"
    assert last["detection_limits"][1] == {"axis": "J2", "rms": 1.25, "unit": "Nm"}


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
    gains = closed.account.total.gains
    chosen = tuple(
        replace(gain, choice_std=share * gain.after_std)
        for gain, share in zip(gains, (0.1, 0.5, 0.1, 0.1, 0.1, 0.1), strict=True)
    )
    total = replace(closed.account.total, gains=chosen)
    changed = replace(closed.account, total=total)
    sentence = "σ of the gains includes the choice of the effects (squares add): 50 % of it on J2."
    assert sentence in summary(closed.fitted, changed, ())
    assert not any(
        "choice of the effects" in text for text in summary(closed.fitted, closed.account, ())
    )
    last_step = closed.fitted.steps[-1]
    opened = replace(last_step, left_open=(SPRING,))
    steps = (*closed.fitted.steps[:-1], opened)
    undecided = replace(closed.fitted, steps=steps)
    more = (
        f"{sentence} spring on J3 is not in the model and may be true: σ holds what that "
        "would move."
    )
    assert more in summary(undecided, changed, ())
    document = Closed(closed.fitted, changed).document()
    choice_std = document["gain_changes"][1]["choice_std"]
    assert choice_std == chosen[1].choice_std


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
    assert (
        ResidualReport.model_validate_json(json_text(closed.report()), strict=False)
        == closed.report()
    )


def test_the_document_has_the_calibration_as_its_file_has_it(closed: Closed) -> None:
    calibration = as_document(calibration_of(closed.fitted, CREATED))
    document = closed.document()
    assert list(document)[: len(calibration)] == list(calibration)
    text = json.dumps({key: document[key] for key in calibration})
    assert text == json.dumps(calibration)


def test_what_to_check_comes_first(closed: Closed) -> None:
    odd = Diagnosis("payload-differs", ("loaded-2",), (), "a body", "another", "was it turned?")
    fitted = replace(closed.fitted, diagnoses=(odd,))
    document = Closed(fitted, closed.account).document()
    sentence = "CHECK loaded-2: found a body; expected another; was it turned? (payload-differs)."
    assert document["summary"][0] == sentence
    first_diagnose = document["diagnoses"][0]
    assert first_diagnose["runs"] == ["loaded-2"]


def test_a_noise_floor_above_the_error_of_the_model_is_reported_with_its_cause(
    closed: Closed,
) -> None:
    left_a = closed.account.left_a
    noise_a = 0.9 * float(left_a[2])
    motor_noise_floor = MotorNoiseFloor(
        noise_a, FloorSource.REPEATED_MOVES, 12, 100.0, is_bound=True
    )
    floors = (
        MotorNoiseFloor(4.0 * float(left_a[0]), FloorSource.STANDSTILL, 20, 100.0),
        MotorNoiseFloor(2.0 * float(left_a[1]), FloorSource.REPEATED_MOVES, 20, 100.0),
        motor_noise_floor,
        MotorNoiseFloor(0.9 * float(left_a[3]), FloorSource.STANDSTILL, 12, 100.0),
        *(None,) * 2,
    )
    changed_account = replace(closed.account, floors=floors)
    refuted = Closed(closed.fitted, changed_account)
    first, second = (
        line for line in summary(refuted.fitted, refuted.account, ()) if "no noise floor" in line
    )
    assert first.startswith(
        "J1 has no noise floor: its current at standstill scatters 4.0 times as much as"
    )
    assert second.startswith(
        "J2 has no noise floor: its current between repeated moves scatters 2.0 times"
    )
    motors = refuted.document()["noise_floor"]["motors"]
    expected = [True, True, False, False, None, None]
    assert [motor and motor["refuted"] for motor in motors] == expected
    least_a = floors[2].least_a
    assert motors[2]["least"] == least_a
    assert motors[3]["least"] is None
    dwells = [motor["dwells"] for motor in motors[:3]]
    assert dwells == [20, None, None]
    source = motors[2]["source"]
    pairs = motors[2]["pairs"]
    assert (source, pairs) == ("repeated moves", 12)
    assert motors[2]["left"] == pytest.approx(left_a[2])


def test_a_time_skew_is_stated_only_where_instruments_confirm_it(closed: Closed) -> None:
    """Least squares are certain of −3 ms in each of these."""
    biased = CurrentDelay(
        4e-5, 6e-5, fit_seconds=-3e-3, fit_std=4e-4, confirmed=False, is_in_model=False
    )
    confirmed = replace(biased, seconds=-2e-3, confirmed=True)
    sentence = "Currents were sampled 2.00 ± 0.06 ms before the positions, the same on every axis"
    for skew, stated in ((None, False), (biased, False), (confirmed, True)):
        changed_account = replace(closed.account, skew=skew)
        made = Closed(closed.fitted, changed_account)
        sentences = summary(made.fitted, made.account, ())
        assert any(text.startswith(sentence) for text in sentences) is stated
        assert any("Currents were sampled" in text for text in sentences) is stated
        assert any("3.0" in text and " ms" in text for text in sentences) is False
        shown = headline(made.fitted, made.account, ())
        assert any("skew" in text or "sampled" in text for text in shown) is stated
        document = made.document()
        assert document["time_skew"] == ({"seconds": -2e-3, "std": 6e-5} if stated else None)
        tested = document["time_skew_by_instruments"]
        assert (tested is None) == (skew is None)
        if skew is not None:
            assert tested == asdict(skew)
    unknown, unconfirmed = (
        statistical_sentences(closed.fitted, replace(closed.account, skew=skew))
        for skew in (None, biased)
    )
    assert any(
        text.startswith("A time skew between currents and positions is not known")
        for text in unknown
    )
    assert any(
        text.endswith("is not confirmed: instruments from the demanded motion give 0.04 ± 0.06 ms.")
        for text in unconfirmed
    )


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
    effect = Smooth(Abscissa.POSITION)
    placed_effect = PlacedEffect(LoadFriction(0), 1)
    places = (placed_effect, PlacedEffect(effect, 4))
    effects = (SPRING, *places)
    after = replace(first.after, effects=effects)
    (turn, _) = closed.account.turns
    assert turn is not None
    found = [finding(place, rivals=(SPRING, places[0])) for place in places]
    asides = tuple(
        SetAside(finding(PlacedEffect(LoadFriction(0), axis)), moved=((3, 2.91),))
        for axis in range(6)
    )
    placed = PlacedEffect(LoadFriction(0), 3)
    refused = replace(
        finding(placed, passed=False),
        refusals=("coefficient is -1 ± 0.1",),
    )
    steps = (
        replace(first, after=after),
        *(replace(first, accepted=one, findings=(one,), after=after) for one in found),
        replace(last, after=after, set_aside=asides, findings=(refused,)),
    )
    turns = (turn, *(replace(turn, added=(place,)) for place in places), None)
    gains = tuple(replace(gain, significant=True) for gain in closed.account.total.gains)
    skew = CurrentDelay(
        -2e-3, 6e-5, fit_seconds=-3e-3, fit_std=4e-4, confirmed=True, is_in_model=False
    )
    total = replace(closed.account.total, gains=gains)
    holdout_change = _holdout_change(1.3)
    account = replace(
        closed.account,
        turns=turns,
        total=total,
        holdout_change=holdout_change,
        skew=skew,
    )
    odd = Diagnosis("payload-differs", ("loaded-2",), (), "a body", "another", "was it turned?")
    fitted = replace(closed.fitted, steps=steps, diagnoses=(odd,))
    return Closed(fitted, account)


def _holdout_change(rise: float) -> ErrorChange:
    """Change of the whole error on 20 held-out blocks, with a σ of one, and of no motor."""
    unchanged = PairedChange(0.0, 0.0, 0)
    return ErrorChange(PairedChange(rise, 1.0, 20), (unchanged,) * 3, np.ones(3))


def _calibrated(made: Closed, effects: int) -> Calibration:
    fitted = replace(made.fitted, steps=())
    calibration = calibration_of(fitted, CREATED)
    ambiguity = ("load-friction on J2",) * 5
    worse = AcceptedEffect("spring", "J3", {}, (), 2.98, 3.11, ambiguity)
    return replace(calibration, effects=(worse,) * effects, diagnoses=made.fitted.diagnoses)


@pytest.mark.parametrize("columns", [80, 120])
def test_what_is_printed_fits_one_screen_and_breaks_no_word(closed: Closed, columns: int) -> None:
    made = _with_three_effects(closed)
    calibration = _calibrated(made, 3)
    parts = residual_view(made.fitted, made.account, calibration)
    screen = _on_screen(parts, columns)
    # Calibration, report and the next command follow, a line each.
    assert len(screen.lines) <= 40 - 3
    assert all(cell_len(line) <= columns for line in screen.lines)
    whole = _on_screen(residual_view(made.fitted, made.account, calibration), 10_000)
    # What does not fit a narrow screen is counted; what is there has the words of a wide one.
    shown = "\n".join(line for line in screen.lines if "sentences more:" not in line)
    wide = iter(whole.text.split())
    assert all(word in wide for word in shown.split())
    assert ("sentences more:" in screen.text) == (shown.split() != whole.text.split())
    for words in (
        "CHECK loaded-2",
        "J3 has a spring",
        "J2 has friction",
        "J5 has a torque",
        "Currents were sampled",
    ):
        assert words in whole.text
    for gain in calibration.gains:
        assert f"{gain.std_percent:.2f}" in screen.text
        assert f"{gain.change_percent:+.1f}" in screen.text
    for statistics in (
        "Turn 1",
        "Detection limit",
        "Not added",
        "failed a check",
        "may have",
        "scales all",
    ):
        assert statistics not in screen.text


@pytest.mark.usefixtures("undrawn")
def test_the_report_has_every_sentence_and_number_of_the_verbose_output(closed: Closed) -> None:
    made = _with_three_effects(closed)
    calibration = _calibrated(made, 3)
    page = Reader(residual_page(made.fitted, made.account, calibration))
    text = " ".join(page.text.split())
    listed = {" ".join(one.split()) for one in page.texts}
    parts = [*residual_view(made.fitted, made.account, calibration, verbose=True)]
    sentences = [
        " ".join(part.text.replace("`", "").split()) for part in parts if isinstance(part, Sentence)
    ]
    assert len(sentences) > 15
    # A command in a sentence is an element of its own on the page.
    changed_text = text.replace(" .", ".")
    joined = " ".join(changed_text.replace(" ,", ",").split())
    assert [one for one in sentences if one not in joined and one not in text] == []
    tables = [part for part in parts if isinstance(part, Table)]
    expected = len(made.fitted.steps) + 2
    assert len(tables) == expected
    for table_ in tables[:-1]:
        cells = []
        for column in table_.columns:
            for cell in (column.header, *column.cells):
                cells.append(str(cell))
        assert [cell for cell in cells if cell and cell not in listed] == []
    # The verbose output has what the screen has.
    shown = residual_view(made.fitted, made.account, calibration)
    texts = [part.text for part in shown if isinstance(part, Sentence)]
    short = texts[:-1]
    assert set(short) <= {part.text for part in parts if isinstance(part, Sentence)}


@pytest.mark.slow
def test_the_dependence_on_the_mass_is_in_the_documents_and_in_a_sentence(
    closed: Closed, tmp_path: Path
) -> None:
    payloads = tuple(replace(one, mass_tolerance_kg=0.0459) for one in closed.fitted.cell.payloads)
    cell = replace(closed.fitted.cell, payloads=payloads)
    weighed = replace(closed.fitted, cell=cell)
    calibration = calibration_of(weighed, CREATED)
    (payload,) = residual_report(weighed, closed.account, calibration).payload_mass
    assert payload.tolerance_kg == 0.0459
    for one, gain in zip(payload.gains, calibration.gains, strict=True):
        assert one.percent_per_percent == pytest.approx(1.0, abs=0.01)
        assert one.per_kg == pytest.approx(gain.value / payload.mass_kg, rel=0.01)
        assert one.tolerance_std == pytest.approx(abs(one.per_kg) * 0.0459)
    verbose = residual_view(weighed, closed.account, calibration, verbose=True)
    sentences = [part.text for part in verbose if isinstance(part, Sentence)]
    assert any("which is ± 1 % of every gain, not included in σ" in one for one in sentences)
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
    gains = closed.account.total.gains
    same = tuple(replace(gain, after=gain.before, significant=False) for gain in gains)
    changed_gain = replace(gains[0], significant=True)
    marked = (changed_gain, *same[1:])
    for shifts, sentence in (
        (same, "With and without the effects, the gains are the same within noise."),
        (
            marked,
            "The effects change gains by more than noise (probability below 1 % among all axes): "
            f"J1 by {gains[0].change_percent:+.1f} % of the gain without them.",
        ),
    ):
        total = replace(closed.account.total, gains=shifts)
        changed = replace(closed.account, total=total)
        assert sentence in summary(closed.fitted, changed, ())


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
    gains = closed.account.total.gains
    shifts = [replace(gain, after=gain.before, significant=False) for gain in gains]
    before = shifts[4].before
    change_std = 0.01 * std_percent * abs(before)
    shifts[4] = replace(shifts[4], after=before * (1.0 + 0.01 * percent), change_std=change_std)
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
    fitted = replace(closed.fitted, diagnoses_before=diagnoses_before, diagnoses=(other, corrected))
    (said,) = (
        one for one in headline(fitted, closed.account, ()) if one.startswith("Without the effects")
    )
    assert said.startswith(
        "Without the effects, the fit said CHECK J3: an error of 2.1 in 8 Nm (or N), 26.6 % "
        "(axis-error). With them it does not: the error of the current of J3 on held-out runs "
        "falls from"
    )


def test_an_estimate_of_the_noise_is_said_where_it_has_no_lower_limit(closed: Closed) -> None:
    axes = (math.nan,) * 6
    unknown = RelativeError(axes, math.nan)
    estimate = RelativeError((math.nan, math.nan, 1.7, math.nan, math.nan, math.nan), math.nan)
    for floor, said in (
        (estimate, "(noise leaves 1.7 %, an estimate)."),
        (unknown, "(noise floor not known)."),
    ):
        judged = replace(
            closed.account, least_holdout_floor=unknown, least_floor=unknown, holdout_floor=floor
        )
        (sentence,) = (
            one for one in headline(closed.fitted, judged, ()) if one.startswith("J3 has")
        )
        assert sentence.endswith(said)


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
    sentence = _effect_sentence(closed.fitted, closed.account, small, placed, first_step)
    assert sentence == (
        "J2 has a zero that is off: it hardly shows in the error of all axes on held-out runs, "
        "3.12 % without it and 3.09 % with it; most in that of J1, 3.20 and 3.00 %."
    )
    spring = closed.fitted.steps[0].after
    (size,) = coefficients(spring, SPRING)
    step = closed.fitted.steps[0]
    text = _hardly_shown_text(closed.fitted, SPRING, step, errors, errors, "here")
    assert text.startswith(f", by {abs(size.value / size.std):.0f} σ: it hardly shows")


def test_the_moves_that_would_help_are_named_after_a_search_too(closed: Closed) -> None:
    advice = Advice("moves with the payload", 60.0, 0.8)
    alone_percent = {GainSource.GRAVITY: 2.4}
    weak = GainVerdict(4, 2.4, None, alone_percent, True, Visibility.WEAK, advice)
    fitted = replace(closed.fitted, uncertain=(weak,))
    sentences = headline(fitted, closed.account, ())
    (said,) = (one for one in sentences if one.startswith("Excitation: J5"))
    assert "add 60 s of moves with the payload (σ 0.8 %)" in said
    assert not any(
        one.startswith("Excitation") for one in headline(closed.fitted, closed.account, ())
    )


def test_the_kind_of_the_errors_is_said_where_several_motors_act_on_a_joint(closed: Closed) -> None:
    (said,) = (
        one for one in summary(closed.fitted, closed.account, ()) if "motors' currents" in one
    )
    assert said.endswith("differ where several motors act on a joint (J5).")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_silence_is_reported_with_its_size(closed: Closed) -> None:
    last = closed.fitted.steps[-1]
    start = closed.fitted.evidence()
    steps = (replace(last, after=start),)
    silent = replace(closed.fitted, steps=steps)
    outcome, limits, *_ = summary(silent, account(start, silent.steps), ())
    assert outcome.startswith("No structure found")
    assert "1.2 Nm on J2" in limits
    assert "no common clock: a warm-up over the session cannot be seen" in limits
    timed = tuple(
        replace(data, started_s=100.0 * index) for index, data in enumerate(start.datasets)
    )
    clocked = replace(silent, steps=(replace(last, after=replace(start, datasets=timed)),))
    assert "clock" not in " ".join(summary(clocked, account(start, silent.steps), ()))
    changed_step = replace(silent.steps[0], findings=(), structures=())
    nothing_tried = replace(silent, steps=(changed_step,))
    text = Closed(nothing_tried, account(start, silent.steps)).page()
    assert "No structure found" in Reader(text).text
    assert "No candidate could be tried." in Reader(text).text


def test_a_strong_candidate_that_failed_a_check_is_named_with_it(closed: Closed) -> None:
    first, last = closed.fitted.steps
    placed = PlacedEffect(LoadFriction(0), 1)
    strong = replace(
        finding(placed, passed=False),
        explained=0.4,
        refusals=("coefficient is -1 ± 0.1",),
    )
    weak = replace(strong, axis=2, explained=0.1)
    steps = (first, replace(last, findings=(weak, strong)))
    asked = replace(closed.fitted, steps=steps)
    sentences = [one for one in summary(asked, closed.account, ()) if "failed a check" in one]
    assert sentences == [
        "J2: friction that grows with the load would explain 40 % of the squared residual, but "
        "failed a check: coefficient is -1 ± 0.1. The cause may be another one."
    ]


def test_a_first_candidate_that_physics_alone_refuses_is_named_however_little_it_explains(
    closed: Closed,
) -> None:
    first, last = closed.fitted.steps
    why = "coefficient is -1 ± 0.1 ; physics allows no less than 0"
    placed = PlacedEffect(LoadFriction(0), 1)
    refused = replace(
        finding(placed, passed=False),
        explained=0.1,
        refusals=(why,),
        impossible=why,
    )
    second = replace(refused, effect=Spring())
    noise = replace(refused, axis=2, refusals=("noise makes one as strong with p = 0.400", why))
    steps = (first, replace(last, findings=(refused, second, noise)))
    asked = replace(closed.fitted, steps=steps)
    # Without --verbose, too.
    sentences = [one for one in headline(asked, closed.account, ()) if "impossible" in one]
    expected = [
        "J2: friction that grows with the load ranks first on this axis, but its sign or size is "
        f"impossible: {why}. The cause may be another one."
    ]
    assert sentences == expected
    findings = (replace(refused, explained=0.4),)
    much = replace(asked, steps=(first, replace(last, findings=findings)))
    assert len([one for one in summary(much, closed.account, ()) if why in one]) == 1


def test_a_candidate_that_was_not_tested_has_no_probability(closed: Closed) -> None:
    first, last = closed.fitted.steps
    why = (
        "it rests on two moves, too few to test it: record more moves with a large current of "
        "this axis"
    )
    placed = PlacedEffect(LoadFriction(0), 1)
    untested = replace(
        finding(placed, passed=False),
        probability=None,
        explained=0.4,
        refusals=(why,),
    )
    step = replace(last, findings=(untested,))
    asked = replace(closed.fitted, steps=(first, step))
    assert next(candidate_rows(asked, step, 1))[2] == "–"
    (sentence,) = (one for one in summary(asked, closed.account, ()) if why in one)
    assert "p =" not in sentence
    calibration = calibration_of(closed.fitted, CREATED)
    report = residual_report(asked, closed.account, calibration)
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
    first, last = closed.fitted.steps
    findings = (untested, weaker, impossible, no_help, few_folds, tiny)
    steps = (first, replace(last, findings=findings))
    asked = replace(
        closed.fitted,
        steps=steps,
    )
    sentences = [one for one in summary(asked, closed.account, ()) if "rests on" in one]
    expected = [
        f"These moves do not tell whether J2 has {effect_text(Saturation(), ())}: it rests on two "
        f"moves, too few to test it: record more {RECORD[Abscissa.CURRENT]}."
    ]
    assert sentences == expected


def test_a_name_that_structure_refutes_is_reported_with_what_it_depends_on(closed: Closed) -> None:
    first, last = closed.fitted.steps
    effect = Smooth(Abscissa.POSITION)
    term = PlacedEffect(effect, 1)
    placed = PlacedEffect(LoadFriction(0), 1)
    name = finding(placed)
    moved = ((3, 2.91),)
    refuted = SetAside(name, "{rival} explains clearly more", term, moved)
    assert refuted.reason([f"J{axis}" for axis in range(1, 7)]) == (
        "it would move the gain of J4 by 2.9 σ, and smooth-position on J2 explains clearly more"
    )
    steps = (first, replace(last, set_aside=(refuted,)))
    fitted = replace(closed.fitted, steps=steps)
    sentences = summary(
        fitted,
        closed.account,
        (),
    )
    assert (
        "J2: what looks like friction that grows with the load depends clearly more on the joint "
        "position, and was not added: it would move the gain of J4 by 2.9 σ."
    ) in sentences


@pytest.mark.usefixtures("undrawn")
def test_what_did_not_join_is_reported_with_the_reason(closed: Closed) -> None:
    first, last = closed.fitted.steps
    effect = Smooth(Abscissa.LOAD)
    placed = PlacedEffect(effect, 1)
    aside = SetAside(finding(placed), moved=((3, 2.91),))
    placed_effect = PlacedEffect(LoadFriction(0), 1)
    replaced = SetAside(finding(placed_effect), "{rival} explains more", SPRING)
    steps = (replace(first, set_aside=(replaced, aside)), replace(last, set_aside=(aside,)))
    fitted = replace(closed.fitted, steps=steps)
    made = Closed(fitted, closed.account)
    sentences = summary(made.fitted, made.account, ())
    assert (
        sum(
            "and was not added: it has no name, and would move the gain of J4 by 2.9 σ" in s
            for s in sentences
        )
        == 1
    )
    assert any(
        "J2 may have friction that grows with the load: it would" in one for one in sentences
    )
    assert any("added: spring on J3 explains more." in one for one in sentences)
    turns = made.document()["turns"]
    set_aside = turns[1]["set_aside"]
    assert set_aside[0]["reason"].endswith("the gain of J4 by 2.9 σ")
    assert (
        "Not added to J2: a torque that depends on the load torque and that no named effect "
        "explains: it has no name" in Reader(made.page()).text
    )


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
    monkeypatch.setattr(before_after_module, "compare_on_holdout", lambda *_: change)
    monkeypatch.setattr(fit_module, "compare_on_holdout", lambda *_: change)
    for name in ("fit", "close_loop"):
        monkeypatch.setattr(fit_module, name, lambda *_, **__: closed.fitted)
    command = [
        "residual",
        *NAMES[:3],
        "--holdout",
        NAMES[3],
        "--out",
        str(out),
        "--report",
        str(folder),
    ]
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
    document = json.loads((folder / DOCUMENT).read_text(encoding="utf-8"))
    assert document["worse_holdout"] is True
    with pytest.raises(EffectsRefuted, match="20 independent blocks of moves"):
        fit_module.check_holdout(closed.fitted)


def test_effects_that_the_cell_declares_are_in_both_models_of_the_comparison(
    closed: Closed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "compare_on_holdout", lambda *_: _holdout_change(5.0))
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
    assert (
        main(["residual", *NAMES[:3], "--holdout", NAMES[3], "--out", str(out), *options])
        == ExitCode.UNEXPECTED
    )
    text, message = capsys.readouterr()
    assert "J3 has a spring" in text
    assert "Written" not in text
    assert "no space left" in message.lower()
    assert not list(tmp_path.iterdir())


def test_a_rise_within_noise_is_said_with_what_apply_will_refuse(closed: Closed) -> None:
    worse = AcceptedEffect("spring", "J3", {}, (), 2.98, 3.11)
    changed_account = replace(closed.account, holdout_change=_holdout_change(1.3))
    sentences = summary(closed.fitted, changed_account, (worse,))
    (whole,) = (one for one in sentences if one.startswith("All axes together"))
    assert whole.endswith(", within its noise (1.3 σ): the effects are kept, but not confirmed.")
    (refused,) = (one for one in sentences if one.startswith("`apply` refuses"))
    assert (
        "with spring on J3: on data that the fit did not use, the torque error is 3.11 % with "
        "it, 2.98 %"
    ) in refused
    better = replace(worse, error_after_percent=2.97)
    lower = replace(closed.account, holdout_change=_holdout_change(-1.0))
    said = summary(closed.fitted, lower, (better,))
    assert not any("within its noise" in one or "`apply` refuses" in one for one in said)


def test_the_candidate_that_was_added_is_listed_wherever_it_ranks(closed: Closed) -> None:
    first = closed.fitted.steps[0]
    rivals = (
        tuple(finding(PlacedEffect(LoadFriction(0), axis), passed=False) for axis in range(6)) * 3
    )
    findings = (*rivals, first.findings[0])
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
    std = math.radians(0.04)
    turned = Parameter("zero-offset offset 3", -math.radians(2.0), std, "rad")
    assert named_size(ZeroOffset(), (turned,)) == (
        "offset -2.000 ± 0.040°, to be added to its position"
    )
    moved = Parameter("zero-offset offset 1", 0.003, 0.0001, "m")
    assert named_size(ZeroOffset(), (moved,)) == (
        "offset 0.00300 ± 0.00010 m, to be added to its position"
    )


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
    assert set(WORDS) <= {family[0].name for family in (*EFFECTS, *GEOMETRY)}


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
        assert main(["residual", "no.mcap", "--report", str(folder)]) == ExitCode.USAGE
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
    assert main(["residual", "no.mcap", "--report", str(tmp_path)]) == ExitCode.UNEXPECTED
    assert "permission denied" in capsys.readouterr().err
    monkeypatch.undo()
    check_report(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "unseen", ["\x1b", "\u202e", "\u2066", "\u200b", "\x00", "\x85", "\u2028", "\ud800"]
)
def test_what_is_not_seen_is_spelt_out(unseen: str) -> None:
    body = [paragraph(f"{unseen}"), table(unseen, [unseen] * 2, [[unseen, unseen]])]
    title = f"a{unseen}b"
    text = html_page(title, body)
    assert unseen not in text
    assert f"<title>a\\u{ord(unseen):04x}b</title>" in text
    text.encode()


def test_what_is_seen_stays_as_it_is() -> None:
    assert (
        paragraph("‖ρ‖/‖Y‖ ± σ, 3 µm, 机械手, naïve\nnext")
        == "<p>‖ρ‖/‖Y‖ ± σ, 3 µm, 机械手, naïve\nnext</p>"
    )


def test_a_disk_that_fails_leaves_the_old_report(
    closed: Closed, whole_page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibration = calibration_of(closed.fitted, CREATED)
    save_report(closed.fitted, closed.account, calibration, tmp_path)
    old = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(old) == {PAGE, DOCUMENT}
    assert old[PAGE].decode() == whole_page  # drawn a second time
    check_report(tmp_path)
    monkeypatch.setattr(residual_page_module, "residual_page", lambda *_: whole_page)
    save_report(closed.fitted, closed.account, calibration, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == old

    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(residual_page_module, "residual_page", lambda *_: "another page")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputFailed, match="no space"):
        save_report(closed.fitted, closed.account, calibration, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == old


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
    assert {path.name for path in tmp_path.iterdir()} == {
        "torques.svg",
        "gains.png",
        "residual-J3-spring.svg",
    }


@pytest.mark.slow
def test_the_verb_writes_the_report_and_says_the_same(
    shelved: Shelf, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "report"
    command = ["residual", *NAMES[:3], "--holdout", NAMES[3], "--report", str(folder), "--verbose"]
    assert main(command) == ExitCode.OK
    text, progress = capsys.readouterr()
    assert "adding spring on J3" in progress
    document = json.loads((folder / DOCUMENT).read_text(encoding="utf-8"))
    assert (document["format"], document["version"]) == ("drivegain-residual", 1)
    assert list(document)[:3] == ["format", "version", "cell"]
    assert "axis 3" not in text
    assert "J3 has a spring" in text
    for sentence in document["summary"]:
        assert sentence in text
    rows = {
        line.rsplit(maxsplit=7)[0].strip(): line.split()[-7:]
        for line in text.splitlines()
        if ", " in line[:30]
    }
    for name, key in (("fit", "relative_error_percent"), ("held out", "holdout_error_percent")):
        for when in ("before", "after"):
            error = document[when][key]
            assert [float(value) for value in rows[f"{name}, {when}"]] == pytest.approx(
                [*error["axes"], error["total"]], abs=0.005
            )
    assert "scales all gains alike" in text
    expected = f"Written: {folder}/ (certificate: {folder}/report.html)"
    last_line = text.splitlines()[-1]
    assert last_line == expected
    total = document["noise_floor"]["relative_error_percent"]["total"]
    assert total is None or math.isfinite(
        document["noise_floor"]["relative_error_percent"]["total"]
    )
    Reader((folder / PAGE).read_text(encoding="utf-8"))


def test_a_gain_that_carries_the_efficiency_of_its_gear_is_named(closed: Closed) -> None:
    one_sided = GearLoss(motoring_rows=0.9, motoring_torque=0.97, loss=0.01, loss_std=0.04)
    both = GearLoss(motoring_rows=0.5, motoring_torque=0.52, loss=0.01, loss_std=0.04)
    text = next(_gear_sentence("J3", one_sided, in_model=False))
    assert text.startswith(
        "The gain of J3 includes the efficiency of its gear: the motor drives in 97 %"
    )
    assert "loss of up to 8.0 % would not show, and would change the gain by 7.5 %" in text
    assert not list(_gear_sentence("J3", both, in_model=False))
    found = GearLoss(motoring_rows=0.5, motoring_torque=0.5, loss=0.2, loss_std=0.01)
    assert "efficiency of 81.6 %" in next(_gear_sentence("J3", found, in_model=True))
    assert "2.06 % larger" in next(_gear_sentence("J3", found, in_model=True))
    listed = closed.document()["gear_loss"]
    expected = list(closed.fitted.cell.axis_names)
    assert [gear["axis"] for gear in listed] == expected
    assert all(0.0 < gear["motoring_torque"] < 1.0 for gear in listed)


def sentences_of(subject: str) -> st.SearchStrategy[tuple[str, ...]]:
    """Sentences of any length, each another."""
    lengths = st.lists(st.integers(0, 60), max_size=8)
    return lengths.map(
        lambda found: tuple(f"{subject} {n}{' word' * length}." for n, length in enumerate(found))
    )


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
    shown = [part.text for part in SentenceScreen(found, room).chosen(width)]
    assert together in shown
    lines = sum(1 if width is None else len(break_lines(text, width).split("\n")) for text in shown)
    assert lines <= room + 1  # the last one counts the others
    everything = list(found.sentences())
    kept = [text for text in shown if text in everything]
    expected = [text for text in everything if text in kept]
    assert kept == expected  # in their order
    if len(kept) < len(everything):
        assert shown[-1].startswith(counted(len(everything) - len(kept), "sentence"))
    else:
        assert shown == everything
