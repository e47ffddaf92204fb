"""Predicted standard deviations against what the estimator does,
and the verdicts drawn from them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.conditioning import decimator
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.estimators.identify import identify
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from ident.planning.excitation import (
    UNSEEN_PERCENT,
    Design,
    Excitation,
    Expectation,
    ExpectedPayload,
    effective_noise,
    recorded,
    visible_base,
)
from ident.planning.gain_verdict import ExtraMoves, GainSource, Visibility, verdicts
from ident.planning.target import recorded_information
from tests.ident.arms import TX40
from tests.ident.recordings import (
    CONDITIONING,
    GAINS,
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    record,
    tx40_truth,
)

FloatArray = NDArray[np.float64]

NOISE_A = 0.075
SEEDS = 12
RATE_HZ = 250.0
PAYLOAD = np.array([PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS])
BOTH_RUNS = (None, 0)  #: mountings of two runs: without a payload, and with the first


def _design(
    truth: Truth,
    known: frozenset[str] = frozenset({"m"}),
    gravity: tuple[float, ...] = (0, 0, -9.81),
) -> Design:
    gravity_m_s2 = np.array(gravity, dtype=np.float64)
    robot = replace(truth.model.robot, gravity_m_s2=gravity_m_s2)
    model = replace(truth.model, robot=robot)
    # White noise at 250 Hz, of which rows at 50 a second keep the band below 20 Hz: s²/5 for what
    # is slower.
    factor = decimator(RATE_HZ, CONDITIONING.decimation_cutoff_hz).factor
    noise = np.full(6, NOISE_A / np.sqrt(factor))
    payload = ExpectedPayload(known, PAYLOAD)
    expectation = Expectation(model, truth.gains, truth.parameters, (payload,), noise)
    rng = np.random.default_rng(5)
    motion = _motion(rng, 900)
    base = visible_base(model, motion)
    return Design(expectation, base)


def _uniform(rng: np.random.Generator, rows: int) -> FloatArray:
    """Random numbers between −1 and 1, shape (rows, 6)."""
    return rng.uniform(-1.0, 1.0, (6, rows)).T


def _motion(rng: np.random.Generator, rows: int, still: int | None = None) -> Motion:
    position = 2.0 * _uniform(rng, rows)
    velocity = 3.0 * _uniform(rng, rows)
    acceleration = 12.0 * _uniform(rng, rows)
    if still is not None:
        position[:, still] = 0.3
        velocity[:, still] = 0.0
        acceleration[:, still] = 0.0
    return Motion(position, velocity, acceleration)


def _excitation(rng: np.random.Generator, rows: int = 400, still: int | None = None) -> Excitation:
    motion = _motion(rng, rows, still)
    is_moving = motion.velocity_rad_s.T != 0.0
    return Excitation(motion, is_moving)


def _excitation_of_seed(seed: int, rows: int) -> Excitation:
    rng = np.random.default_rng(seed)
    return _excitation(rng, rows)


def _std_percent(
    design: Design, excitation: Excitation, mountings: tuple[int | None, ...] = BOTH_RUNS
) -> FloatArray:
    """Deviations of the gains by runs of one excitation [%]."""
    information = design.information(excitation, mountings)
    return design.std_percent(information)


def _with_noise(design: Design, factor: float) -> Design:
    """The design with noise times a factor."""
    noise_a = factor * design.expectation.noise_a
    expectation = replace(design.expectation, noise_a=noise_a)
    return Design(expectation, design.base)


def _torque(regressor: FloatArray, parameters: FloatArray) -> FloatArray:
    """Torque of the joints, shape (n, k)."""
    return np.asarray(np.einsum("jck,c->jk", regressor, parameters))


@pytest.mark.slow
def test_predicted_deviations_are_those_of_the_estimator(truth: Truth) -> None:
    rng = np.random.default_rng(21)
    bare = record(truth, "bare", rng, None, seconds=15.0, rate_hz=RATE_HZ)
    loaded = record(truth, "loaded", rng, MOUNTED, seconds=15.0, rate_hz=RATE_HZ)
    design = _design(truth)
    information = np.zeros(())
    for run, mounting in ((bare, None), (loaded, 0)):
        data = differentiate(run, truth.model.drive_train, CONDITIONING)
        excitation = recorded(truth.model, data, CONDITIONING)
        information = information + design.information(excitation, (mounting,))
    predicted = design.std_percent(information)

    errors = []
    for _ in range(SEEDS):
        noisy = [_with_current_noise(run, rng) for run in (bare, loaded)]
        gains = identify(truth.model, noisy, CONDITIONING).estimate.gains
        error_percent = 100.0 * (gains / GAINS - 1.0)
        errors.append(error_percent)

    error_rms = np.sqrt(np.mean(np.square(errors), axis=0))
    ratio = error_rms / predicted
    # 12 draws know a deviation to 20 %, all six together (the wrist gains go together) to some 12
    # %.
    rms_ratio = np.sqrt(np.mean(ratio**2))
    assert 0.7 < float(rms_ratio) < 1.3
    assert ratio.min() > 0.45
    assert ratio.max() < 1.6


def _with_current_noise(run: Run, rng: np.random.Generator) -> Run:
    noise_a = NOISE_A * rng.standard_normal(run.current_a.shape)
    return replace(run, current_a=run.current_a + noise_a)


def test_the_information_is_that_of_the_fits_own_equation() -> None:
    """J by finite differences of v = T τ(χ, χ_u)/g, in every unknown."""
    truth = tx40_truth()
    rng = np.random.default_rng(2)
    design = _design(truth)
    excitation = _excitation(rng, 40)
    regressor = truth.model.regressor(excitation.motion)
    of_base = regressor[:, list(design.base.independent)]
    of_payload = regressor[:, truth.model.flange]
    base = design.base.grouping @ truth.parameters
    unknown = list(design.expectation.payloads[0].unknown)
    start = np.concatenate((base, PAYLOAD[unknown], np.zeros(6)))
    to_motor = truth.model.drive_train.to_motor
    noise_a = design.expectation.noise_a

    def currents(values: FloatArray, loaded: bool) -> FloatArray:
        """Currents over their noise; values are base parameters, unknowns and ln gains."""
        base_values, payload_values, log_gains = np.split(values, [len(base), -6])
        torque = _torque(of_base, base_values)
        if loaded:
            payload = PAYLOAD.copy()
            payload[unknown] = payload_values
            torque += _torque(of_payload, payload)
        gains = GAINS * np.exp(log_gains)
        current_a = to_motor @ torque / gains[:, None]
        weighted = current_a / noise_a[:, None]
        return np.asarray(weighted.ravel())

    columns = []
    for column in range(len(start)):
        step = np.zeros(len(start))
        step[column] = 1e-5
        ahead = start + step
        behind = start - step
        bare = currents(ahead, loaded=False) - currents(behind, loaded=False)
        loaded = currents(ahead, loaded=True) - currents(behind, loaded=True)
        change = np.concatenate((bare, loaded))
        columns.append(change / 2e-5)
    jacobian = np.stack(columns, axis=1)
    by_differences = jacobian.T @ jacobian

    found = design.information(excitation, BOTH_RUNS)
    scale = np.sqrt(np.diag(found))
    scale_outer = np.outer(scale, scale)
    scaled = found / scale_outer
    assert by_differences / scale_outer == pytest.approx(scaled, abs=1e-6)


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), factor=st.floats(0.1, 10.0), times=st.integers(1, 5))
def test_deviations_scale_with_noise_and_repetition(seed: int, factor: float, times: int) -> None:
    truth = tx40_truth()
    design = _design(truth)
    louder = _with_noise(design, factor)
    rng = np.random.default_rng(seed)
    excitation = _excitation(rng)
    once = _std_percent(design, excitation)
    noisy = _std_percent(louder, excitation)
    information = design.information(excitation, BOTH_RUNS)
    often = design.std_percent(times * information)
    assert noisy == pytest.approx(factor * once, rel=1e-6)
    assert often == pytest.approx(once / np.sqrt(times), rel=1e-6)

    noisy_information = louder.information(excitation, BOTH_RUNS)
    rank = louder.rank(noisy_information)
    rank_of_many = louder.rank(times * noisy_information)
    assert 0 <= rank <= rank_of_many <= len(GAINS)
    # Each gain is a sum of independent directions with squares of weights that add up to one.
    rounding = 1e-9
    if rank >= len(GAINS):
        assert np.all(noisy <= UNSEEN_PERCENT * (1.0 + rounding))
    if rank <= 0:
        assert np.all(noisy > UNSEEN_PERCENT * (1.0 - rounding))

    # More moves never give less information.
    other = _excitation_of_seed(7, 20)
    more = information + design.information(other, BOTH_RUNS)
    by_more = design.std_percent(more)
    assert np.all(by_more <= once * (1.0 + rounding))


def test_recorded_information_is_the_sum_of_the_runs() -> None:
    design = _design(tx40_truth())
    bare = _excitation_of_seed(1, 60)
    loaded = _excitation_of_seed(2, 60)
    runs = [(bare, (None,)), (loaded, (0,))]
    found = recorded_information(design, runs)
    of_bare = design.information(bare, (None,))
    of_loaded = design.information(loaded, (0,))
    assert found == pytest.approx(of_bare + of_loaded)
    of_no_runs = recorded_information(design, [])
    assert not of_no_runs.any()


def test_correlated_rows_say_less() -> None:
    noise_a = np.ones(2)
    assert effective_noise(noise_a, 0.0) == pytest.approx([1.0, 1.0])
    # The mean of a long first-order autoregression, by its definition: Σ_k ρ^|k| times the
    # variance.
    rho = 0.67
    correlations = [rho**k for k in range(1, 200)]
    summed = 1.0 + 2.0 * sum(correlations)
    effective = effective_noise(np.ones(1), rho)
    assert effective[0] ** 2 == pytest.approx(summed)


def test_without_a_known_payload_no_gain_is_seen() -> None:
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    excitation = _excitation(rng)
    of_unknown = _std_percent(_design(truth, frozenset()), excitation)
    assert np.isinf(of_unknown).all()
    of_bare_runs = _std_percent(_design(truth), excitation, (None,))
    assert np.isinf(of_bare_runs).all()


def test_a_gain_whose_axis_never_moves_is_not_seen() -> None:
    truth = tx40_truth()
    design = _design(truth)
    rng = np.random.default_rng(1)
    excitation = _excitation(rng, still=3)
    found = _std_percent(design, excitation)
    assert np.isinf(found[3])
    runs = [(excitation, BOTH_RUNS)]
    fourth = verdicts(design, runs).gains[3]
    assert fourth.verdict is Visibility.UNSEEN
    assert "not identifiable" in fourth.words("J4")


def test_axis_1_upright_is_identifiable_only_through_inertia_and_on_a_wall_through_gravity() -> (
    None
):
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    excitation = _excitation(rng)
    runs = [(excitation, BOTH_RUNS)]
    upright = verdicts(_design(truth), runs).gains[0]
    assert not upright.gravity_acts
    by_gravity = upright.alone_percent[GainSource.GRAVITY]
    assert np.isinf(by_gravity)
    assert "identifiable only through inertia" in upright.words("J1")

    gravity = (9.81, 0.0, 0.0)
    design = _design(truth, gravity=gravity)
    wall = verdicts(design, runs).gains[0]
    assert wall.gravity_acts
    by_gravity = wall.alone_percent[GainSource.GRAVITY]
    assert np.isfinite(by_gravity)
    assert "only through inertia" not in wall.words("J1")


def test_no_source_alone_is_better_than_all_of_them() -> None:
    design = _design(tx40_truth())
    rng = np.random.default_rng(4)
    runs = [(_excitation(rng), BOTH_RUNS)]
    for gain in verdicts(design, runs).gains:
        assert gain.sources
        least_percent = gain.std_percent * (1.0 - 1e-9)
        for alone_percent in gain.alone_percent.values():
            assert alone_percent >= least_percent


def test_the_advice_is_the_best_of_what_was_tried_and_says_what_it_gives() -> None:
    design = _design(tx40_truth())
    weak = _with_noise(design, 100.0)
    excitation = _excitation_of_seed(1, 100)
    extras = []
    for rows in (30, 300, 60):
        moves = _excitation_of_seed(rows, rows)
        extras.append(ExtraMoves(f"{rows} rows", 5.0, moves))
    runs = [(excitation, BOTH_RUNS)]

    judged = verdicts(weak, runs, extras).gains

    information = weak.information(excitation, BOTH_RUNS)
    best = extras[1].excitation
    added = information + weak.information(best, BOTH_RUNS)
    expected_percent = weak.std_percent(added)
    for gain in judged:
        assert gain.advice is not None
        assert gain.advice.words == "300 rows"
        assert gain.advice.std_percent == pytest.approx(expected_percent[gain.axis])
        assert "add 5 s of 300 rows" in gain.words("J")


def test_two_mountings_have_unknowns_of_their_own() -> None:
    design = _design(tx40_truth())
    payload = design.expectation.payloads[0]
    expectation = replace(design.expectation, payloads=(payload, payload))
    two = Design(expectation, design.base)
    expected = design.others + 9
    assert two.others == expected
    rng = np.random.default_rng(1)
    excitation = _excitation(rng)
    shared = _std_percent(design, excitation, (None, 0, 0))
    apart = _std_percent(two, excitation, (None, 0, 1))
    assert np.all(apart >= shared * (1.0 - 1e-9))
    disc = Payload("disc", "a", {"m": 4.59})
    assert disc.known.keys() == payload.known


def test_base_parameters_of_the_geometry_do_not_depend_on_the_motion() -> None:
    robot = robot_from_urdf(TX40.urdf)
    drive_train = tx40_truth().model.drive_train
    model = Model(robot, drive_train)
    found = set()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        motion = _motion(rng, 700)
        base = visible_base(model, motion)
        found.add(base.independent)
    (independent,) = found
    assert len(independent) == 61


def test_what_a_payload_adds_to_friction_is_seen_in_loaded_runs_alone(truth: Truth) -> None:
    model = replace(truth.model, friction_by_payload=True)
    rng = np.random.default_rng(21)
    bare_run = record(truth, "run0", rng, None, seconds=8.0)
    loaded_run = record(truth, "run1", rng, MOUNTED, seconds=8.0)
    base = identify(model, [bare_run, loaded_run], CONDITIONING, judge=False).system.base
    loaded_columns = model.loaded_friction_columns
    of_payload = np.zeros(len(loaded_columns))
    parameters = np.concatenate((truth.parameters, of_payload))
    noise = np.full(6, NOISE_A)
    known = frozenset({"m"})
    payload = ExpectedPayload(known, PAYLOAD)
    expectation = Expectation(model, truth.gains, parameters, (payload,), noise)
    design = Design(expectation, base)
    payload_friction = np.flatnonzero(np.isin(base.independent, loaded_columns))
    assert len(payload_friction) == len(loaded_columns)
    excitation = _excitation(rng)
    bare = design.information(excitation, (None,))
    loaded = design.information(excitation, (0,))
    assert not bare[payload_friction].any()
    of_friction = np.diag(loaded)[payload_friction]
    assert np.all(of_friction > 0.0)
    both = bare + loaded
    for seen in (bare, loaded, both):
        assert np.isfinite(design.condition(seen))
    by_both = design.std_percent(both)
    assert np.isfinite(by_both).all()
