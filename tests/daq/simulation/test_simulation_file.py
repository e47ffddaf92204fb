"""The simulator's truth: read strictly, and never by identification."""

from __future__ import annotations

import ast
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
    np.testing.assert_allclose(spec.start_rad, [0, 0, np.pi / 2, 0, 0, 0])
    assert spec.axes[3].gain_nm_per_a == -9.21
    assert "<robot" in spec.urdf
    assert load_simulation(path).payload is None


def test_an_unknown_payload_is_refused(checkout: Path) -> None:
    with pytest.raises(UsageError, match="disc, plate"):
        load_simulation(checkout / "configs/simulation/clean.yaml", "brick")


@pytest.mark.parametrize(
    ("old", "new", "kind", "message"),
    [
        ("axis: J3", "axis: J9", ConfigurationInconsistent, "J1 to J6"),
        ("axis: J3", "axis: elbow", SchemaMismatch, r"effects\[0\].axis"),
        ("start_deg: [0.0, ", "start_deg: [", ConfigurationInconsistent, "5 angles"),
        ("serial: 1001", "serail: 1001", SchemaMismatch, "serial"),
        ("serial: 1001", "serial: 1001, torque_disturbance_percent: 11", SchemaMismatch, "torque_disturbance_percent"),
        ("gain_nm_per_a: 33.9", "gain_nm_per_a: 0.0", ConfigurationInconsistent, "not zero"),
    ],
)
def test_a_wrong_file_is_refused(
    checkout: Path, tmp_path: Path, old: str, new: str, kind: type[Exception], message: str
) -> None:
    text = (checkout / "configs/simulation/demo.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "spoiled.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(kind, match=message):
        load_simulation(path)


def test_only_simulate_and_demo_import_the_truth(checkout: Path) -> None:
    importers = set()
    for room in ("daq", "ident", "drivers"):
        for path in (checkout / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                if "daq.simulation.simulation_file" in names:
                    importers.add(str(path.relative_to(checkout)))
    assert importers <= READERS
