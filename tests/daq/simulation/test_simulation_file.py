"""The simulator's truth: read strictly, and never by identification."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from daq.errors import ConfigurationInconsistent, SchemaMismatch, UsageError
from daq.simulation.simulation_file import load_simulation

READERS = {"daq/cli/simulate.py", "daq/simulation/demo.py"}


def test_the_truth_is_read(checkout: Path) -> None:
    path = checkout / "configs/simulation/demo.yaml"
    spec = load_simulation(path, "disc")
    assert spec.payload is not None
    assert spec.payload.mass_kg == 4.59
    assert (spec.effects[0].name, spec.effects[0].axis) == ("load-friction", 2)
    expected = [0, 0, np.pi / 2, 0, 0, 0]
    np.testing.assert_allclose(spec.start_rad, expected)
    gain_nm_per_a = spec.axes[3].gain_nm_per_a
    assert gain_nm_per_a == -9.21
    assert "<robot" in spec.urdf
    assert load_simulation(path).payload is None


def test_a_cell_file_for_a_simulation_is_refused_without_advice_on_a_cell(checkout: Path) -> None:
    """`simulate` takes no CELL: none can come first."""
    with pytest.raises(SchemaMismatch) as refused:
        load_simulation(checkout / "configs/cells/demo.yaml")
    assert refused.value.found == "a cell file"
    assert refused.value.expected == "a simulation file"
    assert "CELL" not in refused.value.remedy


def test_an_unknown_payload_is_refused(checkout: Path) -> None:
    with pytest.raises(UsageError, match="disc, plate"):
        load_simulation(checkout / "configs/simulation/clean.yaml", "brick")


@pytest.mark.parametrize(
    ("old", "new", "kind", "message"),
    [
        ("axis: J3", "axis: J9", ConfigurationInconsistent, "J1 to J6"),
        (
            "substeps:",
            "tuned_with: anvil\nsubsteps:",
            ConfigurationInconsistent,
            "tuned_with: found 'anvil'",
        ),
        ("axis: J3", "axis: elbow", SchemaMismatch, r"effects\[0\].axis"),
        ("start_deg: [0.0, ", "start_deg: [", ConfigurationInconsistent, "5 angles"),
        ("serial: 1001", "serail: 1001", SchemaMismatch, "serial"),
        (
            "serial: 1001",
            "serial: 1001, torque_disturbance_percent: 11",
            SchemaMismatch,
            "torque_disturbance_percent",
        ),
        ("gain_nm_per_a: 33.9", "gain_nm_per_a: 0.0", ConfigurationInconsistent, "not zero"),
        (
            "gain_nm_per_a: 33.9",
            "gain_nm_per_a: -1.0e308",
            ConfigurationInconsistent,
            r"axes\[0\].gain_nm_per_a",
        ),
        (
            "rated_current_a: 2.0",
            "rated_current_a: 1.0e-300",
            ConfigurationInconsistent,
            "rated_current_a",
        ),
        (
            "motor_inertia_kg_m2: 0.35",
            "motor_inertia_kg_m2: 1.0e300",
            ConfigurationInconsistent,
            "at most ±1e.09",
        ),
        (
            "coefficient: 0.12",
            "coefficient: 1.0e300",
            ConfigurationInconsistent,
            "parameters.coefficient",
        ),
        (
            "[32, 0, 0, 0, 0, 0]",
            "[1.0e200, 0, 0, 0, 0, 0]",
            ConfigurationInconsistent,
            r"ratio\[0\]",
        ),
        ("mass_kg: 4.59", "mass_kg: 1.0e308", ConfigurationInconsistent, "payloads.disc.mass_kg"),
        (
            "centre_m: [-0.06",
            "centre_m: [1.0e200",
            ConfigurationInconsistent,
            "payloads.disc.centre_m: .* mm",
        ),
        (
            "[0.016, 0.0, 0.0, 0.016, 0.0,",
            "[-1, 0.0, 0.0, -1, 0.0,",
            ConfigurationInconsistent,
            "none below 0",
        ),
        (
            "[0.016, 0.0, 0.0, 0.016, 0.0,",
            "[1.0e200, 0.0, 0.0, 1, 0.0,",
            ConfigurationInconsistent,
            "of gyration",
        ),
    ],
)
def test_a_wrong_file_is_refused(
    checkout: Path, tmp_path: Path, old: str, new: str, kind: type[Exception], message: str
) -> None:
    text = (checkout / "configs/simulation/demo.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "spoiled.yaml"
    changed_text = text.replace(old, new, 1)
    path.write_text(changed_text, encoding="utf-8")
    with pytest.raises(kind, match=message):
        load_simulation(path)


def test_a_closed_chain_is_read(checkout: Path) -> None:
    path = checkout / "configs/simulation/orthoglide.yaml"
    spec = load_simulation(path, "spindle")
    assert spec.motors == ("slide-x", "slide-y", "slide-z")
    expected = ("x", "y", "z", "rx", "ry")
    assert spec.closures[3].directions == expected
    assert spec.platform == "plate-centre"
    assert spec.passive["swing-x"].viscous_nm_s_rad == 0.01
    assert len(spec.assembly_rad) == 16


@pytest.mark.parametrize(
    ("old", "new", "kind", "message"),
    [
        (
            "second: rod-2-tip",
            "second: rod-3-tip",
            ConfigurationInconsistent,
            r"closures\[0\].second.*rod-3-tip",
        ),
        ("second: rod-2-tip", "second: rod-1-tip", ConfigurationInconsistent, "two links"),
        (
            "directions: [x, y]",
            "directions: [x, x]",
            ConfigurationInconsistent,
            "each direction once",
        ),
        ("directions: [x, y]", "directions: []", SchemaMismatch, r"closures\[0\].directions"),
        ("directions: [x, y]", "directions: [x, w]", SchemaMismatch, r"closures\[0\].directions"),
        (
            "motors: [crank-1, crank-2]",
            "motors: [crank-1]",
            ConfigurationInconsistent,
            "2 different joints",
        ),
        (
            "motors: [crank-1, crank-2]",
            "motors: [crank-1, hip]",
            ConfigurationInconsistent,
            "crank-1, hip",
        ),
        ("platform: plate", "platform: tray", ConfigurationInconsistent, "a link of the URDF"),
        ("elbow-1: 0,", "", ConfigurationInconsistent, "no elbow-1"),
        (
            "  elbow-2: {viscous",
            "  crank-2: {viscous",
            ConfigurationInconsistent,
            "a joint with a motor",
        ),
        ("  elbow-2: {viscous", "  knee: {viscous", ConfigurationInconsistent, "knee"),
        ("effects: []", "effects: [{name: stribeck}]", SchemaMismatch, "one of them"),
        (
            "effects: []",
            "assembly_mm: {crank-1: 0}\neffects: []",
            ConfigurationInconsistent,
            "prismatic",
        ),
    ],
)
def test_a_wrong_closed_chain_is_refused(
    checkout: Path, tmp_path: Path, old: str, new: str, kind: type[Exception], message: str
) -> None:
    folder = checkout / "configs/simulation"
    text = (folder / "five-bar.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "spoiled.yaml"
    changed_text = text.replace(old, new, 1)
    path.write_text(changed_text, encoding="utf-8")
    content = (folder / "five-bar-plant.urdf").read_bytes()
    (tmp_path / "five-bar-plant.urdf").write_bytes(content)
    with pytest.raises(kind, match=message):
        load_simulation(path)


def test_a_serial_robot_has_no_key_of_a_closed_chain(checkout: Path, tmp_path: Path) -> None:
    folder = checkout / "configs/simulation"
    path = tmp_path / "gantry.yaml"
    content = (folder / "gantry-plant.urdf").read_bytes()
    (tmp_path / "gantry-plant.urdf").write_bytes(content)
    text = (folder / "gantry.yaml").read_text(encoding="utf-8")
    path.write_text(
        text + "motors: [X, Y, Z, A, B]\n",
        encoding="utf-8",
    )
    with pytest.raises(ConfigurationInconsistent, match="without closures"):
        load_simulation(path)


@pytest.mark.parametrize("name", ["demo", "five-bar"])
def test_a_joint_that_follows_another_is_refused_and_not_simulated_as_a_free_one(
    name: str, checkout: Path, tmp_path: Path
) -> None:
    folder = checkout / "configs/simulation"
    text = (folder / f"{name}.yaml").read_text()
    found = re.search(r"(?m)^urdf: *(\S+)", text)
    assert found is not None
    urdf = (folder / found[1]).read_text()
    matches = re.findall(r'<joint name="([^"]+)" type="(?!fixed)', urdf)
    first, last = matches[::2][:2]
    head, joint, tail = urdf.partition(f'<joint name="{last}"')
    mimic = f'<mimic joint="{first}" multiplier="0.5"/></joint>'
    changed_tail = tail.replace("</joint>", mimic, 1)
    (tmp_path / "mimic.urdf").write_text(head + joint + changed_tail)
    changed_text = text.replace(found[1], "mimic.urdf")
    (tmp_path / "cell.yaml").write_text(changed_text)
    with pytest.raises(ConfigurationInconsistent) as caught:
        load_simulation(tmp_path / "cell.yaml")
    assert f"joint {last} with <mimic> of {first}" in caught.value.found
    assert "closures" in caught.value.expected


@pytest.mark.slow
def test_only_simulate_and_demo_import_the_truth(checkout: Path) -> None:
    importers = set()
    for room in ("daq", "ident", "drivers"):
        for path in (checkout / room).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Import):
                    names = [a.name for a in node.names]
                else:
                    names = []
                if isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                if "daq.simulation.simulation_file" in names:
                    importers.add(str(path.relative_to(checkout)))
    assert importers <= READERS
