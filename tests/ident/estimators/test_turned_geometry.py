"""Gravity that points elsewhere than declared, positions that count the other way,
and zeros a quarter turn away.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.run import Run
from ident.equations.instants import Instants, read_instants
from ident.estimators.turned_geometry import (
    GRAVITY_TURNED,
    POSITION_REVERSED,
    SMALLEST_TURN_DEG,
    ZERO_TURNED,
    TurnedGeometry,
    find_turned_geometry,
    fits_better,
    gravity_products,
    with_gravity,
)
from tests.ident.mistaken import AXES, SMALL, small_recordings, with_currents
from tests.ident.recordings import MOUNTED, FloatArray, Truth, record, three_axes_truth

pytestmark = pytest.mark.slow

DOWN = np.array([0.0, 0.0, -9.81])


@pytest.fixture(scope="module")
def truth() -> Truth:
    return three_axes_truth()


@pytest.fixture(scope="module")
def clean(truth: Truth) -> list[Run]:
    return small_recordings(truth, 0, seconds=12.0)


def found_in(
    truth: Truth, runs: list[Run], gains: FloatArray | None = None
) -> TurnedGeometry | None:
    """The geometry that is found in runs under the model of an arm."""
    instants = read_instants(truth.model, runs, SMALL)
    return find_turned_geometry(truth.model, instants, truth.gains if gains is None else gains)


def with_positions(runs: list[Run], signs: FloatArray) -> list[Run]:
    """The same with positions that count the other way."""
    return [replace(run, position_rad=run.position_rad * signs) for run in runs]


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_in_clean_recordings(truth: Truth, seed: int) -> None:
    runs = small_recordings(truth, seed, noise_a=0.15)
    assert found_in(truth, runs) is None


@pytest.mark.parametrize(
    "declared", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 1, 1), (2, -1, 1)]
)
def test_gravity_is_found_within_a_degree(
    truth: Truth, clean: list[Run], declared: tuple[int, ...]
) -> None:
    declared_norm = np.linalg.norm(declared)
    gravity = 9.81 * np.array(declared) / declared_norm
    model = with_gravity(truth.model, gravity)
    changed_truth = replace(truth, model=model)
    found = found_in(changed_truth, clean)
    assert found is not None
    assert found.gravity is not None
    assert found.diagnosis(AXES).name == GRAVITY_TURNED
    cosine = found.gravity.found_m_s2 @ DOWN / 9.81**2
    assert np.rad2deg(np.arccos(min(cosine, 1.0))) < max(1.0, 4.0 * found.gravity.std_deg)
    assert found.gravity.std_deg < 2.0
    gravity_size_m_s2 = np.linalg.norm(found.gravity.found_m_s2)
    assert gravity_size_m_s2 == pytest.approx(9.81)


def test_a_small_turn_of_gravity_is_no_gross_mistake(truth: Truth, clean: list[Run]) -> None:
    angle = np.deg2rad(0.5 * SMALLEST_TURN_DEG)
    gravity_m_s2 = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    tilted = with_gravity(truth.model, gravity_m_s2)
    changed_truth = replace(truth, model=tilted)
    assert found_in(changed_truth, clean) is None


@pytest.mark.parametrize("current_sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [1, 2])
def test_a_reversed_position_is_found(
    truth: Truth, clean: list[Run], axis: int, current_sign: float
) -> None:
    signs = np.ones(3)
    signs[axis] = -1.0
    currents = np.ones(3)
    currents[axis] = current_sign
    runs = with_currents(with_positions(clean, signs), currents)
    found = found_in(truth, runs)
    assert found is not None
    said = found.diagnosis(AXES)
    expected = (POSITION_REVERSED, (AXES[axis],))
    assert (said.name, said.axes) == expected
    assert found.reversed_currents == ((axis,) if current_sign < 0.0 else ())
    # A current that counts the other way, too, asks for the axis in the URDF, or both signs in the
    # cell file.
    assert ("the <axis> of the joint" in said.remedy) == (current_sign < 0.0)
    assert "`drive_train.ratio`" in said.remedy
    position_rad = np.ones((1, 3))
    assert found.corrected_positions(position_rad).tolist() == [signs.tolist()]


@pytest.mark.parametrize("offset_deg", [40.0, -45.0, 60.0, 90.0, -90.0, 135.0, 160.0, 180.0])
def test_a_zero_that_is_far_off_is_found_with_its_size(
    truth: Truth, clean: list[Run], offset_deg: float
) -> None:
    """It was silent below 45°, and called a payload that was not there above."""
    offset = np.array([0.0, np.deg2rad(offset_deg), 0.0])
    runs = [replace(run, position_rad=run.position_rad + offset) for run in clean]
    found = found_in(truth, runs)
    assert found is not None
    said = found.diagnosis(AXES)
    assert (said.name, said.axes) == (ZERO_TURNED, ("J2",))
    read = np.rad2deg(found.readings[0].zero_rad)
    assert abs((read + offset_deg + 180.0) % 360.0 - 180.0) < 2.0
    assert -180.0 < read <= 180.0
    assert f"add about {read:+.0f} deg to `zero_offset_deg` of J2" in said.remedy
    position_rad = np.zeros((1, 3))
    corrected = found.corrected_positions(position_rad)
    assert corrected == pytest.approx(np.deg2rad([[0.0, read, 0.0]]))


def test_find_turned_geometry_with_a_leaning_base_blames_no_zero(truth: Truth) -> None:
    """A zero of J1 that is off by 116° turns a lean by 8° away from the arm;
    the lean itself explains all of it.
    """
    easy = truth.parameters.copy()
    easy[10:14] *= 0.05  # friction of J1 would hide the torque of the lean
    changed_truth = replace(truth, parameters=easy)
    runs = runs_with_less_of_j1(changed_truth, share=0.6, noise_a=0.03)
    gravity_m_s2 = tilted_gravity(8.0, azimuth_deg=60.0)
    leaning = with_gravity(truth.model, gravity_m_s2)
    assert found_in(replace(truth, model=leaning), runs) is None


def test_find_turned_geometry_where_j1_hardly_moves_names_gravity_and_the_zero_that_explains_the_same(  # noqa: E501
    truth: Truth,
) -> None:
    runs = runs_with_less_of_j1(truth, share=0.1, noise_a=0.1)
    gravity_m_s2 = tilted_gravity(14.0, azimuth_deg=180.0)
    leaning = with_gravity(truth.model, gravity_m_s2)
    changed_truth = replace(truth, model=leaning)
    found = found_in(changed_truth, runs)
    assert found is not None
    assert found.gravity is not None
    assert [reading.axis for reading in found.readings] == [1]
    said = found.diagnosis(AXES)
    assert "explained as well by the zero of J2 off by" in said.found
    assert "these moves do not tell them apart" in said.remedy
    assert "gravity_m_s2" not in said.remedy


def runs_with_less_of_j1(truth: Truth, share: float, noise_a: float) -> list[Run]:
    """Runs in which J1 moves through a share of its range only."""
    rng = np.random.default_rng(0)
    less = np.array([share, 1.0, 1.0])
    runs = list[Run]()
    for index in range(4):
        payload = MOUNTED if index % 2 else None
        runs.append(
            record(
                truth,
                f"r{index}",
                rng,
                payload,
                seconds=16.0,
                noise_a=noise_a,
                rate_hz=200.0,
                bend=lambda q: q * less,
            )
        )
    return runs


def tilted_gravity(angle_deg: float, azimuth_deg: float) -> FloatArray:
    """Gravity that leans by an angle towards an azimuth [m/s²], shape (3,)."""
    angle = np.deg2rad(angle_deg)
    azimuth = np.deg2rad(azimuth_deg)
    sideways = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.asarray(9.81 * (np.sin(angle) * sideways - np.cos(angle) * np.array([0.0, 0.0, 1.0])))


@pytest.mark.parametrize("axis", [0, 2])
def test_a_zero_that_no_torque_shows_is_not_found(
    truth: Truth, clean: list[Run], axis: int
) -> None:
    """About a vertical axis and behind the last joint another zero makes the same torques."""
    offset = np.zeros(3)
    offset[axis] = np.deg2rad(90.0)
    runs = [replace(run, position_rad=run.position_rad + offset) for run in clean]
    assert found_in(truth, runs) is None


@pytest.mark.parametrize(
    ("factor", "order"),
    [
        (np.array([1.0, -1.0, 1.0]), (0, 1, 2)),
        (np.array([-1.0, -1.0, -1.0]), (0, 1, 2)),
        (np.array([1.0, 0.5, 2.0]), (0, 1, 2)),
        (np.full(3, 1000.0), (0, 1, 2)),
        (np.ones(3), (0, 2, 1)),
        (np.ones(3), (1, 0, 2)),
    ],
)
def test_mistakes_of_currents_are_no_geometry(
    truth: Truth, clean: list[Run], factor: FloatArray, order: tuple[int, ...]
) -> None:
    runs = with_currents(clean, factor, order)
    assert found_in(truth, runs) is None


def test_a_reversed_current_beside_a_wrong_gravity_does_not_hide_it(
    truth: Truth, clean: list[Run]
) -> None:
    gravity_m_s2 = np.array([9.81, 0.0, 0.0])
    model = with_gravity(truth.model, gravity_m_s2)
    wall = replace(truth, model=model)
    runs = with_currents(clean, np.array([1.0, -1.0, 1.0]))
    found = found_in(wall, runs)
    assert found is not None
    assert found.gravity is not None
    assert found.reversed_currents == (1,)


@pytest.mark.parametrize("gains_fixed", [False, True])
def test_a_fit_of_all_rows_confirms_it(truth: Truth, clean: list[Run], gains_fixed: bool) -> None:
    gravity_m_s2 = np.array([0.0, 9.81, 0.0])
    model = with_gravity(truth.model, gravity_m_s2)
    wall = replace(truth, model=model)
    found = found_in(wall, clean)
    assert found is not None

    def confirmed(before_percent: float | None) -> bool:
        return fits_better(
            found,
            wall.model,
            clean,
            SMALL,
            truth.gains,
            gains_fixed=gains_fixed,
            before_percent=before_percent,
        )

    assert confirmed(None)
    assert confirmed(40.0)
    assert not confirmed(1.0)  # the declared geometry has left less


def test_products_serve_every_direction(truth: Truth, clean: list[Run]) -> None:
    instants = read_instants(truth.model, clean[:2], SMALL)
    gravity = np.array([3.0, -4.0, 5.0])
    weighed = gravity_products(truth.model, instants)
    square = weighed.directed(gravity).square.sum(axis=1)
    model = with_gravity(truth.model, gravity)
    own = gravity_products(model, instants)
    assert np.array_equal(own.square, weighed.square)  # the declared gravity takes no part
    motion = instants[0].motion
    columns = with_gravity(truth.model, gravity).regressor(motion)[1]
    first = square_of(columns, instants[0], 1)
    bare = gravity_products(truth.model, instants[:1]).directed(gravity).square.sum(axis=1)[1]
    to_motor = truth.model.drive_train.to_motor
    expected = first * to_motor[1, 1] ** 2
    np.testing.assert_allclose(bare[:-1, :-1], expected, atol=1e-9)
    column_count_expected = len(truth.model.columns) + 10 + 1
    assert square.shape[-1] == column_count_expected


def square_of(columns: FloatArray, instants: Instants, motor: int) -> FloatArray:
    """Products of columns over the rows of a motor that count."""
    used = columns[:, instants.use[motor]]
    return used @ used.T


def test_without_rows_nothing_is_found(truth: Truth) -> None:
    turned_geometry = find_turned_geometry(truth.model, (), truth.gains)
    assert turned_geometry is None
