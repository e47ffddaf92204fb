"""A recording gets the same diagnoses from `fit`, `residual`, `validate`, the report,
and `daq.fit_logs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
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
from tests.ident.recordings import MOUNTED, record, three_axes_truth
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

SECTION = "axes.zero_offset (J2)"  #: That a given description changes
RUNS, USED = 8, 6  #: Recordings, and how many of them a fit uses; the others are held out
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
    return lambda runs: [change(run) if index == number else run for index, run in enumerate(runs)]


def carrying(body: np.ndarray) -> Mistake:
    """Another body than the payload in the second loaded run."""
    truth = three_axes_truth()
    carried = small_recordings(truth, 0, count=RUNS, seconds=SECONDS, bodies={3: body})[3]
    return in_one(3, lambda _: carried)


def scaled(*factors: float) -> Mistake:
    """Currents that are recorded too large or too small."""
    return lambda runs: with_currents(runs, np.array(factors))


def of_size(*axes: int) -> Mistake:
    """Drives that report the size of their current."""

    def change(run: Run) -> Run:
        current = run.current_a.copy()
        current[:, axes] = np.abs(current[:, axes])
        return replace(run, current_a=current)

    return lambda runs: [change(run) for run in runs]


def noisy(run: Run) -> Run:
    """A run of which the last current is mostly noise."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(run.current_a.shape) * np.array([0.0, 0.0, 1.0])
    current_a = run.current_a + noise
    return replace(run, current_a=current_a)


def reversed_position(run: Run) -> Run:
    """A run in which the position of J2 counts the other way."""
    position_rad = run.position_rad * np.array([1.0, -1.0, 1.0])
    return replace(run, position_rad=position_rad)


def offset(run: Run, degrees: float = 4.0) -> Run:
    """A run in which the zero of J2 is off."""
    position_rad = run.position_rad + np.array([0.0, np.radians(degrees), 0.0])
    return replace(run, position_rad=position_rad)


def late_currents(*delays_s: float) -> Mistake:
    """Currents that were stamped too late, by so much on each axis."""

    def change(run: Run) -> Run:
        columns = zip(run.current_a.T, delays_s, strict=True)
        late = [
            np.interp(run.time_s - delay_s, run.time_s, current) for current, delay_s in columns
        ]
        current_a = np.stack(late, axis=1)
        return replace(run, current_a=current_a)

    return lambda runs: [change(run) for run in runs]


def without_zero(run: Run) -> Run:
    """A run after the encoder of J2 has lost its zero."""
    return offset(run, degrees=10.0)


def mounted_on_a_wall(runs: Runs) -> Runs:
    """Recordings of an arm whose base is turned from what the cell says."""
    truth = three_axes_truth()
    gravity_m_s2 = np.array([0.0, -9.81, 0.0])
    model = with_gravity(truth.model, gravity_m_s2)
    wall = replace(truth, model=model)
    return small_recordings(wall, 0, count=len(runs), seconds=SECONDS)


def exchanged(run: Run) -> Run:
    """A run with the currents of J2 and J3 exchanged."""
    return replace(run, current_a=run.current_a[:, [0, 2, 1]])


def forgotten(run: Run) -> Run:
    """A run without the payload that it declares."""
    bare = small_recordings(three_axes_truth(), 7, count=1, seconds=SECONDS)[0]
    return replace(bare, name=run.name, payload=run.payload)


def clipped(run: Run) -> Run:
    """A run in which a limit clips the current of J2, and the drive does not report it."""
    current = run.current_a.copy()
    absolute_current = np.abs(current[:, 1])
    limit = float(np.percentile(absolute_current, 90.0))
    current[:, 1] = np.clip(current[:, 1], -limit, limit)
    return replace(run, current_a=current)


def glitched(run: Run) -> Run:
    """A run in which the position of J2 is wrong in one sample."""
    position = run.position_rad.copy()
    position[1000, 1] += 0.5
    return replace(run, position_rad=position)


def frozen(run: Run) -> Run:
    """A run in which the position of J2 stands still for a while although the joint moves."""
    position = run.position_rad.copy()
    position_steps = np.diff(position[:, 1])
    speed = np.abs(position_steps)
    largest_speed_index = np.argmax(speed[1000:-1000])
    start = 1000 + int(largest_speed_index)
    position[start : start + 200, 1] = position[start, 1]
    return replace(run, position_rad=position)


def displaced(run: Run) -> Run:
    """A run in which the encoder of J2 loses its place."""
    position = run.position_rad.copy()
    position[2000:, 1] += 0.5
    return replace(run, position_rad=position)


def constant(run: Run) -> Run:
    """A run in which the channel of J2 has one value."""
    current_a = run.current_a * np.array([1.0, 0.0, 1.0]) + np.array([0.0, 0.5, 0.0])
    return replace(run, current_a=current_a)


def still(run: Run) -> Run:
    """A run in which the encoder of J3 has one value."""
    position_rad = run.position_rad * np.array([1.0, 1.0, 0.0])
    return replace(run, position_rad=position_rad)


#: By mistake: how it is made in the runs r0 to r7, of which r6 and r7 are held out, and what is
#: said of it.
MISTAKES: dict[str, tuple[Mistake, str]] = {
    "none": (lambda runs: runs, ""),
    "J2 half as large": (scaled(1.0, 0.51, 1.0), "gain-off-nameplate J2"),
    "J3 twice as large": (scaled(1.0, 1.0, 2.0), "gain-off-nameplate J3"),
    "J2 reversed": (scaled(1.0, -1.0, 1.0), "current-reversed J2"),
    "all reversed": (scaled(-1.0, -1.0, -1.0), "RolesExchanged"),
    "mA": (scaled(1000.0, 1000.0, 1000.0), "UnitsMistaken"),
    "sizes": (of_size(0, 1, 2), "CurrentUnsigned"),
    "size of J3": (of_size(2), "CurrentUnsigned"),
    "J2 and J3 exchanged": (lambda runs: [exchanged(run) for run in runs], "ChannelsExchanged"),
    "position of J2 "
    "reversed": (lambda runs: [reversed_position(run) for run in runs], "position-reversed J2"),
    "mounted on a wall": (mounted_on_a_wall, "GeometryTurned"),
    "zero of J2 off": (lambda runs: [offset(run) for run in runs], "zero-off J2"),
    "all currents late": (late_currents(0.004, 0.004, 0.004), "time-skew"),
    "current of J1 late": (late_currents(0.01, 0.0, 0.0), "current-late J1"),
    "payload turned": (carrying(turned(np.pi)), "payload-differs r3"),
    "payload left off": (carrying(np.zeros(10)), "PayloadUnseen"),
    "noise on J3": (lambda runs: [*map(noisy, runs[:USED]), *runs[USED:]], "axis-error J3"),
    "J2 clipped": (in_one(3, clipped), "current-clipped r3 J2"),
    "J2 wrong in a sample": (in_one(3, glitched), "readings-damaged r3 J2"),
    "J2 displaced": (in_one(3, displaced), "ReadingsDamaged"),
    "J2 constant": (in_one(3, constant), "CurrentConstant"),
    "J3 still": (lambda runs: [still(run) if run.payload else run for run in runs], "JointStill"),
    "held out: J2 clipped": (in_one(7, clipped), "current-clipped r7 J2"),
    "held out: J2 frozen": (in_one(7, frozen), "readings-frozen r7 J2"),
    "held out: J2 constant": (in_one(7, constant), "CurrentConstant"),
    "held out: J2 half as large": (
        in_one(7, lambda run: with_currents([run], np.array([1.0, 0.51, 1.0]))[0]),
        "current-off-scale r7 J2",
    ),
    "held out: exchanged": (in_one(6, exchanged), "channels-exchanged r6 J2 J3"),
    "held out: position of J2 reversed": (in_one(6, reversed_position), "position-reversed r6 J2"),
    "held out: zero of J2 lost": (in_one(6, without_zero), "zero-off r6 J2"),
    "held out: noise on J3": (in_one(6, noisy), "axis-error r6 J3"),
    "held out: without payload": (in_one(7, forgotten), "payload-differs r7"),
}  # fmt: skip


@pytest.fixture(scope="module")
def three_axis_cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    folder = tmp_path_factory.mktemp("cell")
    (folder / "arm.urdf").write_text(THREE_AXES.urdf)
    gains = three_axes_truth().gains
    axes = "".join(
        AXIS.format(name=f"J{number}", gain=gain) for number, gain in enumerate(gains, start=1)
    )
    (folder / "cell.yaml").write_text(CELL + axes + REST)
    return load_cell(folder / "cell.yaml")


@pytest.fixture(scope="module")
def recorded() -> Runs:
    return small_recordings(three_axes_truth(), 0, count=RUNS, seconds=SECONDS)


def said(diagnoses: tuple[Diagnosis, ...]) -> set[str]:
    """Names of diagnoses with their runs and axes."""
    return {" ".join((one.name, *one.runs, *one.axes)) for one in diagnoses}


def refuse_to_weigh() -> None:
    """Weigh no payload."""
    raise IdentificationError("no mass is asked for")


def texts(diagnoses: tuple[Diagnosis, ...]) -> list[str]:
    return sorted(one.text for one in diagnoses)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_same_is_said_by_every_verb(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch, mistake: str
) -> None:
    change, expected = MISTAKES[mistake]
    runs = {run.name: replace(run, digest=f"{int(run.name[1:]):064x}") for run in change(recorded)}

    def load(
        path: Path, given: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return runs[path.name], given or three_axis_cell

    for module in (fit_module, validate_module):
        monkeypatch.setattr(module, "load_run", load)
    monkeypatch.setattr(fit_module, "find_effects", partial(find_effects, families=FEW_FAMILIES))
    # Every verb asks for these itself; what is asked with the same arguments again is not computed
    # again.
    turned_geometry = remembered(find_turned_geometry)
    for asking in (diagnoses_module, validate_module):
        monkeypatch.setattr(asking, "find_turned_geometry", turned_geometry)
    monkeypatch.setattr(fit_module, "geometry_beside", remembered(geometry_beside))
    # The masses of a validation say nothing of a diagnosis.
    monkeypatch.setattr(validate_module, "rows_to_weigh", lambda *_, **__: refuse_to_weigh())
    paths = [Path(f"r{number}") for number in range(RUNS)]
    logs = paths[:USED]
    holdout = paths[USED:]
    verbs: dict[str, Callable[[], tuple[Diagnosis, ...]]] = {
        # Where a search adds an effect, the gains are others, and so are the numbers in a text.
        "residual": lambda: close_loop(unjudged, 0).diagnoses,
        "fit_logs": lambda: fit_logs(logs, holdout=holdout, effects=False, created=WHEN).diagnoses,
    }
    try:
        fitted = fit(logs, holdout=holdout, keep_rows=True)
        # As the command does it: the search judges held-out logs, with its own model.
        unjudged = fitted
        if mistake.startswith("held out"):
            unjudged = fit(logs, holdout=holdout, keep_rows=True, judge_holdout=False)
    except IdentificationError as error:
        assert type(error).__name__ == expected
        with pytest.raises(type(error), match=re.escape(str(error))):
            verbs["fit_logs"]()
        return
    assert said(fitted.diagnoses) == ({expected} if expected else set())
    diagnoses = verbs["fit_logs"]()
    assert texts(diagnoses) == texts(fitted.diagnoses)
    assert said(verbs["residual"]()) == said(fitted.diagnoses)
    content = encode_calibration(calibration_of(fitted, WHEN))
    calibration = decode_calibration(content, "calibration.yaml")
    assert texts(calibration.diagnoses) == texts(fitted.diagnoses)
    for given in (logs, holdout, [*logs, *holdout]):
        assert texts(cross_validate({"one": calibration}, given).diagnoses) == texts(
            fitted.diagnoses
        )
    comparison = without_controller(calibration, "Not read.", WHEN)
    page = certificate_page(certify(calibration, comparison))
    shown = unescape(re.sub(r"<[^>]*>|`", "", page))
    for one in fitted.diagnoses:
        assert f"CHECK {one.text}.".replace("`", "") in shown


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
    runs = {
        run.name: replace(offset(run, degrees), digest=f"{int(run.name[1:]):064x}")
        for run in recorded
    }
    for module in (fit_module, validate_module):
        monkeypatch.setattr(module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    paths = [Path(f"r{number}") for number in range(RUNS)]
    fitted = fit(paths[:USED], holdout=paths[USED:])
    calibration = calibration_of(fitted, WHEN)
    say_after_fit(calibration, paths[:USED], Path("fit.yaml"))
    error_output = capsys.readouterr().err
    assert f"Next: {next_step}" in error_output
    assert bool(uncorrected_description(calibration)) == bool(degrees)
    screen = StringIO()
    console = Console(width=400, file=screen)
    console.print(*validation_view(calibration, cross_validate({"one": calibration}, paths[USED:])))
    said_of_fit = "The fit of this calibration found: CHECK J2" in screen.getvalue()
    assert said_of_fit == bool(degrees)


def test_a_zero_that_a_given_description_changes_is_tested_on_a_run_without_load(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It explains a small part of what a run without load leaves, and was not named."""
    runs = {run.name: replace(run, digest=f"{int(run.name[1:]):064x}") for run in recorded}
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    logs = [Path(f"r{number}") for number in range(USED)]
    calibration = calibration_of(fit(logs), WHEN)
    given = Recording(
        None, None, (), (), 0, (), None, replaced_configuration_sha256="a", corrected=(SECTION,)
    )
    rng = np.random.default_rng(1)
    current_a = recorded[6].current_a
    noise_a = 0.06 * rng.standard_normal(current_a.shape)
    moved = replace(
        offset(recorded[6], 4.0), current_a=recorded[6].current_a + noise_a, recording=given
    )
    other = replace(three_axis_cell, digest="other", recording_digest="other")
    found: dict[str, set[str]] = {}
    changed_moved = replace(moved, recording=None)
    for name, run in {"given": moved, "recorded": changed_moved}.items():
        monkeypatch.setattr(validate_module, "load_run", lambda *_, run=run: (run, other))
        diagnoses = cross_validate({"one": calibration}, [Path("r6")], other).diagnoses
        found[name] = said(diagnoses)
        if name == "given":
            assert "the given cell file has another number here" in diagnoses[0].remedy
    expected = {"given": {"zero-off r6 J2"}, "recorded": set()}
    assert found == expected
    # A calibration of the same description predicts in the same geometry.
    made_with_it = replace(calibration, recording_configuration_sha256=other.recording_digest)
    assert replaced_geometry(made_with_it, moved, other) == ()


def test_a_zero_that_a_fit_has_named_is_named_after_a_search_that_finds_nothing(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = {run.name: offset(run) for run in recorded}
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    logs = [Path(f"r{number}") for number in range(USED)]
    fitted = fit(logs)
    evidence = fitted.evidence()
    limits_nm = np.zeros(3)
    step = Step((), (), limits_nm, None, evidence, declared=True)
    changed_fitted = replace(fitted, steps=(step,))
    beside_declared = description_diagnoses(changed_fitted)
    assert said(beside_declared) == {"zero-off J2"}
    steps = (replace(step, declared=False),)
    after_search = description_diagnoses(replace(fitted, steps=steps))
    assert said(after_search) == {"zero-off J2"}


def test_a_zero_that_the_search_has_set_aside_is_named_and_one_in_its_noise_is_not(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = {run.name: run for run in recorded}
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    logs = [Path(f"r{number}") for number in range(USED)]
    fitted = fit(logs)
    std = np.radians(0.1)
    finding = passed_finding(ZeroOffset(), 1, np.radians(-4.0), std)
    aside = SetAside(finding, "the squared error on runs left out rises")
    limits_nm = np.zeros(3)
    step = Step((), (), limits_nm, None, fitted.evidence(), set_aside=(aside,))
    changed_fitted = replace(fitted, steps=(step,))
    (diagnosis,) = description_diagnoses(changed_fitted)
    assert (diagnosis.name, diagnosis.axes) == ("zero-off", ("J2",))
    assert "off by -4.00 ± 0.10°" in diagnosis.found
    assert (
        "the gains are without this correction (the squared error on runs left out rises)"
    ) in diagnosis.found
    # Beside a delay that the moves do not tell from it, it is one diagnosis, and no number is to be
    # typed in.
    late = passed_finding(LatePosition(), 1, 0.002, 1e-4)
    alike = (AlikeCorrections((finding, late), ()),)
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=(), alike=alike)
    (unclear,) = description_diagnoses(replace(fitted, steps=(step,), description=check))
    assert unclear.name == "correction-unclear"
    assert "the zero of J2 off by -4.00 ± 0.10°" in unclear.found
    assert "or the position of J2 late by 2.00 ± 0.10 ms" in unclear.found
    assert "correct nothing in the cell file before that" in unclear.remedy
    left_open = (PlacedEffect(ZeroOffset(), 1),)
    in_its_noise = replace(step, left_open=left_open)
    assert description_diagnoses(replace(fitted, steps=(in_its_noise,))) == ()


def test_an_undecided_zero_is_named_and_refuses_the_gains_and_is_in_their_sigma(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A held-out run of three seconds decides nothing."""
    time_s = recorded[6].time_s
    position_rad = recorded[6].position_rad
    current_a = recorded[6].current_a
    short = replace(
        recorded[6],
        time_s=time_s[:600],
        position_rad=position_rad[:600],
        current_a=current_a[:600],
    )
    runs = {run.name: replace(offset(run), digest=run.name) for run in (*recorded[:USED], short)}
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    monkeypatch.setattr(fit_module, "find_effects", partial(find_effects, families=FEW_FAMILIES))
    logs = [Path(f"r{number}") for number in range(USED)]
    holdout = [Path("r6")]
    fitted = fit(logs, holdout=holdout, keep_rows=True)
    closed = close_loop(fitted, 0)
    last_step = closed.steps[-1]
    assert last_step.after.effects == ()
    (verdict,) = closed.steps[-1].verdicts
    assert verdict.judgement is Judgement.UNDECIDED
    named = [one for one in closed.diagnoses if one.name == "zero-off"]
    axes = [one.axes for one in named]
    assert axes == [("J2",)]
    assert "held-out runs do not decide it" in named[0].found
    calibration = calibration_of(closed, WHEN)
    assert [one.name for one in uncorrected_description(calibration)] == ["zero-off"]
    assert np.all(closed.estimate.gains_std > fitted.estimate.gains_std)


def test_a_zero_that_a_search_has_corrected_is_named_with_its_deviation(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was "about -35 deg", and gains and held-out errors of the corrected robot followed."""
    runs = {
        run.name: replace(offset(run, 35.0), digest=f"{int(run.name[1:]):064x}") for run in recorded
    }
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    monkeypatch.setattr(fit_module, "find_effects", partial(find_effects, families=FEW_FAMILIES))
    logs = [Path(f"r{number}") for number in range(USED)]
    fitted = fit(logs, keep_rows=True)
    assert said(fitted.diagnoses) == {"zero-turned J2"}
    assert "gains and errors mean nothing until it is right" in fitted.diagnoses[0].remedy
    (found,) = close_loop(fitted, 0).diagnoses
    assert (found.name, found.axes) == ("zero-off", ("J2",))
    matches = re.findall(r"([-+]\d+\.\d+) ± (\d+\.\d+)", found.found)
    number, deviation = matches[0]
    assert abs(float(number) + 35.0) < 4.0 * float(deviation) < 2.0


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
    runs = {
        run.name: replace(run, digest=f"{int(run.name[1:]):064x}")
        for run in map(reversed_position, recorded)
    }
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    monkeypatch.setattr(fit_module, "find_effects", partial(find_effects, families=FEW_FAMILIES))
    out = tmp_path / "calibration.yaml"
    command = [verb, *(f"r{number}" for number in range(USED)), "--out", str(out)]
    assert main([*command, *(["--json"] if json else [])]) == ExitCode.DATA_UNFIT
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
    diagnoses = (of_run, replace(of_run, runs=()))
    refused = geometry_refusal(diagnoses)
    assert refused is not None
    assert str(refused).startswith("J2")


def test_a_lean_that_a_zero_explains_as_well_is_named_with_it_and_no_number_is_to_be_typed_in(
    three_axis_cell: Cell, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = three_axes_truth()
    lean = np.radians(2.0)
    gravity_m_s2 = 9.81 * np.array([np.sin(lean), 0.0, -np.cos(lean)])
    model = with_gravity(truth.model, gravity_m_s2)
    leaning = replace(truth, model=model)
    rng = np.random.default_rng(8)
    less = np.array([0.06, 1.0, 1.0])  # J1 hardly moves
    runs: dict[str, Run] = {}
    for number in range(4):
        payload = MOUNTED if number % 2 else None
        run = record(
            leaning,
            f"r{number}",
            rng,
            payload,
            seconds=15.0,
            noise_a=0.1,
            rate_hz=500.0,
            bend=lambda q: q * less,
        )
        digest = f"{number:064x}"
        runs[run.name] = replace(run, digest=digest)
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    logs = [Path(f"r{number}") for number in range(4)]
    fitted = fit(logs, gains_fixed=True)
    (found,) = fitted.diagnoses
    assert (found.name, found.axes) == ("correction-unclear", ("J2",))
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
    hidden_zeros = (0, 1, 2)
    check = GeometryCheck(gravity=None, mistakes=(), hidden_zeros=hidden_zeros)
    text = hidden_zeros_text(check, three_axis_cell.axis_names, robot)
    assert "of J1: another one turns or shifts the whole arm" in text
    assert "of J3: no joint is behind it" in text
    assert "of J2: these moves do not show it" in text
    changed_check = replace(check, hidden_zeros=())
    assert hidden_zeros_text(changed_check, three_axis_cell.axis_names, robot) == ""


def test_the_key_that_is_named_reverses_a_position_and_no_current(
    three_axis_cell: Cell, recorded: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = {
        run.name: replace(run, digest=f"{int(run.name[1:]):064x}")
        for run in map(reversed_position, recorded)
    }
    monkeypatch.setattr(fit_module, "load_run", lambda path, *_: (runs[path.name], three_axis_cell))
    logs = [Path(f"r{number}") for number in range(USED)]
    (diagnosis,) = fit(logs, keep_rows=True).diagnoses
    assert (diagnosis.name, diagnosis.axes) == ("position-reversed", ("J2",))
    assert "the row of J2 in `drive_train.ratio`" in diagnosis.remedy
    declared = three_axis_cell.ratio
    corrected = declared * np.array([1.0, -1.0, 1.0])[:, None]
    # The way from motor to joint turns for J2 alone, and the torque of a motor at its joint stays.
    counts = np.array([1.0, 2.0, 3.0])
    corrected_inverse = np.linalg.inv(corrected)
    declared_inverse = np.linalg.inv(declared)
    turned_rad = corrected_inverse @ counts / (declared_inverse @ counts)
    expected = [1.0, -1.0, 1.0]
    np.testing.assert_allclose(turned_rad, expected)
    np.testing.assert_allclose(DriveTrain(corrected).direction, DriveTrain(declared).direction)
