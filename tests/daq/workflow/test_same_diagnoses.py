"""A recording gets the same diagnoses from `fit`, `residual`, `validate`, the report,
and `daq.fit_logs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from html import unescape
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from daq.cli.app import main
from daq.cli.next_step import say_after_fit
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.errors import ExitCode
from daq.log.reader import LossyLogs
from daq.report.certificate import certify
from daq.report.certificate_page import certificate_page
from daq.report.comparison import without_controller
from daq.report.validation import validation_view
from daq.workflow import diagnoses as diagnoses_module
from daq.workflow import fit as fit_module
from daq.workflow import validate as validate_module
from daq.workflow.diagnoses import geometry_beside, geometry_refusal, hidden_zeros_text
from daq.workflow.fit import calibration_of, close_loop, description_diagnoses, fit, fit_logs
from daq.workflow.validate import cross_validate, replaced_geometry
from daq.writeback.gates.fit import uncorrected_description
from ident.calibration import Calibration
from ident.data.run import Recording, Run
from ident.discovery.effect_verdict import Judgement
from ident.discovery.geometry_check import AlikeCorrections, GeometryCheck
from ident.discovery.joining import SetAside
from ident.discovery.loop import Step, find_effects
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import LatePosition, ZeroOffset
from ident.errors import Diagnosis, IdentificationError
from ident.estimators.turned_geometry import find_turned_geometry, with_gravity
from ident.model.model import DriveTrain
from tests.ident.arms import THREE_AXES
from tests.ident.findings import passed_finding
from tests.ident.mistaken import small_recordings, turned, with_currents
from tests.ident.recordings import MOUNTED, FloatArray, record, three_axes_truth
from tests.remembered import remembered

pytestmark = pytest.mark.slow

WHEN = datetime(2025, 1, 2, tzinfo=UTC)
CELL = """\
name: three
robot: {urdf: arm.urdf, gravity_m_s2: [0.0, 0.0, -9.81]}
drive_train:
  ratio: [[40, 0, 0], [0, 50, 0], [0, 0, -45]]
axes:
"""
AXIS = (
    "  - {{name: {name}, nameplate_gain: {gain}, gain_unit: Nm/A, "
    "limits: {{position_deg: [-175, 175], velocity_deg_s: 400, acceleration_deg_s2: 4000}}}}\n"
)
REST = """\
payloads:
  - {name: disc, mounting: a, mass_kg: 4.59, mass_tolerance_kg: 0.005}
conditioning:
  {position_cutoff_hz: 40.0, position_order: 4, decimation_cutoff_hz: 20.0, standstill_rad_s: [0.03, 0.03, 0.03]}
"""  # noqa: E501

CHANGED_SECTION = "axes.zero_offset (J2)"  #: of a description that is given
RUNS = 8  #: recordings r0 to r7
USED = 6  #: how many of them a fit uses; the others are held out
LOGS = [Path(f"r{number}") for number in range(USED)]
HELD_OUT = [Path(f"r{number}") for number in range(USED, RUNS)]
SECONDS = 13.0
FEW = {"stribeck", "load-friction", "spring", "lag", "time-skew"}
FEW_FAMILIES = tuple(family for family in EFFECTS if family[0].name in FEW)
"""What a search tries here beside the corrections of the description:
what is diagnosed hangs on none of it.
"""
Runs = list[Run]
Mistake = Callable[[Runs], Runs]


def in_one(number: int, change: Callable[[Run], Run]) -> Mistake:
    """A mistake in one of the runs."""

    def mistake(runs: Runs) -> Runs:
        changed = list(runs)
        changed[number] = change(runs[number])
        return changed

    return mistake


def in_all(change: Callable[[Run], Run]) -> Mistake:
    """A mistake in every run."""
    return lambda runs: [change(run) for run in runs]


def in_used(change: Callable[[Run], Run]) -> Mistake:
    """A mistake in every run that a fit uses."""

    def mistake(runs: Runs) -> Runs:
        used = [change(run) for run in runs[:USED]]
        return [*used, *runs[USED:]]

    return mistake


def in_loaded(change: Callable[[Run], Run]) -> Mistake:
    """A mistake in every run with a payload."""

    def change_loaded(run: Run) -> Run:
        return change(run) if run.payload else run

    return in_all(change_loaded)


def carrying(body: np.ndarray) -> Mistake:
    """Another body than the payload in the second loaded run."""
    truth = three_axes_truth()
    runs = small_recordings(truth, 0, count=RUNS, seconds=SECONDS, bodies={3: body})
    return in_one(3, lambda _: runs[3])


def scaled(*factors: float) -> Mistake:
    """Currents that are recorded too large or too small."""
    return lambda runs: with_currents(runs, np.array(factors))


def of_size(*axes: int) -> Mistake:
    """Drives that report the size of their current."""

    def change(run: Run) -> Run:
        current = run.current_a.copy()
        current[:, axes] = np.abs(current[:, axes])
        return replace(run, current_a=current)

    return in_all(change)


def noisy(run: Run) -> Run:
    """A run of which the last current is mostly noise."""
    rng = np.random.default_rng(0)
    noise_a = rng.standard_normal(run.current_a.shape)
    noise_a[:, :2] = 0.0
    current_a = run.current_a + noise_a
    return replace(run, current_a=current_a)


def reversed_position(run: Run) -> Run:
    """A run in which the position of J2 counts the other way."""
    position_rad = run.position_rad.copy()
    position_rad[:, 1] *= -1.0
    return replace(run, position_rad=position_rad)


def offset(run: Run, degrees: float = 4.0) -> Run:
    """A run in which the zero of J2 is off."""
    position_rad = run.position_rad.copy()
    position_rad[:, 1] += np.radians(degrees)
    return replace(run, position_rad=position_rad)


def late_currents(*delays_s: float) -> Mistake:
    """Currents that were stamped too late, by so much on each axis."""

    def change(run: Run) -> Run:
        late = []
        for current, delay_s in zip(run.current_a.T, delays_s, strict=True):
            earlier_s = run.time_s - delay_s
            late.append(np.interp(earlier_s, run.time_s, current))
        current_a = np.stack(late, axis=1)
        return replace(run, current_a=current_a)

    return in_all(change)


def without_zero(run: Run) -> Run:
    """A run after the encoder of J2 has lost its zero."""
    return offset(run, degrees=10.0)


def mounted_on_a_wall(runs: Runs) -> Runs:
    """Recordings of an arm whose base is turned from what the cell says."""
    truth = three_axes_truth()
    gravity_m_s2 = np.array([0.0, -9.81, 0.0])
    model = with_gravity(truth.model, gravity_m_s2)
    on_wall = replace(truth, model=model)
    return small_recordings(on_wall, 0, count=len(runs), seconds=SECONDS)


def exchanged(run: Run) -> Run:
    """A run with the currents of J2 and J3 exchanged."""
    current_a = run.current_a[:, [0, 2, 1]]
    return replace(run, current_a=current_a)


def forgotten(run: Run) -> Run:
    """A run without the payload that it declares."""
    (bare,) = small_recordings(three_axes_truth(), 7, count=1, seconds=SECONDS)
    return replace(bare, name=run.name, payload=run.payload)


def clipped(run: Run) -> Run:
    """A run in which a limit clips the current of J2, and the drive does not report it."""
    current = run.current_a.copy()
    of_j2 = current[:, 1]
    limit_a = np.percentile(np.abs(of_j2), 90.0)
    current[:, 1] = np.clip(of_j2, -limit_a, limit_a)
    return replace(run, current_a=current)


def glitched(run: Run) -> Run:
    """A run in which the position of J2 is wrong in one sample."""
    position = run.position_rad.copy()
    position[1000, 1] += 0.5
    return replace(run, position_rad=position)


def frozen(run: Run) -> Run:
    """A run in which the position of J2 stands still for a while although the joint moves."""
    position = run.position_rad.copy()
    of_j2 = position[:, 1]
    speed = np.abs(np.diff(of_j2))
    margin = 1000  # samples, far from both ends
    fastest = np.argmax(speed[margin:-margin])
    start = margin + int(fastest)
    of_j2[start : start + 200] = of_j2[start]
    return replace(run, position_rad=position)


def displaced(run: Run) -> Run:
    """A run in which the encoder of J2 loses its place."""
    position = run.position_rad.copy()
    position[2000:, 1] += 0.5
    return replace(run, position_rad=position)


def constant(run: Run) -> Run:
    """A run in which the channel of J2 has one value."""
    current_a = run.current_a.copy()
    current_a[:, 1] = 0.5
    return replace(run, current_a=current_a)


def half_as_large(run: Run) -> Run:
    """A run in which the current of J2 is half as large."""
    factors = np.array([1.0, 0.51, 1.0])
    (scaled_run,) = with_currents([run], factors)
    return scaled_run


def still(run: Run) -> Run:
    """A run in which the encoder of J3 has one value."""
    position_rad = run.position_rad.copy()
    position_rad[:, 2] = 0.0
    return replace(run, position_rad=position_rad)


#: By mistake: how it is made in the runs r0 to r5 that a fit uses, and what is said of it.
IN_THE_FIT: dict[str, tuple[Mistake, str]] = {
    "none": (lambda runs: runs, ""),
    "J2 half as large": (scaled(1.0, 0.51, 1.0), "gain-off-nameplate J2"),
    "J3 twice as large": (scaled(1.0, 1.0, 2.0), "gain-off-nameplate J3"),
    "J2 reversed": (scaled(1.0, -1.0, 1.0), "current-reversed J2"),
    "all reversed": (scaled(-1.0, -1.0, -1.0), "RolesExchanged"),
    "mA": (scaled(1000.0, 1000.0, 1000.0), "UnitsMistaken"),
    "sizes": (of_size(0, 1, 2), "CurrentUnsigned"),
    "size of J3": (of_size(2), "CurrentUnsigned"),
    "J2 and J3 exchanged": (in_all(exchanged), "ChannelsExchanged"),
    "position of J2 reversed": (in_all(reversed_position), "position-reversed J2"),
    "mounted on a wall": (mounted_on_a_wall, "GeometryTurned"),
    "zero of J2 off": (in_all(offset), "zero-off J2"),
    "all currents late": (late_currents(0.004, 0.004, 0.004), "time-skew"),
    "current of J1 late": (late_currents(0.01, 0.0, 0.0), "current-late J1"),
    "payload turned": (carrying(turned(np.pi)), "payload-differs r3"),
    "payload left off": (carrying(np.zeros(10)), "PayloadUnseen"),
    "noise on J3": (in_used(noisy), "axis-error J3"),
    "J2 clipped": (in_one(3, clipped), "current-clipped r3 J2"),
    "J2 wrong in a sample": (in_one(3, glitched), "readings-damaged r3 J2"),
    "J2 displaced": (in_one(3, displaced), "ReadingsDamaged"),
    "J2 constant": (in_one(3, constant), "CurrentConstant"),
    "J3 still": (in_loaded(still), "JointStill"),
}
#: The same in r6 and r7, which are held out.
IN_HELD_OUT: dict[str, tuple[Mistake, str]] = {
    "held out: J2 clipped": (in_one(7, clipped), "current-clipped r7 J2"),
    "held out: J2 frozen": (in_one(7, frozen), "readings-frozen r7 J2"),
    "held out: J2 constant": (in_one(7, constant), "CurrentConstant"),
    "held out: J2 half as large": (in_one(7, half_as_large), "current-off-scale r7 J2"),
    "held out: exchanged": (in_one(6, exchanged), "channels-exchanged r6 J2 J3"),
    "held out: position of J2 reversed": (in_one(6, reversed_position), "position-reversed r6 J2"),
    "held out: zero of J2 lost": (in_one(6, without_zero), "zero-off r6 J2"),
    "held out: noise on J3": (in_one(6, noisy), "axis-error r6 J3"),
    "held out: without payload": (in_one(7, forgotten), "payload-differs r7"),
}
MISTAKES = IN_THE_FIT | IN_HELD_OUT


@pytest.fixture(scope="module")
def three_axis_cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    folder = tmp_path_factory.mktemp("cell")
    (folder / "arm.urdf").write_text(THREE_AXES.urdf)
    gains = three_axes_truth().gains
    text = CELL
    for number, gain in enumerate(gains, start=1):
        name = f"J{number}"
        text += AXIS.format(name=name, gain=gain)
    cell_file = folder / "cell.yaml"
    cell_file.write_text(text + REST)
    return load_cell(cell_file)


@pytest.fixture(scope="module")
def recorded() -> Runs:
    return small_recordings(three_axes_truth(), 0, count=RUNS, seconds=SECONDS)


def said(diagnoses: tuple[Diagnosis, ...]) -> set[str]:
    """Names of diagnoses with their runs and axes."""
    found = set()
    for one in diagnoses:
        words = (one.name, *one.runs, *one.axes)
        found.add(" ".join(words))
    return found


def check_zero_off(diagnosis: Diagnosis) -> None:
    assert diagnosis.name == "zero-off"
    assert diagnosis.axes == ("J2",)


def texts(diagnoses: tuple[Diagnosis, ...]) -> list[str]:
    return sorted(one.text for one in diagnoses)


def refuse_to_weigh(*_: object, **__: object) -> None:
    """Weigh no payload."""
    raise IdentificationError("no mass is asked for")


def with_digest(run: Run) -> Run:
    """The run, with its number for the digest of its log."""
    number = int(run.name[1:])
    return replace(run, digest=f"{number:064x}")


def serve(monkeypatch: pytest.MonkeyPatch, cell: Cell, runs: Iterable[Run]) -> None:
    """Give these runs to every verb in place of logs of their names."""
    by_name = {run.name: run for run in runs}

    def load(
        path: Path, given: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return by_name[path.name], given or cell

    monkeypatch.setattr(fit_module, "load_run", load)
    monkeypatch.setattr(validate_module, "load_run", load)


def search_few_families(monkeypatch: pytest.MonkeyPatch) -> None:
    few = partial(find_effects, families=FEW_FAMILIES)
    monkeypatch.setattr(fit_module, "find_effects", few)


def remember_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute no check of the geometry again that was asked for with the same arguments.

    Every verb asks for these checks itself.
    """
    turned_geometry = remembered(find_turned_geometry)
    monkeypatch.setattr(diagnoses_module, "find_turned_geometry", turned_geometry)
    monkeypatch.setattr(validate_module, "find_turned_geometry", turned_geometry)
    monkeypatch.setattr(fit_module, "geometry_beside", remembered(geometry_beside))


def certificate_text(calibration: Calibration) -> str:
    """What the certificate shows, without its markup."""
    comparison = without_controller(calibration, "Not read.", WHEN)
    page = certificate_page(certify(calibration, comparison))
    return unescape(re.sub(r"<[^>]*>|`", "", page))


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_same_is_said_by_every_verb(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch, mistake: str
) -> None:
    change, expected = MISTAKES[mistake]
    runs = [with_digest(run) for run in change(recorded)]
    serve(monkeypatch, three_axis_cell, runs)
    search_few_families(monkeypatch)
    remember_geometry(monkeypatch)
    # The masses of a validation say nothing of a diagnosis.
    monkeypatch.setattr(validate_module, "rows_to_weigh", refuse_to_weigh)

    def diagnoses_of_fit_logs() -> tuple[Diagnosis, ...]:
        calibration = fit_logs(LOGS, holdout=HELD_OUT, effects=False, created=WHEN)
        return calibration.diagnoses

    try:
        fitted = fit(LOGS, holdout=HELD_OUT, keep_rows=True)
        # As the command does it: the search judges held-out logs, with its own model.
        unjudged = fitted
        if mistake.startswith("held out"):
            unjudged = fit(LOGS, holdout=HELD_OUT, keep_rows=True, judge_holdout=False)
    except IdentificationError as error:
        assert type(error).__name__ == expected
        message = re.escape(str(error))
        with pytest.raises(type(error), match=message):
            diagnoses_of_fit_logs()
        return
    expected_names = {expected} if expected else set()
    assert said(fitted.diagnoses) == expected_names
    expected_texts = texts(fitted.diagnoses)
    assert texts(diagnoses_of_fit_logs()) == expected_texts
    # Where a search adds an effect, the gains are others, and so are the numbers in a text.
    closed = close_loop(unjudged, 0)
    assert said(closed.diagnoses) == said(fitted.diagnoses)
    content = encode_calibration(calibration_of(fitted, WHEN))
    calibration = decode_calibration(content, "calibration.yaml")
    assert texts(calibration.diagnoses) == expected_texts
    for logs in (LOGS, HELD_OUT, [*LOGS, *HELD_OUT]):
        validated = cross_validate({"one": calibration}, logs)
        assert texts(validated.diagnoses) == expected_texts
    shown = certificate_text(calibration)
    for one in fitted.diagnoses:
        sentence = f"CHECK {one.text}."
        assert sentence.replace("`", "") in shown


@pytest.mark.parametrize(
    ("degrees", "next_step"), [(4.0, "correct the description"), (0.0, "drivegain residual")]
)
def test_a_wrong_description_is_corrected_before_the_next_step(
    three_axis_cell: Cell,
    recorded: Runs,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    degrees: float,
    next_step: str,
) -> None:
    runs = [with_digest(offset(run, degrees)) for run in recorded]
    serve(monkeypatch, three_axis_cell, runs)
    fitted = fit(LOGS, holdout=HELD_OUT)
    calibration = calibration_of(fitted, WHEN)
    say_after_fit(calibration, LOGS, Path("fit.yaml"))
    is_wrong = degrees != 0.0
    error_output = capsys.readouterr().err
    assert f"Next: {next_step}" in error_output
    assert bool(uncorrected_description(calibration)) == is_wrong
    validated = cross_validate({"one": calibration}, HELD_OUT)
    screen = StringIO()
    console = Console(width=400, file=screen)
    console.print(*validation_view(calibration, validated))
    said_of_fit = "The fit of this calibration found: CHECK J2" in screen.getvalue()
    assert said_of_fit == is_wrong


def test_a_zero_that_a_given_description_changes_is_tested_on_a_run_without_load(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It explains a small part of what a run without load leaves, and was not named."""
    serve(monkeypatch, three_axis_cell, map(with_digest, recorded))
    calibration = calibration_of(fit(LOGS), WHEN)
    given = Recording(
        recorded_s=None,
        entered_kg=None,
        serials=(),
        saturated_percent=(),
        lost_cycles=0,
        missing=(),
        controller_sha256=None,
        replaced_configuration_sha256="a",
        corrected=(CHANGED_SECTION,),
    )
    rng = np.random.default_rng(1)
    unloaded = recorded[6]
    noise_a = 0.06 * rng.standard_normal(unloaded.current_a.shape)
    current_a = unloaded.current_a + noise_a
    moved = replace(offset(unloaded, 4.0), current_a=current_a)
    moved_and_given = replace(moved, recording=given)
    other_cell = replace(three_axis_cell, digest="other", recording_digest="other")

    calibrations = {"one": calibration}
    unloaded_log = [Path("r6")]

    serve(monkeypatch, other_cell, [moved_and_given])
    validated = cross_validate(calibrations, unloaded_log, other_cell)
    assert said(validated.diagnoses) == {"zero-off r6 J2"}
    assert "the given cell file has another number here" in validated.diagnoses[0].remedy

    serve(monkeypatch, other_cell, [moved])
    validated = cross_validate(calibrations, unloaded_log, other_cell)
    assert said(validated.diagnoses) == set()

    # A calibration of the same description predicts in the same geometry.
    made_with_it = replace(calibration, recording_configuration_sha256="other")
    assert replaced_geometry(made_with_it, moved_and_given, other_cell) == ()


def test_a_zero_that_a_fit_has_named_is_named_after_a_search_that_finds_nothing(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(monkeypatch, three_axis_cell, map(offset, recorded))
    fitted = fit(LOGS)
    limits_nm = np.zeros(3)
    found_nothing = Step((), (), limits_nm, None, fitted.evidence(), declared=True)
    beside_declared = replace(fitted, steps=(found_nothing,))
    assert said(description_diagnoses(beside_declared)) == {"zero-off J2"}
    searched = replace(found_nothing, declared=False)
    after_search = replace(fitted, steps=(searched,))
    assert said(description_diagnoses(after_search)) == {"zero-off J2"}


def test_a_zero_that_the_search_has_set_aside_is_named_and_one_in_its_noise_is_not(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(monkeypatch, three_axis_cell, recorded)
    fitted = fit(LOGS)
    zero_rad = np.radians(-4.0)
    std_rad = np.radians(0.1)
    finding = passed_finding(ZeroOffset(), 1, zero_rad, std_rad)
    rejected = SetAside(finding, "the squared error on runs left out rises")
    limits_nm = np.zeros(3)
    step = Step((), (), limits_nm, None, fitted.evidence(), set_aside=(rejected,))
    after_search = replace(fitted, steps=(step,))

    (diagnosis,) = description_diagnoses(after_search)
    check_zero_off(diagnosis)
    assert "off by -4.00 ± 0.10°" in diagnosis.found
    reason = "the gains are without this correction (the squared error on runs left out rises)"
    assert reason in diagnosis.found

    # Beside a delay that the moves do not tell from it, it is one diagnosis, and no number is to be
    # typed in.
    late = passed_finding(LatePosition(), 1, 0.002, 1e-4)
    alike = AlikeCorrections((finding, late), ())
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=(), alike=(alike,))
    checked = replace(after_search, description=check)
    (unclear,) = description_diagnoses(checked)
    assert unclear.name == "correction-unclear"
    assert "the zero of J2 off by -4.00 ± 0.10°" in unclear.found
    assert "or the position of J2 late by 2.00 ± 0.10 ms" in unclear.found
    assert "correct nothing in the cell file before that" in unclear.remedy

    left_open = (PlacedEffect(ZeroOffset(), 1),)
    in_its_noise = replace(step, left_open=left_open)
    after_search = replace(fitted, steps=(in_its_noise,))
    assert description_diagnoses(after_search) == ()

    # One that may be zero as it was found asks for no correction of the cell file.
    uncertain = passed_finding(ZeroOffset(), 1, 1.5 * std_rad, std_rad)
    rejected = SetAside(uncertain, "in the joint fit it no longer passes")
    not_significant = replace(step, set_aside=(rejected,))
    assert description_diagnoses(replace(fitted, steps=(not_significant,))) == ()


def test_an_undecided_zero_is_named_and_refuses_the_gains_and_is_in_their_sigma(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A held-out run of three seconds decides nothing."""
    held_out = recorded[6]
    beginning = slice(0, 600)
    time_s = held_out.time_s[beginning]
    position_rad = held_out.position_rad[beginning]
    current_a = held_out.current_a[beginning]
    short = replace(held_out, time_s=time_s, position_rad=position_rad, current_a=current_a)
    runs = []
    for run in (*recorded[:USED], short):
        runs.append(replace(offset(run), digest=run.name))
    serve(monkeypatch, three_axis_cell, runs)
    search_few_families(monkeypatch)
    fitted = fit(LOGS, holdout=[Path("r6")], keep_rows=True)
    closed = close_loop(fitted, 0)
    last_step = closed.steps[-1]
    assert last_step.after.effects == ()
    (verdict,) = last_step.verdicts
    assert verdict.judgement is Judgement.UNDECIDED
    (zero_off,) = [one for one in closed.diagnoses if one.name == "zero-off"]
    assert zero_off.axes == ("J2",)
    assert "held-out runs do not decide it" in zero_off.found
    calibration = calibration_of(closed, WHEN)
    (uncorrected,) = uncorrected_description(calibration)
    assert uncorrected.name == "zero-off"
    gains_std = fitted.estimate.gains_std
    assert np.all(closed.estimate.gains_std > gains_std)


def _first_with_deviation(text: str) -> tuple[float, float]:
    """The first "number ± deviation" of a text."""
    found = re.search(r"([-+]\d+\.\d+) ± (\d+\.\d+)", text)
    assert found is not None
    number, deviation = found.groups()
    return float(number), float(deviation)


def test_a_zero_that_a_search_has_corrected_is_named_with_its_deviation(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was "about -35 deg", and gains and held-out errors of the corrected robot followed."""
    runs = [with_digest(offset(run, 35.0)) for run in recorded]
    serve(monkeypatch, three_axis_cell, runs)
    search_few_families(monkeypatch)
    fitted = fit(LOGS, keep_rows=True)
    assert said(fitted.diagnoses) == {"zero-turned J2"}
    assert "gains and errors mean nothing until it is right" in fitted.diagnoses[0].remedy
    (found,) = close_loop(fitted, 0).diagnoses
    check_zero_off(found)
    zero_deg, std_deg = _first_with_deviation(found.found)
    error_deg = abs(zero_deg + 35.0)
    assert error_deg < 4.0 * std_deg < 2.0


@pytest.mark.parametrize("json", [False, True])
@pytest.mark.parametrize("verb", ["fit", "residual"])
def test_gains_that_mean_nothing_are_refused(
    three_axis_cell: Cell,
    recorded: Runs,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    verb: str,
    json: bool,
) -> None:
    """They ended with exit code 0, beside a CHECK that said so."""
    runs = [with_digest(reversed_position(run)) for run in recorded]
    serve(monkeypatch, three_axis_cell, runs)
    search_few_families(monkeypatch)
    out = tmp_path / "calibration.yaml"
    logs = [str(log) for log in LOGS]
    command = [verb, *logs, "--out", str(out)]
    if json:
        command.append("--json")
    assert main(command) == ExitCode.DATA_UNFIT
    text, said_on_stderr = capsys.readouterr()
    assert "a position that counts the other way" in said_on_stderr
    assert "gains and errors mean nothing until it is right" in said_on_stderr
    assert "Next:" not in said_on_stderr
    assert not out.exists()
    assert ('"diagnoses"' in text) == json
    if verb == "fit" and not json:
        assert text == ""


def test_what_is_said_of_another_run_leaves_the_gains_as_they_are() -> None:
    of_run = Diagnosis(
        "position-reversed", ("held-out",), ("J2",), "a position", "another", "reverse it"
    )
    assert geometry_refusal((of_run,)) is None
    of_fit = replace(of_run, runs=())
    refused = geometry_refusal((of_run, of_fit))
    assert refused is not None
    assert str(refused).startswith("J2")


def test_a_lean_that_a_zero_explains_as_well_is_named_with_it_and_no_number_is_to_be_typed_in(
    three_axis_cell: Cell, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = three_axes_truth()
    lean_rad = np.radians(2.0)
    down = np.array([np.sin(lean_rad), 0.0, -np.cos(lean_rad)])
    model = with_gravity(truth.model, 9.81 * down)
    leaning = replace(truth, model=model)
    rng = np.random.default_rng(8)

    less = np.array([0.06, 1.0, 1.0])

    def with_j1_hardly_moving(position_rad: FloatArray) -> FloatArray:
        return np.asarray(position_rad * less)

    runs = []
    for number, payload in enumerate((None, MOUNTED, None, MOUNTED)):
        run = record(
            leaning,
            f"r{number}",
            rng,
            payload,
            seconds=15.0,
            noise_a=0.1,
            rate_hz=500.0,
            bend=with_j1_hardly_moving,
        )
        runs.append(with_digest(run))
    serve(monkeypatch, three_axis_cell, runs)
    fitted = fit(LOGS[:4], gains_fixed=True)
    (found,) = fitted.diagnoses
    assert found.name == "correction-unclear"
    assert found.axes == ("J2",)
    assert "the zero of J2 off by" in found.found
    assert "gravity along" in found.found
    assert "these moves do not tell them apart" in found.found
    assert "record moves in which J1 turns further" in found.remedy
    assert not re.search(r"\d\.\d", found.remedy)
    calibration = calibration_of(fitted, WHEN)
    say_after_fit(calibration, [], None)
    assert "Next: record the moves that CHECK asks for" in capsys.readouterr().err


def test_each_hidden_zero_has_its_own_reason(three_axis_cell: Cell) -> None:
    robot = three_axes_truth().model.robot
    axis_names = three_axis_cell.axis_names
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=(0, 1, 2))
    text = hidden_zeros_text(check, axis_names, robot)
    assert "of J1: another one turns or shifts the whole arm" in text
    assert "of J3: no joint is behind it" in text
    assert "of J2: these moves do not show it" in text
    without_hidden = replace(check, hidden_zeros=())
    assert hidden_zeros_text(without_hidden, axis_names, robot) == ""


def test_the_key_that_is_named_reverses_a_position_and_no_current(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [with_digest(reversed_position(run)) for run in recorded]
    serve(monkeypatch, three_axis_cell, runs)
    (diagnosis,) = fit(LOGS, keep_rows=True).diagnoses
    assert diagnosis.name == "position-reversed"
    assert diagnosis.axes == ("J2",)
    assert "the row of J2 in `drive_train.ratio`" in diagnosis.remedy
    declared = three_axis_cell.ratio
    corrected = declared.copy()
    corrected[1] = -declared[1]
    # The way from motor to joint turns for J2 alone, and the torque of a motor at its joint stays.
    motor_rad = np.array([1.0, 2.0, 3.0])
    declared_rad = np.linalg.solve(declared, motor_rad)
    corrected_rad = np.linalg.solve(corrected, motor_rad)
    turns = corrected_rad / declared_rad
    np.testing.assert_allclose(turns, [1.0, -1.0, 1.0])
    corrected_direction = DriveTrain(corrected).direction
    declared_direction = DriveTrain(declared).direction
    np.testing.assert_allclose(corrected_direction, declared_direction)
