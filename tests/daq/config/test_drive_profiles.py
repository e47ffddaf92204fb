"""The shipped drive profiles: strict data, in agreement with the makers' data sheets,
and right to the ampere.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from canopen.objectdictionary import ObjectDictionary
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.config.drive import SCALE_KEYS, drive_from_text
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent, ExitCode, SchemaMismatch
from daq.log.conversion import load_run
from daq.log.reader import read_log
from daq.report.bus_views import current_signals
from daq.simulation.simulation_file import load_simulation
from daq.workflow.nameplates import actual_current_note
from daq.workflow.plan import load_plan
from daq.workflow.record import RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.profiles.profile import DriveProfile, FactBasis, ObjectEntry, ScaleForm, TapPoint
from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec, Dialect, UndeclaredEffect
from ident.data.run import Run
from tests.daq.config.data_sheet import data_sheet, disagreements

FOLDER = shipped_configurations() / "drives"
STEMS = [path.stem for path in FOLDER.glob("*.yaml")]
NAMES = tuple(sorted(STEMS))
PEAK_A = 8.0
SHEETS = {
    "maxon-epos4": ("maxon_epos4.eds",),
    "elmo-gold": ("Elmo_cob.dcf", "ElmoSimplIQ_cob.dcf"),
    "schunk-pilz-prbt": ("Schunk_0_63_cob.dcf", "pilz_prbt_0_1.dcf"),
}
"""Data sheets of the makes whose profile says `basis: eds`."""


def text_of(name: str, peak_a: float = PEAK_A) -> str:
    """A shipped profile, with the peak current entered where a person must do so."""
    text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    return text.replace("peak_current_a: null", f"peak_current_a: {peak_a}")


def profile_of(name: str) -> DriveProfile:
    text = text_of(name).encode()
    return drive_from_text(text, f"{name}.yaml")


def sheet(shared_data: Path, name: str) -> ObjectDictionary:
    folder = shared_data / "eds"
    path = folder / name
    if not path.is_file():
        pytest.skip(f"no data sheet at {path}: set DRIVEGAIN_DATA to the folder that holds eds/")
    return data_sheet(path.read_bytes(), name)


# -- the files
# ------------------------------------------------------------------------------------------------


def test_every_make_of_the_issue_has_a_profile() -> None:
    expected = {
        "generic-cia402",
        "maxon-epos4",
        "elmo-gold",
        "nanotec",
        "copley",
        "technosoft-ipos",
        "beckhoff-ax2000",
        "beckhoff-el72x1",
        "schunk-pilz-prbt",
    }
    assert set(NAMES) == expected  # fmt: skip


#: What every profile has a fact about
FACTS = {
    "position",
    "current",
    "current_scale",
    "amplitude",
    "tap",
    "saturation_bit",
    "update_period_us",
    "rated",
    "save",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_profile_is_whole_and_every_fact_has_a_source(name: str) -> None:
    profile = profile_of(name)
    assert profile.name == name
    expected = set(FACTS)
    if profile.torque is not None:
        expected.add("torque")
    if profile.temperature is not None:
        expected.add("temperature")
    facts = {fact.about for fact in profile.facts}
    assert facts == expected
    assert profile.save_semantics
    # A fact with a data sheet as its basis is one that the tests below look up.
    bases = {fact.basis for fact in profile.facts}
    has_data_sheet = name in SHEETS
    assert (FactBasis.EDS in bases) is has_data_sheet


@pytest.mark.parametrize("name", NAMES)
def test_the_page_of_the_drives_names_every_profile(name: str, checkout: Path) -> None:
    profile = profile_of(name)
    path = checkout / "docs/reference/drive-profiles.md"
    page = path.read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if f"`{name}`" in line]
    row = rows[0]
    assert str(profile.current) in row
    assert profile.amplitude.value in row
    assert profile.current_scale.form.value in row
    is_actual = profile.tap is TapPoint.ACTUAL
    assert ("ACTUAL" in row) is is_actual


@dataclass(frozen=True)
class RawUnit:
    """Values of the scale's objects (2 A rated, 8 A peak), and the ampere of a raw unit."""

    scale_values: tuple[int, ...]
    ampere: float


PER_MILLE_OF_RATED = RawUnit((2000,), 1e-6 * 2000)
RAW_UNITS = {
    "generic-cia402": PER_MILLE_OF_RATED,
    "elmo-gold": PER_MILLE_OF_RATED,
    "nanotec": PER_MILLE_OF_RATED,
    "schunk-pilz-prbt": PER_MILLE_OF_RATED,
    "maxon-epos4": RawUnit((), 1e-3),
    "copley": RawUnit((), 1e-2),
    "technosoft-ipos": RawUnit((), 2 * PEAK_A / 65520),
    "beckhoff-ax2000": RawUnit((8000,), 8.0 / 3280),
}


@pytest.mark.parametrize("name", sorted(RAW_UNITS))
def test_a_raw_unit_is_so_many_ampere(name: str) -> None:
    unit = RAW_UNITS[name]
    scale = profile_of(name).current_scale
    assert len(scale.objects) == len(unit.scale_values)
    found = scale.ampere_per_unit(unit.scale_values)
    assert found == pytest.approx(unit.ampere, rel=1e-12)


def test_the_terminal_of_2002h_54_divides_by_root_two() -> None:
    scale = profile_of("beckhoff-el72x1").current_scale
    assert str(scale.switch) == "2002h:54"
    amplitude_unit = scale.ampere_per_unit((2000,), 0)
    assert amplitude_unit == pytest.approx(0.002 / math.sqrt(2))
    rms_unit = scale.ampere_per_unit((2000,), 1)
    assert rms_unit == pytest.approx(0.002)


def test_profiles_without_reference_are_those_of_the_notes() -> None:
    taps = {name: profile_of(name).tap for name in NAMES}
    without = {name for name, tap in taps.items() if tap is TapPoint.ACTUAL}
    assert without == {"schunk-pilz-prbt", "technosoft-ipos", "beckhoff-el72x1"}


# -- strictness
# ------------------------------------------------------------------------------------------------


def test_a_peak_current_that_no_one_entered_is_named_with_its_line() -> None:
    text = (FOLDER / "technosoft-ipos.yaml").read_bytes()
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"ipos\.yaml:9: current_scale\.peak_current_a: .*data sheet",
    ):
        drive_from_text(text, "ipos.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("tap: reference", "tap: reference\ntapp: actual", r"x:\d+: tapp: .*did you mean"),
        (
            "ampere_per_unit: 0.001",
            "ampere_per_unit: 0.001\n  digits: 3",
            r"x:6: current_scale: .*ampere_per_unit",
        ),
        (
            "ampere_per_unit: 0.001",
            "ampere_per_unit: -0.001",
            r"x:8: current_scale\.ampere_per_unit",
        ),
        ("ampere_per_unit: 0.001", "ampere_per_unit: null", r"x:6: current_scale"),
        ("form: fixed-step", "form: n * 0.001", r"x:7: current_scale\.form"),
        (
            "form: fixed-step",
            "form: per-mille-of-rated-current",
            r"x:6: current_scale: "
            r".*rated_current of a scale",
        ),
        ("basis: eds", "basis: hearsay", r"facts\.position\.basis"),
        ("    basis: notes\n", "", r"facts\.current_scale\.basis"),
        ("mapping: stored", "mapping: perhaps", r"save\.mapping"),
    ],
)
def test_what_is_not_a_profile_is_refused_with_its_line(old: str, new: str, message: str) -> None:
    text = text_of("maxon-epos4")
    assert old in text
    changed_content = text.replace(old, new, 1).encode()
    with pytest.raises(SchemaMismatch, match=message):
        drive_from_text(changed_content, "x")


SCALE_KEY_NAMES = sorted(frozenset().union(*SCALE_KEYS.values()))


@given(st.sampled_from(tuple(ScaleForm)), st.sets(st.sampled_from(SCALE_KEY_NAMES)))
@settings(deadline=None)
def test_a_form_takes_its_own_keys_and_no_other(form: ScaleForm, keys: set[str]) -> None:
    entry = "{index: 0x6075, type: u32}"
    values = {
        "factor": "1.0e-6",
        "objects": f"[{entry}]",
        "ampere_per_unit": "0.01",
        "digits": "3280",
        "peak_current_a": "8.0",
    }
    lines = [f"  {key}: {values.get(key, entry)}\n" for key in sorted(keys)]
    scale = "".join(lines)
    text = f"""name: any
position: {{index: 0x6064, type: i32}}
current: {{index: 0x6074, type: i16}}
current_scale:
  form: {form.value}
{scale}amplitude: rms
tap: reference
update_period_us: 1000
save_semantics: none
source: a test
"""
    content = text.encode()
    has_its_keys = keys == SCALE_KEYS[form]
    is_factor_alone = form is ScaleForm.PRODUCT and keys == {"factor"}
    if has_its_keys or is_factor_alone:
        drive = drive_from_text(content, "x")
        assert drive.current_scale.form is form
    else:
        with pytest.raises(SchemaMismatch, match="current_scale"):
            drive_from_text(content, "x")


def test_a_profile_of_the_first_version_is_still_read() -> None:
    """Logs carry their profiles: one from before the forms must keep its meaning."""
    old = b"""name: generic-cia402
position: {index: 0x6064, subindex: 0, type: i32}
current: {index: 0x6074, subindex: 0, type: i16}
current_scale:
  factor: 1.0e-6
  objects:
    - {index: 0x6075, subindex: 0, type: u32}
amplitude: rms
tap: reference
saturation_bit: 11
update_period_us: 1000
save_semantics: any
source: any
"""
    scale = drive_from_text(old, "old").current_scale
    now = profile_of("generic-cia402").current_scale
    assert scale.factor == now.factor
    assert scale.objects == now.objects


def test_a_profile_may_name_the_data_sheet_beside_it_and_no_other_place() -> None:
    text = text_of("maxon-epos4")
    beside_it = f"{text}eds: epos4.eds\n"
    drive = drive_from_text(beside_it.encode(), "x")
    assert drive.name == "maxon-epos4"
    elsewhere = f"{text}eds: ../../secret\n"
    with pytest.raises(SchemaMismatch, match="eds"):
        drive_from_text(elsewhere.encode(), "x")


# -- data sheets
# ------------------------------------------------------------------------------------------------


def _sheets() -> Iterator[tuple[str, str]]:
    for name, files in SHEETS.items():
        for file in files:
            yield name, file


@pytest.mark.parametrize(("name", "file"), list(_sheets()))
def test_a_profile_agrees_with_the_makers_data_sheet(
    name: str, file: str, shared_data: Path
) -> None:
    assert disagreements(profile_of(name), sheet(shared_data, file)) == ()


@pytest.mark.parametrize(
    ("file", "missing"),
    [
        ("maxon_epos4.eds", "6074h:00"),
        ("Schunk_0_63_cob.dcf", "6074h:00"),
        ("pilz_prbt_0_1.dcf", "6074h:00"),
        ("ros2_canopen_cia402_slave.eds", "6074h:00"),
    ],
)
def test_the_standard_profile_does_not_fit_these_drives(
    file: str, missing: str, shared_data: Path
) -> None:
    found = disagreements(profile_of("generic-cia402"), sheet(shared_data, file))
    of_object = [line for line in found if line.startswith(f"{missing}: no such object")]
    assert of_object != []


@pytest.mark.parametrize(
    ("name", "file"), [("elmo-gold", "Elmo_cob.dcf"), ("elmo-gold", "ElmoSimplIQ_cob.dcf")]
)
def test_a_wrong_width_or_an_object_that_cannot_be_mapped_is_reported(
    name: str, file: str, shared_data: Path
) -> None:
    reported = sheet(shared_data, file)
    profile = profile_of(name)
    current = replace(profile.current, bits=32)
    wide = replace(profile, current=current)
    assert disagreements(wide, reported) == (
        "6074h:00 (torque_demand): i16 in the data sheet, i32 in the profile",
    )
    first_object = profile.current_scale.objects[0]
    rated = replace(profile, current=first_object)
    assert disagreements(rated, reported) == (
        "6075h:00 (motor_rated_current): not mappable according to the data sheet",
    )


SHEET = """[FileInfo]
Description=a drive
[DeviceInfo]
VendorName=a maker
ProductName=
[6064]
ParameterName=position
ObjectType=0x7
DataType=0x0004
AccessType=ro
DefaultValue=
PDOMapping=1
[1008]
ParameterName=name
DataType=0x9
AccessType=const
[1018]
SubNumber=2
ParameterName=identity
ObjectType=0x9
[1018sub1]
ParameterName=vendor
DataType=0x7
AccessType=wo
PDOMapping=
"""


def test_a_data_sheet_is_read_with_its_empty_fields() -> None:
    read = data_sheet(SHEET.encode(), "x")
    assert set(read) == {0x6064, 0x1008, 0x1018}
    agreed = profile_of("elmo-gold")
    current_scale = replace(agreed.current_scale, objects=())
    profile = replace(agreed, current=agreed.position, current_scale=current_scale)
    profile = replace(profile, rated=None, torque=None, save=None)
    # All that the sheet lacks is what every recording needs.
    needed = (
        "6041h:00",
        "6040h:00",
        "607Ah:00",
        "6081h:00",
        "6083h:00",
        "6060h:00",
        "6061h:00",
        "1017h:00",
    )
    absent = (
        *(f"{entry}: no such object" for entry in needed),
        "found 0 TPDOs in the drive; expected 2",
    )
    assert disagreements(profile, read) == absent
    name = ObjectEntry(0x1008, 0, 32, signed=False)
    vendor = ObjectEntry(0x1018, 1, 32, signed=False)
    changed_profile = replace(profile, position=name, current=vendor)
    found = disagreements(changed_profile, read)
    assert found[:4] == (
        "1008h:00 (name): no integer in the data sheet, u32 in the profile",
        "1008h:00 (name): not mappable according to the data sheet",
        "1018h:01 (vendor): not readable according to the data sheet",
        "1018h:01 (vendor): not mappable according to the data sheet",
    )


@pytest.mark.parametrize("text", [b"", b"hello", b"[6064]\nDataType=seven\n", b"\xff\xfe"])
def test_what_is_no_data_sheet_is_named(text: bytes) -> None:
    with pytest.raises(ValueError, match=r"x: found .*data sheet"):
        data_sheet(text, "x")


@given(st.integers(0, len(SHEET) - 1), st.binary(max_size=12))
@settings(deadline=None)
def test_a_damaged_data_sheet_is_read_or_named(where: int, damage: bytes) -> None:
    text = SHEET.encode()
    behind = where + len(damage)
    damaged = text[:where] + damage + text[behind:]
    with contextlib.suppress(ValueError):
        assert data_sheet(damaged, "x")


# -- to the ampere
# ------------------------------------------------------------------------------------------------

PLAN = """format: drivegain-plan
cell: demo
seed: 1
condition: 100.0
moves:
  - {target_deg: [8, -6, 82, 10, -6, 12], velocity: 0.5, acceleration: 0.5, dwell_s: 0.02}
"""
LONGER = (
    PLAN
    + """  - {target_deg: [-40, 20, 40, -30, 30, -40], velocity: 0.5, acceleration: 0.5, dwell_s: 0.2}
  - {target_deg: [30, -40, 80, 30, -30, 30], velocity: 0.5, acceleration: 0.5, dwell_s: 0.2}
"""  # noqa: E501
)
PEAKS_A = (8, 8, 8, 6, 6, 6)
RATED_A = (2, 2, 2, 1.5, 1.5, 1.5)
STEP_A = {
    Dialect.EPOS4: (0.001,) * 6,
    Dialect.COPLEY: (0.01,) * 6,
    Dialect.IPOS: tuple(2 * peak_a / 65520 for peak_a in PEAKS_A),
    Dialect.AX2000: tuple(peak_a / 3280 for peak_a in PEAKS_A),
    Dialect.CIA402: tuple(rated_a / 1000 for rated_a in RATED_A),
}
"""Ampere per unit of the demo cell."""
MAKES = {
    Dialect.EPOS4: "maxon-epos4",
    Dialect.COPLEY: "copley",
    Dialect.IPOS: "technosoft-ipos",
    Dialect.AX2000: "beckhoff-ax2000",
    Dialect.CIA402: "elmo-gold",
}


ENTERED_NM = 0.8  # within a factor of three of every motor's
HEATED = {"time_constant_s": 2.0, "resistance_k_per_w": 5.0}
WARMING = UndeclaredEffect(
    "temperature-friction",
    1,
    {"viscous_percent_per_k": -1.0, "coulomb_percent_per_k": 0.0, **HEATED},
)


@dataclass(frozen=True)
class RecordedRun:
    """A run, and the true currents of every SYNC [A]."""

    cell_file: Path
    cell: Cell
    log: Path
    run: Run
    reference_a: NDArray[np.float64]
    actual_a: NDArray[np.float64]


def _write_profiles(folder: Path, make: str) -> None:
    """Write the profiles of two sizes of amplifier of a make, as a person would enter them where
    the make does not report its peak current.
    """
    folder.mkdir()
    # The simulated amplifier reports the temperature of its motor.
    of_make = "{index: 0x22A3, subindex: 1, type: u16, kelvin_per_unit: 1.0}"
    simulated = "{index: 0x2005, type: i16, kelvin_per_unit: 0.1}"
    for peak_a in (8, 6):
        text = text_of(make, peak_a).replace(of_make, simulated)
        path = folder / f"{make}-{peak_a}.yaml"
        path.write_text(text)


def _write_cell(checkout: Path, folder: Path, make: str) -> Path:
    """Write the demo cell with large amplifiers of a make at J1 to J3, and small ones behind."""
    demo = checkout / "configs/cells/demo.yaml"
    robots = str(checkout / "configs/robots")
    text = demo.read_text().replace("../robots", robots)
    text = text.replace("period_us: 1000", "period_us: 2000")
    text = text.replace("channel: demo", f"channel: {folder.name}")
    fourth = text.index("- name: J4")
    large = text[:fourth].replace("drive: generic-cia402", f"drive: {make}-8")
    small = text[fourth:].replace("drive: generic-cia402", f"drive: {make}-6")
    cell_file = folder / "cell.yaml"
    cell_file.write_text(large + small)
    return cell_file


def _simulation(checkout: Path, dialect: Dialect) -> CellSpec:
    """Simulation of the demo cell with amplifiers of a make, one of which warms up."""
    spec = load_simulation(checkout / "configs/simulation/clean.yaml")
    axes = [replace(axis, dialect=dialect, entered_torque_nm=ENTERED_NM) for axis in spec.axes]
    return replace(spec, sync_period_us=2000, axes=tuple(axes), effects=(WARMING,))


def recorded(
    checkout: Path, folder: Path, patch: pytest.MonkeyPatch, dialect: Dialect, plan: str = PLAN
) -> RecordedRun:
    """A short run of the demo cell, its amplifiers being of another make."""
    make = MAKES[dialect]
    _write_profiles(folder / "drives", make)
    cell_file = _write_cell(checkout, folder, make)
    cell = load_cell(cell_file)
    plan_path = folder / "plan.yaml"
    plan_path.write_text(plan)
    spec = _simulation(checkout, dialect)
    references_a: list[NDArray[np.float64]] = []
    actuals_a: list[NDArray[np.float64]] = []
    report = AmplifierSet.report

    def witnessed(self: AmplifierSet) -> None:
        report(self)
        reference_a = self.reported_a.copy()
        actual_a = np.array(self.loops["current_a"])
        references_a.append(reference_a)
        actuals_a.append(actual_a)

    patch.setattr(AmplifierSet, "report", witnessed)
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            moves = load_plan(plan_path, cell)
            out = folder / "a.mcap"
            request = RecordingRequest(
                cell_file,
                cell,
                moves,
                out,
                payload=None,
                operator="Ada",
                granted_by="test",
                run_id="1",
            )
            done = record(request)
    finally:
        bus.shutdown()
    assert done.log.valid, done.log.reason
    run, _ = load_run(done.path)
    return RecordedRun(
        cell_file,
        cell,
        log=done.path,
        run=run,
        reference_a=np.array(references_a),
        actual_a=np.array(actuals_a),
    )


@pytest.mark.slow
def test_torque_and_temperature_are_read_beside_the_samples(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = recorded(checkout, tmp_path, monkeypatch, Dialect.CIA402, LONGER)
    assert made.run.valid is not None
    assert made.run.valid.all()
    rated_a = 1000 * np.array(STEP_A[Dialect.CIA402])
    for axis, channel in enumerate(made.run.torque_channels):
        # 6077h is in thousandths of the entered torque at the rated current.
        ratio = made.cell.ratio[axis, axis]
        expected = ratio * ENTERED_NM / rated_a[axis]
        assert len(channel.time_s) >= 10
        torque_product = channel.torque_nm @ channel.nearby_a
        current_product = channel.current_a @ channel.nearby_a
        slope = torque_product / current_product
        assert slope == pytest.approx(expected, rel=0.05)
    assert made.run.temperature_c is not None
    first_c = made.run.temperature_c[0]
    last_c = made.run.temperature_c[-1]
    assert first_c == pytest.approx(25.0, abs=0.1)
    assert last_c[1] > 27.0
    others_c = np.delete(last_c, 1)
    assert others_c == pytest.approx(25.0)


@pytest.mark.slow
@pytest.mark.parametrize("dialect", list(Dialect))
def test_a_run_is_in_ampere_whatever_the_drive_counts_in(
    dialect: Dialect, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported = recorded(checkout, tmp_path, monkeypatch, dialect)
    profile = reported.cell.axes[0].profile
    assert profile is not None
    if profile.tap is TapPoint.ACTUAL:
        truth = reported.actual_a
    else:
        truth = reported.reference_a
    measured = reported.run.current_a
    half_step = 0.5001 * np.array(STEP_A[dialect])
    # The arm moves: a dead channel would pass every bound
    largest_absolute_measured = np.abs(measured).max(axis=0)
    assert largest_absolute_measured.min() > 0.2
    fits = []
    for start in range(len(truth) - len(measured) + 1):
        end = start + len(measured)
        error_a = np.abs(truth[start:end] - measured)
        if np.all(error_a <= half_step):
            fits.append(start)
    assert len(fits) == 1


@pytest.mark.slow
def test_an_actual_current_is_said_to_be_one(
    checkout: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    reported = recorded(checkout, tmp_path, monkeypatch, Dialect.IPOS)
    capsys.readouterr()
    assert main(["info", str(reported.log), "--json"]) == ExitCode.OK
    printed = capsys.readouterr().out
    shown = json.loads(printed)["current"]
    readback = read_log(reported.log).head.readback
    drive = readback.axes[0].drive
    assert drive["tap"] == "actual"
    assert drive["signal"] == "ACTUAL current 6077h:00"
    gain_units = [axis.gain_unit for axis in reported.cell.axes]
    assert gain_units == ["Nm/A(actual)"] * 6
    expected = dict.fromkeys(
        reported.cell.axis_names, "ACTUAL current 6077h:00, amplitude unstated"
    )
    assert shown == expected
    spec = load_simulation(checkout / "configs/simulation/clean.yaml")
    bus = open_bus(bus_address(reported.cell))
    try:
        axes = [replace(axis, dialect=Dialect.IPOS) for axis in spec.axes]
        of_ipos = replace(spec, axes=tuple(axes))
        with SimulatedCell(of_ipos, bus):
            assert main(["scan", str(reported.cell_file)]) == ExitCode.OK
            printed = capsys.readouterr().out
            assert "J1, J2, J3, J4, J5, J6: ACTUAL current, not the reference" in printed
            assert main(["scan", str(reported.cell_file), "--json"]) == ExitCode.OK
            printed = capsys.readouterr().out
            document = json.loads(printed)
            assert document["current"] == shown
    finally:
        bus.shutdown()


def test_a_reference_needs_no_warning(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    assert actual_current_note(cell) is None
    signals = set(current_signals(cell).values())
    assert signals == {"current reference 6074h:00, amplitude rms"}
