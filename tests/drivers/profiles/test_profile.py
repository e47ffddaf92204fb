"""Scales, identities and numbers of a drive profile, by the texts of CiA 301 and CiA 402."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest

from drivers.profiles.profile import (
    CIA402,
    Amplitude,
    CurrentScale,
    DriveParameter,
    Identity,
    ObjectEntry,
    ParameterKind,
    RatedMotor,
    ScaleForm,
    TapPoint,
)


def test_an_object_is_written_in_the_way_of_cia_301() -> None:
    assert str(ObjectEntry(0x2002, 0x1F, 16)) == "2002h:1F"
    assert str(DriveParameter(0x60, 1, ParameterKind.U16)) == "0060h:01"


def test_a_product_scale_is_the_factor_times_all_objects() -> None:
    entries = (ObjectEntry(0x6075, 0, 32), ObjectEntry(0x2000, 1, 32))
    # 1e-6 A times 2000 mA times 3.
    found = CurrentScale(1e-6, entries).ampere_per_unit((2000, 3))
    assert found == pytest.approx(6e-3)


def test_a_switch_of_the_scale_chooses_its_weight() -> None:
    weights = (1.0, 1.0 / math.sqrt(2.0))
    objects = (ObjectEntry(0x6075, 0, 32),)
    switch = ObjectEntry(0x2002, 0x54, 16)
    scale = CurrentScale(
        1e-6,
        objects,
        ScaleForm.SWITCHED_PER_MILLE,
        switch,
        weights,
    )
    assert scale.ampere_per_unit((2000,)) == pytest.approx(2e-3)
    expected = 2e-3 / math.sqrt(2.0)
    assert scale.ampere_per_unit((2000,), 1) == pytest.approx(expected)


@pytest.mark.parametrize("choice", [-1, 1, 2])
def test_an_unknown_value_of_the_switch_has_no_scale(choice: int) -> None:
    with pytest.raises(IndexError):
        CurrentScale(1e-6, ()).ampere_per_unit((), choice)


def test_the_standards_drive_has_the_objects_of_cia_402() -> None:
    expected = ObjectEntry(0x6064, 0, 32, signed=True)
    assert CIA402.position == expected
    assert CIA402.current == ObjectEntry(0x6074, 0, 16, signed=True)
    assert CIA402.current_scale.objects == (ObjectEntry(0x6075, 0, 32),)
    # 6074h is per mille of the rated current, and 6075h is in mA.
    assert CIA402.current_scale.ampere_per_unit((5000,)) == pytest.approx(5.0 / 1000.0)
    assert CIA402.amplitude is Amplitude.RMS
    assert CIA402.saturation_bit == 11
    assert CIA402.update_period_us == 1000


def test_rated_values_are_in_thousandths_as_the_standard_has_them() -> None:
    current = ObjectEntry(0x6075, 0, 32)
    torque = ObjectEntry(0x6076, 0, 32)
    assert CIA402.rated == RatedMotor(current, 1e-3, torque, 1e-3)


@pytest.mark.parametrize(
    ("tap", "words"),
    [
        (TapPoint.REFERENCE, "current reference 6074h:00"),
        (TapPoint.LIMITED_REFERENCE, "limited current reference 6074h:00"),
        (TapPoint.ACTUAL, "ACTUAL current 6074h:00"),
    ],
)
def test_the_signal_says_where_in_the_loop_it_is_taken(tap: TapPoint, words: str) -> None:
    assert replace(CIA402, tap=tap).signal == words


CONFIGURED = Identity(0x1A, 0x2B, 77)


def test_a_drive_with_every_field_as_configured_has_no_difference() -> None:
    assert CONFIGURED.differences(CONFIGURED) == ()
    found = Identity(0x1A).differences(Identity(0x1A, 5, 6))
    assert found == ()


def test_each_field_that_differs_is_named_beside_one_that_agrees() -> None:
    assert CONFIGURED.differences(Identity(0x1A, 0x2C, 78)) == (
        "product code 1018h:02 is 0x2c, the cell configuration expects 0x2b",
        "serial number 1018h:04 is 78, the cell configuration expects 77",
    )
    assert CONFIGURED.differences(Identity(0x1B, 0x2B, 77)) == (
        "vendor id 1018h:01 is 0x1b, the cell configuration expects 0x1a",
    )


def test_a_field_that_the_drive_does_not_report_is_said() -> None:
    assert CONFIGURED.differences(Identity(0x1A, 0x2B)) == (
        "serial number 1018h:04 is not reported, the cell configuration expects 77",
    )


@pytest.mark.parametrize(
    ("kind", "bits", "value", "word"),
    [
        (ParameterKind.I16, 16, -2.0, 0xFFFE),
        (ParameterKind.I16, 16, -32768.0, 0x8000),
        (ParameterKind.U16, 16, 65535.0, 0xFFFF),
        (ParameterKind.I32, 32, -1.0, 0xFFFF_FFFF),
        (ParameterKind.U32, 32, 0x0102_0304, 0x0102_0304),
        (ParameterKind.F32, 32, 1.5, 0x3FC0_0000),
    ],
)
def test_a_number_becomes_the_bits_of_its_type_and_comes_back(
    kind: ParameterKind, bits: int, value: float, word: int
) -> None:
    parameter = DriveParameter(0x2000, 1, kind)
    assert parameter.entry == ObjectEntry(0x2000, 1, bits)
    assert parameter.word(value) == word
    assert parameter.value(word) == value


def test_a_whole_number_is_the_nearest_and_a_real_one_keeps_its_fraction() -> None:
    assert DriveParameter(0x2000, 1, ParameterKind.I16).word(2.6) == 3
    real = DriveParameter(0x2000, 1, ParameterKind.F32)
    expected = struct.unpack("<f", struct.pack("<f", 2.6))[0]
    assert real.value(real.word(2.6)) == expected


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (ParameterKind.I16, 32768.0),
        (ParameterKind.U16, -1.0),
        (ParameterKind.U32, 2.0**32),
        (ParameterKind.F32, 1e39),
    ],
)
def test_a_number_beyond_its_type_is_refused_with_type_and_object(
    kind: ParameterKind, value: float
) -> None:
    pattern = f"{kind.value} 2000h:01"
    with pytest.raises(ValueError, match=pattern):
        DriveParameter(0x2000, 1, kind).word(value)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_no_number_of_a_drive(value: float) -> None:
    with pytest.raises(ValueError, match="no number for 2000h:01"):
        DriveParameter(0x2000, 1, ParameterKind.F32).word(value)
