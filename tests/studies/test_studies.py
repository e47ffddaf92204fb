"""The tools of the studies: what is kept comes back, shards are the whole,
blind cells are what they say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from math import radians
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.effects import build_effect
from drivers.simulation.plant import Plant
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.discovery.evidence import Evidence
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect
from ident.effects.electrical import Lag
from ident.effects.geometry_corrections import ZeroOffset
from ident.effects.position import Spring
from tests.conftest import CHECKOUT
from tests.studies.any_robot import ROBOTS, StudiedRobot, figures, pooled
from tests.studies.blind_cells import FAMILIES, NOTHING, blind_cases, confusion
from tests.studies.chain_effects import PLANTED, PlantedEffect
from tests.studies.direct_cell import RawRun, demand_rad, run_of
from tests.studies.fingerprint import finish, is_finished, made_once
from tests.studies.followed_cell import follow, without_rest
from tests.studies.kept_rows import pack, unpack
from tests.studies.planted_mistakes import Mistake, Planted, judge_mistake, plant, tilted
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.regions import (
    PARTS,
    independent_sums,
    judge_rise,
    region_of,
    split_by_region,
    two_sides,
)
from tests.studies.robot_tables import write_tables
from tests.studies.side_by_side import Shard
from tests.studies.study_cells import CORRELATION_S, WORLDS, declared_payload, spec_of, world_cell
from tests.studies.study_plans import CELL
from tests.studies.study_rows import finished_rows, from_csv, rows_of_unit, to_csv, work_off
from tests.studies.warm_up_study import (
    BARE_THEN_LOADED,
    BLOCK_S,
    CHANGE_S,
    GUIDED,
    PAUSE_S,
    start_times_s,
)


@settings(max_examples=25)
@given(count=st.integers(1, 9), tasks=st.integers(0, 40))
def test_the_shards_of_a_study_have_every_task_once(count: int, tasks: int) -> None:
    shards = [Shard(number, count).of(range(tasks)) for number in range(1, count + 1)]
    sorted_tasks = sorted(chain.from_iterable(shards))
    assert sorted_tasks == list(range(tasks))
    smallest = min(map(len, shards))
    largest_difference = max(map(len, shards)) - smallest
    assert largest_difference <= 1


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_a_studied_robot_has_a_weighed_payload_and_a_second_body_that_no_cell_declares(
    robot: StudiedRobot,
) -> None:
    path = CHECKOUT / f"configs/cells/{robot.cell}.yaml"
    cell = load_cell(path)
    simulation = CHECKOUT / f"configs/simulation/{robot.simulation}.yaml"
    assert robot.second not in {payload.name for payload in cell.payloads}
    first, second = (
        load_simulation(simulation, name).payload for name in (cell.payloads[0].name, robot.second)
    )
    assert first is not None
    assert second is not None
    assert first.mass_kg == cell.payloads[0].mass_kg
    assert second.mass_kg < 0.7 * first.mass_kg
    changed_robot = replace(robot, seconds=robot.seconds + 1.0)
    assert robot.fingerprint != changed_robot.fingerprint


def test_what_is_made_once_is_not_made_again(tmp_path: Path) -> None:
    def make(folder: Path) -> dict[str, int]:
        assert folder.is_dir()
        made.append(folder)
        return {"times": len(made)}

    made: list[Path] = []
    found = [made_once(tmp_path, "a", mark, make) for mark in ("one", "one", "two")]
    times = [one["times"] for one in found]
    assert times == [1, 1, 2]
    assert not made[0].exists()


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: planted.robot)
def test_a_planted_effect_exists_on_both_sides(planted: PlantedEffect) -> None:
    path = CHECKOUT / f"configs/cells/{planted.cell}.yaml"
    cell = load_cell(path)
    assert planted.place in cell.place_names
    assert planted.size in planted.effect.parameters.values()
    known = {family[0].name: family[0] for family in EFFECTS}[planted.name]
    assert planted.coefficient in {column.name for column in known.coefficients}
    spec = load_simulation(shipped_simulation(planted.cell))
    passive = tuple(name for name in cell.place_names if name not in cell.axis_names)
    build_effect(planted.effect, len(spec.axes), passive)


def test_the_figures_of_a_robot_are_over_all_its_gains_and_seeds() -> None:
    row = {"robot": "arm", "floor_percent": 3.0, "payload_std_percent": 0.2}
    errors = ({"J1": -0.5, "J2": 0.1}, 0.3), ({"J1": 0.2, "J2": 1.0}, -0.5)
    rows = [
        {**row, "seed": seed, "gain_error_percent": gains, "gain_std_percent": {"J1": 0.3, "J2": 0.3},  # noqa: E501
         "payload_error_percent": payload}
        for seed, (gains, payload) in enumerate(errors, start=1)
    ]  # fmt: skip
    found = figures(rows)
    assert found["mean_gain_error_percent"] == pytest.approx(0.45)
    assert found["worst_gain_error_percent"] == 1.0
    assert found["mean_payload_error_percent"] == pytest.approx(0.4)
    assert found["coverage_percent"] == 75.0
    assert pooled(rows) == {
        "gains": 4,
        "gain_coverage_percent": 75.0,
        "masses": 2,
        "mass_coverage_percent": 50.0,
    }


def test_the_tables_of_robots_show_identified_gains_and_masses(tmp_path: Path) -> None:
    masses = {}
    for role, kg in (("first_payload", 10.0), ("payload", 4.0)):
        for what, value in (("kg", kg), ("error_percent", -1.0), ("std_percent", 0.5)):
            masses[f"{role}_{what}"] = value  # fmt: skip
    row = {
        "robot": "arm", "seed": 1, "floor_percent": 3.0, "gain_unit": {"J1": "Nm/A"}, "nameplate_gain": {"J1": -20.0},  # noqa: E501
        "true_gain": {"J1": -25.0}, "gain_error_percent": {"J1": 4.0}, "gain_std_percent": {"J1": 2.6},  # noqa: E501
    }  # fmt: skip
    rows = [row | masses, {**row, **masses, "seed": 2, "gain_error_percent": {"J1": 0.0}}]
    write_tables(tmp_path, [figures(rows)], rows)
    last = {
        path.stem: path.read_text(encoding="utf-8").splitlines()[-1] for path in tmp_path.iterdir()
    }
    # -25 + 4 % is -26: 30 % more than the nameplate says, and 2.6 % of -25 are 2.5 % of -26.
    assert last["robots-gains"] == "arm,J1,Nm/A,-20,-26,2.50,30.00,4.00"
    assert last["robots-payloads"] == "arm,10,9.9,0.50,1.00,4,3.96,0.50,1.00"
    assert last["robots"] == "arm,1,3.0,2.00,4.00,1.00,1.00,100"


def test_runs_come_back_with_their_demand(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    cumulative = np.cumsum(rng.integers(-40_000, 40_000, (500, 6)), axis=0)
    position = cumulative.astype(np.int32)
    raw = RawRun(
        name="disc-1",
        payload=declared_payload("disc"),
        position_counts=position,
        demand_counts=position + rng.integers(-300, 300, position.shape).astype(np.int32),
        current_raw=rng.integers(-2000, 2000, (500, 6)).astype(np.int16),
        limited=rng.random((500, 6)) < 0.1,
        move=np.repeat(np.arange(5), 100),
        ampere_per_unit=rng.random(6),
        began_s=60.0,
    )
    path = tmp_path / "runs.npz"
    write_runs(path, [raw])
    runs_path = tmp_path / "runs.npz"
    (back,) = read_runs(runs_path)
    expected = (raw.name, raw.payload, raw.began_s)
    assert (back.name, back.payload, back.began_s) == expected
    for name in (
        "position_counts",
        "demand_counts",
        "current_raw",
        "limited",
        "move",
        "ampere_per_unit",
    ):
        np.testing.assert_array_equal(getattr(back, name), getattr(raw, name))


def test_a_cell_follows_a_demand_without_any_rest() -> None:
    cell = load_cell(CELL)
    spec = spec_of(world_cell(7, "loop3"), None, 0)
    rng = np.random.default_rng(1)
    demand = without_rest(cell, spec.start_rad, rng, 0.5)
    raw = follow(cell, spec, demand, "bare-1", None)
    recorded = run_of(raw, cell).position_rad
    # A sample is read at the end of its cycle
    asked = demand.position_rad[demand.first + 1 :][: len(recorded)]
    assert 490 <= len(recorded) <= 500
    difference = demand_rad(raw, cell) - asked
    largest_absolute_difference = np.max(np.abs(difference))
    assert largest_absolute_difference < 1e-3
    recorded_difference = np.abs(recorded - asked)
    assert np.max(recorded_difference) < 0.05
    recorded_steps = np.diff(recorded, axis=0)
    absolute_recorded_step = np.abs(recorded_steps)
    assert np.all(np.max(absolute_recorded_step, axis=1) > 1e-5)


def test_cells_of_one_seed_have_one_truth_in_every_world() -> None:
    cells = [world_cell(7, world).bare for world in WORLDS]
    assert len({cell.urdf for cell in cells}) == 1
    gains_of_cells = set()
    for cell in cells:
        gains_of_cells.add(tuple(axis.gain_nm_per_a for axis in cell.axes))
    assert len(gains_of_cells) == 1
    for cell, world in zip(cells, WORLDS.values(), strict=True):
        torque_disturbance_percent = {axis.torque_disturbance_percent for axis in cell.axes}
        assert torque_disturbance_percent == {world.disturbance_percent}
        times_s = [axis.disturbance_correlation_s for axis in cell.axes]
        assert CORRELATION_S[0] <= min(times_s) < max(times_s) <= CORRELATION_S[1]


def test_friction_differs_from_run_to_run_in_one_world_alone() -> None:
    cell = world_cell(7, "measurement")
    plain = spec_of(cell, None, 0)
    ratios = []
    for run in range(24):
        spec = spec_of(world_cell(7, "measurement"), None, run)
        assert spec.axes == plain.axes
        own = spec_of(world_cell(7, "runs"), None, run)
        ratios += [
            one.coulomb_nm / same.coulomb_nm for one, same in zip(own.axes, plain.axes, strict=True)
        ]
    assert np.std(ratios) == pytest.approx(0.02, rel=0.25)  # of 144 draws


@settings(max_examples=2)
@given(seed=st.integers(0, 2**31))
def test_blind_cells_are_the_same_however_many_are_drawn_and_can_be_built(seed: int) -> None:
    cases = blind_cases(seed, 3)
    assert blind_cases(seed, 2) == cases[:2]
    for case in cases:
        spec = case.spec("loop3", "disc", 1)
        Plant(spec)
        places = {(effect.name, effect.axis) for effect in case.effects}
        assert len(places) == len(case.effects) <= 3
        assert {effect.name for effect in case.effects} <= set(FAMILIES)


def test_the_confusion_table_counts_every_true_and_every_false_effect_once() -> None:
    cells = [
        (("spring on J2",), ("spring on J2",)),
        (("stribeck on J4", "spring on J1"), ("nonlinear-viscous on J4",)),
        (("coupling on J4+J5",), ("stribeck on J5", "lag on J1")),
        ((), ("lag on J3",)),
    ]
    lines = confusion(cells).splitlines()
    columns = [text.strip() for text in lines[0].strip("|").split("|")]
    counts: dict[tuple[str, str], int] = {}
    for line in lines[2:]:
        row, *texts = (text.strip() for text in line.strip("|").split("|"))
        counts |= {
            (row, column): int(text)
            for column, text in zip(columns[1:], texts, strict=True)
            if text
        }
    expected = {
        ("spring", "spring"): 1,
        ("stribeck", "nonlinear-viscous"): 1,
        ("spring", NOTHING): 1,
        ("coupling", "stribeck"): 1,
        (NOTHING, "lag"): 2,
    }
    assert counts == expected


@dataclass(frozen=True)
class NamedUnit:
    name: str


@dataclass(frozen=True)
class SomeRow:
    text: str
    number: int
    size: float
    flag: bool
    sizes: tuple[float, ...]
    flags: tuple[bool, ...]
    names: tuple[str, ...]


ROW = SomeRow(
    'a "quoted" name, with a comma', -3, 0.25, True, (1.5, float("inf")), (True, False), ()
)


def test_the_rows_of_a_study_come_back_from_their_table() -> None:
    changed_row = replace(ROW, flag=False, sizes=(), names=("lag on J1", "spring on J2"))
    rows = (ROW, changed_row)
    text = to_csv(SomeRow, rows)
    assert from_csv(SomeRow, text) == rows


def test_a_unit_is_done_again_only_where_what_it_depends_on_differs(tmp_path: Path) -> None:
    def make(unit: NamedUnit) -> list[SomeRow]:
        made.append(unit.name)
        return [replace(ROW, number=len(made))]

    made: list[str] = []
    unit = NamedUnit("one")
    for mark in ("a", "a", "b"):
        rows = rows_of_unit(tmp_path, unit, SomeRow, mark, make)
    assert made == ["one", "one"]
    units = [unit, NamedUnit("another")]
    assert finished_rows(tmp_path, units, SomeRow, lambda _: "b") == rows
    assert finished_rows(tmp_path, units, SomeRow, lambda _: "a") == ()


def test_rows_carried_to_another_machine_are_finished_there_for_the_same_code_alone(
    tmp_path: Path,
) -> None:
    loop8_folder = tmp_path / "made" / "loop8"
    made = loop8_folder / "clean-00.json"
    made.parent.mkdir(parents=True)
    made.write_text('{"case": "clean-00"}')
    finish(made, "of this code")
    (made.parent / "unfinished.json").write_text("{}")
    packed = tmp_path / "data" / "rows.jsonl"

    folder = tmp_path / "made"
    assert pack(folder, packed) == 1
    other_folder = tmp_path / "other"
    assert unpack(packed, other_folder) == 1

    carried = tmp_path / "other" / "loop8" / "clean-00.json"
    assert carried.read_text() == made.read_text()
    assert is_finished(carried, "of this code")
    assert not is_finished(carried, "of code that has changed")
    assert unpack(packed, tmp_path / "other") == 0  # what is there stays


def test_blocks_of_a_guided_session_begin_after_each_change_of_the_payload() -> None:
    bare_s, loaded_s, held_out_s, *_ = start_times_s(GUIDED)

    assert bare_s == 0.0
    expected = BLOCK_S + PAUSE_S + CHANGE_S
    assert loaded_s == expected
    loaded_s_expected = loaded_s + BLOCK_S + PAUSE_S
    assert held_out_s == loaded_s_expected
    assert start_times_s(GUIDED)[-1] == 6 * (BLOCK_S + PAUSE_S) + 3 * CHANGE_S
    assert start_times_s(BARE_THEN_LOADED)[-1] == 6 * (BLOCK_S + PAUSE_S) + CHANGE_S


def test_no_unit_is_begun_after_its_minutes() -> None:
    lines: list[str] = []
    units = [NamedUnit(str(number)) for number in range(5)]
    assert (
        work_off(units, lambda unit: unit.name, 2.0, lambda: 50.0 * len(lines), lines.append) == 2
    )
    assert lines == ["0", "1", "2"]


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), count=st.integers(12, 60))
def test_regions_are_of_one_size_and_the_same_for_one_seed(seed: int, count: int) -> None:
    rng = np.random.default_rng(count)
    position = rng.normal(size=(count, 6))
    part = region_of(position, seed)
    np.testing.assert_array_equal(part, region_of(position, seed))
    sizes = np.bincount(part, minlength=PARTS)
    assert len(sizes) == PARTS
    assert np.ptp(sizes) <= 1


def test_regions_are_apart_in_the_workspace_in_any_unit() -> None:
    corners = np.array([[0.0, 0.0], [0.0, 10.0], [10.0, 0.0], [10.0, 10.0]])
    place = np.tile(np.arange(4), 10)
    rng = np.random.default_rng(1)
    position = corners[place] + 0.1 * rng.normal(size=(40, 2))
    for seed in range(5):
        part = region_of(position, seed)
        assert len({(int(one), int(corner)) for one, corner in zip(part, place, strict=True)}) == 4
        expected = region_of(position * [1e-3, 1.0], seed)
        np.testing.assert_array_equal(part, expected)


def _circling_run(name: str = "run", axes: int = 2) -> Run:
    time_s = np.arange(4000) / 200.0
    position = np.stack([np.sin((1.0 + 0.3 * axis) * time_s) for axis in range(axes)], axis=1)
    current = np.stack([(1.0 + axis) * time_s for axis in range(axes)], axis=1)
    return Run(name, time_s, position, current)


ROWS = Conditioning(decimation_cutoff_hz=20.0, standstill_rad_s=(0.02,) * 6)


def test_a_split_by_region_leaves_each_sample_on_one_side() -> None:
    runs = [_circling_run("a", 6), _circling_run("b", 6)]
    parts = split_by_region(runs, 0.5, seed=2)
    expected = set(range(PARTS))
    assert set(map(int, chain.from_iterable(parts))) == expected
    left_out = [part == 1 for part in parts]
    model = model_of(load_cell(CELL))
    rest, unseen = two_sides(runs, left_out, model, ROWS)
    assert [run.name for run in rest] == ["a, the rest", "b, the rest"]
    for one, other in zip(rest, unseen, strict=True):
        assert one.valid is not None
        assert other.valid is not None
        assert np.all(one.valid ^ other.valid)


def test_a_side_in_one_long_stretch_is_a_run_of_its_own() -> None:
    run = _circling_run(axes=6)
    left_out = [np.arange(4000) >= 3000]
    model = model_of(load_cell(CELL))
    (rest,), (unseen,) = two_sides([run], left_out, model, ROWS)
    # 15 s are a run, 5 s are a part of one.
    assert (len(rest.time_s), len(unseen.time_s)) == (3000, 4000)
    assert rest.time_s[-1] == run.time_s[2999]


@pytest.mark.parametrize("samples", [0, 20, 1000])
def test_a_side_without_a_moving_window_is_no_run(samples: int) -> None:
    run = _circling_run(axes=6)
    position = run.position_rad.copy()
    position[:1100] = position[1100]
    still = replace(run, position_rad=position)
    left_out = [np.arange(4000) < samples]
    model = model_of(load_cell(CELL))
    rest, unseen = two_sides([still], left_out, model, ROWS)
    assert len(rest) == 1
    assert unseen == []


def test_blocks_are_as_long_as_the_change_is_correlated() -> None:
    rng = np.random.default_rng(5)
    run = np.repeat([0, 1], 512)
    white = rng.normal(size=1024)
    slow = np.repeat(rng.normal(size=32), 32)
    assert len(independent_sums(white, run)) == 256
    assert len(independent_sums(slow, run)) <= 64
    assert independent_sums(slow, run).sum() == pytest.approx(slow.sum())


def test_noise_makes_a_rise_as_often_as_the_level_says() -> None:
    rng = np.random.default_rng(7)
    run = np.zeros(96, dtype=np.int64)
    noise = [judge_rise(rng.normal(size=96), run, level=0.05).is_shown for _ in range(400)]
    assert 0.02 <= np.mean(noise) <= 0.09
    harm = [judge_rise(rng.normal(loc=0.8, size=96), run, level=0.01).is_shown for _ in range(20)]
    assert all(harm)
    is_shown = judge_rise(np.zeros(96), run).is_shown
    assert not is_shown
    assert not judge_rise(np.ones(3), run[:3]).is_shown


def test_a_planted_mistake_changes_what_it_says_alone() -> None:
    run = _circling_run()
    cell = load_cell(CELL)
    planted = Planted(Mistake.ZERO, 1, 0.02)
    ((moved,), same) = plant([run], cell, planted, seed=1)
    assert same is cell
    expected = np.tile([0.0, 0.02], (4000, 1))
    position_difference_rad = moved.position_rad - run.position_rad
    np.testing.assert_allclose(position_difference_rad, expected, atol=1e-15)
    ((late,), _) = plant([run], cell, Planted(Mistake.ENCODER, 0, 0.005), seed=1)
    np.testing.assert_allclose(late.position_rad[1:, 0], run.position_rad[:-1, 0], atol=1e-9)
    np.testing.assert_array_equal(late.position_rad[:, 1], run.position_rad[:, 1])
    np.testing.assert_array_equal(late.current_a, run.current_a)
    ((delayed,), _) = plant([run], cell, Planted(Mistake.CURRENT, 1, 0.0025), seed=1)
    current_a_expected = run.current_a[1:, 1] - 2.0 * 0.0025
    np.testing.assert_allclose(delayed.current_a[1:, 1], current_a_expected, atol=1e-9)
    np.testing.assert_array_equal(delayed.position_rad, run.position_rad)
    ((untouched,), tilt) = plant([run], cell, Planted(Mistake.GRAVITY, -1, radians(1.0)), seed=1)
    assert untouched is run
    cosine = np.dot(tilt.gravity_m_s2, cell.gravity_m_s2) / 9.81**2
    assert np.degrees(np.arccos(cosine)) == pytest.approx(1.0, rel=1e-6)


@settings(max_examples=25)
@given(heading=st.floats(0.0, 6.0), angle=st.floats(0.001, 3.0))
def test_a_tilt_keeps_the_size_of_gravity(heading: float, angle: float) -> None:
    gravity = np.array([1.0, -2.0, -9.0])
    turned = np.array(list(tilted(gravity.tolist(), angle, heading)))
    turned_norm = np.linalg.norm(turned)
    gravity_norm = np.linalg.norm(gravity)
    assert turned_norm == pytest.approx(gravity_norm)
    assert turned @ gravity / (gravity @ gravity) == pytest.approx(np.cos(angle))


def _evidence_of(
    effects: tuple[PlacedEffect, ...], values: list[float], std: list[float]
) -> Evidence:
    """What `judge_mistake` reads of an evidence:
    two fixed gains, and the coefficients of effects.
    """
    unknowns = tuple(chain.from_iterable(placed.columns for placed in effects))
    covariance = np.diag([0.0, 0.0, *np.square(std)])
    parameters = np.array(values)
    gains = np.ones(2)
    estimate = SimpleNamespace(
        unknowns=unknowns, parameters=parameters, covariance=covariance, gains=gains
    )
    simple_namespace = SimpleNamespace(effects=effects, declared=0, estimate=estimate)
    return cast(Evidence, simple_namespace)


def test_a_mistake_is_named_on_its_own_axis_only_and_its_size_is_judged_in_sigmas() -> None:
    spring = PlacedEffect(Spring(), 0)
    lag = PlacedEffect(Lag(), 1)
    evidence = _evidence_of((spring, lag), [1.0, 0.0034], [0.1, 0.0002])
    planted = Planted(Mistake.CURRENT, 1, 0.003)
    found = judge_mistake(evidence, planted)
    assert found.named
    assert (found.value, found.std) == pytest.approx((0.0034, 0.0002))
    assert found.z == pytest.approx(2.0)
    assert found.others == (spring,)
    elsewhere = judge_mistake(evidence, Planted(Mistake.CURRENT, 0, 0.003))
    assert not elsewhere.named
    assert elsewhere.others == (spring, lag)
    named = judge_mistake(evidence, Planted(Mistake.CLEAN)).named
    assert not named


@pytest.mark.parametrize("planted_rad", [0.035, -0.035])
def test_a_zero_that_is_corrected_the_wrong_way_is_far_off(planted_rad: float) -> None:
    """Positions that are too large by so much need it taken off."""
    zero = PlacedEffect(ZeroOffset(), 1)
    planted = Planted(Mistake.ZERO, 1, planted_rad)
    evidence = _evidence_of((zero,), [-planted_rad], [0.001])
    right = judge_mistake(evidence, planted)
    wrong = judge_mistake(_evidence_of((zero,), [planted_rad], [0.001]), planted)
    assert right.z == pytest.approx(0.0)
    assert abs(wrong.z) == pytest.approx(70.0)
