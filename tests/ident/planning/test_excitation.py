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
from ident.data.dataset import Dataset, differentiate
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
    noise = np.full(
        6, NOISE_A / np.sqrt(decimator(RATE_HZ, CONDITIONING.decimation_cutoff_hz).factor)
    )
    payloads = (ExpectedPayload(known, PAYLOAD),)
    expectation = Expectation(model, truth.gains, truth.parameters, payloads, noise)
    rng = np.random.default_rng(5)
    motion = _motion(rng, 900)
    return Design(expectation, visible_base(model, motion))


def _motion(rng: np.random.Generator, rows: int, still: int | None = None) -> Motion:
    position, velocity, acceleration = (
        scale * rng.uniform(-1.0, 1.0, (6, rows)).T for scale in (2.0, 3.0, 12.0)
    )
    if still is not None:
        position[:, still], velocity[:, still], acceleration[:, still] = 0.3, 0.0, 0.0
    return Motion(position, velocity, acceleration)


def _excitation(rng: np.random.Generator, rows: int = 400, still: int | None = None) -> Excitation:
    motion = _motion(rng, rows, still)
    return Excitation(motion, motion.velocity_rad_s.T != 0.0)


def _data(truth: Truth, runs: tuple[Run, ...]) -> list[Dataset]:
    return [differentiate(run, truth.model.drive_train, CONDITIONING) for run in runs]


@pytest.mark.slow
def test_predicted_deviations_are_those_of_the_estimator(truth: Truth) -> None:
    rng = np.random.default_rng(21)
    clean = tuple(
        record(truth, name, rng, load, seconds=15.0, rate_hz=RATE_HZ)
        for name, load in (("bare", None), ("loaded", MOUNTED))
    )
    design = _design(truth)
    excitations = [recorded(truth.model, data, CONDITIONING) for data in _data(truth, clean)]
    informations = [
        design.information(e, (p,)) for e, p in zip(excitations, (None, 0), strict=True)
    ]
    predicted = design.std_percent(np.sum(informations, axis=0))
    errors = []
    for _ in range(SEEDS):
        noisy = [
            replace(
                run, current_a=run.current_a + NOISE_A * rng.standard_normal(run.current_a.shape)
            )
            for run in clean
        ]
        gains = identify(truth.model, noisy, CONDITIONING).estimate.gains
        errors.append(100.0 * (gains / GAINS - 1.0))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / predicted
    # 12 draws know a deviation to 20 %, all six together (the wrist gains go together) to some 12
    # %.
    rms_ratio = np.sqrt(np.mean(ratio**2))
    assert 0.7 < float(rms_ratio) < 1.3
    assert ratio.min() > 0.45
    assert ratio.max() < 1.6


def test_the_information_is_that_of_the_fits_own_equation() -> None:
    """J by finite differences of v = T τ(χ, χ_u)/g, in every unknown."""
    truth = tx40_truth()
    rng = np.random.default_rng(2)
    design = _design(truth)
    excitation = _excitation(rng, 40)
    regressor = truth.model.regressor(excitation.motion)
    independent = list(design.base.independent)
    base = design.base.grouping @ truth.parameters
    unknown = list(design.expectation.payloads[0].unknown)
    start = np.concatenate((base, PAYLOAD[unknown], np.zeros(6)))

    def currents(values: FloatArray, loaded: bool) -> FloatArray:
        payload = PAYLOAD.copy()
        payload[unknown] = values[len(base) : len(base) + len(unknown)]
        torque = np.einsum("jck,c->jk", regressor[:, independent], values[: len(base)])
        if loaded:
            torque += np.einsum("jck,c->jk", regressor[:, truth.model.flange], payload)
        gains = GAINS * np.exp(values[-6:])
        to_motor = truth.model.drive_train.to_motor
        weighted = to_motor @ torque / gains[:, None] / design.expectation.noise_a[:, None]
        return np.asarray(weighted.ravel())

    jacobian = np.zeros((2 * 6 * 40, len(start)))
    for column in range(len(start)):
        step = np.zeros(len(start))
        step[column] = 1e-5
        both = [
            currents(start + step, loaded) - currents(start - step, loaded)
            for loaded in (False, True)
        ]
        jacobian[:, column] = np.concatenate(both) / 2e-5
    found = design.information(excitation, (None, 0))
    scale = np.sqrt(np.diag(found))
    scale_outer = np.outer(scale, scale)
    assert jacobian.T @ jacobian / scale_outer == pytest.approx(
        found / np.outer(scale, scale), abs=1e-6
    )


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), factor=st.floats(0.1, 10.0), times=st.integers(1, 5))
def test_deviations_scale_with_noise_and_repetition(seed: int, factor: float, times: int) -> None:
    truth = tx40_truth()
    design = _design(truth)
    noise_a = factor * design.expectation.noise_a
    expectation = replace(design.expectation, noise_a=noise_a)
    louder = Design(expectation, design.base)
    rng = np.random.default_rng(seed)
    excitation = _excitation(rng)
    once = design.std_percent(design.information(excitation, (None, 0)))
    noisy = louder.std_percent(louder.information(excitation, (None, 0)))
    often = design.std_percent(times * design.information(excitation, (None, 0)))
    assert noisy == pytest.approx(factor * once, rel=1e-6)
    assert often == pytest.approx(once / np.sqrt(times), rel=1e-6)
    information = louder.information(excitation, (None, 0))
    rank = louder.rank(information)
    assert 0 <= rank <= louder.rank(times * louder.information(excitation, (None, 0))) <= len(GAINS)
    # Each gain is a sum of independent directions with squares of weights that add up to one.
    assert rank < len(GAINS) or (noisy <= UNSEEN_PERCENT * (1.0 + 1e-9)).all()
    assert rank > 0 or (noisy > UNSEEN_PERCENT * (1.0 - 1e-9)).all()
    # More moves never give less information.
    more = design.information(excitation, (None, 0)) + design.information(
        _excitation(np.random.default_rng(7), 20), (None, 0)
    )
    assert (design.std_percent(more) <= once * (1.0 + 1e-9)).all()


def test_recorded_information_is_the_sum_of_the_runs() -> None:
    design = _design(tx40_truth())
    rng = np.random.default_rng(1)
    bare = _excitation(rng, 60)
    loaded = _excitation(np.random.default_rng(2), 60)
    runs = [(bare, (None,)), (loaded, (0,))]
    found = recorded_information(design, runs)
    expected = design.information(bare, (None,)) + design.information(loaded, (0,))
    assert found == pytest.approx(expected)
    assert not recorded_information(design, []).any()


def test_correlated_rows_say_less() -> None:
    noise_a = np.ones(2)
    assert effective_noise(noise_a, 0.0) == pytest.approx([1.0, 1.0])
    # The mean of a long first-order autoregression, by its definition: Σ_k ρ^|k| times the
    # variance.
    rho = 0.67
    summed = 1.0 + 2.0 * sum(rho**k for k in range(1, 200))
    assert effective_noise(np.ones(1), rho)[0] ** 2 == pytest.approx(summed)


def test_without_a_known_payload_no_gain_is_seen() -> None:
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    excitation = _excitation(rng)
    for design, payloads in (
        (_design(truth, frozenset()), (None, 0)),
        (_design(truth), (None,)),
    ):
        assert np.isinf(design.std_percent(design.information(excitation, payloads))).all()


def test_a_gain_whose_axis_never_moves_is_not_seen() -> None:
    truth = tx40_truth()
    design = _design(truth)
    rng = np.random.default_rng(1)
    excitation = _excitation(rng, still=3)
    found = design.std_percent(design.information(excitation, (None, 0)))
    assert np.isinf(found[3])
    runs = [(excitation, (None, 0))]
    judged = verdicts(design, runs).gains
    assert judged[3].verdict is Visibility.UNSEEN
    assert "not identifiable" in judged[3].words("J4")


def test_axis_1_upright_is_identifiable_only_through_inertia_and_on_a_wall_through_gravity() -> (
    None
):
    truth = tx40_truth()
    rng = np.random.default_rng(1)
    excitation = _excitation(rng)
    gains = verdicts(_design(truth), [(excitation, (None, 0))]).gains
    upright = gains[0]
    assert not upright.gravity_acts
    assert np.isinf(upright.alone_percent[GainSource.GRAVITY])
    assert "identifiable only through inertia" in upright.words("J1")
    gravity = (9.81, 0.0, 0.0)
    design = _design(truth, gravity=gravity)
    runs = [(excitation, (None, 0))]
    wall = verdicts(design, runs).gains[0]
    assert wall.gravity_acts
    assert np.isfinite(wall.alone_percent[GainSource.GRAVITY])
    assert "only through inertia" not in wall.words("J1")


def test_no_source_alone_is_better_than_all_of_them() -> None:
    design = _design(tx40_truth())
    rng = np.random.default_rng(4)
    runs = [(_excitation(rng), (None, 0))]
    for gain in verdicts(design, runs).gains:
        assert all(
            alone >= gain.std_percent * (1.0 - 1e-9) for alone in gain.alone_percent.values()
        )
        assert gain.sources


def test_the_advice_is_the_best_of_what_was_tried_and_says_what_it_gives() -> None:
    design = _design(tx40_truth())
    noise_a = 100.0 * design.expectation.noise_a
    expectation = replace(design.expectation, noise_a=noise_a)
    weak = Design(expectation, design.base)
    rng = np.random.default_rng(1)
    excitation = _excitation(rng, 100)
    extras = [
        ExtraMoves(f"{rows} rows", 5.0, _excitation(np.random.default_rng(rows), rows))
        for rows in (30, 300, 60)
    ]
    runs = [(excitation, (None, 0))]
    judged = verdicts(weak, runs, extras).gains
    for gain in judged:
        assert gain.advice is not None
        assert gain.advice.words == "300 rows"
        added = weak.information(excitation, (None, 0)) + weak.information(
            extras[1].excitation, (None, 0)
        )
        assert gain.advice.std_percent == pytest.approx(weak.std_percent(added)[gain.axis])
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
    shared = design.std_percent(design.information(excitation, (None, 0, 0)))
    apart = two.std_percent(two.information(excitation, (None, 0, 1)))
    assert (apart >= shared * (1.0 - 1e-9)).all()
    assert Payload("disc", "a", {"m": 4.59}).known.keys() == payload.known


def test_base_parameters_of_the_geometry_do_not_depend_on_the_motion() -> None:
    robot = robot_from_urdf(TX40.urdf)
    drive_train = tx40_truth().model.drive_train
    model = Model(robot, drive_train)
    found = {
        visible_base(model, _motion(np.random.default_rng(seed), 700)).independent
        for seed in range(4)
    }
    assert len(found) == 1
    assert len(found.pop()) == 61


def test_what_a_payload_adds_to_friction_is_seen_in_loaded_runs_alone(truth: Truth) -> None:
    model = replace(truth.model, friction_by_payload=True)
    rng = np.random.default_rng(21)
    runs = [
        record(truth, f"run{number}", rng, payload, seconds=8.0)
        for number, payload in enumerate((None, MOUNTED))
    ]
    system = identify(model, runs, CONDITIONING, judge=False).system
    base = system.base
    parameters = np.concatenate((truth.parameters, np.zeros(len(model.loaded_friction_columns))))
    noise = np.full(6, NOISE_A)
    known = frozenset({"m"})
    payload = ExpectedPayload(known, PAYLOAD)
    expectation = Expectation(model, truth.gains, parameters, (payload,), noise)
    design = Design(expectation, base)
    payload_friction = np.flatnonzero(np.isin(base.independent, model.loaded_friction_columns))
    assert len(payload_friction) == len(model.loaded_friction_columns)
    excitation = _excitation(rng)
    bare = design.information(excitation, (None,))
    loaded = design.information(excitation, (0,))
    assert not bare[payload_friction].any()
    assert np.all(np.diag(loaded)[payload_friction] > 0.0)
    for seen in (bare, loaded, bare + loaded):
        assert np.isfinite(design.condition(seen))
    assert np.isfinite(design.std_percent(bare + loaded)).all()
