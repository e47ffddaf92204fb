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
    model = small_truth.model
    alone = rows_to_weigh(model, [one.loaded], one.conditioning)
    with_bare = rows_to_weigh(model, [one.loaded], one.conditioning, bare=[one.bare])
    return (alone, with_bare)


def _without_effects(calibration: Calibration) -> Calibration:
    parameters = calibration.parameters
    left = tuple(one for one in parameters if "friction" not in one.name)
    return replace(calibration, parameters=left, effects=(), covariance_factor=None)


def _body_of(ten: FloatArray, covariance: FloatArray) -> WeighedBody:
    error = RelativeError((), 0.0)
    scale = Scale.__new__(Scale)
    return WeighedBody(ten, covariance, covariance, True, 9, error, scale)


def _motion(position_rad: FloatArray, rate_hz: float) -> Motion:
    """The motion of positions, by differences between samples."""
    velocity = np.gradient(position_rad, axis=0) * rate_hz
    acceleration = np.gradient(velocity, axis=0) * rate_hz
    return Motion(position_rad, velocity, acceleration)


def _scores(cell: WeighedCell, found: WeighedBody) -> FloatArray:
    mass_kg = cell.body[-1]
    centre_m = cell.body[6:9] / mass_kg
    mass_score = (found.mass_kg - mass_kg) / found.mass_std_kg
    found_centre_m, std_m = found.centre_m
    centre_scores = (found_centre_m - centre_m) / std_m
    return np.concatenate(([mass_score], centre_scores))


@pytest.mark.slow
def test_errors_are_as_large_as_their_sigma(
    small_truth: Truth, cells: tuple[WeighedCell, ...]
) -> None:
    """`make weigh-study` counts a hundred cells."""
    model = small_truth.model
    scores_of_cells = []
    for cell in cells:
        for bare in ([], [cell.bare]):
            weighed = weigh(cell.calibration, model, [cell.loaded], cell.conditioning, bare=bare)
            scores_of_cells.append(_scores(cell, weighed))
    scores = np.array(scores_of_cells)
    mean_square = np.mean(scores**2)
    rms_scores = np.sqrt(mean_square)
    assert 0.5 < rms_scores < 1.6
    assert np.abs(scores).max() < 4.0


def test_without_the_effects_sigma_is_wide_and_the_residual_large(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh]
) -> None:
    calibration = cells[0].calibration
    with_effects = weigh_rows(calibration, rows[1])
    without = weigh_rows(_without_effects(calibration), rows[1])
    variances_with = np.diag(with_effects.moves_covariance)
    variances_without = np.diag(without.moves_covariance)
    variance_with = variances_with[-1]
    variance_without = variances_without[-1]
    assert variance_without > 1.3**2 * variance_with
    error_with = with_effects.error.axes[AXIS]
    error_without = without.error.axes[AXIS]
    assert error_without > 1.3 * error_with


@pytest.mark.parametrize("beside", [0, 1])
def test_an_error_of_the_calibration_is_in_sigma_as_it_is_in_the_body(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh], beside: int
) -> None:
    """A calibration whose only error is one direction:
    its share of σ is the shift that this error makes.
    """
    calibration = _without_effects(cells[0].calibration)
    gains = [one.value for one in calibration.gains]
    parameters = [one.value for one in calibration.parameters]
    values = np.array(gains + parameters)
    rng = np.random.default_rng(5)
    relative_error = 1e-4 * rng.standard_normal(len(values))
    sizes = np.maximum(np.abs(values), 1e-2)
    error = relative_error * sizes
    # Rows of a lower triangle, of which only the first column is not zero.
    root = []
    for index, value in enumerate(error):
        zeros = [0.0] * index
        root.append((float(value), *zeros))
    with_error = replace(calibration, covariance_factor=tuple(root))
    moved = _changed(calibration, values + error)

    certain = weigh_rows(with_error, rows[beside])
    at_values = weigh_rows(calibration, rows[beside])
    at_error = weigh_rows(moved, rows[beside])

    covariance_of_error = certain.covariance - certain.moves_covariance
    share = np.diag(covariance_of_error)
    shift = np.abs(at_error.values - at_values.values)
    smallest = 0.03 * float(shift.max())
    share_std = np.sqrt(np.abs(share))
    assert share_std == pytest.approx(shift, rel=0.03, abs=smallest)


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
    exact = weigh_rows(calibration, rows[beside])
    with_other_mass = weigh_rows(heavier, rows[beside])
    shift = np.abs(with_other_mass.values - exact.values)
    smallest = 0.02 * shift.max()
    payload_mass = reference.weighed_to(tolerance_kg)
    tolerant = replace(calibration, payload_mass=(payload_mass,))
    without_derivatives = replace(payload_mass, parameters_per_kg=())
    earlier = replace(calibration, payload_mass=(without_derivatives,))
    for known in (tolerant, earlier):
        found = weigh_rows(known, rows[beside])
        added = found.covariance - exact.covariance
        assert found.reference_covariance == pytest.approx(added)
        added_std = np.sqrt(np.diag(added))
        assert added_std == pytest.approx(shift, rel=0.05, abs=smallest)
        mass_std_kg = tolerance_kg / reference.mass_kg * exact.mass_kg
        assert found.mass_reference_std_kg == pytest.approx(mass_std_kg, rel=0.02)
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
        with_both = replace(calibration, payload_mass=both)
        found = weigh_rows(with_both, rows[0])
        assert found.reference_covariance == pytest.approx(alone.reference_covariance)
    assert alone.mass_reference_std_kg > 0.0


def _changed(calibration: Calibration, values: FloatArray) -> Calibration:
    count = len(calibration.gains)
    gains = []
    values_of_gains = values[:count]
    values_of_parameters = values[count:]
    for gain, value in zip(calibration.gains, values_of_gains, strict=True):
        gains.append(replace(gain, value=float(value)))
    parameters = []
    for parameter, value in zip(calibration.parameters, values_of_parameters, strict=True):
        parameters.append(replace(parameter, value=float(value)))
    return replace(
        calibration,
        gains=tuple(gains),
        parameters=tuple(parameters),
    )


def test_a_common_error_of_the_gains_scales_the_body_and_leaves_its_centre(
    cells: tuple[WeighedCell, ...], rows: tuple[RowsToWeigh, RowsToWeigh]
) -> None:
    """Without a covariance, σ of the gains is taken as such an error;
    the scatter of the moves is left alone.
    """
    plain = _without_effects(cells[0].calibration)
    larger_gains = []
    uncertain_gains = []
    for gain in plain.gains:
        value = 1.05 * gain.value
        std = 0.02 * abs(gain.value)
        larger_gains.append(replace(gain, value=value))
        uncertain_gains.append(replace(gain, std=std))
    scaled = replace(plain, gains=tuple(larger_gains))
    uncertain = replace(plain, gains=tuple(uncertain_gains))

    exact = weigh_rows(plain, rows[1])
    heavier = weigh_rows(scaled, rows[1])
    found = weigh_rows(uncertain, rows[1])

    scaled_kg = 1.05 * exact.mass_kg
    assert heavier.mass_kg == pytest.approx(scaled_kg, rel=1e-3)
    centre_m, _ = exact.centre_m
    centre_of_heavier_m, _ = heavier.centre_m
    assert centre_of_heavier_m == pytest.approx(centre_m, abs=1e-5)
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
    model = small_truth.model
    first = weigh(calibration, model, [cell.loaded], cell.conditioning)
    second = weigh(calibration, model, [changed_loaded], cell.conditioning)
    assert first.values.tolist() == second.values.tolist()


def test_a_swing_of_the_last_joint_shows_a_part_and_says_what_would_show_the_rest(
    small_truth: Truth, cells: tuple[WeighedCell, ...]
) -> None:
    cell = cells[0]
    model = small_truth.model
    rng = np.random.default_rng(1)
    swing = noisy_run(small_truth, "swing", rng, None, 24.0)
    calm = _only_last(small_truth, swing)
    loaded = _recorded(small_truth, calm, cell.body)
    calibration = _without_effects(cell.calibration)
    found = weigh(calibration, model, [loaded], cell.conditioning)
    identifiable = found.identifiable.tolist()
    seen = dict(zip(LINK_PARAMETERS, identifiable, strict=True))
    assert not seen["m"]
    centre_m, _ = found.centre_m
    centre_is_unknown = np.isnan(centre_m).all()
    assert np.isnan(found.mass_kg) == centre_is_unknown
    assert seen["mx"] or seen["mz"]  # the weight's lever about the last joint

    def extra(words: str, run: Run) -> ExtraMoves:
        rate_hz = run.rate_hz / 5.0
        motion = _motion(run.position_rad[::5], rate_hz)
        is_moving = np.abs(motion.velocity_rad_s) > 0.03
        excitation = Excitation(motion, is_moving.T)
        return ExtraMoves(words, 24.0, excitation)

    everything = extra("all axes", cell.loaded)
    same = extra("more of the same", calm)
    helping = moves_that_help(found, [same, everything])
    (of_mass,) = [one for one in helping if one.name == "m"]
    assert of_mass.words == "all axes"
    mass_kg = cell.body[-1]
    assert 2.0 * of_mass.std < mass_kg
    helping = moves_that_help(found, [same])
    helped_names = {one.name for one in helping}
    assert "m" not in helped_names
    assert moves_that_help(found, []) == ()


def _only_last(truth: Truth, run: Run) -> Run:
    still = run.position_rad.copy()
    still[:, :-1] = 0.3
    return replace(run, position_rad=still)


def _recorded(truth: Truth, run: Run, body: FloatArray) -> Run:
    """The run with the currents that its motion needs."""
    motion = _motion(run.position_rad, run.rate_hz)
    parameters = truth.parameters.copy()
    parameters[truth.model.flange] += body
    torque = truth.model.torques(motion, parameters)[2]
    rng = np.random.default_rng(2)
    noise_a = 0.02 * rng.standard_normal(torque.shape)
    motor_torque = truth.model.drive_train.to_motor @ torque
    predicted_a = motor_torque.T / truth.gains
    current_a = predicted_a + noise_a.T
    return replace(run, current_a=current_a)


def test_too_little_is_refused(small_truth: Truth, cells: tuple[WeighedCell, ...]) -> None:
    cell = cells[0]
    with pytest.raises(DataUnfit, match="no run with the body"):
        weigh(cell.calibration, small_truth.model, [], cell.conditioning)
    end = round(6.0 * cell.loaded.rate_hz)
    names = ("time_s", "position_rad", "current_a")
    arrays = {}
    for name in names:
        samples = getattr(cell.loaded, name)
        arrays[name] = samples[:end]
    short = replace(cell.loaded, **arrays)
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
    centre, centre_std = found.centre_m
    inertia, inertia_std = found.inertia_kg_m2
    upper = np.triu_indices(3)
    body = body_of(ten)
    near = body_of(ten + step)

    x, y, z = body.centre_m
    quarter_turn_about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    translation_m = np.array([0.4, 0.1, 0.0])
    frame = Place(0, quarter_turn_about_z, translation_m)
    placed, placed_std = found.centre_in(frame)
    x_in_frame = y - 0.1
    y_in_frame = 0.4 - x
    assert placed == pytest.approx([x_in_frame, y_in_frame, z])
    std_in_frame = centre_std[[1, 0, 2]]
    assert placed_std == pytest.approx(std_in_frame)

    without_mz = ten.copy()
    without_mz[8] = np.nan
    planar = replace(found, values=without_mz)
    placed, _ = planar.centre_in(frame)
    assert placed == pytest.approx([x_in_frame, y_in_frame, np.nan], nan_ok=True)

    assert centre == pytest.approx(body.centre_m)
    inertia_kg_m2 = body.inertia_kg_m2[upper]
    assert inertia == pytest.approx(inertia_kg_m2, abs=1e-12)
    centre_step_m = np.abs(near.centre_m - body.centre_m)
    assert centre_std == pytest.approx(centre_step_m, rel=1e-2, abs=1e-9)
    near_kg_m2 = near.inertia_kg_m2[upper]
    inertia_step_kg_m2 = np.abs(near_kg_m2 - inertia_kg_m2)
    assert inertia_std == pytest.approx(inertia_step_kg_m2, rel=1e-2, abs=1e-9)

    without_mx = ten.copy()
    without_mx[6] = np.nan
    lost = replace(found, values=without_mx)
    centre, _ = lost.centre_m
    assert np.isnan(centre).tolist() == [True, False, False]


def test_a_parameter_with_a_long_lever_is_identified_though_a_compact_body_has_less() -> None:
    """Izz of 5 kg, 0.45 m from the joint, known to 2 %:
    twice σ is more than a steel cube of that mass has.
    """
    nan = np.nan
    ten = np.array([nan, nan, nan, nan, nan, 1.0, 2.2, 0.01, nan, 5.0])
    names = np.array(LINK_PARAMETERS)

    def identified(std_of_izz: float) -> list[str]:
        std = np.where(np.isnan(ten), nan, 0.01)
        std[5] = std_of_izz
        covariance = np.diag(std**2)
        body = _body_of(ten, covariance)
        found: list[str] = names[body.identifiable].tolist()
        return found

    std_of_izz = 0.02
    volume_of_cube_m3 = 5.0 / 7850.0
    side_of_cube_m = volume_of_cube_m3 ** (1.0 / 3.0)
    inertia_of_cube = 5.0 * side_of_cube_m**2
    assert 2.0 * std_of_izz > inertia_of_cube
    # `my` is near zero, and known to less than the cube's
    assert identified(std_of_izz) == ["Izz", "mx", "my", "m"]
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
    body = _body_of(ten, covariance)
    known = body.identifiable
    assert known[9] == (share <= KNOWN)
    is_precise = 2.0 * std < body.size
    others_known = known[:9].tolist()
    assert others_known == is_precise[:9].tolist()
    if share > 0.5:
        assert not known.any()
