"""Every table of the command line on a terminal of 80 columns and in a pipe:
each number is whole.
"""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console, Group, RenderableType
from rich.table import Table

from daq.cli.terminal import PIPE_COLUMNS
from daq.config.cell import Cell
from daq.jobs.cell_fit import Failure, Summary
from daq.jobs.fleet import FleetRow, fleet_view
from daq.ledger.fold import Entry
from daq.ledger.ledger import read_history
from daq.ledger.watch import Series, watch
from daq.report import (
    bus_views,
    fit,
    full_parameters,
    gains,
    history,
    mjcf_views,
    paper_tables,
    proposal,
    residual,
    urdf_views,
    validation,
    weighing_views,
)
from daq.report.bus_views import ScannedNode
from daq.report.log import log_lines
from daq.report.text import WholeTable
from daq.workflow.full_choice import ChosenBy
from daq.workflow.live_prediction import RecentCurrent
from daq.workflow.monitor import CellPrediction, WatchedCell
from daq.workflow.validate import DataUse
from daq.writeback.judgement import NO_HISTORY
from daq.writeback.request import GainChange
from drivers.stream.monitor import AxisReading, CellReading, ReadingSource
from ident.calibration import Gain
from ident.data.conditioning import Conditioning
from ident.data.torque_channel import TorqueSlope
from ident.discovery.loop import Step
from ident.estimators.comparison import ESTIMATORS, EstimatorComparison, EstimatorTrial
from ident.estimators.estimate import RelativeError
from ident.physical.full_set import FullParameter, FullSet, GainWithPrior
from tests.daq.calibrations import demo_calibration
from tests.daq.histories import fill, ledger_in

AXIS_COUNT = 14
AXES = tuple(f"gantry-axis-number-{number + 1}" for number in range(AXIS_COUNT))


def _gain_of(number: int) -> Gain:
    value = -1234.5 - number
    std = 0.0123 + 0.001 * number
    nameplate = -1200.25 - number
    return Gain(AXES[number], value, std, "Nm/A", nameplate)


GAINS = tuple(_gain_of(number) for number in range(AXIS_COUNT))
ERRORS_PERCENT = tuple(10.25 + number for number in range(AXIS_COUNT))
ERROR = RelativeError(ERRORS_PERCENT, 12.34)
CALIBRATION = replace(demo_calibration(), gains=GAINS, relative_error_percent=ERROR)


@pytest.fixture(scope="module")
def long_named_cell(cell: Cell) -> Cell:
    """The demo cell, with long names."""
    axes = []
    for axis, name in zip(cell.axes, AXES, strict=False):
        axes.append(replace(axis, name=name))
    return replace(cell, axes=tuple(axes))


@dataclass(frozen=True)
class KnownHistory:
    """Entries of a history, its series by axis, and what was done with each calibration."""

    entries: tuple[Entry, ...]
    series: tuple[Series, ...]
    actions: dict[str, str]


@pytest.fixture(scope="module")
def known_history(tmp_path_factory: pytest.TempPathFactory) -> KnownHistory:
    """Six weeks in which the gain of the fourth axis drifts."""
    folder = tmp_path_factory.mktemp("tables")
    ledger = ledger_in(folder)

    def drifting(week: int) -> tuple[float, ...]:
        factor = 1.0 + 0.01 * week
        return (1.0, 1.0, 1.0, factor, 1.0, 1.0)

    fill(ledger, 6, drifting)
    entries = read_history(ledger).entries
    action = "applied by a person with quite a long name, rolled back by another"
    actions = {entry.digest: action for entry in entries}
    series = watch(entries, ())
    return KnownHistory(entries, series, actions)


Example = Callable[[Cell, KnownHistory], Iterable[RenderableType]]

EXAMPLES: dict[str, Example] = {}
"""One for each function that makes a table, by file and name."""


def example_of(*names: str) -> Callable[[Example], Example]:
    """Enter an example by the functions of which it makes the tables."""

    def enter(example: Example) -> Example:
        for name in names:
            EXAMPLES[name] = example
        return example

    return enter


# Each example below makes the tables of one view, from the longest values that it may meet.


@example_of("bus_views.scan_table")
def _scan(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    nodes = [_node(number) for number in range(14)]
    yield bus_views.scan_table(nodes)


def _node(number: int) -> ScannedNode:
    bus = number % 2
    node_id = 101 + number
    axis = AXES[number]
    return ScannedNode(
        bus=f"bus-{bus}",
        node_id=node_id,
        axis=axis,
        vendor_id=0xFFFFFFFF,
        product_code=0xFFFFFFFE,
        serial=4294967295,
        device_name="servo amplifier 48 V 12 A, revision 7",
        nmt="PRE-OPERATIONAL",
        state="SWITCH ON DISABLED",
        enabled=True,
        in_fault=True,
        verdict="belongs on right, in fault",
        remarks=[],
    )


@example_of("bus_views.monitor_view", "bus_views.prediction_view")
def _monitor(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    axis = AxisReading(
        position_counts=-123456,
        current_raw=-32768,
        statusword=0x021F,
        nmt=5,
        rate_hz=1000.1,
        lost=12345678,
        delay_s=1.2,
    )
    axes = (axis,) * 6
    frames = ((0,) * 9,)
    reading = CellReading(ReadingSource.ASKED, 0.5, axes, 1000.0, frames, ())
    current = RecentCurrent(-12.345, -11.234, 0.123, 1.234, 0.99, True)
    currents = [current] * 6
    prediction = CellPrediction(payload="disc", remark="", axes=currents)
    positions = [-3.126 - number for number in range(6)]
    ampere_per_unit = 12.345 / 32768
    watched = WatchedCell(
        reading,
        position=positions,
        ampere=[ampere_per_unit] * 6,
        events=(),
        prediction=prediction,
    )
    report = bus_views.monitor_report(cell, watched)
    yield bus_views.monitor_view(report)


@example_of("fit.comparison_tables")
def _comparison(cell: Cell, _: KnownHistory) -> Iterable[RenderableType]:
    values = np.array([gain.value for gain in GAINS])
    std = np.full(len(GAINS), 12.34)
    trials = []
    for name in ESTIMATORS:
        trials.append(EstimatorTrial(name, 40.0, 20.0, values, std, 123.45))
    comparison = EstimatorComparison(tuple(trials))
    return fit.comparison_tables(comparison, AXES)


@example_of("residual.turns_view")
def _turns(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    after: Any = None  # the table needs nothing of it
    effect = SimpleNamespace(name="position-dependent-friction")
    finding: Any = SimpleNamespace(
        effect=effect,
        axis=5,
        probability=0.123,
        folds_better=0.99,
        explained=0.123,
        error_before_percent=123.45,
        error_after_percent=112.34,
        passed=True,
    )
    limits_nm = np.ones(6)
    findings = (finding,) * 6
    step = Step(findings, (), limits_nm, None, after)
    fitted: Any = SimpleNamespace(steps=(step,), cell=cell)
    return residual.turns_view(fitted)


@example_of("validation.validation_view")
def _validation(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    rng = np.random.default_rng(1)
    measured_nm = rng.normal(size=(14, 50))
    predicted_nm = 0.9 * measured_nm
    use = np.ones(measured_nm.shape, dtype=bool)
    log = Path("run.mcap")
    held_out: Any = SimpleNamespace(
        run="a run with a long name, 2026-03-02",
        log=log,
        error=ERROR,
        data_use=DataUse.HOLDOUT,
        same_configuration=True,
        measured_nm=measured_nm,
        predicted_nm=predicted_nm,
        use=use,
    )
    checked = SimpleNamespace(run="run-1", condition=1234.0, left_out="")
    runs = (checked,) * 12
    found: Any = SimpleNamespace(
        validations=(held_out, held_out),
        diagnoses=(),
        runs=runs,
        calibrations=("ml",),
        weighed=(),
    )
    filter_document = Conditioning().document()
    calibration = replace(CALIBRATION, filter=filter_document)
    return validation.validation_view(calibration, found)


@example_of("weighing_views.weighed_view")
def _weighed(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    centre_m = np.full(3, -0.12345)
    centre_std_m = np.full(3, 0.000123)
    inertia_kg_m2 = np.full(6, 0.0123456)
    inertia_std_kg_m2 = np.full(6, 0.00000123)
    values = np.linspace(-0.0123456, 12.3, 10)
    std = np.full(10, 0.00000123)
    identifiable = np.ones(10, dtype=bool)
    body: Any = SimpleNamespace(
        centre_m=(centre_m, centre_std_m),
        inertia_kg_m2=(inertia_kg_m2, inertia_std_kg_m2),
        mass_kg=12.34567,
        mass_std_kg=0.00123,
        mass_reference_std_kg=0.00045,
        complete=True,
        moves=123,
        error=ERROR,
        values=values,
        std=std,
        identifiable=identifiable,
    )
    found: Any = SimpleNamespace(cell=cell, body=body, declared_kg=12.3, bare=(), help=())
    return weighing_views.weighed_view(found)


@example_of("weighing_views.contact_view")
def _contact(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    contact = SimpleNamespace(
        axis=2,
        start_s=12345.67,
        end_s=12346.78,
        peak_nm=-1234.0,
        peak_over_threshold=12.34,
    )
    contacts = (contact,) * 20
    count = len(cell.axes)
    quiet_s = np.full(count, 12345.0)
    ones = np.ones(count)
    samples = np.ones((count, 9))
    band = SimpleNamespace(
        quiet_s=quiet_s,
        threshold=ones,
        alarms_per_hour=0.1,
        correlation_s=ones,
        factor=ones,
        scale=samples,
    )
    band_nm = 1.234e4 * samples
    threshold_nm = 2.345e4 * samples
    torque_nm = 3.456e5 * samples
    use = samples > 0
    time_s = np.arange(9.0)
    found: Any = SimpleNamespace(
        band=band,
        band_nm=band_nm,
        threshold_nm=threshold_nm,
        torque_nm=torque_nm,
        use=use,
        left_out=0,
        from_itself=False,
        contacts=contacts,
        time_s=time_s,
    )
    return weighing_views.contact_view(found, cell)


@example_of("urdf_views.urdf_view")
def _urdf(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    centre_m = (-1.234, 2.345, -3.456)
    body = SimpleNamespace(centre_m=centre_m, mass_kg=123.0)
    update: Any = SimpleNamespace(body=body, damping=1.23e-5, friction=4.56e-5)
    mechanics = SimpleNamespace(joints=(), closures=())
    drive_train = SimpleNamespace(coupled=())
    model = SimpleNamespace(robot=mechanics, drive_train=drive_train, columns=())
    choice: Any = SimpleNamespace(
        model=model,
        exact=True,
        torque_change_percent=ERROR,
        chosen_by=ChosenBy.NEAREST_BODIES,
        assumed=(),
    )
    links = {axis: f"link-of-{axis}" for axis in AXES}
    updated: Any = SimpleNamespace(links=links, merged=())
    updates = dict.fromkeys(AXES, update)
    return urdf_views.urdf_view(CALIBRATION, choice, updates, updated, None)


@example_of("mjcf_views.mjcf_view")
def _mjcf(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    joints = [_mjcf_joint(axis) for axis in AXES]
    actuators = [_mjcf_actuator(gain) for gain in GAINS]
    left_out = SimpleNamespace(name="off12", value=-1.234e-5, unit="Nm")
    parameters = [SimpleNamespace(name="Ixx12", basis="prior")]
    shape_left_out = "visual of link1: no file 'arm.stl' next to or above the URDF"
    report: Any = SimpleNamespace(
        joints=joints,
        actuators=actuators,
        torque_change_percent=ERROR,
        exact=False,
        parameters=parameters,
        chosen_by="bodies nearest to the URDF",
        assumed_links=[],
        not_in_mjcf=[left_out],
        shapes_left_out=[shape_left_out],
        effects_left_out=[],
        mountings_left_out=[],
        closures_left_out=[],
        same_configuration=True,
    )
    return mjcf_views.mjcf_view(report)


def _mjcf_joint(axis: str) -> SimpleNamespace:
    centre_m = (-1.2345, 2.3456, -3.4567)
    return SimpleNamespace(
        name=axis,
        mass_kg=123.456,
        centre_m=centre_m,
        armature=1.23e-5,
        damping=4.56e-5,
        friction=1234.5,
    )


def _mjcf_actuator(gain: Gain) -> SimpleNamespace:
    tendon = f"tendon {gain.axis}"
    return SimpleNamespace(axis=gain.axis, acts_on=tendon, gear=gain.value, unit="Nm/A")


@example_of("full_parameters.full_parameter_table", "full_parameters.gains_with_prior_table")
def _full(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    of_prior = FullParameter("Ixx12", -1.2345e-17, 1.2e-5, "kg m²", "prior", 1.0, 123.45, 1.2e-5)
    of_data = FullParameter("fvm12", 1.234e-5, 1.2e-6, "Nm/(rad/s)", "data", 0.0, None, None)
    parameters = (of_prior, of_data)
    with_prior = []
    for gain in GAINS:
        with_prior.append(GainWithPrior(gain.axis, gain.value, gain.std))
    sha256 = "a" * 64
    full = FullSet(
        "arm.urdf", sha256, 0.1, parameters, tuple(with_prior), True, 1.0, 1, 1.0, 0.1, ()
    )
    return full_parameters.full_parameter_view(CALIBRATION, full)


@example_of("fleet.fleet_view")
def _fleet(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    sha256 = "c" * 64
    effects = (("load-friction", AXES[3]),)
    summary = Summary(GAINS, effects, 3.21, held_out=False, partial=True)
    failure = Failure("DataUnfit", "run-17.mcap lost 1234 samples", 4)
    fitted = FleetRow("press-4-in-hall-12-line-7", sha256, (), (), summary, 1234.56)
    failed = FleetRow("gantry-23", sha256, (), (), failure, 1234.56)
    return fleet_view([fitted, failed])


@example_of("proposal.change_table")
def _changes(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    changes = []
    for number, gain in enumerate(GAINS):
        change = GainChange(
            gain.axis,
            "drives.gain",
            number,
            gain.nameplate,
            gain.value,
            gain.std,
            gain.unit,
            gain.nameplate,
            "1",
        )
        changes.append(change)
    yield proposal.change_table(tuple(changes), NO_HISTORY)


@example_of("paper_tables.view")
def _paper(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    headings = ("parameter", *["10 CAD: value"] * 6)
    row = ("zz1", *["1.2345678"] * 6)
    table = paper_tables.PaperTable("Table 1", headings, (row,))
    return table.view()


@example_of("fit.error_table")
def _error(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    yield fit.error_table("Error", AXES, {"held out, before": ERROR})


@example_of("gains.gain_table")
def _gain(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    truth = dict.fromkeys(AXES, -1230.5)
    yield gains.gain_table(GAINS, truth, title="Gains")


@example_of("gains.torque_table")
def _torque(cell: Cell, _: KnownHistory) -> Iterator[RenderableType]:
    slope = TorqueSlope(-1250.0, 0.0123, 98765)
    slopes = [slope] * len(GAINS)
    yield gains.torque_table(slopes, GAINS)


@example_of("history.axis_table")
def _history_of_axis(cell: Cell, known: KnownHistory) -> Iterator[RenderableType]:
    yield history.axis_table(known.series[3], known.actions)


@example_of("history.calibration_table")
def _history_of_calibrations(cell: Cell, known: KnownHistory) -> Iterator[RenderableType]:
    yield history.calibration_table(known.entries, known.series, known.actions)


@example_of("history.history_gain_table")
def _history_of_gains(cell: Cell, known: KnownHistory) -> Iterator[RenderableType]:
    yield history.history_gain_table(known.series)


def _called_names(tree: ast.AST) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name)):
                names.add(name)
    return names


@pytest.mark.slow
def test_every_function_that_makes_a_table_has_an_example(checkout: Path) -> None:
    makes_table = {"plain_table", "WholeTable"}
    makers = set()
    others = set()
    for path in (checkout / "daq").rglob("*.py"):
        if path == checkout / "daq/report/text.py":
            continue
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        for function in ast.walk(tree):
            if not isinstance(function, ast.FunctionDef):
                continue
            called = _called_names(function)
            if makes_table & called:
                makers.add(f"{path.stem}.{function.name}")
        imports_table = "rich.table" in source
        if imports_table and "Table" in _called_names(tree):
            others.add(path.name)
    assert makers == EXAMPLES.keys()
    assert others == set(), "use plain_table of daq/report/text.py, whose tables never cut a value"


def _tables(parts: Iterable[RenderableType]) -> Iterator[Table]:
    for part in parts:
        if isinstance(part, Group):
            yield from _tables(part.renderables)
        elif isinstance(part, Table):
            yield part


def _numbers(table: Table) -> list[str]:
    """Words of a table that have a digit in them."""
    numbers: list[str] = []
    for column in table.columns:
        for value in (column.header, *column.cells):
            for word in str(value).split():
                if re.search(r"\d", word):
                    numbers.append(word)
    return numbers


def _printed(table: Table, width: int, **settings: Any) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, soft_wrap=True, **settings)
    console.print(table)
    return out.getvalue()


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_number_of_a_table_is_whole_at_80_columns_and_in_a_pipe(
    name: str, long_named_cell: Cell, known_history: KnownHistory
) -> None:
    parts = EXAMPLES[name](long_named_cell, known_history)
    tables = list(_tables(parts))
    assert tables
    for table in tables:
        assert isinstance(table, WholeTable)
        numbers = _numbers(table)
        for width in (80, PIPE_COLUMNS):
            is_terminal = width == 80
            shown = _printed(
                table, width, force_terminal=is_terminal, color_system=None, highlight=False
            )
            assert "…" not in shown
            cut = [number for number in numbers if number not in shown]
            assert cut == []
            for line in shown.splitlines():
                printed = line.rstrip()
                assert cell_len(printed) <= width


def test_a_row_keeps_its_style_in_every_form() -> None:
    bold_red = "\x1b[1;31m"
    for width in (20, 40, 80):
        table = WholeTable()
        for heading in ("axis", "state", "another"):
            table.add_column(heading, no_wrap=True)
        state = "x" * 15
        another = "y" * 15
        table.add_row("J1", state, another, style="bold red")
        shown = _printed(table, width, force_terminal=True, color_system="standard")
        assert shown.count(bold_red) >= 2


def test_an_error_of_a_fleet_is_below_its_table() -> None:
    text = "run-17.mcap: " + "found words of a long error; " * 10
    failure = Failure("DataUnfit", text, 4)
    sha256 = "c" * 64
    failed = FleetRow("press-4", sha256, (), (), failure, 1.0)

    table, *below = fleet_view([failed])

    assert isinstance(table, WholeTable)
    for column in table.columns:
        for value in column.cells:
            assert len(str(value)) < 40
    lines = [str(line) for line in below]
    assert f"press-4: DataUnfit: {text}" in lines


def _lines_of_log(described: dict[str, Any]) -> list[str]:
    lines = log_lines(described, 80)
    return [str(line) for line in lines]


def test_numbers_of_a_log_have_no_exponent_and_none_that_a_person_has_no_use_for() -> None:
    described = {
        "stamped_duration_s": 1234567.8,
        "rate_hz": 1000.0,
        "wall_minus_monotonic_s": 1.79565e9,
        "left": 1e-7,
    }
    lines = _lines_of_log(described)
    assert lines == [
        "stamped duration s  1234568",
        "rate hz             1000",
        "left                1e-07",
    ]


def test_a_log_is_described_in_whole_words() -> None:
    digest = "0123456789abcdef" * 4
    missing = {}
    for number in range(40):
        axis = f"J{number}"
        missing[axis] = 100 + number
    described = {"sha256": digest, "stamped_duration_s": 12345.678, "missing": missing}
    lines = _lines_of_log(described)
    for line in lines:
        assert cell_len(line) <= 80
    assert f"  {digest}" in lines
    text = "\n".join(lines)
    words = " ".join(text.split())
    for axis, count in missing.items():
        assert f"{axis} {count}" in words
