"""A body weighed with a calibration: its values, its σ, and what the motion does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.calibration import Calibration
from ident.data.run import Run
from ident.errors import DataUnfit, TooFewMoves
from ident.estimators.estimate import RelativeError
from ident.model.bodies import LINK_PARAMETERS, Payload, body_of
from ident.model.robot import Motion, Place
from ident.planning.excitation import Excitation
from ident.planning.gain_verdict import ExtraMoves
from ident.weighing import (
    KNOWN,
    RowsToWeigh,
    Scale,
    WeighedBody,
    moves_that_help,
    rows_to_weigh,
    weigh,
    weigh_rows,
)
from tests.ident.recordings import FloatArray, Truth
from tests.ident.weighed import AXIS, WeighedCell, a_body, noisy_run, weighed_cell


@pytest.fixture(scope="module")
def cells(small_truth: Truth) -> tuple[WeighedCell, ...]:
    """Two cells with load friction, each calibrated by itself."""
    return tuple(weighed_cell(small_truth, seed) for seed in range(2))


@pytest.fixture(scope="module")
def rows(small_truth: Truth, cells: tuple[WeighedCell, ...]) -> tuple[RowsToWeigh, RowsToWeigh]:
    """Rows of the first cell: with the body alone, and beside a run without load."""
    one = cells[0]
    return (
        rows_to_weigh(small_truth.model, [one.loaded], one.conditioning),
        rows_to_weigh(small_truth.model, [one.loaded], one.conditioning, bare=[one.bare]),
    )


def _without_effects(calibration: Calibration) -> Calibration:
    left = tuple(one for one in calibration.parameters if "friction" not in one.name)
    return replace(calibration, parameters=left, effects=(), covariance_factor=None)


def _scores(cell: WeighedCell, found: WeighedBody) -> FloatArray:
    mass = cell.body[-1]
    centre, std = found.centre_m
    mass_difference_kg = found.mass_kg - mass
    return np.concatenate(
        ([mass_difference_kg / found.mass_std_kg], (centre - cell.body[6:9] / mass) / std)
    )


@pytest.mark.slow
def test_errors_are_as_large_as_their_sigma(
    small_truth: Truth, cells: tuple[WeighedCell, ...]
) -> None:
    """`make weigh-study` counts a hundred cells."""
    scores_of_cells = []
    for cell in cells:
        for bare in ([], [cell.bare]):
            weighed = weigh(
                cell.calibration, small_truth.model, [cell.loaded], cell.conditioning, bare=bare
            )
            scores_of_cells.append(_scores(cell, weighed))
    scores = np.array(scores_of_cells)
    rms_scores = np.sqrt(np.mean(scores**2))
    assert 0.5 < rms_scores < 1.6
    assert np.abs(scores).max() < 4.0


def test_without_the_effects_sigma_is_wide_and_the_residual_large(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh]
) -> None:
    calibration = cells[0].calibration
    whole = weigh_rows(calibration, rows[1])
    without = weigh_rows(_without_effects(cells[0].calibration), rows[1])
    assert without.moves_covariance[-1, -1] > 1.3**2 * whole.moves_covariance[-1, -1]
    assert without.error.axes[AXIS] > 1.3 * whole.error.axes[AXIS]


@pytest.mark.parametrize("beside", [0, 1])
def test_an_error_of_the_calibration_is_in_sigma_as_it_is_in_the_body(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh], beside: int
) -> None:
    """A calibration whose only error is one direction:
    its share of σ is the shift that this error makes.
    """
    calibration = _without_effects(cells[0].calibration)
    values = np.array(
        [one.value for one in calibration.gains] + [one.value for one in calibration.parameters]
    )
    rng = np.random.default_rng(5)
    error = 1e-4 * rng.standard_normal(len(values)) * np.maximum(np.abs(values), 1e-2)
    root = tuple((float(value), *([0.0] * index)) for index, value in enumerate(error))
    changed_calibration = replace(calibration, covariance_factor=root)
    certain = weigh_rows(changed_calibration, rows[beside])
    moved = _changed(calibration, values + error)
    shift = weigh_rows(moved, rows[beside]).values - weigh_rows(calibration, rows[beside]).values
    covariance_difference = certain.covariance - certain.moves_covariance
    share = np.diag(covariance_difference)
    largest_absolute_shift = float(np.abs(shift).max())
    share_root = np.sqrt(np.abs(share))
    assert share_root == pytest.approx(np.abs(shift), rel=0.03, abs=0.03 * largest_absolute_shift)


@pytest.mark.slow
@pytest.mark.parametrize("beside", [0, 1])
def test_the_tolerance_of_the_reference_mass_is_in_sigma_as_a_wrong_mass_is_in_the_body(
    small_truth: Truth,
    cells: tuple[WeighedCell, ...],
    rows: tuple[RowsToWeigh, RowsToWeigh],
    beside: int,
) -> None:
    """The share of σ is the shift of the body with a calibration that took another mass for
    known.
    """
    calibration = cells[0].calibration
    (reference,) = calibration.payload_mass
    factor = 1.002
    tolerance_kg = (factor - 1.0) * reference.mass_kg
    heavier = weighed_cell(small_truth, 0, mass_factor=factor).calibration
    shift = weigh_rows(heavier, rows[beside]).values - weigh_rows(calibration, rows[beside]).values
    payload_mass = (reference.weighed_to(tolerance_kg),)
    tolerant = replace(calibration, payload_mass=payload_mass)
    changed_payload_mass = replace(tolerant.payload_mass[0], parameters_per_kg=())
    earlier = replace(calibration, payload_mass=(changed_payload_mass,))
    exact = weigh_rows(calibration, rows[beside])
    for known in (tolerant, earlier):
        found = weigh_rows(known, rows[beside])
        added = found.covariance - exact.covariance
        assert found.reference_covariance == pytest.approx(added)
        added_diagonal_root = np.sqrt(np.diag(added))
        largest_absolute_shift = np.abs(shift).max()
        assert added_diagonal_root == pytest.approx(
            np.abs(shift), rel=0.05, abs=0.02 * largest_absolute_shift
        )
        assert found.mass_reference_std_kg == pytest.approx(
            tolerance_kg / reference.mass_kg * exact.mass_kg, rel=0.02
        )
    assert exact.mass_reference_std_kg == 0.0


def test_a_payload_of_exact_mass_hides_no_tolerance_of_another(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh]
) -> None:
    calibration = cells[0].calibration
    (reference,) = calibration.payload_mass
    exact = reference.weighed_to(0.0)
    tolerance_kg = 0.01 * reference.mass_kg
    tolerant = reference.weighed_to(tolerance_kg)
    changed_calibration = replace(calibration, payload_mass=(tolerant,))
    alone = weigh_rows(changed_calibration, rows[0])
    for both in ((exact, tolerant), (tolerant, exact)):
        found = weigh_rows(replace(calibration, payload_mass=both), rows[0])
        assert found.reference_covariance == pytest.approx(alone.reference_covariance)
    assert alone.mass_reference_std_kg > 0.0


def _changed(calibration: Calibration, values: FloatArray) -> Calibration:
    count = len(calibration.gains)
    pairs = zip(calibration.gains, values[:count], strict=True)
    rest = zip(calibration.parameters, values[count:], strict=True)
    gains = tuple(replace(gain, value=float(value)) for gain, value in pairs)
    parameters = tuple(replace(parameter, value=float(value)) for parameter, value in rest)
    return replace(
        calibration,
        gains=gains,
        parameters=parameters,
    )


def test_a_common_error_of_the_gains_scales_the_body_and_leaves_its_centre(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh]
) -> None:
    """Without a covariance, σ of the gains is taken as such an error;
    the scatter of the moves is left alone.
    """
    plain = _without_effects(cells[0].calibration)
    gains = tuple(replace(gain, value=1.05 * gain.value) for gain in plain.gains)
    scaled = replace(plain, gains=gains)
    changed_gains = tuple(replace(gain, std=0.02 * abs(gain.value)) for gain in plain.gains)
    uncertain = replace(plain, gains=changed_gains)
    exact, heavier, found = (weigh_rows(one, rows[1]) for one in (plain, scaled, uncertain))
    assert heavier.mass_kg == pytest.approx(1.05 * exact.mass_kg, rel=1e-3)
    assert heavier.centre_m[0] == pytest.approx(exact.centre_m[0], abs=1e-5)
    assert not found.complete
    assert found.mass_std_kg >= 0.02 * found.mass_kg
    assert found.moves_covariance == pytest.approx(exact.moves_covariance)


def test_what_the_logs_say_of_their_payload_is_ignored(
    small_truth: Truth, cells: tuple[WeighedCell, ...]
) -> None:
    cell = cells[1]
    calibration = _without_effects(cell.calibration)
    payload = Payload("other", "elsewhere", {"m": 99.0})
    changed_loaded = replace(cell.loaded, payload=payload)
    runs = cell.loaded, changed_loaded
    first, second = (
        weigh(calibration, small_truth.model, [run], cell.conditioning) for run in runs
    )
    assert first.values.tolist() == second.values.tolist()


def test_a_swing_of_the_last_joint_shows_a_part_and_says_what_would_show_the_rest(
    small_truth: Truth, cells: tuple[WeighedCell, ...]
) -> None:
    cell = cells[0]
    model = small_truth.model
    rng = np.random.default_rng(1)
    calm = _only_last(small_truth, noisy_run(small_truth, "swing", rng, None, 24.0))
    loaded = _recorded(small_truth, calm, cell.body)
    calibration = _without_effects(cell.calibration)
    found = weigh(calibration, model, [loaded], cell.conditioning)
    seen = dict(zip(LINK_PARAMETERS, found.identifiable.tolist(), strict=True))
    assert not seen["m"]
    expected = np.isnan(found.centre_m[0]).all()
    assert np.isnan(found.mass_kg) == expected
    assert seen["mx"] or seen["mz"]  # the weight's lever about the last joint

    def extra(words: str, run: Run) -> ExtraMoves:
        q = run.position_rad[::5]
        rate_hz = run.rate_hz / 5.0
        velocity = np.gradient(q, axis=0) * rate_hz
        velocity_gradient = np.gradient(velocity, axis=0)
        acceleration_rad_s2 = velocity_gradient * rate_hz
        motion = Motion(q, velocity, acceleration_rad_s2)
        excitation = Excitation(motion, (np.abs(velocity) > 0.03).T)
        return ExtraMoves(words, 24.0, excitation)

    everything = extra("all axes", cell.loaded)
    same = extra("more of the same", calm)
    helped = {one.name: one for one in moves_that_help(found, [same, everything])}
    assert helped["m"].words == "all axes"
    std = helped["m"].std
    assert 2.0 * std < cell.body[-1]
    assert "m" not in {one.name for one in moves_that_help(found, [same])}
    assert moves_that_help(found, []) == ()


def _only_last(truth: Truth, run: Run) -> Run:
    still = run.position_rad.copy()
    still[:, :-1] = 0.3
    return replace(run, position_rad=still)


def _recorded(truth: Truth, run: Run, body: FloatArray) -> Run:
    """The run with the currents that its motion needs."""
    rate_hz = run.rate_hz
    position_rad_gradient = np.gradient(run.position_rad, axis=0)
    velocity = position_rad_gradient * rate_hz
    velocity_gradient = np.gradient(velocity, axis=0)
    acceleration_rad_s2 = velocity_gradient * rate_hz
    motion = Motion(run.position_rad, velocity, acceleration_rad_s2)
    parameters = truth.parameters.copy()
    parameters[truth.model.flange] += body
    torque = truth.model.torques(motion, parameters)[2]
    rng = np.random.default_rng(2)
    noise = 0.02 * rng.standard_normal(torque.shape)
    to_motor = truth.model.drive_train.to_motor
    return replace(run, current_a=(to_motor @ torque / truth.gains[:, None] + noise).T)


def test_too_little_is_refused(small_truth: Truth, cells: tuple[WeighedCell, ...]) -> None:
    cell = cells[0]
    with pytest.raises(DataUnfit, match="no run with the body"):
        weigh(cell.calibration, small_truth.model, [], cell.conditioning)
    end = round(6.0 * cell.loaded.rate_hz)
    arrays = ("time_s", "position_rad", "current_a")
    short = replace(cell.loaded, **{name: getattr(cell.loaded, name)[:end] for name in arrays})
    with pytest.raises(TooFewMoves):
        weigh(cell.calibration, small_truth.model, [short], cell.conditioning)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_centre_and_inertia_are_those_of_the_ten(seed: int) -> None:
    """Values as of `body_of`; σ as of a finite difference along a single uncertain direction."""
    rng = np.random.default_rng(seed)
    ten = a_body(rng)
    step = 1e-6 * rng.standard_normal(10)
    certain = np.zeros((10, 10))
    spread = np.outer(step, step)
    scale = Scale.__new__(Scale)
    error = RelativeError((), 0.0)
    found = WeighedBody(ten, certain, spread, True, 9, error, scale)
    (centre, centre_std), (inertia, inertia_std) = found.centre_m, found.inertia_kg_m2
    upper = np.triu_indices(3)
    body = body_of(ten)
    near = body_of(ten + step)
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    translation_m = np.array([0.4, 0.1, 0.0])
    frame = Place(0, rotation, translation_m)
    placed, placed_std = found.centre_in(frame)
    x, y, z = body.centre_m
    assert placed == pytest.approx([y - 0.1, 0.4 - x, z])  # a quarter turn about z
    assert placed_std == pytest.approx(centre_std[[1, 0, 2]])
    planar = replace(found, values=np.where(np.arange(10) == 8, np.nan, ten))  # no mz, so no z
    assert planar.centre_in(frame)[0] == pytest.approx([y - 0.1, 0.4 - x, np.nan], nan_ok=True)
    assert centre == pytest.approx(body.centre_m)
    assert inertia == pytest.approx(body.inertia_kg_m2[upper], abs=1e-12)
    centre_difference_m = np.abs(near.centre_m - body.centre_m)
    assert centre_std == pytest.approx(centre_difference_m, rel=1e-2, abs=1e-9)
    inertia_difference_kg_m2 = np.abs(near.inertia_kg_m2 - body.inertia_kg_m2)
    assert inertia_std == pytest.approx(inertia_difference_kg_m2[upper], rel=1e-2, abs=1e-9)
    lost = replace(found, values=np.where(np.arange(10) == 6, np.nan, ten))
    assert np.isnan(lost.centre_m[0]).tolist() == [True, False, False]


def test_a_parameter_with_a_long_lever_is_identified_though_a_compact_body_has_less() -> None:
    """Izz of 5 kg, 0.45 m from the joint, known to 2 %:
    twice σ is more than a steel cube of that mass has.
    """
    ten = np.array([np.nan, np.nan, np.nan, np.nan, np.nan, 1.0, 2.2, 0.01, np.nan, 5.0])

    def identified(std_of_izz: float) -> list[str]:
        std = np.where(np.isnan(ten), np.nan, 0.01)
        std[5] = std_of_izz
        covariance = np.diag(std**2)
        error = RelativeError((), 0.0)
        body = WeighedBody(ten, covariance, covariance, True, 9, error, Scale.__new__(Scale))
        return [
            name for name, known in zip(LINK_PARAMETERS, body.identifiable, strict=True) if known
        ]

    assert 2.0 * 0.02 > 5.0 * (5.0 / 7850.0) ** (2.0 / 3.0)
    # `my` is near zero, and known to less than the cube's
    assert identified(0.02) == ["Izz", "mx", "my", "m"]
    assert identified(0.2) == ["mx", "my", "m"]


@given(mass_kg=st.floats(0.1, 200.0), share=st.floats(0.0, 3.0))
def test_a_mass_is_identified_to_a_tenth_of_itself_and_nothing_is_small_beside_an_unknown_one(
    mass_kg: float, share: float
) -> None:
    """±41 % of a mass were called identified, as twice σ is less than the mass."""
    ten = np.full(10, 1e-9)
    ten[9] = mass_kg
    std = np.full(10, 1e-4 * mass_kg)
    std[9] = share * mass_kg
    covariance = np.diag(std**2)
    error = RelativeError((), 0.0)
    body = WeighedBody(ten, covariance, covariance, True, 9, error, Scale.__new__(Scale))
    known = body.identifiable
    assert known[9] == (share <= KNOWN)
    least = body.size
    assert known[:9].tolist() == (2.0 * std < least)[:9].tolist()
    if share > 0.5:
        assert not known.any()
