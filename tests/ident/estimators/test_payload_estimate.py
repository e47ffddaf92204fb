"""A payload found with given gains, and several payloads, mountings and runs in one identification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.run import Run
from ident.equations.reduction import Reduction, reduce_runs
from ident.errors import DataUnfit, RankDeficient, TooFewMoves
from ident.estimators.identify import Identification, estimate_with, identify
from ident.estimators.least_squares import wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.estimators.payload_estimate import as_one_body, joined, payload_beside_bare_runs, payload_on_known_robot
from ident.model.bodies import LINK_PARAMETERS, Payload
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, PAYLOAD_TRUTH, Truth, record

OTHER_MOUNTING = dict(
    zip(LINK_PARAMETERS, (0.06, 0.004, -0.01, 0.07, 0.012, 0.04, 0.21, -0.11, 0.30, 4.59), strict=True)
)
"""The same disc, turned and put elsewhere."""
PLATE = dict(zip(LINK_PARAMETERS, (0.013, -0.001, 0.003, 0.014, 0.002, 0.01, 0.05, 0.03, 0.1, 1.686), strict=True))


def _reduced(truth: Truth, *runs: Run) -> Reduction:
    speeds_rad_s = CONDITIONING.standstill_rad_s[: len(truth.gains)]
    return reduce_runs(truth.model, runs, replace(CONDITIONING, standstill_rad_s=speeds_rad_s))


def _record(
    truth: Truth, name: str, rng: np.random.Generator, payload: Payload | None, body: dict[str, float] | None
) -> Run:
    """A run with any body: `record` mounts the one of PAYLOAD_TRUTH, so the last link makes up the difference."""
    parameters = truth.parameters.copy()
    if body is not None:
        parameters[truth.model.flange] += [body[name] - PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS]
    return record(replace(truth, parameters=parameters), name, rng, payload, noise_a=0.1)


@pytest.fixture(scope="module")
def mixed(truth: Truth) -> tuple[Run, ...]:
    """Two runs without load; the disc in two mountings and the plate, two runs of each."""
    rng = np.random.default_rng(21)
    bodies: list[tuple[Payload | None, dict[str, float] | None]] = [
        (None, None),
        (MOUNTED, PAYLOAD_TRUTH),
        (Payload("disc", "b", {"m": 4.59}), OTHER_MOUNTING),
        (Payload("plate", "c"), PLATE),
    ]
    return tuple(
        _record(truth, f"{payload.mounting if payload else 'bare'}{index}", rng, payload, body)
        for index in range(2)
        for payload, body in bodies
    )


@pytest.fixture(scope="module")
def identified(truth: Truth, mixed: tuple[Run, ...]) -> Identification:
    """All of them together."""
    return identify(truth.model, mixed, CONDITIONING)


@pytest.fixture(scope="module")
def parts(truth: Truth, mixed: tuple[Run, ...]) -> tuple[Reduction, ...]:
    """Each of them alone."""
    return tuple(_reduced(truth, run) for run in mixed)


def test_each_mounting_has_its_own_unknowns(identified: Identification) -> None:
    """Disc twice, plate once, runs of each in any order; the plate's mass is unknown and is found."""
    found = identified.estimate
    assert found.gains == pytest.approx(GAINS, rel=0.01)
    values = dict(zip((column.name for column in found.unknowns), found.parameters, strict=True))
    assert len(values) == 61 + 9 + 9 + 10
    for mounting, body in (("a", PAYLOAD_TRUTH), ("b", OTHER_MOUNTING), ("c", PLATE)):
        for name in ("mx", "my", "mz"):
            assert values[f"{name}:{mounting}"] == pytest.approx(body[name], abs=0.01)
    assert values["m:c"] == pytest.approx(1.686, rel=0.01)
    assert "m:a" not in values


def test_one_unknown_vector_for_two_mountings_ruins_the_gains(parts: tuple[Reduction, ...]) -> None:
    """Why a mounting has a name: the disc turned, and declared as if it had not been."""
    runs = [part for part in parts if not part.payloads or part.payloads[0].name == "disc"]
    confused = [replace(part, payloads=(MOUNTED,)) if part.payloads else part for part in runs]
    right, wrong = (
        np.max(np.abs(ml(r.system(r.base(), r.payload_columns())).gains / GAINS - 1.0))
        for r in (joined(runs), joined(confused))
    )
    assert right < 0.01
    assert wrong > 5.0 * right


@pytest.mark.parametrize("names", [("m",), ("m", "mx", "my", "mz"), LINK_PARAMETERS], ids=len)
def test_more_knowledge_is_used(truth: Truth, clean_runs: tuple[Run, ...], names: tuple[str, ...]) -> None:
    """n_kL of eq. (5) from one to ten: what is known is not estimated, and all of it is consistent."""
    payload = Payload("disc", "a", {name: PAYLOAD_TRUTH[name] for name in names})
    runs = (clean_runs[0], replace(clean_runs[1], payload=payload))
    system = identify(truth.model, runs, CONDITIONING).system
    for method in (Method.WLS, Method.TLS, Method.ML):
        found = estimate_with(method, system)
        assert found.gains == pytest.approx(GAINS, rel=2e-4)
        unknown = {column.name for column in found.unknowns if ":" in column.name}
        assert unknown == {f"{name}:a" for name in LINK_PARAMETERS if name not in names}


def test_a_mass_is_found_with_its_uncertainty(parts: tuple[Reduction, ...]) -> None:
    bare = joined([part for part in parts if not part.payloads])
    for part in parts:
        if not part.payloads:
            continue
        mass = 1.686 if part.payloads[0].name == "plate" else 4.59
        found = payload_beside_bare_runs(bare, part, GAINS)
        assert abs(found.mass_kg - mass) < 4.0 * found.mass_std_kg
        assert 0.0005 * mass < found.mass_std_kg < 0.01 * mass
        assert found.names == LINK_PARAMETERS


def test_the_claimed_sigma_covers_the_scatter(small_truth: Truth) -> None:
    """Over repetitions the mass scatters as much as each of them says; twelve show it within a factor of two."""
    rng = np.random.default_rng(7)
    runs = (record(small_truth, f"{index}", rng, MOUNTED if index else None, noise_a=0.3) for index in range(13))
    bare, *loaded = (_reduced(small_truth, run) for run in runs)
    found = [payload_beside_bare_runs(bare, one, small_truth.gains) for one in loaded]
    scatter = float(np.std([one.mass_kg for one in found], ddof=1))
    claimed = float(np.mean([one.mass_std_kg for one in found]))
    assert 0.5 < claimed / scatter < 2.5
    assert abs(float(np.mean([one.mass_kg for one in found])) - 4.59) < 3.0 * claimed


def test_a_common_error_of_the_gains_is_the_masss_error(parts: tuple[Reduction, ...]) -> None:
    bare, loaded = parts[:2]
    right, wrong = (payload_beside_bare_runs(bare, loaded, scale * GAINS) for scale in (1.0, 1.05))
    assert wrong.mass_kg == pytest.approx(1.05 * right.mass_kg, rel=1e-9)
    assert right.per_gain @ GAINS == pytest.approx(right.values, rel=1e-6)
    assert right.mass_std_with_gains_kg(0.02 * np.abs(GAINS)) >= 0.02 * right.mass_kg
    assert right.mass_std_with_gains_kg(np.zeros(6)) == pytest.approx(right.mass_std_kg)
    one = GAINS.copy()
    one[2] *= 1.01
    shifted = payload_beside_bare_runs(bare, loaded, one)
    assert shifted.mass_kg - right.mass_kg == pytest.approx(0.01 * GAINS[2] * right.per_gain[-1, 2], rel=0.1, abs=1e-3)


def test_on_a_known_robot_the_loaded_run_is_enough(truth: Truth, parts: tuple[Reduction, ...]) -> None:
    found = payload_on_known_robot(truth.parameters, parts[3], GAINS)
    assert found.mass_kg == pytest.approx(1.686, rel=0.01)
    wrong = truth.parameters.copy()
    wrong[truth.model.flange.start + LINK_PARAMETERS.index("m")] += 0.5
    lighter = payload_on_known_robot(wrong, parts[3], GAINS)
    assert lighter.mass_kg == pytest.approx(found.mass_kg - 0.5, abs=1e-6)


def test_reductions_are_joined_as_if_read_together(parts: tuple[Reduction, ...], identified: Identification) -> None:
    whole, other = joined(parts), identified.system
    one = whole.system(other.base, other.payload_columns)
    assert one.runs == other.runs
    assert one.payloads == other.payloads
    assert (whole.base().independent, whole.payload_columns()) == (other.base.independent, other.payload_columns)
    assert wls(one).gains == pytest.approx(wls(other).gains, rel=1e-8)
    assert one.joints.rows.tolist() == other.joints.rows.tolist()
    assert len(one.clusters) == len(other.clusters)
    other_weight = replace(parts[1], payloads=(Payload("disc", "a", {"m": 5.0}),))
    with pytest.raises(DataUnfit, match="in another run"):
        joined([parts[1], other_weight])


def test_as_one_body_the_payload_is_part_of_the_last_link(
    truth: Truth, mixed: tuple[Run, ...], parts: tuple[Reduction, ...]
) -> None:
    one = as_one_body(parts[1])
    same = _reduced(truth, replace(mixed[1], payload=None))
    systems = [r.system(same.base(), ()) for r in (one, same)]
    first, second = (wls(system, GAINS) for system in systems)
    assert first.parameters == pytest.approx(second.parameters, rel=1e-7, abs=1e-9)
    assert first.condition == pytest.approx(second.condition, rel=1e-7)


def test_what_cannot_be_weighed_is_refused(truth: Truth, parts: tuple[Reduction, ...]) -> None:
    bare, loaded, turned, *_ = parts
    with pytest.raises(RankDeficient, match="without load too"):
        payload_beside_bare_runs(loaded, loaded, GAINS)
    with pytest.raises(DataUnfit, match="one payload is weighed at a time"):
        payload_beside_bare_runs(loaded, turned, GAINS)
    with pytest.raises(DataUnfit, match="mountings none"):
        payload_on_known_robot(truth.parameters, bare, GAINS)
    short = record(truth, "short", np.random.default_rng(1), MOUNTED, seconds=4.0, noise_a=0.1)
    with pytest.raises(TooFewMoves):
        payload_on_known_robot(truth.parameters, _reduced(truth, short), GAINS)
