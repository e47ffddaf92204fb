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
from drivers.simulation.spec import Dialect, UndeclaredEffect
from ident.data.run import Run
from tests.daq.config.data_sheet import data_sheet, disagreements

FOLDER = shipped_configurations() / "drives"
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))
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
    path = shared_data / "eds" / name
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


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_profile_is_whole_and_every_fact_has_a_source(name: str) -> None:
    profile = profile_of(name)
    assert profile.name == name
    slow = {name for name in ("torque", "temperature") if getattr(profile, name) is not None}
    expected = slow | {
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
    assert {fact.about for fact in profile.facts} == expected  # fmt: skip
    assert profile.save_semantics
    # A fact with a data sheet as its basis is one that the tests below look up.
    assert (name in SHEETS) is any(fact.basis is FactBasis.EDS for fact in profile.facts)


@pytest.mark.parametrize("name", NAMES)
def test_the_page_of_the_drives_names_every_profile(name: str, checkout: Path) -> None:
    profile = profile_of(name)
    page = (checkout / "docs/reference/drive-profiles.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if f"`{name}`" in line)
    for reported in (
        str(profile.current),
        profile.amplitude.value,
        profile.current_scale.form.value,
    ):
        assert reported in row
    assert ("ACTUAL" in row) is (profile.tap is TapPoint.ACTUAL)


EXPECTED = {
    "generic-cia402": (2000, 1e-6 * 2000),
    "elmo-gold": (2000, 1e-6 * 2000),
    "nanotec": (2000, 1e-6 * 2000),
    "schunk-pilz-prbt": (2000, 1e-6 * 2000),
    "maxon-epos4": (None, 1e-3),
    "copley": (None, 1e-2),
    "technosoft-ipos": (None, 2 * PEAK_A / 65520),
    "beckhoff-ax2000": (8000, 8.0 / 3280),
}
"""Value of the scale's object (2 A rated, 8 A peak), and the ampere of a raw unit."""


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_a_raw_unit_is_so_many_ampere(name: str) -> None:
    value, ampere = EXPECTED[name]
    scale = profile_of(name).current_scale
    assert len(scale.objects) == (value is not None)
    found = scale.ampere_per_unit(() if value is None else (value,))
    assert found == pytest.approx(ampere, rel=1e-12)


def test_the_terminal_of_2002h_54_divides_by_root_two() -> None:
    scale = profile_of("beckhoff-el72x1").current_scale
    assert str(scale.switch) == "2002h:54"
    expected = 0.002 / math.sqrt(2)
    assert scale.ampere_per_unit((2000,), 0) == pytest.approx(expected)
    assert scale.ampere_per_unit((2000,), 1) == pytest.approx(0.002)


def test_profiles_without_reference_are_those_of_the_notes() -> None:
    without = {name for name in NAMES if profile_of(name).tap is TapPoint.ACTUAL}
    assert without == {"schunk-pilz-prbt", "technosoft-ipos", "beckhoff-el72x1"}


# -- strictness
# ------------------------------------------------------------------------------------------------


def test_a_peak_current_that_no_one_entered_is_named_with_its_line() -> None:
    text = (FOLDER / "technosoft-ipos.yaml").read_bytes()
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"ipos\.yaml:9: "
        r"current_scale\.peak_current_a: "
        r".*data sheet",
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


@given(
    st.sampled_from(tuple(ScaleForm)),
    st.sets(st.sampled_from(sorted(frozenset().union(*SCALE_KEYS.values())))),
)
@settings(deadline=None)
def test_a_form_takes_its_own_keys_and_no_other(form: ScaleForm, keys: set[str]) -> None:
    entry = "{index: 0x6075, type: u32}"
    values = {"factor": "1.0e-6", "objects": f"[{entry}]", "ampere_per_unit": "0.01", "digits": "3280",  # noqa: E501
              "peak_current_a": "8.0"}  # fmt: skip
    scale = "".join(f"  {key}: {values.get(key, entry)}\n" for key in sorted(keys))
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
    wanted = SCALE_KEYS[form]
    if keys == wanted or (form is ScaleForm.PRODUCT and keys == {"factor"}):
        drive = drive_from_text(text.encode(), "x")
        assert drive.current_scale.form is form
    else:
        with pytest.raises(SchemaMismatch, match="current_scale"):
            drive_from_text(text.encode(), "x")


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
    expected = (now.factor, now.objects)
    assert (scale.factor, scale.objects) == expected


def test_a_profile_may_name_the_data_sheet_beside_it_and_no_other_place() -> None:
    text = text_of("maxon-epos4")
    drive = drive_from_text(f"{text}eds: epos4.eds\n".encode(), "x")
    assert drive.name == "maxon-epos4"
    with pytest.raises(SchemaMismatch, match="eds"):
        drive_from_text(f"{text}eds: ../../secret\n".encode(), "x")


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
    [("maxon_epos4.eds", "6074h:00"), ("Schunk_0_63_cob.dcf", "6074h:00"), ("pilz_prbt_0_1.dcf", "6074h:00"),  # noqa: E501
     ("ros2_canopen_cia402_slave.eds", "6074h:00")],
)  # fmt: skip
def test_the_standard_profile_does_not_fit_these_drives(
    file: str, missing: str, shared_data: Path
) -> None:
    found = disagreements(profile_of("generic-cia402"), sheet(shared_data, file))
    assert any(line.startswith(f"{missing}: no such object") for line in found)


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
    assert disagreements(changed_profile, read)[:4] == (
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
    with contextlib.suppress(ValueError):
        assert data_sheet(text[:where] + damage + text[where + len(damage) :], "x")


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
STEP_A = {
    Dialect.EPOS4: (0.001,) * 6,
    Dialect.COPLEY: (0.01,) * 6,
    Dialect.IPOS: tuple(2 * peak / 65520 for peak in (8, 8, 8, 6, 6, 6)),
    Dialect.AX2000: tuple(peak / 3280 for peak in (8, 8, 8, 6, 6, 6)),
    Dialect.CIA402: tuple(rated / 1000 for rated in (2, 2, 2, 1.5, 1.5, 1.5)),
}
"""Ampere per unit of the demo cell: 2 and 1.5 A rated, 8 and 6 A peak."""
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


def recorded(
    checkout: Path, folder: Path, patch: pytest.MonkeyPatch, dialect: Dialect, plan: str = PLAN
) -> RecordedRun:
    """A short run of the demo cell, its amplifiers being of another make."""
    make = MAKES[dialect]
    drives = folder / "drives"
    drives.mkdir()
    text = (
        (checkout / "configs/cells/demo.yaml")
        .read_text()
        .replace("../robots", str(checkout / "configs/robots"))
    )
    changed_text = text.replace("period_us: 1000", "period_us: 2000")
    text = changed_text.replace("channel: demo", f"channel: {folder.name}")
    for peak_a in (8, 6):
        # The simulated amplifier reports the temperature of its motor.
        found = "{index: 0x22A3, subindex: 1, type: u16, kelvin_per_unit: 1.0}"
        text_of_make = text_of(make, peak_a).replace(
            found, "{index: 0x2005, type: i16, kelvin_per_unit: 0.1}"
        )
        (drives / f"{make}-{peak_a}.yaml").write_text(text_of_make)
    # Two sizes of amplifier, as a person would enter them for a make that does not report its peak
    # current.
    first = text[: text.index("- name: J4")]
    second = text[text.index("- name: J4") :]
    cell_file = folder / "cell.yaml"
    cell_file.write_text(
        first.replace("drive: generic-cia402", f"drive: {make}-8")
        + second.replace("drive: generic-cia402", f"drive: {make}-6")
    )
    (folder / "plan.yaml").write_text(plan)
    cell = load_cell(cell_file)
    spec = load_simulation(checkout / "configs/simulation/clean.yaml")
    axes = tuple(replace(axis, dialect=dialect, entered_torque_nm=ENTERED_NM) for axis in spec.axes)
    spec = replace(spec, sync_period_us=2000, axes=axes, effects=(WARMING,))
    seen: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    report = AmplifierSet.report

    def witnessed(self: AmplifierSet) -> None:
        report(self)
        current_a = np.array(self.loops["current_a"])
        seen.append((self.reported_a.copy(), current_a))

    patch.setattr(AmplifierSet, "report", witnessed)
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            plan_path = folder / "plan.yaml"
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
    columns = zip(*seen, strict=True)
    return RecordedRun(cell_file, cell, done.path, run, *(np.array(column) for column in columns))


@pytest.mark.slow
def test_torque_and_temperature_are_read_beside_the_samples(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = recorded(checkout, tmp_path, monkeypatch, Dialect.CIA402, LONGER)
    assert made.run.valid is not None
    assert made.run.valid.all()
    for axis, channel in enumerate(made.run.torque_channels):
        # 6077h is in thousandths of the entered torque at the rated current.
        expected = made.cell.ratio[axis, axis] * ENTERED_NM / (STEP_A[Dialect.CIA402][axis] * 1000)
        assert len(channel.time_s) >= 10
        slope = channel.torque_nm @ channel.nearby_a / (channel.current_a @ channel.nearby_a)
        assert slope == pytest.approx(expected, rel=0.05)
    assert made.run.temperature_c is not None
    warmth = made.run.temperature_c[[0, -1]]
    assert warmth[0] == pytest.approx(25.0, abs=0.1)
    assert warmth[1, 1] > 27.0
    assert warmth[1, [0, 2, 3, 4, 5]] == pytest.approx(25.0)


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
    step_a = np.array(STEP_A[dialect])
    half_step = 0.5001 * step_a
    # The arm moves: a dead channel would pass every bound
    largest_absolute_measured = np.abs(measured).max(axis=0)
    assert largest_absolute_measured.min() > 0.2
    starts = range(len(truth) - len(measured) + 1)
    fits = [
        k for k in starts if (np.abs(truth[k : k + len(measured)] - measured) <= half_step).all()
    ]
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
    assert (drive["tap"], drive["signal"]) == ("actual", "ACTUAL current 6077h:00")
    gain_units = [axis.gain_unit for axis in reported.cell.axes]
    assert gain_units == ["Nm/A(actual)"] * 6
    expected = dict.fromkeys(
        reported.cell.axis_names, "ACTUAL current 6077h:00, amplitude unstated"
    )
    assert shown == expected
    spec = load_simulation(checkout / "configs/simulation/clean.yaml")
    bus = open_bus(bus_address(reported.cell))
    try:
        axes = tuple(replace(a, dialect=Dialect.IPOS) for a in spec.axes)
        changed_spec = replace(spec, axes=axes)
        with SimulatedCell(changed_spec, bus):
            assert main(["scan", str(reported.cell_file)]) == ExitCode.OK
            assert (
                "J1, J2, J3, J4, J5, J6: ACTUAL current, not the reference"
            ) in capsys.readouterr().out
            assert main(["scan", str(reported.cell_file), "--json"]) == ExitCode.OK
            document = json.loads(capsys.readouterr().out)
            assert document["current"] == shown
    finally:
        bus.shutdown()


def test_a_reference_needs_no_warning(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    assert actual_current_note(cell) is None
    assert set(current_signals(cell).values()) == {"current reference 6074h:00, amplitude rms"}
