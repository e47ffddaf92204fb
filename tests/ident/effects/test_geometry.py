"""Corrections of the geometry: each column is the derivative of the torque of a corrected arm,
built another way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate, planned
from ident.effects.effect import PlacedEffect, is_placeable
from ident.effects.geometry_corrections import (
    GeometryEffect,
    GravityDirection,
    LatePosition,
    ZeroOffset,
    across,
    corrected_dataset,
    corrected_model,
    rotation_by,
    shifted,
    turned_gravity,
    turned_gravity_std,
)
from ident.effects.signals import declared_signals
from ident.model.model import Model
from ident.model.robot import poses
from tests.ident.recordings import record, three_axes_truth, tx40_truth

FloatArray = NDArray[np.float64]

SMOOTH = Conditioning(position_cutoff_hz=8.0)
STEP = 1e-4


def _run() -> Dataset:
    truth = tx40_truth()
    rng = np.random.default_rng(4)
    run = record(truth, "bare", rng, seconds=4.0)
    return differentiate(run, truth.model.drive_train, SMOOTH)


def _smooth_torque(model: Model, data: Dataset, standard: FloatArray) -> FloatArray:
    """Torque of all joints without dry friction, by the regressor:
    none of it is used by the effects.
    """
    dry = np.array([column.name.startswith("fs") for column in model.columns])
    return np.asarray(
        np.einsum("jck,c->jk", model.regressor(data.motion()), np.where(dry, 0.0, standard))
    )


@pytest.mark.parametrize(
    ("effect", "axis", "coefficient"),
    [
        *((ZeroOffset(), axis, 0) for axis in range(1, 6)),
        (ZeroOffset(applied_rad=0.05), 2, 0),
        (GravityDirection(), 0, 0),
        (GravityDirection(), 0, 1),
        (GravityDirection(applied_1_rad=0.2, applied_2_rad=-0.1), 0, 1),
        *((LatePosition(), axis, 0) for axis in (0, 2, 5)),
    ],
)
def test_a_column_is_the_change_of_the_torque_of_a_corrected_arm(
    effect: GeometryEffect, axis: int, coefficient: int
) -> None:
    truth = tx40_truth()
    data = _run()
    if not isinstance(effect, LatePosition):
        step = STEP
    else:
        step = 1.0 / data.rate_hz

    def torque(change: float) -> FloatArray:
        values = list(effect.applied)
        values[coefficient] += change
        placed = (PlacedEffect(effect.with_applied(values), axis),)
        model = corrected_model(truth.model, placed)
        return _smooth_torque(model, corrected_dataset(data, placed), truth.parameters)

    difference = torque(step) - torque(-step)
    expected = difference / (2.0 * step)
    around = (PlacedEffect(effect, axis),)
    signals = declared_signals(
        corrected_model(truth.model, around), data, truth.parameters, truth.gains
    )
    found = effect.columns(signals, axis)[:, coefficient]
    inner = slice(20, -20)  # the ends of a run that was shifted stay constant
    largest_absolute_expected = np.max(np.abs(expected))
    size = float(largest_absolute_expected)
    tolerance = 2e-2 if isinstance(effect, LatePosition) else 1e-4
    assert size > 0.0
    largest_difference = np.max(np.abs(found - expected)[:, inner])
    assert largest_difference < tolerance * size


def test_the_zero_of_an_axis_along_gravity_changes_no_torque() -> None:
    truth = tx40_truth()
    signals = declared_signals(truth.model, _run(), truth.parameters, truth.gains)
    assert np.max(np.abs(ZeroOffset().columns(signals, 0))) < 1e-6 * np.max(
        np.abs(ZeroOffset().columns(signals, 1))
    )


def test_a_corrected_zero_moves_the_arm_as_the_offset_does() -> None:
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    position = rng.uniform(-1.0, 1.0, (5, 6))
    turned = position.copy()
    turned[:, 3] += 0.1
    effect = ZeroOffset(applied_rad=0.1)
    effects = (PlacedEffect(effect, 3),)
    model = corrected_model(truth.model, effects)
    found = poses(model.robot, position)
    expected = poses(truth.model.robot, turned)
    # Behind the joint; the joint's own frame turns with it in both.
    assert found.origin_m == pytest.approx(expected.origin_m)
    assert found.rotation[4:] == pytest.approx(expected.rotation[4:])


@settings(max_examples=30, deadline=None)
@given(
    direction=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    turn=st.tuples(*[st.floats(-0.3, 0.3)] * 2),
)
def test_gravity_keeps_its_length_and_is_found_again(
    direction: tuple[float, float, float], turn: tuple[float, float]
) -> None:
    direction_norm = np.linalg.norm(direction)
    declared = 9.81 * np.array(direction) / direction_norm
    first, second = across(declared)
    assert [first @ first, second @ second] == pytest.approx([1.0, 1.0])
    assert [first @ second, first @ declared, second @ declared] == pytest.approx(
        [0.0, 0.0, 0.0], abs=1e-12
    )
    turned = turned_gravity(declared, turn)
    turned_norm = np.linalg.norm(turned)
    assert turned_norm == pytest.approx(9.81)
    angle = np.arccos(np.clip(turned @ declared / 9.81**2, -1.0, 1.0))
    turn_norm = np.linalg.norm(turn)
    assert angle == pytest.approx(turn_norm, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(
    direction=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    deviations=st.tuples(*[st.floats(0.0, 0.01)] * 2),
)
def test_components_of_gravity_scatter_as_their_deviations_say(
    direction: tuple[float, float, float], deviations: tuple[float, float]
) -> None:
    direction_norm = np.linalg.norm(direction)
    declared = 9.81 * np.array(direction) / direction_norm
    turn_rad = [deviations[0], 0.0]
    ends = [
        turned_gravity(declared, turn_rad),
        turned_gravity(declared, [0.0, deviations[1]]),
    ]
    moved = np.linalg.norm([end - declared for end in ends], axis=0)
    assert turned_gravity_std(declared, declared, deviations) == pytest.approx(moved, abs=1e-3)


def test_values_between_samples_are_interpolated_and_ends_stay() -> None:
    time_s = np.arange(200) / 100.0
    values = np.sin(2.0 * np.pi * time_s)
    later = shifted(values, 1.3)
    assert later[10:-10] == pytest.approx(np.sin(2.0 * np.pi * (time_s[10:-10] + 0.013)), abs=1e-5)
    expected = values[-1]
    assert later[-1] == expected
    assert shifted(values, 0.0) == pytest.approx(values)


def test_a_planned_motion_has_no_late_position() -> None:
    effect = LatePosition(applied_s=0.004)
    late = (PlacedEffect(effect, 1),)
    recorded = _run()
    moved = corrected_dataset(recorded, late)
    assert not np.allclose(moved.position_rad[:, 1], recorded.position_rad[:, 1])
    assert np.array_equal(moved.position_rad[:, 0], recorded.position_rad[:, 0])
    motion = planned(recorded.motion(), recorded.rate_hz)
    assert corrected_dataset(motion, late) is motion


def test_an_effect_is_the_same_one_after_each_correction() -> None:
    one = PlacedEffect(ZeroOffset(), 2)
    effect = ZeroOffset(applied_rad=0.03)
    other = PlacedEffect(effect, 2)
    assert one == other
    expected = [column.name for column in other.columns]
    assert [column.name for column in one.columns] == expected
    assert [column.about for column in other.columns] == [0.03]


def test_the_mounting_is_one_for_all_axes_and_a_zero_one_for_each() -> None:
    robot = three_axes_truth().model.robot
    assert [axis for axis in range(3) if is_placeable(GravityDirection(), axis, robot)] == [0]
    assert [axis for axis in range(3) if is_placeable(ZeroOffset(), axis, robot)] == [0, 1, 2]
    placed_effect = PlacedEffect(GravityDirection(), 0)
    assert placed_effect.name_among(["J1"]) == "gravity-direction on all axes"


def test_rotations_are_right_handed() -> None:
    vector_rad = np.array([0.0, 0.0, np.pi / 2])
    assert rotation_by(vector_rad) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert np.array_equal(rotation_by(np.zeros(3)), np.eye(3))


def test_signals_without_an_arm_are_refused() -> None:
    truth = tx40_truth()
    signals = declared_signals(truth.model, _run(), truth.parameters, truth.gains)
    changed_signal = replace(signals, arm=None)
    with pytest.raises(ValueError, match="without an arm"):
        ZeroOffset().columns(changed_signal, 0)
