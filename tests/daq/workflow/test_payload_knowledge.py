"""Parameters of a payload in a cell file, and those that a fit takes as known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.cell import Cell, WeighedPayload
from daq.config.cell_file import drawn_parameters, load_cell
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent, SchemaMismatch
from daq.workflow.cases import payload_as
from daq.workflow.choices import Known
from ident.model.bodies import LINK_PARAMETERS, Payload

DRAWN = (
    "mass_kg: 4.59\n    centre_m: [-0.06, -0.063, 0.095]\n    inertia_kg_m2: [0.016, 0.001, "
    "0.0, 0.017, 0.0, 0.012]"
)


@pytest.fixture
def configurations(tmp_path: Path) -> Path:
    """A copy of the shipped configurations that a test may change."""
    folder = tmp_path / "configs"
    shutil.copytree(shipped_configurations(), folder)
    return folder


def _cell(configurations: Path, payload: str) -> Cell:
    path = configurations / "cells" / "demo.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count("mass_kg: 4.59") == 1
    changed_text = text.replace("mass_kg: 4.59", payload)
    path.write_text(changed_text, encoding="utf-8")
    return load_cell(path)


def test_a_drawing_gives_all_ten_in_the_last_joints_frame(configurations: Path) -> None:
    (disc,) = _cell(configurations, DRAWN).payloads
    assert set(disc.drawn.known) == set(LINK_PARAMETERS)
    assert disc.payload.known == {"m": 4.59}  # as in the log; a fit takes it unless given another
    x = -0.06
    y = -0.063
    z = 0.095
    known = disc.drawn.known
    assert (known["mx"], known["my"], known["mz"]) == pytest.approx((4.59 * x, 4.59 * y, 4.59 * z))
    assert known["Ixx"] == pytest.approx(0.016 + 4.59 * (y * y + z * z))
    assert known["Ixy"] == pytest.approx(0.001 - 4.59 * x * y)
    assert known["Izz"] == pytest.approx(0.012 + 4.59 * (x * x + y * y))


def test_part_of_a_drawing_is_part_of_the_knowledge(configurations: Path) -> None:
    (disc,) = _cell(configurations, "mass_kg: 4.59\n    centre_m: [0.1, 0, 0]").payloads
    assert set(disc.known) == {"mx", "my", "mz"}


def test_single_parameters_are_about_the_frame(configurations: Path) -> None:
    (disc,) = _cell(configurations, "mass_kg: 4.59\n    known: {mz: 0.4, Ixx: 0.08}").payloads
    expected = {"m": 4.59, "mz": 0.4, "Ixx": 0.08}
    assert disc.drawn.known == expected


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        ("mass_kg: 4.59\n    inertia_kg_m2: [1, 0, 0, 1, 0, 1]", "about the centre of mass"),
        ("mass_kg: 4.59\n    centre_m: [0, 0, 0]\n    known: {mz: 0.4}", "not both"),
        ("mass_kg: 4.59\n    centre: [0, 0, 0]", "centre_m"),
    ],
)
def test_two_spellings_of_one_thing_are_refused(
    configurations: Path, payload: str, message: str
) -> None:
    with pytest.raises(SchemaMismatch, match=message):
        _cell(configurations, payload)


@pytest.mark.parametrize(
    "inertia", ["[0.016, 0, 0, 0.016, 0, 0.05]", "[0.01, 0.02, 0, 0.01, 0, 0.01]"]
)
def test_an_inertia_that_no_body_has_is_refused(configurations: Path, inertia: str) -> None:
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"inertia_kg_m2: found principal moments "
        r".*sum of the other",
    ):
        _cell(
            configurations, f"mass_kg: 4.59\n    centre_m: [0, 0, 0]\n    inertia_kg_m2: {inertia}"
        )


def test_a_mounting_is_one_body(configurations: Path) -> None:
    second = "mass_kg: 4.59\n  - name: plate\n    mounting: flange-a\n    mass_kg: 1.686"
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"flange-a, used 2 times.*a name "
        r"of its own",
    ):
        _cell(configurations, second)
    other = second.replace("mounting: flange-a", "mounting: flange-b")
    path = configurations / "cells" / "demo.yaml"
    text = path.read_text(encoding="utf-8")
    changed_text = text.replace(second, other)
    path.write_text(changed_text, encoding="utf-8")
    payloads = load_cell(path).payloads
    mountings = [payload.mounting for payload in payloads]
    assert mountings == ["flange-a", "flange-b"]


@given(
    st.lists(st.floats(0.01, 1.0), min_size=3, max_size=3),
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
)
@settings(deadline=None, max_examples=25)
def test_moving_an_inertia_keeps_it_a_bodys(half: list[float], centre: list[float]) -> None:
    """A box of half-sides: its inertia about any frame is positive definite with its first
    moments.
    """
    a, b, c = (2.0 * side**2 for side in half)
    about_centre_kg_m2 = (b + c, 0.0, 0.0, a + c, 0.0, a + b)
    known = drawn_parameters(2.0, tuple(centre), about_centre_kg_m2)
    inertia = np.array(
        [
            [known["Ixx"], known["Ixy"], known["Ixz"]],
            [known["Ixy"], known["Iyy"], known["Iyz"]],
            [known["Ixz"], known["Iyz"], known["Izz"]],
        ]
    )
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    first = np.array([known["mx"], known["my"], known["mz"]])
    pseudo = np.block([[second, first[:, None]], [first[None], np.array([[2.0]])]])
    pseudo_eigenvalues = np.linalg.eigvalsh(pseudo)
    assert pseudo_eigenvalues.min() > 0.0


def test_a_fit_reports_as_much_as_it_asks_for(configurations: Path) -> None:
    cell = _cell(configurations, DRAWN)
    logged = cell.payloads[0].payload
    known = payload_as(logged, cell, Known.NOTHING).known
    assert known == {}
    payload = replace(logged, known={"m": 4.59, "mx": 1.0})
    assert payload_as(payload, cell, Known.MASS).known == {"m": 4.59}
    assert payload_as(logged, cell, Known.CAD) == cell.payloads[0].drawn
    # What the log says was weighed; a later cell file does not change it.
    heavier = WeighedPayload("disc", "flange-a", 5.0, 0.0, cell.payloads[0].known)
    changed_cell = replace(cell, payloads=(heavier,))
    assert payload_as(logged, changed_cell, Known.CAD).known["m"] == 4.59
    assert payload_as(Payload("plate", "x"), cell, Known.CAD).known == {}


def test_a_drawing_that_is_not_there_is_asked_for(configurations: Path) -> None:
    cell = load_cell(configurations / "cells/demo.yaml")
    payload = cell.payloads[0].payload
    with pytest.raises(ConfigurationInconsistent, match="centre_m and inertia_kg_m2"):
        payload_as(payload, cell, Known.CAD)
