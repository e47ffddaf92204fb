"""From raw current to ampere: what the drive says, and when it is not believed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.scale import LARGEST_KT_RATIO, ScaleReading, check_nameplate, read_scale
from drivers.canopen.sdo import ObjectAccess
from drivers.errors import ObjectAccessError, SetupRefused
from drivers.profiles.profile import (
    Amplitude,
    CurrentScale,
    ObjectEntry,
    RatedMotor,
    ScaleForm,
    TapPoint,
)
from tests.drivers.scripted import PROFILE, ScriptedNode, cell

RATED_CURRENT = ObjectEntry(0x6075, 0, 32, signed=False)
RATED_TORQUE = ObjectEntry(0x6076, 0, 32, signed=False)
RATED = replace(PROFILE, rated=RatedMotor(RATED_CURRENT, torque=RATED_TORQUE))


@contextmanager
def drive() -> Iterator[tuple[ObjectAccess, ScriptedNode]]:
    """A drive of 2 A on a bus, without 6076h."""
    network, bus = cell(1)
    with network:
        yield network.link.objects(1), bus.nodes[0]


def reading(current_a: float | None, torque_nm: float | None) -> ScaleReading:
    return ScaleReading(0.002, {}, current_a, torque_nm, ())


def test_a_drive_reports_its_ampere_and_its_motor() -> None:
    with drive() as (access, node):
        node.objects[0x6076, 0] = (1500, 4)
        found = read_scale(access, RATED)
    assert found.ampere_per_unit == pytest.approx(0.002)
    expected = ({"6075h:00": 2000}, 2.0, 1.5)
    assert (found.objects, found.rated_current_a, found.rated_torque_nm) == expected
    assert found.warnings == ()


@pytest.mark.parametrize("torque", [None, 0])
def test_a_drive_without_rated_torque_says_that_nothing_was_checked(torque: int | None) -> None:
    with drive() as (access, node):
        if torque is not None:
            node.objects[0x6076, 0] = (torque, 4)
        found = read_scale(access, RATED)
    assert (found.rated_current_a, found.rated_torque_nm) == (2.0, None)
    expected = (
        "drive reports no rated torque (6076h:00); the torque constant cannot be checked (no gain "
        "depends on this)"
    )
    assert found.warnings == (expected,)


def test_a_negative_rated_torque_is_named_and_nothing_is_checked_with_it() -> None:
    signed_torque = replace(RATED_TORQUE, signed=True)
    rated = RatedMotor(RATED_CURRENT, torque=signed_torque)
    with drive() as (access, node):
        node.objects[0x6076, 0] = (2**32 - 1500, 4)
        found = read_scale(access, replace(PROFILE, rated=rated))
    assert found.rated_torque_nm is None
    (warning,) = found.warnings
    assert warning.startswith("drive reports a rated torque below zero (6076h:00 = -1500); ")
    assert check_nameplate(found, Amplitude.RMS, 0.7) == ()


@pytest.mark.parametrize("lacking", [0x6075, 0x6076])
def test_a_torque_without_a_unit_is_said_not_to_be_logged(lacking: int) -> None:
    fixed = replace(PROFILE.current_scale, factor=0.002, objects=())  # it needs no rated current
    torque = ObjectEntry(0x6077, 0, 16, signed=True)
    profile = replace(RATED, current_scale=fixed, torque=torque)
    with drive() as (access, node):
        node.objects[0x6076, 0] = (1500, 4)
        node.objects[lacking, 0] = (0, 4)
        (warning,) = read_scale(access, profile).warnings
        changed_profile = replace(profile, torque=None)
        (without,) = read_scale(access, changed_profile).warnings
    unlogged = ", and its torque (6077h:00) is not logged"
    assert warning == without + unlogged


def test_a_profile_without_rated_values_says_so() -> None:
    with drive() as (access, _):
        found = read_scale(access, PROFILE)
    assert found.rated_current_a is None
    assert "cannot be checked" in found.warnings[0]


def test_a_drive_that_was_never_set_up_has_no_ampere() -> None:
    with drive() as (access, node):
        node.store(0x6075, 0, 0)
        with pytest.raises(
            SetupRefused,
            match=r"J1 \(node 1\): profile generic: found 6075h:00 = 0; .*rated "
            r"current and torque",
        ):
            read_scale(access, RATED)


@pytest.mark.parametrize(
    ("milliampere", "message"),
    [(2, "rated current of 0.002 A"), (2_000_000, "rated current of 2000 A")],
)
def test_a_rated_current_in_another_unit_is_named(milliampere: int, message: str) -> None:
    with drive() as (access, node):
        node.store(0x6075, 0, milliampere)
        with pytest.raises(SetupRefused, match=message):
            read_scale(access, RATED)


@pytest.mark.parametrize("ampere_per_unit", [1.0, 2.0e-5])
def test_a_step_that_does_not_fit_the_motor_is_named(ampere_per_unit: float) -> None:
    """2 A are two steps of 1 A, and more steps of 20 µA than 16 bits can say."""
    current_scale = CurrentScale(ampere_per_unit, (), ScaleForm.FIXED_STEP)
    wrong = replace(RATED, current_scale=current_scale)
    with (
        drive() as (access, _),
        pytest.raises(SetupRefused, match=r"2 A in steps of .*32767 steps, .* range of 6074h"),
    ):
        read_scale(access, wrong)


@pytest.mark.parametrize(("choice", "share"), [(0, math.sqrt(0.5)), (1, 1.0)])
def test_a_switch_chooses_the_weight(choice: int, share: float) -> None:
    switch = ObjectEntry(0x2002, 0x54, 32, signed=False)
    weights = (math.sqrt(0.5), 1.0)
    scale = CurrentScale(1e-6, (RATED_CURRENT,), ScaleForm.SWITCHED_PER_MILLE, switch, weights)
    with drive() as (access, node):
        node.objects[0x2002, 0x54] = (choice, 4)
        profile = replace(RATED, current_scale=scale)
        found = read_scale(access, profile)
        assert found.ampere_per_unit == pytest.approx(0.002 * share)
        expected = {"6075h:00": 2000, "2002h:54": choice}
        assert found.objects == expected
        node.objects[0x2002, 0x54] = (2, 4)
        changed_rated = replace(RATED, current_scale=scale)
        with pytest.raises(SetupRefused, match=r"2002h:54 = 2; expected 0 to 1"):
            read_scale(access, changed_rated)


def test_a_missing_scale_object_is_an_error_and_not_a_warning() -> None:
    objects = (ObjectEntry(0x203B, 1, 32, signed=False),)
    current_scale = CurrentScale(1e-6, objects)
    missing = replace(PROFILE, current_scale=current_scale)
    with drive() as (access, _), pytest.raises(ObjectAccessError, match="203Bh:01"):
        read_scale(access, missing)


RATIO = st.floats(0.01, 100.0)


@given(
    current_a=st.floats(0.05, 200.0),
    torque_nm=st.floats(0.01, 500.0),
    ratio=RATIO,
    sign=st.sampled_from((-1, 1)),
)
@settings(deadline=None)
def test_nameplates_agree_or_warn_by_their_ratio(
    current_a: float, torque_nm: float, ratio: float, sign: int
) -> None:
    reported = reading(current_a, torque_nm)
    declared = sign * torque_nm / current_a / ratio
    spread = max(ratio, 1.0 / ratio)
    if not LARGEST_KT_RATIO * 0.9999 < spread < LARGEST_KT_RATIO * 1.0001:
        assert bool(check_nameplate(reported, Amplitude.RMS, declared)) is (
            spread > LARGEST_KT_RATIO
        )


@pytest.mark.parametrize("ratio", [math.sqrt(2.0), math.sqrt(0.5)])
def test_peak_against_rms_is_recognised(ratio: float) -> None:
    (found,) = check_nameplate(reading(2.0, 2.0), Amplitude.UNSTATED, 1.0 / ratio)
    assert "near √2" in found
    assert "unstated" in found
    (other,) = check_nameplate(reading(2.0, 2.0), Amplitude.UNSTATED, 0.5)
    assert "√2" not in other


def test_what_a_drive_does_not_report_is_not_compared() -> None:
    assert check_nameplate(reading(2.0, None), Amplitude.RMS, 1e9) == ()
    assert check_nameplate(reading(None, None), Amplitude.RMS, 1e9) == ()


@given(
    factor=st.floats(1e-9, 1.0),
    values=st.lists(st.integers(1, 2**31), max_size=3).map(tuple),
    choice=st.integers(0, 2),
)
@settings(deadline=None)
def test_a_scale_is_proportional_to_each_of_its_objects(
    factor: float, values: tuple[int, ...], choice: int
) -> None:
    weights = (0.5, 1.0, 2.0)
    scale = CurrentScale(factor, (), weights=weights)
    whole = scale.ampere_per_unit(values, choice)
    assert whole > 0.0
    assert scale.ampere_per_unit((*values, 7), choice) == pytest.approx(7.0 * whole)
    expected = 4.0 * scale.ampere_per_unit(values, 0)
    assert scale.ampere_per_unit(values, 2) == pytest.approx(expected)
    with pytest.raises(IndexError):
        scale.ampere_per_unit(values, 3)
    with pytest.raises(IndexError):
        scale.ampere_per_unit(values, -1)


def test_an_actual_current_is_shouted() -> None:
    assert PROFILE.signal == "current reference 6074h:00"
    changed_profile = replace(PROFILE, tap=TapPoint.LIMITED_REFERENCE)
    assert changed_profile.signal == ("limited current reference 6074h:00")
    signal = replace(PROFILE, tap=TapPoint.ACTUAL).signal
    assert signal == "ACTUAL current 6074h:00"
