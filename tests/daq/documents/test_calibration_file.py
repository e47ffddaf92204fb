"""calibration.yaml: what goes in comes out, and nothing else does."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings

from daq.documents import calibration_file
from daq.documents.calibration_file import (
    as_document,
    decode_calibration,
    encode_calibration,
    load_calibration,
    save_calibration,
)
from daq.errors import (
    CalibrationMissing,
    CalibrationRefused,
    CalibrationUnreadable,
    UsageError,
    exit_code,
)
from ident.calibration import Calibration, PayloadMass
from ident.errors import EffectRefused
from tests.daq.calibrations import calibrations, demo_calibration


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A calibration file as `save` wrote it."""
    path = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), path)
    return path


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(calibrations)
def test_every_calibration_comes_back_as_it_was_written(calibration: Calibration) -> None:
    content = encode_calibration(calibration)
    assert decode_calibration(content, "calibration.yaml") == calibration
    # Whatever the texts in it, libyaml writes the bytes of PyYAML, or leaves it to PyYAML.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration_file, "_QuickDumper", calibration_file._Dumper)
        assert encode_calibration(calibration) == content


def test_libyaml_writes_what_a_fit_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_file, "_Dumper", None)
    content = encode_calibration(demo_calibration())
    assert decode_calibration(content, "calibration.yaml") == demo_calibration()


def test_a_saved_calibration_is_the_only_file_left(path: Path) -> None:
    assert load_calibration(path) == demo_calibration()
    files = list(path.parent.iterdir())
    assert files == [path]


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(calibrations)
def test_the_document_is_json_without_nan(calibration: Calibration) -> None:
    json.dumps(as_document(calibration), allow_nan=False)


FIT_KEYS = {
    "method",
    "gains",
    "parameters",
    "relative_error_percent",
    "condition",
    "rows",
    "filter",
    "effects",
}
GAIN_KEYS = {"axis", "value", "std_percent", "unit", "nameplate", "change_percent"}
PARAMETER_KEYS = {"name", "value", "unit", "std_percent"}


def test_the_document_has_what_fit_json_promises() -> None:
    text = json.dumps(as_document(demo_calibration()))
    document = json.loads(text)
    assert set(document) >= FIT_KEYS
    fourth = document["gains"][3]
    assert set(fourth) >= GAIN_KEYS
    assert fourth["change_percent"] == pytest.approx(100 * (-9.21 / -11.52 - 1))
    assert fourth["std_percent"] == pytest.approx(0.4)
    parameter = document["parameters"][0]
    assert set(parameter) >= PARAMETER_KEYS
    std_percent = document["parameters"][1]["std_percent"]
    assert std_percent is None
    relative_error_percent = set(document["relative_error_percent"])
    assert relative_error_percent == {"axes", "total"}


def test_one_entry_is_on_one_line(path: Path) -> None:
    matches = re.findall(
        r"^- \{axis: J\d, value: .* "
        r"change_percent: \S+\}$",
        path.read_text(),
        re.MULTILINE,
    )
    assert len(matches) == 6


@pytest.mark.parametrize(
    ("old", "new", "section"),
    [
        ("value: 33.9,", "value: 33.8,", "gains"),
        ("method: ml", "method: tls", "method"),
        ("name: unloaded", "name: other", "sources"),
        ("condition: 812.0", "condition: 12.0", "condition"),
    ],
)
def test_an_edit_by_hand_is_noticed_and_named(path: Path, old: str, new: str, section: str) -> None:
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(CalibrationRefused, match=rf"by hand in {section};"):
        load_calibration(path)


def test_a_comment_added_by_hand_is_no_edit(path: Path) -> None:
    path.write_text(path.read_text() + "# checked by K.\n")
    assert load_calibration(path) == demo_calibration()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("method: ml", "methode: ml", "methode"),
        ("method: ml", "method: ml\nmethod: ls", "duplicate"),
        ("rows: 14400", "rows: many", "rows"),
        ("rows: 14400", "rows: 14400.5", "rows"),
        ("condition: 812.0", "condition: .nan", "condition"),
        ("condition: 812.0", "condition: .inf", "condition"),
        ("std: 0.1356", "std: -0.1356", "std"),
        ("version: 1", "version: 2", "version 2"),
        ("format: drivegain-calibration", "format: something", "format"),
        ("- {axis: J1,", "- {axis: J1, colour: red,", "colour"),
        ("cell: demo", "cell: *other", "alias"),
        ("rows: 14400", "rows: [14400", r"calibration\.yaml:\d+"),
    ],
)
def test_what_does_not_belong_is_refused_with_its_place(
    path: Path, old: str, new: str, says: str
) -> None:
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(CalibrationUnreadable, match=says) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"\x00\xff", b"[]", b"gains: 3", b"a: \t- b", b"%PDF-1.4"]
)
def test_another_file_is_refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(CalibrationUnreadable):
        load_calibration(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationMissing, match=r"none\.yaml: found no such file"):
        load_calibration(tmp_path / "none.yaml")


def test_a_truncated_file_is_never_taken_for_a_whole_one(path: Path) -> None:
    content = path.read_bytes()
    for length in range(0, len(content) - 1, 97):
        path.write_bytes(content[:length])
        with pytest.raises((CalibrationUnreadable, CalibrationRefused)):
            load_calibration(path)


def test_a_number_that_is_not_finite_is_not_saved(path: Path) -> None:
    before = path.read_bytes()
    calibration = dataclasses.replace(demo_calibration(), condition=float("nan"))
    with pytest.raises(CalibrationUnreadable, match="condition"):
        save_calibration(calibration, path)
    assert path.read_bytes() == before
    files = list(path.parent.iterdir())
    assert files == [path]


def test_the_exit_codes_distinguish_data_from_refusal() -> None:
    assert exit_code(CalibrationUnreadable) == 4
    assert exit_code(CalibrationMissing) == 4
    assert exit_code(CalibrationRefused) == 3


@pytest.mark.parametrize("call", ["open", "fchmod", "fsync", "replace"])
def test_a_failing_disk_leaves_the_old_calibration(
    path: Path, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def fail(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, fail)
    calibration = dataclasses.replace(demo_calibration(), method="tls")
    with pytest.raises(OSError, match="No space"):
        save_calibration(calibration, path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    files = list(path.parent.iterdir())
    assert files == [path]


@pytest.mark.parametrize(
    ("key", "value"),
    [("mass_kg", 0.0), ("mass_kg", -1.0), ("tolerance_kg", -0.1), ("gains", ())],
)
def test_an_impossible_payload_mass_is_refused(key: str, value: Any) -> None:
    calibration = demo_calibration()
    slopes = [gain.value / 4.59 for gain in calibration.gains]
    disc = PayloadMass.of("disc", 4.59, slopes, calibration.gains)
    changed_dataclasses = dataclasses.replace(calibration, payload_mass=(disc,))
    content = encode_calibration(changed_dataclasses)
    assert decode_calibration(content, "calibration.yaml").payload_mass == (disc,)
    impossible = dataclasses.replace(disc, **{key: value})
    content = encode_calibration(dataclasses.replace(calibration, payload_mass=(impossible,)))
    with pytest.raises(CalibrationUnreadable, match="payload_mass"):
        decode_calibration(content, "calibration.yaml")


@pytest.mark.parametrize("given_as", [None, "spring", 3.0])
def test_own_effects_that_are_no_list_are_refused_before_a_file_is_used(
    path: Path, given_as: Any
) -> None:
    with pytest.raises(UsageError, match=r"own_effects.*found .*; expected "):
        load_calibration(path, own_effects=given_as)


def test_own_effects_that_are_no_effects_are_refused_before_a_file_is_used(path: Path) -> None:
    with pytest.raises(EffectRefused, match=r"^`own_effects`: found .*; expected "):
        load_calibration(path, own_effects=[3.0])  # type: ignore[list-item]
